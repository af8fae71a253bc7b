//! Draws the pictures that viewers want to see, if batches have no frames.

use std::fs;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use crate::engine::group::Groups;
use crate::engine::status_writer::StatusWriter;
use crate::protocol::picture_file::{self, MAX_PICTURE_BYTES, PictureFile, PictureHead, Wanted};

/// Time between two pictures for a viewer.
const INTERVAL: Duration = Duration::from_millis(100);

/// Maximum number of viewers that are served at a time.
pub(crate) const MAX_VIEWERS: usize = 16;

/// The viewers of an engine. What they write is checked: they may be faulty.
pub(crate) struct PictureDrawer {
    prefix: String,
    incarnation: u64,
    viewers: Vec<Viewer>,
}

struct Viewer {
    path: PathBuf,
    file: PictureFile,
    sequence: u64,
    /// When its wishes were last read.
    last: Instant,
    /// What was drawn last, and at which step.
    drawn: Option<(u64, Wanted)>,
}

impl PictureDrawer {
    pub(crate) fn new(prefix: &str, incarnation: u64) -> Self {
        PictureDrawer { prefix: prefix.to_owned(), incarnation, viewers: Vec::new() }
    }

    /// Looks for new viewers, and removes the files of dead ones.
    pub(crate) fn find_viewers(&mut self) {
        self.viewers.retain(|viewer| viewer.file.has_viewer());
        for path in picture_file::paths(&self.prefix, self.incarnation) {
            if self.viewers.len() == MAX_VIEWERS || self.viewers.iter().any(|viewer| viewer.path == path) {
                continue;
            }
            let Some(file) = PictureFile::open(&path) else { continue };
            if file.has_viewer() {
                self.viewers.push(Viewer { path, file, sequence: 0, last: Instant::now(), drawn: None });
            } else {
                let _ = fs::remove_file(path);
            }
        }
    }

    /// Draws for each viewer whose next picture is due, if there is another one.
    pub(crate) fn draw(&mut self, groups: &Groups, status: &StatusWriter) {
        for viewer in &mut self.viewers {
            if viewer.last.elapsed() >= INTERVAL {
                viewer.last = Instant::now();
                viewer.draw(groups, status);
            }
        }
    }
}

impl Viewer {
    /// `None` if nothing is drawn.
    fn draw(&mut self, groups: &Groups, status: &StatusWriter) -> Option<()> {
        let wanted = self.file.wanted().ok()?;
        if wanted.group() >= groups.len() || self.drawn == Some((status.step(wanted.group()), wanted)) {
            return None;
        }
        let (step, frames) = groups.visit(wanted.group(), |group| {
            let mut frames = Vec::new();
            for env in wanted.envs()? {
                frames.extend(group.frame(env)?);
                if frames.len() > MAX_PICTURE_BYTES {
                    return None;
                }
            }
            Some((status.step(wanted.group()), frames))
        })?;
        self.sequence = self.sequence.wrapping_add(2);
        let drawn = self.file.draw(self.sequence, &PictureHead { step, wanted }, &frames);
        // Probably, there is no memory.
        let drawn = drawn.inspect_err(|error| tracing::debug!(%error, "cannot draw for a viewer"));
        self.drawn = drawn.ok().map(|()| (step, wanted));
        self.drawn.map(drop)
    }
}
