//! What a frame of Mortar Mayhem shows.

use std::sync::Arc;

use super::commands::Command;
use super::config::Config;
use super::state::{DisplayedCharacter, State};
use crate::envs::character::Character;
use crate::envs::character_sprites::CharacterSprites;

/// What a frame shows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Scene {
    /// The one tile that does not burn, while the others do.
    pub(super) safe_tile: Option<(i32, i32)>,
    pub(super) character: Character,
    /// The character's pictures, if they are an earlier episode's and differ from the current ones.
    pub(super) earlier_sprites: Option<Arc<CharacterSprites>>,
    pub(super) command: Option<Command>,
}

impl Scene {
    /// What a state looks like. `sprites` are the current episode's, `earlier_sprites` those of an earlier episode's character.
    pub(super) fn new(
        state: &State,
        config: &Config,
        sprites: &Arc<CharacterSprites>,
        earlier_sprites: &Arc<CharacterSprites>,
    ) -> Self {
        let shows_earlier = !state.first_frame && matches!(state.displayed, DisplayedCharacter::Earlier { .. });
        let differs = shows_earlier && !Arc::ptr_eq(sprites, earlier_sprites);
        Scene {
            safe_tile: state.visible_fire(&config.parameters),
            character: *state.visible_character(),
            earlier_sprites: differs.then(|| Arc::clone(earlier_sprites)),
            command: state.shown_command,
        }
    }
}
