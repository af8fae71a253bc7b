//! The trainer: sends actions to an engine and receives batches, which it reads in place.

use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use endless_gym_core::batch::{ActionSection, Block, LAYOUT_VERSION, OPTIONS_BYTES, SNAPSHOT_BYTES};
use endless_gym_core::envs::ActionError;
use endless_gym_core::pool::{NextOptions, PoolError, ResetRequest, RunningEpisode};
use serde_json::{Map, Value as Json};

use crate::client::connect::ConnectConfig;
use crate::client::connection::EngineConnection;
use crate::client::lease::{BatchLease, Response};
use crate::client::requests::{GroupReconnection, LastRequest, PendingRequests, Reconnection, Request};
use crate::client::status;
use crate::error::{EngineActivity, ServiceError};
use crate::namespace::fork_guard::ForkGuard;
use crate::protocol::message::{RequestHeader, RequestKind};
use crate::protocol::specification::ServiceSpecification;
use crate::protocol::wait::{LIVENESS_INTERVAL, wait};
use crate::protocol::{discovery, ports};

/// Steps the environments of an engine. An engine has one trainer at a time.
///
/// Every [`reset`](Trainer::reset) or [`send`](Trainer::send) to a group is answered by one batch, which
/// [`receive`](Trainer::receive) returns. A group has at most one pending answer; several groups may have one each.
///
/// A trainer can outlive its engine: after [`ServiceError::EngineLost`] or [`ServiceError::EngineRestarted`],
/// [`reconnect`](Trainer::reconnect) connects to a new engine of the same name. Batches that are still held remain readable.
///
/// ```no_run
/// use std::time::Duration;
///
/// use endless_gym_core::pool::ResetRequest;
/// use endless_gym_service::{ConnectConfig, Trainer};
///
/// let timeout = Duration::from_secs(10);
/// let mut trainer = Trainer::connect(&ConnectConfig { timeout, ..ConnectConfig::new("endless") })?;
/// trainer.reset(0, ResetRequest::All)?;
/// for _ in 0..1000 {
///     let lease = trainer.receive(0, timeout)?;
///     let rewards = lease.batch().reward();
///     println!("step {}: mean reward {}", lease.step(), rewards.iter().sum::<f64>() / rewards.len() as f64);
///     trainer.send_with(0, |actions| actions.fill(0))?;
/// }
/// # Ok::<(), endless_gym_service::ServiceError>(())
/// ```
pub struct Trainer {
    config: ConnectConfig,
    specification: Arc<ServiceSpecification>,
    connection: ForkGuard<EngineConnection>,
    /// Random number that identifies this trainer.
    id: u64,
    /// Number of the last request.
    last_request: u64,
    pending: PendingRequests,
    /// When the last request was sent.
    sent: Instant,
}

impl Trainer {
    /// Connects to an engine as its trainer.
    ///
    /// # Errors
    ///
    /// [`ServiceError::UnknownEngine`] if no engine of that name appears within the timeout, [`ServiceError::TrainerExists`] if
    /// it has a trainer, [`ServiceError::Version`] or [`ServiceError::IncompatibleTypes`] for an engine of another version,
    /// [`ServiceError::InvalidName`] or [`ServiceError::Root`] for an invalid configuration.
    pub fn connect(config: &ConnectConfig) -> Result<Self, ServiceError> {
        let (connection, specification) = EngineConnection::open(config)?;
        let (service, process) = (&*specification.service, specification.engine_pid);
        tracing::info!(service, process, "connected to an engine");
        Ok(Trainer {
            config: config.clone(),
            pending: PendingRequests::new(specification.groups),
            specification: Arc::new(specification),
            connection: ForkGuard::new(connection),
            id: rand::random(),
            last_request: 0,
            sent: Instant::now(),
        })
    }

