//! Film files: animated WebP, and MP4 through ffmpeg.

use std::fs::File;
use std::io::{BufWriter, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use crate::failure::Failure;
use crate::film::picture::magnified;
use crate::film::webp::WebpFilm;

/// The environment variable that names the program ffmpeg, the same as for the Python package imageio-ffmpeg.
const FFMPEG: &str = "IMAGEIO_FFMPEG_EXE";

/// Properties that all pictures of a film share.
#[derive(Clone, Copy, Debug)]
pub struct Shape {
    /// Size of a picture before it is magnified.
    pub size: (usize, usize),
    /// Pixels of the file for each pixel of a picture, in each direction.
    pub scale: usize,
    /// Pictures per second.
    pub fps: u16,
}

enum Encoder {
    /// Lossless.
    Webp(WebpFilm<BufWriter<File>>),
    /// H.264 or whatever ffmpeg chooses, lossy.
    Mp4(Child),
}

/// A film that is being written. If it is dropped without [`finish`](FilmFile::finish), no file remains.
pub struct FilmFile {
    encoder: Option<Encoder>,
    shape: Shape,
    /// The duration so far in pictures.
    duration: u64,
    partial: PathBuf,
    path: PathBuf,
}

impl FilmFile {
    /// Starts a file of the format that the suffix of `path` names. Fails if the suffix is another one, the folder
    /// cannot be written, or ffmpeg does not start.
    pub fn create(path: &Path, shape: Shape) -> Result<Self, Failure> {
        let suffix = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        if !["webp", "mp4"].contains(&suffix.as_str()) {
            return Err(format!("a film's name must end in .webp or .mp4, got `{}`", path.display()).into());
        }
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let partial = path.with_file_name(format!(".{name}.{}.partial.{suffix}", std::process::id()));
        // Also for ffmpeg, so that an unwritable folder gives the same error for both formats.
        let created = File::create(&partial).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
        let mut film = FilmFile { encoder: None, shape, duration: 0, partial, path: path.to_owned() };
        let (width, height) = (shape.size.0 * shape.scale, shape.size.1 * shape.scale);
        film.encoder = Some(if suffix == "mp4" {
            Encoder::Mp4(film.ffmpeg(&format!("{width}x{height}"))?)
        } else {
            Encoder::Webp(WebpFilm::new(BufWriter::new(created), (u32::try_from(width)?, u32::try_from(height)?))?)
        });
        Ok(film)
    }

    fn ffmpeg(&self, size: &str) -> Result<Child, Failure> {
        let program = std::env::var_os(FFMPEG).unwrap_or_else(|| "ffmpeg".into());
        let mut command = Command::new(&program);
        command.args(["-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r"]);
        command.arg(self.shape.fps.to_string()).args(["-i", "-", "-pix_fmt", "yuv420p"]).arg(&self.partial);
        let child = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn();
        child.map_err(|error| match error.kind() {
            ErrorKind::NotFound => format!(
                "an .mp4 needs ffmpeg, and there is no program `{}`: install it, or let {FFMPEG} name it, or use .webp",
                program.display()
            )
            .into(),
            _ => format!("cannot start ffmpeg: {}: {error}", program.display()).into(),
        })
    }

    /// Adds a picture, RGB pixels in rows, that is shown for `count` picture durations, 1 or more. Fails if the picture
    /// cannot be encoded or written.
    pub fn add(&mut self, pixels: &[[u8; 3]], count: u16) -> Result<(), Failure> {
        self.encode(pixels, count).map_err(|error| self.failure(&error))
    }

    fn failure(&self, error: &Failure) -> Failure {
        format!("cannot write {}: {error}", self.path.display()).into()
    }

    fn encode(&mut self, pixels: &[[u8; 3]], count: u16) -> Result<(), Failure> {
        let Shape { size: (width, _), scale, fps } = self.shape;
        let (start, end) = (self.duration, self.duration + u64::from(count));
        self.duration = end;
        let pixels = magnified(pixels, width, scale).into_flattened();
        match self.encoder.as_mut() {
            Some(Encoder::Webp(film)) => {
                // Rounding errors do not add up: the whole film has the right duration.
                let milliseconds = |pictures: u64| (pictures * 1000 + u64::from(fps) / 2) / u64::from(fps);
                film.add(&pixels, u32::try_from(milliseconds(end) - milliseconds(start))?)?;
            }
            Some(Encoder::Mp4(child)) => {
                let written = child.stdin.as_mut().map(|stdin| (0..count).try_for_each(|_| stdin.write_all(&pixels)));
                match written {
                    // ffmpeg has ended; `end` reports its error.
                    Some(Err(error)) if error.kind() == ErrorKind::BrokenPipe => return self.end(),
                    Some(written) => written.map_err(|error| format!("cannot write to ffmpeg: {error}"))?,
                    None => {}
                }
            }
            None => {}
        }
        Ok(())
    }

    /// Ends the encoder, which writes the rest of the file.
    fn end(&mut self) -> Result<(), Failure> {
        match self.encoder.take() {
            Some(Encoder::Webp(film)) => film.finish()?,
            Some(Encoder::Mp4(mut child)) => {
                drop(child.stdin.take());
                let mut errors = String::new();
                if let Some(stderr) = &mut child.stderr {
                    stderr.read_to_string(&mut errors)?;
                }
                let status = child.wait()?;
                if !status.success() {
                    let path = self.path.display();
                    return Err(format!("ffmpeg failed to write {path} ({status}): {}", errors.trim()).into());
                }
            }
            None => {}
        }
        Ok(())
    }

    /// Completes the file and, once it is on disk, renames it to its final name. Fails if the rest of the file cannot
    /// be written, or ffmpeg failed.
    pub fn finish(mut self) -> Result<(), Failure> {
        self.end()
            .and_then(|()| Ok(File::open(&self.partial)?.sync_all()?))
            .and_then(|()| Ok(std::fs::rename(&self.partial, &self.path)?))
            .map_err(|error| self.failure(&error))
    }
}

impl Drop for FilmFile {
    fn drop(&mut self) {
        if let Some(Encoder::Mp4(mut child)) = self.encoder.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
        // Fails for a finished film, which was renamed.
        let _ = std::fs::remove_file(&self.partial);
    }
}
