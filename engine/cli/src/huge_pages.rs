//! How much memory of a process is in transparent huge pages.

/// Kinds of memory, by their names in `smaps_rollup`: private memory, such as in-process batches, and shared memory,
/// such as an engine's batches.
pub const PRIVATE: &str = "AnonHugePages:";
pub const SHARED: &str = "ShmemPmdMapped:";

/// Bytes of that kind of a process's memory that are in huge pages. `None` if the system does not report them.
pub fn bytes(process: u32, kind: &str) -> Option<u64> {
    parse(&std::fs::read_to_string(format!("/proc/{process}/smaps_rollup")).ok()?, kind)
}

fn parse(smaps: &str, kind: &str) -> Option<u64> {
    let line = smaps.lines().find_map(|line| line.strip_prefix(kind))?;
    let kilobytes: u64 = line.trim().strip_suffix(" kB")?.parse().ok()?;
    kilobytes.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_those_of_the_kind() {
        let smaps =
            "Rss:  1712 kB\nAnonHugePages:     20480 kB\nShmemPmdMapped:         4096 kB\nFilePmdMapped: 0 kB\n";
        assert_eq!(parse(smaps, PRIVATE), Some(20 << 20));
        assert_eq!(parse(smaps, SHARED), Some(4 << 20));
        assert_eq!(parse("Rss: 1712 kB\n", PRIVATE), None);
        assert_eq!(parse("AnonHugePages: many kB\n", PRIVATE), None);
    }
}
