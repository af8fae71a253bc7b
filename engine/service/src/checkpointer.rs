//! When an engine saves its environments.

use std::thread::JoinHandle;
use std::time::Instant;

use crate::checkpoint::{self, CheckpointHead, SavedGroup};
use crate::checkpoint_config::{CheckpointConfig, CheckpointError};
use crate::checkpoint_lock::CheckpointLock;
use crate::group::Group;
use crate::status_record::now;
use crate::status_writer::StatusWriter;

/// Saves the environments of an engine. A periodic checkpoint stalls the engine only while their states are copied: another thread
/// encodes and writes them.
#[derive(Debug)]
pub(crate) struct Checkpointer {
    config: CheckpointConfig,
    head: CheckpointHead,
    last: Instant,
    /// Whether a request was executed since the last checkpoint.
    changed: bool,
    writing: Option<JoinHandle<Result<(), CheckpointError>>>,
    // Released when nothing is written any more.
    _lock: CheckpointLock,
}

impl Checkpointer {
    pub(crate) fn new(config: &CheckpointConfig, head: CheckpointHead) -> Result<Self, CheckpointError> {
        if config.every.is_some_and(|every| every.is_zero()) {
            return Err(CheckpointError::Interval);
        }
        // First: another engine may be about to create the file.
        let lock = CheckpointLock::acquire(&config.path)?;
        if !config.resume && config.path.exists() {
            return Err(CheckpointError::Exists { path: config.path.clone() });
        }
        checkpoint::check_writable(&config.path)?;
        Ok(Checkpointer {
            config: config.clone(),
            head,
            last: Instant::now(),
            changed: false,
            writing: None,
            _lock: lock,
        })
    }

    /// Continues from the file, if the configuration asks for it and the file exists.
    pub(crate) fn resume(&self, groups: &mut [Group], status: &mut StatusWriter) -> Result<(), CheckpointError> {
        let path = &self.config.path;
        let Some(saved) = self.config.resume.then(|| checkpoint::read(path, &self.head)).transpose()?.flatten() else {
            return Ok(());
        };
        for (number, (group, SavedGroup { step, envs })) in groups.iter_mut().zip(saved).enumerate() {
            if let Some(envs) = envs {
                group.resume(&envs).map_err(|source| CheckpointError::Group {
                    path: path.clone(),
                    group: number,
                    source,
                })?;
            }
            status.update_group(number, |group| group.step = step);
        }
        tracing::info!(path = %path.display(), "resumed from a checkpoint");
        Ok(())
    }

    /// A request was executed.
    pub(crate) fn mark_changed(&mut self) {
        self.changed = true;
    }

    /// Saves in the background if it is time to.
    pub(crate) fn poll(&mut self, groups: &[Group], status: &mut StatusWriter) {
        if self.writing.as_ref().is_some_and(JoinHandle::is_finished)
            && let Err(e) = self.finish(status)
        {
            tracing::error!(error = %e, "cannot save a checkpoint");
        }
        let is_due = self.config.every.is_some_and(|every| self.last.elapsed() >= every);
        if !is_due || !self.changed || self.writing.is_some() {
            return;
        }
        (self.last, self.changed) = (Instant::now(), false);
        let saved = match save(groups, status) {
            Ok(saved) => saved,
            // No group was reset.
            Err(CheckpointError::NotReset) => return,
            Err(e) => return tracing::error!(error = %e, "cannot save a checkpoint"),
        };
        let (path, head) = (self.config.path.clone(), self.head.clone());
        let thread = std::thread::Builder::new().name("checkpoint".to_owned());
        match thread.spawn(move || checkpoint::write(&path, &head, saved)) {
            Ok(writing) => self.writing = Some(writing),
            Err(e) => tracing::error!(error = %e, "cannot start a thread to save a checkpoint"),
        }
    }

    /// Saves now, and returns when the checkpoint is on the disk.
    pub(crate) fn save(&mut self, groups: &[Group], status: &mut StatusWriter) -> Result<(), CheckpointError> {
        if let Err(e) = self.finish(status) {
            tracing::warn!(error = %e, "cannot save a checkpoint");
        }
        let saved = save(groups, status)?;
        checkpoint::write(&self.config.path, &self.head, saved)?;
        (self.last, self.changed) = (Instant::now(), false);
        self.saved(status);
        Ok(())
    }

    /// Saves what has changed since the last checkpoint, when the engine stops.
    pub(crate) fn stop(&mut self, groups: &[Group], status: &mut StatusWriter) -> Result<(), CheckpointError> {
        let unfinished = self.finish(status);
        if self.changed || unfinished.is_err() { self.save(groups, status) } else { Ok(()) }
    }

    /// Waits for the thread that writes.
    fn finish(&mut self, status: &mut StatusWriter) -> Result<(), CheckpointError> {
        let Some(writing) = self.writing.take() else { return Ok(()) };
        let failed = |_| CheckpointError::Write { path: self.config.path.clone(), reason: "it panicked".to_owned() };
        let written = writing.join().map_err(failed).and_then(|written| written);
        match written {
            Ok(()) => self.saved(status),
            Err(_) => self.changed = true,
        }
        written
    }

    fn saved(&self, status: &mut StatusWriter) {
        tracing::info!(path = %self.config.path.display(), "saved a checkpoint");
        status.update_engine(|engine| (engine.checkpoints, engine.last_checkpoint) = (engine.checkpoints + 1, now()));
    }
}

impl Drop for Checkpointer {
    fn drop(&mut self) {
        // Otherwise the end of the process would interrupt the thread.
        if let Some(writing) = self.writing.take() {
            let _ = writing.join();
        }
    }
}

/// The states of all groups.
fn save(groups: &[Group], status: &StatusWriter) -> Result<Vec<SavedGroup>, CheckpointError> {
    let saved: Result<Vec<_>, _> = groups
        .iter()
        .enumerate()
        .map(|(number, group)| group.save().map(|envs| SavedGroup { step: status.step(number), envs }))
        .collect();
    let saved = saved.map_err(|source| CheckpointError::State { source })?;
    if saved.iter().all(|group| group.envs.is_none()) { Err(CheckpointError::NotReset) } else { Ok(saved) }
}
