//! Reservation of shared memory for an observer.
//!
//! An engine has reserved the chunks that it and its trainer need. The chunks of observers have addresses from the start and
//! memory only from their first use, so observers that hold batches could take memory that the engine then misses. An observer
//! therefore allocates its share in the engine's segment before it connects, or is refused.
//!
//! The chunks in use at a time are always among the first of the segment: the list of free chunks is a stack, with the first chunk
//! on top at the start. So the memory of as many chunks as can be in use at a time is enough.

use std::fs::File;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::MetadataExt;

use endless_gym_core::batch::BLOCK_BYTES;
use iceoryx2::prelude::{CallbackProgression, PortFactory, SemanticString};
use rustix::fs::FallocateFlags;
use rustix::io::Errno;

use crate::error::ServiceError;
use crate::group::chunk_blocks;
use crate::memory;
use crate::ports::{self, EngineServices};
use crate::specification::ServiceSpecification;
use crate::status_file;

/// Allocates the memory of the batches that one more observer of a group may hold. The caller holds the namespace's lock, so that
/// no other observer connects meanwhile.
pub(crate) fn reserve_for_observer(
    services: &EngineServices<'_>,
    group: usize,
    specification: &ServiceSpecification,
) -> Result<(), ServiceError> {
    let limits = specification.lease_limits();
    let responses = services.responses(group, limits)?;
    let trainer = services.requests(group).ok().and_then(|requests| ports::publisher_node(&requests));
    let mut ports = 0;
    responses.dynamic_config().list_subscribers(|subscriber| {
        ports += usize::from(Some(subscriber.node_id) != trainer);
        CallbackProgression::Continue
    });
    // An observer that is paused has a status and no port. A dead one may have a port, and one without a status has one, too.
    let statuses = status_file::running_observers(services.node.prefix(), specification.incarnation);
    let statuses = statuses.iter().filter(|observer| observer.group as usize == group).count();
    let observers = 1 + statuses.max(ports);
    if observers > specification.observers {
        let (service, limit) = (specification.service.clone(), specification.observers);
        return Err(ServiceError::TooManyObservers { service, limit });
    }
    let mut publisher = None;
    responses.dynamic_config().list_publishers(|details| {
        publisher = Some(details.publisher_id.value());
        CallbackProgression::Stop
    });
    let restarted = || ServiceError::EngineRestarted { service: specification.service.clone() };
    let Some(segment) = publisher.and_then(|publisher| segment(services, publisher)) else { return Err(restarted()) };

    let unused = limits.observer_chunks() * (specification.observers - observers);
    let chunk = (chunk_blocks(&specification.batch) * BLOCK_BYTES) as u64;
    let failed = |e: std::io::Error| ServiceError::middleware("cannot reserve shared memory")(e.to_string());
    let bytes = segment.metadata().map_err(failed)?.len().saturating_sub(chunk * unused as u64).max(1);
    // What is allocated already, in the file system's blocks of 512 bytes. The observer's own port needs memory, too.
    let allocated = segment.metadata().map_err(failed)?.blocks().saturating_mul(512);
    memory::check_free(bytes.saturating_sub(allocated).saturating_add(memory::MARGIN))?;
    match rustix::fs::fallocate(&segment, FallocateFlags::KEEP_SIZE, 0, bytes) {
        Ok(()) => Ok(()),
        Err(Errno::NOSPC | Errno::NOMEM) => Err(memory::too_small(chunk * limits.observer_chunks() as u64)),
        // The file system cannot allocate in advance.
        Err(Errno::OPNOTSUPP | Errno::NOSYS) => memory::check_free(chunk * limits.observer_chunks() as u64),
        Err(e) => Err(failed(e.into())),
    }
}

/// The data segment of the engine's publisher. Its name ends with the publisher's id.
fn segment(services: &EngineServices<'_>, publisher: u128) -> Option<File> {
    let global = &services.node.config().global;
    let suffix = format!("_{publisher}{}", global.service.data_segment_suffix);
    let is_segment = |name: &[u8]| name.starts_with(global.prefix.as_bytes()) && name.ends_with(suffix.as_bytes());
    let found =
        std::fs::read_dir(memory::PATH).ok()?.flatten().find(|entry| is_segment(entry.file_name().as_bytes()))?;
    File::options().read(true).write(true).open(found.path()).ok()
}
