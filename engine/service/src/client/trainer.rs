//! The trainer: sends actions to an engine and receives batches, which it reads in place.

use std::sync::Arc;
use std::time::Duration;

use endless_gym_core::pool::{NextOptions, ResetRequest, RunningEpisode};
use serde_json::{Map, Value as Json};

use crate::client::connect::ConnectConfig;
use crate::client::connection::EngineConnection;
use crate::client::lease::BatchLease;
use crate::client::requests::{GroupReconnection, LastRequest, Reconnection};
use crate::client::trainer_group::{self, Shared, TrainerGroup};
use crate::error::ServiceError;
use crate::namespace::fork_guard::ForkGuard;
use crate::protocol::specification::ServiceSpecification;

/// Steps the environments of an engine. An engine has one trainer at a time.
///
/// Every [`reset`](Trainer::reset) or [`send`](Trainer::send) to a group is answered by one batch, which
/// [`receive`](Trainer::receive) returns. A group has at most one pending answer; several groups may have one each. Several threads
/// can use one [group](Trainer::groups) each.
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
/// let mut trainer = Trainer::connect(&ConnectConfig::new("endless").timeout(timeout))?;
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
    /// All groups of the engine, in the order of their numbers.
    groups: Vec<TrainerGroup>,
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
        let (groups, specification) = (0..specification.groups, Arc::new(specification));
        let connection = ForkGuard::new(connection);
        let shared = Arc::new(Shared { config: config.clone(), specification, connection, id: rand::random() });
        Ok(Trainer { groups: groups.map(|number| TrainerGroup::new(number, 0, &shared)).collect() })
    }

    /// The groups, which several threads can use at the same time.
    pub fn groups(&mut self) -> &mut [TrainerGroup] {
        &mut self.groups
    }

    /// One group.
    ///
    /// # Errors
    ///
    /// [`ServiceError::NoSuchGroup`].
    pub fn group(&mut self, group: usize) -> Result<&mut TrainerGroup, ServiceError> {
        let (service, groups) = (&self.shared().config.service, self.groups.len());
        let missing = ServiceError::NoSuchGroup { service: service.clone(), given: group, groups };
        // Callers may have sorted them.
        self.groups.iter_mut().find(|found| found.number() == group).ok_or(missing)
    }

    /// All groups, in the order of their numbers. The connection ends when the last one is dropped.
    pub fn into_groups(self) -> Vec<TrainerGroup> {
        self.groups
    }

    /// The trainer of these groups, which are taken out of `groups`. After an error, they are still there.
    ///
    /// # Errors
    ///
    /// [`ServiceError::MixedGroups`] if they are not all that [`into_groups`](Trainer::into_groups) returned, in any order.
    pub fn from_groups(groups: &mut Vec<TrainerGroup>) -> Result<Self, ServiceError> {
        if trainer_group::sort(groups) {
            Ok(Trainer { groups: std::mem::take(groups) })
        } else {
            Err(ServiceError::MixedGroups)
        }
    }

    fn shared(&self) -> &Arc<Shared> {
        // A valid specification has at least one group.
        &self.groups[0].shared
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
    /// [`ServiceError::SpecificationChanged`] if the new engine serves different environments, [`ServiceError::MixedGroups`] if
    /// groups were exchanged with another trainer's, and the errors of [`connect`](Trainer::connect).
    pub fn reconnect(&mut self, timeout: Duration) -> Result<Reconnection, ServiceError> {
        if !trainer_group::sort(&mut self.groups) {
            return Err(ServiceError::MixedGroups);
        }
        let lost = Arc::clone(self.shared());
        let restarted = !lost.connection.is_engine_alive();
        let mut last: Vec<_> = self.groups.iter().map(|group| (None, group.pending.last)).collect();
        if restarted {
            let config = lost.config.clone().timeout(timeout);
            let (connection, specification) = EngineConnection::open(&config)?;
            if let Some(what) = lost.specification.difference(&specification) {
                return Err(ServiceError::SpecificationChanged { service: config.service, what });
            }
            for (group, (lost_step, last)) in self.groups.iter().zip(&mut last) {
                let status = lost.connection.status.as_ref().and_then(|status| status.group(group.number));
                *lost_step = status.map(|status| status.step);
                if let Some((number, _)) = group.pending.pending {
                    *last = LastRequest::of_dead_engine(status, lost.id, number);
                }
            }
            let (config, specification) = (lost.config.clone(), Arc::new(specification));
            let shared =
                Arc::new(Shared { config, specification, connection: ForkGuard::new(connection), id: lost.id });
            for group in &mut self.groups {
                *group = TrainerGroup::new(group.number, group.last_request, &shared);
            }
            let (service, process) = (&*shared.specification.service, shared.specification.engine_pid);
            tracing::info!(service, process, "reconnected to another engine");
        }
        let shared = self.shared();
        let step = |group| shared.connection.status.as_ref().and_then(|status| status.group(group)).map(|now| now.step);
        let groups = last.into_iter().enumerate();
        let groups = groups.map(|(group, (lost_step, last_request))| GroupReconnection {
            step: step(group),
            lost_step,
            last_request,
        });
        Ok(Reconnection { restarted, incarnation: shared.specification.incarnation, groups: groups.collect() })
    }

    /// The engine's specification.
    pub fn specification(&self) -> &ServiceSpecification {
        &self.shared().specification
    }

    /// Requests new episodes in a group; [`receive`](Trainer::receive) returns their first observations.
    ///
    /// [`ResetRequest::Seed`] seeds environment `i` of the group with `seed + group * num_envs + i`: the environments of all
    /// groups are numbered consecutively, as in one pool.
    ///
    /// # Errors
    ///
    /// [`ServiceError::ResetCount`] if the request has the wrong length, [`ServiceError::NoSuchGroup`],
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
        self.group(group)?.reset_with(request, options)
    }

    /// Requests a step of a group; [`receive`](Trainer::receive) returns its batch. `actions` has shape `(num_envs, branches)`.
    ///
    /// # Errors
    ///
    /// Checked in this order: [`ServiceError::NoSuchGroup`], [`ServiceError::Action`] for a wrong number of actions,
    /// [`ServiceError::AnswerPending`], [`ServiceError::Action`] for an action out of range. [`ServiceError::EngineLost`] or
    /// [`ServiceError::EngineRestarted`] if the engine has ended, and [`ServiceError::Middleware`] if iceoryx2 cannot send the
    /// request. No error steps an environment.
    pub fn send(&mut self, group: usize, actions: &[i32]) -> Result<(), ServiceError> {
        self.group(group)?.send(actions)
    }

    /// Like [`send`](Trainer::send), but `fill` writes the actions directly into shared memory. The slice has shape
    /// `(num_envs, branches)` and holds zeros or the actions of an earlier step.
    ///
    /// # Errors
    ///
    /// Those of [`send`](Trainer::send).
    pub fn send_with(&mut self, group: usize, fill: impl FnOnce(&mut [i32])) -> Result<(), ServiceError> {
        self.group(group)?.send_with(fill)
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
        self.group(group)?.receive(timeout)
    }

    /// Receives the first batch that arrives from any group with a pending answer; see [`BatchLease::group`].
    ///
    /// # Errors
    ///
    /// [`ServiceError::NothingPending`] if no group has a pending answer, and otherwise those of [`receive`](Trainer::receive).
    pub fn receive_any(&mut self, timeout: Duration) -> Result<BatchLease, ServiceError> {
        TrainerGroup::receive_any(&mut self.groups, timeout)
    }

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
    /// [`SNAPSHOT_BYTES`](endless_gym_core::batch::SNAPSHOT_BYTES) and so takes several messages.
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
        self.group(group)?.set_options(sets, timeout)
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
        self.group(group)?.running_episodes(envs, timeout)
    }

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
    /// # use endless_gym_core::pool::{EnvReset, ResetRequest};
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
    /// trainer.reset(0, ResetRequest::Each(&vec![EnvReset::Keep; num_envs]))?;
    /// let lease = trainer.receive(0, timeout)?;
    /// # Ok::<(), endless_gym_service::ServiceError>(())
    /// ```
    pub fn snapshot(&mut self, group: usize, env: usize, timeout: Duration) -> Result<Vec<u8>, ServiceError> {
        self.group(group)?.snapshot(env, timeout)
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
        self.group(group)?.restore(env, snapshot, timeout)
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
        self.groups[0].checkpoint(timeout)
    }
}
