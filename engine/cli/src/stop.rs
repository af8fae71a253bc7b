//! Stop flags of commands.

use std::io::Read;
use std::os::unix::process::parent_id;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::failure::Failure;

/// How often a child process looks whether its parent is running.
const PARENT_INTERVAL: Duration = Duration::from_millis(200);

/// The flag of the running command. A process has one set of signal handlers, so all commands of a process share it.
static STOP: AtomicBool = AtomicBool::new(false);

/// A flag that SIGINT (Ctrl-C), SIGTERM or SIGHUP sets. Each call clears it.
pub fn on_signal() -> Result<&'static AtomicBool, Failure> {
    // A second call of `set_handler` is an error.
    static HANDLER: OnceLock<Result<(), String>> = OnceLock::new();
    let set = || ctrlc::set_handler(|| STOP.store(true, Ordering::Relaxed)).map_err(|error| error.to_string());
    HANDLER.get_or_init(set).clone()?;
    STOP.store(false, Ordering::Relaxed);
    Ok(&STOP)
}

/// Sets the flag when the parent process asks for it or ends: with a byte on standard input, at its end, or when `parent` is no
/// longer this process's parent. The end of standard input alone would not do: children that the parent has forked keep it open.
pub fn with_parent(stop: &'static AtomicBool, parent: Option<u32>) {
    std::thread::spawn(move || {
        let _ = std::io::stdin().read(&mut [0]);
        stop.store(true, Ordering::Relaxed);
    });
    if let Some(parent) = parent {
        std::thread::spawn(move || {
            while parent_id() == parent {
                std::thread::sleep(PARENT_INTERVAL);
            }
            stop.store(true, Ordering::Relaxed);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_of_a_process_starts_with_a_cleared_flag() {
        on_signal().unwrap().store(true, Ordering::Relaxed);
        assert!(!on_signal().unwrap().load(Ordering::Relaxed));
    }
}
