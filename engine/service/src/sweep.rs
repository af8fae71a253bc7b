//! Removing what the middleware cannot: the remains of processes that died while they were joining or leaving a namespace.
//!
//! The middleware removes what dead processes leave by the records that they keep of themselves. A process that is killed
//! between two steps of that leaves remains which are skipped for ever, or worse:
//!
//! - a **segment without a size**, made and not sized yet. The middleware waits for its size without end, so these go first;
//! - a **stub**: a member without its description, or a service whose description was begun. Every look at the members passes it;
//! - **strays**: segments and sockets that no record names. They are known as such once a namespace has no members.
//!
//! Also, the counter that numbers members stays in shared memory even if all goes well.

use std::collections::HashSet;
use std::ffi::OsStr;
use std::fs::{self, Metadata};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use iceoryx2::node::NodeView;
use iceoryx2::prelude::{CallbackProgression, Config, Node, NodeState, SemanticString};

use super::node::Ipc;

const SEGMENTS: &str = "/dev/shm";

/// After this time a segment that has no size yet will not get one. It takes microseconds.
const UNSIZED: Duration = Duration::from_millis(500);

/// After this time a service whose description was begun will not be finished. It takes milliseconds.
const BEGUN: Duration = Duration::from_secs(1);

/// After this time a process that has not finished joining is taken for dead. It takes milliseconds.
const UNFINISHED: Duration = Duration::from_secs(10);

/// Removes segments without a size. Waits for those that are too young to tell, so that afterwards no segment of a process
/// that was dead before is without a size.
pub(super) fn unsized_segments(config: &Config) {
    let prefix = config.global.prefix.as_bytes();
    for segment in entries(Path::new(SEGMENTS)).into_iter().filter(|path| is_named(path, prefix)) {
        let is_unsized = || metadata(&segment).filter(|data| data.len() == 0);
        let Some(data) = is_unsized() else { continue };
        std::thread::sleep(UNSIZED.saturating_sub(age(&data)));
        if is_unsized().is_some() {
            remove(&segment);
        }
    }
}

/// Removes stubs of services. They keep their name taken.
pub(super) fn services(config: &Config) {
    for path in entries(&directory(&config.global.service_dir())) {
        // A description becomes read-only when it is finished.
        if metadata(&path).is_some_and(|data| data.permissions().mode() & 0o200 != 0 && age(&data) >= BEGUN) {
            remove(&path);
        }
    }
}

/// Removes stubs of members.
pub(super) fn members(config: &Config) {
    let mut dead = HashSet::new();
    let mut whole = HashSet::new();
    let listed = Node::<Ipc>::list(config, |state| {
        let number = state.node_id().value().to_string();
        match &state {
            NodeState::Dead(view) if view.details().is_none() => dead.insert(number),
            NodeState::Undefined(_) => false,
            NodeState::Alive(_) | NodeState::Dead(_) | NodeState::Inaccessible(_) => whole.insert(number),
        };
        CallbackProgression::Continue
    });
    if listed.is_err() {
        return;
    }
    for path in entries(&directory(&config.global.node_dir())) {
        let Some(number) = member_number(&path, config.global.prefix.as_bytes()) else { continue };
        if dead.contains(&number) || (!whole.contains(&number) && is_old(&path)) {
            remove(&path);
        }
    }
}

/// Removes the counter and strays if the namespace has no members, dead ones included.
///
/// Nothing is confused when the counter starts over, since the number is one part of a member's identity beside process and
/// time. A stray is recognised by its age: what a member owns that has joined in the meantime is young.
pub(super) fn deserted(config: &Config) {
    let mut is_deserted = true;
    let listed = Node::<Ipc>::list(config, |_| {
        is_deserted = false;
        CallbackProgression::Stop
    });
    if listed.is_err() || !is_deserted {
        return;
    }
    let prefix = config.global.prefix.as_bytes();
    let places =
        [PathBuf::from(SEGMENTS), directory(config.global.root_path()), directory(&config.global.service_dir())];
    for path in places.iter().flat_map(|place| entries(place)).filter(|path| is_named(path, prefix)) {
        if path.as_os_str().as_bytes().ends_with(b".global_mgmt") || is_old(&path) {
            remove(&path);
        }
    }
}

/// The member that a file or directory belongs to: `NUMBER`, or `PREFIX NUMBER .node_monitor...`.
fn member_number(path: &Path, prefix: &[u8]) -> Option<String> {
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

/// Time since the last change; zero if the clock was set back since.
fn age(data: &Metadata) -> Duration {
    data.modified().ok().and_then(|at| at.elapsed().ok()).unwrap_or_default()
}

fn is_old(path: &Path) -> bool {
    metadata(path).is_some_and(|data| age(&data) >= UNFINISHED)
}

fn remove(path: &Path) {
    tracing::debug!(path = %path.display(), "removing the remains of a dead process");
    // Whoever else is at it does the same.
    let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
}

#[cfg(test)]
mod tests {
    use std::fs::{File, Permissions};
    use std::time::{Instant, SystemTime};

    use iceoryx2::prelude::FileName;

    use super::*;

    /// A namespace in a directory of its own, without members.
    fn place(name: &str) -> (PathBuf, Config) {
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
    fn files_of_members_are_recognised() {
        let number = |name: &str| member_number(&Path::new("/tmp").join(name), b"e1_");
        assert_eq!(number("123").as_deref(), Some("123"));
        assert_eq!(number("e1_123.node_monitor_owner_lock").as_deref(), Some("123"));
        assert_eq!(number("e2_123.node_monitor"), None);
        assert_eq!(number("e1_.node_monitor"), None);
        assert_eq!(number("notes.txt"), None);
    }

    #[test]
    fn stubs_go_when_they_are_old() {
        let (root, config) = place("stub");
        let services = root.join("services");
        let [finished, begun, stuck] =
            [("a", 0o400, 60), ("b", 0o600, 0), ("c", 0o600, 60)].map(|(n, m, s)| file(&services, &config, n, m, s));
        let nodes = root.join("nodes");
        let [young, old] = [("1", 1), ("2", 60)].map(|(n, s)| file(&nodes, &config, n, 0o600, s));
        super::services(&config);
        members(&config);
        assert!(finished.exists() && begun.exists() && !stuck.exists());
        assert!(young.exists() && !old.exists());
        deserted(&config);
        assert!(!finished.exists() && begun.exists(), "nobody uses what lies in a deserted place");
        fs::remove_dir_all(&root).unwrap();
    }

    #[test]
    fn segments_without_a_size_go_when_it_is_certain() {
        let (root, config) = place("size");
        let segments = Path::new(SEGMENTS);
        let [old, young, sized] = ["old", "young", "sized"].map(|name| file(segments, &config, name, 0o600, 0));
        File::options().write(true).open(&old).unwrap().set_modified(SystemTime::UNIX_EPOCH).unwrap();
        fs::write(&sized, "x").unwrap();
        let start = Instant::now();
        unsized_segments(&config);
        assert!(!old.exists() && !young.exists() && sized.exists());
        assert!(start.elapsed() >= UNSIZED / 2);
        fs::remove_file(sized).unwrap();
        fs::remove_dir_all(&root).unwrap();
    }
}
