//! Removes resources that iceoryx2 cannot remove, left by processes that died while they joined or left a namespace.
//!
//! iceoryx2 finds the resources of a dead process in the records that the process kept. A process killed while it
//! starts or ends leaves resources that iceoryx2 ignores or waits for forever:
//!
//! - **unsized segments**: created, but not resized yet. iceoryx2 waits for the size without a timeout, so they are
//!   removed first;
//! - **incomplete nodes and services**: a node without details, or a service whose static configuration is not finished;
//! - **orphans**: segments and sockets in no record, which can be recognised once a namespace has no nodes;
//! - **the node counter**: a segment that iceoryx2 needs while it creates a node, and leaves behind.
//!
//! A living process may stay in such a state indefinitely if it is stopped. Nodes are created under the namespace's
//! lock, services and ports under the creation lock ([`crate::namespace::identity`]). Each function takes the locks
//! that prove that no living process is creating what it removes.

use std::collections::HashSet;
use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use iceoryx2::node::NodeView;
use iceoryx2::prelude::{CallbackProgression, Config, Node, NodeState};
use rustix::fs::{AtFlags, CWD, Timespec, Timestamps, UTIME_NOW, utimensat};

use crate::error::ServiceError;
use crate::namespace::directory::Ipc;
use crate::namespace::iceoryx_files as files;
use crate::namespace::identity::ExclusiveCreation;
use crate::namespace::lock::NamespaceLock;

/// Whether the namespace has an unsized segment.
pub(crate) fn has_unsized_segments(config: &Config) -> bool {
    unsized_segments(config).next().is_some()
}

/// Removes unsized segments.
pub(crate) fn remove_unsized_segments(config: &Config, _lock: &NamespaceLock, _all: &ExclusiveCreation) {
    unsized_segments(config).for_each(|segment| remove(&segment));
}

fn unsized_segments(config: &Config) -> impl Iterator<Item = PathBuf> {
    files::segments(config).filter(|path| files::is_unsized(path))
}

/// A segment of the namespace that belongs to another user, and that user.
pub(crate) fn foreign_segment(config: &Config) -> Option<(PathBuf, u32)> {
    let user = rustix::process::getuid().as_raw();
    files::segments(config).find_map(|path| {
        let owner = fs::symlink_metadata(&path).ok()?.uid();
        (owner != user).then_some((path, owner))
    })
}

/// Removes the node counter, which is needed only while a node is created, under the lock; node ids stay unique, since they
/// also contain the process id and the start time. The counter is writable by all users, and one left by a process that
/// died halfway is unusable, so it is kept only while a node is created.
pub(crate) fn remove_counter(config: &Config, _lock: &NamespaceLock) -> Result<(), ServiceError> {
    for path in files::segments(config).filter(|path| files::is_node_counter(path)) {
        match fs::remove_file(&path) {
            Err(e) if e.kind() != ErrorKind::NotFound => {
                return Err(ServiceError::file("cannot remove the counter of nodes", &path)(e));
            }
            _ => {}
        }
    }
    Ok(())
}

/// Removes incomplete services, which block their names.
pub(crate) fn remove_incomplete_services(config: &Config, _lock: &NamespaceLock, _all: &ExclusiveCreation) {
    files::services(config).filter(|path| files::is_unfinished_service(path)).for_each(|path| remove(&path));
}

/// Removes incomplete nodes.
pub(crate) fn remove_incomplete_nodes(config: &Config, _lock: &NamespaceLock) {
    let mut complete = HashSet::new();
    let listed = Node::<Ipc>::list(config, |state| {
        let is_complete = match &state {
            NodeState::Dead(view) => view.details().is_some(),
            NodeState::Undefined(_) => false,
            NodeState::Alive(_) | NodeState::Inaccessible(_) => true,
        };
        if is_complete {
            complete.insert(state.node_id().value().to_string());
        }
        CallbackProgression::Continue
    });
    if listed.is_err() {
        return;
    }
    for path in files::entries(&files::node_directory(config)) {
        let number = files::node_number(&path, config);
        if number.is_some_and(|number| !complete.contains(&number)) {
            remove(&path);
        }
    }
}

/// Removes everything if the namespace has no nodes, neither running nor dead. Returns whether it had none.
pub(crate) fn remove_orphans(config: &Config, _lock: &NamespaceLock, _all: &ExclusiveCreation) -> bool {
    let mut is_empty = true;
    let listed = Node::<Ipc>::list(config, |_| {
        is_empty = false;
        CallbackProgression::Stop
    });
    if listed.is_err() || !is_empty {
        return false;
    }
    remove_files(config);
    // Directories that are not empty stay.
    let _ = (fs::remove_dir(files::service_directory(config)), fs::remove_dir(files::node_directory(config)));
    true
}

