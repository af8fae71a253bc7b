//! Reset parameters: their names, defaults and limits, and the validation of given values.

use serde::Serialize;
use serde_json::{Map, Value as Json};
use thiserror::Error;

/// Maximum number of values in a list.
const MAX_LIST: usize = 4096;

/// Type, default and limits of a reset parameter, or of an argument of an id.
#[derive(Clone, Copy, Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum ParameterKind {
    /// A flag.
    Bool {
        /// Default.
        default: bool,
    },
    /// An integer.
    Int {
        /// Default.
        default: i64,
        /// Least allowed value.
        min: i64,
        /// Largest allowed value.
        max: i64,
    },
    /// A finite number.
    Float {
        /// Default.
        default: f64,
        /// Least allowed value.
        min: f64,
        /// Largest allowed value.
        max: f64,
    },
    /// A list of 1 to 4096 integers. Of a reset parameter, each episode draws one.
    IntList {
        /// Default.
        default: &'static [i64],
        /// Least allowed value of an item.
        min: i64,
        /// Largest allowed value of an item.
        max: i64,
    },
    /// One of several words.
    Choice {
        /// Default.
        default: &'static str,
        /// Allowed words.
        choices: &'static [&'static str],
    },
}

/// One reset parameter of an environment, or one argument of its id.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Parameter {
    /// Name.
    pub name: &'static str,
    /// Type, default and limits.
    #[serde(flatten)]
    pub kind: ParameterKind,
    /// Meaning and unit.
    pub description: &'static str,
}

/// Largest absolute value of a reward.
const MAX_REWARD: f64 = 1e6;

impl Parameter {
    /// A flag.
    pub const fn bool(name: &'static str, default: bool, description: &'static str) -> Self {
        Parameter { name, kind: ParameterKind::Bool { default }, description }
    }

    /// An integer in `min..=max`.
    pub const fn int(name: &'static str, default: i64, min: i64, max: i64, description: &'static str) -> Self {
        Parameter { name, kind: ParameterKind::Int { default, min, max }, description }
    }

    /// A number in `min..=max`.
    pub const fn float(name: &'static str, default: f64, min: f64, max: f64, description: &'static str) -> Self {
        Parameter { name, kind: ParameterKind::Float { default, min, max }, description }
    }

    /// A reward of -1e6 to 1e6; negative values are penalties.
    pub const fn reward(name: &'static str, default: f64, description: &'static str) -> Self {
        Parameter::float(name, default, -MAX_REWARD, MAX_REWARD, description)
    }

    /// A list of integers in `min..=max`. Of a reset parameter, each episode draws one.
    pub const fn list(
        name: &'static str,
        default: &'static [i64],
        min: i64,
        max: i64,
        description: &'static str,
    ) -> Self {
        Parameter { name, kind: ParameterKind::IntList { default, min, max }, description }
    }

