//! The files in shared memory in which an engine draws pictures for viewers, if its batches have no frames.
//!
//! A viewer creates its file and writes which environments it wants to see; the engine writes their frames behind that. As
//! with a status file, the viewer holds an `flock` until its process ends. Both sides use `pread` and `pwrite` instead of a
//! mapping, so that neither can harm the other by truncating the file.
//!
//! A sequence number precedes the pictures; it is odd while they are being written (a sequence lock). What is wanted needs
//! none, since the pictures repeat it.

use std::fs::{self, File};
use std::io;
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{Ordering, fence};

use bytemuck::{Pod, Zeroable};
use rustix::fs::{FlockOperation, flock};

use crate::namespace::segments::{self, PICTURE_SUFFIX, open_own};

/// Maximum number of environments that a viewer sees at a time.
pub(crate) const MAX_PICTURES: usize = 256;

/// Maximum size of all pictures of a viewer in bytes, which limits how long the engine draws.
pub(crate) const MAX_PICTURE_BYTES: usize = 16 << 20;

/// First word of the file.
const MAGIC: u64 = u64::from_le_bytes(*b"EGYMPICT");

/// Where the sequence number is. The pictures follow it.
const SEQUENCE: u64 = 2048;
const PICTURES: u64 = SEQUENCE + size_of::<u64>() as u64;
const _: () = assert!(size_of::<Wanted>() <= SEQUENCE as usize);

/// The files of an engine's viewers.
pub(crate) fn paths(prefix: &str, incarnation: u64) -> Vec<PathBuf> {
    segments::named(&format!("{prefix}{incarnation:016x}."), PICTURE_SUFFIX)
}

/// The environments that a viewer wants to see.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Wanted {
    magic: u64,
    group: u32,
    count: u32,
    envs: [u32; MAX_PICTURES],
}

impl Wanted {
    /// The first of these environments, at most [`MAX_PICTURES`].
    pub(crate) fn new(group: usize, envs: &[usize]) -> Self {
        let number = |number: usize| u32::try_from(number).unwrap_or(u32::MAX);
        let count = envs.len().min(MAX_PICTURES);
        let mut wanted = Wanted { magic: MAGIC, group: number(group), count: count as u32, ..Wanted::zeroed() };
        wanted.envs.iter_mut().zip(envs).for_each(|(to, env)| *to = number(*env));
        wanted
    }

    pub(crate) fn group(&self) -> usize {
        self.group as usize
    }

    /// Their numbers; `None` if the file was not written by a viewer.
    pub(crate) fn envs(&self) -> Option<impl ExactSizeIterator<Item = usize>> {
        let envs = self.envs.get(..self.count as usize).filter(|_| self.magic == MAGIC)?;
        Some(envs.iter().map(|env| *env as usize))
    }
}

/// What precedes the frames.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct PictureHead {
    /// The number of the group's last batch.
    pub step: u64,
    pub wanted: Wanted,
}

/// A viewer's file, on either side.
#[derive(Debug)]
pub(crate) struct PictureFile(File);

impl PictureFile {
    /// Creates a viewer's file, which belongs to this process. `number` is random.
    pub(crate) fn create(prefix: &str, incarnation: u64, number: u64) -> io::Result<(Self, PathBuf)> {
        let path = segments::path(&format!("{prefix}{incarnation:016x}.{number:016x}{PICTURE_SUFFIX}"));
        let unnamed = path.with_extension("new");
        let file = File::options().read(true).write(true).create_new(true).mode(0o600).open(&unnamed)?;
        let file = PictureFile(file);
        let prepared = flock(&file.0, FlockOperation::NonBlockingLockExclusive)
            .map_err(io::Error::from)
            .and_then(|()| file.want(&Wanted::new(0, &[])))
            .and_then(|()| fs::rename(&unnamed, &path));
        match prepared {
            Ok(()) => Ok((file, path)),
            Err(error) => {
                let _ = fs::remove_file(unnamed);
                Err(error)
            }
        }
    }

