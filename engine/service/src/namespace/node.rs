//! The iceoryx2 node of this process in a namespace, and the state of other processes' nodes.

use std::collections::HashSet;
use std::fs;
use std::ops::Deref;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::node::{DeadNodeView, NodeDetails, NodeView};
use iceoryx2::prelude::{
    CallbackProgression, Config, LogLevel, Node, NodeBuilder, NodeState, SignalHandlingMode, set_log_level_from_env_or,
};

use crate::error::ServiceError;
use crate::namespace::directory::{Ipc, Namespace};
use crate::namespace::fork_guard::ForkGuard;
use crate::namespace::identity::{CreationLock, Identity};
use crate::namespace::lock::{LOCK_TIMEOUT, NamespaceLock};
use crate::namespace::members::{self, Membership};
use crate::namespace::{cleanup, descriptors, iceoryx_files, memory, segments};
use crate::os::process;

/// How many times a process tries to join a namespace whose directory is removed meanwhile.
const JOIN_ATTEMPTS: usize = 5;

/// How long a process waits for the lock when it leaves the namespace.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(1);

/// This process's node in a namespace. Must be dropped after all ports that were created with it.
pub(crate) struct NamespaceNode {
    node: ForkGuard<Node<Ipc>>,
    identity: Identity,
    membership: Option<Membership>,
    root: PathBuf,
    /// How long this process waits for the namespace's lock.
    patience: Duration,
    /// The dead nodes whose segments are damaged so that iceoryx2 panics: the first process that is alone in the namespace removes them.
    damaged: Mutex<HashSet<u128>>,
}

impl NamespaceNode {
    /// Registers this process in the namespace. Also removes what dead processes left there. Waits for the namespace's lock up to
    /// `patience`, and at least [`LOCK_TIMEOUT`].
    pub(crate) fn join(namespace: &Namespace, patience: Duration) -> Result<Self, ServiceError> {
        set_log_level_from_env_or(LogLevel::Error);
        let patience = patience.max(LOCK_TIMEOUT);
        let mut attempts = 1;
        loop {
            namespace.prepare()?;
            let joined = NamespaceLock::acquire_within(namespace.root(), patience)
                .and_then(|lock| Self::join_locked(namespace, patience, &lock));
            match joined {
                Err(ServiceError::RootRemoved { .. }) if attempts < JOIN_ATTEMPTS => attempts += 1,
                joined => return joined,
            }
        }
    }

    fn join_locked(namespace: &Namespace, patience: Duration, lock: &NamespaceLock) -> Result<Self, ServiceError> {
        if memory::check_free(memory::NODE_BYTES).is_err() {
            // Dead processes may occupy the memory, and iceoryx2 needs some to remove them.
            members::remove_abandoned(namespace, None);
        }
        if let Some(identity) = Identity::existing(namespace).filter(|identity| !members::is_used(identity.prefix())) {
            // iceoryx2 cannot remove dead processes whose segments are damaged, as of one that was ended by SIGBUS.
            cleanup::remove_all_unless_used(&namespace.config(identity.prefix())?, lock);
        }
        memory::check_free(memory::NODE_BYTES)?;
        descriptors::reserve(descriptors::NODE)?;
        let (identity, config) = own_identity(namespace, lock)?;
        let membership = Membership::join(identity.prefix(), lock)?;
        members::remove_abandoned(namespace, Some(identity.prefix()));
        segments::remove_abandoned_status(identity.prefix());
        cleanup::remove_counter(&config, lock)?;
        let node = NodeBuilder::new().config(&config).signal_handling_mode(SignalHandlingMode::Disabled).create();
        cleanup::remove_counter(&config, lock)?;
        let node = node.map_err(ServiceError::middleware("cannot register this process"))?;
        let root = namespace.root().to_owned();
        let (node, membership, damaged) = (ForkGuard::new(node), Some(membership), Mutex::default());
        let node = NamespaceNode { node, identity, membership, root, patience, damaged };
        node.clean(lock);
        Ok(node)
    }

    /// The namespace's lock.
    pub(crate) fn lock(&self) -> Result<NamespaceLock, ServiceError> {
        self.lock_within(self.patience)
    }

    /// The namespace's lock. Waits for it up to `timeout`.
    pub(crate) fn lock_within(&self, timeout: Duration) -> Result<NamespaceLock, ServiceError> {
        let lock = NamespaceLock::acquire_within(&self.root, timeout)?;
        self.identity.check()?;
        Ok(lock)
    }

    /// The prefix of the names of the namespace's files in shared memory.
    pub(crate) fn prefix(&self) -> &str {
        self.identity.prefix()
    }

    /// The lock under which services and ports are created; see [`crate::namespace::identity`].
    pub(crate) fn creating(&self) -> Result<CreationLock, ServiceError> {
        self.identity.creating()
    }

    /// Fails if the namespace's directory, or this process's file in it, was removed or replaced since this process joined.
    pub(crate) fn check_root(&self) -> Result<(), ServiceError> {
        self.identity.check()?;
        if iceoryx_files::context_file(self.id(), self.config()).exists() {
            Ok(())
        } else {
            Err(ServiceError::RootRemoved { path: self.root.clone() })
        }
    }

    /// Sets the times of all files of the namespace to now, since programs that clean up `/tmp` remove files that are
    /// days old.
    pub(crate) fn refresh_files(&self) {
        cleanup::refresh(self.config());
    }

    /// Removes the resources of processes that have died, and returns the number of these processes. Does nothing while another
    /// process holds the namespace's lock.
    pub(crate) fn remove_dead_nodes(&self) -> usize {
        if !self.dead_nodes().is_empty()
            && self.check_root().is_ok()
            && let Some(lock) = NamespaceLock::try_acquire(&self.root)
        {
            return self.clean(&lock);
        }
        0
    }

