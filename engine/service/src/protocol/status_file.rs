//! The status files in shared memory: an engine's, with its specification, and its observers'.
//!
//! The engine or observer maps its file and is its only writer. Readers use `pread` instead of a mapping, so that a
//! writer cannot harm them. Each record is preceded by a sequence number, which is odd while the record is being
//! written (a sequence lock).
//!
//! Behind the records of an engine are its bells: words that count the batches sent, one for each group and one for all groups.
//! Observers wait for a change of a bell by a futex. They map the bells only for the system call, and read them by `pread` as well.
//!
//! The writer holds an `flock` on the file from before the file gets its name until its process ends. A file without
//! that lock belongs to a dead process and may be removed. This needs no process ids, which differ between containers.
//!
//! If another process truncates the file, SIGBUS kills the writer, as with every shared memory segment. The file is
//! read-only to prevent accidents; root, or a process of the same user that changes the mode first, can still do it.

use std::fs::{self, File};
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering, fence};
use std::time::Duration;

use bytemuck::{Pod, Zeroable};
use endless_gym_core::batch::LAYOUT_VERSION;
use endless_gym_core::printable;
use rustix::fs::{FallocateFlags, FlockOperation, fallocate, flock};
use rustix::io::Errno;
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use rustix::thread::futex;
use rustix::time::{ClockId, Timespec, clock_gettime};

use crate::error::ServiceError;
use crate::namespace::segments::{self, OBSERVER_SUFFIX, STATUS_SUFFIX, open_status};
use crate::protocol::limits::MAX_GROUPS;
use crate::protocol::message::RequestKind;

const WORD: usize = size_of::<u64>();

/// Words of each record, including its sequence number: whole cache lines.
const ENGINE_WORDS: usize = 32;
const GROUP_WORDS: usize = 24;
const OBSERVER_WORDS: usize = 8;
/// Words of a bell: the count, and a futex for [`Bells::wait`].
const BELL_WORDS: usize = 8;
const _: () = assert!(size_of::<EngineHead>() < size_of::<EngineRecord>());
const _: () = assert!(size_of::<EngineRecord>() / WORD < ENGINE_WORDS && size_of::<GroupRecord>() / WORD < GROUP_WORDS);
const _: () = assert!(size_of::<ObserverRecord>() / WORD < OBSERVER_WORDS);

/// How many times a reader tries to read a record that is being written.
const READ_ATTEMPTS: usize = 100;

/// The file of an engine's status.
pub(crate) fn path(prefix: &str, service: &str, incarnation: u64) -> PathBuf {
    segments::path(&format!("{prefix}{service}.{incarnation:016x}{STATUS_SUFFIX}"))
}

/// The file of an engine's observer. `number` is random.
pub(crate) fn observer_path(prefix: &str, incarnation: u64, number: u64) -> PathBuf {
    segments::path(&format!("{prefix}{incarnation:016x}.{number:016x}{OBSERVER_SUFFIX}"))
}

/// The names of a namespace's engines, and their status files.
pub(crate) fn engines(prefix: &str) -> Vec<(String, PathBuf)> {
    let service = |path: &Path| {
        let name = path.file_name()?.to_str()?.strip_prefix(prefix)?.strip_suffix(STATUS_SUFFIX)?;
        Some(name.rsplit_once('.')?.0.to_owned())
    };
    segments::named(prefix, STATUS_SUFFIX).into_iter().filter_map(|path| Some((service(&path)?, path))).collect()
}

/// The records of an engine's observers that are running.
pub(crate) fn running_observers(prefix: &str, incarnation: u64) -> Vec<ObserverRecord> {
    observer_paths(prefix, incarnation).iter().filter_map(|path| StatusReader::running_observer(path)).collect()
}

/// The files of an engine's observers.
fn observer_paths(prefix: &str, incarnation: u64) -> Vec<PathBuf> {
    segments::named(&format!("{prefix}{incarnation:016x}."), OBSERVER_SUFFIX)
}

/// The number of words of the records of an engine with that many groups.
fn words(groups: usize) -> usize {
    ENGINE_WORDS + groups * GROUP_WORDS
}

/// The number of words before the bell of a group; the bell of all groups follows those of the groups.
fn words_before_bell(groups: usize, bell: usize) -> usize {
    words(groups) + bell * BELL_WORDS
}

