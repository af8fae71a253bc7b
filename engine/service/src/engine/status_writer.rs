//! The status of an engine as it serves requests.

use std::path::PathBuf;

use bytemuck::Zeroable;

use crate::engine::group::Outcome;
use crate::error::{PACKAGE_VERSION, ServiceError};
use crate::protocol::message::RequestHeader;
use crate::protocol::specification::ServiceSpecification;
use crate::protocol::status_file::{self, EngineHead, EngineRecord, GroupRecord, MAGIC, StatusFile, now, padded};

/// Keeps the records of an engine and publishes every change, which takes tens of nanoseconds.
#[derive(Debug)]
pub(crate) struct StatusWriter {
    file: StatusFile,
    path: PathBuf,
    engine: EngineRecord,
    groups: Vec<GroupRecord>,
}

impl StatusWriter {
    /// Writes the status and the specification of a starting engine; [`publish`](Self::publish) lets others find them.
    /// `prefix` is that of the namespace's files.
    pub(crate) fn create(prefix: &str, specification: &ServiceSpecification) -> Result<Self, ServiceError> {
        let (service, incarnation) = (&specification.service, specification.incarnation);
        let text = serde_json::to_vec(specification);
        let text = text.map_err(ServiceError::middleware("cannot write the specification"))?;
        let head = EngineHead {
            magic: MAGIC,
            layout_version: specification.layout_version,
            process: specification.engine_pid,
            package: padded(PACKAGE_VERSION),
            specification_bytes: text.len() as u64,
        };
        let engine = EngineRecord {
            head,
            incarnation,
            started: now(),
            groups: specification.groups as u32,
            num_envs: specification.num_envs as u32,
            id: padded(&specification.id),
            service: padded(service),
            ..EngineRecord::zeroed()
        };
        let path = status_file::path(prefix, service, incarnation);
        let file = StatusFile::create(&path, &engine, specification.groups, &text)?;
        Ok(StatusWriter { file, path, engine, groups: vec![GroupRecord::default(); specification.groups] })
    }

    /// Lets other processes find the engine, under its name.
    pub(crate) fn publish(&mut self) -> Result<(), ServiceError> {
        self.file.publish(&self.path)
    }

    /// Changes the engine's record.
    pub(crate) fn update_engine(&mut self, change: impl FnOnce(&mut EngineRecord)) {
        change(&mut self.engine);
        self.file.write_engine(&self.engine);
    }

    /// Changes a group's record.
    pub(crate) fn update_group(&mut self, group: usize, change: impl FnOnce(&mut GroupRecord)) {
        let record = &mut self.groups[group];
        change(record);
        self.file.write_group(group, record);
    }

    /// A request was taken. Returns whether it is its trainer's first.
    pub(crate) fn begin(&mut self, group: usize, request: &RequestHeader) -> bool {
        let is_new = self.groups[group].trainer != request.trainer;
        self.update_group(group, |record| {
            if is_new {
                (record.trainers, record.answered, record.executed) = (record.trainers + 1, 0, 0);
            }
            (record.trainer, record.trainer_process) = (request.trainer, request.process);
            (record.taken, record.kind, record.held) = (request.request, request.kind, request.held);
            record.busy_since = now();
            record.last_request = record.busy_since;
        });
        is_new
    }

    /// The request was executed and is about to be answered: `outcome` is what the response holds, `None` for a rejection.
    pub(crate) fn end(&mut self, group: usize, step: u64, outcome: Option<&Outcome>) {
        self.update_group(group, |record| {
            (record.step, record.answered, record.busy_since) = (step, record.taken, 0);
            match outcome {
                Some(_) => record.executed = record.taken,
                None => record.rejected += 1,
            }
            if let Some(Outcome::Batch { env_steps, episodes }) = outcome {
                record.batches += 1;
                record.env_steps += *env_steps as u64;
                record.episodes += *episodes as u64;
            }
        });
    }

    /// The number of the current step of a group.
    pub(crate) fn step(&self, group: usize) -> u64 {
        self.groups[group].step
    }

    /// Totals over the groups.
    pub(crate) fn summary(&self) -> EngineSummary {
        let sum = |field: fn(&GroupRecord) -> u64| self.groups.iter().map(field).sum();
        EngineSummary {
            batches: sum(|group| group.batches),
            env_steps: sum(|group| group.env_steps),
            episodes: sum(|group| group.episodes),
            rejected: sum(|group| group.rejected),
            undelivered: sum(|group| group.undelivered),
            dropped: self.engine.dropped,
            recoveries: self.engine.recoveries,
        }
    }
}

/// What an engine has done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EngineSummary {
    /// Batches sent, including those of resets.
    pub batches: u64,
    /// Steps, summed over the environments.
    pub env_steps: u64,
    /// Episodes that have ended.
    pub episodes: u64,
    /// Requests that were rejected.
    pub rejected: u64,
    /// Requests for an earlier incarnation, which were ignored.
    pub dropped: u64,
    /// Batches that no process received.
    pub undelivered: u64,
    /// Dead processes whose resources the engine removed.
    pub recoveries: u64,
}
