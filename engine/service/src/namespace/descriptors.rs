//! File descriptors: making sure that there are enough before iceoryx2 opens them.
//!
//! iceoryx2 opens descriptors for services, segments and sockets, also later, when another process connects. Without a free one a
//! port is created and never delivers anything. A process therefore reserves what it may need when it starts.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use crate::error::ServiceError;

/// Descriptors of a process to join a namespace and to look for an engine.
pub(crate) const NODE: usize = 16;

/// Descriptors of an engine with that many groups and observers in each group.
pub(crate) fn of_engine(groups: usize, observers: usize) -> usize {
    NODE + 24 + groups * (12 + 2 * observers)
}

/// Descriptors of a trainer of that many groups.
pub(crate) fn of_trainer(groups: usize) -> usize {
    NODE + 16 + groups * 12
}

/// Makes sure that this process can open `count` more descriptors. Raises its soft limit if necessary.
pub(crate) fn reserve(count: usize) -> Result<(), ServiceError> {
    // Without /proc, assume the standard streams.
    let open = std::fs::read_dir("/proc/self/fd").map_or(3, Iterator::count);
    let needed = (open + count) as u64;
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    if current.is_none_or(|current| needed <= current) {
        return Ok(());
    }
    let raised = maximum.is_none_or(|maximum| needed <= maximum)
        && setrlimit(Resource::Nofile, Rlimit { current: Some(needed), maximum }).is_ok();
    if raised { Ok(()) } else { Err(ServiceError::DescriptorLimit { needed, limit: maximum.or(current).unwrap_or(0) }) }
}
