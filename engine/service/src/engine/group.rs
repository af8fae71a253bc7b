//! One group of an engine: its pool, its ports, and how it executes requests.

use endless_gym_core::batch::{ActionLayout, ActionSection, Batch, Block, LAYOUT_VERSION, SNAPSHOT_BYTES};
use endless_gym_core::envs::InfoColumn;
use endless_gym_core::pool::{
    EnvReset, NextOptions, Pool, PoolError, ResetRequest, ResumeError, SavedEnv, SnapshotError, Threads,
};
use std::sync::{Arc, Mutex, MutexGuard, TryLockError};

use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::{ReceiveError, SendError};
use iceoryx2::prelude::{CallbackProgression, PortFactory};
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use serde_json::{Map, Value as Json};

use crate::error::{Rejection, ServiceError};
use crate::namespace::directory::Ipc;
use crate::namespace::memory::PrefaultedChunks;
use crate::protocol::message::{PayloadBlock, RequestHeader, RequestKind, ResponseHeader, decode_reset, write_text};
use crate::protocol::ports::{self, BlockService, EngineServices, RequestSubscriber, ResponsePublisher};
use crate::protocol::wait::lock;

/// A request in shared memory.
pub(crate) type RequestSample = Sample<Ipc, [PayloadBlock], RequestHeader>;

/// A response that is being written.
pub(crate) type ResponseLoan = SampleMut<Ipc, [PayloadBlock], ResponseHeader>;

/// Why a request is rejected, and an explanation.
pub(crate) type Rejected = (Rejection, String);

/// What the response to a request holds.
pub(crate) enum Outcome {
    Batch { env_steps: usize, ended: Ended },
    Snapshot { bytes: usize },
}

/// Episodes that ended in a step: their number, the sums of their returns and lengths, and how many succeeded.
#[derive(Clone, Copy, Default)]
pub(crate) struct Ended {
    pub episodes: u64,
    pub returns: f64,
    pub lengths: u64,
    pub successes: u64,
}

impl Ended {
    /// `success` is the column of the infos that is 1 after a success.
    fn of(batch: &Batch<'_>, success: Option<usize>) -> Self {
        let mut ended = Ended::default();
        let width = batch.info().len() / batch.terminated().len().max(1);
        // Most steps end no episode, and all of them pass here: two slices, not two lookups for each environment.
        for (env, flags) in batch.terminated().iter().zip(batch.truncated()).enumerate() {
            if flags == (&0, &0) {
                continue;
            }
            ended.episodes += 1;
            ended.returns += batch.episode_return()[env];
            ended.lengths += u64::try_from(batch.episode_length()[env]).unwrap_or_default();
            let succeeded = success.and_then(|column| batch.info().get(env * width + column)) == Some(&1.0);
            ended.successes += u64::from(succeeded);
        }
        ended
    }
}

/// A batch that was sent and is still in memory.
#[derive(Clone, Copy)]
struct SentBatch {
    header: ResponseHeader,
    /// Exposed address of its first block.
    address: usize,
}

/// One group of an engine.
pub(crate) struct Group {
    pool: Pool,
    /// Also used by threads that do not use the group.
    requests: Arc<RequestSubscriber>,
    responses: ResponsePublisher,
    memory: PrefaultedChunks,
    response_service: BlockService<ResponseHeader>,
    /// The last batch sent, until the next chunk is written.
    last: Option<SentBatch>,
    /// The ports of resumed observers that the engine found when it was last idle.
    resumed: Vec<u128>,
    request: RequestData,
    /// The trainer that last reset all environments.
    trainer: Option<u64>,
    /// Whether a checkpoint is being saved for a request of this group, which takes no other meanwhile.
    is_saving: bool,
}

impl Group {
    pub(crate) fn new(services: &EngineServices<'_>, number: usize, pool: Pool) -> Result<Self, ServiceError> {
        let requests = services
            .requests(number)?
            .subscriber_builder()
            .create()
            .map_err(ServiceError::middleware("cannot create a subscriber"))?;
        let service = services.responses(number)?;
        // An observer reserves its chunks when it connects.
        let blocks = ports::chunk_blocks(pool.layout());
        let (responses, memory) =
            ports::publisher(&service, blocks, services.specification.trainer_chunks(), pool.threads())?;
        Ok(Group {
            pool,
            requests: Arc::new(requests),
            responses,
            memory,
            response_service: service,
            last: None,
            resumed: Vec::new(),
            request: RequestData::default(),
            trainer: None,
            is_saving: false,
        })
    }

