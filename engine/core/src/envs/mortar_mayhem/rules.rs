//! The rules of Mortar Mayhem: one set for all five ids.
//!
//! Source: `reset` and `step` of the original's `mortar_mayhem*.py` and `endless_mortar_mayhem.py`. The order of the random
//! draws is part of the rules.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::commands::{Clue, Command};
use super::drawing::{Assets, TILE};
use super::parameters::{Locomotion, MAX_AGENT_SCALE, MAX_DURATION};
use crate::envs::character::{Character, CharacterSprites};
use crate::envs::{InvalidState, Transition};
use crate::random::Generator;

/// Which character a frame shows, other than the first frame of an episode.
///
/// The endless original goes on showing the last episode's character until the agent may move in the new one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) enum Shown {
    /// No episode has played a step yet.
    Nobody,
    Current,
    /// The last episode's, with the scale that it was drawn at.
    Former {
        character: Character,
        scale: f64,
    },
}

/// One environment: its state, and the pictures that it is shown with.
#[derive(Clone, Debug)]
pub struct MortarMayhem {
    pub(super) assets: Arc<Assets>,
    /// Pictures of [`Shown::Former`].
    pub(super) former_sprites: Arc<CharacterSprites>,
    pub(super) state: State,
}

/// All that changes while an environment is played.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct State {
    pub(super) agent: Character,
    pub(super) shown: Shown,
    /// The frame is the first of its episode.
    pub(super) first_frame: bool,
    /// The command that the frame shows.
    pub(super) shown_command: Option<Command>,
    /// The whole sequence.
    pub(super) commands: Vec<Command>,
    /// Tile of the agent, and the one that it has to be on.
    agent_tile: (i32, i32),
    pub(super) target: (i32, i32),
    /// All tiles but the target burn.
    tiles_on: bool,
    pub(super) clue: Clue,
    /// The clue as the ground-truth view goes through it, at its own pace.
    pub(super) viewed_clue: Clue,
    show_duration: usize,
    show_delay: usize,
    explosion_duration: u32,
    explosion_delay: u32,
    /// Commands of the sequence that were checked.
    current_command: usize,
    /// Steps since the current command became due, and steps since its tiles began to burn.
    command_steps: u32,
    verify_steps: u32,
    steps: i64,
    total_completed: usize,
    /// The whole sequence was checked in this step, which finite ids count as success.
    success: bool,
}

impl State {
    /// Whether playing on from the state stays within the rules: every number in its range.
    fn is_valid(&self, assets: &Assets) -> bool {
        let size = assets.parameters.arena_size;
        let on_arena = |(x, y): (i32, i32)| (0..size).contains(&x) && (0..size).contains(&y);
        let former_is_valid = match &self.shown {
            Shown::Former { character, scale } => character.is_valid() && (0.0..=MAX_AGENT_SCALE).contains(scale),
            Shown::Nobody | Shown::Current => true,
        };
        self.agent.is_valid()
            && former_is_valid
            && on_arena(self.target)
            && (on_arena(self.agent_tile) || assets.variant.locomotion != Locomotion::Grid)
            && self.commands.iter().chain(&self.shown_command).all(|command| command.is_valid())
            && self.current_command <= self.commands.len()
            && self.clue.is_valid()
            && self.viewed_clue.is_valid()
            && [self.show_duration, self.show_delay].iter().all(|steps| *steps <= MAX_DURATION as usize)
            && [self.explosion_duration, self.explosion_delay].iter().all(|s| (1..=MAX_DURATION as u32).contains(s))
            && [self.command_steps, self.verify_steps].iter().all(|steps| *steps < u32::MAX / 2)
            && (0..i64::MAX / 2).contains(&self.steps)
            && self.total_completed < usize::MAX / 2
    }
}

impl MortarMayhem {
    pub(super) fn unplayed(assets: &Arc<Assets>) -> Self {
        let state = State {
            agent: Character::default(),
            shown: Shown::Nobody,
            first_frame: true,
            shown_command: None,
            commands: Vec::new(),
            agent_tile: (0, 0),
            target: (0, 0),
            tiles_on: false,
            clue: Clue::default(),
            viewed_clue: Clue::default(),
            show_duration: 0,
            show_delay: 0,
            explosion_duration: 1,
            explosion_delay: 1,
            current_command: 0,
            command_steps: 0,
            verify_steps: 0,
            steps: 0,
            total_completed: 0,
            success: false,
        };
        MortarMayhem { assets: Arc::clone(assets), former_sprites: Arc::clone(&assets.character), state }
    }

