//! Environments for Endless Gym: a library, a program, a Python package and the engine of a page.

mod task;

use endless_gym::pool::{Registry, RegistryError};
pub use task::TMaze;

/// The environments of this crate; `with` adds each further task.
pub fn registry() -> Result<Registry, RegistryError> {
    Registry::new().with::<TMaze>()
}

#[cfg(feature = "python")]
endless_gym_python::module!(_native, registry());

#[cfg(target_arch = "wasm32")]
endless_gym_web::module!(registry());

/// The tests check that a step does not allocate.
#[cfg(test)]
#[global_allocator]
static ALLOCATOR: endless_gym::conformance::CountingAllocator = endless_gym::conformance::CountingAllocator;
