//! The environments, in groups: `send` a group's actions, and `receive` the result later. They step in this process, or in an engine
//! process that steps one group while the agent computes the actions of another.

use std::time::Duration;

use endless_gym_core::batch::{Batch, BatchBuffer};
use endless_gym_core::envs::{EnvSpec, ObservationSpace};
use endless_gym_core::pool::{
    Autoreset, EnvReset, Pool, PoolConfig, PoolError, Registry, ResetOptions, ResetRequest, Seeding, Threads,
};
use endless_gym_service::{BatchLease, Trainer};

use crate::error::Error;
use crate::served;
use crate::settings::{self, MAX_WIDTH, ONE_HOT, Settings, VECTORS};

/// Seeds of the training episodes, as in the paper. Evaluation uses others, so its levels are never seen in training.
const TRAINING_SEEDS: u64 = 100_000;

/// Longest time that an engine may take for an answer.
const TIMEOUT: Duration = Duration::from_secs(30);

/// Groups of environments.
pub struct Environments {
    /// The specification of the environments.
    pub spec: EnvSpec,
    /// Number of groups.
    pub groups: usize,
    /// Environments in each group.
    pub per_group: usize,
    /// `--environment.wrapper`, with its default.
    pub wrapper: Vec<String>,
    place: Stepping,
}

enum Stepping {
    InProcess(Vec<(Pool, BatchBuffer)>),
    Served { trainer: Box<Trainer>, latest: Vec<Option<BatchLease>> },
}

/// The configuration of the first group's pool, which is also that of an engine with these environments. Fails with
/// [`Error::Unsupported`], or an unknown id or reset parameter.
pub fn pool_config(registry: &Registry, settings: &Settings) -> Result<PoolConfig, Error> {
    let spec = registry.spec(&settings.env).map_err(PoolError::from)?;
    check(spec)?;
    let wanted = &settings.environment;
    let num_envs = wanted.num_envs / wanted.groups;
    let seeding = Seeding::Range { start: 0, end: TRAINING_SEEDS, step: 1, seed: Some(settings.seed) };
    let config = PoolConfig::new(spec.id, num_envs)
        .options(ResetOptions::Shared(settings.options()?))
        .autoreset(Autoreset::SameStep)
        .seeding(seeding)
        .frames(None)
        .features(true);
    config.validate(spec)?;
    Ok(config)
}

/// Checks that the agents support these environments.
fn check(spec: &EnvSpec) -> Result<(), Error> {
    let unsupported = |what| Err(Error::Unsupported { id: spec.id.to_owned(), what });
    if spec.action_space.branches().is_empty() {
        return unsupported("its actions are real numbers; the agents choose among discrete actions");
    }
    if spec.features.is_empty() && spec.vector_observation == 0 {
        return unsupported("it has no features; use `endless-train` for frames");
    }
    if observation_width(spec) > MAX_WIDTH as usize {
        return unsupported("its observations have more than 16,384 numbers, with one for each value of an integer");
    }
    Ok(())
}

impl Environments {
    /// Environments in this process, stepped by its threads.
    pub fn in_process(registry: &Registry, settings: &Settings) -> Result<Self, Error> {
        let (config, wanted) = (pool_config(registry, settings)?, &settings.environment);
        let threads = Threads::new(wanted.num_threads)?;
        let pool = |group| {
            let first_env = group * config.num_envs;
            let config = config.clone().first_env(first_env).total_envs(wanted.num_envs);
            let pool = Pool::new(registry, &config, &threads)?;
            let buffer = BatchBuffer::new(pool.layout().blocks());
            Ok((pool, buffer))
        };
        let pools = (0..wanted.groups).map(pool).collect::<Result<Vec<_>, Error>>()?;
        let spec = registry.spec(&settings.env).map_err(PoolError::from)?.clone();
        Self::new(spec, settings, Stepping::InProcess(pools))
    }

    /// The environments of an engine, as many as the settings say. The engine describes them, so the program need not
    /// have them. Fails with [`Error::Settings`] if it serves others, and [`Error::Unsupported`].
    pub fn served(settings: &Settings, trainer: Trainer) -> Result<Self, Error> {
        let (served, wanted) = (trainer.specification(), &settings.environment);
        let spec = served::spec(served)?;
        check(&spec)?;
        let (id, num_envs) = (Registry::bare_id(&settings.env), wanted.num_envs / wanted.groups);
        let expected = (id, num_envs, wanted.groups, Autoreset::SameStep, spec.features.len());
        let given = (&*served.id, served.num_envs, served.groups, served.autoreset, served.features.len());
        if given != expected {
            let text = |(id, num_envs, groups, autoreset, features): (&str, usize, usize, Autoreset, usize)| {
                format!(
                    "{groups} groups of {num_envs} environments {id} with autoreset {autoreset} and {features} features"
                )
            };
            return Err(Error::Settings(format!("the engine must serve {}, got {}", text(expected), text(given))));
        }
        let latest = (0..served.groups).map(|_| None).collect();
        Self::new(spec, settings, Stepping::Served { trainer: Box::new(trainer), latest })
    }

