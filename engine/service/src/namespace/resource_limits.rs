//! Limits of this process under which iceoryx2 cannot create or map a segment. Its errors do not name them.

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
