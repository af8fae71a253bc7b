//! The position of each section of a batch in memory.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::block::{BLOCK_BYTES, Block, blocks_for};
use super::dtype::{Dtype, Element};
use super::limits::MAX_ENVS;
use super::sections::{ActionSection, BatchSection, Contents, RowShape, SectionTable};
use crate::envs::{ActionSpace, EnvSpec};

/// Maximum number of dimensions of a section's array, including the environment's index.
pub const MAX_DIMENSIONS: usize = 8;

/// One array of a batch: `num_envs` rows of [`shape`](Section::shape) numbers in C order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Section<S: SectionTable = BatchSection> {
    name: S,
    shape: Vec<usize>,
    offset: usize,
    width: usize,
    bytes: usize,
}

impl<S: SectionTable> Section<S> {
    /// Which section it is.
    pub fn name(&self) -> S {
        self.name
    }

    /// Number type.
    pub fn dtype(&self) -> Dtype {
        self.name.dtype()
    }

    /// Shape of one environment's row; empty for a single number. It has fewer than [`MAX_DIMENSIONS`] dimensions.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Bytes from the start of the batch; a multiple of [`BLOCK_BYTES`].
    pub fn offset(&self) -> usize {
        self.offset
    }

    /// Numbers in one environment's row.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Bytes of all rows, without the padding after them.
    pub fn bytes(&self) -> usize {
        self.bytes
    }
}

/// Where the sections of a batch of `num_envs` environments lie in memory.
///
/// Every layout is valid: its sections are those of the table `S` with their number types and numbers of dimensions, each
/// starts at a multiple of [`BLOCK_BYTES`], they do not overlap, and all lie within the declared size. Deserialising rejects
/// anything else with a [`LayoutError`].
///
/// ```
/// use endless_gym_core::batch::{BatchSection, Contents, Frames, Layout, batch_layout, zeroed};
/// use endless_gym_memory_gym::memory_gym;
///
/// let contents = Contents { frames: Some(Frames::default()), ..Contents::default() };
/// let layout = batch_layout(memory_gym().spec("MysteryPath-v0")?, 16, contents)?;
/// let observation = layout.section(BatchSection::Observation).unwrap();
/// assert_eq!(observation.shape(), [84, 84, 3]);
///
/// let mut batch = zeroed(layout.blocks());
/// layout.write::<f64>(&mut batch, BatchSection::Reward)[3] = 0.1;
/// assert_eq!(layout.read::<f64>(&batch, BatchSection::Reward)[3], 0.1);
///
/// let mut json = serde_json::to_value(&layout)?;
/// assert_eq!(serde_json::from_value::<Layout>(json.clone())?, layout);
/// json["num_envs"] = 0.into();
/// let error = serde_json::from_value::<Layout>(json).unwrap_err();
/// assert_eq!(error.to_string(), "num_envs must be 1 to 1048576, got 0");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "LayoutFields", into = "LayoutFields", bound = "S: SectionTable")]
pub struct Layout<S: SectionTable = BatchSection> {
    num_envs: usize,
    /// In the order of their offsets.
    sections: Vec<Section<S>>,
    blocks: usize,
}

/// The layout of the message that a trainer sends to an engine.
pub type ActionLayout = Layout<ActionSection>;

/// The layout of a batch of `num_envs` environments, 1 to [`MAX_ENVS`].
///
/// # Errors
///
/// [`LayoutError`] if `num_envs` is out of its range.
pub fn batch_layout(spec: &EnvSpec, num_envs: usize, contents: Contents) -> Result<Layout, LayoutError> {
    let sections = BatchSection::ALL.iter();
    Layout::new(num_envs, sections.filter_map(|section| Some((*section, section.row_shape(spec, contents)?))))
}

/// The layout of the message that a trainer sends to an engine, for `num_envs` environments, 1 to [`MAX_ENVS`].
///
/// # Errors
///
/// [`LayoutError`] if `num_envs` is out of its range.
pub fn action_layout(space: &ActionSpace, num_envs: usize) -> Result<ActionLayout, LayoutError> {
    check_num_envs(num_envs)?;
    Layout::new(num_envs, ActionSection::ALL.iter().map(|section| (*section, section.row_shape(space, num_envs))))
}