    /// Opens a viewer's file in the engine.
    pub(crate) fn open(path: &Path) -> Option<Self> {
        open_own(path, true).map(PictureFile)
    }

    /// Whether the viewer's process is running.
    pub(crate) fn has_viewer(&self) -> bool {
        segments::has_writer(&self.0)
    }

    pub(crate) fn want(&self, wanted: &Wanted) -> io::Result<()> {
        self.0.write_all_at(bytemuck::bytes_of(wanted), 0)
    }

    pub(crate) fn wanted(&self) -> io::Result<Wanted> {
        self.read(0)
    }

    /// Writes the frames of all wanted environments. `sequence` is even, and another number each time.
    pub(crate) fn draw(&self, sequence: u64, head: &PictureHead, frames: &[u8]) -> io::Result<()> {
        let mark = |sequence: u64| self.0.write_all_at(&sequence.to_ne_bytes(), SEQUENCE);
        mark(sequence.wrapping_sub(1))?;
        fence(Ordering::SeqCst);
        self.0.write_all_at(bytemuck::bytes_of(head), PICTURES)?;
        self.0.write_all_at(frames, PICTURES + size_of::<PictureHead>() as u64)?;
        fence(Ordering::SeqCst);
        mark(sequence)
    }

    /// The sequence number.
    pub(crate) fn sequence(&self) -> io::Result<u64> {
        self.read(SEQUENCE)
    }

    /// The pictures with that sequence number, each of `frame_bytes` bytes; `None` if the engine is writing others.
    pub(crate) fn drawn(&self, sequence: u64, frame_bytes: usize) -> io::Result<Option<(PictureHead, Vec<u8>)>> {
        if !sequence.is_multiple_of(2) {
            return Ok(None);
        }
        fence(Ordering::SeqCst);
        let head: PictureHead = self.read(PICTURES)?;
        let Some(envs) = head.wanted.envs() else { return Ok(None) };
        let mut frames = vec![0; envs.len() * frame_bytes];
        self.0.read_exact_at(&mut frames, PICTURES + size_of::<PictureHead>() as u64)?;
        fence(Ordering::SeqCst);
        Ok((self.sequence()? == sequence).then_some((head, frames)))
    }

    fn read<T: Pod>(&self, at: u64) -> io::Result<T> {
        let mut value = T::zeroed();
        self.0.read_exact_at(bytemuck::bytes_of_mut(&mut value), at).map(|()| value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_never_read_half_written_and_do_not_outlive_their_viewer() {
        let prefix = format!("endless-picture-{}_", std::process::id());
        let (viewer, path) = PictureFile::create(&prefix, 9, 1).unwrap();
        let (engine, wanted) = (PictureFile::open(&path).unwrap(), Wanted::new(0, &[2, 3, 5]));
        viewer.want(&wanted).unwrap();
        assert_eq!(engine.wanted().unwrap(), wanted);
        assert!(viewer.sequence().is_err(), "nothing was drawn");
        let (bytes, mut seen) = (40_000, 0);
        std::thread::scope(|scope| {
            let draw = |n: u64| {
                engine.draw(2 * n, &PictureHead { step: n, wanted }, &vec![n as u8; 3 * bytes]).unwrap();
                std::thread::sleep(std::time::Duration::from_micros(100));
            };
            let drawing = scope.spawn(move || (1..1500).for_each(draw));
            while !drawing.is_finished() {
                let drawn = viewer.sequence().ok().and_then(|sequence| viewer.drawn(sequence, bytes).unwrap());
                let Some((head, frames)) = drawn else { continue };
                assert!(head.wanted == wanted && frames.len() == 3 * bytes);
                assert!(frames.iter().all(|byte| *byte == head.step as u8), "a mixture");
                seen += 1;
            }
        });
        assert!(seen > 0);
        segments::remove_abandoned_status(&prefix);
        assert!(path.exists() && engine.has_viewer());
        drop(viewer);
        assert!(!engine.has_viewer());
        segments::remove_abandoned_status(&prefix);
        assert_eq!(paths(&prefix, 9), [] as [PathBuf; 0]);
    }
}