    /// One of several words.
    pub const fn choice(
        name: &'static str,
        default: &'static str,
        choices: &'static [&'static str],
        description: &'static str,
    ) -> Self {
        Parameter { name, kind: ParameterKind::Choice { default, choices }, description }
    }

    /// The default as JSON text; a word without quotes.
    pub fn default_text(&self) -> String {
        match self.kind {
            ParameterKind::Bool { default } => default.to_string(),
            ParameterKind::Int { default, .. } => default.to_string(),
            ParameterKind::Float { default, .. } => format!("{default:?}"),
            ParameterKind::IntList { default, .. } => format!("{default:?}"),
            ParameterKind::Choice { default, .. } => default.to_owned(),
        }
    }

    /// Type and limits as text, such as `integer, 2 to 6`.
    pub fn allowed(&self) -> String {
        match self.kind {
            ParameterKind::Bool { .. } => "true or false".to_owned(),
            ParameterKind::Int { min: i64::MIN, max: i64::MAX, .. } => "integer".to_owned(),
            ParameterKind::Int { min, max, .. } => format!("integer, {min} to {max}"),
            ParameterKind::Float { min, max, .. } => format!("number, {min} to {max}"),
            ParameterKind::IntList { min, max, .. } => format!("list of 1 to {MAX_LIST} integers, {min} to {max}"),
            ParameterKind::Choice { choices, .. } => choices.join(" or "),
        }
    }

    /// A description of valid values for error messages: [`allowed`](Self::allowed) with an article.
    fn requirement(&self) -> String {
        let article = match self.kind {
            ParameterKind::Bool { .. } | ParameterKind::Choice { .. } => "",
            ParameterKind::Int { .. } => "an ",
            ParameterKind::Float { .. } | ParameterKind::IntList { .. } => "a ",
        };
        format!("{article}{}", self.allowed())
    }

    fn default_value(&self) -> Value {
        match self.kind {
            ParameterKind::Bool { default } => Value::Bool(default),
            ParameterKind::Int { default, .. } => Value::Int(default),
            ParameterKind::Float { default, .. } => Value::Float(default),
            ParameterKind::IntList { default, .. } => Value::IntList(default.to_vec()),
            ParameterKind::Choice { default, .. } => Value::Choice(default),
        }
    }

    /// The argument with another value: JSON text, where words need no quotes and lists no brackets.
    pub(super) fn with_default(self, text: &str) -> Result<Self, ParameterError> {
        let json = match self.kind {
            ParameterKind::Choice { .. } => Ok(text.into()),
            ParameterKind::IntList { .. } if !text.starts_with('[') => serde_json::from_str(&format!("[{text}]")),
            _ => serde_json::from_str(text),
        };
        let wrong =
            |_| ParameterError::Argument { name: self.name, value: text.to_owned(), allowed: self.requirement() };
        let value = self.parse(&json.unwrap_or_else(|_| text.into())).map_err(wrong)?;
        let mut kind = self.kind;
        match (&mut kind, value) {
            (ParameterKind::Bool { default }, Value::Bool(new)) => *default = new,
            (ParameterKind::Int { default, .. }, Value::Int(new)) => *default = new,
            (ParameterKind::Float { default, .. }, Value::Float(new)) => *default = new,
            (ParameterKind::IntList { default, .. }, Value::IntList(new)) => *default = new.leak(),
            (ParameterKind::Choice { default, .. }, Value::Choice(new)) => *default = new,
            _ => {}
        }
        Ok(Parameter { kind, ..self })
    }

    fn parse(&self, given: &Json) -> Result<Value, ParameterError> {
        let wrong = || ParameterError::Value { name: self.name, value: given.to_string(), allowed: self.requirement() };
        match self.kind {
            ParameterKind::Bool { .. } => given.as_bool().map(Value::Bool).ok_or_else(wrong),
            ParameterKind::Int { min, max, .. } => {
                let value = integer(given).ok_or_else(wrong)?;
                (min..=max).contains(&value).then_some(Value::Int(value)).ok_or_else(wrong)
            }
            ParameterKind::Float { min, max, .. } => {
                let value = given.as_f64().ok_or_else(wrong)?;
                (min..=max).contains(&value).then_some(Value::Float(value)).ok_or_else(wrong)
            }
            ParameterKind::IntList { min, max, .. } => {
                let items = given.as_array().ok_or_else(wrong)?;
                let values: Vec<i64> = items.iter().map(integer).collect::<Option<_>>().ok_or_else(wrong)?;
                let fits = (1..=MAX_LIST).contains(&values.len()) && values.iter().all(|v| (min..=max).contains(v));
                fits.then_some(Value::IntList(values)).ok_or_else(wrong)
            }
            ParameterKind::Choice { choices, .. } => {
                let given = given.as_str().ok_or_else(wrong)?;
                choices.iter().find(|choice| **choice == given).map(|choice| Value::Choice(choice)).ok_or_else(wrong)
            }
        }
    }
}

/// The integer of a JSON number, which may be written as `3.0`.
fn integer(given: &Json) -> Option<i64> {
    given.as_i64().or_else(|| given.as_f64().filter(|v| v.fract() == 0.0 && v.abs() < 1e15).map(|v| v as i64))
}