    fn new(spec: EnvSpec, settings: &Settings, place: Stepping) -> Result<Self, Error> {
        let wanted = &settings.environment;
        let is_integers =
            spec.observation_space.as_ref().is_some_and(|space| !matches!(space, ObservationSpace::Box { .. }));
        let wrapper = match &wanted.wrapper[..] {
            [] if is_integers => vec![VECTORS.to_owned()],
            given @ ([] | [_]) if spec.vector_observation == 0 || given.is_empty() => given.to_vec(),
            given => {
                let rule =
                    format!("--environment.wrapper must be {VECTORS} or {ONE_HOT}, once, and not for {}", spec.id);
                return Err(Error::Settings(format!("{rule}, got {}", given.join(" "))));
            }
        };
        Ok(Environments { spec, groups: wanted.groups, per_group: wanted.num_envs / wanted.groups, wrapper, place })
    }

    /// Number of choices of each branch of the action.
    pub fn choices(&self) -> Vec<usize> {
        self.spec.action_space.branches().iter().map(|choices| *choices as usize).collect()
    }

    /// Starts an episode in every environment of a group; [`receive`](Self::receive) returns the first observations.
    pub fn reset(&mut self, group: usize) -> Result<(), Error> {
        match &mut self.place {
            Stepping::InProcess(pools) => {
                let (pool, buffer) = &mut pools[group];
                pool.reset(ResetRequest::All, buffer)?;
            }
            Stepping::Served { trainer, latest } => {
                latest[group] = None;
                trainer.reset(group, ResetRequest::All)?;
            }
        }
        Ok(())
    }

    /// Starts a step of a group, whose last result is then gone. In this process it is also done.
    pub fn send(&mut self, group: usize, actions: &[i32]) -> Result<(), Error> {
        match &mut self.place {
            Stepping::InProcess(pools) => {
                let (pool, buffer) = &mut pools[group];
                pool.step(actions, buffer)?;
            }
            Stepping::Served { trainer, latest } => {
                latest[group] = None;
                trainer.send(group, actions)?;
            }
        }
        Ok(())
    }

    /// Waits for the answer to the last request to a group.
    pub fn receive(&mut self, group: usize) -> Result<(), Error> {
        if let Stepping::Served { trainer, latest } = &mut self.place {
            latest[group] = Some(trainer.receive(group, TIMEOUT)?);
        }
        Ok(())
    }

