//! Seals traits, so that other crates cannot implement them.

/// A supertrait that other crates cannot name.
///
/// A number type with the [`Dtype`](super::Dtype) of another type would make the views of a batch panic:
///
/// ```compile_fail,E0277
/// use endless_gym_core::batch::{Dtype, Element};
///
/// #[derive(Clone, Copy)]
/// #[repr(transparent)]
/// struct Half(u16);
/// unsafe impl bytemuck::Zeroable for Half {}
/// unsafe impl bytemuck::Pod for Half {}
///
/// impl Element for Half {
///     const DTYPE: Dtype = Dtype::Uint8;
/// }
/// ```
///
/// So would a table with a section that no layout has:
///
/// ```compile_fail,E0277
/// use std::fmt;
/// use endless_gym_core::batch::{Dtype, RowShape, SectionTable};
///
/// #[derive(Clone, Copy, Debug, PartialEq, Eq)]
/// struct Reward;
///
/// impl fmt::Display for Reward {
///     fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
///         f.write_str("reward")
///     }
/// }
///
/// impl SectionTable for Reward {
///     const ALL: &'static [Self] = &[];
///     const STAMP_BLOCKS: usize = 0;
///
///     fn name(self) -> &'static str {
///         "reward"
///     }
///
///     fn dtype(self) -> Dtype {
///         Dtype::Float64
///     }
///
///     fn row(self) -> RowShape {
///         RowShape::Scalar
///     }
///
///     fn is_required(self) -> bool {
///         true
///     }
/// }
/// ```
pub trait Sealed {}
