//! The small trait for custom environments.

use std::fmt::Debug;
use std::sync::Arc;

use serde::{Serialize, de::DeserializeOwned};

use super::environment::{Environment, InvalidState, Transition};
use super::expert::Expert;
use super::parameters::{ParameterError, ResetParameters};
use super::progress::Progress;
use super::spec::EnvSpec;
use crate::random::Generator;
use crate::raster::Canvas;

/// The rules and rendering of one id: all that an environment needs to run in a pool or an engine.
///
/// A value is the state of one environment, which a snapshot stores and [`paint`](Task::paint) draws. One value plays many
/// episodes: [`Default`] creates it, and [`reset`](Task::reset) comes before every other call. Draw all random numbers from the
/// given generator, so that seed, reset parameters and actions determine an episode.
///
/// Rules that several ids share list them in [`specs`](Task::specs). Implement [`Environment`] instead to keep pictures, or to
/// repaint only what changed.
///
/// ```
/// use endless_gym_core::batch::{Batch, zeroed};
/// use endless_gym_core::envs::{ActionSpace, Column, EnvSpec, ResetParameters, Task, Transition};
/// use endless_gym_core::pool::{Pool, PoolConfig, Registry, ResetRequest, Threads};
/// use endless_gym_core::random::Generator;
/// use serde::{Deserialize, Serialize};
///
/// /// Repeat the number that was shown first.
/// #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
/// struct Repeat {
///     number: i32,
///     step: usize,
/// }
///
/// impl Task for Repeat {
///     type Parameters = ();
///
///     fn spec() -> EnvSpec {
///         const FEATURES: &[Column] = &[Column { name: "number", description: "the number, in the first step" }];
///         EnvSpec { features: FEATURES, ..EnvSpec::new("Repeat-v0", "Repeat the first number", ActionSpace::Discrete(4)) }
///     }
///
///     fn parameters(_: &ResetParameters) {}
///
///     fn reset(&mut self, _: &(), random: &mut Generator) {
///         *self = Repeat { number: random.integers(0, 4) as i32, step: 0 };
///     }
///
///     fn step(&mut self, _: &(), action: &[i32], _: &mut Generator) -> Transition {
///         self.step += 1;
///         let reward = if action[0] == self.number { 1.0 } else { 0.0 };
///         Transition { reward, truncated: self.step == 10, ..Transition::default() }
///     }
///
///     fn features(&self, _: &(), out: &mut [f32]) {
///         out[0] = if self.step == 0 { self.number as f32 } else { 0.0 };
///     }
///
///     fn is_valid(&self, _: &()) -> bool {
///         (0..4).contains(&self.number)
///     }
/// }
///
/// let registry = Registry::new().with::<Repeat>()?;
/// let mut pool = Pool::new(&registry, &PoolConfig::new("Repeat-v0", 8), &Threads::new(1)?)?;
/// let mut blocks = zeroed(pool.layout().blocks());
/// pool.reset(ResetRequest::Seed(1), &mut blocks)?;
/// let numbers: Vec<i32> = Batch::new(pool.layout(), &blocks).features().iter().map(|number| *number as i32).collect();
/// for _ in 0..10 {
///     pool.step(&numbers, &mut blocks)?;
/// }
/// let batch = Batch::new(pool.layout(), &blocks);
/// assert_eq!((batch.episode_return(), batch.truncated()), ([10.0; 8].as_slice(), [1; 8].as_slice()));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub trait Task: Clone + Debug + Default + PartialEq + Serialize + DeserializeOwned + Send + Sync + 'static {
    /// Reset parameters as typed values, shared by the environments that were given the same ones.
    type Parameters: Send + Sync;

    /// Id, spaces, reset parameters, features and infos.
    fn spec() -> EnvSpec;

    /// The specification of every id that these rules play; by default, only [`spec`](Task::spec).
    fn specs() -> Vec<EnvSpec> {
        vec![Self::spec()]
    }

    /// Completes the specification of an id with arguments, such as `Maze-v0?size=9`, which has the spaces of that without: spaces and
    /// columns that follow from the arguments. `parameters` are those of an episode without reset parameters.
    ///
    /// # Errors
    ///
    /// [`ParameterError::Argument`] if the arguments do not go together.
    fn with_arguments(spec: EnvSpec, _parameters: &Self::Parameters) -> Result<EnvSpec, ParameterError> {
        Ok(spec)
    }

    /// The typed reset parameters. `given` is complete with the [`arguments`](EnvSpec::arguments) of the id, every value is within its
    /// limits, and its [`id`](ResetParameters::id) up to a `?` says which of several ids is played.
    fn parameters(given: &ResetParameters) -> Self::Parameters;

    /// Seeds the generators that the rules keep themselves, before the reset of an episode that has a seed. Rules that only draw
    /// from the given generator need none.
    fn seed(&mut self, _seed: u64) {}

    /// Starts an episode.
    fn reset(&mut self, parameters: &Self::Parameters, random: &mut Generator);

    /// Plays one step. `action` has one number for each branch of the action space, each within its range.
    fn step(&mut self, parameters: &Self::Parameters, action: &[i32], random: &mut Generator) -> Transition;

    /// Writes the feature observation, float32 in the order of [`EnvSpec::features`].
    fn features(&self, _parameters: &Self::Parameters, _out: &mut [f32]) {}

    /// Draws the frame, or the picture of an environment without frames, on a black canvas.
    fn paint(&self, _parameters: &Self::Parameters, _canvas: &mut Canvas<'_>) {}

    /// Writes the pixels of a frame with 1 or 4 channels, instead of [`paint`](Task::paint). The byte of channel `c` of the pixel `(x, y)`
    /// is `(x * height + y) * channels + c`. All bytes are 0 before.
    fn write_pixels(&self, _parameters: &Self::Parameters, _pixels: &mut [u8]) {}

    /// Writes the ground truth, float64 in the order of [`EnvSpec::ground_truth`].
    fn ground_truth(&self, _parameters: &Self::Parameters, _out: &mut [f64]) {}

    /// Writes the Markov state, float32 in the order of [`EnvSpec::markov_state`].
    fn markov_state(&self, _parameters: &Self::Parameters, _out: &mut [f32]) {}

    /// Writes the final info, float64 in the order of [`EnvSpec::info`]. Valid after the step that ended the episode.
    fn info(&self, _parameters: &Self::Parameters, _out: &mut [f64]) {}

    /// Progress of the episode, for a human viewer.
    fn progress(&self) -> Vec<Progress> {
        Vec::new()
    }

    /// A scripted expert for an id, if there is one, from the parameters of an episode without reset parameters.
    fn expert(_parameters: &Self::Parameters) -> Option<Box<dyn Expert>> {
        None
    }

    /// Whether an environment with these parameters can be in this state, in an episode or after its end. A snapshot may be forged,
    /// so each number may be anything that its type can be; a state that is accepted is played. Check ranges, lengths, and what
    /// fields have in common.
    fn is_valid(&self, parameters: &Self::Parameters) -> bool;
}

