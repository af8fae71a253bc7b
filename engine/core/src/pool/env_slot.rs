//! One environment of a pool, and how it writes its row of a batch.

use std::sync::Arc;

use super::autoreset::Autoreset;
use super::config::OptionMap;
use super::drawn_scene::{DrawSettings, DrawnScene, FrameFormat, WrongFrame, draw_in_full};
use super::frame_stack::{FrameStack, StackedFrame};
use super::seeding::Seeds;
use crate::batch::BatchMut;
use crate::envs::{Environment, Transition};
use crate::random::Generator;

/// An environment with its generator, its seeds, and the return and length of its episode.
pub(super) struct EnvSlot<E: Environment> {
    pub env: E,
    /// The assets for the next episode, unless `next` replaces them.
    pub assets: Arc<E::Assets>,
    pub random: Generator,
    pub seeds: Seeds,
    pub episode_return: f64,
    pub episode_length: i32,
    pub frame_stack: FrameStack<E::Scene>,
    /// Whether the last step ended the episode. With next-step autoreset, the next step then starts another.
    pub ended: bool,
    /// Whether every episode starts as in a new environment.
    independent_episodes: bool,
    /// The reset parameters, as given, from which `assets` were made.
    pub options: Arc<OptionMap>,
    /// New assets and options, used from the next episode on.
    pub next: Option<OptionSet<E>>,
    /// The seed that the running episode started with, unless it continued the generator.
    pub episode_seed: Option<u64>,
}

/// Assets, and the reset parameters, as given, from which they were made.
pub(super) type OptionSet<E> = (Arc<<E as Environment>::Assets>, Arc<OptionMap>);

impl<E: Environment> EnvSlot<E> {
    /// An environment that has not been reset yet, for observations of `stack` frames. `random` is its generator until an episode
    /// is seeded.
    pub fn new(
        assets: Arc<E::Assets>,
        options: Arc<OptionMap>,
        seeds: Seeds,
        random: Generator,
        stack: usize,
        independent_episodes: bool,
    ) -> Self {
        EnvSlot {
            env: E::new(&assets),
            assets,
            random,
            seeds,
            episode_return: 0.0,
            episode_length: 0,
            frame_stack: FrameStack::new(stack),
            ended: false,
            independent_episodes,
            options,
            next: None,
            episode_seed: None,
        }
    }

    /// Starts an episode with `seed`, or else with the environment's next seed.
    pub fn start_episode(&mut self, seed: Option<u64>) {
        if let Some(seed) = seed {
            self.seeds.restart(seed);
        }
        self.episode_seed = seed.or_else(|| self.seeds.next());
        if let Some(seed) = self.episode_seed {
            self.random = Generator::from_seed(seed);
        }
        if let Some(next) = self.next.take() {
            (self.assets, self.options) = next;
        }
        if self.independent_episodes {
            self.env = E::new(&self.assets);
        }
        if let Some(seed) = self.episode_seed {
            self.env.seed(seed);
        }
        self.env.reset(&self.assets, &mut self.random);
        self.frame_stack.restart(|| self.env.scene());
        self.episode_return = 0.0;
        self.episode_length = 0;
        self.ended = false;
    }

    /// The observation's frames.
    fn frames(&self) -> impl Iterator<Item = StackedFrame<E::Scene>> {
        self.frame_stack.frames(|| self.env.scene())
    }

    /// Writes a frame of the observation in full.
    pub fn draw_stacked(&self, stacked: &StackedFrame<E::Scene>, format: FrameFormat, frame: &mut [u8]) {
        match stacked {
            StackedFrame::Scene(scene) => draw_in_full::<E>(self.env.shared(), scene, format, frame),
            StackedFrame::Pixels(pixels) => frame.copy_from_slice(pixels),
        }
    }

    /// Plays a step, or with next-step autoreset starts the next episode, and writes the environment's row except its frames.
    pub fn step(
        &mut self,
        autoreset: Autoreset,
        draw: DrawSettings,
        action: &[i32],
        out: &mut BatchMut<'_>,
        row: usize,
    ) {
        if self.ended && autoreset == Autoreset::NextStep {
            self.start_episode(None);
            return self.write_start(out, row);
        }
        let transition = self.env.step(action, &mut self.random);
        self.frame_stack.push(|| self.env.scene());
        self.episode_return += transition.reward;
        self.episode_length = self.episode_length.saturating_add(1);
        self.ended = transition.terminated || transition.truncated;
        self.write_transition(out, row, transition);
        if self.ended {
            self.env.info(out.info.row(row));
            if autoreset == Autoreset::SameStep {
                self.write_final_observation(draw, out, row);
                self.start_episode(None);
            }
        } else {
            out.info.row(row).fill(0.0);
        }
        self.write_numbers(out, row);
    }

    /// Writes the row of an environment that did not step, except its frames: the current observation, a reward of 0, and no
    /// flags.
    pub fn write_start(&self, out: &mut BatchMut<'_>, row: usize) {
        self.write_transition(out, row, Transition::default());
        out.info.row(row).fill(0.0);
        self.write_numbers(out, row);
    }

    fn write_transition(&self, out: &mut BatchMut<'_>, row: usize, transition: Transition) {
        out.reward.set(row, transition.reward);
        out.terminated.set(row, u8::from(transition.terminated));
        out.truncated.set(row, u8::from(transition.truncated));
        out.episode_return.set(row, self.episode_return);
        out.episode_length.set(row, self.episode_length);
    }

    /// Writes the observations other than the frames.
    fn write_numbers(&self, out: &mut BatchMut<'_>, row: usize) {
        out.vector_observation.write(row, |r| self.env.vector_observation(r));
        out.features.write(row, |r| self.env.features(r));
        out.ground_truth.write(row, |r| self.env.ground_truth(r));
        out.state.write(row, |r| self.env.markov_state(r));
    }

    /// Updates the frames of the observation. `drawn` holds the scene that was last drawn into each frame.
    #[inline]
    pub fn draw(
        &self,
        drawn: &mut [DrawnScene<E>],
        settings: DrawSettings,
        frames: &mut [u8],
    ) -> Result<(), WrongFrame> {
        let assets = self.env.shared();
        if let [drawn] = drawn {
            return drawn.update(assets, self.env.scene(), settings, frames);
        }
        let frames = frames.chunks_exact_mut(frames.len() / drawn.len());
        let mut stacked = self.frames().zip(drawn).zip(frames);
        stacked.try_for_each(|((stacked, drawn), frame)| match stacked {
            StackedFrame::Scene(scene) => drawn.update(assets, scene, settings, frame),
            StackedFrame::Pixels(pixels) => {
                frame.copy_from_slice(&pixels);
                *drawn = DrawnScene::unknown();
                Ok(())
            }
        })
    }

    fn write_final_observation(&self, draw: DrawSettings, out: &mut BatchMut<'_>, row: usize) {
        out.final_observation.write(row, |r| {
            for (stacked, frame) in self.frames().zip(r.chunks_exact_mut(r.len() / self.frame_stack.length())) {
                self.draw_stacked(&stacked, draw.frame, frame);
            }
        });
        out.final_vector_observation.write(row, |r| self.env.vector_observation(r));
        out.final_features.write(row, |r| self.env.features(r));
        out.final_ground_truth.write(row, |r| self.env.ground_truth(r));
        out.final_state.write(row, |r| self.env.markov_state(r));
    }
}
