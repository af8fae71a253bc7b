//! A batch in shared memory, lent to this process.

use std::sync::Arc;

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::port::ReceiveError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::sample::Sample;

use super::error::ServiceError;
use super::here::Here;
use super::message::{ObservationHeader, PayloadBlock};
use super::node::{Ipc, Member};
use super::ports::{self, ObservationSubscriber, Services};
use super::specification::Specification;
use endless_gym_core::batch::{Batch, Block};

/// A group's batch, read where the engine wrote it. The engine writes other batches elsewhere until this one is dropped.
pub struct Received {
    // The sample goes back before the port that it came through.
    sample: Here<Sample<Ipc, [PayloadBlock], ObservationHeader>>,
    specification: Arc<Specification>,
    // The engine takes back what it lent to a port that is gone, so the port stays for as long as the batch.
    _port: Arc<ObservationPort>,
}

// SAFETY: a shared reference only reads the payload and the headers, which nobody writes to while the sample is held. The parts
// of the sample that change are used when it is dropped, which takes ownership.
unsafe impl Sync for Received {}

impl Received {
    /// The arrays of the batch.
    pub fn batch(&self) -> Batch<'_> {
        Batch::new(&self.specification.batch, self.blocks())
    }

    /// The batch's memory, for readers with arrays of their own.
    pub fn blocks(&self) -> &[Block] {
        bytemuck::cast_slice(self.sample.payload())
    }

    /// The group that the batch is of.
    pub fn group(&self) -> usize {
        self.sample.user_header().group as usize
    }

    /// Batches that the group has yielded since the engine started, this one included.
    pub fn step(&self) -> u64 {
        self.sample.user_header().step
    }

    /// The engine's specification.
    pub fn specification(&self) -> &Specification {
        &self.specification
    }

    pub(super) fn answers(&self, trainer: u64, request: u64) -> bool {
        let header = self.sample.user_header();
        (header.trainer, header.request) == (trainer, request)
    }

    /// The batch, or why there is none.
    pub(super) fn or_rejection(self) -> Result<Self, ServiceError> {
        let header = self.sample.user_header();
        match header.rejection() {
            None => Ok(self),
            Some((reason, message)) => {
                let (service, group) = (self.specification.service.clone(), self.group());
                Err(ServiceError::Rejected { service, group, reason, message })
            }
        }
    }

    pub(super) fn is_batch(&self) -> bool {
        self.sample.user_header().is_batch()
    }

    /// The snapshot, if it is one and not a batch.
    pub(super) fn snapshot(&self) -> Option<&[u8]> {
        let bytes = self.sample.user_header().snapshot()?;
        bytemuck::cast_slice(self.sample.payload()).get(..bytes)
    }
}

impl std::fmt::Debug for Received {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Received").field("group", &self.group()).field("step", &self.step()).finish_non_exhaustive()
    }
}

/// The port through which one group's batches come.
pub(super) struct ObservationPort {
    subscriber: Here<ObservationSubscriber>,
    group: usize,
    engine: UniqueNodeId,
    _node: Arc<Member>,
}

impl ObservationPort {
    pub(super) fn open(
        services: &Services<'_>,
        node: &Arc<Member>,
        group: usize,
        specification: &Specification,
    ) -> Result<Self, ServiceError> {
        let service = services.observations(group, specification.limits())?;
        let restarted = || ServiceError::EngineRestarted { service: specification.service.clone() };
        let engine = ports::publishing_node(&service).ok_or_else(restarted)?;
        let subscriber = service.subscriber_builder().create().map_err(|e| match e {
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => ServiceError::TooManyObservers {
                service: specification.service.clone(),
                limit: specification.observers,
            },
            e => ServiceError::middleware("cannot create a subscriber")(e.to_string()),
        })?;
        Ok(ObservationPort { subscriber: Here::new(subscriber), group, engine, _node: Arc::clone(node) })
    }

    /// The node of the engine on the other side.
    pub(super) fn engine(&self) -> UniqueNodeId {
        self.engine
    }

    /// The next message, if there is one that this process can read.
    pub(super) fn receive(
        self: &Arc<Self>,
        specification: &Arc<Specification>,
    ) -> Result<Option<Received>, ServiceError> {
        let sample = match self.subscriber.receive() {
            Ok(None) => return Ok(None),
            Ok(Some(sample)) => sample,
            Err(ReceiveError::ExceedsMaxBorrows) => {
                return Err(ServiceError::TooManyBatchesHeld { group: self.group, limit: specification.batches_held });
            }
            // An engine that is gone; the trainer finds that out when it hears nothing.
            Err(ReceiveError::ConnectionFailure(e)) => {
                tracing::debug!(error = %e, "the engine cannot be heard");
                return Ok(None);
            }
        };
        let header = sample.user_header();
        // Whoever gets past the engine's lock on its services and publishes something else is no engine of ours.
        if header.group as usize != self.group
            || header.epoch != specification.epoch
            || sample.payload().len() < specification.batch.blocks()
        {
            return Err(ServiceError::IncompatibleTypes { service: specification.service.clone() });
        }
        Ok(Some(Received {
            sample: Here::new(sample),
            specification: Arc::clone(specification),
            _port: Arc::clone(self),
        }))
    }
}
