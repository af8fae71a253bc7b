//! Leases on batches in shared memory, and the port that receives them.

use std::ptr::NonNull;
use std::sync::Arc;

use endless_gym_core::batch::{Batch, Block, LAYOUT_VERSION};
use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::port::ReceiveError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::prelude::PortName;
use iceoryx2::sample::Sample;

use crate::error::ServiceError;
use crate::namespace::directory::Ipc;
use crate::namespace::fork_guard::ForkGuard;
use crate::namespace::node::NamespaceNode;
use crate::protocol::message::{PayloadBlock, ResponseContent, ResponseHeader, copied, read_text};
use crate::protocol::ports::{self, BlockService, EngineServices, ResponseSubscriber, chunk_blocks};
use crate::protocol::specification::ServiceSpecification;

/// A lease on a group's batch in shared memory.
///
/// The batch is read in place, without a copy. The engine does not write to its memory until the lease is dropped.
/// [`batches_held`](ServiceSpecification::batches_held) leases of a group may be held at a time.
pub struct BatchLease {
    // Dropped before the port that received it.
    _sample: ForkGuard<Sample<Ipc, [PayloadBlock], ResponseHeader>>,
    payload: Payload,
    group: usize,
    step: u64,
    specification: Arc<ServiceSpecification>,
    // The engine reclaims the chunks of a closed port, so the port must outlive the lease.
    _port: Arc<ResponsePort>,
}

// SAFETY: `&self` gives access to the stored pointer and length of the payload, and to fields that are `Sync`. The sample is used
// when it is dropped, which requires ownership.
unsafe impl Sync for BatchLease {}

/// Address and length of a received payload. The length is checked once, on receipt: iceoryx2 rereads it from shared
/// memory in every call of `Sample::payload`, where the sender can change it at any time.
#[derive(Clone, Copy)]
struct Payload {
    start: NonNull<Block>,
    blocks: usize,
}

// SAFETY: an address in shared memory is the same in all threads.
unsafe impl Send for Payload {}

impl Payload {
    /// Cuts the payload at `longest` blocks, since a forged length may reach beyond the mapped memory.
    fn new(payload: &[PayloadBlock], longest: usize) -> Self {
        let blocks: &[Block] = bytemuck::cast_slice(payload);
        Payload { start: NonNull::from(blocks).cast(), blocks: blocks.len().min(longest) }
    }
}

impl BatchLease {
    /// The arrays of the batch.
    pub fn batch(&self) -> Batch<'_> {
        Batch::new(&self.specification.batch, self.blocks())
    }

    /// The memory of the batch, laid out as [`ServiceSpecification::batch`] says.
    pub fn blocks(&self) -> &[Block] {
        let Payload { start, blocks } = self.payload;
        // SAFETY: the pointer and the length are those of the payload when it was received. The memory is mapped, and the engine
        // does not write to it, for as long as the lease holds the sample. Every byte pattern is a valid block.
        unsafe { std::slice::from_raw_parts(start.as_ptr(), blocks) }
    }

    /// The number of the batch's group.
    pub fn group(&self) -> usize {
        self.group
    }

    /// Batches that the group has returned since the engine started, including this one.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// The engine's specification.
    pub fn specification(&self) -> &ServiceSpecification {
        &self.specification
    }
}

impl std::fmt::Debug for BatchLease {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BatchLease").field("group", &self.group).field("step", &self.step).finish_non_exhaustive()
    }
}

/// A message from the engine: a batch, a snapshot or a rejection.
pub(crate) struct Response {
    lease: BatchLease,
    /// The trainer and the number of the request that it answers.
    trainer: u64,
    request: u64,
    content: ResponseContent,
}

impl Response {
    /// Whether it answers that request.
    pub(crate) fn answers(&self, trainer: u64, request: u64) -> bool {
        (self.trainer, self.request) == (trainer, request)
    }

    /// The engine's name.
    pub(crate) fn service(&self) -> &str {
        &self.lease.specification.service
    }

    /// The batch; `None` if the message is something else.
    pub(crate) fn into_batch(self) -> Option<BatchLease> {
        (self.content == ResponseContent::Batch).then_some(self.lease)
    }

    /// A copy of the snapshot; `None` if the message is something else.
    pub(crate) fn to_snapshot(&self) -> Option<Vec<u8>> {
        let ResponseContent::Snapshot { bytes } = self.content else { return None };
        let payload: &[u8] = bytemuck::cast_slice(self.lease.blocks());
        payload.get(..bytes).map(<[u8]>::to_vec)
    }

