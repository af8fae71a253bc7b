//! The operating system's entropy, for generators without a seed.

use thiserror::Error;

/// 128 bits of the operating system's entropy, as numpy draws for `SeedSequence()`.
///
/// Every call reads from the system: a process-wide generator would repeat its output in the child of a fork, which is how
/// Python starts parallel environments.
///
/// # Errors
///
/// If the system call fails, and always in builds without the feature `entropy`.
pub fn entropy() -> Result<u128, EntropyError> {
    #[cfg(feature = "entropy")]
    {
        use rand::TryRng;
        let mut bytes = [0; size_of::<u128>()];
        rand::rngs::SysRng.try_fill_bytes(&mut bytes).map_err(|error| EntropyError(error.to_string()))?;
        Ok(u128::from_le_bytes(bytes))
    }
    #[cfg(not(feature = "entropy"))]
    Err(EntropyError("this build has no source of entropy (feature `entropy`)".to_owned()))
}

/// An unseeded generator needs entropy, and none is available.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("cannot draw a seed: {0}; pass a seed")]
pub struct EntropyError(String);