    /// The last result of a group that [`receive`](Self::receive) has received; `None` before.
    pub fn batch(&self, group: usize) -> Option<Batch<'_>> {
        match &self.place {
            Stepping::InProcess(pools) => Some(Batch::new(pools[group].0.layout(), &pools[group].1)),
            Stepping::Served { latest, .. } => latest[group].as_ref().map(BatchLease::batch),
        }
    }

    /// Snapshots of all environments of all groups.
    pub fn snapshots(&mut self) -> Result<Vec<Vec<u8>>, Error> {
        let per_group = self.per_group;
        let all = (0..self.groups).flat_map(|group| (0..per_group).map(move |env| (group, env)));
        match &mut self.place {
            Stepping::InProcess(pools) => all.map(|(group, env)| Ok(pools[group].0.snapshot(env)?)).collect(),
            Stepping::Served { trainer, .. } => {
                all.map(|(group, env)| Ok(trainer.snapshot(group, env, TIMEOUT)?)).collect()
            }
        }
    }

    /// Continues from snapshots, after [`reset`](Self::reset) of each group; [`receive`](Self::receive) then returns the current
    /// observations.
    pub fn restore(&mut self, snapshots: &[Vec<u8>]) -> Result<(), Error> {
        let none = vec![EnvReset::Keep; self.per_group];
        for (group, snapshots) in snapshots.chunks(self.per_group).enumerate() {
            match &mut self.place {
                Stepping::InProcess(pools) => {
                    let (pool, buffer) = &mut pools[group];
                    for (env, snapshot) in snapshots.iter().enumerate() {
                        pool.restore(env, snapshot)?;
                    }
                    pool.observe(buffer)?;
                }
                Stepping::Served { trainer, latest } => {
                    latest[group] = None;
                    for (env, snapshot) in snapshots.iter().enumerate() {
                        trainer.restore(group, env, snapshot, TIMEOUT)?;
                    }
                    trainer.reset(group, ResetRequest::Each(&none))?;
                }
            }
        }
        Ok(())
    }

    /// Whether observations include the previous action.
    pub fn has_previous_action(&self) -> bool {
        settings::has_previous_action(&self.wrapper)
    }

    /// Width of the observations that [`observe`](Self::observe) writes.
    pub fn observation_width(&self) -> usize {
        let added = if self.has_previous_action() { self.choices().iter().sum::<usize>() + 2 } else { 0 };
        observation_width(&self.spec) + added
    }

    /// Writes the last observations of a group, float32 (n, width): the features, then the vector observation or, as POPGym's agents
    /// observe them, the previous action and whether the step is the first of its episode. Integers of discrete spaces are one-hot,
    /// since their numbers have no order in general.
    ///
    /// # Arguments
    ///
    /// - `group`: the group
    /// - `starts`: whether each observation is the first of an episode, (n,)
    /// - `actions`: the actions before them, (n, branches); empty without the previous action
    pub fn observe(&self, group: usize, starts: &[bool], actions: &[i32], observations: &mut [f32]) {
        let Some(batch) = self.batch(group) else { return };
        let (features, vectors) = (self.spec.features.len(), self.spec.vector_observation);
        let branches = self.spec.action_space.branches();
        for (env, row) in observations.chunks_exact_mut(self.observation_width()).enumerate() {
            let given = batch.features().get(env * features..(env + 1) * features).unwrap_or_default();
            let (row, vector) = row.split_at_mut(row.len() - vectors);
            let rest = match &self.spec.observation_space {
                Some(space) => encode(space, given, row).1,
                None => {
                    let (row, rest) = row.split_at_mut(features);
                    row.copy_from_slice(given);
                    rest
                }
            };
            if self.has_previous_action() {
                let is_first = starts[env];
                let before = actions[env * branches.len()..].iter().map(|action| if is_first { 0 } else { *action });
                let added = before.zip(branches.iter().copied()).chain([(i32::from(is_first), 2)]);
                added.fold(rest, |rest, (number, choices)| one_hot(number as f32, choices, rest));
            }
            vector.copy_from_slice(
                batch.vector_observation().get(env * vectors..(env + 1) * vectors).unwrap_or_default(),
            );
        }
    }
}

fn observation_width(spec: &EnvSpec) -> usize {
    spec.observation_space.as_ref().map_or(spec.features.len(), encoded_width) + spec.vector_observation
}

/// Numbers that encode an observation of a space.
fn encoded_width(space: &ObservationSpace) -> usize {
    match space {
        ObservationSpace::Discrete(n) => *n as usize,
        ObservationSpace::MultiDiscrete(numbers) => numbers.iter().map(|n| *n as usize).sum(),
        ObservationSpace::Box { low, .. } => low.len(),
        ObservationSpace::Tuple(parts) => parts.iter().map(encoded_width).sum(),
    }
}

/// Writes an integer as a one-hot vector, and returns the rest.
fn one_hot(number: f32, choices: i32, to: &mut [f32]) -> &mut [f32] {
    let (row, rest) = to.split_at_mut(choices as usize);
    row.fill(0.0);
    if let Some(entry) = row.get_mut(number as usize) {
        *entry = 1.0;
    }
    rest
}

/// Writes the encoding of features, and returns the rest of both.
fn encode<'a, 'b>(space: &ObservationSpace, features: &'a [f32], to: &'b mut [f32]) -> (&'a [f32], &'b mut [f32]) {
    match space {
        ObservationSpace::Discrete(n) => (&features[1..], one_hot(features[0], *n, to)),
        ObservationSpace::MultiDiscrete(numbers) => {
            let to = numbers.iter().zip(features).fold(to, |to, (n, number)| one_hot(*number, *n, to));
            (&features[numbers.len()..], to)
        }
        ObservationSpace::Box { low, .. } => {
            let (given, features) = features.split_at(low.len());
            let (row, to) = to.split_at_mut(low.len());
            row.copy_from_slice(given);
            (features, to)
        }
        ObservationSpace::Tuple(parts) => {
            parts.iter().fold((features, to), |(features, to), part| encode(part, features, to))
        }
    }
}
