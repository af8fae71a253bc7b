//! The environments that a program knows.

use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use serde_json::Map;
use thiserror::Error;

use super::config::PoolConfig;
use super::error::PoolError;
use super::seeding::PoolEntropy;
use super::typed_envs::{AnyEnvs, typed_envs};
use crate::envs::{EnvSpec, Environment, Expert, ObservationSpace, ParameterError, Task, TaskEnv, UnknownEnvironment};
use crate::raster::FrameShape;

/// Environment ids with their implementations. Pools, engines and commands look up ids in the registry that they are given.
///
/// Clones share the implementations.
#[derive(Clone, Default)]
pub struct Registry {
    entries: Vec<Arc<Entry>>,
    /// Ids with arguments, as they were given. They are never freed, since specifications are borrowed.
    made: Arc<Mutex<HashMap<String, &'static Arc<Entry>>>>,
}

impl Registry {
    /// A registry without environments.
    pub fn new() -> Self {
        Registry::default()
    }

    /// Adds an id that the family `E` implements with the given variant of its rules.
    ///
    /// # Errors
    ///
    /// [`RegistryError`] if the registry has the id already, or if the specification contradicts itself.
    pub fn register<E: Environment + 'static>(
        &mut self,
        spec: EnvSpec,
        variant: E::Variant,
    ) -> Result<(), RegistryError> {
        if self.specs().any(|known| known.id == spec.id) {
            return Err(RegistryError::Duplicate { id: spec.id });
        }
        self.entries.push(Arc::new(Entry::new(spec, Arc::new(Family::<E> { variant }))?));
        Ok(())
    }

    /// Adds the ids of a task and returns the registry.
    ///
    /// # Errors
    ///
    /// [`RegistryError`] if the registry has an id already, or if a specification contradicts itself.
    pub fn with<T: Task>(mut self) -> Result<Self, RegistryError> {
        for spec in T::specs() {
            self.register::<TaskEnv<T>>(spec, ())?;
        }
        Ok(self)
    }

    /// The specification of every id, in the order of registration.
    pub fn specs(&self) -> impl Iterator<Item = &EnvSpec> {
        self.entries.iter().map(|entry| &entry.spec)
    }

    /// The specification of an id, of which only [`bare_id`](Self::bare_id) counts. It may have arguments, as in `Maze-v0?size=9`; each
    /// new text of them takes a few kilobytes until the process ends.
    ///
    /// # Errors
    ///
    /// [`UnknownEnvironment`] if the registry does not have the id, or not with its arguments.
    pub fn spec(&self, id: &str) -> Result<&EnvSpec, UnknownEnvironment> {
        Ok(&self.entry(id)?.spec)
    }

    /// A scripted expert for an id.
    ///
    /// # Errors
    ///
    /// [`NoExpert`] if the registry does not have the id, or its family has no expert.
    pub fn expert(&self, id: &str) -> Result<Box<dyn Expert>, NoExpert> {
        let expert = self.entry(id).ok().and_then(|entry| entry.family.expert(&entry.spec));
        expert.ok_or_else(|| NoExpert { id: id.to_owned() })
    }

    /// The id without what Python allows before it: the module that has the environment, as in `t_maze:TMaze-v0`, and `EndlessGym/`.
    pub fn bare_id(id: &str) -> &str {
        let id = id.rsplit(':').next().unwrap_or(id);
        id.strip_prefix("EndlessGym/").unwrap_or(id)
    }

    pub(super) fn entry(&self, id: &str) -> Result<&Arc<Entry>, UnknownEnvironment> {
        let given = Registry::bare_id(id);
        let (id, arguments) = given.split_once('?').unwrap_or((given, ""));
        let error = |known, problem| UnknownEnvironment { id: given.to_owned(), known, problem };
        let known = || self.specs().map(|spec| spec.id).collect::<Vec<_>>().join(", ");
        let entry = self.entries.iter().find(|entry| entry.spec.id == id).ok_or_else(|| error(known(), None))?;
        if arguments.is_empty() {
            return Ok(entry);
        }
        let made = || self.made.lock().unwrap_or_else(PoisonError::into_inner);
        let known = made().get(given).copied();
        if let Some(entry) = known {
            return Ok(entry);
        }
        // Not locked, since a family's own code may look up ids.
        let new = entry.with_arguments(arguments).map_err(|problem| error(String::new(), Some(problem)))?;
        Ok(*made().entry(given.to_owned()).or_insert_with(|| Box::leak(Box::new(Arc::new(new)))))
    }
}