impl<S: SectionTable> Layout<S> {
    /// Places sections with these row shapes one after the other.
    fn new(num_envs: usize, sections: impl IntoIterator<Item = (S, Vec<usize>)>) -> Result<Self, LayoutError> {
        let mut builder = Builder::new(num_envs)?;
        for (name, shape) in sections {
            let offset = blocks_for(builder.end) * BLOCK_BYTES;
            builder.add(name, shape, offset)?;
        }
        builder.finish()
    }

    /// Number of environments in the batch, 1 to [`MAX_ENVS`].
    pub fn num_envs(&self) -> usize {
        self.num_envs
    }

    /// All sections, in the order of their offsets.
    pub fn sections(&self) -> &[Section<S>] {
        &self.sections
    }

    /// A section, if the batch has it.
    pub fn section(&self, name: S) -> Option<&Section<S>> {
        self.sections.iter().find(|section| section.name == name)
    }

    /// Size of the whole batch in blocks.
    pub fn blocks(&self) -> usize {
        self.blocks
    }

    /// Size of the sections in blocks, without the writer's stamp.
    pub(super) fn section_blocks(&self) -> usize {
        self.blocks - S::STAMP_BLOCKS
    }

    /// The section's numbers in `batch`: `num_envs` consecutive rows. Empty if the layout lacks the section, if `T` is not its
    /// type, or if `batch` is too short.
    pub fn read<'a, T: Element>(&self, batch: &'a [Block], name: S) -> &'a [T] {
        self.section(name)
            .filter(|_| name.dtype() == T::DTYPE)
            .and_then(|section| {
                let bytes: &[u8] = bytemuck::cast_slice(batch);
                bytes.get(section.offset..section.offset + section.bytes)
            })
            .map_or(&[], bytemuck::cast_slice)
    }

    /// Like [`Layout::read`], for writing.
    pub fn write<'a, T: Element>(&self, batch: &'a mut [Block], name: S) -> &'a mut [T] {
        self.section(name)
            .filter(|_| name.dtype() == T::DTYPE)
            .and_then(|section| {
                let bytes: &mut [u8] = bytemuck::cast_slice_mut(batch);
                bytes.get_mut(section.offset..section.offset + section.bytes)
            })
            .map_or(&mut [], bytemuck::cast_slice_mut)
    }
}

fn check_num_envs(given: usize) -> Result<(), LayoutError> {
    if (1..=MAX_ENVS).contains(&given) { Ok(()) } else { Err(LayoutError::NumEnvs { given }) }
}

/// Checks sections one by one, in the order of their offsets.
struct Builder<S: SectionTable> {
    num_envs: usize,
    sections: Vec<Section<S>>,
    /// Bytes from the start of the batch to the end of the last section.
    end: usize,
}

impl<S: SectionTable> Builder<S> {
    fn new(num_envs: usize) -> Result<Self, LayoutError> {
        check_num_envs(num_envs)?;
        Ok(Builder { num_envs, sections: Vec::new(), end: 0 })
    }

    fn add(&mut self, name: S, shape: Vec<usize>, offset: usize) -> Result<(), LayoutError> {
        let text = name.name();
        if shape.len() >= MAX_DIMENSIONS || !name.row().admits(&shape) {
            return Err(LayoutError::Shape { section: text, expected: name.row().to_string(), given: shape });
        }
        if self.sections.iter().any(|other| other.name == name) {
            return Err(LayoutError::Duplicate { section: text });
        }
        if !offset.is_multiple_of(BLOCK_BYTES) {
            return Err(LayoutError::Alignment { section: text, given: offset });
        }
        if offset < self.sections.last().map_or(0, |last| last.offset) {
            return Err(LayoutError::Order { section: text, given: offset });
        }
        if offset < self.end {
            return Err(LayoutError::Overlap { section: text, given: offset, end: self.end });
        }
        let too_large = || LayoutError::TooLarge { section: text };
        // Treats dimensions of 0 as 1, so that each dimension alone fits too.
        let count = shape.iter().try_fold(self.num_envs, |count, length| count.checked_mul((*length).max(1)));
        let largest =
            count.and_then(|count| count.checked_mul(name.dtype().size())).and_then(|n| n.checked_add(offset));
        // A slice has at most isize::MAX bytes, and the last block and the stamp must fit too.
        largest.filter(|end| *end <= isize::MAX as usize - 2 * BLOCK_BYTES).ok_or_else(too_large)?;
        let width: usize = shape.iter().product();
        let bytes = self.num_envs * width * name.dtype().size();
        if let RowShape::Bytes(needed) = name.row()
            && bytes < needed
        {
            return Err(LayoutError::TooShort { section: text, given: bytes, needed });
        }
        self.end = offset + bytes;
        self.sections.push(Section { name, shape, offset, width, bytes });
        Ok(())
    }

