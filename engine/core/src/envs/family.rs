//! The families of environments, and what distinguishes the ids within each.

/// The family of an id, with the id's variant of the family's rules.
#[derive(Clone, Copy, Debug)]
pub enum Family {
    /// One of the five ids of Mortar Mayhem.
    MortarMayhem(MortarMayhemVariant),
    /// One of the three ids of Mystery Path.
    MysteryPath(MysteryPathVariant),
    /// One of the two ids of Searing Spotlights.
    SearingSpotlights(SearingSpotlightsVariant),
}

/// What distinguishes the ids of Mortar Mayhem.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MortarMayhemVariant {
    /// How the agent moves.
    pub locomotion: Locomotion,
    /// The commands are provided as a vector observation and never shown.
    pub commands_given: bool,
    /// The sequence of commands grows until the agent fails.
    pub endless: bool,
    /// The agent starts up to two pixels off its tile's centre.
    pub start_offset: bool,
}

/// How the agent of Mortar Mayhem moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Locomotion {
    /// By `agent_speed` in eight directions, limited by the arena's border.
    Free,
    /// By `agent_speed` in eight directions; leaving the screen on one side leads to the other.
    Wrapping,
    /// Turns and walks from tile to tile.
    Grid,
}

/// What distinguishes the ids of Mystery Path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MysteryPathVariant {
    /// One screen with a goal; the agent moves by `agent_speed` in eight directions, limited by the screen's border.
    Free,
    /// One screen with a goal; the agent turns and walks from tile to tile.
    Grid,
    /// An endless path to the right, along which the screen scrolls; the agent moves right, up or down.
    Endless,
}

/// What distinguishes the ids of Searing Spotlights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SearingSpotlightsVariant {
    /// A collected coin is replaced by a new one, and there is no exit.
    pub endless: bool,
}
