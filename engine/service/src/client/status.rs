//! The status of an engine, as other processes see it.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::time::Duration;

use iceoryx2::node::NodeView;
use iceoryx2::prelude::{CallbackProgression, NodeState, Service};
use serde::Serialize;

use crate::error::EngineActivity;
use crate::namespace::directory::{Ipc, Namespace};
use crate::namespace::identity::Identity;
use crate::protocol::message::RequestKind;
use crate::protocol::ports::SERVICE_PREFIX;
use crate::protocol::specification::ServiceSpecification;
use crate::protocol::status_file::{self, EngineRecord, GroupRecord, ObserverRecord, StatusReader, now, unpadded};

/// The status of an engine, read from shared memory. Reading it affects neither the engine nor its trainer.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EngineStatus {
    /// The engine's name.
    pub service: String,
    /// Environment id.
    pub id: String,
    /// Process id of the engine.
    pub process: u32,
    /// Random number that identifies this run of the engine.
    pub incarnation: u64,
    /// Environments in each group.
    pub num_envs: u32,
    /// Time since the engine started.
    #[serde(rename = "uptime_seconds", serialize_with = "seconds")]
    pub uptime: Duration,
    /// Requests for an earlier incarnation, which were ignored.
    pub dropped: u64,
    /// Dead processes whose resources the engine removed.
    pub recoveries: u64,
    /// Checkpoints saved.
    pub checkpoints: u64,
    /// Time since the last checkpoint; `None` before the first.
    #[serde(rename = "seconds_since_checkpoint", serialize_with = "optional_seconds")]
    pub last_checkpoint: Option<Duration>,
    /// By group.
    pub groups: Vec<GroupStatus>,
}

/// The status of one group of an engine.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GroupStatus {
    /// Batches that the group has returned; see [`BatchLease::step`](crate::BatchLease::step).
    pub step: u64,
    /// Batches that this run of the engine has sent, including those of resets.
    pub batches: u64,
    /// Steps, summed over the environments.
    pub env_steps: u64,
    /// Episodes that have ended.
    pub episodes: u64,
    /// Sum of their returns.
    pub returns: f64,
    /// Sum of their lengths in steps.
    pub lengths: u64,
    /// How many of them ended with an info `success` of 1.
    pub successes: u64,
    /// Requests that were rejected.
    pub rejected: u64,
    /// Batches that no process received.
    pub undelivered: u64,
    /// Number of trainers that sent requests, one after the other.
    pub trainers: u64,
    /// Process id of the last trainer; `None` before its first request.
    pub trainer_process: Option<u32>,
    /// Batches that the trainer held when it sent its last request.
    pub held: u32,
    /// The group's observers, sorted by process id.
    pub observers: Vec<ObserverStatus>,
    /// Number of the last request that the engine has taken.
    pub last_taken: u64,
    /// Number of the last request that the engine has answered.
    pub last_answered: u64,
    /// Kind of the last request: `step`, `reset`, `snapshot`, `restore`, `checkpoint`, `options` or `episodes`; `None`
    /// before the first.
    pub kind: Option<&'static str>,
    /// How long the engine has been executing the current request; `None` if there is none.
    #[serde(rename = "busy_seconds", serialize_with = "optional_seconds")]
    pub busy: Option<Duration>,
    /// Time since the last request; `None` before the first.
    #[serde(rename = "seconds_since_request", serialize_with = "optional_seconds")]
    pub last_request: Option<Duration>,
}

/// The status of an observer.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ObserverStatus {
    /// Its process id.
    pub process: u32,
    /// Batches that it has received.
    pub batches: u64,
    /// Batches that it held when it received the last one, including that one.
    pub held: u32,
    /// Time since it received the last one; `None` before the first.
    #[serde(rename = "seconds_since_batch", serialize_with = "optional_seconds")]
    pub last_batch: Option<Duration>,
}

fn seconds<S: serde::Serializer>(duration: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(duration.as_secs_f64())
}

#[allow(clippy::ref_option)] // The signature that serde requires.
fn optional_seconds<S: serde::Serializer>(duration: &Option<Duration>, serializer: S) -> Result<S::Ok, S::Error> {
    duration.map(|duration| duration.as_secs_f64()).serialize(serializer)
}

impl EngineStatus {
    /// The status of all running engines of a namespace, sorted by name.
    ///
    /// Creates and removes nothing, even if the namespace's directory does not exist. Engines of another version are
    /// left out.
    pub fn all(namespace: &Namespace) -> Vec<Self> {
        let Some(identity) = Identity::existing(namespace) else { return Vec::new() };
        let prefix = identity.prefix();
        let readers = status_file::engines(prefix).into_iter().filter_map(|(_, path)| StatusReader::open(&path));
        let running = readers.filter(StatusReader::is_alive);
        let mut found: Vec<_> = running.filter_map(|reader| EngineStatus::read(&reader, prefix)).collect();
        found.sort_by(|a, b| a.service.cmp(&b.service));
        found
    }

