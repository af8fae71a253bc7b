//! Configuration of a pool, and reset requests.

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::{Map, Value as Json};

use super::autoreset::Autoreset;
use super::error::PoolError;
use super::seeding::{MAX_TOTAL_ENVS, Seeding};
use crate::batch::limits::MAX_ENVS;
use crate::batch::{Contents, Frames, MAX_STACK, batch_layout};
use crate::envs::EnvSpec;

/// Reset parameters by name, as a JSON object.
pub type OptionMap = Map<String, Json>;

/// Reset parameters of a pool's environments. Omitted parameters have their defaults.
///
/// In JSON, an object is [`Shared`](Self::Shared), and a list of objects is [`Each`](Self::Each).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Json", untagged)]
pub enum ResetOptions {
    /// The same for all environments.
    Shared(OptionMap),
    /// One set for each environment.
    Each(Vec<OptionMap>),
}

impl Default for ResetOptions {
    fn default() -> Self {
        ResetOptions::Shared(OptionMap::new())
    }
}

impl TryFrom<Json> for ResetOptions {
    type Error = String;

    fn try_from(given: Json) -> Result<Self, String> {
        let wrong = |given: &Json| format!("options must be an object, or a list of objects, got {given}");
        match given {
            Json::Object(shared) => Ok(ResetOptions::Shared(shared)),
            Json::Array(each) => {
                let object = |item| if let Json::Object(map) = item { Ok(map) } else { Err(wrong(&item)) };
                each.into_iter().map(object).collect::<Result<_, _>>().map(ResetOptions::Each)
            }
            other => Err(wrong(&other)),
        }
    }
}

/// Defines a method for each field of a configuration, which returns the configuration with another value of the field.
#[doc(hidden)]
#[macro_export]
macro_rules! setters {
    ($($field:ident: $type:ty),+ $(,)?) => {
        $(
            #[doc = concat!("With [`", stringify!($field), "`](Self#structfield.", stringify!($field), ").")]
            #[must_use]
            pub fn $field(mut self, $field: $type) -> Self {
                self.$field = $field;
                self
            }
        )+
    };
}

/// Configuration of a pool: [`new`](Self::new) has the defaults, and a method for each field changes one.
///
/// In JSON, the keys are the names of the fields. Only `id` and `num_envs` are required; the other fields default to those of
/// [`new`](Self::new), and an unknown field is an error. `"frames": null` omits the frames.
///
/// ```
/// use endless_gym_core::pool::{Autoreset, PoolConfig, Seeding};
///
/// let config: PoolConfig = serde_json::from_str(
///     r#"{
///         "id": "MortarMayhem-v0",
///         "num_envs": 16,
///         "options": {"command_count": [5]},
///         "autoreset": "same_step",
///         "seeding": {"range": {"start": 0, "end": 100000}}
///     }"#,
/// )?;
/// assert_eq!(config.autoreset, Autoreset::SameStep);
/// assert_eq!(config.seeding, Seeding::Range { start: 0, end: 100_000, step: 1, seed: None });
/// assert_eq!(config.total_envs, 16);
/// # Ok::<(), serde_json::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(remote = "Self", deny_unknown_fields)]
#[non_exhaustive]
pub struct PoolConfig {
    /// Environment id, such as `MortarMayhem-v0`.
    pub id: String,
    /// Number of environments in the pool, 1 to [`MAX_ENVS`].
    pub num_envs: usize,
    /// Reset parameters.
    #[serde(default)]
    pub options: ResetOptions,
    /// When the next episode starts after one has ended.
    #[serde(default)]
    pub autoreset: Autoreset,
    /// Whether same-step autoreset keeps the last observation of an episode, in the `final_*` sections. It has no effect in
    /// other modes.
    #[serde(default)]
    pub final_observation: bool,
    /// Source of the episodes' seeds.
    #[serde(default)]
    pub seeding: Seeding,
    /// Whether an episode depends only on its seed and its reset parameters.
    ///
    /// If false, environments whose specification [keeps state](EnvSpec::keeps_state) show what an earlier episode left, and with
    /// [`Seeding::Continue`] an episode continues the previous one's generator.
    ///
    /// If true, every episode starts as in a new environment, and resets allocate memory. [`Seeding::Continue`] then draws a
    /// seed for each later episode from `SeedSequence(seed, spawn_key=(0,))`, where `seed` is the last seed that the
    /// environment was given.
    #[serde(default)]
    pub independent_episodes: bool,
    /// Format of the frames; `None` omits them, and nothing is drawn.
    #[serde(default = "default_frames")]
    pub frames: Option<Frames>,
    /// Whether the batch has the feature observation.
    #[serde(default)]
    pub features: bool,
    /// Whether the batch has the Markov state, if the environment tells it.
    #[serde(default)]
    pub state: bool,
    /// Whether to draw every frame a second time, in full, and compare; a difference is [`PoolError::WrongFrame`]. For tests.
    #[serde(default)]
    pub check_drawing: bool,
    /// Number of this pool's first environment among all environments, for [`seeding`](Self::seeding) and
    /// [`ResetRequest::Seed`]. An engine numbers the environments of all its groups consecutively.
    #[serde(default)]
    pub first_env: usize,
    /// Total number of environments in all pools, for [`seeding`](Self::seeding): `first_env + num_envs` to 2^32 - 1. In JSON,
    /// the default is `first_env + num_envs`.
    #[serde(default)]
    pub total_envs: usize,
}