    /// Goes on from a state, if an environment with these assets can be in it.
    pub(super) fn resume(&mut self, assets: &Arc<Assets>, state: State) -> Result<(), InvalidState> {
        if !state.is_valid(assets) {
            return Err(InvalidState);
        }
        self.assets = Arc::clone(assets);
        self.former_sprites = match state.shown {
            Shown::Former { scale, .. } if scale != assets.parameters.agent_scale => {
                Arc::new(CharacterSprites::new(scale))
            }
            _ => Arc::clone(&assets.character),
        };
        self.state = state;
        Ok(())
    }

    pub(super) fn start(&mut self, assets: &Arc<Assets>, random: &mut Generator) {
        if let Shown::Current = self.state.shown {
            let scale = self.assets.parameters.agent_scale;
            self.state.shown = Shown::Former { character: self.state.agent, scale };
            self.former_sprites = Arc::clone(&self.assets.character);
        }
        if !Arc::ptr_eq(&self.assets, assets) {
            self.assets = Arc::clone(assets);
        }
        let assets = &**assets;
        let (variant, parameters) = (assets.variant, &assets.parameters);

        let size = i64::from(parameters.arena_size);
        let tile = random.integers(0, size * size);
        self.state.agent_tile = ((tile / size) as i32, (tile % size) as i32);
        let mut offset = (0, 0);
        if variant.start_offset {
            offset = (random.integers(-2, 2) as i32, random.integers(-2, 2) as i32);
        }
        let centre = |corner: i32, tile: i32| corner + tile * TILE + TILE / 2;
        self.state.agent = Character {
            position: (
                centre(assets.arena.0, self.state.agent_tile.0) + offset.0,
                centre(assets.arena.1, self.state.agent_tile.1) + offset.1,
            ),
            rotation: 0,
        };

        self.state.commands.clear();
        if variant.endless {
            for _ in 0..parameters.initial_command_count {
                self.add_any_command(random);
            }
        } else {
            let count = *random.choice(&parameters.command_count);
            self.add_valid_commands(count, random);
        }
        self.state.clue = Clue::default();
        self.state.viewed_clue = Clue::default();
        if !variant.commands_given {
            self.state.show_duration = *random.choice(&parameters.command_show_duration) as usize;
            self.state.show_delay = *random.choice(&parameters.command_show_delay) as usize;
            self.begin_clue(0);
        }
        self.show_next();

        self.state.target = self.tile_after(self.state.agent_tile, 0);
        self.state.tiles_on = false;
        self.state.current_command = 0;
        self.state.command_steps = 0;
        self.state.verify_steps = 0;
        self.state.steps = 0;
        self.state.total_completed = 0;
        self.state.success = false;
        self.state.first_frame = true;
        self.state.explosion_duration = *random.choice(&parameters.explosion_duration) as u32;
        self.state.explosion_delay = *random.choice(&parameters.explosion_delay) as u32;
    }

    /// Commands that keep within the arena, each drawn from those that can be executed where the last one leads.
    fn add_valid_commands(&mut self, count: i64, random: &mut Generator) {
        let parameters = &self.assets.parameters;
        let inside =
            |(x, y): (i32, i32)| (0..parameters.arena_size).contains(&x) && (0..parameters.arena_size).contains(&y);
        let mut at = self.state.agent_tile;
        for _ in 0..count {
            let valid = || Command::first(parameters.allowed_commands).filter(|command| inside(command.apply(at)));
            let drawn = random.integers(0, valid().count() as i64) as usize;
            // At least two of the first four commands lead from any tile to another.
            if let Some(command) = valid().nth(drawn) {
                at = command.apply(at);
                self.state.commands.push(command);
            }
        }
    }

    fn add_any_command(&mut self, random: &mut Generator) {
        let drawn = random.integers(0, self.assets.parameters.allowed_commands as i64);
        self.state.commands.push(Command::from_index(drawn as usize));
    }

    /// Where command number `number` leads; the endless arena is a torus.
    fn tile_after(&self, tile: (i32, i32), number: usize) -> (i32, i32) {
        let (x, y) = self.state.commands.get(number).map_or(tile, |command| command.apply(tile));
        if self.assets.variant.endless {
            let size = self.assets.parameters.arena_size;
            (x.rem_euclid(size), y.rem_euclid(size))
        } else {
            (x, y)
        }
    }

    /// Begins to show the commands from number `first` on.
    fn begin_clue(&mut self, first: usize) {
        let state = &mut self.state;
        state.clue = Clue::new(first, state.commands.len() - first, state.show_duration, state.show_delay);
        state.viewed_clue = state.clue;
    }

    fn show_next(&mut self) {
        self.state.shown_command =
            self.state.clue.next_frame().and_then(|number| self.state.commands.get(number).copied());
    }

