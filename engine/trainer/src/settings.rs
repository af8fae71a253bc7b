//! The settings of a run. Names, meanings and values are those of the Python agents' `settings.py`; what a trainer on the CPU from
//! features does not have is left out.
//!
//! Every field is an option of `endless learn`, whose parser checks its range. The defaults are those of the preset `quick`. Another
//! preset, and the settings of a run to resume, replace defaults before the command line is parsed.

use std::ffi::OsString;
use std::ops::RangeInclusive;
use std::path::Path;

use clap::builder::RangedU64ValueParser;
use clap::{ArgAction, Args, Command, ValueEnum};
use endless_gym_core::pool::OptionMap;
use endless_gym_service::ServiceSpecification;
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;

use crate::error::{Error, file};

/// How observations become vectors, by the names of the Python agents' wrappers: with the previous action, or only one-hot.
pub const VECTORS: &str = "endless_gym_agents.popgym:Vectors";
/// See [`VECTORS`].
pub const ONE_HOT: &str = "endless_gym_agents.popgym:OneHot";

/// Whether observations include the previous action, by the wrappers of a run.
pub(crate) fn has_previous_action(wrappers: &[String]) -> bool {
    wrappers.iter().eq([VECTORS])
}

/// File in the folder of a run with its settings.
pub const SETTINGS: &str = "settings.json";

/// The settings of a run.
#[derive(Args, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Environment id; `endless list` lists them.
    pub env: String,
    /// Memory of the agent.
    #[arg(long, value_enum, default_value_t = Agent::Gru)]
    pub agent: Agent,
    /// Defaults of all other settings.
    #[arg(long, value_enum, default_value_t = Preset::Quick)]
    pub preset: Preset,
    /// Seed of the initial weights, the episode seeds and all sampling.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Threads that act and learn; 0 for one per core. The results do not depend on it.
    #[arg(long, default_value_t = 0, value_parser = integer(0..=1024))]
    pub threads: usize,
    /// Train in the environments of this running engine, which decides their number, groups, reset parameters and seeds [default:
    /// environments of its own].
    #[arg(long, value_name = "SERVICE", default_value = "", hide_default_value = true)]
    #[arg(conflicts_with_all = ["option", "num_envs", "groups", "engine", "num_threads"])]
    #[serde(skip)]
    pub connect: String,
    /// Folder of the run [default: runs/ENV/AGENT-SEED-TIME].
    #[arg(long, value_name = "FOLDER", default_value = "", hide_default_value = true)]
    pub run: String,
    /// Resume the run in this folder from its last checkpoint; its settings are the defaults of the other options [default: a new
    /// run].
    #[arg(long, value_name = "FOLDER", default_value = "", hide_default_value = true)]
    pub resume: String,
    /// Start from the weights of this checkpoint in safetensors, or of the last one of the run in this folder; the encoder and the
    /// heads keep their initial values where shapes differ [default: initial weights].
    #[arg(long, value_name = "PATH", default_value = "", hide_default_value = true)]
    pub init_from: String,
    /// Environment steps of the run, rounded up to a whole update; 0 for `--ppo.updates`, which it replaces.
    #[arg(long, default_value_t = 0)]
    pub total_steps: u64,
    /// Updates between two checkpoints; the last update always writes a checkpoint.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u64).range(1..))]
    pub checkpoint_interval: u64,
    /// Largest number of minutes between two checkpoints; 0 for no limit.
    #[arg(long, default_value_t = 10.0, value_parser = number(FROM_ZERO))]
    pub checkpoint_minutes: f64,
    /// Keep all checkpoints, for evaluation, instead of only the last.
    #[arg(long, default_value_t = false, action = ArgAction::Set, num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub keep_checkpoints: bool,
    /// Minutes within which training stops with a checkpoint, by the time that updates and checkpoints took; 0 for no limit.
    #[arg(long, default_value_t = 0.0, value_parser = number(FROM_ZERO))]
    pub time_limit: f64,
    /// Stop when the mean reward of the last 100 episodes reaches this value [default: none].
    #[arg(long, allow_negative_numbers = true, value_parser = number(FINITE))]
    pub target_reward: Option<f64>,
    /// Stop when the last 100 episodes show that the task is learnt, as `endless list ID` defines it. A target reward replaces it.
    #[arg(long, default_value_t = true, action = ArgAction::Set, num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub stop_when_learnt: bool,
    /// The environments.
    #[command(flatten)]
    pub environment: Environment,
    /// The memory.
    #[command(flatten)]
    pub recurrence: Recurrence,
    /// The layers before and after the memory.
    #[command(flatten)]
    pub model: Model,
    /// The algorithm.
    #[command(flatten)]
    pub ppo: Ppo,
}

