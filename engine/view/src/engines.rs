//! Describes engines for the page, from the status that each publishes.

use endless_gym_service::{EngineProcesses, EngineStatus, GroupStatus, Namespace};
use serde_json::{Value as Json, json};

/// The running engines, sorted by name.
pub(crate) fn list(namespace: &Namespace) -> Vec<Json> {
    EngineStatus::all(namespace).iter().map(|status| describe(status, &Details::of(status, namespace))).collect()
}

/// Details that are not in the status. Reading them opens files of all engines in the namespace and the engine's memory
/// map.
#[derive(Debug, Default)]
pub(crate) struct Details {
    processes: EngineProcesses,
    shared_memory: Option<u64>,
}

impl Details {
    pub fn of(status: &EngineStatus, namespace: &Namespace) -> Self {
        Details { processes: status.processes(namespace), shared_memory: status.shared_memory(namespace) }
    }
}

/// One engine: its work and its users.
pub(crate) fn describe(status: &EngineStatus, details: &Details) -> Json {
    let last_request = status.groups.iter().filter_map(|group| group.last_request).min();
    json!({
        "service": status.service,
        "id": status.id,
        "process": status.process,
        // As text, since not every JSON reader keeps 64 bits.
        "incarnation": format!("{:016x}", status.incarnation),
        "groups": status.groups.len(),
        "num_envs": status.num_envs,
        "uptime_seconds": status.uptime.as_secs_f64(),
        "env_steps": status.total(|group| group.env_steps),
        "episodes": status.total(|group| group.episodes),
        "held": status.total(|group| u64::from(group.held)),
        "held_by_observers": status.total(GroupStatus::held_by_observers),
        "trainers": details.processes.trainers,
        "observers": details.processes.observers,
        "shared_memory_bytes": details.shared_memory,
        "recoveries": status.recoveries,
        "seconds_since_request": last_request.map(|since| since.as_secs_f64()),
    })
}
