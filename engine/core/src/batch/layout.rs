//! Where each array of a batch lies: the one description that every reader and writer uses.

use bytemuck::Pod;
use serde::{Deserialize, Serialize};

use super::block::{BLOCK_BYTES, Block, blocks_for};
use super::stamp::Stamp;

/// Number type of a section.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Dtype {
    Uint8,
    Int32,
    Uint64,
    Float32,
    Float64,
}

impl Dtype {
    /// Bytes of one number.
    pub const fn size(self) -> usize {
        match self {
            Dtype::Uint8 => 1,
            Dtype::Int32 | Dtype::Float32 => 4,
            Dtype::Uint64 | Dtype::Float64 => 8,
        }
    }

    /// numpy's name of the type.
    pub const fn name(self) -> &'static str {
        match self {
            Dtype::Uint8 => "uint8",
            Dtype::Int32 => "int32",
            Dtype::Uint64 => "uint64",
            Dtype::Float32 => "float32",
            Dtype::Float64 => "float64",
        }
    }
}

/// Ties a Rust number type to its [`Dtype`].
pub trait Element: Pod + Send + Sync {
    /// The type's description in a layout.
    const DTYPE: Dtype;
}

macro_rules! element {
    ($($rust:ty => $dtype:ident),*) => { $(impl Element for $rust { const DTYPE: Dtype = Dtype::$dtype; })* };
}
element!(u8 => Uint8, i32 => Int32, u64 => Uint64, f32 => Float32, f64 => Float64);

/// One array of a batch: `num_envs` rows of `shape` numbers, C order, at `offset` bytes from the batch's start.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Section {
    pub name: String,
    pub dtype: Dtype,
    /// Shape of one environment's row; empty for a single number.
    pub shape: Vec<usize>,
    /// Bytes from the start of the batch; a multiple of 64.
    pub offset: usize,
}

impl Section {
    /// Numbers in one environment's row.
    pub fn width(&self) -> usize {
        self.shape.iter().product()
    }
}

/// The sections of a batch of `num_envs` environments, in the order of their offsets.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layout {
    num_envs: usize,
    sections: Vec<Section>,
    /// A block behind the sections belongs to the pool that writes them.
    stamped: bool,
}

