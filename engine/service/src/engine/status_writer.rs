//! The status of an engine as it serves requests.

use std::path::PathBuf;
use std::sync::Mutex;

use bytemuck::Zeroable;

use crate::engine::group::Outcome;
use crate::error::{PACKAGE_VERSION, ServiceError};
use crate::protocol::message::RequestHeader;
use crate::protocol::specification::ServiceSpecification;
use crate::protocol::status_file::{self, EngineHead, EngineRecord, GroupRecord, MAGIC, StatusFile, now, padded};
use crate::protocol::wait::lock;

/// Keeps the records of an engine and publishes every change, which takes tens of nanoseconds.
#[derive(Debug)]
pub(crate) struct StatusWriter {
    file: StatusFile,
    path: PathBuf,
    engine: Mutex<EngineRecord>,
    groups: Vec<Mutex<GroupRecord>>,
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
        let groups = (0..specification.groups).map(|_| Mutex::default()).collect();
        Ok(StatusWriter { file, path, engine: Mutex::new(engine), groups })
    }

    /// Lets other processes find the engine, under its name.
    pub(crate) fn publish(&mut self) -> Result<(), ServiceError> {
        self.file.publish(&self.path)
    }

    /// Changes the engine's record.
    pub(crate) fn update_engine(&self, change: impl FnOnce(&mut EngineRecord)) {
        let mut record = lock(&self.engine);
        change(&mut record);
        self.file.write_first(&*record);
    }

    /// Changes a group's record.
    pub(crate) fn update_group(&self, group: usize, change: impl FnOnce(&mut GroupRecord)) {
        let mut record = lock(&self.groups[group]);
        change(&mut record);
        self.file.write_group(group, &record);
    }

    /// A request was taken. Returns whether it is its trainer's first.
    pub(crate) fn begin(&self, group: usize, request: &RequestHeader) -> bool {
        let mut is_new = false;
        self.update_group(group, |record| {
            is_new = record.trainer != request.trainer;
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
    pub(crate) fn end(&self, group: usize, step: u64, outcome: Option<&Outcome>) {
        self.update_group(group, |record| {
            (record.step, record.answered, record.busy_since) = (step, record.taken, 0);
            match outcome {
                Some(_) => record.executed = record.taken,
                None => record.rejected += 1,
            }
            if let Some(Outcome::Batch { env_steps, ended }) = outcome {
                record.batches += 1;
                record.env_steps += *env_steps as u64;
                record.episodes += ended.episodes;
                record.returns += ended.returns;
                record.lengths += ended.lengths;
                record.successes += ended.successes;
            }
        });
    }

    /// Wakes the observers that wait for a batch of a group.
    pub(crate) fn ring(&self, group: usize) {
        let groups = self.groups.len();
        self.file.ring(groups, group);
        // An observer of one group, the only one, waits for that group.
        if groups > 1 {
            self.file.ring(groups, groups);
        }
    }

    /// The number of the current step of a group.
    pub(crate) fn step(&self, group: usize) -> u64 {
        lock(&self.groups[group]).step
    }

    /// Totals over the groups.
    pub(crate) fn summary(&self) -> EngineSummary {
        let sum = |field: fn(&GroupRecord) -> u64| self.groups.iter().map(|group| field(&lock(group))).sum();
        EngineSummary {
            batches: sum(|group| group.batches),
            env_steps: sum(|group| group.env_steps),
            rejected: sum(|group| group.rejected),
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
    /// Requests that were rejected.
    pub rejected: u64,
}
