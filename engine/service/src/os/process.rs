//! What the operating system says about other processes.

/// The state of a process as in `/proc/PID/stat`, such as `R`, `S` or `T`; `None` if there is no such process.
pub(crate) fn state(pid: u32) -> Option<char> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The state follows the program's name, which is in parentheses.
    stat.rsplit_once(") ")?.1.chars().next()
}

/// Whether a process exists and has not ended.
pub(crate) fn runs(pid: u32) -> bool {
    state(pid).is_some_and(|state| !matches!(state, 'Z' | 'X'))
}

/// A process that holds the lock of a namespace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LockHolder {
    /// Its process id.
    pub pid: u32,
    /// Whether it is stopped, by SIGSTOP or a debugger.
    pub stopped: bool,
}

impl LockHolder {
    /// Who holds the lock and what to do about it, for messages.
    pub(crate) fn text(holder: Option<Self>) -> String {
        match holder {
            Some(LockHolder { pid, stopped: true }) => {
                format!("process {pid}, which is stopped: continue it with `kill -CONT {pid}`, or end it")
            }
            Some(LockHolder { pid, stopped: false }) => format!("process {pid}: wait for it, or end it"),
            None => "another process that starts, ends or looks for an engine: wait for it, or end it".to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processes_that_have_ended_do_not_run() {
        assert!(runs(std::process::id()));
        let mut child = std::process::Command::new("true").spawn().unwrap();
        while state(child.id()) != Some('Z') {
            std::thread::yield_now();
        }
        assert!(!runs(child.id()));
        child.wait().unwrap();
        assert_eq!(state(child.id()), None);
    }
}