/// The status file of an engine or an observer in this process. Dropping it removes the file.
#[derive(Debug)]
pub(crate) struct StatusFile {
    start: NonNull<AtomicU64>,
    words: usize,
    /// The name that the file has now.
    path: PathBuf,
    process: u32,
    /// Holds the lock.
    file: File,
}

// SAFETY: the mapping belongs to this value alone, and its words are atomic.
unsafe impl Send for StatusFile {}
// SAFETY: as above; `&self` gives access to atomic words.
unsafe impl Sync for StatusFile {}

impl StatusFile {
    /// Creates the file of an engine with these records and the text of its specification. Readers find it only after
    /// [`publish`](Self::publish).
    pub(crate) fn create(
        path: &Path,
        engine: &EngineRecord,
        groups: usize,
        specification: &[u8],
    ) -> Result<Self, ServiceError> {
        Self::with_record(path, words_before_bell(groups, groups + 1), engine, specification)
    }

    /// Creates the file of an observer.
    pub(crate) fn create_observer(path: &Path, record: &ObserverRecord) -> Result<Self, ServiceError> {
        let mut file = Self::with_record(path, OBSERVER_WORDS, record, &[])?;
        file.publish(path)?;
        Ok(file)
    }

    /// Gives the file its name; by then it is complete and locked.
    pub(crate) fn publish(&mut self, path: &Path) -> Result<(), ServiceError> {
        fs::rename(&self.path, path).map_err(ServiceError::file("cannot publish the status", path))?;
        path.clone_into(&mut self.path);
        Ok(())
    }

    fn with_record(path: &Path, words: usize, record: &impl Pod, text: &[u8]) -> Result<Self, ServiceError> {
        let unnamed = path.with_extension("new");
        let failed = ServiceError::file("cannot create the status", &unnamed);
        let file =
            File::options().read(true).write(true).create_new(true).mode(0o400).open(&unnamed).map_err(&failed)?;
        let prepared = flock(&file, FlockOperation::NonBlockingLockExclusive)
            // Without allocation, writing to the mapping raises SIGBUS when there is no memory.
            .and_then(|()| fallocate(&file, FallocateFlags::empty(), 0, (words * WORD + text.len()) as u64))
            .and_then(|()| {
                // SAFETY: a new mapping at an address that the system chooses.
                unsafe {
                    let protection = ProtFlags::READ | ProtFlags::WRITE;
                    mmap(std::ptr::null_mut(), words * WORD, protection, MapFlags::SHARED, &file, 0)
                }
            });
        let start = prepared.map_err(|e| {
            let _ = fs::remove_file(&unnamed);
            failed(e.into())
        })?;
        let start = NonNull::new(start.cast()).ok_or_else(|| failed(Errno::NOMEM.into()))?;
        let status = StatusFile { start, words, path: unnamed.clone(), process: std::process::id(), file };
        status.write(0, record);
        status.file.write_all_at(text, (words * WORD) as u64).map_err(&failed)?;
        Ok(status)
    }

    /// Writes the first record, that of the engine or the observer.
    pub(crate) fn write_first(&self, record: &impl Pod) {
        self.write(0, record);
    }

    pub(crate) fn write_group(&self, group: usize, record: &GroupRecord) {
        self.write(words(group), record);
    }

    /// Rings a bell of an engine with that many groups. If observers wait for it, wakes one; see [`Bells::wait`].
    pub(crate) fn ring(&self, groups: usize, bell: usize) {
        let [count, relay] = bell_words(&self.memory()[words_before_bell(groups, bell)..]);
        let rung = count.fetch_add(1, Ordering::SeqCst).wrapping_add(1);
        // The others go to another futex without being woken. If the count has changed, the thread that changed it wakes them.
        let woken = futex::cmp_requeue(count, futex::Flags::empty(), 1, i32::MAX.cast_unsigned(), relay, rung);
        if let Err(e) = woken
            && e != Errno::AGAIN
        {
            tracing::debug!(error = %e, "cannot wake the observers");
        }
    }

    fn memory(&self) -> &[AtomicU64] {
        // SAFETY: the mapping has that many words, is aligned to a page, and lasts until this value is dropped. All access to it
        // in this process is atomic.
        unsafe { std::slice::from_raw_parts(self.start.as_ptr(), self.words) }
    }

