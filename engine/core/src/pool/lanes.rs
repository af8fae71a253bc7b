//! Environments of one family in a row, stepped piece by piece.

use std::sync::{Arc, Mutex, PoisonError};

use serde_json::{Map, Value as Json};

use super::history::History;
use super::seeding::Seeds;
use super::shown::{self, Drawing, Shown, WrongFrame};
use super::snapshot::{Saved, SnapshotError};
use super::threads::{Threads, lock};
use super::{Autoreset, ResetRequest};
use crate::batch::BatchMut;
use crate::envs::{EnvSpec, Environment, ParameterError, ResetParameters, view};
use crate::random::Generator;

/// One environment with all that belongs to it alone.
struct Lane<E: Environment> {
    env: E,
    assets: Arc<E::Assets>,
    random: Generator,
    seeds: Seeds,
    episode_return: f64,
    episode_length: i32,
    history: History<E::Scene>,
    /// The last step ended the episode, and the next one is to start a new one (next-step auto-reset).
    ended: bool,
    /// The reset parameters that were given.
    options: Arc<Options>,
}

/// Reset parameters by name, as they were given.
pub(super) type Options = Map<String, Json>;

impl<E: Environment> Lane<E> {
    fn start_episode(&mut self, seed: Option<u64>) {
        if let Some(seed) = seed.or_else(|| self.seeds.next()) {
            self.random = Generator::from_seed(seed);
        }
        self.env.reset(&self.assets, &mut self.random);
        self.history.restart(|| self.env.scene());
        self.episode_return = 0.0;
        self.episode_length = 0;
        self.ended = false;
    }

    /// The scenes of the observation's frames.
    fn scenes(&self) -> impl Iterator<Item = E::Scene> {
        self.history.scenes(|| self.env.scene())
    }

    /// Plays a step and writes its row, without its frame.
    fn step(&mut self, autoreset: Autoreset, drawing: Drawing, action: &[i32], out: &mut BatchMut<'_>, row: usize) {
        if self.ended && autoreset == Autoreset::NextStep {
            self.start_episode(None);
            return self.write_start(out, row);
        }
        let transition = self.env.step(action, &mut self.random);
        self.history.push(|| self.env.scene());
        self.episode_return += transition.reward;
        self.episode_length = self.episode_length.saturating_add(1);
        self.ended = transition.terminated;
        self.write_transition(out, row, transition.reward, transition.terminated);
        if transition.terminated {
            self.env.info(out.info.row(row));
            if autoreset == Autoreset::SameStep {
                self.write_final_observation(drawing, out, row);
                self.start_episode(None);
            }
        } else {
            out.info.row(row).fill(0.0);
        }
        self.write_numbers(out, row);
    }

    /// Writes the row of an environment that did not step, without its frame: its current observation, and no reward.
    fn write_start(&self, out: &mut BatchMut<'_>, row: usize) {
        self.write_transition(out, row, 0.0, false);
        out.info.row(row).fill(0.0);
        self.write_numbers(out, row);
    }

    fn write_transition(&self, out: &mut BatchMut<'_>, row: usize, reward: f64, terminated: bool) {
        out.reward.row(row)[0] = reward;
        out.terminated.row(row)[0] = u8::from(terminated);
        out.truncated.row(row)[0] = 0;
        out.episode_return.row(row)[0] = self.episode_return;
        out.episode_length.row(row)[0] = self.episode_length;
    }

    /// Writes what is observed beside the frame.
    fn write_numbers(&self, out: &mut BatchMut<'_>, row: usize) {
        write_if_present(out.vector_observation.row(row), |r| self.env.vector_observation(r));
        write_if_present(out.features.row(row), |r| self.env.features(r));
        write_if_present(out.ground_truth.row(row), |r| self.env.ground_truth(r));
    }

