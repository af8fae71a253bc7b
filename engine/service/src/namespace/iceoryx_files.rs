//! What this crate knows about iceoryx2's private files, in one place. iceoryx2 promises none of it, so the workspace
//! pins its version exactly, and a test below fails for each assumption that an upgrade breaks.
//! `docs/design/iceoryx2.md` says what each is needed for, and what a public API would have to offer instead.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::prelude::{Config, SemanticString};

use crate::namespace::segments;

/// Longest name of a socket in bytes, without the prefix.
pub(crate) const MAX_SOCKET_NAME: usize = 49;

/// The segments of a namespace: files in `/dev/shm` whose names start with the prefix.
pub(crate) fn segments(config: &Config) -> impl Iterator<Item = PathBuf> {
    named(Path::new(segments::DIRECTORY), config)
}

/// The sockets and locks of a namespace: files in its root whose names start with the prefix.
pub(crate) fn root_files(config: &Config) -> impl Iterator<Item = PathBuf> {
    named(&root_directory(config), config)
}

/// The static configurations of a namespace's services.
pub(crate) fn services(config: &Config) -> impl Iterator<Item = PathBuf> {
    named(&service_directory(config), config)
}

/// Whether a segment was created and not resized yet. iceoryx2 waits for the size without a timeout.
pub(crate) fn is_unsized(segment: &Path) -> bool {
    fs::symlink_metadata(segment).is_ok_and(|data| data.len() == 0)
}

/// Whether a segment is the counter of nodes, which iceoryx2 needs only while it creates a node and creates again if it is
/// missing.
pub(crate) fn is_node_counter(segment: &Path) -> bool {
    segment.as_os_str().as_bytes().ends_with(b".global_mgmt")
}

/// Whether the static configuration of a service is unfinished: iceoryx2 makes a finished one read-only.
pub(crate) fn is_unfinished_service(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|data| data.permissions().mode() & 0o200 != 0)
}

/// The number of the node that a file or directory in the directory of nodes belongs to, from its name: `NUMBER`, or the
/// prefix, `NUMBER` and `.node_monitor...`.
pub(crate) fn node_number(path: &Path, config: &Config) -> Option<String> {
    let name = path.file_name()?.as_bytes();
    let name = std::str::from_utf8(name.strip_prefix(config.global.prefix.as_bytes()).unwrap_or(name)).ok()?;
    let number = name.split('.').next()?;
    (!number.is_empty() && number.bytes().all(|digit| digit.is_ascii_digit())).then(|| number.to_owned())
}

/// The file with the number by which iceoryx2 identifies the process of a node. Forked processes inherit the number.
pub(crate) fn context_file(node: &UniqueNodeId, config: &Config) -> PathBuf {
    let global = &config.global;
    node_directory(config).join(format!("{}{}{}_context", global.prefix, node.value(), global.node.monitor_suffix))
}

/// The data segment of a publisher. Its name ends with the publisher's id.
pub(crate) fn data_segment(publisher: u128, config: &Config) -> Option<PathBuf> {
    let suffix = format!("_{publisher}{}", config.global.service.data_segment_suffix);
    segments(config).find(|path| path.as_os_str().as_bytes().ends_with(suffix.as_bytes()))
}

pub(crate) fn root_directory(config: &Config) -> PathBuf {
    directory(config.global.root_path())
}

pub(crate) fn service_directory(config: &Config) -> PathBuf {
    directory(&config.global.service_dir())
}

pub(crate) fn node_directory(config: &Config) -> PathBuf {
    directory(&config.global.node_dir())
}

/// The entries of a directory; none if it cannot be read.
pub(crate) fn entries(directory: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path())
}

fn named(directory: &Path, config: &Config) -> impl Iterator<Item = PathBuf> + use<> {
    let prefix = config.global.prefix;
    entries(directory)
        .filter(move |path| path.file_name().is_some_and(|name| name.as_bytes().starts_with(prefix.as_bytes())))
}