    /// Connects to an engine of the same name that replaces a lost one. Waits for it up to `timeout`. It must serve the same
    /// environments in the same layout, and each group must be reset before it is stepped.
    ///
    /// If the current engine is still running, the connection and the pending answers are kept: nothing is executed
    /// twice, and pending answers can be received. The result says which of the two happened, and what became of the
    /// last request to each group; see the table in the crate's documentation.
    ///
    /// # Errors
    ///
    /// [`ServiceError::SpecificationChanged`] if the new engine serves different environments, and the errors of
    /// [`connect`](Trainer::connect).
    pub fn reconnect(&mut self, timeout: Duration) -> Result<Reconnection, ServiceError> {
        let restarted = !self.connection.is_engine_alive();
        let mut last: Vec<_> = (0..self.pending.groups()).map(|group| (None, self.pending.last(group))).collect();
        if restarted {
            let config = ConnectConfig { timeout, ..self.config.clone() };
            let (connection, specification) = EngineConnection::open(&config)?;
            if let Some(what) = self.specification.difference(&specification) {
                return Err(ServiceError::SpecificationChanged { service: self.config.service.clone(), what });
            }
            for (group, (lost_step, last)) in last.iter_mut().enumerate() {
                let status = self.connection.status.as_ref().and_then(|status| status.group(group));
                *lost_step = status.map(|status| status.step);
                if let Some(number) = self.pending.any_number(group) {
                    *last = LastRequest::of_dead_engine(status, self.id, number);
                }
            }
            self.pending = PendingRequests::new(specification.groups);
            self.specification = Arc::new(specification);
            self.connection = ForkGuard::new(connection);
            let (service, process) = (&*self.specification.service, self.specification.engine_pid);
            tracing::info!(service, process, "reconnected to another engine");
        }
        let step = |group| self.connection.status.as_ref().and_then(|status| status.group(group)).map(|now| now.step);
        let groups = last.into_iter().enumerate();
        let groups = groups.map(|(group, (lost_step, last_request))| GroupReconnection {
            step: step(group),
            lost_step,
            last_request,
        });
        Ok(Reconnection { restarted, incarnation: self.specification.incarnation, groups: groups.collect() })
    }

    /// The engine's specification.
    pub fn specification(&self) -> &ServiceSpecification {
        &self.specification
    }

    /// Requests new episodes in a group; [`receive`](Trainer::receive) returns their first observations.
    ///
    /// [`ResetRequest::Seed`] seeds environment `i` of the group with `seed + group * num_envs + i`: the environments of all
    /// groups are numbered consecutively, as in one pool.
    ///
    /// # Errors
    ///
    /// [`ServiceError::ResetCount`] if the reset mask or the seeds have a wrong length, [`ServiceError::NoSuchGroup`],
    /// [`ServiceError::AnswerPending`], [`ServiceError::EngineLost`] or [`ServiceError::EngineRestarted`] if the engine has ended,
    /// and [`ServiceError::Middleware`] if iceoryx2 cannot send the request.
    pub fn reset(&mut self, group: usize, request: ResetRequest<'_>) -> Result<(), ServiceError> {
        self.reset_with(group, request, None)
    }

