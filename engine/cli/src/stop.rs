//! Stop flags of commands.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

use super::failure::Failure;

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

/// Sets the flag at the end of standard input, which a parent process that dies closes.
pub fn on_closed_input(stop: &'static AtomicBool) {
    std::thread::spawn(move || {
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        stop.store(true, Ordering::Relaxed);
    });
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