fn directory(path: &iceoryx2::prelude::Path) -> PathBuf {
    PathBuf::from(OsStr::from_bytes(path.as_bytes()))
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use iceoryx2::prelude::{AllocationStrategy, CallbackProgression, Node, NodeBuilder, NodeState, PortFactory};
    use iceoryx2::service::port_factory::publish_subscribe;

    use super::*;
    use crate::namespace::directory::{Ipc, MAX_PREFIX, Namespace};
    use crate::namespace::identity::Identity;
    use crate::namespace::lock::NamespaceLock;

    /// A namespace in which only iceoryx2 creates files, with one node.
    struct Place {
        root: PathBuf,
        config: Config,
        node: Node<Ipc>,
    }

    impl Place {
        fn new(name: &str) -> Self {
            let namespace = Namespace::at(format!("/tmp/endless-files-{name}-{}", std::process::id()));
            namespace.prepare().unwrap();
            let identity = Identity::read_or_create(&namespace, &NamespaceLock::acquire(namespace.root()).unwrap());
            let config = namespace.config(identity.unwrap().prefix()).unwrap();
            let node = NodeBuilder::new().config(&config).create().unwrap();
            Place { root: namespace.root().to_owned(), config, node }
        }

        fn service(&self) -> publish_subscribe::PortFactory<Ipc, [u64], ()> {
            let builder = self.node.service_builder(&"numbers".try_into().unwrap());
            builder.publish_subscribe::<[u64]>().create().unwrap()
        }

        fn counter(&self) -> Option<PathBuf> {
            segments(&self.config).find(|path| is_node_counter(path))
        }
    }

    impl Drop for Place {
        fn drop(&mut self) {
            for path in segments(&self.config).collect::<Vec<_>>() {
                fs::remove_file(path).unwrap();
            }
            fs::remove_dir_all(&self.root).unwrap();
        }
    }

    #[test]
    fn nodes_can_be_created_after_their_counter_was_removed() {
        let place = Place::new("counter");
        let counter = place.counter().expect("iceoryx2 leaves the counter behind");
        fs::remove_file(&counter).unwrap();
        let other = NodeBuilder::new().config(&place.config).create::<Ipc>().unwrap();
        assert!(other.id() != place.node.id() && place.counter() == Some(counter));
    }

    #[test]
    fn the_files_of_a_node_carry_its_number() {
        let place = Place::new("node");
        let number = place.node.id().value().to_string();
        let files: Vec<_> = entries(&node_directory(&place.config)).collect();
        assert!(files.len() >= 2, "{files:?}");
        assert!(files.iter().all(|path| node_number(path, &place.config).as_deref() == Some(&number)), "{files:?}");
        let context = context_file(place.node.id(), &place.config);
        assert!(files.contains(&context) && fs::metadata(context).unwrap().len() > 0, "{files:?}");
        let number = |name: &str| node_number(Path::new(name), &place.config);
        assert_eq!(
            [number("other_123.node_monitor"), number(".node_monitor"), number("notes.txt")],
            [None, None, None]
        );
    }

    #[test]
    fn a_node_without_its_files_is_none() {
        let place = Place::new("incomplete");
        let listed = || {
            let mut states = Vec::new();
            let listing = Node::<Ipc>::list(&place.config, |state| {
                states.push(matches!(state, NodeState::Alive(_)));
                CallbackProgression::Continue
            });
            listing.map(|()| states).unwrap()
        };
        assert_eq!(listed(), [true]);
        for path in entries(&node_directory(&place.config)) {
            let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
        }
        assert!(listed().is_empty());
    }

    #[test]
    fn a_finished_service_is_read_only_and_an_unfinished_one_blocks_its_name() {
        let place = Place::new("service");
        let service = place.service();
        let files: Vec<_> = services(&place.config).collect();
        assert!(files.len() == 1 && !is_unfinished_service(&files[0]), "{files:?}");
        drop(service);
        assert_eq!(services(&place.config).count(), 0);

        File::create(&files[0]).unwrap();
        assert!(is_unfinished_service(&files[0]));
        let builder = place.node.service_builder(&"numbers".try_into().unwrap());
        assert!(builder.publish_subscribe::<[u64]>().create().is_err());
        fs::remove_file(&files[0]).unwrap();
        drop(place.service());
    }

    #[test]
    fn all_files_carry_the_prefix_and_disappear_with_their_owner() {
        let place = Place::new("prefix");
        let count = || [root_files(&place.config).count(), segments(&place.config).count()];
        let before = count();
        let service = place.service();
        let publisher = service.publisher_builder().initial_max_slice_len(1000).create().unwrap();
        let subscriber = service.subscriber_builder().create().unwrap();
        let events = place.node.service_builder(&"events".try_into().unwrap()).event().create().unwrap();
        let listener = events.listener_builder().create().unwrap();
        let [files, segments_now] = count();
        assert!(files > before[0] && segments_now > before[1], "{files} files, {segments_now} segments");
        assert!(segments(&place.config).all(|segment| !is_unsized(&segment)));
        drop((listener, events, subscriber, publisher, service));
        assert_eq!(count(), before);
    }

    #[test]
    fn the_data_segment_of_a_publisher_carries_its_id() {
        let place = Place::new("segment");
        let service = place.service();
        let publisher = || service.publisher_builder().initial_max_slice_len(1000).create().unwrap();
        let [first, second] = [publisher(), publisher()];
        let [a, b] = [&first, &second].map(|port| data_segment(port.id().value(), &place.config).unwrap());
        assert_ne!(a, b);
        assert!(fs::metadata(a).unwrap().len() > 8000);
        assert_eq!(data_segment(0, &place.config), None);
        let mut listed = Vec::new();
        service.dynamic_config().list_publishers(|details| {
            listed.push(details.publisher_id.value());
            CallbackProgression::Continue
        });
        listed.sort_unstable();
        let mut expected = [first.id().value(), second.id().value()];
        expected.sort_unstable();
        assert_eq!(listed, expected);
    }

    /// `ports::publisher` prefaults chunks through loans; the first loan after it must be the first chunk again.
    #[test]
    fn free_chunks_are_a_stack() {
        let place = Place::new("stack");
        let service = place.service();
        let builder = service.publisher_builder().initial_max_slice_len(8).max_loaned_samples(3);
        let publisher = builder.allocation_strategy(AllocationStrategy::Static).create().unwrap();
        let loaned_and_returned = || {
            let mut loans: Vec<_> = (0..3).map(|_| publisher.loan_slice_uninit(8).unwrap()).collect();
            let addresses: Vec<_> = loans.iter().map(|loan| loan.payload().as_ptr().addr()).collect();
            while loans.pop().is_some() {}
            addresses
        };
        assert_eq!(loaned_and_returned(), loaned_and_returned());
    }

    /// `directory::MAX_ROOT` is derived from it.
    #[test]
    fn sockets_fit_into_the_path_of_the_longest_root() {
        let place = Place::new("socket");
        let events = place.node.service_builder(&"events".try_into().unwrap()).event().create().unwrap();
        let _listener = events.listener_builder().create().unwrap();
        let longest = root_files(&place.config).map(|path| path.file_name().unwrap().len()).max().unwrap();
        assert!(longest <= MAX_PREFIX + MAX_SOCKET_NAME, "{longest}");
    }
}