fn default_frames() -> Option<Frames> {
    Some(Frames::default())
}

// `remote = "Self"` derives inherent functions. These add the one default that depends on other fields.
impl<'de> Deserialize<'de> for PoolConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut config = PoolConfig::deserialize(deserializer)?;
        if config.total_envs == 0 {
            config.total_envs = config.first_env.saturating_add(config.num_envs);
        }
        Ok(config)
    }
}

impl Serialize for PoolConfig {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        PoolConfig::serialize(self, serializer)
    }
}

impl PoolConfig {
    /// `num_envs` environments of `id` with the defaults: default reset parameters, next-step autoreset, seeds from entropy,
    /// and frames in the default format.
    pub fn new(id: &str, num_envs: usize) -> Self {
        PoolConfig {
            id: id.to_owned(),
            num_envs,
            options: ResetOptions::default(),
            autoreset: Autoreset::default(),
            final_observation: false,
            seeding: Seeding::default(),
            independent_episodes: false,
            frames: default_frames(),
            features: false,
            state: false,
            check_drawing: false,
            first_env: 0,
            total_envs: num_envs,
        }
    }

    setters! {
        num_envs: usize,
        options: ResetOptions,
        autoreset: Autoreset,
        final_observation: bool,
        seeding: Seeding,
        independent_episodes: bool,
        frames: Option<Frames>,
        features: bool,
        state: bool,
        check_drawing: bool,
        first_env: usize,
        total_envs: usize,
    }

    /// Checks everything that [`Pool::new`](super::Pool::new) checks, without creating environments. `spec` is the
    /// specification of `id`.
    ///
    /// # Errors
    ///
    /// [`PoolError`] if a reset parameter or a number is out of range.
    pub fn validate(&self, spec: &EnvSpec) -> Result<(), PoolError> {
        self.check(spec)?;
        batch_layout(spec, self.num_envs, self.contents())?;
        let check = |given: &OptionMap| spec.reset_parameters(given).map(drop);
        match &self.options {
            ResetOptions::Shared(given) => Ok(check(given)?),
            ResetOptions::Each(each) => each.iter().enumerate().try_for_each(|(env, given)| {
                check(given).map_err(|source| PoolError::ParametersOf { env: self.first_env + env, source })
            }),
        }
    }

    /// Checks everything except the id and the reset parameters.
    pub(super) fn check(&self, spec: &EnvSpec) -> Result<(), PoolError> {
        if !(1..=MAX_ENVS).contains(&self.num_envs) {
            return Err(PoolError::NumEnvs { given: self.num_envs });
        }
        if let Some(Frames { stack: given, .. }) = self.frames
            && !(1..=MAX_STACK).contains(&given)
        {
            return Err(PoolError::Stack { given });
        }
        if let (Some(frames), Some(frame)) = (self.frames, spec.frame)
            && frames.format.grayscale
            && frame.channels != 3
        {
            return Err(PoolError::Grayscale { id: spec.id, channels: frame.channels });
        }
        let end = self.first_env.checked_add(self.num_envs);
        if end.is_none_or(|end| end > self.total_envs) || self.total_envs > MAX_TOTAL_ENVS {
            let PoolConfig { first_env, num_envs, total_envs, .. } = *self;
            return Err(PoolError::EnvNumbers { first_env, num_envs, total_envs });
        }
        if let ResetOptions::Each(each) = &self.options
            && each.len() != self.num_envs
        {
            return Err(PoolError::OptionsCount { given: each.len(), num_envs: self.num_envs });
        }
        match &self.seeding {
            Seeding::List(seeds) if seeds.is_empty() => Err(PoolError::NoSeeds),
            Seeding::Range { start, end, .. } if start >= end || *end > i64::MAX as u64 => {
                Err(PoolError::SeedRange { start: *start, end: *end })
            }
            Seeding::Range { step: 0, .. } => Err(PoolError::SeedStep),
            _ => Ok(()),
        }
    }

