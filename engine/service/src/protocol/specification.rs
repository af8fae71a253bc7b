//! The specification of an engine, which trainers and observers read before they connect.

use endless_gym_core::batch::{ActionLayout, BatchSection, Frames, Layout, Section, action_layout};
use endless_gym_core::envs::ActionSpace;
use endless_gym_core::pool::{Autoreset, MAX_ENVS};
use endless_gym_core::raster::FrameShape;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value as Json};

use crate::protocol::limits::{MAX_BATCHES_HELD, MAX_GROUPS, MAX_OBSERVERS};

/// Describes an engine and its environments. The engine publishes it as JSON under its name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ServiceSpecification {
    /// The engine's name.
    pub service: String,
    /// The engine's [`LAYOUT_VERSION`](endless_gym_core::batch::LAYOUT_VERSION).
    pub layout_version: u32,
    /// Version of the engine's package.
    pub engine_version: String,
    /// Process id of the engine.
    pub engine_pid: u32,
    /// Random number that identifies this run of the engine.
    pub incarnation: u64,
    /// Environment id.
    pub id: String,
    /// The id's [`EnvSpec`](endless_gym_core::envs::EnvSpec): spaces, columns with their meanings, and reset parameters
    /// with their limits. With it, a client can use environments that its build does not include.
    pub environment: Json,
    /// Number of groups, which are stepped independently of each other.
    pub groups: usize,
    /// Environments in each group.
    pub num_envs: usize,
    /// Number of the first group's first environment among those of all engines, for seeds.
    #[serde(default)]
    pub first_env: usize,
    /// Layout of a group's batch.
    pub batch: Layout,
    /// Layout of a request to step or reset a group.
    pub action: ActionLayout,
    /// Format of the frames in a batch; `None` if batches have no frames.
    pub frames: Option<Frames>,
    /// Size of a frame; `None` if batches have no frames.
    #[serde(default)]
    pub frame: Option<FrameShape>,
    /// The action space of one environment.
    pub action_space: ActionSpace,
    /// Names of the columns of the batch's section `info`.
    pub info: Vec<String>,
    /// Names of the columns of the batch's section `features`.
    pub features: Vec<String>,
    /// The reset parameters that were given: one map for all environments, or one for each environment of all groups.
    pub options: Vec<Map<String, Json>>,
    /// [`PoolConfig::independent_episodes`](endless_gym_core::pool::PoolConfig::independent_episodes).
    #[serde(default)]
    pub independent_episodes: bool,
    /// When a new episode starts after one has ended.
    pub autoreset: Autoreset,
    /// Nominal rendering rate in frames per second (`metadata["render_fps"]`).
    pub render_fps: u32,
    /// Batches of a group that a trainer or an observer may hold at a time.
    pub batches_held: usize,
    /// Observers of a group that may be connected at a time.
    pub observers: usize,
}

impl ServiceSpecification {
    /// Size of what people see of an environment: its frame, or the picture of one without frames. As [`EnvSpec::shown`].
    ///
    /// [`EnvSpec::shown`]: endless_gym_core::envs::EnvSpec::shown
    pub fn shown(&self) -> Option<FrameShape> {
        ["frame", "picture"].into_iter().find_map(|name| FrameShape::deserialize(&self.environment[name]).ok())
    }

    /// Chunks of shared memory that a group uses without observers: those that the trainer holds, one in its queue and one
    /// being written.
    pub(crate) fn trainer_chunks(&self) -> usize {
        self.batches_held + 2
    }

    /// Chunks that one observer uses: those that it holds, and one in its queue.
    pub(crate) fn observer_chunks(&self) -> usize {
        self.batches_held + 1
    }

    /// Checks the fields on which a trainer of the engine `service` relies. Returns the reason if one is invalid.
    pub(crate) fn check(&self, service: &str) -> Result<(), String> {
        if self.service != service {
            return Err(format!("service must be `{service}`, got `{}`", self.service));
        }
        let ranges = [
            ("groups", self.groups, 1, MAX_GROUPS),
            ("num_envs", self.num_envs, 1, MAX_ENVS),
            ("batches_held", self.batches_held, 1, MAX_BATCHES_HELD),
            ("observers", self.observers, 0, MAX_OBSERVERS),
        ];
        for (name, given, lowest, highest) in ranges {
            if !(lowest..=highest).contains(&given) {
                return Err(format!("{name} must be {lowest} to {highest}, got {given}"));
            }
        }
        let action = action_layout(&self.action_space, self.num_envs).map_err(|e| e.to_string())?;
        if self.action != action {
            return Err(format!("action must be the layout of actions in {}", self.action_space));
        }
        if self.batch.num_envs() != self.num_envs {
            return Err(format!("batch must have {} environments, got {}", self.num_envs, self.batch.num_envs()));
        }
        let shape = self.frames.zip(self.frame).map(|(frames, frame)| frames.shape(frame));
        let section = self.batch.section(BatchSection::Observation).map(Section::shape);
        if shape.as_deref() != section {
            return Err(format!("frames and frame must give the shape of an observation, {section:?}, got {shape:?}"));
        }
        let columns = [("info", &self.info, BatchSection::Info), ("features", &self.features, BatchSection::Features)];
        for (name, columns, section) in columns {
            let (given, width) = (columns.len(), self.batch.section(section).map_or(0, Section::width));
            if given != width {
                return Err(format!("{name} must name {width} columns, those of the batch's section, got {given}"));
            }
        }
        Ok(())
    }

    /// The first property whose difference in `other` keeps a trainer of this engine from continuing with that one.
    pub(crate) fn difference(&self, other: &ServiceSpecification) -> Option<&'static str> {
        let same = [
            ("environment", self.id == other.id),
            ("number of groups", self.groups == other.groups),
            ("number of environments", self.num_envs == other.num_envs),
            ("number of the first environment", self.first_env == other.first_env),
            ("batch layout", self.batch == other.batch && self.action == other.action && self.frames == other.frames),
            ("action space", self.action_space == other.action_space),
            ("set of columns", self.info == other.info && self.features == other.features),
            ("set of options", self.options == other.options),
            ("independence of episodes", self.independent_episodes == other.independent_episodes),
            ("auto-reset mode", self.autoreset == other.autoreset),
        ];
        same.into_iter().find(|(_, same)| !same).map(|(what, _)| what)
    }
}