    /// Steps with these threads from now on.
    pub(crate) fn set_threads(&mut self, threads: &Threads) {
        self.pool.set_threads(threads);
    }

    /// Takes no requests until this is called with `false`.
    pub(crate) fn set_saving(&mut self, is_saving: bool) {
        self.is_saving = is_saving;
    }

    /// A chunk for a response, with unspecified content.
    pub(crate) fn loan(&mut self) -> Result<ResponseLoan, ServiceError> {
        let mut chunk = self
            .responses
            .loan_slice_uninit(ports::chunk_blocks(self.pool.layout()))
            .map_err(ServiceError::middleware("cannot loan a chunk"))?;
        self.memory.prefault(chunk.payload_mut())?;
        self.last = None;
        // SAFETY: every byte pattern is a valid block, and the memory is initialised: the operating system zeroes new shared
        // memory, and a recycled chunk holds an earlier response.
        Ok(unsafe { chunk.assume_init() })
    }

    /// Sends a batch, and returns how many processes receive it.
    pub(crate) fn send_batch(&mut self, batch: ResponseLoan) -> Result<usize, SendError> {
        self.last =
            Some(SentBatch { header: *batch.user_header(), address: batch.payload().as_ptr().expose_provenance() });
        batch.send()
    }

    /// Sends the last batch again if an observer has resumed since: while the trainer pauses, it would get no other.
    /// Processes that have the batch recognise it by its numbers and ignore it. Returns whether it was sent.
    pub(crate) fn repeat_batch(&mut self) -> bool {
        let mut resumed = Vec::new();
        self.response_service.dynamic_config().list_subscribers(|subscriber| {
            if subscriber.subscriber_name.as_str() == ports::RESUMED {
                resumed.push(subscriber.subscriber_id.value());
            }
            CallbackProgression::Continue
        });
        let has_new = resumed.iter().any(|port| !self.resumed.contains(port));
        self.resumed = resumed;
        let Some(last) = self.last.filter(|_| has_new) else { return false };
        let mut batch = match self.loan() {
            Ok(batch) => batch,
            Err(error) => {
                tracing::warn!(%error, "cannot send a batch again");
                return false;
            }
        };
        *batch.user_header_mut() = last.header;
        let payload: &mut [Block] = bytemuck::cast_slice_mut(batch.payload_mut());
        // It is the same chunk unless some process still holds it.
        if payload.as_ptr().addr() != last.address {
            // SAFETY: the address is that of a chunk of the publisher's segment, which has this size and stays mapped.
            // Only `loan` gives write access; it returned another chunk now, and none since that one was sent. Every
            // byte pattern is a valid block.
            let written = unsafe {
                std::slice::from_raw_parts(std::ptr::with_exposed_provenance::<Block>(last.address), payload.len())
            };
            payload.copy_from_slice(written);
        }
        let sent = self.send_batch(batch).inspect_err(|e| tracing::warn!(error = %e, "cannot deliver a batch again"));
        sent.is_ok()
    }

    /// An environment's frame in the default format; `None` if there is none.
    pub(crate) fn frame(&self, env: usize) -> Option<Vec<u8>> {
        self.pool.frame(env).ok()
    }

    /// The next request, if there is one.
    fn poll(&self) -> Result<Option<RequestSample>, ServiceError> {
        if self.is_saving {
            return Ok(None);
        }
        match self.requests.receive() {
            // The trainer died while it connected.
            Err(ReceiveError::ConnectionFailure(e)) => {
                tracing::warn!(error = %e, "cannot receive from a trainer");
                Ok(None)
            }
            received => received.map_err(ServiceError::middleware("cannot receive a request")),
        }
    }

    /// Checks a request and copies its payload. `header` is a copy as well.
    pub(crate) fn read(
        &mut self,
        layout: &ActionLayout,
        header: &RequestHeader,
        payload: &[Block],
    ) -> Result<RequestKind, Rejected> {
        let kind = self.request.read(layout, header, payload)?;
        // A new trainer must not step another one's episodes by mistake, but may adopt them with a reset of no
        // environment.
        let is_allowed = match kind {
            RequestKind::Step | RequestKind::Snapshot | RequestKind::Restore | RequestKind::Episodes => false,
            RequestKind::ResetEach => {
                let count = self.request.resets.iter().filter(|reset| **reset != EnvReset::Keep).count();
                count == 0 || count == self.request.resets.len()
            }
            RequestKind::ResetAll | RequestKind::ResetSeed | RequestKind::Checkpoint | RequestKind::SetOptions => true,
        };
        if !is_allowed && self.trainer != Some(header.trainer) {
            let text = "this trainer must reset all environments of the group first, or none to adopt their episodes";
            return Err((Rejection::NotReset, text.to_owned()));
        }
        Ok(kind)
    }

