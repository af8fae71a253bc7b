//! Binding threads to CPUs.

use crate::pool::error::PoolError;

/// The CPUs of the calling thread's affinity mask, at least `count`.
pub(super) fn cpus(count: usize) -> Result<Vec<usize>, PoolError> {
    let cpus = system::cpus().map_err(|source| PoolError::Pin { source })?;
    if cpus.len() < count { Err(PoolError::PinnedThreads { given: count, cpus: cpus.len() }) } else { Ok(cpus) }
}

/// Binds the calling thread to a CPU.
pub(super) fn pin(cpu: usize) -> Result<(), PoolError> {
    system::pin(cpu).map_err(|source| PoolError::Pin { source })
}

#[cfg(target_os = "linux")]
mod system {
    use std::io;

    use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

    pub(super) fn cpus() -> io::Result<Vec<usize>> {
        let set = sched_getaffinity(None)?;
        Ok((0..CpuSet::MAX_CPU).filter(|cpu| set.is_set(*cpu)).collect())
    }

    pub(super) fn pin(cpu: usize) -> io::Result<()> {
        let mut set = CpuSet::new();
        set.set(cpu);
        Ok(sched_setaffinity(None, &set)?)
    }
}

#[cfg(not(target_os = "linux"))]
mod system {
    use std::io;

    pub(super) fn cpus() -> io::Result<Vec<usize>> {
        Err(io::Error::new(io::ErrorKind::Unsupported, "this system does not support it"))
    }

    pub(super) fn pin(_cpu: usize) -> io::Result<()> {
        cpus().map(drop)
    }
}

#[cfg(all(test, target_os = "linux", feature = "threads", not(loom)))]
mod tests {
    use std::fs;
    use std::sync::Mutex;

    use super::*;
    use crate::pool::Threads;

    /// The CPUs on which the calling thread may run, as the kernel lists them.
    fn allowed() -> String {
        let status = fs::read_to_string("/proc/thread-self/status").unwrap();
        status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:")).unwrap().trim().to_owned()
    }

    #[test]
    fn workers_are_bound_and_the_caller_is_not() {
        let (before, all) = (allowed(), cpus(1).unwrap());
        let count = all.len().min(4);
        let threads = Threads::new(count).unwrap();
        threads.pin(0).unwrap();
        let found = Mutex::new(vec![String::new(); count]);
        threads.on_each(count, &|thread| found.lock().unwrap()[thread] = allowed());
        let expected = std::iter::once(before.clone()).chain(all[1..count].iter().map(usize::to_string));
        assert_eq!(found.into_inner().unwrap(), expected.collect::<Vec<_>>());
        let error = threads.pin(all.len()).unwrap_err();
        assert!(matches!(error, PoolError::PinnedThreads { cpus, .. } if cpus == all.len()), "{error}");
        std::thread::spawn(move || {
            Threads::pin_caller(all.len() - 1).unwrap();
            assert_eq!(allowed(), all[all.len() - 1].to_string());
        })
        .join()
        .unwrap();
        assert_eq!(allowed(), before);
    }
}
