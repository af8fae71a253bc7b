//! Requests whose answer is not a batch: snapshots of environments, and checkpoints of the engine.

use std::sync::Arc;
use std::time::Duration;

use endless_gym_core::batch::{ActionSection, Block, SNAPSHOT_BYTES};

use super::Trainer;
use crate::error::ServiceError;
use crate::message::RequestKind;
use crate::pending::Request;

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
        let specification = Arc::clone(&self.specification);
        let write = |message: &mut [Block]| {
            specification.action.write::<u8>(message, ActionSection::Snapshot)[..given].copy_from_slice(snapshot);
            Ok(given)
        };
        let request = Request { env, checksum: crc32fast::hash(snapshot), ..Request::new(RequestKind::Restore) };
        self.transfer(group, request, timeout, write).map(|_| ())
    }

    /// Saves all environments of the engine to its checkpoint file, and returns the step of each group that was saved. The file is
    /// on the disk when this returns. Groups whose answers are pending are saved before or after their step, as their number says.
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
