//! How much memory of a process is in transparent huge pages.

/// Kinds of memory, which Linux counts separately.
#[derive(Clone, Copy, Debug)]
pub enum Kind {
    /// Private memory, such as batches in process.
    Anonymous,
    /// Shared memory, such as an engine's batches.
    Shared,
}

/// Bytes of that process in huge pages. `None` if the system does not report them.
pub fn bytes(process: u32, kind: Kind) -> Option<u64> {
    parse(&std::fs::read_to_string(format!("/proc/{process}/smaps_rollup")).ok()?, kind)
}

fn parse(smaps: &str, kind: Kind) -> Option<u64> {
    let name = match kind {
        Kind::Anonymous => "AnonHugePages:",
        Kind::Shared => "ShmemPmdMapped:",
    };
    let kilobytes: u64 =
        smaps.lines().find_map(|line| line.strip_prefix(name))?.trim().strip_suffix(" kB")?.parse().ok()?;
    kilobytes.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_those_of_the_kind() {
        let smaps =
            "Rss:  1712 kB\nAnonHugePages:     20480 kB\nShmemPmdMapped:         4096 kB\nFilePmdMapped: 0 kB\n";
        assert_eq!(parse(smaps, Kind::Anonymous), Some(20 << 20));
        assert_eq!(parse(smaps, Kind::Shared), Some(4 << 20));
        assert_eq!(parse("Rss: 1712 kB\n", Kind::Anonymous), None);
        assert_eq!(parse("AnonHugePages: many kB\n", Kind::Anonymous), None);
    }
}
