//! The reasons for which a layout is refused.

use thiserror::Error;

use super::block::BLOCK_BYTES;
use super::dtype::Dtype;
use super::limits::MAX_ENVS;

/// A description of a layout that is not valid.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum LayoutError {
    /// No environment, or too many.
    #[error("num_envs must be 1 to {MAX_ENVS}, got {given}")]
    NumEnvs {
        /// The number that was given.
        given: usize,
    },
    /// A section that the table lacks.
    #[error("unknown section `{given}`")]
    UnknownSection {
        /// The name that was given.
        given: String,
    },
    /// A section that is given twice.
    #[error("section `{section}` is given twice")]
    Duplicate {
        /// The section's name.
        section: &'static str,
    },
    /// A section is missing that every layout has.
    #[error("section `{section}` is missing")]
    Missing {
        /// The section's name.
        section: &'static str,
    },
    /// A section has another number type than the table says.
    #[error("section `{section}` must have dtype {expected}, got {given}")]
    Dtype {
        /// The section's name.
        section: &'static str,
        /// The number type that was given.
        given: Dtype,
        /// The table's number type.
        expected: Dtype,
    },
    /// A section's row has another number of dimensions than the table says.
    #[error("the row shape of section `{section}` must be {expected}, got {given:?}")]
    Shape {
        /// The section's name.
        section: &'static str,
        /// The shape that was given.
        given: Vec<usize>,
        /// The shapes that are allowed, in words.
        expected: String,
    },
    /// A section does not start at a multiple of [`BLOCK_BYTES`].
    #[error("the offset of section `{section}` must be a multiple of {BLOCK_BYTES}, got {given}")]
    Alignment {
        /// The section's name.
        section: &'static str,
        /// The offset that was given, in bytes.
        given: usize,
    },
    /// Sections are not in the order of their offsets.
    #[error("sections must be in the order of their offsets; section `{section}` at byte {given} follows a later one")]
    Order {
        /// The section's name.
        section: &'static str,
        /// The offset that was given, in bytes.
        given: usize,
    },
    /// A section starts before the end of the one before it.
    #[error("section `{section}` overlaps the one before it: it must start at byte {end} or later, got {given}")]
    Overlap {
        /// The section's name.
        section: &'static str,
        /// The offset that was given, in bytes.
        given: usize,
        /// End of the section before it, in bytes.
        end: usize,
    },
    /// A section's end does not fit the address space.
    #[error("section `{section}` is too large for the address space")]
    TooLarge {
        /// The section's name.
        section: &'static str,
    },
    /// A section of bytes is too short for the longest message.
    #[error("section `{section}` must have at least {needed} bytes, got {given}")]
    TooShort {
        /// The section's name.
        section: &'static str,
        /// Bytes of all rows.
        given: usize,
        /// Bytes of the longest message.
        needed: usize,
    },
    /// A section reaches beyond the declared size.
    #[error("section `{section}` ends at byte {end}, beyond the declared {blocks} blocks of {BLOCK_BYTES} bytes")]
    PastEnd {
        /// The section's name.
        section: &'static str,
        /// End of the section, in bytes.
        end: usize,
        /// The declared size in blocks.
        blocks: usize,
    },
    /// The declared size is not that of the sections.
    #[error("blocks must be {expected}, the size of all sections, got {given}")]
    Blocks {
        /// The declared size.
        given: usize,
        /// The sections' size.
        expected: usize,
    },
}
