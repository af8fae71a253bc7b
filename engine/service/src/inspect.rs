//! The processes of an engine and its shared memory, found without connecting to it.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::fs;
use std::os::unix::fs::MetadataExt;

use iceoryx2::node::NodeView;
use iceoryx2::prelude::{CallbackProgression, NodeState, Service};
use serde::Serialize;

use crate::identity::Identity;
use crate::namespace::{Ipc, Namespace};
use crate::ports::SPECIFICATION_PREFIX;
use crate::status::EngineStatus;

/// The processes that are connected to an engine, by their ids.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct EngineProcesses {
    /// The trainer. Several only while one takes the place of another.
    pub trainers: BTreeSet<u32>,
    /// The observers of all groups.
    pub observers: BTreeSet<u32>,
}

impl EngineStatus {
    /// The processes that are connected to the engine. Creates and removes nothing; empty if they cannot be listed.
    pub fn processes(&self, namespace: &Namespace) -> EngineProcesses {
        let Some(identity) = Identity::existing(namespace) else { return EngineProcesses::default() };
        let Ok(config) = namespace.config(identity.prefix()) else { return EngineProcesses::default() };
        let specification = format!("{SPECIFICATION_PREFIX}{}", self.service);
        let prefix = format!("{specification}/{:016x}/", self.incarnation);
        // The nodes of the services, and their process ids.
        let (mut engine, mut requests, mut responses) = (HashSet::new(), HashSet::new(), HashSet::new());
        let mut process_ids = HashMap::new();
        let listed = Ipc::list(&config, |service| {
            let name = service.static_details.name().as_str();
            let nodes = match name.strip_prefix(&prefix) {
                Some(what) if what.starts_with("act/") => &mut requests,
                Some(what) if what.starts_with("obs/") => &mut responses,
                None if name == specification => &mut engine,
                _ => return CallbackProgression::Continue,
            };
            for node in service.dynamic_details.iter().flat_map(|details| &details.nodes) {
                if let NodeState::Alive(view) = node
                    && let Some(details) = view.details()
                    && let Ok(process) = u32::try_from(details.process_id().value())
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
        // Trainers and observers open the specification only while they connect.
        let process_of = |node: &u128| process_ids.get(node).copied();
        let trainers = requests.difference(&engine).filter_map(process_of).collect();
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
