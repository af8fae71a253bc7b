//! The specification of an environment id: spaces, reset parameters, info columns.

use std::collections::HashSet;
use std::fmt;

use serde::Serialize;
use serde_json::{Map, Value as Json};
use thiserror::Error;

use super::action_space::ActionSpace;
use super::parameters::{Parameter, ParameterError, ResetParameters};
use crate::raster::FrameShape;

/// One branch of an action.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct ActionBranch {
    /// Name, unique within the environment.
    pub name: &'static str,
    /// The meaning of each number, from 0 on.
    pub choices: &'static [Choice],
}

/// A value of a branch of an action.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Choice {
    /// Name, unique within the branch.
    pub name: &'static str,
    /// What the agent does.
    pub description: &'static str,
}

/// A column of the feature observation (float32) or of the ground truth (float64).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Column {
    /// Name, unique within the environment.
    pub name: &'static str,
    /// Meaning and unit.
    pub description: &'static str,
}

/// A column of the final info (float64).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct InfoColumn {
    /// Key in the final info.
    pub name: &'static str,
    /// Whether the value is a Python int in the final info; otherwise it is a float.
    pub is_integer: bool,
    /// Meaning and unit.
    pub description: &'static str,
}

impl InfoColumn {
    /// Task progress. Traces omit it, since the original does not return it.
    pub const TASK_PROGRESS: InfoColumn =
        InfoColumn { name: "task_progress", is_integer: false, description: "share of the task that was done, 0 to 1" };

    /// Name of the column that is 1 if the agent succeeded, in environments that define success.
    pub const SUCCESS: &str = "success";
}

/// The number of an episode by which agents are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Metric {
    /// Its name: `reward`, `length` or a column of the final info.
    pub name: &'static str,
    /// Label in plots.
    pub label: &'static str,
}

impl Metric {
    /// The sum of an episode's rewards.
    pub const RETURN: Metric = Metric { name: "reward", label: "Return" };
    /// [`InfoColumn::TASK_PROGRESS`].
    pub const TASK_PROGRESS: Metric = Metric { name: InfoColumn::TASK_PROGRESS.name, label: "Task progress" };
}

/// When a task counts as learnt: the mean of a number over the last episodes reaches a share of the best possible one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Learnt {
    /// Name of the number, as in [`Metric::name`]. A task without a final info of that name never counts as learnt.
    pub name: &'static str,
    /// The least mean.
    pub mean: f64,
}

impl Learnt {
    /// At 0.9 of a final info from 0 to 1.
    pub const fn by(name: &'static str) -> Self {
        Learnt { name, mean: 0.9 }
    }
}

