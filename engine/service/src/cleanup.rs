//! Removes resources that iceoryx2 cannot remove: those of processes that died while they joined or left a namespace.
//!
//! iceoryx2 removes the resources of a dead process by the records that the process kept. A process that is killed between two
//! steps of its start or end leaves resources that iceoryx2 ignores or waits for forever:
//!
//! - **unsized segments**: created, but not resized yet. iceoryx2 waits without a timeout for the size, so they are removed
//!   first;
//! - **incomplete nodes and services**: a node without details, or a service whose static configuration is not finished;
//! - **orphans**: segments and sockets that no record names. They are recognised once a namespace has no nodes.
//!
//! In addition, the shared counter that numbers the nodes remains after a regular end.

use std::collections::HashSet;
use std::ffi::OsStr;
use std::fs::{self, Metadata};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use iceoryx2::node::NodeView;
use iceoryx2::prelude::{CallbackProgression, Config, Node, NodeState, SemanticString};

use crate::lock::NamespaceLock;
use crate::namespace::Ipc;

const SEGMENTS: &str = "/dev/shm";

/// Age from which an unsized segment counts as abandoned. Creating and resizing one takes microseconds.
const UNSIZED_SEGMENT_AGE: Duration = Duration::from_millis(500);

/// Age from which an incomplete service counts as abandoned. Creating one takes milliseconds.
const INCOMPLETE_SERVICE_AGE: Duration = Duration::from_secs(1);

/// Age from which an incomplete node or an orphan counts as abandoned. Creating a node takes milliseconds.
const INCOMPLETE_NODE_AGE: Duration = Duration::from_secs(10);

/// Removes unsized segments. Waits until the younger ones reach [`UNSIZED_SEGMENT_AGE`]: on return, no process that was dead
/// before the call has an unsized segment.
pub(crate) fn remove_unsized_segments(config: &Config) {
    let prefix = config.global.prefix.as_bytes();
    for segment in entries(Path::new(SEGMENTS)).into_iter().filter(|path| is_named(path, prefix)) {
        let is_unsized = || metadata(&segment).filter(|data| data.len() == 0);
        let Some(data) = is_unsized() else { continue };
        std::thread::sleep(UNSIZED_SEGMENT_AGE.saturating_sub(age(&data)));
        if is_unsized().is_some() {
            remove(&segment);
        }
    }
}

/// Removes incomplete services, which block their names. The lock keeps an engine from creating a service of the same
/// name between the check and the removal.
pub(crate) fn remove_incomplete_services(config: &Config, _lock: &NamespaceLock) {
    for path in entries(&directory(&config.global.service_dir())) {
        // iceoryx2 makes a static configuration read-only when it is finished.
        if metadata(&path)
            .is_some_and(|data| data.permissions().mode() & 0o200 != 0 && age(&data) >= INCOMPLETE_SERVICE_AGE)
        {
            remove(&path);
        }
    }
}

/// Removes incomplete nodes.
pub(crate) fn remove_incomplete_nodes(config: &Config) {
    let mut dead = HashSet::new();
    let mut complete = HashSet::new();
    let listed = Node::<Ipc>::list(config, |state| {
        let number = state.node_id().value().to_string();
        match &state {
            NodeState::Dead(view) if view.details().is_none() => dead.insert(number),
            NodeState::Undefined(_) => false,
            NodeState::Alive(_) | NodeState::Dead(_) | NodeState::Inaccessible(_) => complete.insert(number),
        };
        CallbackProgression::Continue
    });
    if listed.is_err() {
        return;
    }
    for path in entries(&directory(&config.global.node_dir())) {
        let Some(number) = node_number(&path, config.global.prefix.as_bytes()) else { continue };
        if dead.contains(&number) || (!complete.contains(&number) && is_old(&path)) {
            remove(&path);
        }
    }
}

/// Removes the node counter and all orphans if the namespace has no nodes, neither running nor dead.
///
/// The counter may restart at zero: a node's id also contains its process id and its start time. Orphans are recognised by their
/// age, so that the resources of a node that joins in the meantime are kept. The lock keeps an engine from creating a service
/// between the check and the removal.
pub(crate) fn remove_orphans(config: &Config, _lock: &NamespaceLock) {
    let mut is_empty = true;
    let listed = Node::<Ipc>::list(config, |_| {
        is_empty = false;
        CallbackProgression::Stop
    });
    if listed.is_err() || !is_empty {
        return;
    }
    let prefix = config.global.prefix.as_bytes();
    let directories =
        [PathBuf::from(SEGMENTS), directory(config.global.root_path()), directory(&config.global.service_dir())];
    for path in directories.iter().flat_map(|directory| entries(directory)).filter(|path| is_named(path, prefix)) {
        if path.as_os_str().as_bytes().ends_with(b".global_mgmt") || is_old(&path) {
            remove(&path);
        }
    }
}