    /// The status of the running engine of that name.
    pub fn of(namespace: &Namespace, service: &str) -> Option<Self> {
        EngineStatus::all(namespace).into_iter().find(|status| status.service == service)
    }

    /// The sum of a field over the groups.
    pub fn total(&self, field: impl Fn(&GroupStatus) -> u64) -> u64 {
        // Saturating: the numbers come from another process.
        self.groups.iter().map(field).fold(0, u64::saturating_add)
    }

    fn read(reader: &StatusReader, prefix: &str) -> Option<Self> {
        let engine = reader.engine()?;
        let groups: Option<Vec<_>> = (0..engine.groups as usize).map(|group| reader.group(group)).collect();
        let observers = status_file::running_observers(prefix, engine.incarnation);
        Some(EngineStatus::new(&engine, &groups?, &observers, now()))
    }

    fn new(engine: &EngineRecord, groups: &[GroupRecord], observers: &[ObserverRecord], now: u64) -> Self {
        EngineStatus {
            service: unpadded(&engine.service),
            id: unpadded(&engine.id),
            process: engine.head.process,
            incarnation: engine.incarnation,
            num_envs: engine.num_envs,
            uptime: since(engine.started, now).unwrap_or_default(),
            dropped: engine.dropped,
            recoveries: engine.recoveries,
            checkpoints: engine.checkpoints,
            last_checkpoint: since(engine.last_checkpoint, now),
            groups: groups
                .iter()
                .enumerate()
                .map(|(number, group)| {
                    let observers = observers.iter().filter(|observer| observer.group as usize == number);
                    GroupStatus::new(group, observers, now)
                })
                .collect(),
        }
    }
}

impl GroupStatus {
    /// Batches that the observers held when they received their last ones.
    pub fn held_by_observers(&self) -> u64 {
        self.observers.iter().map(|observer| u64::from(observer.held)).sum()
    }

    fn new<'a>(group: &GroupRecord, observers: impl Iterator<Item = &'a ObserverRecord>, now: u64) -> Self {
        let had_request = group.last_request != 0;
        let mut observers: Vec<_> = observers.map(|observer| ObserverStatus::new(observer, now)).collect();
        observers.sort_by_key(|observer| observer.process);
        GroupStatus {
            step: group.step,
            batches: group.batches,
            env_steps: group.env_steps,
            episodes: group.episodes,
            returns: group.returns,
            lengths: group.lengths,
            successes: group.successes,
            rejected: group.rejected,
            undelivered: group.undelivered,
            trainers: group.trainers,
            trainer_process: had_request.then_some(group.trainer_process),
            held: group.held,
            observers,
            last_taken: group.taken,
            last_answered: group.answered,
            kind: had_request.then(|| group.kind()),
            busy: since(group.busy_since, now),
            last_request: since(group.last_request, now),
        }
    }
}

impl ObserverStatus {
    fn new(observer: &ObserverRecord, now: u64) -> Self {
        ObserverStatus {
            process: observer.process,
            batches: observer.batches,
            held: observer.held,
            last_batch: since(observer.last_batch, now),
        }
    }
}

/// The time since a moment; `None` for the moment 0.
fn since(moment: u64, now: u64) -> Option<Duration> {
    (moment != 0).then(|| Duration::from_nanos(now.saturating_sub(moment)))
}

/// What the engine is doing while a trainer waits for the answer to its request `number` to `group`.
pub(crate) fn activity(status: Option<&StatusReader>, trainer: u64, group: usize, number: u64) -> EngineActivity {
    let Some((status, engine)) = status.and_then(|status| Some((status, status.engine()?))) else {
        return EngineActivity::Unknown;
    };
    let groups = std::iter::once(group).chain((0..engine.groups as usize).filter(|other| *other != group));
    for other in groups {
        let Some(record) = status.group(other) else { return EngineActivity::Unknown };
        if let Some(since) = since(record.busy_since, now()) {
            return EngineActivity::Busy { group: other, kind: record.kind(), since, process: engine.head.process };
        }
        if other == group && record.trainer == trainer && record.answered == number {
            return EngineActivity::Answered;
        }
    }
    EngineActivity::NotTaken { process: engine.head.process }
}

/// Shows what one run of an engine is doing, also after its files were removed.
#[derive(Debug)]
pub struct EngineMonitor(StatusReader);

impl EngineMonitor {
    /// Opens the status of an engine; `None` if that is not possible.
    pub fn open(namespace: &Namespace, engine: &ServiceSpecification) -> Option<Self> {
        let identity = Identity::existing(namespace)?;
        let path = status_file::path(identity.prefix(), &engine.service, engine.incarnation);
        StatusReader::open(&path).map(EngineMonitor)
    }

