//! Configuration of an engine.

use std::path::PathBuf;
use std::time::Duration;

use endless_gym_core::pool::{MAX_ENVS, PoolConfig, PoolError, ResetOptions};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::error::ServiceError;
use crate::namespace::directory::{Namespace, check_name};
use crate::protocol::limits::{MAX_BATCHES_HELD, MAX_GROUPS, MAX_OBSERVERS};

/// Configuration of an engine: what it serves, and under which name. [`new`](Self::new) has the defaults, and a method for each
/// field changes one.
///
/// Its JSON form uses the field names. Only `pool` is required; the other fields default to those of [`new`](Self::new)
/// with the name `endless`. An unknown field is an error.
///
/// ```
/// use endless_gym_service::EngineConfig;
///
/// let config: EngineConfig = serde_json::from_str(
///     r#"{
///         "service": "gym",
///         "pool": {"id": "MortarMayhem-v0", "num_envs": 16},
///         "groups": 2,
///         "checkpoint": {"path": "/tmp/gym.checkpoint", "every_seconds": 60}
///     }"#,
/// )?;
/// assert_eq!((config.groups, config.batches_held, config.pool.num_envs), (2, 3, 16));
/// # Ok::<(), serde_json::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[non_exhaustive]
pub struct EngineConfig {
    /// The engine's name: 1 to 64 letters, digits, `.`, `_` or `-`.
    #[serde(default = "default_service")]
    pub service: String,
    /// The namespace in which trainers find the engine. In JSON, it is the path of its root directory.
    #[serde(default)]
    pub namespace: Namespace,
    /// The environments of one group. `first_env` is the number of the first group's first environment. `total_envs`
    /// counts the environments of all groups and engines; the default, `first_env + num_envs`, means that this is the
    /// only engine. [`ResetOptions::Each`] holds the reset parameters of all groups, one group after the other.
    pub pool: PoolConfig,
    /// Number of groups, 1 to [`MAX_GROUPS`]. A group is stepped when its actions arrive, so that a trainer can work on
    /// one group while the engine steps another.
    #[serde(default = "default_groups")]
    pub groups: usize,
    /// Number of threads that step the environments of all groups; 0 for one per core. As many groups as get all the threads that
    /// they can use (one for fewer than 64 environments) step at the same time.
    #[serde(default)]
    pub threads: usize,
    /// Whether each thread that steps environments, those that take requests included, is bound to a CPU of its own, in the order of
    /// the process's affinity mask. Linux only. More threads than CPUs are an error.
    #[serde(default)]
    pub pin_threads: bool,
    /// Batches of a group that a trainer or an observer may hold at a time, 1 to 16. The engine requires shared memory for two
    /// more.
    #[serde(default = "default_batches_held")]
    pub batches_held: usize,
    /// Observers of a group that may be connected at a time, 0 to 16. They use memory only while they are connected.
    #[serde(default = "default_observers")]
    pub observers: usize,
    /// The file to which the engine saves its environments, and from which it may resume; `None` for none.
    #[serde(default)]
    pub checkpoint: Option<CheckpointConfig>,
}

fn default_service() -> String {
    "endless".to_owned()
}

fn default_groups() -> usize {
    EngineConfig::GROUPS
}

fn default_batches_held() -> usize {
    EngineConfig::BATCHES_HELD
}

fn default_observers() -> usize {
    3
}

impl EngineConfig {
    /// Default of [`groups`](Self::groups).
    pub const GROUPS: usize = 1;
    /// Default of [`batches_held`](Self::batches_held).
    pub const BATCHES_HELD: usize = 3;

    /// One group in the default namespace, with `batches_held` and `observers` of 3, without a checkpoint.
    pub fn new(service: &str, pool: PoolConfig, threads: usize) -> Self {
        EngineConfig {
            service: service.to_owned(),
            namespace: Namespace::default(),
            pool,
            groups: default_groups(),
            threads,
            pin_threads: false,
            batches_held: default_batches_held(),
            observers: default_observers(),
            checkpoint: None,
        }
    }

    endless_gym_core::setters! {
        service: String,
        namespace: Namespace,
        pool: PoolConfig,
        groups: usize,
        threads: usize,
        pin_threads: bool,
        batches_held: usize,
        observers: usize,
        checkpoint: Option<CheckpointConfig>,
    }

    pub(crate) fn check(&self) -> Result<(), ServiceError> {
        check_name(&self.service)?;
        let ranges = [
            ("groups", self.groups, 1, MAX_GROUPS),
            ("batches_held", self.batches_held, 1, MAX_BATCHES_HELD),
            ("observers", self.observers, 0, MAX_OBSERVERS),
        ];
        for (name, given, lowest, highest) in ranges {
            if !(lowest..=highest).contains(&given) {
                return Err(ServiceError::OutOfRange { name, given, lowest, highest });
            }
        }
        Ok(())
    }