impl Layout {
    /// Lays `(name, dtype, row shape)` out one after the other, each aligned to 64 bytes.
    pub fn new<'a>(num_envs: usize, arrays: impl IntoIterator<Item = (&'a str, Dtype, Vec<usize>)>) -> Self {
        let mut layout = Layout { num_envs, sections: Vec::new(), stamped: false };
        for (name, dtype, shape) in arrays {
            let offset = layout.blocks() * BLOCK_BYTES;
            layout.sections.push(Section { name: name.to_owned(), dtype, shape, offset });
        }
        layout
    }

    /// The same sections with room for a pool's stamp behind them.
    pub(super) fn with_stamp(self) -> Self {
        Layout { stamped: true, ..self }
    }

    /// The place of the pool's stamp.
    pub(super) fn stamp_block(&self) -> Option<usize> {
        self.stamped.then(|| self.section_blocks())
    }

    /// Makes the pool that next writes into `batch` draw every frame in full. Whoever has changed frames in a batch, and gives
    /// it to a pool again, has to call this in between.
    pub fn forget_frames(&self, batch: &mut [Block]) {
        Stamp::default().write(self, batch);
    }

    /// Environments in the batch.
    pub fn num_envs(&self) -> usize {
        self.num_envs
    }

    /// All sections, in the order of their offsets.
    pub fn sections(&self) -> &[Section] {
        &self.sections
    }

    /// The section of that name, if this batch has it.
    pub fn section(&self, name: &str) -> Option<&Section> {
        self.sections.iter().find(|section| section.name == name)
    }

    /// Bytes that the section's rows take, without the padding behind them.
    pub fn section_bytes(&self, section: &Section) -> usize {
        self.num_envs * section.width() * section.dtype.size()
    }

    /// Blocks that the whole batch takes.
    pub fn blocks(&self) -> usize {
        self.section_blocks() + usize::from(self.stamped)
    }

    /// Blocks that the sections take.
    pub(super) fn section_blocks(&self) -> usize {
        self.sections.last().map_or(0, |last| blocks_for(last.offset + self.section_bytes(last)))
    }

    /// The section's numbers in `batch`: `num_envs` rows after each other. Empty if the layout has no such section, if `T` is
    /// not its type, or if `batch` is too short.
    pub fn read<'a, T: Element>(&self, batch: &'a [Block], name: &str) -> &'a [T] {
        self.section(name)
            .filter(|section| section.dtype == T::DTYPE)
            .and_then(|section| {
                let bytes: &[u8] = bytemuck::cast_slice(batch);
                bytes.get(section.offset..section.offset + self.section_bytes(section))
            })
            .map_or(&[], bytemuck::cast_slice)
    }

    /// As [`Layout::read`], for writing.
    pub fn write<'a, T: Element>(&self, batch: &'a mut [Block], name: &str) -> &'a mut [T] {
        match self.section(name).filter(|section| section.dtype == T::DTYPE) {
            Some(section) => {
                let range = section.offset..section.offset + self.section_bytes(section);
                let bytes: &mut [u8] = bytemuck::cast_slice_mut(batch);
                bytes.get_mut(range).map_or(&mut [], bytemuck::cast_slice_mut)
            }
            None => &mut [],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::block::zeroed;
    use super::*;

    #[test]
    fn sections_are_aligned_and_do_not_overlap() {
        let layout = Layout::new(
            3,
            [("a", Dtype::Uint8, vec![5, 7]), ("b", Dtype::Float64, vec![]), ("c", Dtype::Float32, vec![2])],
        );
        let mut end = 0;
        for section in layout.sections() {
            assert_eq!(section.offset % BLOCK_BYTES, 0);
            assert!(section.offset >= end);
            end = section.offset + layout.section_bytes(section);
        }
        assert_eq!(layout.blocks() * BLOCK_BYTES, end.next_multiple_of(BLOCK_BYTES));
    }

    #[test]
    fn reading_returns_what_was_written() {
        let layout = Layout::new(4, [("a", Dtype::Uint8, vec![3]), ("b", Dtype::Float64, vec![])]);
        let mut batch = zeroed(layout.blocks());
        layout.write::<f64>(&mut batch, "b").copy_from_slice(&[1.0, 2.0, 3.0, 4.0]);
        layout.write::<u8>(&mut batch, "a").fill(9);
        assert_eq!(layout.read::<f64>(&batch, "b"), [1.0, 2.0, 3.0, 4.0]);
        assert_eq!(layout.read::<u8>(&batch, "a"), [9; 12]);
    }

    #[test]
    fn a_wrong_name_type_or_length_reads_as_empty() {
        let layout = Layout::new(4, [("a", Dtype::Float64, vec![9])]);
        let batch = zeroed(layout.blocks());
        assert!(layout.read::<f64>(&batch, "b").is_empty());
        assert!(layout.read::<f32>(&batch, "a").is_empty());
        assert!(layout.read::<f64>(&batch[1..], "a").is_empty());
    }

    #[test]
    fn the_stamp_lies_behind_the_sections() {
        let layout = Layout::new(3, [("a", Dtype::Uint8, vec![30])]).with_stamp();
        let mut batch = zeroed(layout.blocks());
        assert_eq!(batch.len(), 3);
        let stamp = Stamp { pool: 7, slot: 1, write: 2 };
        stamp.write(&layout, &mut batch);
        assert_eq!(Stamp::read(&layout, &batch), stamp);
        assert_eq!(layout.read::<u8>(&batch, "a"), [0; 90]);
        layout.forget_frames(&mut batch);
        assert_eq!(Stamp::read(&layout, &batch), Stamp::default());
        assert_eq!(Stamp::read(&layout, &batch[..2]), Stamp::default());
    }

    #[test]
    fn a_layout_survives_json() {
        let layout = Layout::new(4, [("a", Dtype::Uint8, vec![84, 84, 3]), ("b", Dtype::Uint64, vec![])]);
        let text = serde_json::to_string(&layout).unwrap();
        assert_eq!(serde_json::from_str::<Layout>(&text).unwrap(), layout);
    }
}