/// The number of the node that a file or directory belongs to: `NUMBER`, or `PREFIX NUMBER .node_monitor...`.
fn node_number(path: &Path, prefix: &[u8]) -> Option<String> {
    let name = path.file_name()?.as_bytes();
    let name = std::str::from_utf8(name.strip_prefix(prefix).unwrap_or(name)).ok()?;
    let number = name.split('.').next()?;
    (!number.is_empty() && number.bytes().all(|digit| digit.is_ascii_digit())).then(|| number.to_owned())
}

fn directory(path: &iceoryx2::prelude::Path) -> PathBuf {
    PathBuf::from(OsStr::from_bytes(path.as_bytes()))
}

fn entries(directory: &Path) -> Vec<PathBuf> {
    fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path()).collect()
}

fn is_named(path: &Path, prefix: &[u8]) -> bool {
    path.file_name().is_some_and(|name| name.as_bytes().starts_with(prefix))
}

fn metadata(path: &Path) -> Option<Metadata> {
    fs::symlink_metadata(path).ok()
}

/// Time since the last modification; zero if the clock was set back since then.
fn age(data: &Metadata) -> Duration {
    data.modified().ok().and_then(|at| at.elapsed().ok()).unwrap_or_default()
}

fn is_old(path: &Path) -> bool {
    metadata(path).is_some_and(|data| age(&data) >= INCOMPLETE_NODE_AGE)
}

fn remove(path: &Path) {
    tracing::debug!(path = %path.display(), "removing a resource of a dead process");
    // An error means that another process has removed it.
    let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
}

#[cfg(test)]
mod tests {
    use std::fs::{File, Permissions};
    use std::time::{Instant, SystemTime};

    use iceoryx2::prelude::FileName;

    use super::*;

    /// A namespace in a directory of its own, without nodes.
    fn empty_namespace(name: &str) -> (PathBuf, Config) {
        let root = PathBuf::from(format!("/tmp/endless-sweep-{name}-{}", std::process::id()));
        let mut config = Config::default();
        config.global.set_root_path(&iceoryx2::prelude::Path::new(root.as_os_str().as_bytes()).unwrap());
        config.global.prefix = FileName::new(format!("e{name}{}_", std::process::id()).as_bytes()).unwrap();
        fs::create_dir_all(root.join("services")).unwrap();
        fs::create_dir_all(root.join("nodes")).unwrap();
        (root, config)
    }

    fn file(directory: &Path, config: &Config, name: &str, mode: u32, seconds: u64) -> PathBuf {
        let path = directory.join(format!("{}{name}", config.global.prefix));
        let file = File::create(&path).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_secs(seconds)).unwrap();
        fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
        path
    }

    #[test]
    fn files_of_nodes_are_recognised() {
        let number = |name: &str| node_number(&Path::new("/tmp").join(name), b"e1_");
        assert_eq!(number("123").as_deref(), Some("123"));
        assert_eq!(number("e1_123.node_monitor_owner_lock").as_deref(), Some("123"));
        assert_eq!(number("e2_123.node_monitor"), None);
        assert_eq!(number("e1_.node_monitor"), None);
        assert_eq!(number("notes.txt"), None);
    }

    #[test]
    fn incomplete_resources_are_removed_when_they_are_old() {
        let (root, config) = empty_namespace("stub");
        let services = root.join("services");
        let [finished, begun, stuck] =
            [("a", 0o400, 60), ("b", 0o600, 0), ("c", 0o600, 60)].map(|(n, m, s)| file(&services, &config, n, m, s));
        let nodes = root.join("nodes");
        let [young, old] = [("1", 1), ("2", 60)].map(|(n, s)| file(&nodes, &config, n, 0o600, s));
        let lock = NamespaceLock::acquire(&root).unwrap();
        remove_incomplete_services(&config, &lock);
        remove_incomplete_nodes(&config);
        assert!(finished.exists() && begun.exists() && !stuck.exists());
        assert!(young.exists() && !old.exists());
        remove_orphans(&config, &lock);
        assert!(!finished.exists() && begun.exists(), "old resources of an empty namespace are orphans");
        fs::remove_dir_all(&root).unwrap();
    }

    #[test]
    fn unsized_segments_are_removed_when_they_are_old() {
        let (root, config) = empty_namespace("size");
        let segments = Path::new(SEGMENTS);
        let [old, young, sized] = ["old", "young", "sized"].map(|name| file(segments, &config, name, 0o600, 0));
        File::options().write(true).open(&old).unwrap().set_modified(SystemTime::UNIX_EPOCH).unwrap();
        fs::write(&sized, "x").unwrap();
        let start = Instant::now();
        remove_unsized_segments(&config);
        assert!(!old.exists() && !young.exists() && sized.exists());
        assert!(start.elapsed() >= UNSIZED_SEGMENT_AGE / 2);
        fs::remove_file(sized).unwrap();
        fs::remove_dir_all(&root).unwrap();
    }
}