    pub(super) fn play(&mut self, action: &[i32], random: &mut Generator) -> Transition {
        let mut transition = Transition { reward: 0.0, terminated: false };
        self.state.first_frame = false;
        self.state.success = false;
        if self.state.clue.is_over() {
            self.state.shown_command = None;
            self.state.shown = Shown::Current;
            self.move_agent(action);
            self.verify(&mut transition, random);
            self.burn(&mut transition);
        } else {
            self.show_next();
            if !self.assets.variant.endless || self.state.shown == Shown::Nobody {
                self.state.shown = Shown::Current;
            }
        }
        self.state.steps += 1;
        transition.terminated |= self.state.steps == self.assets.parameters.max_steps;
        transition
    }

    fn move_agent(&mut self, action: &[i32]) {
        let assets = &*self.assets;
        let (speed, radius) = (assets.parameters.agent_speed, assets.character.radius());
        match assets.variant.locomotion {
            Locomotion::Free => self.state.agent.step_within(action, speed, radius, assets.arena),
            Locomotion::Wrapping => self.state.agent.step_wrapping(action, speed, radius, assets.arena),
            Locomotion::Grid => {
                let (x, y) =
                    self.state.agent.step_on_grid(action[0], self.state.agent_tile, assets.parameters.arena_size);
                let centre = |corner: i32, tile: i32| corner + tile * TILE + TILE / 2;
                self.state.agent.position = (centre(assets.arena.0, x), centre(assets.arena.1, y));
            }
        }
        let (x, y) = self.state.agent.position;
        self.state.agent_tile = ((x - assets.arena.0).div_euclid(TILE), (y - assets.arena.1).div_euclid(TILE));
    }

    /// When the current command is due: checks it, and sets the tiles on fire.
    fn verify(&mut self, transition: &mut Transition, random: &mut Generator) {
        let due = self.state.command_steps > 0 && self.state.command_steps.is_multiple_of(self.state.explosion_delay);
        if !due || self.state.tiles_on {
            return;
        }
        let parameters = &self.assets.parameters;
        let endless = self.assets.variant.endless;
        if self.state.current_command < self.state.commands.len() {
            self.state.current_command += 1;
            self.state.tiles_on = true;
            if self.state.agent_tile == self.state.target {
                transition.reward += parameters.reward_command_success;
                self.state.total_completed += 1;
                if endless && self.state.current_command == self.state.commands.len() {
                    transition.reward += parameters.reward_sequence_success;
                }
            } else {
                transition.terminated = true;
                transition.reward += parameters.reward_command_failure;
            }
        }
        if self.state.current_command >= self.state.commands.len() {
            if endless {
                self.add_any_command(random);
                self.state.current_command = 0;
                self.state.verify_steps = 0;
                self.begin_clue(self.state.commands.len() - 1);
            } else {
                transition.terminated = true;
                self.state.success = true;
                transition.reward += parameters.reward_sequence_success;
            }
        }
        self.state.command_steps = 1;
    }

    /// While tiles burn: ends the episode where the agent stands on one, and puts them out when their time is over.
    fn burn(&mut self, transition: &mut Transition) {
        if !self.state.tiles_on {
            self.state.command_steps += 1;
        } else if self.state.verify_steps > 0 && self.state.verify_steps.is_multiple_of(self.state.explosion_duration) {
            self.state.tiles_on = false;
            self.state.verify_steps = 0;
            if self.state.current_command < self.state.commands.len() {
                self.state.target = self.tile_after(self.state.target, self.state.current_command);
            }
        } else {
            if self.state.agent_tile != self.state.target {
                transition.terminated = true;
                transition.reward = self.assets.parameters.reward_command_failure;
            }
            self.state.verify_steps += 1;
        }
    }

    /// The tile that is spared, while others are seen burning.
    pub(super) fn visible_fire(&self) -> Option<(i32, i32)> {
        (self.state.tiles_on && self.assets.parameters.visual_feedback).then_some(self.state.target)
    }

    /// The character that the frame shows, and its pictures.
    pub(super) fn shown_character(&self) -> (&Arc<CharacterSprites>, &Character) {
        if self.state.first_frame { (&self.assets.character, &self.state.agent) } else { self.last_moved() }
    }

    /// The character that moved last, in this episode or an earlier one, and its pictures.
    pub(super) fn last_moved(&self) -> (&Arc<CharacterSprites>, &Character) {
        match &self.state.shown {
            Shown::Former { character, .. } => (&self.former_sprites, character),
            Shown::Nobody | Shown::Current => (&self.assets.character, &self.state.agent),
        }
    }

    /// The final info of finite ids: success, and the share of commands that were executed.
    pub(super) fn finite_info(&self) -> [f64; 2] {
        let success = f64::from(u8::from(self.state.success));
        [success, (self.state.current_command as f64 - 1.0 + success) / self.state.commands.len() as f64]
    }

    /// The final info of the endless id: commands executed, and the longest sequence.
    pub(super) fn endless_info(&self) -> [f64; 2] {
        [self.state.total_completed as f64, self.state.commands.len().saturating_sub(1) as f64]
    }
}
