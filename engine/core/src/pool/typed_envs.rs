//! The environments of a pool, all of one family.

use std::cell::Cell;
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;

use serde_json::Value as Json;

use super::autoreset::Autoreset;
use super::config::{EnvReset, OptionMap, PoolConfig, ResetOptions, ResetRequest};
use super::division::EnvRange;
use super::drawn_scene::{DrawSettings, DrawnScene, FrameFormat, WrongFrame, draw_in_full};
use super::env_panic::{EnvPanic, catch};
use super::env_slot::{EnvSlot, OptionSet};
use super::episodes::{NextOptions, RunningEpisode};
use super::error::PoolError;
use super::seeding::{PoolEntropy, Seeding, Seeds};
use super::snapshot::{Saved, SnapshotError};
use super::threads::Threads;
use crate::batch::BatchMut;
use crate::disjoint::DisjointSlice;
use crate::envs::view::{self, Picture};
use crate::envs::{EnvSpec, Environment, ParameterError, Progress};
use crate::raster::FrameShape;

/// Arguments for writing a batch.
#[derive(Clone, Copy, Debug)]
pub(super) struct WriteContext<'a> {
    pub threads: &'a Threads,
    /// Index of the buffer's drawn scenes.
    pub buffer: usize,
    pub draw: DrawSettings,
}

/// The environments of a pool, of any family. One virtual call handles a whole batch.
pub(super) trait AnyEnvs: Send + Sync {
    /// Steps all environments.
    fn step(
        &mut self,
        context: WriteContext<'_>,
        autoreset: Autoreset,
        actions: &[i32],
        out: BatchMut<'_>,
    ) -> Result<(), PoolError>;

    /// Resets environments as `request` says and writes every environment's row.
    fn reset(
        &mut self,
        context: WriteContext<'_>,
        request: ResetRequest<'_>,
        out: BatchMut<'_>,
    ) -> Result<(), PoolError>;

    /// Sets reset parameters for environments, from their next episode on. The environments' numbers must be in range.
    fn set_options(&mut self, sets: &[NextOptions]) -> Result<(), ParameterError>;

    /// Seed and reset parameters of an environment's running episode.
    fn running_episode(&self, env: usize) -> RunningEpisode;

    /// The whole state of one environment.
    fn snapshot(&self, env: usize) -> Result<Vec<u8>, SnapshotError>;

    /// Replaces one environment's state with a snapshot's.
    fn restore(&mut self, env: usize, snapshot: &[u8]) -> Result<(), SnapshotError>;

    /// All frames of one environment's observation except the newest, each of `frame_bytes` bytes; empty for an observation of
    /// one frame.
    fn earlier_frames(&self, env: usize, format: FrameFormat) -> Vec<u8>;

    /// Replaces all frames of one environment's observation except the newest.
    fn restore_earlier_frames(&mut self, env: usize, frames: &[u8], frame_bytes: usize) -> Result<(), SnapshotError>;

    /// Progress of one environment's episode.
    fn progress(&self, env: usize) -> Vec<Progress>;

    /// Draws one environment's newest frame in full.
    fn frame(&self, env: usize, format: FrameFormat) -> Vec<u8>;

    /// Draws one environment's ground-truth view.
    fn ground_truth_view(&mut self, env: usize, shape: FrameShape) -> Picture;

    /// Sets the animations of one environment's ground-truth view to the current step.
    fn align_ground_truth_view(&mut self, env: usize);
}

/// The environments of a pool, all of one family.
pub(super) struct TypedEnvs<E: Environment> {
    slots: Vec<EnvSlot<E>>,
    /// For each buffer, the scenes that were last drawn into its frames.
    drawn: Vec<Vec<DrawnScene<E>>>,
    /// Frames in an observation.
    stack: usize,
    spec: EnvSpec,
    variant: E::Variant,
}

