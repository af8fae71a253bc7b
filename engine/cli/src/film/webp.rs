//! Animated WebP: lossless pictures, one after the other, in a RIFF file.

use std::io::{Seek, SeekFrom, Write};

use image_webp::{ColorType, WebPEncoder};

use crate::failure::Failure;

/// Bytes before the first chunk: `RIFF`, the length of what follows, `WEBP`.
const HEADER: usize = 12;

/// Bytes of a chunk's name and length.
const CHUNK_HEADER: usize = 8;

/// The flag of a file with an animation.
const ANIMATION: u32 = 1 << 1;

/// The flag of a picture that replaces the previous one without blending.
const REPLACES: u8 = 1 << 1;

/// Durations have 24 bits.
const MAX_MILLISECONDS: u32 = (1 << 24) - 1;

/// An animated WebP file that is being written. It loops forever.
pub struct WebpFilm<W> {
    file: W,
    size: (u32, u32),
}

impl<W: Write + Seek> WebpFilm<W> {
    /// Starts a file with pictures of that width and height.
    pub fn new(file: W, size: (u32, u32)) -> Result<Self, Failure> {
        let mut film = WebpFilm { file, size };
        // `finish` writes the length.
        film.file.write_all(b"RIFF\0\0\0\0WEBP")?;
        let extended = [&ANIMATION.to_le_bytes()[..], &three(size.0 - 1), &three(size.1 - 1)].concat();
        film.chunk(b"VP8X", &[&extended])?;
        // A transparent background, and the number of repetitions, 0 for endless.
        film.chunk(b"ANIM", &[&[0; 4], &[0; 2]])?;
        Ok(film)
    }

    /// Adds a picture of RGB pixels, rows from the top.
    pub fn add(&mut self, pixels: &[u8], milliseconds: u32) -> Result<(), Failure> {
        let (width, height) = self.size;
        let mut still = Vec::new();
        WebPEncoder::new(&mut still).encode(pixels, width, height, ColorType::Rgb8)?;
        // A still picture without metadata is a single chunk, which an animation contains unchanged.
        let picture = still.get(HEADER..).unwrap_or_default();
        let duration = three(milliseconds.min(MAX_MILLISECONDS));
        let place = [&three(0)[..], &three(0), &three(width - 1), &three(height - 1), &duration, &[REPLACES]].concat();
        self.chunk(b"ANMF", &[&place, picture])
    }

    /// Completes the file.
    pub fn finish(mut self) -> Result<(), Failure> {
        let end = self.file.stream_position()?;
        let length = u32::try_from(end - CHUNK_HEADER as u64)
            .map_err(|_| "a .webp file has at most 4 GiB; record fewer episodes, or an .mp4")?;
        self.file.seek(SeekFrom::Start(4))?;
        self.file.write_all(&length.to_le_bytes())?;
        Ok(self.file.flush()?)
    }

    /// Writes a chunk, padded so that the next one starts at an even offset.
    fn chunk(&mut self, name: &[u8; 4], parts: &[&[u8]]) -> Result<(), Failure> {
        let length = u32::try_from(parts.iter().map(|part| part.len()).sum::<usize>())?;
        self.file.write_all(name)?;
        self.file.write_all(&length.to_le_bytes())?;
        parts.iter().try_for_each(|part| self.file.write_all(part))?;
        Ok(self.file.write_all(&[0][..(length % 2) as usize])?)
    }
}

/// A number of 24 bits, little-endian.
fn three(number: u32) -> [u8; 3] {
    let [first, second, third, _] = number.to_le_bytes();
    [first, second, third]
}
