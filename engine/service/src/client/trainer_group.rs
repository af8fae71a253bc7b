//! One group of a trainer: sends its actions and receives its batches.

use std::borrow::{Borrow, BorrowMut};
use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use endless_gym_core::batch::{ActionSection, Block, LAYOUT_VERSION, OPTIONS_BYTES, SNAPSHOT_BYTES};
use endless_gym_core::envs::ActionError;
use endless_gym_core::pool::{NextOptions, PoolError, ResetRequest, RunningEpisode};
use serde_json::{Map, Value as Json};

use crate::client::connect::ConnectConfig;
use crate::client::connection::EngineConnection;
use crate::client::lease::{BatchLease, Response};
use crate::client::requests::{PendingRequest, Request};
use crate::client::status;
use crate::error::{EngineActivity, ServiceError};
use crate::namespace::fork_guard::ForkGuard;
use crate::protocol::message::{RequestHeader, RequestKind, encode_reset};
use crate::protocol::specification::ServiceSpecification;
use crate::protocol::wait::LIVENESS_INTERVAL;
use crate::protocol::{discovery, ports};

/// What the groups of a trainer share.
pub(crate) struct Shared {
    pub config: ConnectConfig,
    pub specification: Arc<ServiceSpecification>,
    pub connection: ForkGuard<EngineConnection>,
    /// Random number that identifies the trainer.
    pub id: u64,
}

impl Shared {
    /// The error for an engine that has ended, which depends on whether another one has replaced it.
    fn lost(&self) -> ServiceError {
        let (service, node) = (self.config.service.clone(), &*self.connection.node);
        if let Err(removed) = node.check_root() {
            return removed;
        }
        match discovery::read(node, &service) {
            Ok(Some(other)) if other.incarnation != self.specification.incarnation => {
                ServiceError::EngineRestarted { service }
            }
            _ => ServiceError::EngineLost { service, pid: self.specification.engine_pid },
        }
    }

    fn incompatible(&self) -> ServiceError {
        ServiceError::IncompatibleTypes { service: self.config.service.clone() }
    }
}

/// One group of a [`Trainer`](crate::Trainer), which another thread can step at the same time as the others.
///
/// [`Trainer::groups`](crate::Trainer::groups) lends the groups, and [`Trainer::into_groups`](crate::Trainer::into_groups)
/// returns them. The methods and their errors are those of the trainer, without a group's number.
///
/// ```no_run
/// use std::time::Duration;
///
/// use endless_gym_core::pool::ResetRequest;
/// use endless_gym_service::{ConnectConfig, ServiceError, Trainer, TrainerGroup};
///
/// let timeout = Duration::from_secs(10);
/// let mut trainer = Trainer::connect(&ConnectConfig::new("endless").timeout(timeout))?;
/// let play = |group: &mut TrainerGroup| {
///     group.reset(ResetRequest::All)?;
///     for _ in 0..1000 {
///         let lease = group.receive(timeout)?;
///         println!("group {} step {}", lease.group(), lease.step());
///         group.send_with(|actions| actions.fill(0))?;
///     }
///     Ok::<(), ServiceError>(())
/// };
/// std::thread::scope(|scope| {
///     let threads: Vec<_> = trainer.groups().iter_mut().map(|group| scope.spawn(move || play(group))).collect();
///     threads.into_iter().try_for_each(|thread| thread.join().expect("no panic"))
/// })
/// # ?; Ok::<(), ServiceError>(())
/// ```
pub struct TrainerGroup {
    pub(super) number: usize,
    /// Number of the last request.
    pub(super) last_request: u64,
    pub(super) pending: PendingRequest,
    /// When the last request was sent.
    sent: Instant,
    pub(super) shared: Arc<Shared>,
}

impl fmt::Debug for TrainerGroup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let service = &self.shared.config.service;
        f.debug_struct("TrainerGroup").field("service", service).field("number", &self.number).finish_non_exhaustive()
    }
}