    fn finish(self) -> Result<Layout<S>, LayoutError> {
        let has = |name: &S| self.sections.iter().any(|section| section.name == *name);
        if let Some(missing) = S::ALL.iter().find(|name| name.is_required() && !has(name)) {
            return Err(LayoutError::Missing { section: missing.name() });
        }
        let blocks = blocks_for(self.end) + S::STAMP_BLOCKS;
        Ok(Layout { num_envs: self.num_envs, sections: self.sections, blocks })
    }
}

/// A layout as in JSON.
#[derive(Clone, Serialize, Deserialize)]
struct LayoutFields {
    num_envs: usize,
    blocks: usize,
    sections: Vec<SectionFields>,
}

#[derive(Clone, Serialize, Deserialize)]
struct SectionFields {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    offset: usize,
}

impl<S: SectionTable> From<Layout<S>> for LayoutFields {
    fn from(layout: Layout<S>) -> Self {
        let fields = |section: Section<S>| SectionFields {
            name: section.name.name().to_owned(),
            dtype: section.dtype(),
            shape: section.shape,
            offset: section.offset,
        };
        let sections = layout.sections.into_iter().map(fields).collect();
        LayoutFields { num_envs: layout.num_envs, blocks: layout.blocks, sections }
    }
}

impl<S: SectionTable> TryFrom<LayoutFields> for Layout<S> {
    type Error = LayoutError;

    fn try_from(fields: LayoutFields) -> Result<Self, LayoutError> {
        let mut builder = Builder::<S>::new(fields.num_envs)?;
        for SectionFields { name, dtype, shape, offset } in fields.sections {
            let section = S::from_name(&name).ok_or(LayoutError::UnknownSection { given: name })?;
            if dtype != section.dtype() {
                return Err(LayoutError::Dtype { section: section.name(), given: dtype, expected: section.dtype() });
            }
            builder.add(section, shape, offset)?;
            if blocks_for(builder.end) > fields.blocks {
                let (end, blocks) = (builder.end, fields.blocks);
                return Err(LayoutError::PastEnd { section: section.name(), end, blocks });
            }
        }
        let layout = builder.finish()?;
        if layout.blocks != fields.blocks {
            return Err(LayoutError::Blocks { given: fields.blocks, expected: layout.blocks });
        }
        Ok(layout)
    }
}

