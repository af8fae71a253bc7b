//! The environments of POPGym (Morad et al., ICLR 2023), bit for bit as the Python package `popgym` 1.0.7 plays them.
//!
//! Each family is a module, which defines its ids and their arguments. What pools and programs use is [`popgym`]; the rules are public for benchmarks
//! and may change in any version.

#![deny(unsafe_code)]

pub mod autoencode;
pub mod battleship;
pub mod cart_pole;
pub mod concentration;
pub mod count_recall;
mod deck;
mod filter;
pub mod higher_lower;
mod ids;
pub mod labyrinth;
mod maze;
pub mod mine_sweeper;
pub mod multiarmed_bandit;
pub mod pendulum;
mod pictures;
pub mod repeat_first;
pub mod repeat_previous;

use std::sync::LazyLock;

use endless_gym_core::pool::{Registry, RegistryError};

/// The registry of the POPGym ids.
///
/// ```
/// let ids: Vec<_> = endless_gym_popgym::popgym().specs().map(|spec| spec.id).collect();
/// assert!(ids.contains(&"popgym-RepeatFirstEasy-v0"));
/// ```
pub fn popgym() -> &'static Registry {
    static REGISTRY: LazyLock<Registry> = LazyLock::new(|| register(Registry::new()).expect("ids are unique"));
    &REGISTRY
}

/// Adds the POPGym ids to a registry.
///
/// # Errors
///
/// [`RegistryError`] if the registry has one of the ids already.
pub fn register(registry: Registry) -> Result<Registry, RegistryError> {
    registry
        .with::<autoencode::Autoencode>()?
        .with::<battleship::Battleship>()?
        .with::<cart_pole::CartPole>()?
        .with::<concentration::Concentration>()?
        .with::<count_recall::CountRecall>()?
        .with::<higher_lower::HigherLower>()?
        .with::<labyrinth::Labyrinth>()?
        .with::<mine_sweeper::MineSweeper>()?
        .with::<multiarmed_bandit::MultiarmedBandit>()?
        .with::<pendulum::Pendulum>()?
        .with::<repeat_first::RepeatFirst>()?
        .with::<repeat_previous::RepeatPrevious>()
}