/// Sorts groups by their numbers, and returns whether they are all groups of one trainer.
pub(super) fn sort(groups: &mut [TrainerGroup]) -> bool {
    groups.sort_by_key(TrainerGroup::number);
    groups.first().is_some_and(|first| first.specification().groups == groups.len()) && are_of_one_trainer(groups)
}

fn are_of_one_trainer(groups: &[impl Borrow<TrainerGroup>]) -> bool {
    groups.iter().all(|group| Arc::ptr_eq(&group.borrow().shared, &groups[0].borrow().shared))
}

#[expect(clippy::missing_errors_doc, reason = "those of the trainer's methods of the same name")]
impl TrainerGroup {
    pub(super) fn new(number: usize, last_request: u64, shared: &Arc<Shared>) -> Self {
        let (pending, shared) = (PendingRequest::NONE, Arc::clone(shared));
        TrainerGroup { number, last_request, pending, sent: Instant::now(), shared }
    }

    /// The group's number.
    pub fn number(&self) -> usize {
        self.number
    }

    /// The engine's specification.
    pub fn specification(&self) -> &ServiceSpecification {
        &self.shared.specification
    }

    /// See [`Trainer::reset`](crate::Trainer::reset).
    pub fn reset(&mut self, request: ResetRequest<'_>) -> Result<(), ServiceError> {
        self.reset_with(request, None)
    }

    /// See [`Trainer::reset_with`](crate::Trainer::reset_with).
    pub fn reset_with(
        &mut self,
        request: ResetRequest<'_>,
        options: Option<&Map<String, Json>>,
    ) -> Result<(), ServiceError> {
        let (specification, num_envs) = (Arc::clone(&self.shared.specification), self.shared.specification.num_envs);
        let options = options.map(|options| Json::from(options.clone()).to_string()).unwrap_or_default();
        if options.len() > OPTIONS_BYTES {
            return Err(ServiceError::OptionsTooLong { given: options.len() });
        }
        let write_options = |message: &mut [Block]| {
            let text = specification.action.write::<u8>(message, ActionSection::Options);
            text[..options.len()].copy_from_slice(options.as_bytes());
            Ok(options.len())
        };
        match request {
            ResetRequest::All => self.post(Request::new(RequestKind::ResetAll), write_options),
            ResetRequest::Seed(seed) => {
                self.post(Request { seed, ..Request::new(RequestKind::ResetSeed) }, write_options)
            }
            ResetRequest::Each(each) if each.len() != num_envs => {
                Err(ServiceError::ResetCount { given: each.len(), num_envs })
            }
            ResetRequest::Each(each) => self.post(Request::new(RequestKind::ResetEach), |message| {
                for (env, reset) in each.iter().enumerate() {
                    let (reset, seed) = encode_reset(*reset);
                    specification.action.write::<u8>(message, ActionSection::Reset)[env] = reset;
                    specification.action.write::<u64>(message, ActionSection::Seed)[env] = seed;
                }
                write_options(message)
            }),
        }
    }

    /// See [`Trainer::send`](crate::Trainer::send).
    pub fn send(&mut self, actions: &[i32]) -> Result<(), ServiceError> {
        let specification = Arc::clone(&self.shared.specification);
        // Order of the checks: number of actions, pending answer, range.
        let checked = specification.action_space.check(specification.num_envs, actions);
        if let Err(error @ ActionError::Count { .. }) = checked {
            return Err(error.into());
        }
        self.post(Request::new(RequestKind::Step), |message| {
            checked?;
            specification.action.write::<i32>(message, ActionSection::Action).copy_from_slice(actions);
            Ok(0)
        })
    }

    /// See [`Trainer::send_with`](crate::Trainer::send_with).
    pub fn send_with(&mut self, fill: impl FnOnce(&mut [i32])) -> Result<(), ServiceError> {
        let specification = Arc::clone(&self.shared.specification);
        self.post(Request::new(RequestKind::Step), |message| {
            let actions = specification.action.write::<i32>(message, ActionSection::Action);
            fill(actions);
            specification.action_space.check(specification.num_envs, actions)?;
            Ok(0)
        })
    }

