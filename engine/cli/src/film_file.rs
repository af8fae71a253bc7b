//! Film files: GIF, animated WebP, animated PNG, and MP4 through ffmpeg.

use std::fs::File;
use std::io::{BufWriter, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use super::failure::Failure;
use super::film_picture::{Picture, magnified};
use super::film_webp::WebpFilm;

/// The environment variable that names the program ffmpeg, the same as for the Python package imageio-ffmpeg.
const FFMPEG: &str = "IMAGEIO_FFMPEG_EXE";

/// The format of a film file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// With a palette of 256 colours for each picture.
    Gif,
    /// Animated WebP, lossless.
    Webp,
    /// Animated PNG, lossless.
    Png,
    /// H.264 or whatever ffmpeg chooses, lossy.
    Mp4,
}

impl Format {
    /// The format for a file name's suffix.
    pub fn of(file: &Path) -> Result<Self, Failure> {
        let suffix = file.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        match suffix.as_str() {
            "gif" => Ok(Format::Gif),
            "webp" => Ok(Format::Webp),
            "png" => Ok(Format::Png),
            "mp4" => Ok(Format::Mp4),
            _ => Err(format!("--film must end in .gif, .webp, .png or .mp4, got `{}`", file.display()).into()),
        }
    }
}

/// Properties that all pictures of a film share.
#[derive(Clone, Copy, Debug)]
pub struct Shape {
    /// Size of a picture before it is magnified.
    pub size: (usize, usize),
    /// Pixels of the file for each pixel of a picture, in each direction.
    pub scale: usize,
    /// Pictures per second.
    pub fps: u16,
    /// Number of pictures; only [`Format::Png`] needs it.
    pub pictures: u32,
}

enum Encoder {
    Gif(gif::Encoder<BufWriter<File>>),
    Webp(WebpFilm<BufWriter<File>>),
    Png(png::Writer<BufWriter<File>>),
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
    /// Starts a file of the format that `path` names.
    pub fn create(path: &Path, shape: Shape) -> Result<Self, Failure> {
        let format = Format::of(path)?;
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let suffix = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        let partial = path.with_file_name(format!(".{name}.{}.partial.{suffix}", std::process::id()));
        // Also for ffmpeg, so that an unwritable folder gives the same error for all formats.
        let created = File::create(&partial).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
        let mut film = FilmFile { encoder: None, shape, duration: 0, partial, path: path.to_owned() };
        film.encoder = Some(film.encoder(format, BufWriter::new(created))?);
        Ok(film)
    }

    fn encoder(&self, format: Format, file: BufWriter<File>) -> Result<Encoder, Failure> {
        let Shape { size: (width, height), scale, fps, pictures } = self.shape;
        let (width, height) = (width * scale, height * scale);
        Ok(match format {
            Format::Gif => {
                let mut encoder = gif::Encoder::new(file, u16::try_from(width)?, u16::try_from(height)?, &[])?;
                encoder.set_repeat(gif::Repeat::Infinite)?;
                Encoder::Gif(encoder)
            }
            Format::Webp => Encoder::Webp(WebpFilm::new(file, (u32::try_from(width)?, u32::try_from(height)?))?),
            Format::Png => {
                let mut encoder = png::Encoder::new(file, u32::try_from(width)?, u32::try_from(height)?);
                encoder.set_color(png::ColorType::Rgb);
                encoder.set_depth(png::BitDepth::Eight);
                encoder.set_animated(pictures, 0)?;
                Encoder::Png(encoder.write_header()?)
            }
            Format::Mp4 => Encoder::Mp4(self.ffmpeg(&format!("{width}x{height}"), fps)?),
        })
    }

    fn ffmpeg(&self, size: &str, fps: u16) -> Result<Child, Failure> {
        let program = std::env::var_os(FFMPEG).unwrap_or_else(|| "ffmpeg".into());
        let mut command = Command::new(&program);
        command.args(["-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r"]);
        command.arg(fps.to_string()).args(["-i", "-", "-pix_fmt", "yuv420p"]).arg(&self.partial);
        let child = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn();
        child.map_err(|error| match error.kind() {
            ErrorKind::NotFound => format!(
                "an .mp4 needs ffmpeg, and there is no program `{}`: install it, or let {FFMPEG} name it, or use .gif, .webp or .png",
                program.display()
            )
            .into(),
            _ => format!("cannot start ffmpeg: {}: {error}", program.display()).into(),
        })
    }

    /// Adds a picture that is shown for `count` picture durations, 1 or more.
    pub fn add(&mut self, picture: &Picture, count: u16) -> Result<(), Failure> {
        let Shape { scale, fps, .. } = self.shape;
        let (start, end) = (self.duration, self.duration + u64::from(count));
        self.duration = end;
        // Rounding errors do not add up: the whole film has the right duration.
        let time = |pictures: u64, unit: u64| (pictures * unit + u64::from(fps) / 2) / u64::from(fps);
        let duration = |unit: u64| time(end, unit) - time(start, unit);
        let pixels = || magnified(&picture.pixels, picture.width, scale).into_flattened();
        match self.encoder.as_mut() {
            Some(Encoder::Gif(encoder)) => {
                let (width, height) = (u16::try_from(picture.width)?, u16::try_from(picture.height)?);
                let mut frame = gif::Frame::from_rgb(width, height, picture.pixels.as_flattened());
                frame.buffer = magnified(&frame.buffer, picture.width, scale).into();
                (frame.width, frame.height) =
                    (u16::try_from(picture.width * scale)?, u16::try_from(picture.height * scale)?);
                frame.delay = u16::try_from(duration(100))?;
                encoder.write_frame(&frame)?;
            }
            Some(Encoder::Webp(film)) => film.add(&pixels(), u32::try_from(duration(1000))?)?,
            Some(Encoder::Png(writer)) => {
                writer.set_frame_delay(count, fps)?;
                writer.write_image_data(&pixels())?;
            }
            Some(Encoder::Mp4(child)) => {
                let pixels = pixels();
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
            Some(Encoder::Gif(encoder)) => encoder.into_inner()?.flush()?,
            Some(Encoder::Webp(film)) => film.finish()?,
            Some(Encoder::Png(writer)) => writer.finish()?,
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

    /// Completes the file and renames it to its final name.
    pub fn finish(mut self) -> Result<(), Failure> {
        self.end()
            .and_then(|()| Ok(std::fs::rename(&self.partial, &self.path)?))
            .map_err(|error| format!("cannot write {}: {error}", self.path.display()).into())
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn suffixes_name_formats() {
        for (name, format) in
            [("a.gif", Format::Gif), ("b.webp", Format::Webp), ("x/b.c.PNG", Format::Png), ("c.Mp4", Format::Mp4)]
        {
            assert_eq!(Format::of(Path::new(name)).unwrap(), format);
        }
    }
}