/// A layout's description is invalid.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum LayoutError {
    /// There are no environments, or too many.
    #[error("num_envs must be 1 to {MAX_ENVS}, got {given}")]
    NumEnvs { given: usize },
    /// The table has no such section.
    #[error("unknown section `{given}`")]
    UnknownSection { given: String },
    /// A section is given twice.
    #[error("section `{section}` is given twice")]
    Duplicate { section: &'static str },
    /// A required section is missing.
    #[error("section `{section}` is missing")]
    Missing { section: &'static str },
    /// A section's number type differs from the table's.
    #[error("section `{section}` must have dtype {expected}, got {given}")]
    Dtype { section: &'static str, given: Dtype, expected: Dtype },
    /// A section's row has the wrong number of dimensions.
    #[error("the row shape of section `{section}` must be {expected}, got {given:?}")]
    Shape { section: &'static str, given: Vec<usize>, expected: String },
    /// A section does not start at a multiple of [`BLOCK_BYTES`].
    #[error("the offset of section `{section}` must be a multiple of {BLOCK_BYTES}, got {given}")]
    Alignment {
        section: &'static str,
        /// The offset that was given, in bytes.
        given: usize,
    },
    /// Sections are not in the order of their offsets.
    #[error("sections must be in the order of their offsets; section `{section}` at byte {given} follows a later one")]
    Order {
        section: &'static str,
        /// The offset that was given, in bytes.
        given: usize,
    },
    /// A section starts before the previous one ends.
    #[error("section `{section}` overlaps the one before it: it must start at byte {end} or later, got {given}")]
    Overlap {
        section: &'static str,
        /// The offset that was given, in bytes.
        given: usize,
        /// End of the section before it, in bytes.
        end: usize,
    },
    /// A section's end does not fit into the address space.
    #[error("section `{section}` is too large for the address space")]
    TooLarge { section: &'static str },
    /// A section of bytes is too short for the longest content.
    #[error("section `{section}` must have at least {needed} bytes, got {given}")]
    TooShort { section: &'static str, given: usize, needed: usize },
    /// A section extends beyond the declared size.
    #[error("section `{section}` ends at byte {end}, beyond the declared {blocks} blocks of {BLOCK_BYTES} bytes")]
    PastEnd {
        section: &'static str,
        /// End of the section, in bytes.
        end: usize,
        blocks: usize,
    },
    /// The declared size differs from the size of the sections.
    #[error("blocks must be {expected}, the size of all sections, got {given}")]
    Blocks { given: usize, expected: usize },
}

#[cfg(test)]
mod tests {
    use super::super::block::zeroed;
    use super::super::frames::Frames;
    use super::*;
    use crate::toy::toys;

    fn everything() -> Contents {
        Contents { frames: Some(Frames::default()), features: true, state: true, final_observation: true }
    }

    fn layout(num_envs: usize) -> Layout {
        batch_layout(toys().spec("Toy-v0").unwrap(), num_envs, everything()).unwrap()
    }

    #[test]
    fn sections_are_aligned_and_do_not_overlap() {
        for (spec, num_envs) in toys().specs().zip([1, 3, 64, 1000].into_iter().cycle()) {
            let layout = batch_layout(spec, num_envs, everything()).unwrap();
            let mut end = 0;
            for section in layout.sections() {
                assert_eq!(section.offset() % BLOCK_BYTES, 0);
                assert!(section.offset() >= end);
                assert_eq!(section.bytes(), num_envs * section.width() * section.dtype().size());
                end = section.offset() + section.bytes();
            }
            assert_eq!(layout.section_blocks() * BLOCK_BYTES, end.next_multiple_of(BLOCK_BYTES));
            assert_eq!(layout.blocks(), layout.section_blocks() + 1);
        }
    }

    #[test]
    fn a_missing_section_wrong_type_or_short_batch_reads_as_empty() {
        let layout = batch_layout(toys().spec("Toy-Plain-v0").unwrap(), 4, Contents::default());
        let layout = layout.unwrap();
        let batch = zeroed(layout.blocks());
        assert_eq!(layout.read::<f64>(&batch, BatchSection::Reward).len(), 4);
        assert!(layout.read::<u8>(&batch, BatchSection::Observation).is_empty());
        assert!(layout.read::<f32>(&batch, BatchSection::Reward).is_empty());
        assert!(layout.read::<f64>(&[], BatchSection::Reward).is_empty());
    }

    #[test]
    fn layouts_survive_json() {
        let layout = layout(5);
        let text = serde_json::to_string(&layout).unwrap();
        assert_eq!(serde_json::from_str::<Layout>(&text).unwrap(), layout);
        let actions = action_layout(&ActionSpace::Discrete(4), 5).unwrap();
        let text = serde_json::to_string(&actions).unwrap();
        assert_eq!(serde_json::from_str::<ActionLayout>(&text).unwrap(), actions);
        assert!(serde_json::from_str::<Layout>(&text).is_err(), "the tables differ");
    }

    #[test]
    fn too_many_and_too_few_environments_are_refused() {
        let spec = toys().specs().next().unwrap();
        for given in [0, MAX_ENVS + 1, usize::MAX] {
            assert_eq!(batch_layout(spec, given, everything()), Err(LayoutError::NumEnvs { given }));
            assert_eq!(action_layout(&spec.action_space, given), Err(LayoutError::NumEnvs { given }));
        }
        for num_envs in [1, 7, 1024, MAX_ENVS] {
            action_layout(&spec.action_space, num_envs).unwrap();
        }
        let frames = Some(Frames { stack: usize::MAX, ..Frames::default() });
        let error = batch_layout(spec, 3, Contents { frames, ..everything() });
        assert_eq!(error, Err(LayoutError::TooLarge { section: "observation" }));
    }
}