    /// See [`Trainer::receive`](crate::Trainer::receive).
    pub fn receive(&mut self, timeout: Duration) -> Result<BatchLease, ServiceError> {
        if !self.pending.has_batch() {
            return Err(ServiceError::NothingSent { group: self.number });
        }
        Self::receive_any(std::slice::from_mut(self), timeout)
    }

    /// Receives the first batch that arrives from any of these groups of one trainer; see
    /// [`Trainer::receive_any`](crate::Trainer::receive_any).
    ///
    /// # Errors
    ///
    /// [`ServiceError::MixedGroups`], and those of [`Trainer::receive_any`](crate::Trainer::receive_any).
    pub fn receive_any(groups: &mut [impl BorrowMut<Self>], timeout: Duration) -> Result<BatchLease, ServiceError> {
        let response = receive_response(groups, true, timeout)?;
        let service = response.service().to_owned();
        response.into_batch().ok_or(ServiceError::IncompatibleTypes { service })
    }

    /// See [`Trainer::set_options`](crate::Trainer::set_options).
    pub fn set_options(&mut self, sets: &[NextOptions], timeout: Duration) -> Result<(), ServiceError> {
        for text in messages(sets)? {
            self.transfer_bytes(Request::new(RequestKind::SetOptions), &text, timeout)?;
        }
        Ok(())
    }

    /// See [`Trainer::running_episodes`](crate::Trainer::running_episodes).
    pub fn running_episodes(&mut self, envs: &[usize], timeout: Duration) -> Result<Vec<RunningEpisode>, ServiceError> {
        let num_envs = self.shared.specification.num_envs;
        let mut missing: BTreeSet<usize> = envs.iter().copied().collect();
        if let Some(given) = missing.last().copied().filter(|env| *env >= num_envs) {
            return Err(PoolError::NoSuchEnv { given, num_envs }.into());
        }
        let mut episodes = Vec::new();
        while !missing.is_empty() {
            let mask: Vec<u8> = (0..num_envs).map(|env| u8::from(missing.contains(&env))).collect();
            let specification = Arc::clone(&self.shared.specification);
            let write = |message: &mut [Block]| {
                specification.action.write::<u8>(message, ActionSection::Reset).copy_from_slice(&mask);
                Ok(0)
            };
            let request = Request { checksum: crc32fast::hash(&mask), ..Request::new(RequestKind::Episodes) };
            let text = self.transfer(request, timeout, write)?;
            // As many as fit in a response, at least one.
            let received: Vec<RunningEpisode> =
                serde_json::from_slice(&text).map_err(|_| self.shared.incompatible())?;
            let before = missing.len();
            for episode in &received {
                missing.remove(&episode.env);
            }
            if missing.len() == before {
                return Err(self.shared.incompatible());
            }
            episodes.extend(received);
        }
        Ok(episodes)
    }

    /// See [`Trainer::snapshot`](crate::Trainer::snapshot).
    pub fn snapshot(&mut self, env: usize, timeout: Duration) -> Result<Vec<u8>, ServiceError> {
        self.transfer(Request { env, ..Request::new(RequestKind::Snapshot) }, timeout, |_| Ok(0))
    }

    /// See [`Trainer::restore`](crate::Trainer::restore).
    pub fn restore(&mut self, env: usize, snapshot: &[u8], timeout: Duration) -> Result<(), ServiceError> {
        let given = snapshot.len();
        if given > SNAPSHOT_BYTES {
            return Err(ServiceError::SnapshotTooLong { given });
        }
        self.transfer_bytes(Request { env, ..Request::new(RequestKind::Restore) }, snapshot, timeout)
    }

    /// See [`Trainer::checkpoint`](crate::Trainer::checkpoint).
    pub fn checkpoint(&mut self, timeout: Duration) -> Result<Vec<u64>, ServiceError> {
        let steps = self.transfer(Request::new(RequestKind::Checkpoint), timeout, |_| Ok(0))?;
        Ok(steps.chunks_exact(size_of::<u64>()).map(bytemuck::pod_read_unaligned).collect())
    }