    /// Executes the request that was read last and writes the response into `payload`.
    pub(crate) fn execute(
        &mut self,
        kind: RequestKind,
        header: &RequestHeader,
        payload: &mut [Block],
    ) -> Result<Outcome, Rejected> {
        let RequestData { action, resets, snapshot, options, next_options, .. } = &self.request;
        let (options, env) = (options.as_ref(), usize::try_from(header.env).unwrap_or(usize::MAX));
        let batch_blocks = self.pool.layout().blocks();
        let batch = &mut payload[..batch_blocks];
        let done = match kind {
            RequestKind::Step => self.pool.step(action, batch),
            RequestKind::Snapshot => return self.write_snapshot(env, payload),
            RequestKind::Restore => {
                let done = self.pool.restore(env, snapshot).map(|()| Outcome::Snapshot { bytes: 0 });
                return done.map_err(rejected_snapshot);
            }
            RequestKind::ResetAll => self.pool.reset_with(ResetRequest::All, options, batch),
            RequestKind::ResetSeed => self.pool.reset_with(ResetRequest::Seed(header.seed), options, batch),
            RequestKind::ResetEach => self.pool.reset_with(ResetRequest::Each(resets), options, batch),
            RequestKind::SetOptions => self.pool.set_options(next_options),
            RequestKind::Episodes => return self.write_episodes(payload),
            // Executed by the engine.
            RequestKind::Checkpoint => return Ok(Outcome::Snapshot { bytes: 0 }),
        };
        done.map_err(|e| match e {
            PoolError::NotReset => (Rejection::NotReset, e.to_string()),
            PoolError::Panic(e) => (Rejection::Panic, e.to_string()),
            e => (Rejection::Pool, e.to_string()),
        })?;
        if kind == RequestKind::SetOptions {
            return Ok(Outcome::Snapshot { bytes: 0 });
        }
        self.trainer = Some(header.trainer);
        let (env_steps, ended) = match kind {
            RequestKind::Step => {
                let batch = Batch::new(self.pool.layout(), batch);
                let success = self.pool.spec().info.iter().position(|column| column.name == InfoColumn::SUCCESS);
                (batch.terminated().len(), Ended::of(&batch, success))
            }
            _ => (0, Ended::default()),
        };
        Ok(Outcome::Batch { env_steps, ended })
    }

    /// The states of the environments; `None` before the first reset.
    pub(crate) fn save(&self) -> Result<Option<Vec<SavedEnv>>, SnapshotError> {
        self.pool.save()
    }

    /// Continues from these states.
    pub(crate) fn resume(&mut self, saved: &[SavedEnv]) -> Result<(), ResumeError> {
        self.pool.resume(saved)
    }

    /// Prepares `payload` for content other than a batch.
    pub(crate) fn forget_frames(&self, payload: &mut [Block]) {
        self.pool.layout().forget_frames(payload);
    }

    /// Overwrites the batch in `payload` with the explanation of a rejection, and returns its length in bytes.
    pub(crate) fn write_rejection(&self, payload: &mut [Block], text: &str) -> usize {
        self.forget_frames(payload);
        write_text(payload, text)
    }

    /// Overwrites the batch in `payload` with the seeds and reset parameters of the requested environments' running
    /// episodes, as JSON text: as many as fit, at least one.
    fn write_episodes(&self, payload: &mut [Block]) -> Result<Outcome, Rejected> {
        self.forget_frames(payload);
        let text: &mut [u8] = bytemuck::cast_slice_mut(payload);
        let mut end = 0;
        for env in (0..self.request.envs.len()).filter(|env| self.request.envs[*env] != 0) {
            let episode = self.pool.running_episode(env).map_err(|e| (Rejection::NotReset, e.to_string()))?;
            let item = serde_json::to_vec(&episode).map_err(|e| (Rejection::Pool, e.to_string()))?;
            // A separator before it, and a bracket after the last.
            if end + item.len() + 2 > text.len() {
                break;
            }
            text[end] = if end == 0 { b'[' } else { b',' };
            text[end + 1..][..item.len()].copy_from_slice(&item);
            end += 1 + item.len();
        }
        if end == 0 {
            text[0] = b'[';
            end = 1;
        }
        text[end] = b']';
        Ok(Outcome::Snapshot { bytes: end + 1 })
    }