    /// Makes the frames of the observation show the environment. `shown` has what is noted about each of them.
    #[inline]
    fn draw(&self, shown: &mut [Shown<E>], drawing: Drawing, frames: &mut [u8]) -> Result<(), WrongFrame> {
        let assets = self.env.shared();
        if let [shown] = shown {
            return shown.update(assets, self.env.scene(), drawing, frames);
        }
        let frames = frames.chunks_exact_mut(frames.len() / shown.len());
        let mut drawn = self.scenes().zip(shown).zip(frames);
        drawn.try_for_each(|((scene, shown), frame)| shown.update(assets, scene, drawing, frame))
    }

    fn write_final_observation(&self, drawing: Drawing, out: &mut BatchMut<'_>, row: usize) {
        write_if_present(out.final_observation.row(row), |r| {
            for (scene, frame) in self.scenes().zip(r.chunks_exact_mut(r.len() / self.history.length())) {
                shown::draw::<E>(self.env.shared(), &scene, drawing.format, frame);
            }
        });
        write_if_present(out.final_vector_observation.row(row), |r| self.env.vector_observation(r));
        write_if_present(out.final_features.row(row), |r| self.env.features(r));
        write_if_present(out.final_ground_truth.row(row), |r| self.env.ground_truth(r));
    }
}

fn write_if_present<T>(row: &mut [T], write: impl FnOnce(&mut [T])) {
    if !row.is_empty() {
        write(row);
    }
}

/// Environments that one thread steps in one go: few, so that none waits long for one whose environments have much to do.
const ENVS_IN_PIECE: usize = 16;

/// Fewer environments than these are stepped by the calling thread: they are done before others have come.
const ENVS_FOR_THREADS: usize = 64;

/// How a batch is to be written.
#[derive(Clone, Copy, Debug)]
pub(super) struct Work<'a> {
    pub threads: &'a Threads,
    /// Where is noted what the frames of the batch show.
    pub slot: usize,
    pub drawing: Drawing,
}

/// Environments in a row, whatever their family: one virtual call for a whole batch.
pub(super) trait Lanes: Send + Sync {
    /// Steps all environments.
    fn step(
        &mut self,
        work: Work<'_>,
        autoreset: Autoreset,
        actions: &[i32],
        out: BatchMut<'_>,
    ) -> Result<(), WrongFrame>;