    /// Like [`transfer`](Self::transfer), with these bytes in the payload's `snapshot`, for an answer without content.
    fn transfer_bytes(&mut self, request: Request, bytes: &[u8], timeout: Duration) -> Result<(), ServiceError> {
        let specification = Arc::clone(&self.shared.specification);
        let write = |message: &mut [Block]| {
            let section = specification.action.write::<u8>(message, ActionSection::Snapshot);
            section[..bytes.len()].copy_from_slice(bytes);
            Ok(bytes.len())
        };
        self.transfer(Request { checksum: crc32fast::hash(bytes), ..request }, timeout, write).map(drop)
    }

    /// Sends a request whose answer is not a batch, unless the same request is pending, and waits for the answer.
    fn transfer(
        &mut self,
        request: Request,
        timeout: Duration,
        write: impl FnOnce(&mut [Block]) -> Result<usize, ServiceError>,
    ) -> Result<Vec<u8>, ServiceError> {
        if !self.pending.has(request) {
            self.post(request, write)?;
        }
        let response = receive_response(std::slice::from_mut(self), false, timeout)?;
        response.to_snapshot().ok_or_else(|| self.shared.incompatible())
    }

    /// Writes a request to shared memory and sends it. `write` fills the payload and returns the length of its options
    /// or snapshot in bytes.
    fn post(
        &mut self,
        request: Request,
        write: impl FnOnce(&mut [Block]) -> Result<usize, ServiceError>,
    ) -> Result<(), ServiceError> {
        if self.pending.has_batch() {
            return Err(ServiceError::AnswerPending { group: self.number });
        }
        let failed = ServiceError::middleware("cannot send a request");
        let message = self.shared.connection.requests[self.number]
            .loan_slice_uninit(self.shared.specification.action.blocks())
            .map_err(|e| failed(e.to_string()))?;
        // SAFETY: every byte pattern is a valid block, and the memory is initialised: the operating system zeroes new shared
        // memory, and a recycled chunk holds a request.
        let mut message = unsafe { message.assume_init() };
        let bytes = write(bytemuck::cast_slice_mut(message.payload_mut()))? as u64;
        self.last_request += 1;
        *message.user_header_mut() = RequestHeader {
            layout_version: LAYOUT_VERSION,
            kind: request.kind.code(),
            incarnation: self.shared.specification.incarnation,
            trainer: self.shared.id,
            request: self.last_request,
            seed: request.seed,
            env: request.env as u64,
            bytes,
            process: std::process::id(),
            held: (Arc::strong_count(&self.shared.connection.responses[self.number]) - 1) as u32,
        };
        let receivers = message.send().map_err(|e| failed(e.to_string()))?;
        if receivers == 0 && !self.shared.connection.is_engine_alive() {
            return Err(self.shared.lost());
        }
        ports::notify(&self.shared.connection.to_engine, self.number);
        self.pending.insert(self.last_request, request);
        self.sent = Instant::now();
        Ok(())
    }
}

