//! A batch as arrays: [`Batch`] for readers, and [`BatchMut`] for the pool, which writes it in parts.

use std::ops::Range;

use super::block::Block;
use super::dtype::Element;
use super::layout::Layout;
use super::sections::{BatchSection, batch_sections};
use crate::disjoint::DisjointSlice;

/// Writable rows of one section, one for each environment. If the batch lacks the section, the rows are empty.
#[derive(Debug)]
pub(crate) struct RowsMut<'a, T> {
    numbers: DisjointSlice<'a, T>,
    width: usize,
}

impl<T> RowsMut<'_, T> {
    /// The row of one environment; empty if the batch lacks the section.
    ///
    /// # Panics
    ///
    /// If `env` is out of range.
    pub fn row(&mut self, env: usize) -> &mut [T] {
        &mut self.numbers.as_mut()[env * self.width..(env + 1) * self.width]
    }

    /// Writes the row of one environment, if the batch has the section.
    ///
    /// # Panics
    ///
    /// If `env` is out of range.
    #[inline]
    pub(crate) fn write(&mut self, env: usize, write: impl FnOnce(&mut [T])) {
        if self.width > 0 {
            write(self.row(env));
        }
    }

    /// Sets the number of one environment in a section with one number per environment.
    ///
    /// # Panics
    ///
    /// If `env` is out of range.
    pub fn set(&mut self, env: usize, number: T) {
        self.numbers.as_mut()[env] = number;
    }

    /// The rows of some environments.
    ///
    /// # Safety
    ///
    /// Those of [`DisjointSlice::part`].
    unsafe fn part(&self, envs: &Range<usize>) -> RowsMut<'_, T> {
        // SAFETY: our caller upholds the contract.
        let numbers = unsafe { self.numbers.part(envs.start * self.width..envs.end * self.width) };
        RowsMut { numbers, width: self.width }
    }
}

macro_rules! batch_view {
    ($($variant:ident $field:ident: $element:ident, $row:ident, $presence:ident, $meaning:literal;)*) => {
        /// A batch, or its part for consecutive environments, for writing.
        #[derive(Debug)]
        pub(crate) struct BatchMut<'a> {
            $(
                #[doc = concat!("Rows of `", stringify!($field), "`: ", $meaning, ".")]
                pub $field: RowsMut<'a, $element>,
            )*
        }

        impl<'a> BatchMut<'a> {
            /// The batch in `blocks`; `None` if there are fewer than the layout needs.
            pub fn new(layout: &Layout, blocks: &'a mut [Block]) -> Option<Self> {
                if blocks.len() < layout.blocks() {
                    return None;
                }
                let mut rest: &mut [u8] = bytemuck::cast_slice_mut(blocks);
                let mut at = 0;
                $(let mut $field = RowsMut::<$element> { numbers: DisjointSlice::new(&mut []), width: 0 };)*
                for section in layout.sections() {
                    let (_, tail) = rest.split_at_mut(section.offset() - at);
                    let (numbers, tail) = tail.split_at_mut(section.bytes());
                    at = section.offset() + section.bytes();
                    rest = tail;
                    match section.name() {
                        $(BatchSection::$variant => {
                            let numbers = DisjointSlice::new(bytemuck::cast_slice_mut(numbers));
                            $field = RowsMut { numbers, width: section.width() };
                        })*
                    }
                }
                Some(BatchMut { $($field),* })
            }

            /// The rows of some environments.
            ///
            /// # Panics
            ///
            /// If they are out of range.
            ///
            /// # Safety
            ///
            /// While the part exists, no other part contains any of its environments.
            pub unsafe fn part(&self, envs: Range<usize>) -> BatchMut<'_> {
                // SAFETY: our caller upholds the contract.
                BatchMut { $($field: unsafe { self.$field.part(&envs) }),* }
            }
        }

        /// The sections as slices of `num_envs` consecutive rows; [`BatchSection`] lists the shapes. A slice is empty if the
        /// batch lacks the section.
        impl<'a> Batch<'a> {
            $(
                #[doc = concat!("Section `", stringify!($field), "`: ", $meaning, ".")]
                pub fn $field(&self) -> &'a [$element] {
                    self.section(BatchSection::$variant)
                }
            )*
        }
    };
}

batch_sections! { batch_view! }

/// A batch for reading.
///
/// ```
/// use endless_gym_core::batch::{Batch, BatchSection, zeroed};
/// use endless_gym_memory_gym::memory_gym;
/// use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
///
/// let mut pool = Pool::new(memory_gym(), &PoolConfig::new("MysteryPath-Grid-v0", 4), &Threads::new(1)?)?;
/// let mut blocks = zeroed(pool.layout().blocks());
/// pool.reset(ResetRequest::Seed(7), &mut blocks)?;
///
/// let batch = Batch::new(pool.layout(), &blocks);
/// assert_eq!(batch.observation().len(), 4 * 84 * 84 * 3);
/// assert_eq!(batch.reward(), [0.0; 4]);
/// assert!(batch.features().is_empty());
/// // Read as the wrong number type, a section is empty.
/// assert_eq!(batch.section::<u8>(BatchSection::Terminated), [0; 4]);
/// assert!(batch.section::<f32>(BatchSection::Terminated).is_empty());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Batch<'a> {
    layout: &'a Layout,
    blocks: &'a [Block],
}

impl<'a> Batch<'a> {
    /// The batch in `blocks`. Sections that extend beyond them are empty.
    pub fn new(layout: &'a Layout, blocks: &'a [Block]) -> Self {
        Batch { layout, blocks }
    }

    /// Where the sections lie.
    pub fn layout(&self) -> &'a Layout {
        self.layout
    }

    /// Whether an environment's episode ended in this step, terminated or truncated. False if there is no such environment.
    pub fn has_ended(&self, env: usize) -> bool {
        [self.terminated(), self.truncated()].iter().any(|flags| flags.get(env).is_some_and(|flag| *flag != 0))
    }

    /// All sections and the padding between them, without the writer's stamp.
    pub fn bytes(&self) -> &'a [u8] {
        bytemuck::cast_slice(&self.blocks[..self.blocks.len().min(self.layout.section_blocks())])
    }

    /// All numbers of a section; empty if the batch lacks the section or if `T` is not its type.
    pub fn section<T: Element>(&self, section: BatchSection) -> &'a [T] {
        self.layout.read(self.blocks, section)
    }
}
