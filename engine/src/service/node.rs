//! This process among those of its namespace, and whether others live.

use std::fs;
use std::ops::Deref;

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::node::NodeView;
use iceoryx2::prelude::{
    CallbackProgression, Config, LogLevel, Node, NodeBuilder, NodeState, SignalHandlingMode, ipc_threadsafe,
    set_log_level_from_env_or,
};

use super::config::Namespace;
use super::error::ServiceError;
use super::here::Here;

/// The kind of services. Its ports and samples may be moved to and dropped in any thread, which a binding to a garbage
/// collected language needs. It costs half a microsecond a step against the kind for one thread.
pub(super) type Ipc = ipc_threadsafe::Service;

/// This process as a member of a namespace. Goes after all ports that were made with it.
pub(super) struct Member {
    node: Here<Node<Ipc>>,
    prefix: String,
}

impl Member {
    /// Joins the namespace. That also removes what dead processes left there.
    pub(super) fn join(namespace: &Namespace) -> Result<Self, ServiceError> {
        set_log_level_from_env_or(LogLevel::Error);
        let config = namespace.prepare()?;
        let node = NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create()
            .map_err(|e| ServiceError::middleware("cannot register this process")(e.to_string()))?;
        Ok(Member { node: Here::new(node), prefix: namespace.prefix().to_owned() })
    }

    /// Whether the process that owns a node still runs. `false` is certain; where the state cannot be read, it counts as
    /// running.
    pub(super) fn is_alive(&self, node: UniqueNodeId) -> bool {
        !matches!(Node::<Ipc>::state_of(self.config(), node), Ok(None | Some(NodeState::Dead(_))))
    }

    /// The process that owns a running node.
    pub(super) fn process_of(&self, node: UniqueNodeId) -> Option<u32> {
        match Node::<Ipc>::state_of(self.config(), node) {
            Ok(Some(NodeState::Alive(view))) => {
                view.details().as_ref().and_then(|details| u32::try_from(details.process_id().value()).ok())
            }
            _ => None,
        }
    }
}

impl Deref for Member {
    type Target = Node<Ipc>;

    fn deref(&self) -> &Node<Ipc> {
        &self.node
    }
}

impl Drop for Member {
    fn drop(&mut self) {
        let config = self.config().clone();
        if self.node.leave() && is_deserted(&config) {
            remove_node_counter(&self.prefix);
        }
    }
}

/// Whether a namespace has no members, dead ones included.
fn is_deserted(config: &Config) -> bool {
    let mut deserted = true;
    let listed = Node::<Ipc>::list(config, |_| {
        deserted = false;
        CallbackProgression::Stop
    });
    listed.is_ok() && deserted
}

/// Removes the counter that numbers the members, which the middleware leaves in shared memory for ever. The number is one part
/// of a member's identity beside process and time, so nothing is confused when it starts over.
fn remove_node_counter(prefix: &str) {
    for entry in fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with(prefix) && name.ends_with(".global_mgmt") {
            let _ = fs::remove_file(entry.path());
        }
    }
}