    /// Writes a record, which consists of words.
    fn write(&self, at: usize, record: &impl Pod) {
        let memory = self.memory();
        let sequence = memory[at].load(Ordering::Relaxed);
        memory[at].store(sequence.wrapping_add(1), Ordering::Relaxed);
        fence(Ordering::Release);
        for (to, from) in memory[at + 1..].iter().zip(bytemuck::cast_slice(bytemuck::bytes_of(record))) {
            to.store(*from, Ordering::Relaxed);
        }
        memory[at].store(sequence.wrapping_add(2), Ordering::Release);
    }
}

impl Drop for StatusFile {
    fn drop(&mut self) {
        // A forked child must not remove its parent's file.
        if self.process == std::process::id() {
            let _ = fs::remove_file(&self.path);
        }
        // SAFETY: the mapping was made with this address and length, and nothing else refers to it.
        let _ = unsafe { munmap(self.start.as_ptr().cast(), self.words * WORD) };
    }
}

/// The two futexes of a bell at the start of `memory`.
fn bell_words(memory: &[AtomicU64]) -> [&AtomicU32; 2] {
    // SAFETY: a word has the size and the alignment of two of these, and no other code accesses the words of bells.
    [0, 1].map(|word| unsafe { &*memory[word].as_ptr().cast::<AtomicU32>() })
}

/// The bells of an engine in another process.
#[derive(Debug)]
pub(crate) struct Bells {
    pub status: StatusReader,
    groups: usize,
    /// The mapping, which only the kernel accesses: if the file was truncated, a futex fails, and reading would raise SIGBUS.
    start: NonNull<AtomicU64>,
}

// SAFETY: the mapping belongs to this value alone, and its words are atomic.
unsafe impl Send for Bells {}
// SAFETY: as above; `&self` gives access to atomic words.
unsafe impl Sync for Bells {}

impl Bells {
    /// The bells in an engine's file; `None` if they cannot be mapped.
    pub(crate) fn open(path: &Path) -> Option<Self> {
        let status = StatusReader::open(path)?;
        let groups = status.engine()?.groups as usize;
        // SAFETY: a new mapping at an address that the system chooses.
        let start = unsafe {
            mmap(std::ptr::null_mut(), Self::bytes(groups), ProtFlags::READ, MapFlags::SHARED, &status.file, 0).ok()?
        };
        Some(Bells { status, groups, start: NonNull::new(start.cast())? })
    }

    fn bytes(groups: usize) -> usize {
        words_before_bell(groups, groups + 1) * WORD
    }

    /// How often the bell of a group, or of all groups (the number of groups), has rung.
    pub(crate) fn count(&self, bell: usize) -> u32 {
        let mut count = [0; size_of::<u32>()];
        let offset = (words_before_bell(self.groups, bell) * WORD) as u64;
        let _ = self.status.file.read_exact_at(&mut count, offset);
        // The queue of batches is read after it.
        fence(Ordering::Acquire);
        u32::from_ne_bytes(count)
    }

    /// Waits until the count differs from `seen`, up to `timeout`. May return earlier.
    ///
    /// The engine wakes one of those that wait for the count and moves the others to the relay, on which each one that wakes wakes
    /// two, so that the number of observers does not slow the engine. If one dies before it has woken two, others stay on the relay
    /// until somebody who waits for the count is woken by a later batch, or until their timeout.
    pub(crate) fn wait(&self, bell: usize, seen: u32, timeout: Duration) {
        // SAFETY: the mapping has this many words and lasts until this value is dropped. Nothing is read or written through the
        // slice in this process.
        let memory = unsafe { std::slice::from_raw_parts(self.start.as_ptr(), Self::bytes(self.groups) / WORD) };
        let [count, relay] = bell_words(&memory[words_before_bell(self.groups, bell)..]);
        let time = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: timeout.subsec_nanos().into() };
        match futex::wait(count, futex::Flags::empty(), seen, Some(&time)) {
            Ok(()) => drop(futex::wake(relay, futex::Flags::empty(), 2)),
            Err(Errno::AGAIN | Errno::INTR | Errno::TIMEDOUT) => {}
            // The file was truncated.
            Err(_) => std::thread::sleep(timeout.min(Duration::from_millis(1))),
        }
    }
}

