//! Where the files of the middleware lie, and what its services are called.

use std::fs::{self, DirBuilder};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use iceoryx2::prelude::{Config, FileName, Path as IceoryxPath, SemanticString};

use super::error::ServiceError;

/// Environment variable that replaces the default root of a [`Namespace`].
pub const ROOT_VARIABLE: &str = "ENDLESS_GYM_ROOT";

/// Longest name of an engine.
const MAX_SERVICE_NAME: usize = 64;

/// Longest root: a socket under it must keep within the 107 bytes of a Unix socket's path, with the prefix before its name
/// (at most [`MAX_PREFIX`] bytes) and 49 bytes of its own.
const MAX_ROOT: usize = 107 - 1 - MAX_PREFIX - 49;
const MAX_PREFIX: usize = 16;

/// A place in which engines and trainers meet: a directory for sockets and small files, and a prefix for segments in shared
/// memory. Processes see each other only within the same namespace.
///
/// The default is `/tmp/endless-gym-<uid>`, or the directory that `ENDLESS_GYM_ROOT` names: one for each user, with access for
/// nobody else. It does not depend on the session, since engines outlive logins.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Namespace {
    root: PathBuf,
    prefix: String,
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
    /// The namespace at that directory, which is made when it is needed. The prefix follows from the path.
    pub fn at(root: impl Into<PathBuf>) -> Self {
        let root = root.into();
        let prefix = format!("endless{:08x}_", crc32fast::hash(root.as_os_str().as_bytes()));
        Namespace { root, prefix }
    }

    /// The same directory with another prefix: 1 to 16 letters, digits, `_` or `-`.
    pub fn with_prefix(self, prefix: impl Into<String>) -> Self {
        Namespace { prefix: prefix.into(), ..self }
    }

    /// The directory of sockets and small files.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// What the names of all segments in `/dev/shm` start with.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Makes the directory where it is missing, refuses one that others may write to, and describes both to the middleware.
    pub(super) fn prepare(&self) -> Result<Config, ServiceError> {
        let unusable = |reason: String| ServiceError::Root { path: self.root.clone(), reason };
        if !self.root.is_absolute() {
            return Err(unusable("it is not an absolute path".to_owned()));
        }
        if self.root.as_os_str().len() > MAX_ROOT {
            let length = self.root.as_os_str().len();
            return Err(unusable(format!(
                "its {length} bytes leave no room for a socket's name, which takes the rest of 107; give a path of at most {MAX_ROOT}"
            )));
        }
        let fits = |c: u8| c.is_ascii_alphanumeric() || c == b'_' || c == b'-';
        if !(1..=MAX_PREFIX).contains(&self.prefix.len()) || !self.prefix.bytes().all(fits) {
            return Err(unusable(format!(
                "the prefix `{}` is not 1 to {MAX_PREFIX} letters, digits, `_` or `-`",
                self.prefix
            )));
        }
        DirBuilder::new().recursive(true).mode(0o700).create(&self.root).map_err(|e| unusable(e.to_string()))?;
        let metadata = fs::symlink_metadata(&self.root).map_err(|e| unusable(e.to_string()))?;
        let (owner, user) = (metadata.uid(), rustix::process::getuid().as_raw());
        if !metadata.is_dir() {
            return Err(unusable("it is not a directory".to_owned()));
        }
        if owner != user {
            return Err(unusable(format!("it belongs to user {owner}, and this process to user {user}")));
        }
        if metadata.permissions().mode() & 0o022 != 0 {
            return Err(unusable(
                "other users may write to it; take their permission away with `chmod 700`".to_owned(),
            ));
        }
        let mut config = Config::default();
        let root = IceoryxPath::new(self.root.as_os_str().as_bytes()).map_err(|e| unusable(format!("{e:?}")))?;
        config.global.set_root_path(&root);
        config.global.prefix = FileName::new(self.prefix.as_bytes()).map_err(|e| unusable(format!("{e:?}")))?;
        config.global.creation_timeout = Duration::from_millis(500);
        // We clean up ourselves, and more carefully.
        config.global.node.cleanup_dead_nodes_on_creation = false;
        config.global.node.cleanup_dead_nodes_on_destruction = false;
        config.global.service.cleanup_dead_nodes_on_open = false;
        Ok(config)
    }
}

/// Checks the name of an engine: 1 to 64 letters, digits, `.`, `_` or `-`.
pub(super) fn check_name(service: &str) -> Result<(), ServiceError> {
    let fits = |c: u8| c.is_ascii_alphanumeric() || matches!(c, b'.' | b'_' | b'-');
    if (1..=MAX_SERVICE_NAME).contains(&service.len()) && service.bytes().all(fits) {
        Ok(())
    } else {
        Err(ServiceError::InvalidName { given: service.to_owned(), longest: MAX_SERVICE_NAME })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reason(namespace: &Namespace) -> String {
        namespace.prepare().unwrap_err().to_string()
    }

    #[test]
    fn the_prefix_follows_from_the_root() {
        assert_eq!(Namespace::at("/tmp/a"), Namespace::at("/tmp/a"));
        assert_ne!(Namespace::at("/tmp/a").prefix(), Namespace::at("/tmp/b").prefix());
        assert!(Namespace::at("/tmp/a").prefix().len() <= MAX_PREFIX);
    }

    #[test]
    fn unusable_roots_are_refused() {
        assert!(reason(&Namespace::at("somewhere")).contains("absolute"));
        assert!(reason(&Namespace::at(format!("/tmp/{}", "a".repeat(MAX_ROOT)))).contains("at most"));
        assert!(reason(&Namespace::at("/dev/null")).contains("/dev/null"));
        assert!(reason(&Namespace::at("/tmp")).contains("/tmp"));
        assert!(reason(&Namespace::at("/tmp/x").with_prefix("a/b")).contains("a/b"));
    }

    #[test]
    fn names_of_engines_are_checked() {
        check_name("mortar_mayhem-1.0").unwrap();
        for name in ["", "a/b", "a b", &"a".repeat(65)] {
            assert!(matches!(check_name(name), Err(ServiceError::InvalidName { .. })), "{name}");
        }
    }
}
