//! The ten environment ids of Memory Gym.

use std::sync::LazyLock;

use crate::envs::mortar_mayhem::{self, MortarMayhem};
use crate::envs::mystery_path::{self, MysteryPath};
use crate::envs::searing_spotlights::{self, SearingSpotlights};
use crate::envs::{EnvSpec, Environment};
use crate::pool::Registry;

/// The environment id that commands and training programs use by default.
pub const DEFAULT_ENV_ID: &str = "Endless-MortarMayhem-v0";

/// The registry of the ten Memory Gym ids, in the order that `endless list` shows.
///
/// ```
/// let ids: Vec<_> = endless_gym_core::memory_gym().specs().map(|spec| spec.id).collect();
/// assert_eq!((ids.len(), ids[0]), (10, "MortarMayhem-v0"));
/// ```
pub fn memory_gym() -> &'static Registry {
    static REGISTRY: LazyLock<Registry> = LazyLock::new(|| {
        let mut registry = Registry::new();
        add::<MortarMayhem>(&mut registry, mortar_mayhem::IDS);
        add::<MysteryPath>(&mut registry, mystery_path::IDS);
        add::<SearingSpotlights>(&mut registry, searing_spotlights::IDS);
        registry
    });
    &REGISTRY
}

fn add<E: Environment + 'static>(registry: &mut Registry, ids: &[(EnvSpec, E::Variant)]) {
    for (spec, variant) in ids {
        registry.register::<E>(spec.clone(), *variant).expect("ids are unique");
    }
}