/// Removes everything, unless a process uses the namespace whose shared memory is not this one's, as in another container. The caller
/// knows that no other process does.
pub(crate) fn remove_all_unless_used(config: &Config, _lock: &NamespaceLock) {
    let mut is_used = false;
    let listed = Node::<Ipc>::list(config, |state| {
        is_used |= matches!(state, NodeState::Alive(_) | NodeState::Inaccessible(_));
        CallbackProgression::Continue
    });
    if listed.is_err() || is_used {
        return;
    }
    remove_files(config);
    for directory in [files::service_directory(config), files::node_directory(config)] {
        if directory.exists() {
            remove(&directory);
        }
    }
}

/// Removes the segments, the sockets and the services.
fn remove_files(config: &Config) {
    let all = files::root_files(config).chain(files::services(config)).chain(files::segments(config));
    all.for_each(|path| remove(&path));
}

/// Sets the times of all files in the namespace's directory to now.
pub(crate) fn refresh(config: &Config) {
    let now = Timespec { tv_sec: 0, tv_nsec: UTIME_NOW };
    let now = Timestamps { last_access: now, last_modification: now };
    let nodes = files::node_directory(config);
    let of_nodes = files::entries(&nodes).flat_map(|path| files::entries(&path));
    let all = [files::root_directory(config), files::service_directory(config), nodes.clone()];
    for path in all.iter().flat_map(|path| files::entries(path)).chain(of_nodes) {
        if let Err(e) = utimensat(CWD, &path, &now, AtFlags::SYMLINK_NOFOLLOW) {
            tracing::debug!(error = %e, path = %path.display(), "cannot set the times of a file");
        }
    }
}

fn remove(path: &Path) {
    tracing::debug!(path = %path.display(), "removing a resource of a dead process");
    // An error means that another process has removed it.
    let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
}

#[cfg(test)]
mod tests {
    use std::fs::{File, Permissions};
    use std::os::unix::fs::PermissionsExt;
    use std::time::SystemTime;

    use super::*;
    use crate::namespace::directory::Namespace;
    use crate::namespace::identity::Identity;
    use crate::namespace::segments::DIRECTORY;

    /// A new namespace without nodes.
    fn empty_namespace(name: &str) -> (Namespace, Config, Identity, NamespaceLock) {
        let namespace = Namespace::at(format!("/tmp/endless-sweep-{name}-{}", std::process::id()));
        namespace.prepare().unwrap();
        let lock = NamespaceLock::acquire(namespace.root()).unwrap();
        let identity = Identity::read_or_create(&namespace, &lock).unwrap();
        let config = namespace.config(identity.prefix()).unwrap();
        fs::create_dir(namespace.root().join("services")).unwrap();
        fs::create_dir(namespace.root().join("nodes")).unwrap();
        (namespace, config, identity, lock)
    }

    fn file(directory: &Path, config: &Config, name: &str, mode: u32) -> PathBuf {
        let path = directory.join(format!("{}{name}", config.global.prefix));
        File::create(&path).unwrap();
        fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
        path
    }

    /// All files are new: removal does not depend on their age.
    #[test]
    fn incomplete_resources_are_removed_under_the_locks() {
        let (namespace, config, identity, lock) = empty_namespace("stub");
        let [services, nodes] = ["services", "nodes"].map(|name| namespace.root().join(name));
        let [finished, begun] = [("a", 0o400), ("b", 0o600)].map(|(name, mode)| file(&services, &config, name, mode));
        let node = file(&nodes, &config, "1.node_monitor_context", 0o200);
        fs::create_dir(nodes.join("1")).unwrap();
        let segments = Path::new(DIRECTORY);
        let [empty, sized, counter] =
            ["empty", "sized", ".global_mgmt"].map(|name| file(segments, &config, name, 0o200));
        fs::write(&sized, "x").unwrap();

        let creating = identity.creating().unwrap();
        assert!(identity.try_exclusive(&lock).is_none() && has_unsized_segments(&config));
        drop(creating);
        let all = identity.try_exclusive(&lock).unwrap();
        File::options().write(true).open(&begun).unwrap().set_modified(SystemTime::UNIX_EPOCH).unwrap();
        refresh(&config);
        assert!(fs::metadata(&begun).unwrap().modified().unwrap() > SystemTime::UNIX_EPOCH);
        remove_counter(&config, &lock).unwrap();
        assert!(empty.exists() && !counter.exists());
        remove_unsized_segments(&config, &lock, &all);
        assert!(!empty.exists() && sized.exists());
        remove_incomplete_services(&config, &lock, &all);
        remove_incomplete_nodes(&config, &lock);
        assert!(finished.exists() && !begun.exists() && !node.exists() && !nodes.join("1").exists());
        assert!(remove_orphans(&config, &lock, &all));
        assert!(!finished.exists() && !sized.exists() && !services.exists() && !nodes.exists());
        fs::remove_dir_all(namespace.root()).unwrap();
    }
}