    /// The configurations of all groups' pools.
    pub(crate) fn pools(&self) -> Result<Vec<PoolConfig>, PoolError> {
        let num_envs = self.pool.num_envs;
        if !(1..=MAX_ENVS).contains(&num_envs) {
            return Err(PoolError::NumEnvs { given: num_envs });
        }
        let here = num_envs * self.groups;
        let first = self.pool.first_env;
        let is_alone = first.checked_add(num_envs) == Some(self.pool.total_envs);
        let total_envs = if is_alone { first.saturating_add(here) } else { self.pool.total_envs };
        (0..self.groups)
            .map(|group| {
                let first_here = group * num_envs;
                let options = match &self.pool.options {
                    ResetOptions::Shared(options) => ResetOptions::Shared(options.clone()),
                    ResetOptions::Each(each) if each.len() == here => {
                        ResetOptions::Each(each[first_here..first_here + num_envs].to_vec())
                    }
                    ResetOptions::Each(each) => {
                        return Err(PoolError::OptionsCount { given: each.len(), num_envs: here });
                    }
                };
                let first_env = first.saturating_add(first_here);
                Ok(self.pool.clone().options(options).first_env(first_env).total_envs(total_envs))
            })
            .collect()
    }
}

/// Where an engine saves its environments, and whether it resumes from there.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[non_exhaustive]
pub struct CheckpointConfig {
    /// The file. A new checkpoint is written to `FILE.new` and replaces it when it is complete and on disk. The engine
    /// holds a lock on `FILE.lock` for its lifetime, so that no other engine saves to the same file.
    pub path: PathBuf,
    /// How often the engine saves while it runs; `None` saves only when the engine stops and when a trainer requests
    /// it.
    #[serde(default, rename = "every_seconds", serialize_with = "write_seconds", deserialize_with = "read_seconds")]
    pub every: Option<Duration>,
    /// Whether the engine resumes from the file if it exists. If `false`, an existing file is an error, so that it is
    /// not overwritten by mistake.
    #[serde(default)]
    pub resume: bool,
}

#[allow(clippy::ref_option)] // The signature that serde requires.
fn write_seconds<S: Serializer>(every: &Option<Duration>, serializer: S) -> Result<S::Ok, S::Error> {
    every.map(|every| every.as_secs_f64()).serialize(serializer)
}

fn read_seconds<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Duration>, D::Error> {
    let seconds = Option::<f64>::deserialize(deserializer)?;
    seconds.map(|seconds| Duration::try_from_secs_f64(seconds).map_err(serde::de::Error::custom)).transpose()
}

impl CheckpointConfig {
    /// Saves to `path` when the engine stops and when a trainer requests it, and does not resume from it.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        CheckpointConfig { path: path.into(), every: None, resume: false }
    }

    endless_gym_core::setters!(every: Option<Duration>, resume: bool);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> EngineConfig {
        EngineConfig::new("gym", PoolConfig::new("MortarMayhem-Grid-v0", 2), 1)
    }

    #[test]
    fn too_many_observers_are_an_error() {
        let error = config().observers(17).check().unwrap_err();
        assert_eq!(error.to_string(), "observers must be 0 to 16, got 17");
    }

    #[test]
    fn json_has_the_fields_defaults_and_errors_of_the_type() {
        let checkpoint = CheckpointConfig::new("/tmp/c").every(Some(Duration::from_millis(1500)));
        let full = config().namespace(Namespace::at("/tmp/a")).checkpoint(Some(checkpoint));
        let text = serde_json::to_string(&full).unwrap();
        assert_eq!(serde_json::from_str::<EngineConfig>(&text).unwrap(), full, "{text}");
        let short = r#"{"service": "gym", "pool": {"id": "MortarMayhem-Grid-v0", "num_envs": 2}, "threads": 1}"#;
        assert_eq!(serde_json::from_str::<EngineConfig>(short).unwrap(), config());
        let error = serde_json::from_str::<EngineConfig>(&short.replace("threads", "thread")).unwrap_err().to_string();
        assert!(error.starts_with("unknown field `thread`"), "{error}");
    }

    #[test]
    fn too_many_environments_are_an_error() {
        let pool = PoolConfig::new("MortarMayhem-Grid-v0", usize::MAX);
        let pools = config().pool(pool).groups(2).pools();
        assert!(matches!(pools, Err(PoolError::NumEnvs { given: usize::MAX })));
    }

    #[test]
    fn environments_are_numbered_across_groups_and_engines() {
        let numbered = |first_env, total_envs| {
            let pool = config().pool.first_env(first_env).total_envs(total_envs);
            let pools = config().pool(pool).groups(2).pools().unwrap();
            pools.iter().map(|pool| (pool.first_env, pool.total_envs)).collect::<Vec<_>>()
        };
        assert_eq!(numbered(0, 2), [(0, 4), (2, 4)]);
        assert_eq!(numbered(4, 12), [(4, 12), (6, 12)]);
        assert_eq!(numbered(4, 6), [(4, 8), (6, 8)]);
        // A total that is too small, which the pools refuse.
        assert_eq!(numbered(4, 7), [(4, 7), (6, 7)]);
    }
}