    /// Like [`reset`](Trainer::reset), with new reset parameters for the environments that start an episode. They apply
    /// to all later episodes as well; see [`Pool::reset_with`](endless_gym_core::pool::Pool::reset_with).
    ///
    /// # Errors
    ///
    /// Those of [`reset`](Trainer::reset), and [`ServiceError::OptionsTooLong`]. [`receive`](Trainer::receive) returns
    /// [`ServiceError::Rejected`] for reset parameters that the environments do not accept.
    pub fn reset_with(
        &mut self,
        group: usize,
        request: ResetRequest<'_>,
        options: Option<&Map<String, Json>>,
    ) -> Result<(), ServiceError> {
        let (specification, num_envs) = (Arc::clone(&self.specification), self.specification.num_envs);
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
            ResetRequest::All => self.post(group, Request::new(RequestKind::ResetAll), write_options),
            ResetRequest::Seed(seed) => {
                self.post(group, Request { seed, ..Request::new(RequestKind::ResetSeed) }, write_options)
            }
            ResetRequest::Each { reset, seed } if reset.len() != num_envs || seed.len() != num_envs => {
                let given = if reset.len() == num_envs { seed.len() } else { reset.len() };
                Err(ServiceError::ResetCount { given, num_envs })
            }
            ResetRequest::Each { reset, seed } => self.post(group, Request::new(RequestKind::ResetEach), |message| {
                specification.action.write::<u8>(message, ActionSection::Reset).copy_from_slice(reset);
                specification.action.write::<u64>(message, ActionSection::Seed).copy_from_slice(seed);
                write_options(message)
            }),
        }
    }

    /// Requests a step of a group; [`receive`](Trainer::receive) returns its batch. `actions` has shape `(num_envs, branches)`.
    ///
    /// # Errors
    ///
    /// Checked in this order: [`ServiceError::Action`] for a wrong number of actions, [`ServiceError::NoSuchGroup`],
    /// [`ServiceError::AnswerPending`], [`ServiceError::Action`] for an action out of range. [`ServiceError::EngineLost`] or
    /// [`ServiceError::EngineRestarted`] if the engine has ended, and [`ServiceError::Middleware`] if iceoryx2 cannot send the
    /// request. No error steps an environment.
    pub fn send(&mut self, group: usize, actions: &[i32]) -> Result<(), ServiceError> {
        let specification = Arc::clone(&self.specification);
        // Order of the checks: number of actions, pending answer, range.
        let checked = specification.action_space.check(specification.num_envs, actions);
        if let Err(error @ ActionError::Count { .. }) = checked {
            return Err(error.into());
        }
        self.post(group, Request::new(RequestKind::Step), |message| {
            checked?;
            specification.action.write::<i32>(message, ActionSection::Action).copy_from_slice(actions);
            Ok(0)
        })
    }

    /// Like [`send`](Trainer::send), but `fill` writes the actions directly into shared memory. The slice has shape
    /// `(num_envs, branches)` and holds zeros or the actions of an earlier step.
    ///
    /// # Errors
    ///
    /// Those of [`send`](Trainer::send).
    pub fn send_with(&mut self, group: usize, fill: impl FnOnce(&mut [i32])) -> Result<(), ServiceError> {
        let specification = Arc::clone(&self.specification);
        self.post(group, Request::new(RequestKind::Step), |message| {
            let actions = specification.action.write::<i32>(message, ActionSection::Action);
            fill(actions);
            specification.action_space.check(specification.num_envs, actions)?;
            Ok(0)
        })
    }

    /// Receives the batch that answers the last request to `group`.
    ///
    /// # Errors
    ///
    /// [`ServiceError::TimedOut`] if there is no answer in time; it stays pending and can be received later.
    /// [`ServiceError::EngineLost`] or [`ServiceError::EngineRestarted`] within half a second after the engine's process has
    /// ended. [`ServiceError::Rejected`] if the engine rejected the request. [`ServiceError::NothingSent`] if the group has no
    /// pending answer, [`ServiceError::NoSuchGroup`], [`ServiceError::TooManyBatchesHeld`] if
    /// [`batches_held`](ServiceSpecification::batches_held) leases are held, [`ServiceError::IncompatibleTypes`] for a malformed
    /// response, and [`ServiceError::Middleware`] if iceoryx2 cannot wait for a message.
    pub fn receive(&mut self, group: usize, timeout: Duration) -> Result<BatchLease, ServiceError> {
        self.check_group(group)?;
        if !self.pending.has_batch(group) {
            return Err(ServiceError::NothingSent { group });
        }
        self.receive_batch(group..group + 1, timeout)
    }

    /// Receives the first batch that arrives from any group with a pending answer; see [`BatchLease::group`].
    ///
    /// # Errors
    ///
    /// [`ServiceError::NothingPending`] if no group has a pending answer, and otherwise those of [`receive`](Trainer::receive).
    pub fn receive_any(&mut self, timeout: Duration) -> Result<BatchLease, ServiceError> {
        if !self.pending.has_any_batch() {
            return Err(ServiceError::NothingPending);
        }
        self.receive_batch(0..self.pending.groups(), timeout)
    }

    fn receive_batch(&mut self, groups: Range<usize>, timeout: Duration) -> Result<BatchLease, ServiceError> {
        let response = self.receive_response(groups, true, timeout)?;
        response.into_batch().ok_or_else(|| self.incompatible())
    }

    /// The first response to a pending request of `groups`: of requests that return batches, or (`!batches`) of the
    /// others.
    fn receive_response(
        &mut self,
        groups: Range<usize>,
        batches: bool,
        timeout: Duration,
    ) -> Result<Response, ServiceError> {
        let start = Instant::now();
        loop {
            let left = timeout.saturating_sub(start.elapsed());
            let (connection, pending) = (&*self.connection, &self.pending);
            let received = wait(&connection.to_trainer, left.min(LIVENESS_INTERVAL), self.sent, || {
                for group in groups.clone() {
                    let Some(number) = pending.number(group, batches) else { continue };
                    // The queue may hold the response to an earlier trainer.
                    while let Some(response) = connection.responses[group].receive(&self.specification)? {
                        if response.answers(self.id, number) {
                            return Ok(Some((group, response)));
                        }
                    }
                }
                Ok(None)
            })?;
            if let Some((group, response)) = received {
                let response = response.check_accepted();
                self.pending.answered(group, response.is_ok());
                return response;
            }
            if !connection.is_engine_alive() {
                return Err(self.lost());
            }
            if start.elapsed() >= timeout {
                let activity = self.activity(groups, batches);
                let service = self.config.service.clone();
                return Err(ServiceError::TimedOut { service, waited: timeout, activity });
            }
        }
    }

    /// What the engine is doing while this trainer waits for an answer from one of `groups`.
    fn activity(&self, mut groups: Range<usize>, batches: bool) -> EngineActivity {
        let waiting = groups.find_map(|group| self.pending.number(group, batches).map(|number| (group, number)));
        waiting.map_or(EngineActivity::Unknown, |(group, number)| {
            status::activity(self.connection.status.as_ref(), self.id, group, number)
        })
    }

    fn check_group(&self, group: usize) -> Result<(), ServiceError> {
        let groups = self.pending.groups();
        if group < groups {
            return Ok(());
        }
        let service = self.config.service.clone();
        Err(ServiceError::NoSuchGroup { service, given: group, groups })
    }

    /// Writes a request to shared memory and sends it. `write` fills the payload and returns the length of its options
    /// or snapshot in bytes.
    fn post(
        &mut self,
        group: usize,
        request: Request,
        write: impl FnOnce(&mut [Block]) -> Result<usize, ServiceError>,
    ) -> Result<(), ServiceError> {
        self.check_group(group)?;
        if self.pending.has_batch(group) {
            return Err(ServiceError::AnswerPending { group });
        }
        let failed = ServiceError::middleware("cannot send a request");
        let message = self.connection.requests[group]
            .loan_slice_uninit(self.specification.action.blocks())
            .map_err(|e| failed(e.to_string()))?;
        // SAFETY: every byte pattern is a valid block, and the memory is initialised: the operating system zeroes new shared
        // memory, and a recycled chunk holds a request.
        let mut message = unsafe { message.assume_init() };
        let bytes = write(bytemuck::cast_slice_mut(message.payload_mut()))? as u64;
        self.last_request += 1;
        *message.user_header_mut() = RequestHeader {
            layout_version: LAYOUT_VERSION,
            kind: request.kind.code(),
            incarnation: self.specification.incarnation,
            trainer: self.id,
            request: self.last_request,
            seed: request.seed,
            env: request.env as u64,
            bytes,
            process: std::process::id(),
            held: (Arc::strong_count(&self.connection.responses[group]) - 1) as u32,
        };
        let receivers = message.send().map_err(|e| failed(e.to_string()))?;
        if receivers == 0 && !self.connection.is_engine_alive() {
            return Err(self.lost());
        }
        ports::notify(&self.connection.to_engine, group);
        self.pending.insert(group, self.last_request, request);
        self.sent = Instant::now();
        Ok(())
    }

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