/// Space of the feature observation, named after Gymnasium's spaces. In JSON as an [`ActionSpace`].
///
/// The features are float32 in any case. The space says what they stand for: Python returns integers of a
/// [`Discrete`](ObservationSpace::Discrete) space as int64, and the parts of a [`Tuple`](ObservationSpace::Tuple) apart.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub enum ObservationSpace {
    /// One integer from 0 to less than this number.
    Discrete(i32),
    /// Several integers, each from 0 to less than its number.
    MultiDiscrete(&'static [i32]),
    /// One float32 for each dimension.
    Box {
        /// Lower bounds; may be infinite.
        low: &'static [f32],
        /// Upper bounds; may be infinite.
        high: &'static [f32],
    },
    /// Several observations, one after the other.
    Tuple(&'static [ObservationSpace]),
}

impl ObservationSpace {
    /// Number of features.
    pub fn width(&self) -> usize {
        match self {
            ObservationSpace::Discrete(_) => 1,
            ObservationSpace::MultiDiscrete(numbers) => numbers.len(),
            ObservationSpace::Box { low, .. } => low.len(),
            ObservationSpace::Tuple(parts) => parts.iter().map(ObservationSpace::width).sum(),
        }
    }

    /// Whether features are in the space.
    pub fn contains(&self, features: &[f32]) -> bool {
        features.len() == self.width()
            && match self {
                ObservationSpace::Discrete(choices) => is_choice(features[0], *choices),
                ObservationSpace::MultiDiscrete(choices) => {
                    features.iter().zip(*choices).all(|(number, choices)| is_choice(*number, *choices))
                }
                ObservationSpace::Box { low, high } => features
                    .iter()
                    .zip(low.iter().zip(*high))
                    .all(|(number, (low, high))| (*low..=*high).contains(number)),
                ObservationSpace::Tuple(parts) => {
                    let mut rest = features;
                    parts.iter().all(|part| {
                        let (own, others) = rest.split_at(part.width());
                        rest = others;
                        part.contains(own)
                    })
                }
            }
    }
}

/// Whether a number is one of the integers from 0 to less than `choices`.
fn is_choice(number: f32, choices: i32) -> bool {
    number.fract() == 0.0 && (0.0..choices as f32).contains(&number)
}

impl fmt::Display for ObservationSpace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ObservationSpace::Discrete(n) => write!(f, "Discrete({n})"),
            ObservationSpace::MultiDiscrete(numbers) => write!(f, "MultiDiscrete({numbers:?})"),
            ObservationSpace::Box { low, .. } => write!(f, "Box({},)", low.len()),
            ObservationSpace::Tuple(parts) => {
                let parts: Vec<String> = parts.iter().map(ToString::to_string).collect();
                write!(f, "Tuple({})", parts.join(", "))
            }
        }
    }
}

/// A part of the Markov state: what determines, together with the actions, how an episode continues.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StatePart {
    /// Name, unique within the environment.
    pub name: &'static str,
    /// Meaning and unit.
    pub description: &'static str,
    /// The space of each of its numbers.
    pub space: StateSpace,
    /// Its shape; empty for one number.
    pub shape: &'static [usize],
    /// Its type in a single environment of Python: a dtype of numpy, or `int` for an integer of Python.
    pub dtype: &'static str,
}

impl StatePart {
    /// An array of integers from 0 to less than `choices`.
    pub const fn integers(
        name: &'static str,
        choices: i32,
        shape: &'static [usize],
        dtype: &'static str,
        description: &'static str,
    ) -> Self {
        StatePart { name, description, space: StateSpace::Integers(choices), shape, dtype }
    }

    /// An integer of Python from 0 to less than `choices`.
    pub const fn integer(name: &'static str, choices: i32, description: &'static str) -> Self {
        StatePart::integers(name, choices, &[], "int", description)
    }

    /// A float32 array of numbers from 0 to 1.
    pub const fn shares(name: &'static str, shape: &'static [usize], description: &'static str) -> Self {
        let space = StateSpace::Box { low: &[0.0], high: &[1.0] };
        StatePart { name, description, space, shape, dtype: "float32" }
    }

    /// How many numbers it has.
    pub fn width(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether numbers are in its space.
    pub fn contains(&self, numbers: &[f32]) -> bool {
        numbers.len() == self.width()
            && match self.space {
                StateSpace::Integers(choices) => numbers.iter().all(|number| is_choice(*number, choices)),
                StateSpace::Binary => numbers.iter().all(|number| is_choice(*number, 2)),
                StateSpace::Box { low, high } => numbers
                    .iter()
                    .zip(low.iter().cycle().zip(high.iter().cycle()))
                    .all(|(number, (low, high))| (*low..=*high).contains(number)),
            }
    }
}

/// Space of a part of the Markov state.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub enum StateSpace {
    /// Integers from 0 to less than this number: Gymnasium's `Discrete` for one, otherwise `MultiDiscrete`.
    Integers(i32),
    /// Zeros and ones, Gymnasium's `MultiBinary`.
    Binary,
    /// Numbers, float32.
    Box {
        /// The lower bound of all numbers, or of each.
        low: &'static [f32],
        /// The upper bound of all numbers, or of each.
        high: &'static [f32],
    },
}

