//! A scripted player that remembers the commands.

use super::commands::{COMMANDS, Command};
use super::config::TILE;
use super::features::{AGENT, ARENA_SIZE, BURNING, COMMAND, HEADING, LARGEST_ARENA};
use super::parameters::{Locomotion, Variant};
use crate::controls::turn_or_walk;
use crate::screen::SCREEN;
use endless_gym_core::envs::Expert;

/// Distance in pixels from a tile's centre within which the agent stops.
const DEAD_ZONE: i32 = 2;

/// Plays Mortar Mayhem from the feature and vector observations. It recognises a new command by the pause before it or by a
/// difference, and knows that a command is finished when the fire goes out. It therefore needs `visual_feedback`, and a
/// `command_show_delay` of at least 1.
#[derive(Debug)]
pub struct MortarExpert {
    variant: Variant,
    commands: Vec<Command>,
    last_shown: Option<Command>,
    /// Index of the command to execute; `None` until the current fire has gone out.
    current: Option<usize>,
    target: Option<(i32, i32)>,
    was_burning: bool,
}

impl MortarExpert {
    /// An expert for one id of the family.
    pub fn new(variant: Variant) -> Self {
        MortarExpert {
            variant,
            commands: Vec::new(),
            last_shown: None,
            current: Some(0),
            target: None,
            was_burning: false,
        }
    }

    fn remember(&mut self, features: &[f32], vector_observation: &[f32]) {
        if self.commands.is_empty() {
            let given = vector_observation.chunks_exact(COMMANDS);
            self.commands.extend(
                given.filter_map(|one_hot| one_hot.iter().position(|v| *v == 1.0)).filter_map(Command::from_one_hot),
            );
        }
        let shown = features[COMMAND..COMMAND + COMMANDS].iter().position(|v| *v == 1.0).map(Command::from_index);
        if shown != self.last_shown
            && let Some(command) = shown
        {
            self.commands.push(command);
            // A command shown while tiles still burn restarts the sequence once the fire is out.
            if features[BURNING] == 1.0 {
                self.current = None;
            }
        }
        self.last_shown = shown;
    }

    fn tile_after(&self, (x, y): (i32, i32), arena_size: i32) -> (i32, i32) {
        let command = self.current.and_then(|index| self.commands.get(index));
        let (x, y) = command.map_or((x, y), |command| command.apply((x, y)));
        if self.variant.endless { (x.rem_euclid(arena_size), y.rem_euclid(arena_size)) } else { (x, y) }
    }
}

impl Expert for MortarExpert {
    fn reset(&mut self) {
        *self = MortarExpert::new(self.variant);
    }

    fn act(&mut self, features: &[f32], vector_observation: &[f32], action: &mut [i32]) {
        action.fill(0);
        let screen = SCREEN as i32;
        let arena_size = (features[ARENA_SIZE] * LARGEST_ARENA).round() as i32;
        let corner = (screen - arena_size * TILE) / 2;
        let [x, y] = [AGENT, AGENT + 1].map(|place| (features[place] * SCREEN as f32).round() as i32);
        let tile = ((x - corner).div_euclid(TILE), (y - corner).div_euclid(TILE));

        self.remember(features, vector_observation);
        let target = match self.target {
            Some(target) => target,
            // The first frame shows the first command and the start tile.
            None => self.tile_after(tile, arena_size),
        };
        self.target = Some(target);
        let burning = features[BURNING] == 1.0;
        if self.was_burning && !burning {
            self.current = Some(self.current.map_or(0, |index| index + 1));
            self.target = Some(self.tile_after(target, arena_size));
        }
        self.was_burning = burning;
        let Some((target_x, target_y)) = self.target.filter(|_| !burning) else { return };

        if self.variant.locomotion == Locomotion::Grid {
            action[0] =
                turn_or_walk([features[HEADING], features[HEADING + 1]], (target_x - tile.0, target_y - tile.1));
            return;
        }
        let towards = |target: i32, at: i32| {
            let mut distance = corner + target * TILE + TILE / 2 - at;
            if self.variant.endless {
                distance = (distance + screen / 2).rem_euclid(screen) - screen / 2;
            }
            match distance {
                d if d < -DEAD_ZONE => 1,
                d if d > DEAD_ZONE => 2,
                _ => 0,
            }
        };
        action[0] = towards(target_x, x);
        action[1] = towards(target_y, y);
    }
}