/// Maximum number of environments in one item of a message: their numbers and options of [`OPTIONS_BYTES`] fit in a
/// message.
const ENVS_PER_ITEM: usize = 16_384;

impl Trainer {
    /// Sets the reset parameters for the next and all later episodes of some environments; see
    /// [`Pool::set_options`](endless_gym_core::pool::Pool::set_options). It may precede the first reset.
    ///
    /// After [`ServiceError::TimedOut`], the call may be repeated; the engine may still set the options, but not after
    /// a later request.
    ///
    /// # Errors
    ///
    /// [`ServiceError::OptionsTooLong`], [`ServiceError::AnswerPending`] if the group has a pending batch,
    /// [`ServiceError::Rejected`] if there is no such environment or an option is not valid, and the errors of
    /// [`receive`](Trainer::receive). A rejected call changes no environment, unless its JSON text is longer than
    /// [`SNAPSHOT_BYTES`] and so takes several messages.
    ///
    /// ```no_run
    /// # use std::time::Duration;
    /// # use endless_gym_core::pool::NextOptions;
    /// # use endless_gym_service::{ConnectConfig, Trainer};
    /// # let timeout = Duration::from_secs(10);
    /// # let mut trainer = Trainer::connect(&ConnectConfig::new("endless"))?;
    /// let options = serde_json::from_str(r#"{"command_count": [2]}"#)?;
    /// trainer.set_options(0, &[NextOptions { options, envs: vec![3, 5] }], timeout)?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn set_options(&mut self, group: usize, sets: &[NextOptions], timeout: Duration) -> Result<(), ServiceError> {
        for text in messages(sets)? {
            self.transfer_bytes(group, Request::new(RequestKind::SetOptions), &text, timeout)?;
        }
        Ok(())
    }

    /// Returns the seeds and reset parameters of the environments' running episodes, in the order of the environments'
    /// numbers. This trainer must have reset the group before.
    ///
    /// # Errors
    ///
    /// [`ServiceError::Pool`] if an environment's number is out of range, [`ServiceError::AnswerPending`] if the group has a
    /// pending batch, [`ServiceError::Rejected`] if the group was not reset, and the errors of [`receive`](Trainer::receive).
    pub fn running_episodes(
        &mut self,
        group: usize,
        envs: &[usize],
        timeout: Duration,
    ) -> Result<Vec<RunningEpisode>, ServiceError> {
        let num_envs = self.specification.num_envs;
        let mut missing: BTreeSet<usize> = envs.iter().copied().collect();
        if let Some(given) = missing.last().copied().filter(|env| *env >= num_envs) {
            return Err(PoolError::NoSuchEnv { given, num_envs }.into());
        }
        let mut episodes = Vec::new();
        while !missing.is_empty() {
            let mask: Vec<u8> = (0..num_envs).map(|env| u8::from(missing.contains(&env))).collect();
            let specification = Arc::clone(&self.specification);
            let write = |message: &mut [Block]| {
                specification.action.write::<u8>(message, ActionSection::Reset).copy_from_slice(&mask);
                Ok(0)
            };
            let request = Request { checksum: crc32fast::hash(&mask), ..Request::new(RequestKind::Episodes) };
            let text = self.transfer(group, request, timeout, write)?;
            // As many as fit in a response, at least one.
            let received: Vec<RunningEpisode> = serde_json::from_slice(&text).map_err(|_| self.incompatible())?;
            let before = missing.len();
            for episode in &received {
                missing.remove(&episode.env);
            }
            if missing.len() == before {
                return Err(self.incompatible());
            }
            episodes.extend(received);
        }
        Ok(episodes)
    }
}

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

