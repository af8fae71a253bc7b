//! Makes sure that there are enough file descriptors before iceoryx2 opens them.
//!
//! iceoryx2 opens descriptors for services, segments and sockets, some of them later, when another process connects.
//! Without a free descriptor, a port is created but never delivers anything. A process therefore reserves all it may
//! need when it starts.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use crate::error::ServiceError;

/// Descriptors that a process needs to join a namespace and look for an engine.
pub(crate) const NODE: usize = 16;

/// Descriptors of an engine with that many groups, and observers in each group.
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
