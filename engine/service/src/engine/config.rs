//! Configuration of an engine.

use std::path::PathBuf;
use std::time::Duration;

use endless_gym_core::pool::{MAX_ENVS, PoolConfig, PoolError, ResetOptions, Threads};

use crate::error::ServiceError;
use crate::namespace::directory::{Namespace, check_name};

/// Maximum number of groups of an engine.
pub const MAX_GROUPS: usize = 64;

/// Maximum number of batches of a group that a trainer or an observer may hold.
pub const MAX_BATCHES_HELD: usize = 16;

/// Maximum number of observers of a group.
pub(crate) const MAX_OBSERVERS: usize = 16;

/// Configuration of an engine: what it serves, and under which name.
#[derive(Clone, Debug)]
pub struct EngineConfig {
    /// The engine's name: 1 to 64 letters, digits, `.`, `_` or `-`.
    pub service: String,
    /// The namespace in which trainers find the engine.
    pub namespace: Namespace,
    /// The environments of one group. `first_env` is the number of the first group's first environment. `total_envs` counts the
    /// environments of all groups and engines; `first_env + num_envs`, the default, stands for those of this engine alone.
    /// [`ResetOptions::Each`] holds the reset parameters of all groups, one group after the other.
    pub pool: PoolConfig,
    /// Number of groups, 1 to [`MAX_GROUPS`]. Each is stepped when its actions arrive, so that a trainer can work on one group
    /// while the engine steps another.
    pub groups: usize,
    /// The threads that step the environments of all groups.
    pub threads: Threads,
    /// Batches of a group that a trainer or an observer may hold at a time, 1 to 16. The engine requires shared memory for two
    /// more.
    pub batches_held: usize,
    /// Observers of a group that may be connected at a time, 0 to 16. They use memory only while they are connected.
    pub observers: usize,
    /// The file to which the engine saves its environments, and from which it may continue; `None` for none.
    pub checkpoint: Option<CheckpointConfig>,
}

impl EngineConfig {
    /// One group in the default namespace, with `batches_held` and `observers` of 3, without a checkpoint.
    pub fn new(service: &str, pool: PoolConfig, threads: Threads) -> Self {
        EngineConfig {
            service: service.to_owned(),
            namespace: Namespace::default(),
            pool,
            groups: 1,
            threads,
            batches_held: 3,
            observers: 3,
            checkpoint: None,
        }
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
                Ok(PoolConfig { options, first_env, total_envs, ..self.pool.clone() })
            })
            .collect()
    }
}

/// Where an engine saves its environments, and whether it continues from there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckpointConfig {
    /// The file. A new checkpoint is written beside it, as `FILE.new`, and replaces it when it is complete and on the disk. As long as
    /// the engine exists, it holds a lock on `FILE.lock`, so that no other engine saves to the same file.
    pub path: PathBuf,
    /// How often the engine saves while it runs; `None` saves only when the engine stops and when a trainer asks for it.
    pub every: Option<Duration>,
    /// Whether the engine continues from the file if it exists. Otherwise a file that exists is an error, so that it is not
    /// overwritten by mistake.
    pub resume: bool,
}

impl CheckpointConfig {
    /// Saves to `path` when the engine stops and when a trainer asks for it, and does not continue from there.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        CheckpointConfig { path: path.into(), every: None, resume: false }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> EngineConfig {
        EngineConfig::new("gym", PoolConfig::new("MortarMayhem-Grid-v0", 2), Threads::new(1).unwrap())
    }

    #[test]
    fn numbers_out_of_range_are_errors() {
        let message = |config: EngineConfig| config.check().unwrap_err().to_string();
        assert_eq!(message(EngineConfig { batches_held: 20, ..config() }), "batches_held must be 1 to 16, got 20");
        assert_eq!(message(EngineConfig { groups: 0, ..config() }), "groups must be 1 to 64, got 0");
        assert_eq!(message(EngineConfig { observers: 17, ..config() }), "observers must be 0 to 16, got 17");
    }

    #[test]
    fn too_many_environments_are_an_error() {
        let pool = PoolConfig::new("MortarMayhem-Grid-v0", usize::MAX);
        let pools = EngineConfig { pool, groups: 2, ..config() }.pools();
        assert!(matches!(pools, Err(PoolError::NumEnvs { given: usize::MAX })));
    }

    #[test]
    fn environments_are_counted_over_the_groups() {
        let pools = EngineConfig { groups: 3, ..config() }.pools().unwrap();
        let numbers: Vec<_> = pools.iter().map(|pool| (pool.first_env, pool.num_envs, pool.total_envs)).collect();
        assert_eq!(numbers, [(0, 2, 6), (2, 2, 6), (4, 2, 6)]);
    }

    #[test]
    fn environments_are_counted_over_several_engines() {
        let numbered = |first_env, total_envs| {
            let pool = PoolConfig { first_env, total_envs, ..config().pool };
            let pools = EngineConfig { pool, groups: 2, ..config() }.pools().unwrap();
            pools.iter().map(|pool| (pool.first_env, pool.total_envs)).collect::<Vec<_>>()
        };
        assert_eq!(numbered(4, 12), [(4, 12), (6, 12)]);
        assert_eq!(numbered(4, 6), [(4, 8), (6, 8)]);
        // Too few in all, which the pools refuse.
        assert_eq!(numbered(4, 7), [(4, 7), (6, 7)]);
    }
}