impl Trainer {
    /// Takes a snapshot of an environment: its whole state, for [`restore`](Trainer::restore) or
    /// [`Pool::restore`](endless_gym_core::pool::Pool::restore). This trainer must have reset the group before.
    ///
    /// After [`ServiceError::TimedOut`], the same call continues to wait, and any other request replaces it.
    ///
    /// # Errors
    ///
    /// [`ServiceError::AnswerPending`] if the group has a pending batch, [`ServiceError::Rejected`] if there is no such
    /// environment or the group was not reset, and the errors of [`receive`](Trainer::receive).
    ///
    /// ```no_run
    /// # use std::time::Duration;
    /// # use endless_gym_core::pool::ResetRequest;
    /// # use endless_gym_service::{ConnectConfig, Trainer};
    /// # let timeout = Duration::from_secs(10);
    /// # let mut trainer = Trainer::connect(&ConnectConfig::new("endless"))?;
    /// trainer.reset(0, ResetRequest::All)?;
    /// trainer.receive(0, timeout)?;
    /// let snapshot = trainer.snapshot(0, 3, timeout)?;
    /// // Environment 5 continues where environment 3 was.
    /// trainer.restore(0, 5, &snapshot, timeout)?;
    /// // A reset of no environment returns the current observations.
    /// let num_envs = trainer.specification().num_envs;
    /// trainer.reset(0, ResetRequest::Each { reset: &vec![0; num_envs], seed: &vec![0; num_envs] })?;
    /// let lease = trainer.receive(0, timeout)?;
    /// # Ok::<(), endless_gym_service::ServiceError>(())
    /// ```
    pub fn snapshot(&mut self, group: usize, env: usize, timeout: Duration) -> Result<Vec<u8>, ServiceError> {
        self.transfer(group, Request { env, ..Request::new(RequestKind::Snapshot) }, timeout, |_| Ok(0))
    }