impl Drop for Bells {
    fn drop(&mut self) {
        // SAFETY: the mapping was made with this address and length, and nothing else refers to it.
        let _ = unsafe { munmap(self.start.as_ptr().cast(), Self::bytes(self.groups)) };
    }
}

/// Reads the status of an engine or an observer in another process, even after its end.
#[derive(Debug)]
pub(crate) struct StatusReader {
    file: File,
}

impl StatusReader {
    /// Opens an engine's file; `None` if it is missing, or not of this version.
    pub(crate) fn open(path: &Path) -> Option<Self> {
        let reader = StatusReader { file: open_status(path)? };
        reader.engine().map(|_| reader)
    }

    /// Opens the file of an engine of any version.
    pub(crate) fn open_any(path: &Path) -> Option<Self> {
        let reader = StatusReader { file: open_status(path)? };
        reader.head().map(|_| reader)
    }

    /// The first fields of an engine's record, of any version; `None` if they cannot be read.
    pub(crate) fn head(&self) -> Option<EngineHead> {
        self.read::<EngineHead>(0).filter(|head| head.magic == MAGIC)
    }

    /// The text of an engine's specification; `None` if the file is too short.
    pub(crate) fn specification(&self) -> Option<Vec<u8>> {
        let engine = self.engine()?;
        let groups = engine.groups as usize;
        let offset = (words_before_bell(groups, groups + 1) * WORD) as u64;
        let length = engine.head.specification_bytes;
        if self.file.metadata().ok()?.len() < offset.checked_add(length)? {
            return None;
        }
        let mut text = vec![0; usize::try_from(length).ok()?];
        self.file.read_exact_at(&mut text, offset).ok()?;
        Some(text)
    }

    /// The record of an observer that is running; `None` if it cannot be read.
    fn running_observer(path: &Path) -> Option<ObserverRecord> {
        let reader = StatusReader { file: open_status(path)? };
        if reader.is_alive() { reader.read(0) } else { None }
    }

    /// Whether the process that writes the file is running.
    pub(crate) fn is_alive(&self) -> bool {
        segments::has_writer(&self.file)
    }

    /// The record of the engine; `None` if it cannot be read.
    pub(crate) fn engine(&self) -> Option<EngineRecord> {
        self.read::<EngineRecord>(0).filter(EngineRecord::is_valid)
    }

    /// The record of a group; `None` if it cannot be read.
    pub(crate) fn group(&self, group: usize) -> Option<GroupRecord> {
        self.read(words(group))
    }

    fn read<R: Pod>(&self, at: usize) -> Option<R> {
        let offset = (at * WORD) as u64;
        let sequence = || {
            let mut word = [0; WORD];
            self.file.read_exact_at(&mut word, offset).ok().map(|()| u64::from_ne_bytes(word))
        };
        for _ in 0..READ_ATTEMPTS {
            let before = sequence()?;
            // The kernel loads the words in this thread, so that a fence orders these loads as it would this thread's own. This one
            // pairs with the writer's last store: a record read after an even number is at least as new as that number.
            fence(Ordering::Acquire);
            let mut record = R::zeroed();
            self.file.read_exact_at(bytemuck::bytes_of_mut(&mut record), offset + WORD as u64).ok()?;
            // This one pairs with the writer's fence: if any word is of a later record, so is the number that is read now.
            fence(Ordering::Acquire);
            if before.is_multiple_of(2) && sequence()? == before {
                return Some(record);
            }
            std::thread::yield_now();
        }
        None
    }
}

/// First word of a status file.
pub(crate) const MAGIC: u64 = u64::from_le_bytes(*b"EGYMSTAT");

/// How to read the rest of an engine's file. Its layout must never change, so that every version recognises engines of
/// all others.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct EngineHead {
    pub magic: u64,
    pub layout_version: u32,
    pub process: u32,
    /// Version of the engine's package, padded with zeros.
    pub package: [u8; 32],
    /// Length of the specification, which follows the records as JSON text.
    pub specification_bytes: u64,
}

/// The status of the whole engine, with fields as in [`EngineStatus`](crate::EngineStatus). Times are in nanoseconds of
/// CLOCK_MONOTONIC, 0 for none.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct EngineRecord {
    pub head: EngineHead,
    pub incarnation: u64,
    pub started: u64,
    pub groups: u32,
    pub num_envs: u32,
    pub dropped: u64,
    pub recoveries: u64,
    pub checkpoints: u64,
    pub last_checkpoint: u64,
    /// Environment id and engine name, padded with zeros.
    pub id: [u8; 64],
    pub service: [u8; 64],
}

