//! The identity of a namespace: a file in its root directory with the prefix of its shared memory segments.
//!
//! The prefix is random, so that no two directories share segments, even if they have the same path (in two containers
//! that share `/dev/shm` but not `/tmp`), and so that another user cannot guess the name of a segment and create it
//! first. The first process that joins writes the file and the last one that leaves removes it, both under the
//! namespace's lock.
//!
//! The file also carries the **creation lock**: a process holds it shared while it creates services and ports. A
//! process that holds it exclusively, together with the namespace's lock, knows that every incomplete resource belongs
//! to a dead process, not to a stopped one.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use endless_gym_core::files;
use rand::RngExt;
use rand::distr::Alphanumeric;

use crate::error::ServiceError;
use crate::namespace::directory::{MAX_PREFIX, Namespace};
use crate::namespace::lock::NamespaceLock;

/// Name of the file.
const FILE: &str = "prefix";

/// What a process knows of the namespace that it has joined.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Identity {
    root: PathBuf,
    prefix: String,
}

impl Identity {
    /// Reads the namespace's identity, or creates one if there is none.
    pub(crate) fn read_or_create(namespace: &Namespace, lock: &NamespaceLock) -> Result<Self, ServiceError> {
        let root = namespace.root();
        let unusable = |e: io::Error| ServiceError::Root { path: root.to_owned(), reason: e.to_string() };
        match read(root) {
            Ok(Some(identity)) => Ok(identity),
            Ok(None) => Self::create(namespace, lock).map_err(unusable),
            Err(e) => Err(unusable(e)),
        }
    }

    /// The namespace's identity, if any process uses the namespace. Creates nothing.
    pub(crate) fn existing(namespace: &Namespace) -> Option<Self> {
        read(namespace.root()).ok().flatten()
    }

    /// Gives the namespace a new prefix.
    fn create(namespace: &Namespace, _lock: &NamespaceLock) -> io::Result<Self> {
        let path = namespace.root().join(FILE);
        // A process that died here left an incomplete file.
        match fs::remove_file(&path) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
        let random = MAX_PREFIX - 1 - namespace.prefix().len();
        let random: String = rand::rng().sample_iter(Alphanumeric).take(random).map(char::from).collect();
        let prefix = format!("{}{random}_", namespace.prefix());
        let mut file = File::options().write(true).create_new(true).mode(0o600).open(&path)?;
        file.write_all(prefix.as_bytes()).inspect_err(|_| drop(fs::remove_file(&path)))?;
        Ok(Identity { root: namespace.root().to_owned(), prefix })
    }

    /// The prefix of the names of all sockets and segments.
    pub(crate) fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Fails if the root directory or the file was removed or replaced since this process joined. A file that cannot be
    /// read, for example for lack of a descriptor, counts as unchanged.
    pub(crate) fn check(&self) -> Result<(), ServiceError> {
        match read(&self.root) {
            Ok(Some(found)) if found == *self => Ok(()),
            Err(e) if !matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => Ok(()),
            _ => Err(ServiceError::RootRemoved { path: self.root.clone() }),
        }
    }

    /// Removes the file. The caller knows that no process uses the namespace.
    pub(crate) fn remove(&self, _lock: &NamespaceLock, _all: &ExclusiveCreation) {
        if self.check().is_ok() {
            let _ = fs::remove_file(self.root.join(FILE));
        }
    }

    /// The creation lock, shared. Waits for a process that holds it exclusively.
    pub(crate) fn creating(&self) -> Result<CreationLock, ServiceError> {
        let file = self.open()?;
        file.lock_shared().map_err(|e| self.unusable(&e))?;
        Ok(CreationLock(file))
    }

    /// The creation lock, exclusively, if no process is creating anything.
    pub(crate) fn try_exclusive(&self, _lock: &NamespaceLock) -> Option<ExclusiveCreation> {
        let file = self.open().ok()?;
        file.try_lock().ok()?;
        Some(ExclusiveCreation(CreationLock(file)))
    }

    fn open(&self) -> Result<File, ServiceError> {
        self.check()?;
        files::open(&self.root.join(FILE)).map_err(|e| self.unusable(&e))
    }

    fn unusable(&self, error: &io::Error) -> ServiceError {
        ServiceError::Root { path: self.root.clone(), reason: error.to_string() }
    }
}

/// Held while a process creates services and ports.
#[derive(Debug)]
pub(crate) struct CreationLock(File);

impl Drop for CreationLock {
    fn drop(&mut self) {
        // Closing the file is not enough: a child process that was forked in the meantime shares the lock.
        let _ = self.0.unlock();
    }
}

/// Proof that no other process creates services or ports.
#[derive(Debug)]
pub(crate) struct ExclusiveCreation(#[expect(dead_code, reason = "held until it is dropped")] CreationLock);

/// The identity in `root`; `None` if it is missing or incomplete.
fn read(root: &Path) -> io::Result<Option<Identity>> {
    let file = match files::open(&root.join(FILE)) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file?,
    };
    let mut prefix = String::new();
    if (&file).take(1 + MAX_PREFIX as u64).read_to_string(&mut prefix).is_err() || !is_prefix(&prefix) {
        return Ok(None);
    }
    Ok(Some(Identity { root: root.to_owned(), prefix }))
}

fn is_prefix(text: &str) -> bool {
    text.len() == MAX_PREFIX
        && text.strip_suffix('_').is_some_and(|text| text.bytes().all(|c| c.is_ascii_alphanumeric()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_namespace_keeps_its_prefix_until_it_is_removed() {
        let namespace = Namespace::at(format!("/tmp/endless-identity-{}", std::process::id()));
        namespace.prepare().unwrap();
        let path = namespace.root().join(FILE);
        let lock = NamespaceLock::acquire(namespace.root()).unwrap();
        let first = Identity::read_or_create(&namespace, &lock).unwrap();
        assert!(first.prefix().starts_with(namespace.prefix()) && first.prefix().len() == MAX_PREFIX);
        let again = Identity::read_or_create(&namespace, &lock).unwrap();
        assert_eq!(again, first);

        let creating = first.creating().unwrap();
        assert!(first.try_exclusive(&lock).is_none());
        drop(creating);
        first.remove(&lock, &first.try_exclusive(&lock).unwrap());
        assert!(!path.exists());
        assert!(matches!(first.check(), Err(ServiceError::RootRemoved { .. })));

        // An incomplete file is replaced.
        fs::write(&path, "eg").unwrap();
        let second = Identity::read_or_create(&namespace, &lock).unwrap();
        assert_ne!(second.prefix(), first.prefix());
        second.check().unwrap();
        assert!(first.check().is_err());
        fs::remove_dir_all(namespace.root()).unwrap();
    }
}