/// The types of a Python class that an environment reproduces, where they are not those of its spaces. [`DEFAULT`](Self::DEFAULT)
/// is right for all other environments.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct OriginalTypes {
    /// numpy's dtype of arrays of integers in observations.
    pub integers: &'static str,
    /// The type of rewards.
    pub reward: RewardType,
    /// The names of the final infos that are floats of numpy.
    pub numpy_floats: &'static [&'static str],
}

impl OriginalTypes {
    /// The types of most environments: integers of 64 bits, and floats.
    pub const DEFAULT: OriginalTypes =
        OriginalTypes { integers: "int64", reward: RewardType::Float, numpy_floats: &[] };
}

/// The type of a Python class's rewards.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RewardType {
    /// A float.
    Float,
    /// A float of numpy.
    NumpyFloat,
    /// A float of numpy if it is positive, otherwise a float.
    NumpyFloatIfPositive,
    /// A float; 0 is an integer.
    IntegerZero,
    /// A float; 0 is an integer, except in the step that ends the episode.
    IntegerZeroUntilEnd,
}

/// Everything that is fixed about an environment id.
#[derive(Clone, Debug, Serialize)]
pub struct EnvSpec {
    /// Id, such as `TMaze-v0`.
    pub id: &'static str,
    /// The agent's task in one line.
    pub summary: &'static str,
    /// Action space.
    pub action_space: ActionSpace,
    /// Size of the frame; `None` if the environment has features only, which every batch then contains.
    pub frame: Option<FrameShape>,
    /// Size of the picture for people of an environment without frames; `None` if there is none.
    pub picture: Option<FrameShape>,
    /// The meaning of an action's numbers, in the order of its branches.
    pub actions: &'static [ActionBranch],
    /// Length of the vector observation (float32 in 0..=1); 0 if there is none.
    pub vector_observation: usize,
    /// Columns of the ground truth (float64); empty if there is none.
    pub ground_truth: &'static [Column],
    /// Whether the ground truth of a single environment has an integer dtype in Python.
    pub ground_truth_is_integer: bool,
    /// The least and the largest number of the ground truth; `None` if it has no bounds.
    pub ground_truth_bounds: Option<(f32, f32)>,
    /// The parts of the Markov state, float32 in a batch that is to have it; empty if the environment does not tell it.
    pub markov_state: &'static [StatePart],
    /// Columns of the final info in addition to `reward` and `length`.
    pub info: &'static [InfoColumn],
    /// Columns of the feature observation (float32).
    pub features: &'static [Column],
    /// What the features stand for; `None` for a box without bounds.
    pub observation_space: Option<ObservationSpace>,
    /// Whether the best policy needs the previous action, which the observation does not show.
    pub needs_previous_action: bool,
    /// Types of the Python class that the environment reproduces.
    pub types: OriginalTypes,
    /// Whether an episode may show what earlier ones left. [`PoolConfig::independent_episodes`] prevents it.
    ///
    /// [`PoolConfig::independent_episodes`]: crate::pool::PoolConfig::independent_episodes
    pub keeps_state: bool,
    /// Reset parameters with their defaults and limits.
    pub parameters: &'static [Parameter],
    /// Arguments of the id, as in `Maze-v0?size=9`, with its values as their defaults.
    pub arguments: &'static [Parameter],
    /// The number by which agents are compared.
    pub metric: Metric,
    /// When the task counts as learnt; `None` for a task whose episodes get longer the better the agent is.
    pub learnt: Option<Learnt>,
    /// The maximum number of steps of an episode with these reset parameters; `None` without a limit.
    #[serde(skip)]
    pub step_limit: fn(&ResetParameters) -> Option<i64>,
    /// Frames per second for a human viewer.
    pub render_fps: u32,
}