    /// Overwrites the batch in `payload` with a snapshot of an environment.
    fn write_snapshot(&self, env: usize, payload: &mut [Block]) -> Result<Outcome, Rejected> {
        let snapshot = self.pool.snapshot(env).map_err(rejected_snapshot)?;
        if snapshot.len() > SNAPSHOT_BYTES {
            let text = format!(
                "snapshot must have at most {SNAPSHOT_BYTES} bytes, got {}; use reset parameters with shorter lists",
                snapshot.len()
            );
            return Err((Rejection::Snapshot, text));
        }
        self.pool.layout().forget_frames(payload);
        bytemuck::cast_slice_mut(payload)[..snapshot.len()].copy_from_slice(&snapshot);
        Ok(Outcome::Snapshot { bytes: snapshot.len() })
    }
}

/// The groups of an engine, each of which one thread at a time uses.
pub(crate) struct Groups {
    groups: Vec<(Arc<RequestSubscriber>, Mutex<Group>)>,
    /// Wakes the engine's threads; `None` if there is only one.
    waker: Option<Notifier<Ipc>>,
}

/// A group with the request that a thread has taken.
pub(crate) struct Taken<'a> {
    pub number: usize,
    pub group: MutexGuard<'a, Group>,
    pub request: RequestSample,
}

impl Groups {
    pub(crate) fn new(groups: Vec<Group>, waker: Option<Notifier<Ipc>>) -> Self {
        let groups = groups.into_iter().map(|group| (Arc::clone(&group.requests), Mutex::new(group)));
        Groups { groups: groups.collect(), waker }
    }

    pub(crate) fn len(&self) -> usize {
        self.groups.len()
    }

    pub(crate) fn lock(&self, number: usize) -> MutexGuard<'_, Group> {
        lock(&self.groups[number].1)
    }

    /// Uses a group between two requests.
    pub(crate) fn visit<T>(&self, number: usize, visit: impl FnOnce(&mut Group) -> T) -> T {
        let seen = visit(&mut self.lock(number));
        self.wake(number);
        seen
    }

    /// A thread that found the group locked does not come back by itself.
    pub(crate) fn wake(&self, number: usize) {
        if let Some(waker) = &self.waker {
            ports::notify(waker, number);
        }
    }

    /// Wakes any waiting thread.
    pub(crate) fn wake_any(&self) {
        self.wake(self.len());
    }

    /// Takes the first request to any of these groups that no thread uses.
    pub(crate) fn take(&self, numbers: impl Iterator<Item = usize>) -> Result<Option<Taken<'_>>, ServiceError> {
        for number in numbers.filter(|number| self.has_request(*number)) {
            let Some(group) = self.try_lock(number) else { continue };
            if let Some(request) = group.poll()? {
                return Ok(Some(Taken { number, group, request }));
            }
            let is_saving = group.is_saving;
            drop(group);
            // Who saves wakes them when it is done.
            if !is_saving && self.has_request(number) {
                self.wake(number);
            }
        }
        Ok(None)
    }

    /// Whether there is a request to a group.
    pub(crate) fn has_request(&self, number: usize) -> bool {
        // `take` reports the error of a trainer that died while it connected.
        self.groups[number].0.has_samples().unwrap_or(true)
    }

    /// The group, unless another thread uses it.
    pub(crate) fn try_lock(&self, number: usize) -> Option<MutexGuard<'_, Group>> {
        match self.groups[number].1.try_lock() {
            Ok(group) => Some(group),
            Err(TryLockError::Poisoned(group)) => Some(group.into_inner()),
            Err(TryLockError::WouldBlock) => None,
        }
    }
}

/// The payload of the current request, copied out of shared memory so that the trainer cannot change it after the
/// check. The buffers are reused, so that a step does not allocate.
#[derive(Debug, Default)]
struct RequestData {
    action: Vec<i32>,
    resets: Vec<EnvReset>,
    /// For each environment, whether its running episode was asked for.
    envs: Vec<u8>,
    snapshot: Vec<u8>,
    options_text: Vec<u8>,
    options: Option<Map<String, Json>>,
    next_options: Vec<NextOptions>,
}