/// Creates the environments of one family; those with the same options share their assets.
pub(super) fn typed_envs<E: Environment>(
    spec: &EnvSpec,
    variant: E::Variant,
    config: &PoolConfig,
    entropy: PoolEntropy,
) -> Result<TypedEnvs<E>, PoolError> {
    // An environment's options, and the assets made from them.
    let make = |given: &OptionMap| -> Result<(Arc<OptionMap>, Arc<E::Assets>), ParameterError> {
        let parameters = spec.reset_parameters(given)?;
        Ok((Arc::new(given.clone()), Arc::new(E::assets(variant, &parameters))))
    };
    let made: Vec<_> = match &config.options {
        ResetOptions::Shared(given) => vec![make(given)?; config.num_envs],
        ResetOptions::Each(each) => {
            let mut known = HashMap::new();
            each.iter()
                .enumerate()
                .map(|(env, given)| match known.entry(Json::from(given.clone()).to_string()) {
                    Entry::Occupied(entry) => Ok(Clone::clone(entry.get())),
                    Entry::Vacant(entry) => make(given)
                        .map(|made| Clone::clone(entry.insert(made)))
                        .map_err(|source| PoolError::ParametersOf { env: config.first_env + env, source }),
                })
                .collect::<Result<_, _>>()?
        }
    };
    let list: Arc<[u64]> = match &config.seeding {
        Seeding::List(seeds) => seeds.as_slice().into(),
        _ => [].into(),
    };
    let stack = config.frames.unwrap_or_default().stack;
    let slots = made.into_iter().enumerate().map(|(env, (options, assets))| {
        let number = config.first_env + env;
        let mut seeds = Seeds::new(&config.seeding, &list, number, config.total_envs, entropy);
        if config.independent_episodes {
            seeds = seeds.independent(number, entropy);
        }
        EnvSlot::new(assets, options, seeds, entropy.environment(number), stack, config.independent_episodes)
    });
    Ok(TypedEnvs { slots: slots.collect(), drawn: Vec::new(), stack, spec: spec.clone(), variant })
}

impl<E: Environment> TypedEnvs<E> {
    /// Writes all rows. `play(env, slot, out, row)` plays environment `env` and writes row `row` of `out`, except its frames.
    fn write(
        &mut self,
        context: WriteContext<'_>,
        out: BatchMut<'_>,
        play: impl Fn(usize, &mut EnvSlot<E>, &mut BatchMut<'_>, usize) + Sync,
    ) -> Result<(), PoolError> {
        while self.drawn.len() <= context.buffer {
            self.drawn.push((0..self.slots.len() * self.stack).map(|_| DrawnScene::unknown()).collect());
        }
        let (stack, num_envs) = (self.stack, self.slots.len());
        let drawn = DisjointSlice::new(&mut self.drawn[context.buffer]);
        let all = EnvRange { first: 0, slots: DisjointSlice::new(&mut self.slots), drawn, stack, out };
        let id = self.spec.id;
        let played = all.for_each_piece(num_envs, context.threads, |piece| {
            let EnvRange { first, mut slots, mut drawn, mut out, .. } = piece;
            let slots = slots.as_mut();
            let current = Cell::new(0);
            let played = catch(|| {
                let envs = slots.iter_mut().zip(drawn.as_mut().chunks_exact_mut(stack));
                for (row, (slot, drawn)) in envs.enumerate() {
                    current.set(row);
                    play(first + row, slot, &mut out, row);
                    let frames = out.observation.row(row);
                    if !frames.is_empty() {
                        let outcome = slot.draw(drawn, context.draw, frames);
                        outcome.map_err(|wrong| WrongFrame { env: first + row, ..wrong })?;
                    }
                }
                Ok::<_, WrongFrame>(())
            });
            let (row, env) = (current.get(), first + current.get());
            match played {
                Ok(played) => played.map_err(PoolError::from),
                Err(message) => Err(EnvPanic { id, env: Some(env), seed: slots[row].episode_seed, message }.into()),
            }
            .map_err(|error| (env, error))
        });
        played.map_err(|(_, error)| error)
    }

    /// The assets for these options: shared with an environment that has the same options, or new.
    fn with_options(&self, options: &OptionMap) -> Result<OptionSet<E>, ParameterError> {
        for slot in &self.slots {
            if *slot.options == *options {
                return Ok((Arc::clone(&slot.assets), Arc::clone(&slot.options)));
            }
            if let Some((assets, known)) = slot.next.as_ref().filter(|(_, known)| **known == *options) {
                return Ok((Arc::clone(assets), Arc::clone(known)));
            }
        }
        let parameters = self.spec.reset_parameters(options)?;
        Ok((Arc::new(E::assets(self.variant, &parameters)), Arc::new(options.clone())))
    }
}

impl<E: Environment> AnyEnvs for TypedEnvs<E> {
    fn step(
        &mut self,
        context: WriteContext<'_>,
        autoreset: Autoreset,
        actions: &[i32],
        out: BatchMut<'_>,
    ) -> Result<(), PoolError> {
        let branches = self.spec.action_space.width();
        self.write(context, out, |env, slot, out, row| {
            slot.step(autoreset, context.draw, &actions[env * branches..][..branches], out, row);
        })
    }

