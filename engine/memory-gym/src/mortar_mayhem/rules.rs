//! The rules of Mortar Mayhem: one implementation for all five ids.
//!
//! Source: `reset` and `step` of the original's `mortar_mayhem*.py` and `endless_mortar_mayhem.py`. The order of the random
//! draws is part of the rules.

use super::commands::Command;
use super::config::Config;
use super::display_schedule::DisplaySchedule;
use super::parameters::{Locomotion, Parameters};
use super::state::{DisplayedCharacter, State};
use crate::character::Character;
use endless_gym_core::envs::Transition;
use endless_gym_core::random::Generator;

impl State {
    /// Starts an episode. `last_scale` is the scale of the agent in the previous episode.
    pub(super) fn reset(&mut self, config: &Config, last_scale: f64, random: &mut Generator) {
        let (variant, parameters) = (config.variant, &config.parameters);
        if self.displayed == DisplayedCharacter::Current {
            self.displayed = DisplayedCharacter::Earlier { character: self.agent, scale: last_scale };
        }

        let size = i64::from(parameters.arena_size);
        let tile = random.integers(0, size * size);
        self.agent_tile = ((tile / size) as i32, (tile % size) as i32);
        let mut offset = (0, 0);
        if variant.start_offset {
            offset = (random.integers(-2, 2) as i32, random.integers(-2, 2) as i32);
        }
        let (x, y) = config.centre(self.agent_tile);
        self.agent = Character { position: (x + offset.0, y + offset.1), rotation: 0 };

        self.commands.clear();
        if variant.endless {
            for _ in 0..parameters.initial_command_count {
                self.add_any_command(parameters, random);
            }
        } else {
            let count = *random.choice(&parameters.command_count);
            self.add_valid_commands(config, count, random);
        }
        self.display = DisplaySchedule::default();
        self.view_display = DisplaySchedule::default();
        if !variant.commands_given {
            self.show_duration = *random.choice(&parameters.command_show_duration) as usize;
            self.show_delay = *random.choice(&parameters.command_show_delay) as usize;
            self.start_display(0);
        }
        self.show_next_command();

        self.target = self.tile_after(config, self.agent_tile, 0);
        self.tiles_on = false;
        self.current_command = 0;
        self.command_steps = 0;
        self.verify_steps = 0;
        self.steps = 0;
        self.total_completed = 0;
        self.success = false;
        self.first_frame = true;
        self.explosion_duration = *random.choice(&parameters.explosion_duration) as u32;
        self.explosion_delay = *random.choice(&parameters.explosion_delay) as u32;
    }

    /// Adds `count` commands that stay within the arena, each drawn from those that are possible after the last one.
    fn add_valid_commands(&mut self, config: &Config, count: i64, random: &mut Generator) {
        let mut at = self.agent_tile;
        for _ in 0..count {
            let valid = || {
                Command::first(config.parameters.allowed_commands).filter(|command| config.contains(command.apply(at)))
            };
            let drawn = random.integers(0, valid().count() as i64) as usize;
            // From any tile, at least two of the first four commands lead to another.
            if let Some(command) = valid().nth(drawn) {
                at = command.apply(at);
                self.commands.push(command);
            }
        }
    }

    fn add_any_command(&mut self, parameters: &Parameters, random: &mut Generator) {
        let drawn = random.integers(0, parameters.allowed_commands as i64);
        self.commands.push(Command::from_index(drawn as usize));
    }

    /// The tile that the command at `index` leads to; the endless arena is a torus.
    fn tile_after(&self, config: &Config, tile: (i32, i32), index: usize) -> (i32, i32) {
        let (x, y) = self.commands.get(index).map_or(tile, |command| command.apply(tile));
        if config.variant.endless {
            let size = config.parameters.arena_size;
            (x.rem_euclid(size), y.rem_euclid(size))
        } else {
            (x, y)
        }
    }