impl EngineRecord {
    /// Whether a reader of this version can use the record.
    pub(crate) fn is_valid(&self) -> bool {
        let groups = usize::try_from(self.groups).unwrap_or(usize::MAX);
        self.head.magic == MAGIC && self.head.layout_version == LAYOUT_VERSION && (1..=MAX_GROUPS).contains(&groups)
    }
}

/// The status of one group, with fields as in [`GroupStatus`](crate::GroupStatus). Times are as in [`EngineRecord`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct GroupRecord {
    pub step: u64,
    /// The random number of the trainer of the last request.
    pub trainer: u64,
    pub trainers: u64,
    /// Numbers of that trainer's requests: the last one that was taken, answered, and executed rather than rejected.
    pub taken: u64,
    pub answered: u64,
    pub executed: u64,
    /// When the current request was taken; 0 if there is none.
    pub busy_since: u64,
    /// When the last request was taken.
    pub last_request: u64,
    pub batches: u64,
    pub env_steps: u64,
    pub episodes: u64,
    pub rejected: u64,
    pub undelivered: u64,
    /// Code of the last request's [`RequestKind`].
    pub kind: u32,
    /// As reported by the trainer.
    pub trainer_process: u32,
    pub held: u32,
    pub padding: u32,
    pub returns: f64,
    pub lengths: u64,
    pub successes: u64,
}

impl GroupRecord {
    /// The kind of the last request in a word.
    pub(crate) fn kind(&self) -> &'static str {
        RequestKind::from_code(self.kind).map_or("request", RequestKind::name)
    }
}

/// The status of one observer, with fields as in [`ObserverStatus`](crate::ObserverStatus). Times are as in [`EngineRecord`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct ObserverRecord {
    /// As reported by the observer.
    pub process: u32,
    pub group: u32,
    pub batches: u64,
    pub last_batch: u64,
    pub held: u32,
    pub padding: u32,
}

/// Nanoseconds of CLOCK_MONOTONIC, which is the same in all processes of a host; at least 1.
pub(crate) fn now() -> u64 {
    let time = clock_gettime(ClockId::Monotonic);
    let seconds = u64::try_from(time.tv_sec).unwrap_or(0);
    seconds.saturating_mul(1_000_000_000).saturating_add(u64::try_from(time.tv_nsec).unwrap_or(0)).max(1)
}

/// Text padded with zeros to the size of a field.
pub(crate) fn padded<const N: usize>(text: &str) -> [u8; N] {
    let mut bytes = [0; N];
    bytes.iter_mut().zip(text.bytes()).for_each(|(to, from)| *to = from);
    bytes
}

