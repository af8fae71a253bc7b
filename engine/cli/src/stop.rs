//! Stop flags of commands.

use std::io::Read;
use std::os::unix::process::parent_id;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use nix::sys::signal::{SigSet, Signal};

use crate::failure::Failure;

/// How often a child process checks whether its parent is running.
const PARENT_INTERVAL: Duration = Duration::from_millis(200);

/// The flag of the running command. A process has one set of signal handlers, so all commands of a process share it.
static STOP: AtomicBool = AtomicBool::new(false);

/// When the first signal since the flag was cleared came.
static FIRST_SIGNAL: Mutex<Option<Instant>> = Mutex::new(None);

/// Called before a second signal ends the process.
static BEFORE_EXIT: Mutex<Option<fn()>> = Mutex::new(None);

/// Signals within this time of the first count as one, since a closing terminal sends several.
const SAME_SIGNAL: Duration = Duration::from_millis(200);

/// How often a waiting command checks its flag.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// How long a command that was asked to stop may take for one piece of work.
const GRACE: Duration = Duration::from_secs(5);

/// Exit status of a process ended by a second signal, the same as for one killed by SIGINT.
const INTERRUPTED: i32 = 130;

/// A flag that SIGINT (Ctrl-C), SIGTERM or SIGHUP sets. Each call clears it. A second signal ends the process at once,
/// in case the command does not check the flag or takes too long.
pub fn on_signal() -> Result<&'static AtomicBool, Failure> {
    // A second call of `set_handler` is an error.
    static HANDLER: OnceLock<Result<(), String>> = OnceLock::new();
    let stop = || {
        STOP.store(true, Ordering::Relaxed);
        let mut first = FIRST_SIGNAL.lock().unwrap_or_else(PoisonError::into_inner);
        if first.get_or_insert_with(Instant::now).elapsed() >= SAME_SIGNAL {
            prepare_exit();
            std::process::exit(INTERRUPTED);
        }
    };
    let set = || {
        ctrlc::set_handler(stop).map_err(|error| match error {
            ctrlc::Error::System(error) => no_thread(error),
            _ => error.to_string(),
        })
    };
    HANDLER.get_or_init(set).clone()?;
    *FIRST_SIGNAL.lock().unwrap_or_else(PoisonError::into_inner) = None;
    STOP.store(false, Ordering::Relaxed);
    Ok(&STOP)
}

/// Keeps SIGHUP ignored where it is, as under `nohup`, by blocking it in this thread and those that it starts. To be called before
/// [`on_signal`].
pub fn keep_ignored_hangup() {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok());
    if ignored.is_some_and(|signals| signals & 1 << (Signal::SIGHUP as u32 - 1) != 0) {
        let _ = SigSet::from(Signal::SIGHUP).thread_block();
    }
}

/// Sets what to do before a second signal ends the process.
pub fn before_exit(action: fn()) {
    *BEFORE_EXIT.lock().unwrap_or_else(PoisonError::into_inner) = Some(action);
}

fn prepare_exit() {
    if let Some(action) = BEFORE_EXIT.lock().unwrap_or_else(PoisonError::into_inner).take() {
        action();
    }
}

/// Watches a command that may not notice the flag, until this is dropped.
#[must_use]
pub struct Watchdog(#[expect(dead_code, reason = "held until it is dropped")] Arc<()>);

/// Calls `end`, which does not return if it ends the process, when the flag has been set for [`GRACE`] and `stuck` says that one
/// piece of work has taken as long, and what it is. Fails if a thread cannot be started.
pub fn watch(
    stop: &'static AtomicBool,
    stuck: impl Fn(Duration) -> Option<String> + Send + 'static,
    end: impl Fn(String) + Send + 'static,
) -> Result<Watchdog, Failure> {
    let running = Arc::new(());
    let command = Arc::downgrade(&running);
    let watches = move || {
        let mut asked = None;
        while command.strong_count() > 0 {
            if stop.load(Ordering::Relaxed)
                && asked.get_or_insert_with(Instant::now).elapsed() >= GRACE
                && let Some(work) = stuck(GRACE)
            {
                prepare_exit();
                end(work);
            }
            std::thread::sleep(PARENT_INTERVAL);
        }
    };
    std::thread::Builder::new().name("watchdog".to_owned()).spawn(watches).map_err(no_thread)?;
    Ok(Watchdog(running))
}

/// Waits up to `time` for the flag, and returns whether it is set.
pub fn wait(stop: &AtomicBool, time: Duration) -> bool {
    let start = Instant::now();
    while !stop.load(Ordering::Relaxed) && start.elapsed() < time {
        std::thread::sleep(POLL_INTERVAL.min(time));
    }
    stop.load(Ordering::Relaxed)
}

/// Sets the flag when the parent process requests it or ends: on a byte on standard input, when it closes, or when
/// `parent` is no longer this process's parent. Standard input alone would not do, since other children that the parent
/// has forked keep it open. Fails if a thread cannot be started.
pub fn with_parent(stop: &'static AtomicBool, parent: Option<u32>) -> Result<(), Failure> {
    let thread = |name: &str| std::thread::Builder::new().name(name.to_owned());
    let input = thread("input").spawn(move || {
        let _ = std::io::stdin().read(&mut [0]);
        stop.store(true, Ordering::Relaxed);
    });
    input.map_err(no_thread)?;
    if let Some(parent) = parent {
        let ended = move || {
            while parent_id() == parent {
                std::thread::sleep(PARENT_INTERVAL);
            }
            stop.store(true, Ordering::Relaxed);
        };
        thread("parent").spawn(ended).map_err(no_thread)?;
    }
    Ok(())
}

fn no_thread(error: std::io::Error) -> String {
    format!("cannot start a thread: {error}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_command_starts_with_a_cleared_flag() {
        on_signal().unwrap().store(true, Ordering::Relaxed);
        assert!(!on_signal().unwrap().load(Ordering::Relaxed));
    }
}
