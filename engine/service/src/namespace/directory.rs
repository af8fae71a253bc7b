//! Namespaces: the directory and the prefix of iceoryx2's files and segments, and the rules for engine names.

use std::fs::{self, DirBuilder};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use iceoryx2::prelude::{Config, FileName, Path as IceoryxPath, SemanticString, ipc_threadsafe};
use serde::{Deserialize, Serialize};

use crate::error::ServiceError;
use crate::namespace::iceoryx_files::MAX_SOCKET_NAME;

/// The iceoryx2 service type. Its ports and samples may be moved to and dropped in any thread, as bindings to a
/// garbage-collected language require. Compared with the single-threaded type, it costs half a microsecond per step.
pub(crate) type Ipc = ipc_threadsafe::Service;

/// Environment variable that overrides the root directory of the default [`Namespace`].
pub const ROOT_VARIABLE: &str = "ENDLESS_GYM_ROOT";

/// Maximum length of an engine name in bytes.
const MAX_SERVICE_NAME: usize = 64;

/// Maximum length of the root in bytes. The path of a Unix socket has at most 107 bytes: the root, a separator, the prefix and the
/// socket's own name.
const MAX_ROOT: usize = 107 - 1 - MAX_PREFIX - MAX_SOCKET_NAME;
/// Length in bytes of the prefix of all sockets and segments: [`Namespace::prefix`], random characters, `_`.
pub(crate) const MAX_PREFIX: usize = 16;

/// A root directory for sockets and small files, and a prefix for shared memory segments. Engines, trainers and
/// observers find each other only in the same namespace, that is, in the same directory; the same path in another
/// container does not suffice.
///
/// The default root is `/tmp/endless-gym-<uid>`, or the directory in the environment variable `ENDLESS_GYM_ROOT`. It belongs to
/// one user and is not writable by others. It does not depend on the login session, because engines outlive logins.
///
/// ```
/// use endless_gym_service::Namespace;
///
/// let namespace = Namespace::at("/tmp/my-experiment");
/// assert_eq!(namespace, Namespace::at("/tmp/my-experiment"));
/// assert_ne!(namespace.prefix(), Namespace::at("/tmp/another").prefix());
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "PathBuf", into = "PathBuf")]
pub struct Namespace {
    root: PathBuf,
    prefix: String,
}

impl From<PathBuf> for Namespace {
    fn from(root: PathBuf) -> Self {
        Namespace::at(root)
    }
}

impl From<Namespace> for PathBuf {
    fn from(namespace: Namespace) -> Self {
        namespace.root
    }
}

impl Default for Namespace {
    fn default() -> Self {
        match std::env::var_os(ROOT_VARIABLE) {
            Some(root) if !root.is_empty() => Namespace::at(root),
            _ => Namespace::at(format!("/tmp/endless-gym-{}", rustix::process::getuid().as_raw())),
        }
    }
}

impl Namespace {
    /// The namespace with the root directory `root`, an absolute path of at most 41 bytes. The directory is created when it is
    /// first used.
    pub fn at(root: impl Into<PathBuf>) -> Self {
        // A slash at the end would follow a symbolic link.
        let root: PathBuf = root.into().components().collect();
        let prefix = format!("eg{:08x}", crc32fast::hash(root.as_os_str().as_bytes()));
        Namespace { root, prefix }
    }