/// The memory of an agent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[value(rename_all = "lowercase")]
pub enum Agent {
    /// Gated recurrent units.
    Gru,
    /// Gated recurrent units whose gates depend on the input only; faster.
    MinGru,
    /// No memory; what it reaches shows how much of a task needs one.
    None,
}

/// Values of the settings that are not given.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// Small networks; minutes on two cores; stops when the task is learnt.
    Quick,
    /// The final hyperparameters of the paper.
    Paper,
}

/// Where the environments step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Place {
    /// In this process.
    Thread,
    /// In an engine process, over shared memory.
    Process,
}

/// The scope in which advantages are normalised.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Scope {
    /// Not at all.
    None,
    /// All steps of an update.
    Batch,
    /// Each minibatch.
    Minibatch,
}

/// Training environments.
#[derive(Args, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Environment {
    /// Reset parameter, such as `command_count=[2]`; may be repeated [default: the environment's own].
    #[arg(long = "environment.option", value_name = "NAME=VALUE")]
    pub option: Vec<String>,
    /// What the agent observes: a vector that describes the frame.
    #[arg(long = "environment.observation", default_value = "features", value_parser = ["features"])]
    pub observation: String,
    /// What makes vectors of integers: `endless_gym_agents.popgym:Vectors`, which adds the previous action and whether a step is the
    /// first of its episode, as POPGym's agents observe them, or `endless_gym_agents.popgym:OneHot`, which does not [default: Vectors
    /// where observations are integers].
    #[arg(long = "environment.wrapper", value_name = "CLASS", value_parser = [VECTORS, ONE_HOT])]
    pub wrapper: Vec<String>,
    /// Total number of environments in all groups.
    #[arg(long = "environment.num-envs", default_value_t = 64, value_parser = integer(1..=MAX_COUNT))]
    pub num_envs: usize,
    /// Groups of environments. With two, an engine process steps one group while the agent computes the actions for the other.
    #[arg(long = "environment.groups", default_value_t = 1, value_parser = integer(1..=MAX_COUNT))]
    pub groups: usize,
    /// `thread`: environments in this process. `process`: in an engine process, over shared memory.
    #[arg(long = "environment.engine", value_enum, default_value_t = Place::Thread)]
    pub engine: Place,
    /// Threads that step the environments; 0 for one per core.
    #[arg(long = "environment.num-threads", default_value_t = 1)]
    pub num_threads: usize,
}

/// Memory of the agents.
#[derive(Args, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Recurrence {
    /// Size of the hidden state.
    #[arg(long = "recurrence.hidden-size", default_value_t = 128, value_parser = integer(1..=MAX_WIDTH))]
    pub hidden_size: usize,
    /// Number of stacked recurrent layers.
    #[arg(long = "recurrence.layers", default_value_t = 1, value_parser = integer(1..=64))]
    pub layers: usize,
    /// Residual connection around the recurrent layers.
    #[arg(long = "recurrence.residual", default_value_t = false, action = ArgAction::Set, num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub residual: bool,
    /// Fully connected layer before the recurrent layers.
    #[arg(long = "recurrence.embedding", default_value_t = true, action = ArgAction::Set, num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub embedding: bool,
    /// Length of truncated BPTT in steps; longer segments are cut into sequences that start from stored states.
    #[arg(long = "recurrence.sequence-length", default_value_t = 64, value_parser = integer(1..=MAX_COUNT))]
    pub sequence_length: usize,
}

