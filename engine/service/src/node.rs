//! This process among those of its namespace, and whether others live.

use std::ops::Deref;

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::node::NodeView;
use iceoryx2::prelude::{
    CallbackProgression, LogLevel, Node, NodeBuilder, NodeState, SignalHandlingMode, ipc_threadsafe,
    set_log_level_from_env_or,
};

use super::config::Namespace;
use super::error::ServiceError;
use super::here::Here;
use super::sweep;

/// The kind of services. Its ports and samples may be moved to and dropped in any thread, which a binding to a garbage
/// collected language needs. It costs half a microsecond a step against the kind for one thread.
pub(super) type Ipc = ipc_threadsafe::Service;

/// This process as a member of a namespace. Goes after all ports that were made with it.
pub(super) struct Member {
    node: Here<Node<Ipc>>,
}

impl Member {
    /// Joins the namespace. That also removes what dead processes left there.
    pub(super) fn join(namespace: &Namespace) -> Result<Self, ServiceError> {
        set_log_level_from_env_or(LogLevel::Error);
        let config = namespace.prepare()?;
        sweep::unsized_segments(&config);
        let node = NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create()
            .map_err(|e| ServiceError::middleware("cannot register this process")(e.to_string()))?;
        let member = Member { node: Here::new(node) };
        member.clean();
        sweep::services(&config);
        sweep::members(&config);
        Ok(member)
    }

    /// Removes what processes left that have died.
    pub(super) fn clean(&self) {
        let mut dead = Vec::new();
        let listed = Node::<Ipc>::list(self.config(), |state| {
            if let NodeState::Dead(node) = state {
                dead.push(node);
            }
            CallbackProgression::Continue
        });
        if let Err(e) = listed {
            tracing::debug!(error = %e, "cannot look for dead processes");
        }
        if dead.is_empty() {
            return;
        }
        // After their death and before the middleware looks at what they left: it would wait for a size for ever.
        sweep::unsized_segments(self.config());
        for node in dead.into_iter().filter(|node| node.details().is_some()) {
            // That another process is at it is no error.
            if let Err(e) = node.try_remove_stale_resources() {
                tracing::debug!(error = %e, "a dead process is not removed");
            }
        }
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
        if self.node.leave() {
            sweep::deserted(&config);
        }
    }
}