impl EnvSpec {
    /// An id without frames, reset parameters, infos and features, at 25 frames per second. `summary` is the agent's task in one line.
    ///
    /// Its metric is the return, a final info `success` of 0.9 counts as learnt, and the step limit is the reset parameter `max_steps`,
    /// unless that is missing or less than 1.
    pub const fn new(id: &'static str, summary: &'static str, action_space: ActionSpace) -> Self {
        EnvSpec {
            id,
            summary,
            action_space,
            frame: None,
            picture: None,
            actions: &[],
            vector_observation: 0,
            ground_truth: &[],
            ground_truth_is_integer: false,
            ground_truth_bounds: None,
            markov_state: &[],
            info: &[],
            features: &[],
            observation_space: None,
            needs_previous_action: false,
            types: OriginalTypes::DEFAULT,
            keeps_state: false,
            parameters: &[],
            arguments: &[],
            metric: Metric::RETURN,
            learnt: Some(Learnt::by(InfoColumn::SUCCESS)),
            step_limit: |parameters| Some(parameters.int("max_steps", 0)).filter(|steps| *steps > 0),
            render_fps: 25,
        }
    }

    /// Size of what people see: the frame, or the picture of an environment without frames.
    pub fn shown(&self) -> Option<FrameShape> {
        self.frame.or(self.picture)
    }

    /// Features as text, such as `suit hearts  mines 2`. A feature that is named as a branch of the actions has the names of its choices.
    pub fn text(&self, features: &[f32]) -> String {
        let part = |(column, value): (&Column, &f32)| {
            let branch = self.actions.iter().find(|branch| branch.name == column.name);
            match branch.and_then(|branch| branch.choices.get(*value as usize)) {
                Some(choice) => format!("{} {}", column.name, choice.name),
                None if value.fract() == 0.0 => format!("{} {value}", column.name),
                None => format!("{} {value:.3}", column.name),
            }
        };
        self.features.iter().zip(features).map(part).collect::<Vec<_>>().join("  ")
    }

    /// The maximum number of steps of an episode with the given reset parameters; `None` without a limit.
    ///
    /// # Errors
    ///
    /// [`ParameterError`] if a reset parameter is unknown, or has the wrong type or range.
    pub fn max_episode_steps(&self, given: &Map<String, Json>) -> Result<Option<i64>, ParameterError> {
        Ok((self.step_limit)(&self.reset_parameters(given)?))
    }

    /// The given reset parameters, the defaults of all others, and the id's arguments.
    ///
    /// # Errors
    ///
    /// [`ParameterError`] if a name is unknown, or a value has the wrong type or is out of range.
    pub fn reset_parameters(&self, given: &Map<String, Json>) -> Result<ResetParameters, ParameterError> {
        ResetParameters::new(self.id, self.parameters, self.arguments, given)
    }

    /// The specification with these arguments, such as `size=9&goals=1,2`, in its id and in [`arguments`](EnvSpec::arguments). Spaces
    /// that follow from them are as before. Its texts are never freed.
    ///
    /// # Errors
    ///
    /// [`ParameterError`] if a name is unknown, or a value has the wrong type or is out of range.
    pub fn with_arguments(&self, given: &str) -> Result<EnvSpec, ParameterError> {
        let (mut arguments, mut names) = (self.arguments.to_vec(), HashSet::new());
        for argument in given.split('&').filter(|argument| !argument.is_empty()) {
            let (name, value) = argument.split_once('=').unwrap_or((argument, ""));
            let known = arguments.iter_mut().find(|known| known.name == name);
            let known = known.ok_or_else(|| ParameterError::UnknownArgument {
                id: self.id,
                name: name.to_owned(),
                allowed: match self.arguments {
                    [] => "none".to_owned(),
                    known => known.iter().map(|known| known.name).collect::<Vec<_>>().join(", "),
                },
            })?;
            if !names.insert(name) {
                let (value, allowed) = (value.to_owned(), "given once".to_owned());
                return Err(ParameterError::Argument { name: known.name, value, allowed });
            }
            *known = known.with_default(value)?;
        }
        let texts =
            arguments.iter().zip(self.arguments).map(|(new, old)| (new, new.default_text(), old.default_text()));
        let changed = texts.filter(|(_, new, old)| new != old);
        let text = |(argument, text, _): (&Parameter, String, _)| {
            format!("{}={}", argument.name, text.replace(['[', ']', ' '], ""))
        };
        let changed: Vec<_> = changed.map(text).collect();
        let id = if changed.is_empty() { self.id } else { format!("{}?{}", self.id, changed.join("&")).leak() };
        Ok(EnvSpec { id, arguments: arguments.leak(), ..self.clone() })
    }
}

