//! Limits of this process under which iceoryx2 cannot create, map or fill a segment. Its errors do not name them.

use std::path::Path;

use rustix::process::{Resource, getrlimit};

/// The limits of memory and files that this process has, as text; `None` if it has none.
pub(crate) fn text() -> Option<String> {
    let limit = |resource, of: &str, option, used: &dyn Fn() -> String| {
        let most = getrlimit(resource).current? / 1000;
        Some(format!("{of} is limited to {most} kB (`ulimit {option}`){}", used()))
    };
    let space = || address_space().map_or_else(String::new, |bytes| format!(", of which {} kB are used", bytes / 1000));
    let limits = [
        limit(Resource::As, "the address space of this process", "-v", &space),
        limit(Resource::Fsize, "the size of its files", "-f", &String::new),
    ];
    let limits: Vec<_> = limits.into_iter().flatten().collect();
    (!limits.is_empty()).then(|| limits.join(", and "))
}

/// Bytes of the address space that this process uses.
fn address_space() -> Option<u64> {
    let pages: u64 = std::fs::read_to_string("/proc/self/statm").ok()?.split(' ').next()?.parse().ok()?;
    Some(pages * rustix::param::page_size() as u64)
}

/// The smallest memory limit of the control groups of this process, in bytes, of version 1 or 2 (cgroups(7)).
pub(crate) fn control_group() -> Option<u64> {
    let groups = std::fs::read_to_string("/proc/self/cgroup").ok()?;
    let limits = groups.lines().filter_map(|line| {
        let (controllers, group) = line.split_once(':')?.1.split_once(':')?;
        let (mount, file) = match controllers {
            "" => ("/sys/fs/cgroup", "memory.max"),
            "memory" => ("/sys/fs/cgroup/memory", "memory.limit_in_bytes"),
            _ => return None,
        };
        // A group is also limited by those above it. A container may see only its own, as the root.
        let limit = |group: &Path| {
            std::fs::read_to_string(format!("{mount}{}/{file}", group.display())).ok()?.trim().parse().ok()
        };
        Path::new(group).ancestors().filter_map(limit).min()
    });
    limits.min()
}