    /// The root directory.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The start of the names of all shared memory segments in `/dev/shm`, derived from the path. Five random
    /// characters follow, drawn by the first process that joins and discarded by the last one that leaves, so that two
    /// directories of the same path, in two containers that share `/dev/shm`, never share a segment.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    fn unusable(&self, reason: String) -> ServiceError {
        ServiceError::Root { path: self.root.clone(), reason }
    }

    /// Creates the root directory if it is missing, and fails if other users can write to it.
    pub(crate) fn prepare(&self) -> Result<(), ServiceError> {
        let unusable = |reason: String| self.unusable(reason);
        if !self.root.is_absolute() {
            return Err(unusable("it must be an absolute path".to_owned()));
        }
        if self.root.as_os_str().len() > MAX_ROOT {
            let length = self.root.as_os_str().len();
            return Err(unusable(format!(
                "it must have at most {MAX_ROOT} bytes, so that the paths of Unix sockets fit into 107 bytes, got {length}"
            )));
        }
        // iceoryx2 accepts no others.
        if !self.root.as_os_str().as_bytes().iter().all(|byte| (b' '..=b'~').contains(byte)) {
            return Err(unusable("it must consist of printable ASCII characters".to_owned()));
        }
        DirBuilder::new().recursive(true).mode(0o700).create(&self.root).map_err(|e| unusable(e.to_string()))?;
        let metadata = fs::symlink_metadata(&self.root).map_err(|e| unusable(e.to_string()))?;
        let (owner, user) = (metadata.uid(), rustix::process::getuid().as_raw());
        if !metadata.is_dir() {
            return Err(unusable("it must be a directory".to_owned()));
        }
        let mode = metadata.permissions().mode();
        // A directory with the sticky bit, such as `/tmp`, is shared on purpose.
        if mode & 0o022 != 0 && mode & 0o1000 != 0 {
            let own = self.root.join(format!("endless-gym-{user}"));
            return Err(unusable(format!(
                "it is shared with other users; use a directory in it, such as {}",
                own.display()
            )));
        }
        if owner != user {
            return Err(unusable(format!(
                "it must belong to user {user}, who runs this process, and belongs to user {owner}"
            )));
        }
        if mode & 0o022 != 0 {
            let root = self.root.display();
            return Err(unusable(format!(
                "other users must not have write permission; remove it with `chmod go-w {root}`"
            )));
        }
        Ok(())
    }

    /// iceoryx2's configuration with this prefix.
    pub(crate) fn config(&self, prefix: &str) -> Result<Config, ServiceError> {
        let unusable = |reason: String| self.unusable(reason);
        let mut config = Config::default();
        let root = IceoryxPath::new(self.root.as_os_str().as_bytes()).map_err(|e| unusable(format!("{e:?}")))?;
        config.global.set_root_path(&root);
        config.global.prefix = FileName::new(prefix.as_bytes()).map_err(|e| unusable(format!("{e:?}")))?;
        config.global.creation_timeout = Duration::from_millis(500);
        // `NamespaceNode` cleans up, under the namespace's lock.
        config.global.node.cleanup_dead_nodes_on_creation = false;
        config.global.node.cleanup_dead_nodes_on_destruction = false;
        config.global.service.cleanup_dead_nodes_on_open = false;
        Ok(config)
    }
}

/// Checks an engine name: 1 to 64 letters, digits, `.`, `_` or `-`.
pub(crate) fn check_name(service: &str) -> Result<(), ServiceError> {
    let fits = |c: u8| c.is_ascii_alphanumeric() || matches!(c, b'.' | b'_' | b'-');
    if (1..=MAX_SERVICE_NAME).contains(&service.len()) && service.bytes().all(fits) {
        Ok(())
    } else {
        Err(ServiceError::InvalidName { given: service.to_owned(), max_length: MAX_SERVICE_NAME })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reason(namespace: &Namespace) -> String {
        namespace.prepare().unwrap_err().to_string()
    }

    #[test]
    fn unusable_roots_are_refused() {
        assert!(reason(&Namespace::at("somewhere")).contains("absolute"));
        assert!(reason(&Namespace::at(format!("/tmp/{}", "a".repeat(MAX_ROOT)))).contains("at most"));
        assert!(reason(&Namespace::at("/dev/null")).contains("/dev/null"));
        let own = PathBuf::from(format!("/tmp/endless-own-{}", std::process::id()));
        fs::create_dir(&own).unwrap();
        fs::set_permissions(&own, fs::Permissions::from_mode(0o700)).unwrap();
        std::os::unix::fs::symlink(&own, own.join("link")).unwrap();
        for link in ["link", "link/", "./link//."] {
            assert!(reason(&Namespace::at(own.join(link))).contains("must be a directory"), "{link}");
        }
        for name in ["\u{fc}", "\n", "a\u{7f}"] {
            assert!(reason(&Namespace::at(own.join(name))).contains("ASCII"), "{name:?}");
            assert!(!own.join(name).exists());
        }
        fs::remove_dir_all(&own).unwrap();
        let shared = reason(&Namespace::at("/tmp"));
        assert!(
            shared.contains("/tmp cannot be used: it is shared with other users") && !shared.contains("chmod"),
            "{shared}"
        );
        let open = PathBuf::from(format!("/tmp/endless-open-{}", std::process::id()));
        fs::create_dir(&open).unwrap();
        fs::set_permissions(&open, fs::Permissions::from_mode(0o777)).unwrap();
        let advice = reason(&Namespace::at(&open));
        fs::remove_dir(&open).unwrap();
        assert!(advice.contains(&format!("chmod go-w {}", open.display())), "{advice}");
    }

    #[test]
    fn engine_names_are_checked() {
        check_name("mortar_mayhem-1.0").unwrap();
        for name in ["", "a/b", "a b", "g\u{443}m", "gym\n", &"a".repeat(65)] {
            assert!(matches!(check_name(name), Err(ServiceError::InvalidName { .. })), "{name}");
        }
    }
}