    /// Resets environments as `request` says and writes every environment's row.
    fn reset(&mut self, work: Work<'_>, request: ResetRequest<'_>, out: BatchMut<'_>) -> Result<(), WrongFrame>;

    /// Gives the environments that `request` resets other reset parameters, from their next episode on.
    fn set_options(&mut self, request: ResetRequest<'_>, options: &Options) -> Result<(), ParameterError>;

    /// The whole state of one environment.
    fn snapshot(&self, env: usize) -> Result<Vec<u8>, SnapshotError>;

    /// Goes on from a snapshot in the place of one environment.
    fn restore(&mut self, env: usize, snapshot: &[u8]) -> Result<(), SnapshotError>;

    /// Draws one environment's ground-truth view.
    fn ground_truth_view(&mut self, env: usize, out: &mut [u8]);
}

/// The environments of one pool.
pub(super) struct FamilyLanes<E: Environment> {
    lanes: Vec<Lane<E>>,
    /// What the frames show, of each buffer by its slot.
    shown: Vec<Vec<Shown<E>>>,
    /// Frames in an observation.
    stack: usize,
    spec: &'static EnvSpec,
    variant: E::Variant,
}

impl<E: Environment> FamilyLanes<E> {
    /// Environments with the given assets and seeds, none of them reset yet.
    pub(super) fn new(
        spec: &'static EnvSpec,
        variant: E::Variant,
        stack: usize,
        environments: impl Iterator<Item = (Arc<E::Assets>, Arc<Options>, Seeds, Generator)>,
    ) -> Self {
        let lanes = environments
            .map(|(assets, options, seeds, random)| Lane {
                env: E::new(&assets),
                assets,
                random,
                seeds,
                episode_return: 0.0,
                episode_length: 0,
                history: History::new(stack),
                ended: false,
                options,
            })
            .collect();
        FamilyLanes { lanes, shown: Vec::new(), stack, spec, variant }
    }

    /// Writes all rows: `play` writes everything but the frame of the row that it gets, with the environment's number.
    fn write(
        &mut self,
        work: Work<'_>,
        out: BatchMut<'_>,
        play: impl Fn(usize, &mut Lane<E>, &mut BatchMut<'_>, usize) + Sync,
    ) -> Result<(), WrongFrame> {
        while self.shown.len() <= work.slot {
            self.shown.push((0..self.lanes.len() * self.stack).map(|_| Shown::nothing()).collect());
        }
        let (stack, shown) = (self.stack, &mut self.shown[work.slot]);
        let whole = Slice { first: 0, lanes: &mut self.lanes, shown, stack, out };
        whole.share(work.threads, |slice| {
            let Slice { first, lanes, shown, mut out, .. } = slice;
            for (row, (lane, shown)) in lanes.iter_mut().zip(shown.chunks_exact_mut(stack)).enumerate() {
                play(first + row, lane, &mut out, row);
                let frames = out.observation.row(row);
                if !frames.is_empty() {
                    let drawn = lane.draw(shown, work.drawing, frames);
                    drawn.map_err(|wrong| WrongFrame { env: first + row, ..wrong })?;
                }
            }
            Ok(())
        })
    }

    /// The assets for these options: those of an environment that has the same, or new ones.
    fn with_options(&self, options: &Options) -> Result<(Arc<E::Assets>, Arc<Options>), ParameterError> {
        if let Some(lane) = self.lanes.iter().find(|lane| *lane.options == *options) {
            return Ok((Arc::clone(&lane.assets), Arc::clone(&lane.options)));
        }
        let parameters = ResetParameters::new(self.spec.id, self.spec.parameters, options)?;
        Ok((Arc::new(E::assets(self.variant, &parameters)), Arc::new(options.clone())))
    }
}

impl<E: Environment> Lanes for FamilyLanes<E> {
    fn step(
        &mut self,
        work: Work<'_>,
        autoreset: Autoreset,
        actions: &[i32],
        out: BatchMut<'_>,
    ) -> Result<(), WrongFrame> {
        let branches = self.spec.action_space.branches().len();
        self.write(work, out, |env, lane, out, row| {
            lane.step(autoreset, work.drawing, &actions[env * branches..][..branches], out, row);
        })
    }

    fn reset(&mut self, work: Work<'_>, request: ResetRequest<'_>, out: BatchMut<'_>) -> Result<(), WrongFrame> {
        self.write(work, out, |env, lane, out, row| {
            match request {
                ResetRequest::All => lane.start_episode(None),
                ResetRequest::Seed(seed) => lane.start_episode(Some(seed.wrapping_add(env as u64))),
                ResetRequest::Each { reset, seed } => match reset[env] {
                    0 => {}
                    1 => lane.start_episode(None),
                    _ => lane.start_episode(Some(seed[env])),
                },
            }
            lane.write_start(out, row);
        })
    }

    fn set_options(&mut self, request: ResetRequest<'_>, options: &Options) -> Result<(), ParameterError> {
        let (assets, options) = self.with_options(options)?;
        for (env, lane) in self.lanes.iter_mut().enumerate() {
            if request.resets(env) {
                lane.assets = Arc::clone(&assets);
                lane.options = Arc::clone(&options);
            }
        }
        Ok(())
    }

    fn snapshot(&self, env: usize) -> Result<Vec<u8>, SnapshotError> {
        let lane = &self.lanes[env];
        // The state is borrowed when it is saved and owned when it is restored; its encoding is the same.
        Saved {
            id: self.spec.id.to_owned(),
            options: Json::from(Options::clone(&lane.options)).to_string(),
            random: lane.random.clone(),
            seeds: lane.seeds.save(),
            episode_return: lane.episode_return,
            episode_length: lane.episode_length,
            ended: lane.ended,
            state: lane.env.state(),
        }
        .to_bytes()
    }

    fn restore(&mut self, env: usize, snapshot: &[u8]) -> Result<(), SnapshotError> {
        let saved = Saved::<E::State>::from_bytes(snapshot)?;
        if saved.id != self.spec.id {
            return Err(SnapshotError::OtherEnvironment { given: saved.id, expected: self.spec.id });
        }
        let options: Options =
            serde_json::from_str(&saved.options).map_err(|error| SnapshotError::Content(error.to_string()))?;
        let (assets, options) = self.with_options(&options)?;
        let lane = &mut self.lanes[env];
        lane.env.restore(&assets, saved.state)?;
        lane.history.restart(|| lane.env.scene());
        lane.assets = assets;
        lane.options = options;
        lane.random = saved.random;
        lane.seeds.restore(saved.seeds);
        lane.episode_return = saved.episode_return;
        lane.episode_length = saved.episode_length;
        lane.ended = saved.ended;
        Ok(())
    }

    fn ground_truth_view(&mut self, env: usize, out: &mut [u8]) {
        view::ground_truth_view(&mut self.lanes[env].env, out);
    }
}

/// Consecutive environments with all that belongs to them.
struct Slice<'a, E: Environment> {
    /// Number of the first environment.
    first: usize,
    lanes: &'a mut [Lane<E>],
    /// By environment, as many as there are frames in an observation.
    shown: &'a mut [Shown<E>],
    stack: usize,
    out: BatchMut<'a>,
}

impl<E: Environment> Slice<'_, E> {
    /// Has `work` done on all of it, piece by piece, by all threads that come. The caller takes pieces from the front and workers
    /// from the back, so that the memory of an environment mostly stays with the core that touched it last.
    fn share(
        self,
        threads: &Threads,
        work: impl Fn(Slice<'_, E>) -> Result<(), WrongFrame> + Sync,
    ) -> Result<(), WrongFrame> {
        if threads.count() == 1 || self.lanes.len() < ENVS_FOR_THREADS {
            return work(self);
        }
        let helpers = self.lanes.len().div_ceil(ENVS_IN_PIECE) - 1;
        let rest = Mutex::new(Some(self));
        let outcome = Mutex::new(Ok(()));
        threads.run(helpers, &|thread| {
            while let Some(piece) = Self::take_piece(&rest, thread == 0) {
                let Err(wrong) = work(piece) else { continue };
                let mut outcome = lock(&outcome);
                if outcome.as_ref().err().is_none_or(|known: &WrongFrame| wrong.env < known.env) {
                    *outcome = Err(wrong);
                }
            }
        });
        outcome.into_inner().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a piece of what is left.
    fn take_piece(rest: &Mutex<Option<Self>>, from_front: bool) -> Option<Self> {
        let mut rest = lock(rest);
        let (piece, others) = rest.take()?.piece(from_front);
        *rest = others;
        Some(piece)
    }

    /// The first or last few environments, and those that are left, if there are.
    fn piece(self, from_front: bool) -> (Self, Option<Self>) {
        let num_envs = self.lanes.len();
        if num_envs <= ENVS_IN_PIECE {
            return (self, None);
        }
        if from_front {
            let (piece, others) = self.split_at(ENVS_IN_PIECE);
            (piece, Some(others))
        } else {
            let (others, piece) = self.split_at(num_envs - ENVS_IN_PIECE);
            (piece, Some(others))
        }
    }

    /// Divides everything before environment `middle`.
    fn split_at(self, middle: usize) -> (Self, Self) {
        let (first, stack) = (self.first, self.stack);
        let (left_lanes, right_lanes) = self.lanes.split_at_mut(middle);
        let (left_shown, right_shown) = self.shown.split_at_mut(middle * stack);
        let (left_out, right_out) = self.out.split_at(middle);
        (
            Slice { first, lanes: left_lanes, shown: left_shown, stack, out: left_out },
            Slice { first: first + middle, lanes: right_lanes, shown: right_shown, stack, out: right_out },
        )
    }
}
