//! Pixels, and runs: consecutive pixels of a column, which are contiguous in memory.

use std::ops::Range;

/// A colour: red, green, blue.
pub type Rgb = [u8; 3];

/// Sets all pixels of a run to one colour.
pub(super) fn fill_run(run: &mut [u8], color: Rgb) {
    if color == [color[0]; 3] {
        return fill_bytes(run, color[0]);
    }
    // Writes pixels one by one up to this length; copies the rest in chunks that double.
    let mut painted = run.len().min(96 * 3);
    run[..painted].as_chunks_mut().0.fill(color);
    while painted < run.len() {
        let length = painted.min(run.len() - painted);
        run.copy_within(..length, painted);
        painted += length;
    }
}

/// Fills bytes: 16 to 63 of them from registers, without a call to `memset`.
#[inline]
fn fill_bytes(bytes: &mut [u8], byte: u8) {
    match bytes.len() {
        16..32 => fill_ends::<16>(bytes, byte),
        32..64 => fill_ends::<32>(bytes, byte),
        _ => bytes.fill(byte),
    }
}

/// Fills the first and the last `N` bytes.
#[inline]
fn fill_ends<const N: usize>(bytes: &mut [u8], byte: u8) {
    if let Some(first) = bytes.first_chunk_mut::<N>() {
        *first = [byte; N];
    }
    if let Some(last) = bytes.last_chunk_mut::<N>() {
        *last = [byte; N];
    }
}

/// The part of `first..=last` that lies in `within`.
#[inline]
pub(super) fn clip(first: i64, last: i64, within: &Range<usize>) -> Range<usize> {
    let (low, high) = (within.start as i64, within.end as i64);
    let start = first.clamp(low, high);
    let end = last.saturating_add(1).clamp(start, high);
    start as usize..end as usize
}

/// Copies a run between slices of the same length.
///
/// Copies of 3 to 127 bytes are two blocks of a fixed size that may overlap, in registers, without a call to `memcpy`.
///
/// # Panics
///
/// If the lengths differ and `source` has fewer than 3 bytes or at least 128.
#[inline]
pub fn copy_run(source: &[u8], target: &mut [u8]) {
    match source.len() {
        3 => copy_ends::<3>(source, target),
        4..8 => copy_ends::<4>(source, target),
        8..16 => copy_ends::<8>(source, target),
        16..32 => copy_ends::<16>(source, target),
        32..64 => copy_ends::<32>(source, target),
        64..128 => copy_ends::<64>(source, target),
        _ => target.copy_from_slice(source),
    }
}

/// Copies the first and the last `N` bytes.
#[inline]
fn copy_ends<const N: usize>(source: &[u8], target: &mut [u8]) {
    if let (Some(source), Some(target)) = (source.first_chunk::<N>(), target.first_chunk_mut()) {
        *target = *source;
    }
    if let (Some(source), Some(target)) = (source.last_chunk::<N>(), target.last_chunk_mut()) {
        *target = *source;
    }
}
