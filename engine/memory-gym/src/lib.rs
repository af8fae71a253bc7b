//! The environments of Memory Gym (Pleines et al., JMLR 2025), bit for bit as `memory-gym` 1.0.3 plays them.
//!
//! Each family is a module: [`mortar_mayhem`], [`mystery_path`], [`searing_spotlights`], with its ids in `IDS`. What pools and programs
//! use is [`memory_gym`]; the rules are public for benchmarks and may change in any version.

#![deny(unsafe_code)]

mod character;
mod character_sprites;
mod controls;
pub mod mortar_mayhem;
pub mod mystery_path;
mod screen;
pub mod searing_spotlights;
mod shared_methods;
mod typed_parameters;
mod vector;

use std::sync::LazyLock;

use endless_gym_core::envs::{EnvSpec, Environment};
use endless_gym_core::pool::Registry;
use mortar_mayhem::MortarMayhem;
use mystery_path::MysteryPath;
pub use screen::{FRAME, SCREEN};
use searing_spotlights::SearingSpotlights;

/// The environment id that commands and training programs use by default.
pub const DEFAULT_ENV_ID: &str = "Endless-MortarMayhem-v0";

/// The registry of the ten Memory Gym ids, in the order that `endless list` shows.
///
/// ```
/// let ids: Vec<_> = endless_gym_memory_gym::memory_gym().specs().map(|spec| spec.id).collect();
/// assert_eq!((ids.len(), ids[0]), (10, "MortarMayhem-v0"));
/// ```
pub fn memory_gym() -> &'static Registry {
    static REGISTRY: LazyLock<Registry> = LazyLock::new(|| {
        let mut registry = Registry::new();
        add::<MortarMayhem>(&mut registry, &*mortar_mayhem::IDS);
        add::<MysteryPath>(&mut registry, &*mystery_path::IDS);
        add::<SearingSpotlights>(&mut registry, &*searing_spotlights::IDS);
        registry
    });
    &REGISTRY
}

fn add<E: Environment + 'static>(registry: &mut Registry, ids: &[(EnvSpec, E::Variant)]) {
    for (spec, variant) in ids {
        registry.register::<E>(spec.clone(), *variant).expect("ids are unique");
    }
}
