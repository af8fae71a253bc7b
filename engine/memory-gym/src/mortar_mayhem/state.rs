//! The state of a Mortar Mayhem environment.

use serde::{Deserialize, Serialize};

use super::commands::{COMMANDS, Command};
use super::config::Config;
use super::display_schedule::DisplaySchedule;
use super::parameters::{Locomotion, MAX_DURATION, Parameters};
use crate::character::Character;
use crate::controls::MAX_AGENT_SCALE;
use endless_gym_core::envs::Progress;

/// The character that frames show after an episode's first frame.
///
/// The original's endless id keeps showing the last episode's character until the agent may move in the new episode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) enum DisplayedCharacter {
    /// The current one, since no episode has played a step yet.
    #[default]
    Initial,
    /// The current episode's.
    Current,
    /// An earlier episode's, with the scale at which it was drawn.
    Earlier { character: Character, scale: f64 },
}

/// Everything that changes during play.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct State {
    pub(super) agent: Character,
    pub(super) displayed: DisplayedCharacter,
    /// Whether the frame is the first of its episode.
    pub(super) first_frame: bool,
    /// The command that the frame shows.
    pub(super) shown_command: Option<Command>,
    /// The whole sequence.
    pub(super) commands: Vec<Command>,
    pub(super) agent_tile: (i32, i32),
    /// The tile that the current command leads to.
    pub(super) target: (i32, i32),
    /// Whether all tiles but the target burn.
    pub(super) tiles_on: bool,
    pub(super) display: DisplaySchedule,
    /// The same schedule for the ground-truth view, in which every view advances it by one frame.
    pub(super) view_display: DisplaySchedule,
    pub(super) show_duration: usize,
    pub(super) show_delay: usize,
    pub(super) explosion_duration: u32,
    pub(super) explosion_delay: u32,
    /// Number of commands of the sequence that have been checked.
    pub(super) current_command: usize,
    /// Steps since the current command became due.
    pub(super) command_steps: u32,
    /// Steps since the current command's tiles began to burn.
    pub(super) verify_steps: u32,
    pub(super) steps: i64,
    pub(super) total_completed: usize,
    /// Whether the whole sequence was checked in this step, which finite ids count as success.
    pub(super) success: bool,
}

impl State {
    /// Whether an environment can be in this state. A forged snapshot may hold any numbers.
    pub(super) fn is_valid(&self, config: &Config) -> bool {
        let displayed_is_valid = match &self.displayed {
            DisplayedCharacter::Earlier { character, scale } => {
                character.is_valid() && (0.0..=MAX_AGENT_SCALE).contains(scale)
            }
            DisplayedCharacter::Initial | DisplayedCharacter::Current => true,
        };
        let Config { parameters, variant, arena: (left, _, right, _), .. } = config;
        let (radius, (x, y)) = (config.agent.radius, self.agent.position);
        self.agent.is_valid()
            && [x, y].iter().all(|at| (left - radius..=right + radius).contains(at))
            && self.agent_tile == config.tile_at(self.agent.position)
            && (variant.locomotion != Locomotion::Grid
                || config.contains(self.agent_tile)
                    && (x, y) == config.centre(self.agent_tile)
                    && self.agent.rotation % 90 == 0)
            && displayed_is_valid
            && config.contains(self.target)
            && !self.commands.is_empty()
            && (variant.endless || parameters.command_count.contains(&(self.commands.len() as i64)))
            && self
                .commands
                .iter()
                .chain(&self.shown_command)
                .all(|command| command.index() < parameters.allowed_commands.min(COMMANDS))
            && self.current_command <= self.commands.len()
            && (variant.endless || self.total_completed <= self.current_command)
            && [self.display, self.view_display].iter().all(|display| display.is_valid(self.commands.len()))
            && [self.show_duration, self.show_delay].iter().all(|steps| *steps <= MAX_DURATION as usize)
            && [self.explosion_duration, self.explosion_delay].iter().all(|s| (1..=MAX_DURATION as u32).contains(s))
            && (0..i64::MAX / 2).contains(&self.steps)
            && self.first_frame == (self.steps == 0)
            && [self.command_steps, self.verify_steps]
                .iter()
                .all(|steps| i64::from(*steps) <= self.steps && *steps < u32::MAX / 2)
            && self.total_completed as u64 <= self.steps as u64
    }

    /// The tile that does not burn, while burning tiles are shown.
    pub(super) fn visible_fire(&self, parameters: &Parameters) -> Option<(i32, i32)> {
        (self.tiles_on && parameters.visual_feedback).then_some(self.target)
    }

    /// The character that the frame shows.
    pub(super) fn visible_character(&self) -> &Character {
        match &self.displayed {
            DisplayedCharacter::Earlier { character, .. } if !self.first_frame => character,
            _ => &self.agent,
        }
    }

    /// The character that moved last, in this episode or an earlier one.
    pub(super) fn last_moved(&self) -> &Character {
        match &self.displayed {
            DisplayedCharacter::Earlier { character, .. } => character,
            DisplayedCharacter::Initial | DisplayedCharacter::Current => &self.agent,
        }
    }

    /// The number of commands executed, and the total.
    pub(super) fn progress(&self, config: &Config) -> Vec<Progress> {
        let (executed, sequence) = (self.total_completed as f64, self.commands.len() as f64);
        if config.variant.endless {
            vec![Progress::count("commands", executed), Progress::count("commands in the sequence", sequence)]
        } else {
            vec![Progress::share("commands", executed, sequence)]
        }
    }

    /// The final info of finite ids: success, and the share of commands that were executed, which counts a failed last command; and
    /// the task progress, which does not.
    pub(super) fn finite_info(&self) -> [f64; 3] {
        let (success, commands) = (f64::from(u8::from(self.success)), self.commands.len() as f64);
        let executed = self.current_command as f64 - 1.0 + success;
        // An agent that leaves the tile too early fails at a command that is already counted.
        [success, executed / commands, executed.min(self.total_completed as f64) / commands]
    }

    /// The final info of the endless id: commands executed, and the longest sequence.
    pub(super) fn endless_info(&self) -> [f64; 2] {
        [self.total_completed as f64, self.commands.len().saturating_sub(1) as f64]
    }
}
