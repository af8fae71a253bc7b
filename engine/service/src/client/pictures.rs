//! Pictures of environments whose batches have no frames.

use std::fs;
use std::path::PathBuf;

use endless_gym_core::raster::FrameShape;

use crate::client::observer::Observer;
use crate::error::ServiceError;
use crate::namespace::memory;
use crate::protocol::picture_file::{MAX_PICTURE_BYTES, PictureFile, Wanted};

/// Asks an engine whose batches have no frames to draw some environments for this process.
///
/// The engine finds this within half a second, draws at most ten times per second, and writes into memory that this process
/// provides. It draws nothing unless a process has asked, and stops within half a second after this is dropped or its process
/// has ended. It draws for at most 16 of these at a time.
///
/// ```no_run
/// use endless_gym_service::{ConnectConfig, Observer, Pictures};
///
/// let observer = Observer::connect(&ConnectConfig::new("endless"), 0)?;
/// let mut pictures = Pictures::of(&observer)?.expect("the environment has frames, and its batches have none");
/// pictures.want(0, &[0, 3])?;
/// while !pictures.refresh() {
///     std::thread::sleep(std::time::Duration::from_millis(30));
/// }
/// let newest = pictures.newest().expect("there is one");
/// println!("environments {:?} at step {}", newest.envs, newest.step);
/// # Ok::<(), endless_gym_service::ServiceError>(())
/// ```
#[derive(Debug)]
pub struct Pictures {
    file: PictureFile,
    path: PathBuf,
    process: u32,
    shape: FrameShape,
    wanted: Wanted,
    /// The sequence number of the newest pictures.
    sequence: u64,
    newest: Option<Drawn>,
}

/// What an engine has drawn.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Drawn {
    /// Group of the environments.
    pub group: usize,
    /// Number of the group's last batch before it was drawn; see [`BatchLease::step`](crate::BatchLease::step).
    pub step: u64,
    /// The environments' numbers in their group.
    pub envs: Vec<usize>,
    /// Size of a frame.
    pub shape: FrameShape,
    /// The environments' frames, uint8, one after the other, indexed \[x\]\[y\]\[channel\].
    pub frames: Vec<u8>,
}

impl Pictures {
    /// Asks the engine of an observer, so far for no environments. `None` if its batches have frames, or its environments have
    /// neither frames nor pictures.
    ///
    /// # Errors
    ///
    /// [`ServiceError::RootRemoved`] if the namespace's directory was removed, and [`ServiceError::Middleware`] if no file can be
    /// created in `/dev/shm`.
    pub fn of(observer: &Observer) -> Result<Option<Self>, ServiceError> {
        let (specification, node) = (observer.specification(), observer.node());
        let Some(shape) = specification.shown().filter(|_| specification.frames.is_none()) else { return Ok(None) };
        // Under the creation lock, since another process would remove the file while it is empty.
        let _creating = node.creating()?;
        let (file, path) = PictureFile::create(node.prefix(), specification.incarnation, rand::random())
            .map_err(ServiceError::middleware("cannot ask for pictures"))?;
        let (wanted, process) = (Wanted::new(0, &[]), std::process::id());
        Ok(Some(Pictures { file, path, process, shape, wanted, sequence: 0, newest: None }))
    }

    /// Size of a frame.
    pub fn shape(&self) -> FrameShape {
        self.shape
    }

    /// Asks for other environments of a group, in this order; the first 256 of them, or fewer if their frames have more than 16
    /// MiB. Numbers that do not exist yield no pictures.
    ///
    /// # Errors
    ///
    /// [`ServiceError::SharedMemoryTooSmall`] or [`ServiceError::MemoryLimit`] if there is no room for the frames.
    pub fn want(&mut self, group: usize, envs: &[usize]) -> Result<(), ServiceError> {
        let most = MAX_PICTURE_BYTES / self.shape.bytes().max(1);
        let wanted = Wanted::new(group, &envs[..envs.len().min(most)]);
        if wanted != self.wanted {
            memory::check_free((envs.len().min(most) * self.shape.bytes()) as u64 + memory::MARGIN)?;
            self.file.want(&wanted).map_err(ServiceError::middleware("cannot ask for pictures"))?;
            self.wanted = wanted;
        }
        Ok(())
    }

    /// Reads what the engine has drawn since the last call. Returns whether there was anything.
    pub fn refresh(&mut self) -> bool {
        let Some(sequence) = self.file.sequence().ok().filter(|sequence| *sequence != self.sequence) else {
            return false;
        };
        let Ok(Some((head, frames))) = self.file.drawn(sequence, self.shape.bytes()) else { return false };
        let (group, envs) = (head.wanted.group(), head.wanted.envs().into_iter().flatten().collect());
        self.sequence = sequence;
        self.newest = Some(Drawn { group, step: head.step, envs, shape: self.shape, frames });
        true
    }

    /// What [`refresh`](Self::refresh) read last. It may show environments that were wanted before.
    pub fn newest(&self) -> Option<&Drawn> {
        self.newest.as_ref()
    }
}

impl Drop for Pictures {
    fn drop(&mut self) {
        // A forked child must not remove its parent's file.
        if self.process == std::process::id() {
            let _ = fs::remove_file(&self.path);
        }
    }
}
