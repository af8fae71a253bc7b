//! The number types of a batch.

use std::fmt;

use bytemuck::Pod;
use serde::{Deserialize, Serialize};

/// Number type of a section. In JSON it is its [`name`](Dtype::name).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Dtype {
    /// `u8`, 1 byte.
    Uint8,
    /// `i32`, 4 bytes.
    Int32,
    /// `u64`, 8 bytes.
    Uint64,
    /// `f32`, 4 bytes.
    Float32,
    /// `f64`, 8 bytes.
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

    /// numpy's name for the type.
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

impl fmt::Display for Dtype {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A supertrait that other crates cannot name, so that they cannot implement [`Element`] or
/// [`SectionTable`](super::SectionTable). A number type with the [`Dtype`] of another type would make batch views panic:
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
pub trait Sealed {}

/// A Rust number type that has a [`Dtype`].
///
/// The trait is sealed: other crates cannot implement it.
pub trait Element: Sealed + Pod + Send + Sync {
    /// The corresponding number type of a layout.
    const DTYPE: Dtype;
}

macro_rules! element {
    ($($rust:ty => $dtype:ident),*) => { $(
        impl Sealed for $rust {}
        impl Element for $rust { const DTYPE: Dtype = Dtype::$dtype; }
    )* };
}
element!(u8 => Uint8, i32 => Int32, u64 => Uint64, f32 => Float32, f64 => Float64);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_names_and_sizes_match_the_rust_types() {
        fn check<T: Element>() {
            assert_eq!(T::DTYPE.size(), size_of::<T>());
            assert_eq!(serde_json::to_value(T::DTYPE).unwrap(), T::DTYPE.name());
        }
        check::<u8>();
        check::<i32>();
        check::<u64>();
        check::<f32>();
        check::<f64>();
    }
}
