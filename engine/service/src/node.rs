//! The iceoryx2 node of this process in a namespace, and the state of other processes' nodes.

use std::ops::Deref;
use std::path::{Path, PathBuf};

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::node::NodeView;
use iceoryx2::prelude::{
    CallbackProgression, LogLevel, Node, NodeBuilder, NodeState, SignalHandlingMode, set_log_level_from_env_or,
};

use crate::cleanup;
use crate::error::ServiceError;
use crate::fork_guard::ForkGuard;
use crate::lock::NamespaceLock;
use crate::namespace::{Ipc, Namespace};
use crate::status_file;

/// This process's node in a namespace. Must be dropped after all ports that were created with it.
pub(crate) struct NamespaceNode {
    node: ForkGuard<Node<Ipc>>,
    root: PathBuf,
}

impl NamespaceNode {
    /// Registers this process in the namespace. Also removes what dead processes left there.
    pub(crate) fn join(namespace: &Namespace) -> Result<Self, ServiceError> {
        set_log_level_from_env_or(LogLevel::Error);
        let config = namespace.prepare()?;
        cleanup::remove_unsized_segments(&config);
        status_file::remove_abandoned(namespace.prefix());
        let node = NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create()
            .map_err(|e| ServiceError::middleware("cannot register this process")(e.to_string()))?;
        let node = NamespaceNode { node: ForkGuard::new(node), root: namespace.root().to_owned() };
        node.remove_dead_nodes();
        if let Some(lock) = NamespaceLock::try_acquire(&node.root) {
            cleanup::remove_incomplete_services(&config, &lock);
        }
        cleanup::remove_incomplete_nodes(&config);
        Ok(node)
    }

    /// The namespace's directory.
    pub(crate) fn root(&self) -> &Path {
        &self.root
    }

    /// Removes the resources of processes that have died, and returns the number of these processes. Does nothing while another
    /// process holds the namespace's lock.
    pub(crate) fn remove_dead_nodes(&self) -> usize {
        let mut dead = Vec::new();
        let listed = Node::<Ipc>::list(self.config(), |state| {
            if let NodeState::Dead(node) = state {
                dead.push(node);
            }
            CallbackProgression::Continue
        });
        if let Err(e) = listed {
            tracing::debug!(error = %e, "cannot list the nodes");
        }
        if dead.is_empty() {
            return 0;
        }
        // Before iceoryx2 opens the dead nodes' segments: it would wait forever for one without a size.
        cleanup::remove_unsized_segments(self.config());
        let Some(_lock) = NamespaceLock::try_acquire(&self.root) else { return 0 };
        let mut removed = 0;
        for node in dead.into_iter().filter(|node| node.details().is_some()) {
            let process = node.details().as_ref().map(|details| details.process_id().value());
            match node.try_remove_stale_resources() {
                Ok(_) => {
                    tracing::info!(process, "removed the resources of a process that has died");
                    removed += 1;
                }
                Err(e) => tracing::debug!(error = %e, "cannot remove a dead node"),
            }
        }
        removed
    }

    /// Whether the process that owns a node is running. `false` is certain; a node whose state cannot be read counts as running.
    pub(crate) fn is_alive(&self, node: UniqueNodeId) -> bool {
        !matches!(Node::<Ipc>::state_of(self.config(), node), Ok(None | Some(NodeState::Dead(_))))
    }

    /// The process id of the owner of a running node.
    pub(crate) fn process_id_of(&self, node: UniqueNodeId) -> Option<u32> {
        match Node::<Ipc>::state_of(self.config(), node) {
            Ok(Some(NodeState::Alive(view))) => {
                view.details().as_ref().and_then(|details| u32::try_from(details.process_id().value()).ok())
            }
            _ => None,
        }
    }
}

impl Deref for NamespaceNode {
    type Target = Node<Ipc>;

    fn deref(&self) -> &Node<Ipc> {
        &self.node
    }
}

impl Drop for NamespaceNode {
    fn drop(&mut self) {
        let config = self.config().clone();
        // Without the lock, another process may be creating the files that look like orphans.
        if self.node.drop_now()
            && let Some(lock) = NamespaceLock::try_acquire(&self.root)
        {
            cleanup::remove_orphans(&config, &lock);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};
    use std::time::SystemTime;

    use super::*;

    #[test]
    fn orphans_are_kept_while_another_process_holds_the_lock() {
        let root = PathBuf::from(format!("/tmp/endless-node-{}", std::process::id()));
        let namespace = Namespace::at(&root);
        let node = NamespaceNode::join(&namespace).unwrap();
        let orphan = root.join(format!("{}orphan", namespace.prefix()));
        File::create(&orphan).unwrap().set_modified(SystemTime::UNIX_EPOCH).unwrap();
        let lock = NamespaceLock::acquire(&root).unwrap();
        drop(node);
        assert!(orphan.exists());
        drop(lock);
        drop(NamespaceNode::join(&namespace).unwrap());
        assert!(!orphan.exists());
        fs::remove_dir_all(&root).unwrap();
    }
}