    /// The request that the engine has been executing for the longest time, apart from saving checkpoints, which takes as long as
    /// it takes; `None` if there is none.
    pub fn longest(&self) -> Option<EngineActivity> {
        let engine = self.0.engine()?;
        let busy = (0..engine.groups as usize).filter_map(|group| {
            let record = self.0.group(group)?;
            let since = since(record.busy_since, now()).filter(|_| record.kind() != RequestKind::Checkpoint.name())?;
            Some(EngineActivity::Busy { group, kind: record.kind(), since, process: engine.head.process })
        });
        busy.max_by_key(|activity| match activity {
            EngineActivity::Busy { since, .. } => *since,
            _ => Duration::ZERO,
        })
    }
}

/// What the engine is doing while an observer waits for a batch of a group.
pub(crate) fn observed_activity(status: Option<&StatusReader>, group: usize) -> EngineActivity {
    // No trainer has the number 0.
    match activity(status, 0, group, u64::MAX) {
        EngineActivity::NotTaken { process } => {
            let record = status.and_then(|status| status.group(group));
            let since = record.and_then(|record| since(record.last_request, now()));
            EngineActivity::Idle { group, since, process }
        }
        busy => busy,
    }
}

/// The process ids of an engine's clients.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct EngineProcesses {
    /// The trainer. More than one only while one replaces another.
    pub trainers: BTreeSet<u32>,
    /// The observers of all groups.
    pub observers: BTreeSet<u32>,
}

impl EngineStatus {
    /// The processes that are connected to the engine. Creates and removes nothing; empty if they cannot be listed.
    pub fn processes(&self, namespace: &Namespace) -> EngineProcesses {
        let Some(identity) = Identity::existing(namespace) else { return EngineProcesses::default() };
        let Ok(config) = namespace.config(identity.prefix()) else { return EngineProcesses::default() };
        let prefix = format!("{SERVICE_PREFIX}{}/{:016x}/", self.service, self.incarnation);
        // The nodes of all processes but the engine, by service, and their process ids.
        let (mut requests, mut responses) = (HashSet::new(), HashSet::new());
        let mut process_ids = HashMap::new();
        let listed = Ipc::list(&config, |service| {
            let name = service.static_details.name().as_str();
            let nodes = match name.strip_prefix(&prefix) {
                Some(what) if what.starts_with("act/") => &mut requests,
                Some(what) if what.starts_with("obs/") => &mut responses,
                _ => return CallbackProgression::Continue,
            };
            for node in service.dynamic_details.iter().flat_map(|details| &details.nodes) {
                if let NodeState::Alive(view) = node
                    && let Some(details) = view.details()
                    && let Ok(process) = u32::try_from(details.process_id().value())
                    && process != self.process
                {
                    let number = node.node_id().value();
                    nodes.insert(number);
                    process_ids.insert(number, process);
                }
            }
            CallbackProgression::Continue
        });
        if let Err(e) = listed {
            tracing::debug!(error = %e, "cannot list the services");
        }
        let process_of = |node: &u128| process_ids.get(node).copied();
        let trainers = requests.iter().filter_map(process_of).collect();
        let observers = responses.difference(&requests).filter_map(process_of).collect();
        EngineProcesses { trainers, observers }
    }

    /// Bytes of shared memory that are allocated to the engine: its own segments and the requests of its trainer. `None` if its
    /// process cannot be inspected.
    pub fn shared_memory(&self, namespace: &Namespace) -> Option<u64> {
        let maps = fs::read_to_string(format!("/proc/{}/maps", self.process)).ok()?;
        let segment = format!("/dev/shm/{}", Identity::existing(namespace)?.prefix());
        let paths: HashSet<&str> = maps.lines().filter_map(|line| Some(&line[line.find(&segment)?..])).collect();
        Some(paths.iter().filter_map(|path| fs::metadata(path).ok()).map(|data| data.blocks() * 512).sum())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn record<R: bytemuck::Pod + std::fmt::Debug>() -> impl Strategy<Value = R> {
        prop::collection::vec(any::<u8>(), size_of::<R>()).prop_map(|bytes| bytemuck::pod_read_unaligned(&bytes))
    }

    proptest! {
        #[test]
        fn arbitrary_records_make_a_printable_status(
            engine in record::<EngineRecord>(),
            groups in prop::collection::vec(record::<GroupRecord>(), 0..4),
            observers in prop::collection::vec(record::<ObserverRecord>(), 0..4),
            now: u64,
        ) {
            let status = EngineStatus::new(&engine, &groups, &observers, now);
            prop_assert_eq!(status.groups.len(), groups.len());
            prop_assert!(!status.service.chars().any(char::is_control));
            serde_json::to_string(&status).unwrap();
        }
    }
}