/// Layers before and after the memory.
#[derive(Args, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Model {
    /// Units of the encoder.
    #[arg(long = "model.vector-width", default_value_t = 64, value_parser = integer(1..=MAX_WIDTH))]
    pub vector_width: usize,
    /// Units of the layer after the memory; 0 for the memory's output size.
    #[arg(long = "model.body-width", default_value_t = 0, value_parser = integer(0..=MAX_WIDTH))]
    pub body_width: usize,
    /// Units of the hidden layers of the policy and value heads.
    #[arg(long = "model.head-width", default_value_t = 64, value_parser = integer(1..=MAX_WIDTH))]
    pub head_width: usize,
    /// Gain of the initial weights of the value head's output layer.
    #[arg(long = "model.value-gain", default_value_t = 0.05, allow_negative_numbers = true, value_parser = number(FINITE))]
    pub value_gain: f64,
}

/// Proximal policy optimisation.
#[derive(Args, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Ppo {
    /// Number of updates of the run; 0 for as many environment steps as the paper's runs.
    #[arg(long = "ppo.updates", default_value_t = 2000)]
    pub updates: u64,
    /// Updates over which learning rate and entropy coefficient decay linearly to their final values.
    #[arg(long = "ppo.decay-updates", default_value_t = 2000, value_parser = clap::value_parser!(u64).range(1..))]
    pub decay_updates: u64,
    /// Rollout length: steps of each environment per update.
    #[arg(long = "ppo.steps", default_value_t = 64, value_parser = integer(1..=MAX_COUNT))]
    pub steps: usize,
    /// Epochs per update.
    #[arg(long = "ppo.epochs", default_value_t = 3, value_parser = integer(1..=MAX_COUNT))]
    pub epochs: usize,
    /// Minibatches per epoch.
    #[arg(long = "ppo.minibatches", default_value_t = 4, value_parser = integer(1..=MAX_COUNT))]
    pub minibatches: usize,
    /// Discount factor.
    #[arg(long = "ppo.gamma", default_value_t = 0.99, value_parser = number(SHARE))]
    pub gamma: f64,
    /// Lambda of generalised advantage estimation.
    #[arg(long = "ppo.gae-lambda", default_value_t = 0.95, value_parser = number(SHARE))]
    pub gae_lambda: f64,
    /// Clip range epsilon of the policy loss and of the value loss.
    #[arg(long = "ppo.clip-range", default_value_t = 0.1, value_parser = number(ABOVE_ZERO))]
    pub clip_range: f64,
    /// Normalise advantages over the whole batch, over each minibatch, or not at all.
    #[arg(long = "ppo.advantage-normalisation", value_enum, default_value_t = Scope::Minibatch)]
    pub advantage_normalisation: Scope,
    /// Coefficient of the value loss.
    #[arg(long = "ppo.value-coefficient", default_value_t = 0.5, value_parser = number(FROM_ZERO))]
    pub value_coefficient: f64,
    /// Initial learning rate of AdamW.
    #[arg(long = "ppo.learning-rate", default_value_t = 1.0e-3, value_parser = number(FROM_ZERO))]
    pub learning_rate: f64,
    /// Learning rate after its decay.
    #[arg(long = "ppo.final-learning-rate", default_value_t = 1.0e-4, value_parser = number(FROM_ZERO))]
    pub final_learning_rate: f64,
    /// Initial coefficient of the entropy bonus.
    #[arg(long = "ppo.entropy-coefficient", default_value_t = 1.0e-2, value_parser = number(FROM_ZERO))]
    pub entropy_coefficient: f64,
    /// Coefficient of the entropy bonus after its decay.
    #[arg(long = "ppo.final-entropy-coefficient", default_value_t = 1.0e-3, value_parser = number(FROM_ZERO))]
    pub final_entropy_coefficient: f64,
    /// Gradient clipping: largest global norm of the gradients.
    #[arg(long = "ppo.max-gradient-norm", default_value_t = 0.5, value_parser = number(ABOVE_ZERO))]
    pub max_gradient_norm: f64,
}