#[derive(Clone, Debug, PartialEq)]
enum Value {
    Bool(bool),
    Int(i64),
    Float(f64),
    IntList(Vec<i64>),
    Choice(&'static str),
}

/// A complete and valid set of reset parameters: the given values, and defaults for all others; and the arguments of the id.
#[derive(Clone, Debug, PartialEq)]
pub struct ResetParameters {
    id: &'static str,
    values: Vec<(&'static str, Value)>,
}

impl ResetParameters {
    /// Validates `given` against `parameters` and adds the defaults, also those of `arguments`.
    pub(super) fn new(
        id: &'static str,
        parameters: &'static [Parameter],
        arguments: &'static [Parameter],
        given: &Map<String, Json>,
    ) -> Result<Self, ParameterError> {
        if let Some(name) = given.keys().find(|name| parameters.iter().all(|p| p.name != name.as_str())) {
            let allowed = parameters.iter().map(|p| p.name).collect::<Vec<_>>().join(", ");
            return Err(ParameterError::Unknown { id, name: name.clone(), allowed });
        }
        let values = parameters
            .iter()
            .map(|p| Ok((p.name, given.get(p.name).map_or_else(|| Ok(p.default_value()), |v| p.parse(v))?)))
            .chain(arguments.iter().map(|argument| Ok((argument.name, argument.default_value()))))
            .collect::<Result<_, _>>()?;
        Ok(ResetParameters { id, values })
    }

    /// The environment id that they are for.
    pub fn id(&self) -> &'static str {
        self.id
    }

    fn value(&self, name: &str) -> Option<&Value> {
        self.values.iter().find(|(n, _)| *n == name).map(|(_, v)| v)
    }

    /// The flag with that name; `absent` if the environment does not have it.
    pub fn bool(&self, name: &str, absent: bool) -> bool {
        if let Some(Value::Bool(value)) = self.value(name) { *value } else { absent }
    }

    /// The integer with that name; `absent` if the environment does not have it.
    pub fn int(&self, name: &str, absent: i64) -> i64 {
        if let Some(Value::Int(value)) = self.value(name) { *value } else { absent }
    }

    /// The number with that name; `absent` if the environment does not have it.
    pub fn float(&self, name: &str, absent: f64) -> f64 {
        if let Some(Value::Float(value)) = self.value(name) { *value } else { absent }
    }

    /// The list with that name; empty if the environment does not have it.
    pub fn int_list(&self, name: &str) -> Vec<i64> {
        if let Some(Value::IntList(value)) = self.value(name) { value.clone() } else { Vec::new() }
    }

    /// The word with that name; empty if the environment does not have it.
    pub fn choice(&self, name: &str) -> &'static str {
        if let Some(Value::Choice(value)) = self.value(name) { value } else { "" }
    }
}

/// An invalid reset parameter.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum ParameterError {
    /// The environment has no reset parameter with this name.
    #[error("{id} has no reset parameter `{name}`; it has {allowed}")]
    Unknown {
        id: &'static str,
        name: String,
        /// The environment's reset parameters, separated by commas.
        allowed: String,
    },
    /// The value has the wrong type or is out of range.
    #[error("reset parameter `{name}` must be {allowed}, got {value}")]
    Value {
        name: &'static str,
        value: String,
        /// Allowed type and range as text.
        allowed: String,
    },
    /// The id has no argument with this name.
    #[error("{id} has no argument `{name}`; it has {allowed}")]
    UnknownArgument {
        /// The id without arguments.
        id: &'static str,
        /// The given name.
        name: String,
        /// The id's arguments, separated by commas.
        allowed: String,
    },
    /// The value of an argument of an id has the wrong type or is out of range.
    #[error("argument `{name}` must be {allowed}, got {value}")]
    Argument {
        /// The argument's name.
        name: &'static str,
        /// The given value.
        value: String,
        /// Allowed type and range as text.
        allowed: String,
    },
}
