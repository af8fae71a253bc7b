//! The status of an observer, for `endless status`.

use crate::node::NamespaceNode;
use crate::specification::ServiceSpecification;
use crate::status_file::{self, StatusFile};
use crate::status_record::{ObserverRecord, now};

/// Publishes what an observer holds.
#[derive(Debug)]
pub(crate) struct ObserverStatusWriter {
    file: StatusFile,
    record: ObserverRecord,
}

impl ObserverStatusWriter {
    /// `None` if there is no memory or descriptor for it: an observer works without.
    pub(crate) fn create(node: &NamespaceNode, specification: &ServiceSpecification, group: usize) -> Option<Self> {
        // A file that another process finds empty is removed, unless this process is creating something.
        let _creating = node.creating().ok()?;
        let record = ObserverRecord { process: std::process::id(), group: group as u32, ..ObserverRecord::default() };
        let path = status_file::observer_path(node.prefix(), specification.incarnation, rand::random());
        let created = StatusFile::create_observer(path, &record);
        let created = created.inspect_err(|e| tracing::debug!(error = %e, "cannot publish what this observer holds"));
        created.ok().map(|file| ObserverStatusWriter { file, record })
    }

    /// A batch was received; with it, `held` are held.
    pub(crate) fn received(&mut self, held: usize) {
        let ObserverRecord { batches, .. } = self.record;
        self.record = ObserverRecord { batches: batches + 1, last_batch: now(), held: held as u32, ..self.record };
        self.file.write_observer(&self.record);
    }
}