    /// Restores an environment from a snapshot; see [`Pool::restore`](endless_gym_core::pool::Pool::restore). A reset of no
    /// environment ([`ResetRequest::Each`](endless_gym_core::pool::ResetRequest::Each)) then returns its observation.
    ///
    /// After [`ServiceError::TimedOut`], the engine may still restore the environment, but not after a later request.
    ///
    /// # Errors
    ///
    /// [`ServiceError::SnapshotTooLong`], and the errors of [`snapshot`](Trainer::snapshot).
    pub fn restore(
        &mut self,
        group: usize,
        env: usize,
        snapshot: &[u8],
        timeout: Duration,
    ) -> Result<(), ServiceError> {
        let given = snapshot.len();
        if given > SNAPSHOT_BYTES {
            return Err(ServiceError::SnapshotTooLong { given });
        }
        self.transfer_bytes(group, Request { env, ..Request::new(RequestKind::Restore) }, snapshot, timeout)
    }

    /// Saves all environments of the engine to its checkpoint file and returns the saved step of each group. The file
    /// is on disk when this returns. A group with a pending answer may be saved before or after that step; its number
    /// tells which.
    ///
    /// After [`ServiceError::TimedOut`], the same call continues to wait.
    ///
    /// # Errors
    ///
    /// [`ServiceError::AnswerPending`] if group 0 has a pending batch, [`ServiceError::Rejected`] if the engine has no checkpoint
    /// file or cannot write it, or if no group was reset, and the errors of [`receive`](Trainer::receive).
    pub fn checkpoint(&mut self, timeout: Duration) -> Result<Vec<u64>, ServiceError> {
        let steps = self.transfer(0, Request::new(RequestKind::Checkpoint), timeout, |_| Ok(0))?;
        Ok(steps.chunks_exact(size_of::<u64>()).map(bytemuck::pod_read_unaligned).collect())
    }

    /// Like [`transfer`](Self::transfer), with these bytes in the payload's `snapshot`, for an answer without content.
    fn transfer_bytes(
        &mut self,
        group: usize,
        request: Request,
        bytes: &[u8],
        timeout: Duration,
    ) -> Result<(), ServiceError> {
        let specification = Arc::clone(&self.specification);
        let write = |message: &mut [Block]| {
            let section = specification.action.write::<u8>(message, ActionSection::Snapshot);
            section[..bytes.len()].copy_from_slice(bytes);
            Ok(bytes.len())
        };
        self.transfer(group, Request { checksum: crc32fast::hash(bytes), ..request }, timeout, write).map(drop)
    }

    /// Sends a request whose answer is not a batch, unless the same request is pending, and waits for the answer.
    pub(super) fn transfer(
        &mut self,
        group: usize,
        request: Request,
        timeout: Duration,
        write: impl FnOnce(&mut [Block]) -> Result<usize, ServiceError>,
    ) -> Result<Vec<u8>, ServiceError> {
        self.check_group(group)?;
        if !self.pending.has(group, request) {
            self.post(group, request, write)?;
        }
        let response = self.receive_response(group..group + 1, false, timeout)?;
        response.to_snapshot().ok_or_else(|| self.incompatible())
    }
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