/// What the preset `paper` changes, as options.
const PAPER: &[(&str, &str)] = &[
    ("checkpoint_interval", "100"),
    ("stop_when_learnt", "false"),
    ("num_envs", "32"),
    ("hidden_size", "512"),
    ("sequence_length", "512"),
    ("vector_width", "128"),
    ("head_width", "512"),
    ("value_gain", "1"),
    ("updates", "0"),
    ("decay_updates", "10000"),
    ("steps", "512"),
    ("minibatches", "8"),
    ("gamma", "0.995"),
    ("advantage_normalisation", "none"),
    ("learning_rate", "0.000275"),
    ("final_learning_rate", "0.00001"),
    ("entropy_coefficient", "0.0001"),
    ("final_entropy_coefficient", "0.000001"),
    ("max_gradient_norm", "0.25"),
];

/// Environment steps of one update of the paper.
const PAPER_STEPS_PER_UPDATE: u64 = 32 * 512;

/// Largest number of steps of an update, and largest size of a layer. Beyond, a mistyped number would use up the memory of the machine.
const MAX_STEPS: usize = 1 << 24;
pub(crate) const MAX_WIDTH: u64 = 16_384;
/// Largest number of environments, steps or parts.
const MAX_COUNT: u64 = u32::MAX as u64;

/// The command `learn` with the defaults that the arguments name by `--preset` or `--resume`. Of an option that is given twice, the last
/// one counts. Fails with [`Error::NoRun`] or [`Error::Settings`] if there is no such run to resume.
pub fn with_defaults(mut command: Command, arguments: &[OsString]) -> Result<Command, Error> {
    let set = |command: Command, id: &str, values: Vec<String>| {
        command.mut_arg(id, |argument| argument.required(false).default_values(values))
    };
    if let Some(run) = value_of(arguments, "--resume").filter(|run| !run.is_empty()) {
        let mut values = serde_json::to_value(read(Path::new(&run))?).map_err(Error::json(SETTINGS))?;
        if let Json::Object(top) = &mut values {
            // Those of one call only.
            ["run", "resume", "time_limit"].iter().for_each(|name| drop(top.remove(*name)));
        }
        command = flat(&values).into_iter().fold(command, |command, (_, id, values)| set(command, id, values));
    } else if value_of(arguments, "--preset").is_some_and(|name| name == "paper") {
        command = PAPER.iter().fold(command, |command, (id, value)| set(command, id, vec![(*value).to_owned()]));
    }
    Ok(command.args_override_self(true))
}

/// The arguments with `--no-NAME` and `--GROUP.no-NAME` as `--NAME=false` and `--GROUP.NAME=false`, as for the Python agents.
pub fn with_negations(arguments: &[OsString]) -> Vec<OsString> {
    let positive = |text: &str| match text.strip_prefix("--no-") {
        Some(name) => Some(format!("--{name}=false")),
        None => text.split_once(".no-").map(|(group, name)| format!("{group}.{name}=false")),
    };
    let convert = |argument: &OsString| {
        let given = argument.to_str().filter(|text| text.starts_with("--") && !text.contains('='));
        given.and_then(positive).map_or_else(|| argument.clone(), OsString::from)
    };
    arguments.iter().map(convert).collect()
}

/// The last value of an option.
fn value_of(arguments: &[OsString], option: &str) -> Option<String> {
    let texts: Vec<&str> = arguments.iter().map(|argument| argument.to_str().unwrap_or_default()).collect();
    (0..texts.len()).rev().find_map(|i| {
        let value = texts[i].strip_prefix(option)?;
        if value.is_empty() { texts.get(i + 1).copied() } else { value.strip_prefix('=') }.map(str::to_owned)
    })
}

