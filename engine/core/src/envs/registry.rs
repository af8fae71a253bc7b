//! The registry of all environment ids.

use thiserror::Error;

use super::expert::Expert;
use super::family::Family;
use super::spec::EnvSpec;
use super::{mortar_mayhem, mystery_path, searing_spotlights};

/// The environment id that commands and training programs use by default.
pub const DEFAULT_ENV_ID: &str = "Endless-MortarMayhem-v0";

/// Every environment id, in the order in which `endless list` shows them.
pub fn specs() -> impl Iterator<Item = &'static EnvSpec> {
    mortar_mayhem::SPECS.iter().chain(mystery_path::SPECS).chain(searing_spotlights::SPECS)
}

/// The specification of an id.
///
/// # Errors
///
/// [`UnknownEnvironment`] if no environment has that id.
pub fn spec(id: &str) -> Result<&'static EnvSpec, UnknownEnvironment> {
    specs().find(|spec| spec.id == id).ok_or_else(|| UnknownEnvironment {
        id: id.to_owned(),
        known: specs().map(|spec| spec.id).collect::<Vec<_>>().join(", "),
    })
}

/// A scripted expert for an environment.
pub fn expert(spec: &EnvSpec) -> Box<dyn Expert> {
    match spec.family {
        Family::MortarMayhem(variant) => Box::new(mortar_mayhem::expert::MortarExpert::new(variant)),
        Family::MysteryPath(variant) => Box::new(mystery_path::expert::PathExpert::new(variant)),
        Family::SearingSpotlights(variant) => Box::new(searing_spotlights::expert::SpotlightsExpert::new(variant)),
    }
}

/// An id that no environment has.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("no environment `{id}`; there are {known}")]
pub struct UnknownEnvironment {
    /// The given id.
    pub id: String,
    /// All known ids, separated by commas.
    pub known: String,
}
