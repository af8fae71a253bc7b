//! Environments of one family in a row, stepped slice by slice.

use std::sync::Arc;

use serde_json::{Map, Value as Json};

use super::seeding::Seeds;
use super::snapshot::{Saved, SnapshotError};
use super::{Autoreset, ResetRequest};
use crate::batch::BatchMut;
use crate::envs::{Environment, ParameterError, ResetParameters, Spec, view};
use crate::random::Generator;

/// One environment with all that belongs to it alone.
struct Lane<E: Environment> {
    env: E,
    assets: Arc<E::Assets>,
    random: Generator,
    seeds: Seeds,
    episode_return: f64,
    episode_length: i32,
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
        self.episode_return = 0.0;
        self.episode_length = 0;
        self.ended = false;
    }

    fn step(&mut self, autoreset: Autoreset, action: &[i32], out: &mut BatchMut<'_>, row: usize) {
        if self.ended && autoreset == Autoreset::NextStep {
            self.start_episode(None);
            return self.write_start(out, row);
        }
        let transition = self.env.step(action, &mut self.random);
        self.episode_return += transition.reward;
        self.episode_length += 1;
        self.ended = transition.terminated;
        self.write_transition(out, row, transition.reward, transition.terminated);
        if transition.terminated {
            self.env.info(out.info.row(row));
            if autoreset == Autoreset::SameStep {
                self.write_final_observation(out, row);
                self.start_episode(None);
            }
        } else {
            out.info.row(row).fill(0.0);
        }
        self.write_observation(out, row);
    }

    /// Writes the row of an environment that did not step: its current observation, and no reward.
    fn write_start(&self, out: &mut BatchMut<'_>, row: usize) {
        self.write_transition(out, row, 0.0, false);
        out.info.row(row).fill(0.0);
        self.write_observation(out, row);
    }

    fn write_transition(&self, out: &mut BatchMut<'_>, row: usize, reward: f64, terminated: bool) {
        out.reward.row(row)[0] = reward;
        out.terminated.row(row)[0] = u8::from(terminated);
        out.truncated.row(row)[0] = 0;
        out.episode_return.row(row)[0] = self.episode_return;
        out.episode_length.row(row)[0] = self.episode_length;
    }

    fn write_observation(&self, out: &mut BatchMut<'_>, row: usize) {
        write_if_present(out.observation.row(row), |r| self.env.draw(r));
        write_if_present(out.vector_observation.row(row), |r| self.env.vector_observation(r));
        write_if_present(out.features.row(row), |r| self.env.features(r));
        write_if_present(out.ground_truth.row(row), |r| self.env.ground_truth(r));
    }

    fn write_final_observation(&self, out: &mut BatchMut<'_>, row: usize) {
        write_if_present(out.final_observation.row(row), |r| self.env.draw(r));
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

/// Environments in a row, whatever their family: one virtual call for a whole batch.
pub(super) trait Lanes: Send + Sync {
    /// Steps all environments in `slices` contiguous slices that may run at the same time.
    fn step(&mut self, slices: usize, autoreset: Autoreset, actions: &[i32], out: BatchMut<'_>);

    /// Resets environments as `request` says and writes every environment's row.
    fn reset(&mut self, slices: usize, request: ResetRequest<'_>, out: BatchMut<'_>);

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
    spec: &'static Spec,
    variant: E::Variant,
}

impl<E: Environment> FamilyLanes<E> {
    /// Environments with the given assets and seeds, none of them reset yet.
    pub(super) fn new(
        spec: &'static Spec,
        variant: E::Variant,
        environments: impl Iterator<Item = (Arc<E::Assets>, Arc<Options>, Seeds)>,
    ) -> Self {
        let lanes = environments
            .map(|(assets, options, seeds)| Lane {
                env: E::new(&assets),
                assets,
                random: Generator::from_entropy(),
                seeds,
                episode_return: 0.0,
                episode_length: 0,
                ended: false,
                options,
            })
            .collect();
        FamilyLanes { lanes, spec, variant }
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
    fn step(&mut self, slices: usize, autoreset: Autoreset, actions: &[i32], out: BatchMut<'_>) {
        let branches = self.spec.action_space.branches().len();
        in_slices(slices, 0, &mut self.lanes, out, &|first, lanes, mut out| {
            let actions = actions[first * branches..].chunks_exact(branches);
            for (row, (lane, action)) in lanes.iter_mut().zip(actions).enumerate() {
                lane.step(autoreset, action, &mut out, row);
            }
        });
    }

    fn reset(&mut self, slices: usize, request: ResetRequest<'_>, out: BatchMut<'_>) {
        in_slices(slices, 0, &mut self.lanes, out, &|first, lanes, mut out| {
            for (row, lane) in lanes.iter_mut().enumerate() {
                match request {
                    ResetRequest::All => lane.start_episode(None),
                    ResetRequest::Seed(seed) => lane.start_episode(Some(seed.wrapping_add((first + row) as u64))),
                    ResetRequest::Each { reset, seed } => match reset[first + row] {
                        0 => {}
                        1 => lane.start_episode(None),
                        _ => lane.start_episode(Some(seed[first + row])),
                    },
                }
                lane.write_start(&mut out, row);
            }
        });
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

/// Divides lanes and batch alike into contiguous slices and runs `work` on each, at the same time where threads are free.
/// `first` is the number of the first lane.
fn in_slices<L: Send>(
    slices: usize,
    first: usize,
    lanes: &mut [L],
    out: BatchMut<'_>,
    work: &(impl Fn(usize, &mut [L], BatchMut<'_>) + Sync),
) {
    if slices <= 1 {
        return work(first, lanes, out);
    }
    let left = slices / 2;
    let middle = lanes.len() * left / slices;
    let (left_lanes, right_lanes) = lanes.split_at_mut(middle);
    let (left_out, right_out) = out.split_at(middle);
    rayon::join(
        || in_slices(left, first, left_lanes, left_out, work),
        || in_slices(slices - left, first + middle, right_lanes, right_out, work),
    );
}
