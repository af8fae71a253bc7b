//! The autoreset modes.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// When the next episode starts after one has ended. The modes are those of Gymnasium's `AutoresetMode`.
///
/// In JSON, in Python and on the command line a mode is given by its [`name`](Autoreset::name).
///
/// ```
/// use endless_gym_core::pool::Autoreset;
///
/// assert_eq!(Autoreset::SameStep.name(), "same_step");
/// assert_eq!("same_step".parse(), Ok(Autoreset::SameStep));
/// assert_eq!(
///     "same-step".parse::<Autoreset>().unwrap_err().to_string(),
///     "autoreset must be `next_step`, `same_step` or `disabled`, got `same-step`"
/// );
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "&'static str")]
pub enum Autoreset {
    /// In the following step, which ignores its action and returns the new episode's first observation with a reward of 0.
    #[default]
    NextStep,
    /// In the same step: the observation is the new episode's first; reward, flags and info belong to the old episode.
    SameStep,
    /// Never: the trainer calls [`Pool::reset`](super::Pool::reset). Until then the episode continues.
    Disabled,
}

impl Autoreset {
    /// All modes.
    pub const ALL: [Autoreset; 3] = [Autoreset::NextStep, Autoreset::SameStep, Autoreset::Disabled];

    /// Gymnasium's name for the mode, in lower case.
    pub const fn name(self) -> &'static str {
        match self {
            Autoreset::NextStep => "next_step",
            Autoreset::SameStep => "same_step",
            Autoreset::Disabled => "disabled",
        }
    }

    /// A one-line description for help texts.
    pub const fn summary(self) -> &'static str {
        match self {
            Autoreset::NextStep => "Start the next episode in the step after the one that ended it",
            Autoreset::SameStep => "Start the next episode in the same step",
            Autoreset::Disabled => "Wait for the trainer to reset",
        }
    }
}

impl fmt::Display for Autoreset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Autoreset {
    type Err = UnknownAutoreset;

    fn from_str(name: &str) -> Result<Self, UnknownAutoreset> {
        let known = Autoreset::ALL.into_iter().find(|mode| mode.name() == name);
        known.ok_or_else(|| UnknownAutoreset { given: name.to_owned() })
    }
}

impl TryFrom<String> for Autoreset {
    type Error = UnknownAutoreset;

    fn try_from(name: String) -> Result<Self, UnknownAutoreset> {
        name.parse()
    }
}

impl From<Autoreset> for &'static str {
    fn from(mode: Autoreset) -> Self {
        mode.name()
    }
}

/// No autoreset mode has this name.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("autoreset must be {}, got `{given}`", names())]
pub struct UnknownAutoreset {
    /// The name that was given.
    pub given: String,
}

/// All names, listed for a sentence.
fn names() -> String {
    let names = Autoreset::ALL.map(|mode| format!("`{mode}`"));
    let [others @ .., last] = &names;
    format!("{} or {last}", others.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_survive_text_and_json() {
        for mode in Autoreset::ALL {
            assert_eq!(mode.name().parse(), Ok(mode));
            let json = serde_json::to_value(mode).unwrap();
            assert_eq!(json, mode.name());
            assert_eq!(serde_json::from_value::<Autoreset>(json).unwrap(), mode);
        }
        for wrong in ["", "NextStep", "next-step", "next_step "] {
            let error = UnknownAutoreset { given: wrong.to_owned() };
            assert_eq!(wrong.parse::<Autoreset>(), Err(error.clone()));
            let json = serde_json::from_value::<Autoreset>(wrong.into());
            assert_eq!(json.unwrap_err().to_string(), error.to_string());
        }
    }
}