    /// Starts showing the commands from index `first` on.
    fn start_display(&mut self, first: usize) {
        let count = self.commands.len() - first;
        self.display = DisplaySchedule::new(first, count, self.show_duration, self.show_delay);
        self.view_display = self.display;
    }

    /// Sets the view's schedule as if every frame of the episode had been viewed once.
    pub(super) fn align_view_display(&mut self) {
        // A schedule that starts with the episode shows its first frame at once; a later one, in the next step.
        let starts_with_episode = self.display.first() == 0;
        self.view_display = self.display.before(usize::from(starts_with_episode));
    }

    fn show_next_command(&mut self) {
        self.shown_command = self.display.next_frame().and_then(|index| self.commands.get(index).copied());
    }

    /// Plays one step.
    pub(super) fn step(&mut self, config: &Config, action: &[i32], random: &mut Generator) -> Transition {
        let mut transition = Transition::default();
        self.first_frame = false;
        self.success = false;
        if self.display.is_over() {
            self.shown_command = None;
            self.displayed = DisplayedCharacter::Current;
            self.move_agent(config, action);
            self.verify(config, &mut transition, random);
            self.burn(config, &mut transition);
        } else {
            self.show_next_command();
            if !config.variant.endless || self.displayed == DisplayedCharacter::Initial {
                self.displayed = DisplayedCharacter::Current;
            }
        }
        self.steps += 1;
        transition.terminated |= self.steps == config.parameters.max_steps;
        transition
    }

    fn move_agent(&mut self, config: &Config, action: &[i32]) {
        let (speed, radius) = (config.parameters.agent_speed, config.agent.radius);
        match config.variant.locomotion {
            Locomotion::Free => self.agent.step_within(action, speed, radius, config.arena),
            Locomotion::Wrapping => self.agent.step_wrapping(action, speed, radius, config.arena),
            Locomotion::Grid => {
                let tile = self.agent.step_on_grid(action[0], self.agent_tile, config.parameters.arena_size);
                self.agent.position = config.centre(tile);
            }
        }
        self.agent_tile = config.tile_at(self.agent.position);
    }

    /// Checks the current command when it is due, and sets the tiles on fire.
    fn verify(&mut self, config: &Config, transition: &mut Transition, random: &mut Generator) {
        let due = self.command_steps > 0 && self.command_steps.is_multiple_of(self.explosion_delay);
        if !due || self.tiles_on {
            return;
        }
        let parameters = &config.parameters;
        let endless = config.variant.endless;
        if self.current_command < self.commands.len() {
            self.current_command += 1;
            self.tiles_on = true;
            if self.agent_tile == self.target {
                transition.reward += parameters.reward_command_success;
                self.total_completed += 1;
                if endless && self.current_command == self.commands.len() {
                    transition.reward += parameters.reward_sequence_success;
                }
            } else {
                transition.terminated = true;
                transition.reward += parameters.reward_command_failure;
            }
        }
        if self.current_command >= self.commands.len() {
            if endless {
                self.add_any_command(parameters, random);
                self.current_command = 0;
                self.verify_steps = 0;
                self.start_display(self.commands.len() - 1);
            } else {
                transition.terminated = true;
                self.success = true;
                transition.reward += parameters.reward_sequence_success;
            }
        }
        self.command_steps = 1;
    }

    /// While tiles burn, ends the episode if the agent is on one, and extinguishes them after `explosion_duration` steps.
    fn burn(&mut self, config: &Config, transition: &mut Transition) {
        if !self.tiles_on {
            self.command_steps += 1;
        } else if self.verify_steps > 0 && self.verify_steps.is_multiple_of(self.explosion_duration) {
            self.tiles_on = false;
            self.verify_steps = 0;
            if self.current_command < self.commands.len() {
                self.target = self.tile_after(config, self.target, self.current_command);
            }
        } else {
            if self.agent_tile != self.target {
                transition.terminated = true;
                transition.reward = config.parameters.reward_command_failure;
            }
            self.verify_steps += 1;
        }
    }
}