/// The registry does not have this id, or not with its arguments.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("no environment `{id}`; {}", self.hint())]
pub struct UnknownEnvironment {
    /// The given id.
    pub id: String,
    /// All known ids, separated by commas; empty if only the arguments of `id` are wrong.
    pub known: String,
    /// What is wrong with the arguments of a known id.
    pub problem: Option<String>,
}

impl UnknownEnvironment {
    /// The known ids that the given one may stand for, such as `A-v0 or B-v0`: the one of which it is the name without a version,
    /// those that contain it, or the one most like it.
    pub fn likely(&self) -> Option<String> {
        const MOST: usize = 6;
        let given = self.id.split('?').next().unwrap_or_default().to_lowercase();
        let known = || self.known.split(", ").map(|known| (known, known.to_lowercase()));
        let is_version = |rest: &str| rest.strip_prefix("-v").is_some_and(|rest| rest.parse::<u32>().is_ok());
        let is_named = |lower: &str| lower.strip_prefix(&given).is_some_and(is_version);
        let mut ids: Vec<_> = known().filter(|(_, lower)| is_named(lower)).collect();
        if ids.is_empty() {
            ids = known().filter(|(_, lower)| lower.contains(&given)).collect();
        }
        if ids.is_empty() {
            let like = known().map(|one| (strsim::jaro_winkler(&one.1, &given), one));
            ids.extend(
                like.filter(|(like, _)| *like > 0.7).max_by(|(a, _), (b, _)| a.total_cmp(b)).map(|(_, one)| one),
            );
        }
        let ids: Vec<_> = ids.into_iter().map(|(known, _)| known).collect();
        match &ids[..] {
            [] => None,
            [only] => Some((*only).to_owned()),
            [others @ .., last] if ids.len() <= MOST => Some(format!("{} or {last}", others.join(", "))),
            _ => Some(format!("one of {} such ids", ids.len())),
        }
    }

    /// What is wrong with the arguments, the likely ids, or all known ones.
    fn hint(&self) -> String {
        match (&self.problem, self.likely()) {
            (Some(problem), _) => problem.clone(),
            (None, Some(likely)) => format!("did you mean {likely}? `endless list` shows all"),
            (None, None) => format!("there are {}", self.known),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_stands_for_its_ids() {
        for (given, likely) in [
            ("maze", Some("Maze-v0")),
            ("maze?size=9", Some("Maze-v0")),
            ("Maze-Gird-v0", Some("Maze-Grid-v0")),
            ("p-Count", Some("p-CountEasy-v0 or p-CountHard-v0")),
            ("counthard", Some("p-CountHard-v0")),
            ("p-", Some("one of 7 such ids")),
            ("xyz", None),
        ] {
            let known = "Maze-v0, Maze-Grid-v0, p-CountEasy-v0, p-CountHard-v0, p-A, p-B, p-C, p-D, p-E".to_owned();
            let error = UnknownEnvironment { id: given.to_owned(), known, problem: None };
            assert_eq!(error.likely().as_deref(), likely, "{given}");
        }
    }
}