impl fmt::Debug for Registry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.specs().map(|spec| spec.id)).finish()
    }
}

/// An id and its implementation.
pub(super) struct Entry {
    pub spec: EnvSpec,
    family: Arc<dyn AnyFamily>,
}

impl Entry {
    fn new(spec: EnvSpec, family: Arc<dyn AnyFamily>) -> Result<Self, RegistryError> {
        let (id, features) = (spec.id, spec.features.len());
        if let Some(given) = spec.shown().filter(|frame| !frame.is_valid()) {
            return Err(RegistryError::Frame { id, given });
        }
        if spec.frame.is_none() && spec.features.is_empty() {
            return Err(RegistryError::NoObservation { id });
        }
        let width = spec.observation_space.as_ref().map(ObservationSpace::width);
        match width.filter(|width| *width != features) {
            Some(given) => Err(RegistryError::ObservationSpace { id, given, features }),
            None => Ok(Entry { spec, family }),
        }
    }

    /// The same environment with arguments, or what is wrong with them.
    fn with_arguments(&self, arguments: &str) -> Result<Entry, String> {
        let spec = self.spec.with_arguments(arguments).and_then(|spec| self.family.with_arguments(spec));
        let entry = Entry::new(spec.map_err(|error| error.to_string())?, Arc::clone(&self.family));
        entry.map_err(|error| error.to_string())
    }

    /// Makes the environments of a pool.
    pub fn envs(&self, config: &PoolConfig, entropy: PoolEntropy) -> Result<Box<dyn AnyEnvs>, PoolError> {
        self.family.envs(&self.spec, config, entropy)
    }
}

/// A family with the variant of one id.
trait AnyFamily: Send + Sync {
    fn envs(&self, spec: &EnvSpec, config: &PoolConfig, entropy: PoolEntropy) -> Result<Box<dyn AnyEnvs>, PoolError>;

    fn expert(&self, spec: &EnvSpec) -> Option<Box<dyn Expert>>;

    fn with_arguments(&self, spec: EnvSpec) -> Result<EnvSpec, ParameterError>;
}

struct Family<E: Environment> {
    variant: E::Variant,
}

impl<E: Environment + 'static> AnyFamily for Family<E> {
    fn envs(&self, spec: &EnvSpec, config: &PoolConfig, entropy: PoolEntropy) -> Result<Box<dyn AnyEnvs>, PoolError> {
        Ok(Box::new(typed_envs::<E>(spec, self.variant, config, entropy)?))
    }

    fn expert(&self, spec: &EnvSpec) -> Option<Box<dyn Expert>> {
        E::expert(self.variant, &spec.reset_parameters(&Map::new()).ok()?)
    }

    fn with_arguments(&self, spec: EnvSpec) -> Result<EnvSpec, ParameterError> {
        let parameters = spec.reset_parameters(&Map::new())?;
        E::with_arguments(spec, &parameters)
    }
}

/// The registry refuses an environment.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum RegistryError {
    /// Two environments have the same id.
    #[error("the registry already has an environment `{id}`")]
    Duplicate { id: &'static str },
    /// The size of the frame is out of range.
    #[error("frames must have a width and height of 1 to {max} and 1, 3 or 4 channels, got {given:?} for `{id}`", max = FrameShape::MAX_SIDE)]
    Frame { id: &'static str, given: FrameShape },
    /// The environment has neither a frame nor features.
    #[error("an environment must have a frame or features, and `{id}` has neither")]
    NoObservation { id: &'static str },
    /// The observation space does not fit the features.
    #[error("the observation space of `{id}` must have as many numbers as there are features, {features}, got {given}")]
    ObservationSpace { id: &'static str, given: usize, features: usize },
}

/// An id without a scripted expert.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("`{id}` has no scripted expert")]
pub struct NoExpert {
    /// The id.
    pub id: String,
}