    /// Turns a rejection into an error.
    pub(crate) fn check_accepted(self) -> Result<Self, ServiceError> {
        match self.content {
            ResponseContent::Rejection { reason, bytes } => {
                let message = read_text(self.lease.blocks(), bytes);
                let (service, group) = (self.lease.specification.service.clone(), self.lease.group);
                Err(ServiceError::Rejected { service, group, reason, message })
            }
            _ => Ok(self),
        }
    }
}

/// The service of one group's responses, opened by a process that receives them.
pub(crate) struct ResponseService {
    // Closed before the node.
    service: ForkGuard<BlockService<ResponseHeader>>,
    group: usize,
    engine: UniqueNodeId,
    node: Arc<NamespaceNode>,
}

impl ResponseService {
    pub(crate) fn open(
        services: &EngineServices<'_>,
        node: &Arc<NamespaceNode>,
        group: usize,
    ) -> Result<Self, ServiceError> {
        let service = services.responses(group)?;
        let restarted = || ServiceError::EngineRestarted { service: services.specification.service.clone() };
        let engine = ports::publisher_of(&service).ok_or_else(restarted)?.node_id;
        Ok(ResponseService { service: ForkGuard::new(service), group, engine, node: Arc::clone(node) })
    }

    /// Creates a port, which receives what is sent from now on. If `is_resumed`, an idle engine sends the last batch
    /// again.
    pub(crate) fn port(
        &self,
        specification: &ServiceSpecification,
        is_resumed: bool,
    ) -> Result<ResponsePort, ServiceError> {
        let name = PortName::new(if is_resumed { ports::RESUMED } else { "" });
        let name = name.map_err(ServiceError::middleware("cannot name a port"))?;
        let subscriber = self.service.subscriber_builder().name(&name).create().map_err(|e| match e {
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => ServiceError::TooManyObservers {
                service: specification.service.clone(),
                limit: specification.observers,
            },
            e => ServiceError::middleware("cannot create a subscriber")(e),
        })?;
        let (group, engine, node) = (self.group, self.engine, Arc::clone(&self.node));
        Ok(ResponsePort { subscriber: ForkGuard::new(subscriber), group, engine, _node: node })
    }

    /// The engine's node.
    pub(crate) fn engine(&self) -> UniqueNodeId {
        self.engine
    }
}

/// The port that receives one group's responses.
pub(crate) struct ResponsePort {
    subscriber: ForkGuard<ResponseSubscriber>,
    group: usize,
    engine: UniqueNodeId,
    _node: Arc<NamespaceNode>,
}

impl ResponsePort {
    pub(crate) fn open(
        services: &EngineServices<'_>,
        node: &Arc<NamespaceNode>,
        group: usize,
    ) -> Result<Self, ServiceError> {
        ResponseService::open(services, node, group)?.port(services.specification, false)
    }

    /// The engine's node.
    pub(crate) fn engine(&self) -> UniqueNodeId {
        self.engine
    }

    /// Whether there is a message.
    pub(crate) fn has_response(&self) -> bool {
        // As in `receive`, an engine that cannot be reached has sent nothing.
        self.subscriber.has_samples().unwrap_or(false)
    }

    /// The next message; `None` if there is none.
    pub(crate) fn receive(
        self: &Arc<Self>,
        specification: &Arc<ServiceSpecification>,
    ) -> Result<Option<Response>, ServiceError> {
        let sample = match self.subscriber.receive() {
            Ok(None) => return Ok(None),
            Ok(Some(sample)) => sample,
            Err(ReceiveError::ExceedsMaxBorrows) => {
                return Err(ServiceError::TooManyBatchesHeld { group: self.group, limit: specification.batches_held });
            }
            // The engine is dead, which the liveness check of the trainer or observer reports.
            Err(ReceiveError::ConnectionFailure(e)) => {
                tracing::debug!(error = %e, "cannot receive from the engine");
                return Ok(None);
            }
        };
        let header = copied(sample.user_header());
        let payload = Payload::new(sample.payload(), chunk_blocks(&specification.batch));
        if header.layout_version != LAYOUT_VERSION
            || header.group as usize != self.group
            || header.incarnation != specification.incarnation
            || payload.blocks < specification.batch.blocks()
        {
            return Err(ServiceError::IncompatibleTypes { service: specification.service.clone() });
        }
        let lease = BatchLease {
            _sample: ForkGuard::new(sample),
            payload,
            group: self.group,
            step: header.step,
            specification: Arc::clone(specification),
            _port: Arc::clone(self),
        };
        Ok(Some(Response { lease, trainer: header.trainer, request: header.request, content: header.content() }))
    }
}