    /// The optional sections of the pool's batch.
    pub(super) fn contents(&self) -> Contents {
        Contents {
            frames: self.frames,
            features: self.features,
            state: self.state,
            final_observation: self.final_observation && self.autoreset == Autoreset::SameStep,
        }
    }
}

/// Which environments start an episode.
#[derive(Clone, Copy, Debug)]
pub enum ResetRequest<'a> {
    /// All, each with the next seed of [`Seeding`].
    All,
    /// All; environment `i` of the pool is seeded with `seed + first_env + i` (wrapping), where `first_env` is
    /// [`PoolConfig::first_env`].
    Seed(u64),
    /// Individually, one item for each environment.
    Each(&'a [EnvReset]),
}

/// Whether one environment starts an episode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum EnvReset {
    /// No: its episode continues.
    #[default]
    Keep,
    /// With the next seed of [`Seeding`].
    Next,
    /// With this seed.
    Seed(u64),
}

impl ResetRequest<'_> {
    /// Whether environment number `env` starts an episode.
    pub(super) fn resets(&self, env: usize) -> bool {
        match self {
            ResetRequest::All | ResetRequest::Seed(_) => true,
            ResetRequest::Each(each) => each[env] != EnvReset::Keep,
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::raster::PixelFormat;

    /// The error for a configuration whose field `name` is `value`.
    fn error(name: &str, value: Json) -> String {
        let mut given = json!({"id": "MortarMayhem-v0", "num_envs": 2});
        given[name] = value;
        serde_path_to_error::deserialize::<_, PoolConfig>(given).unwrap_err().to_string()
    }

    #[test]
    fn every_field_survives_json() {
        let options = |text| serde_json::from_str::<OptionMap>(text).unwrap();
        let new = PoolConfig::new("MysteryPath-v0", 2);
        let all = new
            .clone()
            .options(ResetOptions::Each(vec![options(r#"{"agent_scale": 0.2}"#), options("{}")]))
            .autoreset(Autoreset::Disabled)
            .final_observation(true)
            .seeding(Seeding::Range { start: 1, end: 9, step: 2, seed: Some(u64::MAX) })
            .independent_episodes(true)
            .frames(Some(Frames { format: PixelFormat { grayscale: true, ..PixelFormat::default() }, stack: 4 }))
            .features(true)
            .state(true)
            .check_drawing(true)
            .first_env(3)
            .total_envs(7);
        let list = new.clone().seeding(Seeding::List(vec![3, 1])).frames(None);
        let seeded = new.clone().seeding(Seeding::Continue { seed: Some(5) });
        for config in [new.clone(), all, list, seeded] {
            let text = serde_json::to_string(&config).unwrap();
            assert_eq!(serde_json::from_str::<PoolConfig>(&text).unwrap(), config, "{text}");
        }
        let short = json!({"id": "MysteryPath-v0", "num_envs": 2, "frames": {}, "seeding": {"continue": {}}});
        assert_eq!(serde_json::from_value::<PoolConfig>(short).unwrap(), new);
    }

    #[test]
    fn a_json_error_names_the_field_the_value_and_what_is_allowed() {
        for (name, value, expected) in [
            ("frame", json!(null), "unknown field `frame`, expected one of `id`, `num_envs`, `options`"),
            ("num_envs", json!("many"), "num_envs: invalid type: string \"many\", expected usize"),
            ("num_envs", json!(-1), "num_envs: invalid value: integer `-1`, expected usize"),
            ("options", json!([{}, 5]), "options: options must be an object, or a list of objects, got 5"),
            ("autoreset", json!("never"), "autoreset must be `next_step`, `same_step` or `disabled`, got `never`"),
            ("seeding", json!({"next": {}}), "unknown variant `next`, expected one of `continue`, `range`, `list`"),
            ("seeding", json!({"range": {"end": -3}}), "seeding.range.end: invalid value: integer `-3`, expected u64"),
            ("frames", json!({"stack": 1.5}), "frames.stack: invalid type: floating point `1.5`, expected usize"),
            ("frames", json!({"format": {"gray": true}}), "frames.format.gray: unknown field `gray`, expected one of"),
        ] {
            let found = error(name, value);
            assert!(found.contains(expected), "{found}");
        }
    }
}