/// The settings with their values as texts, each with the group and the name of its field, which is the id of clap's argument.
fn flat(settings: &Json) -> Vec<(&str, &str, Vec<String>)> {
    let text = |value: &Json| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let texts =
        |value: &Json| value.as_array().map_or_else(|| vec![text(value)], |list| list.iter().map(text).collect());
    let fields = settings.as_object().into_iter().flatten().filter(|(_, value)| !value.is_null());
    let parts = fields.flat_map(|(name, value)| match value.as_object() {
        Some(group) => group.iter().map(|(field, value)| (&**name, &**field, texts(value))).collect(),
        None => vec![("", &**name, texts(value))],
    });
    parts.collect()
}

/// Reads the settings of the run in a folder. Fails with [`Error::NoRun`], or [`Error::Settings`] for those of another
/// program.
pub fn read(run: &Path) -> Result<Settings, Error> {
    let path = run.join(SETTINGS);
    if !path.exists() {
        return Err(Error::NoRun { run: run.to_owned() });
    }
    let text = endless_gym_core::files::read(&path).map_err(file(&path))?;
    serde_json::from_slice(&text).map_err(Error::json(path.display()))
}

impl Settings {
    /// The reset parameters. Fails with [`Error::Settings`] if one is not NAME=VALUE with a JSON value.
    pub fn options(&self) -> Result<OptionMap, Error> {
        let parse = |given: &String| {
            let (name, text) = given.split_once('=')?;
            let text = if ["True", "False"].contains(&text) { text.to_lowercase() } else { text.to_owned() };
            Some((name.to_owned(), serde_json::from_str(&text).ok()?))
        };
        let wrong = |given: &String| {
            let expected = "NAME=VALUE with a JSON value, such as 'command_count=[2]'";
            Error::Settings(format!("--environment.option must be {expected}, got `{given}`"))
        };
        self.environment.option.iter().map(|given| parse(given).ok_or_else(|| wrong(given))).collect()
    }

    /// Steps of a sequence. Without a memory, steps are shuffled one by one.
    pub fn sequence_length(&self) -> usize {
        if self.agent == Agent::None { 1 } else { self.recurrence.sequence_length.min(self.ppo.steps) }
    }

    /// These settings with the environments of an engine. Fails with [`Error::Settings`] if its environments differ in
    /// their reset parameters.
    pub fn of_engine(mut self, served: &ServiceSpecification) -> Result<Self, Error> {
        let [options] = &served.options[..] else {
            let (service, count) = (&served.service, served.options.len());
            let rule = format!("engine `{service}` must have the same reset parameters in all environments");
            return Err(Error::Settings(format!("{rule}, got {count} sets; start it with --option")));
        };
        let own = &mut self.environment;
        own.option = options.iter().map(|(name, value)| format!("{name}={value}")).collect();
        (own.num_envs, own.groups) = (served.num_envs * served.groups, served.groups);
        Ok(self)
    }