/// The text of a field that is padded with zeros.
pub(crate) fn unpadded(bytes: &[u8]) -> String {
    printable(String::from_utf8_lossy(bytes).trim_end_matches('\0'))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn record() -> EngineRecord {
        let (id, service) = (padded("MortarMayhem-v0"), padded("gym"));
        let head = EngineHead { magic: MAGIC, layout_version: LAYOUT_VERSION, ..EngineHead::zeroed() };
        EngineRecord { head, groups: 2, num_envs: 3, id, service, ..EngineRecord::zeroed() }
    }

    fn published(path: &Path, groups: usize) -> StatusFile {
        let mut file = StatusFile::create(path, &record(), groups, b"").unwrap();
        file.publish(path).unwrap();
        file
    }

    fn place(name: &str) -> PathBuf {
        path(&format!("endless-status-{}_", std::process::id()), name, 1)
    }

    #[test]
    fn records_are_read_as_they_were_written() {
        let path = place("read");
        let file = published(&path, 2);
        let reader = StatusReader::open(&path).unwrap();
        assert_eq!(reader.engine(), Some(record()));
        let mode = fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o400, "no other process truncates it by mistake");
        let group = GroupRecord { step: 7, taken: 9, held: 2, ..GroupRecord::default() };
        file.write_group(1, &group);
        assert_eq!((reader.group(0), reader.group(1)), (Some(GroupRecord::default()), Some(group)));
        assert_eq!(reader.group(9), None, "beyond the end");
        assert!(reader.is_alive());
        drop(file);
        assert!(!path.exists() && !reader.is_alive());
        assert_eq!(reader.group(1), Some(group), "the last status remains readable");
    }

    /// One thread more than the engine wakes at once; a bell that rings between two waits is not missed.
    #[test]
    fn every_waiting_thread_hears_its_bell() {
        let path = place("bell");
        let file = published(&path, 2);
        let long = Duration::from_secs(30);
        std::thread::scope(|scope| {
            for (thread, bell) in [0, 0, 0, 0, 0, 1, 2, 2].into_iter().enumerate() {
                let bells = Bells::open(&path).unwrap();
                scope.spawn(move || {
                    let (mut seen, mut waits) = (0, 0);
                    while seen < 300 {
                        bells.wait(bell, seen, long);
                        (seen, waits) = (bells.count(bell), waits + 1);
                    }
                    assert!(waits <= 600, "thread {thread} waited {waits} times");
                });
            }
            for round in 0..300 {
                (0..=2).for_each(|bell| file.ring(2, bell));
                if round % 3 == 0 {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
        });
        let bells = Bells::open(&path).unwrap();
        assert_eq!([0, 1, 2].map(|bell| bells.count(bell)), [300; 3]);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
        File::options().write(true).open(&path).unwrap().set_len(0).unwrap();
        // Not a SIGBUS.
        bells.wait(1, 300, Duration::from_millis(20));
        assert_eq!(bells.count(1), 0);
        drop(file);
    }

    /// Fails without either of the two checks of the sequence number.
    #[test]
    fn a_record_is_never_read_half_written() {
        let path = place("torn");
        let file = published(&path, 1);
        let reader = StatusReader::open(&path).unwrap();
        let same = |n: u64| GroupRecord { step: n, taken: n, answered: n, undelivered: n, ..GroupRecord::default() };
        let (sequence, done) = (&file.memory()[words(0)], AtomicU32::new(0));
        sequence.fetch_add(1, Ordering::SeqCst);
        assert_eq!(reader.group(0), None, "the writer stopped in the middle");
        sequence.fetch_add(1, Ordering::SeqCst);
        std::thread::scope(|scope| {
            let write =
                || (0..).take_while(|_| done.load(Ordering::Relaxed) == 0).for_each(|n| file.write_group(0, &same(n)));
            scope.spawn(write);
            let torn = (0..200_000).filter_map(|_| reader.group(0)).find(|read| *read != same(read.step));
            done.store(1, Ordering::Relaxed);
            assert_eq!(torn, None);
        });
    }

    #[test]
    fn files_that_are_not_the_status_of_a_running_process_are_refused_or_removed() {
        let prefix = format!("endless-status-odd-{}_", std::process::id());
        let running = path(&prefix, "running", 1);
        let file = published(&running, 1);
        let [other, short, dead] = ["other", "short", "dead"].map(|name| path(&prefix, name, 1));
        fs::write(&other, [7; 4096]).unwrap();
        fs::write(&short, [0; 9]).unwrap();
        fs::copy(&running, &dead).unwrap();
        assert!(StatusReader::open(&other).is_none() && StatusReader::open(&short).is_none());
        assert!(StatusReader::open(&path(&prefix, "missing", 1)).is_none());
        assert!(!StatusReader::open(&dead).unwrap().is_alive());
        assert_eq!(engines(&prefix).len(), 4);
        let [observer, gone] = [1, 2].map(|number| observer_path(&prefix, 9, number));
        let seen = ObserverRecord { group: 1, held: 2, ..ObserverRecord::default() };
        let file_of_observer = StatusFile::create_observer(&observer, &seen).unwrap();
        fs::copy(&observer, &gone).unwrap();
        assert_eq!(StatusReader::running_observer(&observer), Some(seen));
        assert_eq!(StatusReader::running_observer(&gone), None);
        segments::remove_abandoned_status(&prefix);
        assert_eq!(observer_paths(&prefix, 9), [observer]);
        drop(file_of_observer);
        assert!(observer_paths(&prefix, 9).is_empty());
        assert_eq!(engines(&prefix), [("running".to_owned(), running)]);
        drop(file);
        assert!(engines(&prefix).is_empty());
    }
}