/// A [`Task`] as an [`Environment`]: its scene is its state, and a frame is painted in full whenever the state has changed.
#[derive(Clone, Debug)]
pub struct TaskEnv<T: Task> {
    parameters: Arc<T::Parameters>,
    task: T,
}

impl<T: Task> Environment for TaskEnv<T> {
    type Variant = ();
    type Assets = T::Parameters;
    type State = T;
    type Scene = T;

    fn assets((): (), parameters: &ResetParameters) -> T::Parameters {
        T::parameters(parameters)
    }

    fn new(assets: &Arc<T::Parameters>) -> Self {
        TaskEnv { parameters: Arc::clone(assets), task: T::default() }
    }

    fn seed(&mut self, seed: u64) {
        self.task.seed(seed);
    }

    fn reset(&mut self, assets: &Arc<T::Parameters>, random: &mut Generator) {
        self.parameters = Arc::clone(assets);
        self.task.reset(assets, random);
    }

    fn step(&mut self, action: &[i32], random: &mut Generator) -> Transition {
        self.task.step(&self.parameters, action, random)
    }

    fn shared(&self) -> &Arc<T::Parameters> {
        &self.parameters
    }

    fn scene(&self) -> T {
        self.task.clone()
    }

    fn paint(assets: &T::Parameters, scene: &T, canvas: &mut Canvas<'_>) {
        canvas.fill([0; 3]);
        scene.paint(assets, canvas);
    }

    fn repaint(assets: &T::Parameters, _shown: &T, scene: &T, canvas: &mut Canvas<'_>) {
        Self::paint(assets, scene, canvas);
    }

    fn write_pixels(assets: &T::Parameters, scene: &T, pixels: &mut [u8]) {
        scene.write_pixels(assets, pixels);
    }

    fn draw_ground_truth(&mut self, canvas: &mut Canvas<'_>) {
        Self::paint(&self.parameters, &self.task, canvas);
    }

    fn features(&self, out: &mut [f32]) {
        self.task.features(&self.parameters, out);
    }

    fn ground_truth(&self, out: &mut [f64]) {
        self.task.ground_truth(&self.parameters, out);
    }

    fn markov_state(&self, out: &mut [f32]) {
        self.task.markov_state(&self.parameters, out);
    }

    fn state(&self) -> &T {
        &self.task
    }

    fn restore(&mut self, assets: &Arc<T::Parameters>, state: T) -> Result<(), InvalidState> {
        if !state.is_valid(assets) {
            return Err(InvalidState);
        }
        *self = TaskEnv { parameters: Arc::clone(assets), task: state };
        Ok(())
    }

    fn progress(&self) -> Vec<Progress> {
        self.task.progress()
    }

    fn info(&self, out: &mut [f64]) {
        self.task.info(&self.parameters, out);
    }

    fn expert((): (), parameters: &ResetParameters) -> Option<Box<dyn Expert>> {
        T::expert(&T::parameters(parameters))
    }

    fn with_arguments(spec: EnvSpec, parameters: &ResetParameters) -> Result<EnvSpec, ParameterError> {
        T::with_arguments(spec, &T::parameters(parameters))
    }
}
