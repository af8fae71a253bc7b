//! Action spaces, and the check of actions.

use std::borrow::Cow;
use std::fmt;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Action space of an environment, named after Gymnasium's spaces. In JSON, `{"Discrete": 4}` or `{"MultiDiscrete": [3, 3]}`.
///
/// An action is one `i32` for each branch, from 0 to less than the branch's number of choices. Deserialising rejects a space
/// without branches, and a branch without choices.
///
/// ```
/// use endless_gym_core::envs::ActionSpace;
///
/// let space = ActionSpace::multi_discrete(&[3, 3]);
/// assert!(space.check(2, &[0, 2, 1, 1]).is_ok());
/// assert_eq!(
///     space.check(2, &[0, 2, 3, 1]).unwrap_err().to_string(),
///     "the action of environment 1 must be in MultiDiscrete([3, 3]), got [3, 1]"
/// );
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "ActionSpaceFields")]
pub enum ActionSpace {
    /// One branch with this number of choices.
    Discrete(i32),
    /// Several branches, each with its own number of choices.
    MultiDiscrete(Cow<'static, [i32]>),
}

impl ActionSpace {
    /// [`ActionSpace::MultiDiscrete`] from a constant list.
    pub const fn multi_discrete(branches: &'static [i32]) -> Self {
        ActionSpace::MultiDiscrete(Cow::Borrowed(branches))
    }

    /// Number of choices of each branch.
    pub fn branches(&self) -> &[i32] {
        match self {
            ActionSpace::Discrete(n) => std::slice::from_ref(n),
            ActionSpace::MultiDiscrete(branches) => branches,
        }
    }

    /// Checks the actions of `num_envs` environments: for each, a row with one number for each branch.
    ///
    /// # Errors
    ///
    /// [`ActionError`] if there are too few or too many numbers, or if one is out of its branch's range.
    pub fn check(&self, num_envs: usize, actions: &[i32]) -> Result<(), ActionError> {
        let branches = self.branches();
        if Some(actions.len()) != num_envs.checked_mul(branches.len()) {
            return Err(ActionError::Count { given: actions.len(), num_envs, branches: branches.len() });
        }
        let fits = |action: &[i32]| action.iter().zip(branches).all(|(a, n)| (0..*n).contains(a));
        match actions.chunks_exact(branches.len().max(1)).enumerate().find(|(_, action)| !fits(action)) {
            None => Ok(()),
            Some((env, action)) => Err(ActionError::Range { env, given: action.to_vec(), space: self.to_string() }),
        }
    }
}

impl fmt::Display for ActionSpace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ActionSpace::Discrete(n) => write!(f, "Discrete({n})"),
            ActionSpace::MultiDiscrete(branches) => write!(f, "MultiDiscrete({branches:?})"),
        }
    }
}

/// An action space as in JSON.
#[derive(Deserialize)]
#[serde(rename = "ActionSpace")]
enum ActionSpaceFields {
    Discrete(i32),
    MultiDiscrete(Vec<i32>),
}

impl TryFrom<ActionSpaceFields> for ActionSpace {
    type Error = InvalidActionSpace;

    fn try_from(fields: ActionSpaceFields) -> Result<Self, InvalidActionSpace> {
        let space = match fields {
            ActionSpaceFields::Discrete(n) => ActionSpace::Discrete(n),
            ActionSpaceFields::MultiDiscrete(branches) => ActionSpace::MultiDiscrete(branches.into()),
        };
        let branches = space.branches();
        if branches.is_empty() || branches.iter().any(|choices| *choices < 1) {
            return Err(InvalidActionSpace { given: space.to_string() });
        }
        Ok(space)
    }
}

/// An action space has no branch, or a branch without choices.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("an action space must have at least one branch, and each at least one choice, got {given}")]
pub struct InvalidActionSpace {
    /// The space that was given.
    pub given: String,
}

/// There are too few or too many actions, or one is out of range.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum ActionError {
    /// Too few or too many numbers.
    #[error(
        "actions must be a row of length {branches} for each of {num_envs} environments, {} numbers in all, got {given}",
        num_envs.saturating_mul(*branches)
    )]
    Count {
        /// The length that was given.
        given: usize,
        /// Number of environments.
        num_envs: usize,
        /// Number of branches of the action space.
        branches: usize,
    },
    /// A number is out of its branch's range.
    #[error("the action of environment {env} must be in {space}, got {given:?}")]
    Range {
        /// Number of the first environment with such an action.
        env: usize,
        /// Its action.
        given: Vec<i32>,
        /// The action space.
        space: String,
    },
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn spaces_survive_json() {
        for (space, json) in [
            (ActionSpace::Discrete(4), json!({"Discrete": 4})),
            (ActionSpace::multi_discrete(&[3, 5]), json!({"MultiDiscrete": [3, 5]})),
        ] {
            assert_eq!(serde_json::to_value(&space).unwrap(), json);
            assert_eq!(serde_json::from_value::<ActionSpace>(json).unwrap(), space);
        }
    }

    #[test]
    fn spaces_without_a_choice_are_refused() {
        for (json, shown) in [
            (json!({"Discrete": 0}), "Discrete(0)"),
            (json!({"MultiDiscrete": []}), "MultiDiscrete([])"),
            (json!({"MultiDiscrete": [3, -1]}), "MultiDiscrete([3, -1])"),
        ] {
            let message = serde_json::from_value::<ActionSpace>(json).unwrap_err().to_string();
            assert!(message.ends_with(&format!("got {shown}")), "{message}");
        }
        assert!(serde_json::from_value::<ActionSpace>(json!({"Box": 3})).is_err());
    }

    #[test]
    fn wrong_actions_are_refused() {
        let space = ActionSpace::Discrete(4);
        assert_eq!(space.check(3, &[0, 3, 1]), Ok(()));
        assert_eq!(space.check(2, &[0, 3, 1]), Err(ActionError::Count { given: 3, num_envs: 2, branches: 1 }));
        assert_eq!(
            space.check(2, &[]).unwrap_err().to_string(),
            "actions must be a row of length 1 for each of 2 environments, 2 numbers in all, got 0"
        );
        for (env, wrong) in [(0, [-1, 0]), (1, [0, 4]), (1, [3, i32::MIN])] {
            let error = space.check(2, &wrong).unwrap_err();
            assert!(matches!(error, ActionError::Range { env: found, .. } if found == env), "{error}");
        }
        assert!(space.check(usize::MAX, &[0]).is_err());
        let none = ActionSpace::multi_discrete(&[]);
        assert_eq!(none.check(usize::MAX, &[]), Ok(()));
        assert!(none.check(1, &[0]).is_err());
    }
}