    /// Removes the complete and incomplete resources of processes that have died. Returns the number of processes.
    pub(crate) fn clean(&self, lock: &NamespaceLock) -> usize {
        // Listed before the segments are examined, so that everything these processes left is there by then.
        let dead = self.dead_nodes();
        let all = self.identity.try_exclusive(lock);
        if let Some(all) = &all {
            cleanup::remove_unsized_segments(self.config(), lock, all);
        }
        let mut removed = 0;
        for node in dead.into_iter().filter(|node| node.details().is_some()) {
            // Checked for each node, since iceoryx2 waits forever for the size of an unsized segment, and a process may
            // leave one at any time.
            if cleanup::has_unsized_segments(self.config()) {
                break;
            }
            let process = node.details().as_ref().map(|details| details.process_id().value());
            // To announce the removal, iceoryx2 creates a node, which needs shared memory.
            if let Err(e) = memory::check_free(memory::NODE_BYTES) {
                tracing::debug!(process, error = %e, "cannot remove the resources of a process that has died yet");
                break;
            }
            let number = node.id().value();
            if self.damaged().contains(&number) {
                continue;
            }
            match catch_unwind(AssertUnwindSafe(|| node.try_remove_stale_resources())) {
                Ok(Ok(_)) => {
                    tracing::info!(process, "removed the resources of a process that has died");
                    removed += 1;
                }
                Ok(Err(e)) => tracing::debug!(error = %e, "cannot remove a dead node"),
                Err(_) => drop(self.damaged().insert(number)),
            }
        }
        cleanup::remove_incomplete_nodes(self.config(), lock);
        if let Some(all) = &all {
            cleanup::remove_incomplete_services(self.config(), lock, all);
        }
        removed
    }

    fn damaged(&self) -> MutexGuard<'_, HashSet<u128>> {
        self.damaged.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn dead_nodes(&self) -> Vec<DeadNodeView<Ipc>> {
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
        dead
    }

    /// Whether the process that owns a node is running. `false` is certain; a node whose state cannot be read counts as running.
    pub(crate) fn is_alive(&self, node: UniqueNodeId) -> bool {
        match Node::<Ipc>::state_of(self.config(), node) {
            Ok(None | Some(NodeState::Dead(_))) => false,
            Ok(Some(NodeState::Alive(view))) => !self.is_dead_relative(node, view.details().as_ref()),
            _ => true,
        }
    }

    /// Whether a node that counts as running belongs to a dead parent of this process, or to a dead child of the same
    /// parent. iceoryx2 identifies a process by a number that forked processes inherit, so it takes the nodes of all of
    /// them for those of this process.
    fn is_dead_relative(&self, node: UniqueNodeId, details: Option<&NodeDetails>) -> bool {
        let Some(pid) = details.and_then(|details| u32::try_from(details.process_id().value()).ok()) else {
            return false;
        };
        let number = |node: &UniqueNodeId| fs::read(iceoryx_files::context_file(node, self.config())).ok();
        pid != std::process::id()
            && number(&node).is_some_and(|number_of| Some(number_of) == number(self.id()))
            && !process::runs(pid)
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
        if !self.node.is_owner() {
            return;
        }
        let config = self.config().clone();
        let lock = self.lock_within(LEAVE_TIMEOUT);
        self.node.drop_now();
        // Without the lock, another process may be creating the files that look like orphans.
        if let Ok(lock) = &lock
            && let Some(all) = self.identity.try_exclusive(lock)
            && cleanup::remove_orphans(&config, lock, &all)
        {
            self.identity.remove(lock, &all);
        }
        // No process can join under this prefix again.
        if let Err(ServiceError::RootRemoved { .. }) = lock {
            drop(self.membership.take());
            members::remove_if_unused(self.identity.prefix());
        }
    }
}

/// The identity of the namespace and iceoryx2's configuration. If another user has used the namespace's prefix, the
/// namespace gets a new one, unless processes use it.
fn own_identity(namespace: &Namespace, lock: &NamespaceLock) -> Result<(Identity, Config), ServiceError> {
    let mut renewed = false;
    loop {
        let identity = Identity::read_or_create(namespace, lock)?;
        let config = namespace.config(identity.prefix())?;
        let Some((path, owner)) = cleanup::foreign_segment(&config) else { return Ok((identity, config)) };
        match identity.try_exclusive(lock) {
            Some(all) if !renewed && cleanup::remove_orphans(&config, lock, &all) => {
                identity.remove(lock, &all);
                renewed = true;
            }
            _ => return Err(ServiceError::ForeignSegment { path, owner, root: namespace.root().to_owned() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use super::*;

    #[test]
    fn orphans_are_kept_while_another_process_holds_the_lock() {
        let root = PathBuf::from(format!("/tmp/endless-node-{}", std::process::id()));
        let namespace = Namespace::at(&root);
        let node = NamespaceNode::join(&namespace, Duration::ZERO).unwrap();
        let orphan = root.join(format!("{}orphan", node.identity.prefix()));
        File::create(&orphan).unwrap();
        let lock = NamespaceLock::acquire(&root).unwrap();
        drop(node);
        assert!(orphan.exists());
        drop(lock);
        drop(NamespaceNode::join(&namespace, Duration::ZERO).unwrap());
        assert!(!orphan.exists());
        assert_eq!(fs::read_dir(&root).unwrap().count(), 0);
        fs::remove_dir_all(&root).unwrap();
    }
}