/// The first response to a pending request of `groups`: of requests that return batches, or (`!batches`) of the
/// others.
fn receive_response<G: BorrowMut<TrainerGroup>>(
    groups: &mut [G],
    batches: bool,
    timeout: Duration,
) -> Result<Response, ServiceError> {
    if !are_of_one_trainer(groups) {
        return Err(ServiceError::MixedGroups);
    }
    let is_pending = |group: &&TrainerGroup| group.pending.number(batches).is_some();
    let waiting = || groups.iter().map(Borrow::borrow).filter(is_pending);
    let Some(shared) = waiting().next().map(|group| Arc::clone(&group.shared)) else {
        return Err(ServiceError::NothingPending);
    };
    let numbers = waiting().map(|group| group.number);
    let numbers = numbers.clone().min().unwrap_or(0)..numbers.max().unwrap_or(0) + 1;
    let (start, sent) = (Instant::now(), waiting().map(|group| group.sent).max());
    loop {
        let left = timeout.saturating_sub(start.elapsed());
        let (connection, limit) = (&*shared.connection, left.min(LIVENESS_INTERVAL));
        let received = connection.to_trainer.wait(&numbers, limit, sent.unwrap_or(start), || {
            for (place, TrainerGroup { number, pending, shared, .. }) in groups.iter().map(Borrow::borrow).enumerate() {
                let Some(request) = pending.number(batches) else { continue };
                // The queue may hold the response to an earlier trainer.
                while let Some(response) = shared.connection.responses[*number].receive(&shared.specification)? {
                    if response.answers(shared.id, request) {
                        return Ok(Some((place, response)));
                    }
                }
            }
            Ok(None)
        })?;
        if let Some((place, response)) = received {
            let response = response.check_accepted();
            groups[place].borrow_mut().pending.answered(response.is_ok());
            return response;
        }
        if !connection.is_engine_alive() {
            return Err(shared.lost());
        }
        if start.elapsed() >= timeout {
            let group = groups.iter().map(Borrow::borrow).find(is_pending);
            let activity = group.and_then(|group| Some((group, group.pending.number(batches)?)));
            let activity = activity.map_or(EngineActivity::Unknown, |(group, request)| {
                status::activity(connection.status.as_ref(), shared.id, group.number, request)
            });
            return Err(ServiceError::TimedOut { service: shared.config.service.clone(), waited: timeout, activity });
        }
    }
}

/// Maximum number of environments in one item of a message: their numbers and options of [`OPTIONS_BYTES`] fit in a
/// message.
const ENVS_PER_ITEM: usize = 16_384;

/// The items as JSON lists, each of which fits in a message.
fn messages(sets: &[NextOptions]) -> Result<Vec<Vec<u8>>, ServiceError> {
    let mut messages: Vec<Vec<u8>> = Vec::new();
    for set in sets {
        let options = Json::from(set.options.clone()).to_string();
        if options.len() > OPTIONS_BYTES {
            return Err(ServiceError::OptionsTooLong { given: options.len() });
        }
        for envs in set.envs.chunks(ENVS_PER_ITEM) {
            let item = format!(r#"{{"options":{options},"envs":{}}}"#, Json::from(envs)).into_bytes();
            match messages.last_mut() {
                Some(message) if message.len() + item.len() + 2 <= SNAPSHOT_BYTES => message.push(b','),
                _ => messages.push(vec![b'[']),
            }
            messages.iter_mut().last().into_iter().for_each(|message| message.extend_from_slice(&item));
        }
    }
    messages.iter_mut().for_each(|message| message.push(b']'));
    Ok(messages)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lists_are_divided_among_messages() {
        let options =
            |count: usize| [("command_show_delay".to_owned(), Json::from(vec![1; count]))].into_iter().collect();
        let sets = [
            NextOptions { options: options(8_000), envs: (1_000_000..1_040_000).collect() },
            NextOptions { options: options(2), envs: vec![7] },
            NextOptions { options: options(3), envs: Vec::new() },
        ];
        let messages = messages(&sets).unwrap();
        assert_eq!(messages.len(), 2);
        assert!(messages.iter().all(|message| message.len() <= SNAPSHOT_BYTES));
        let items: Vec<NextOptions> =
            messages.iter().flat_map(|text| serde_json::from_slice::<Vec<NextOptions>>(text).unwrap()).collect();
        let envs: Vec<usize> = items.iter().flat_map(|item| item.envs.clone()).collect();
        assert!(envs == (1_000_000..1_040_000).chain([7]).collect::<Vec<_>>());
        assert!(items[..items.len() - 1].iter().all(|item| item.options == sets[0].options));
        assert_eq!(items.last(), Some(&sets[1]));
        let long = [NextOptions { options: options(9_000), envs: vec![0] }];
        assert!(matches!(super::messages(&long), Err(ServiceError::OptionsTooLong { .. })));
    }
}