impl RequestData {
    fn read(
        &mut self,
        layout: &ActionLayout,
        header: &RequestHeader,
        payload: &[Block],
    ) -> Result<RequestKind, Rejected> {
        if header.layout_version != LAYOUT_VERSION {
            let text = format!("layout version must be {LAYOUT_VERSION}, got {}", header.layout_version);
            return Err((Rejection::Version, text));
        }
        let Some(kind) = RequestKind::from_code(header.kind) else {
            let highest = (1..).map_while(RequestKind::from_code).count();
            let text = format!("request kind must be 1 to {highest}, got {}", header.kind);
            return Err((Rejection::Kind, text));
        };
        if payload.len() < layout.blocks() {
            let text = format!("payload must have {} blocks of 64 bytes, got {}", layout.blocks(), payload.len());
            return Err((Rejection::Payload, text));
        }
        match kind {
            RequestKind::Step => copy(&mut self.action, layout.read(payload, ActionSection::Action)),
            RequestKind::ResetEach => {
                let seeds = layout.read::<u64>(payload, ActionSection::Seed);
                self.resets.clear();
                let items = layout.read::<u8>(payload, ActionSection::Reset).iter().zip(seeds);
                self.resets.extend(items.map(|(reset, seed)| decode_reset(*reset, *seed)));
            }
            RequestKind::Episodes => copy(&mut self.envs, layout.read(payload, ActionSection::Reset)),
            RequestKind::Restore | RequestKind::SetOptions => {
                copy(&mut self.snapshot, prefix(layout.read(payload, ActionSection::Snapshot), header.bytes));
            }
            RequestKind::ResetAll | RequestKind::ResetSeed | RequestKind::Snapshot | RequestKind::Checkpoint => {}
        }
        if kind == RequestKind::SetOptions {
            let sets = serde_json::from_slice(&self.snapshot);
            let wrong = |e| (Rejection::Options, format!("options of next episodes must be a JSON list: {e}"));
            self.next_options = sets.map_err(wrong)?;
        }
        self.options = match kind {
            RequestKind::ResetAll | RequestKind::ResetSeed | RequestKind::ResetEach if header.bytes > 0 => {
                copy(&mut self.options_text, prefix(layout.read(payload, ActionSection::Options), header.bytes));
                let options = serde_json::from_slice(&self.options_text);
                Some(
                    options
                        .map_err(|e| (Rejection::Options, format!("reset parameters must be a JSON object: {e}")))?,
                )
            }
            _ => None,
        };
        Ok(kind)
    }
}

fn rejected_snapshot(error: SnapshotError) -> Rejected {
    let reason = if matches!(error, SnapshotError::Panic(_)) { Rejection::Panic } else { Rejection::Snapshot };
    (reason, error.to_string())
}

/// The first `length` elements, or an empty slice if there are fewer.
fn prefix<T>(elements: &[T], length: u64) -> &[T] {
    usize::try_from(length).ok().and_then(|length| elements.get(..length)).unwrap_or_default()
}

fn copy<T: Copy>(to: &mut Vec<T>, from: &[T]) {
    to.clear();
    to.extend_from_slice(from);
}

#[cfg(test)]
mod tests {
    use endless_gym_core::batch::{action_layout, zeroed};
    use endless_gym_core::envs::ActionSpace;

    use super::*;

    #[test]
    fn changing_a_request_after_it_was_read_has_no_effect() {
        let layout = action_layout(&ActionSpace::Discrete(4), 1).unwrap();
        let mut payload = zeroed(layout.blocks());
        let mut data = RequestData::default();
        let header = |kind: RequestKind, bytes| RequestHeader {
            layout_version: LAYOUT_VERSION,
            kind: kind.code(),
            bytes,
            ..RequestHeader::default()
        };

        let text = br#"{"arena_size": 3}"#;
        layout.write::<u8>(&mut payload, ActionSection::Options)[..text.len()].copy_from_slice(text);
        data.read(&layout, &header(RequestKind::ResetAll, text.len() as u64), &payload).unwrap();
        layout.write::<u8>(&mut payload, ActionSection::Options).fill(b'x');
        assert_eq!(data.options.as_ref().unwrap()["arena_size"], 3);
        assert_eq!(data.options_text, text);

        layout.write::<u8>(&mut payload, ActionSection::Snapshot).fill(1);
        data.read(&layout, &header(RequestKind::Restore, 9), &payload).unwrap();
        layout.write::<u8>(&mut payload, ActionSection::Snapshot).fill(2);
        assert_eq!((&data.snapshot[..], &data.options), (&[1; 9][..], &None));
    }

    #[test]
    fn a_length_beyond_the_payload_reads_nothing() {
        let layout = action_layout(&ActionSpace::Discrete(4), 1).unwrap();
        let payload = zeroed(layout.blocks());
        let header =
            RequestHeader { layout_version: LAYOUT_VERSION, kind: 2, bytes: u64::MAX, ..RequestHeader::default() };
        let (reason, _) = RequestData::default().read(&layout, &header, &payload).unwrap_err();
        assert_eq!(reason, Rejection::Options);
    }
}