    fn reset(
        &mut self,
        context: WriteContext<'_>,
        request: ResetRequest<'_>,
        out: BatchMut<'_>,
    ) -> Result<(), PoolError> {
        self.write(context, out, |env, slot, out, row| {
            match request {
                ResetRequest::All => slot.start_episode(None),
                ResetRequest::Seed(seed) => slot.start_episode(Some(seed.wrapping_add(env as u64))),
                ResetRequest::Each(each) => match each[env] {
                    EnvReset::Keep => {}
                    EnvReset::Next => slot.start_episode(None),
                    EnvReset::Seed(seed) => slot.start_episode(Some(seed)),
                },
            }
            slot.write_start(out, row);
        })
    }

    fn set_options(&mut self, sets: &[NextOptions]) -> Result<(), ParameterError> {
        // Makes all before it sets the first, so that an error changes no environment.
        let made: Vec<_> = sets.iter().map(|set| self.with_options(&set.options)).collect::<Result<_, _>>()?;
        for (set, (assets, options)) in sets.iter().zip(made) {
            for env in &set.envs {
                self.slots[*env].next = Some((Arc::clone(&assets), Arc::clone(&options)));
            }
        }
        Ok(())
    }

    fn running_episode(&self, env: usize) -> RunningEpisode {
        let slot = &self.slots[env];
        RunningEpisode { env, seed: slot.episode_seed, options: OptionMap::clone(&slot.options), ended: slot.ended }
    }

    fn snapshot(&self, env: usize) -> Result<Vec<u8>, SnapshotError> {
        let slot = &self.slots[env];
        // Saving borrows the state and restoring owns it; the encoding is the same.
        Saved {
            id: self.spec.id.to_owned(),
            options: text(&slot.options),
            next_options: slot.next.as_ref().map(|(_, options)| text(options)),
            episode_seed: slot.episode_seed,
            random: slot.random.clone(),
            seeds: slot.seeds.save(),
            episode_return: slot.episode_return,
            episode_length: slot.episode_length,
            ended: slot.ended,
            state: slot.env.state(),
        }
        .to_bytes()
    }

    fn restore(&mut self, env: usize, snapshot: &[u8]) -> Result<(), SnapshotError> {
        let saved = Saved::<E::State>::from_bytes(snapshot)?;
        if saved.id != self.spec.id {
            return Err(SnapshotError::OtherEnvironment { given: saved.id, expected: self.spec.id });
        }
        let made = |text: String| -> Result<_, SnapshotError> {
            let options: OptionMap =
                serde_json::from_str(&text).map_err(|error| SnapshotError::Content(error.to_string()))?;
            Ok(self.with_options(&options)?)
        };
        let (assets, options) = made(saved.options)?;
        let next = saved.next_options.map(made).transpose()?;
        let slot = &mut self.slots[env];
        slot.env.restore(&assets, saved.state)?;
        slot.frame_stack.restart(|| slot.env.scene());
        slot.assets = assets;
        slot.options = options;
        slot.next = next;
        slot.episode_seed = saved.episode_seed;
        slot.random = saved.random;
        slot.seeds.restore(saved.seeds);
        slot.episode_return = saved.episode_return;
        slot.episode_length = saved.episode_length;
        slot.ended = saved.ended;
        Ok(())
    }

    fn earlier_frames(&self, env: usize, format: FrameFormat) -> Vec<u8> {
        let slot = &self.slots[env];
        let bytes = format.bytes();
        let mut frames = vec![0; (self.stack - 1) * bytes];
        for (stacked, frame) in slot.frame_stack.earlier().zip(frames.chunks_exact_mut(bytes.max(1))) {
            slot.draw_stacked(stacked, format, frame);
        }
        frames
    }

    fn restore_earlier_frames(&mut self, env: usize, frames: &[u8], frame_bytes: usize) -> Result<(), SnapshotError> {
        let (given, expected) = (frames.len(), (self.stack - 1) * frame_bytes);
        if given != expected {
            return Err(SnapshotError::EarlierFrames { given, expected });
        }
        self.slots[env].frame_stack.set_earlier(frames.chunks_exact(frame_bytes.max(1)).map(Arc::from));
        Ok(())
    }

    fn progress(&self, env: usize) -> Vec<Progress> {
        self.slots[env].env.progress()
    }

    fn frame(&self, env: usize, format: FrameFormat) -> Vec<u8> {
        let (env, mut frame) = (&self.slots[env].env, vec![0; format.bytes()]);
        draw_in_full::<E>(env.shared(), &env.scene(), format, &mut frame);
        frame
    }

    fn ground_truth_view(&mut self, env: usize, shape: FrameShape) -> Picture {
        view::ground_truth_view(&mut self.slots[env].env, shape)
    }

    fn align_ground_truth_view(&mut self, env: usize) {
        self.slots[env].env.align_ground_truth();
    }
}

/// Reset parameters as JSON text.
fn text(options: &OptionMap) -> String {
    Json::from(options.clone()).to_string()
}