    /// These settings with the number of updates; checks what concerns several of them.
    pub fn validated(mut self) -> Result<Self, Error> {
        self.options()?;
        let Settings { environment, recurrence, model, ppo, .. } = &self;
        let (num_envs, groups) = (environment.num_envs, environment.groups);
        let steps = num_envs.saturating_mul(ppo.steps);
        let error = if num_envs % groups != 0 {
            let rule = "--environment.num-envs must be a multiple of --environment.groups";
            format!("{rule}, got {num_envs} environments and {groups} groups")
        } else if steps > MAX_STEPS {
            let given = ppo.steps;
            format!("an update must have at most {MAX_STEPS} steps, got {num_envs} environments and {given} steps")
        } else if ppo.steps % self.sequence_length() != 0 {
            let (given, length) = (ppo.steps, recurrence.sequence_length);
            let rule = "--ppo.steps must be a multiple of --recurrence.sequence-length";
            format!("{rule}, got {given} steps and sequences of {length}")
        } else if ppo.minibatches > steps {
            let given = ppo.minibatches;
            format!("--ppo.minibatches must be 1 to {steps}, the steps of an update, got {given}")
        } else if self.agent != Agent::None
            && recurrence.residual
            && !recurrence.embedding
            && model.vector_width != recurrence.hidden_size
        {
            let (hidden, given) = (recurrence.hidden_size, model.vector_width);
            let rule = format!("--recurrence.residual needs inputs of the hidden size {hidden}, got {given}");
            format!("{rule}; add --recurrence.embedding")
        } else {
            String::new()
        };
        if !error.is_empty() {
            return Err(Error::Settings(error));
        }
        let paper = self.paper_updates().saturating_mul(PAPER_STEPS_PER_UPDATE);
        let total = if self.total_steps > 0 { self.total_steps } else { paper };
        if self.total_steps > 0 || self.ppo.updates == 0 {
            self.ppo.updates = total.div_ceil(steps as u64);
        }
        self.total_steps = 0;
        Ok(self)
    }

    /// Updates of the paper's runs, according to its published curves; for runs that it does not have, those of the closest one.
    fn paper_updates(&self) -> u64 {
        match &*self.env {
            env if env.starts_with("Endless") => 50_000,
            env if env.contains("Grid") => 10_000,
            env if env.starts_with("MortarMayhem") => 30_000,
            env if env.starts_with("SearingSpotlights") && self.agent != Agent::Gru => 20_000,
            _ => 25_000,
        }
    }

    /// Checks that a run can be resumed with these settings: network, environments and seed must not change.
    /// [`Error::Settings`] names the first setting that must not change.
    pub fn check_resumable(&self, before: &Settings) -> Result<(), Error> {
        let json = |settings: &Settings| serde_json::to_value(settings).map_err(Error::json(SETTINGS));
        let (given, had) = (json(self)?, json(before)?);
        let had = flat(&had);
        for (group, name, given) in flat(&given) {
            // A setting without a value is absent.
            let had = had.iter().find(|(of, other, _)| (*of, *other) == (group, name));
            let had = had.map(|(_, _, values)| values.clone()).unwrap_or_default();
            let is_kept = match group {
                "" => ["env", "agent", "preset", "seed"].contains(&name),
                "environment" => !["engine", "num_threads"].contains(&name),
                group => group != "ppo",
            };
            if is_kept && given != had {
                let flag =
                    if group.is_empty() { name.to_owned() } else { format!("{group}.{}", name.replace('_', "-")) };
                let (given, had) = (given.join(" "), had.join(" "));
                let rule = format!("a resumed run must keep its {flag}: expected {had}, got {given}");
                return Err(Error::Settings(format!("{rule}; omit the option, or start a new run")));
            }
        }
        Ok(())
    }
}

/// What is allowed for a number, in words and as a check.
type Rule = (&'static str, fn(&f64) -> bool);
const FINITE: Rule = ("a finite number", |x| x.is_finite());
const FROM_ZERO: Rule = ("a finite number, 0 or more", |x| x.is_finite() && *x >= 0.0);
const ABOVE_ZERO: Rule = ("a finite number above 0", |x| x.is_finite() && *x > 0.0);
const SHARE: Rule = ("a number from 0 to 1", |x| (0.0..=1.0).contains(x));

/// A parser of numbers.
fn number((rule, fits): Rule) -> impl Fn(&str) -> Result<f64, String> + Clone {
    move |text| text.parse().ok().filter(fits).ok_or_else(|| format!("must be {rule}"))
}

/// A parser of integers.
fn integer(range: RangeInclusive<u64>) -> RangedU64ValueParser<usize> {
    RangedU64ValueParser::new().range(range)
}
