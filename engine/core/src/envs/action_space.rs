//! Action spaces, and the check of actions.

use std::borrow::Cow;
use std::fmt;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::random::Generator;

/// Finite bounds within those of a box, for random numbers: an infinite one is `width` away from the other, or from 0 if both
/// are infinite.
pub fn finite_bounds(low: f32, high: f32, width: f32) -> (f32, f32) {
    match (low.is_finite(), high.is_finite()) {
        (true, true) => (low, high),
        (true, false) => (low, low + width),
        (false, true) => (high - width, high),
        (false, false) => (-width, width),
    }
}

/// Action space of an environment, named after Gymnasium's spaces. In JSON, `{"Discrete": 4}`, `{"MultiDiscrete": [3, 3]}` or
/// `{"Box": {"low": [-2.0], "high": [2.0]}}`, where null is an infinite bound.
///
/// An action is one `i32` for each branch, from 0 to less than the branch's number of choices. In a [`Box`](ActionSpace::Box), it is
/// the bits of one `f32` for each dimension, which [`box_action`] reads. Deserialising rejects a space without branches or dimensions,
/// a branch without choices, and a dimension whose lower bound is not below its upper bound.
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "ActionSpaceFields")]
pub enum ActionSpace {
    /// One branch with this number of choices.
    Discrete(i32),
    /// Several branches, each with its own number of choices.
    MultiDiscrete(Cow<'static, [i32]>),
    /// One float32 for each dimension. The environment clips numbers beyond the bounds, as Gymnasium's environments do.
    Box {
        /// Lower bounds.
        low: Cow<'static, [f32]>,
        /// Upper bounds.
        high: Cow<'static, [f32]>,
    },
}

impl ActionSpace {
    /// [`ActionSpace::MultiDiscrete`] from a constant list.
    pub const fn multi_discrete(branches: &'static [i32]) -> Self {
        ActionSpace::MultiDiscrete(Cow::Borrowed(branches))
    }

    /// [`ActionSpace::Box`] from constant lists of the same length.
    pub const fn bounded(low: &'static [f32], high: &'static [f32]) -> Self {
        ActionSpace::Box { low: Cow::Borrowed(low), high: Cow::Borrowed(high) }
    }

    /// Number of numbers in an action.
    pub fn width(&self) -> usize {
        match self {
            ActionSpace::Discrete(_) => 1,
            ActionSpace::MultiDiscrete(branches) => branches.len(),
            ActionSpace::Box { low, .. } => low.len(),
        }
    }

    /// Number of choices of each branch. A [`Box`](ActionSpace::Box) has no branches.
    pub fn branches(&self) -> &[i32] {
        match self {
            ActionSpace::Discrete(n) => std::slice::from_ref(n),
            ActionSpace::MultiDiscrete(branches) => branches,
            ActionSpace::Box { .. } => &[],
        }
    }

    /// Checks the actions of `num_envs` environments, one row of [`width`](ActionSpace::width) numbers after the other.
    ///
    /// # Errors
    ///
    /// [`ActionError`] if there are too few or too many numbers, if one is outside its branch's range, or if one of a
    /// [`Box`](ActionSpace::Box) is not a number.
    pub fn check(&self, num_envs: usize, actions: &[i32]) -> Result<(), ActionError> {
        let width = self.width();
        if Some(actions.len()) != num_envs.checked_mul(width) {
            return Err(ActionError::Count { given: actions.len(), num_envs, width });
        }
        if self.contains(actions) {
            return Ok(());
        }
        match actions.chunks_exact(width.max(1)).enumerate().find(|(_, action)| !self.contains(action)) {
            None => Ok(()),
            Some((env, action)) => Err(ActionError::Range { env, given: self.shown(action), space: self.to_string() }),
        }
    }

    /// Whether rows of [`width`](ActionSpace::width) numbers are all in the space. Tests every number, so that it compiles to vector
    /// instructions: a pool's other threads wait for it.
    fn contains(&self, actions: &[i32]) -> bool {
        let fits = |action: &i32, choices: &i32| (0..*choices).contains(action);
        match self.branches() {
            [] => box_action(actions).iter().fold(true, |all, number| all & !number.is_nan()),
            [n] => actions.iter().fold(true, |all, a| all & fits(a, n)),
            [m, n] => actions.as_chunks().0.iter().fold(true, |all, [a, b]| all & fits(a, m) & fits(b, n)),
            branches => actions.chunks_exact(branches.len()).all(|a| a.iter().zip(branches).all(|(a, n)| fits(a, n))),
        }
    }

    /// A uniformly random action. Infinite bounds of a box are replaced by [`finite_bounds`] with a width of 1000.
    pub fn sample(&self, random: &mut Generator) -> Vec<i32> {
        match self {
            ActionSpace::Box { low, high } => {
                let bounds = low.iter().zip(high.iter()).map(|(low, high)| finite_bounds(*low, *high, 1e3));
                bounds.map(|(low, high)| (low + random.random_f32() * (high - low)).to_bits().cast_signed()).collect()
            }
            _ => self.branches().iter().map(|choices| random.integers(0, i64::from(*choices)) as i32).collect(),
        }
    }

    fn shown(&self, action: &[i32]) -> String {
        match self {
            ActionSpace::Box { .. } => format!("{:?}", box_action(action)),
            _ => format!("{action:?}"),
        }
    }
}

/// The numbers of an action in a [`Box`](ActionSpace::Box).
pub fn box_action(action: &[i32]) -> &[f32] {
    bytemuck::cast_slice(action)
}

impl fmt::Display for ActionSpace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ActionSpace::Discrete(n) => write!(f, "Discrete({n})"),
            ActionSpace::MultiDiscrete(branches) => write!(f, "MultiDiscrete({branches:?})"),
            ActionSpace::Box { low, high } => write!(f, "Box({low:?}, {high:?})"),
        }
    }
}

/// An action space in JSON.
#[derive(Deserialize)]
#[serde(rename = "ActionSpace")]
enum ActionSpaceFields {
    Discrete(i32),
    MultiDiscrete(Vec<i32>),
    Box { low: Vec<Option<f32>>, high: Vec<Option<f32>> },
}

impl TryFrom<ActionSpaceFields> for ActionSpace {
    type Error = InvalidActionSpace;

    fn try_from(fields: ActionSpaceFields) -> Result<Self, InvalidActionSpace> {
        let space = match fields {
            ActionSpaceFields::Discrete(n) => ActionSpace::Discrete(n),
            ActionSpaceFields::MultiDiscrete(branches) => ActionSpace::MultiDiscrete(branches.into()),
            ActionSpaceFields::Box { low, high } => {
                let bounds =
                    |given: Vec<Option<f32>>, none: f32| given.into_iter().map(|bound| bound.unwrap_or(none)).collect();
                ActionSpace::Box { low: bounds(low, f32::NEG_INFINITY), high: bounds(high, f32::INFINITY) }
            }
        };
        let is_valid = match &space {
            ActionSpace::Box { low, high } => {
                low.len() == high.len() && low.iter().zip(high.iter()).all(|(low, high)| low < high)
            }
            _ => space.branches().iter().all(|choices| *choices >= 1),
        };
        if space.width() == 0 || !is_valid {
            return Err(InvalidActionSpace { given: space.to_string() });
        }
        Ok(space)
    }
}

/// The action space has no branch or dimension, a branch without choices, or a dimension without a range.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error(
    "an action space must have at least one branch, each with at least one choice, or a lower bound below the upper bound for each \
     dimension, got {given}"
)]
pub struct InvalidActionSpace {
    /// The space that was given.
    pub given: String,
}

/// There are too few or too many actions, or one is out of range.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum ActionError {
    /// Too few or too many numbers.
    #[error(
        "actions must be a row of length {width} for each of {num_envs} environments, {} numbers in all, got {given}",
        num_envs.saturating_mul(*width)
    )]
    Count { given: usize, num_envs: usize, width: usize },
    /// A number is out of its branch's range, or not a number.
    #[error("the action of environment {env} must be in {space}, got {given}")]
    Range { env: usize, given: String, space: String },
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn random_numbers_are_within_the_bounds_of_a_box() {
        const LOW: &[f32] = &[2000.0, 5.0, f32::NEG_INFINITY];
        const HIGH: &[f32] = &[3000.0, f32::INFINITY, -5.0];
        let (space, mut random) = (ActionSpace::bounded(LOW, HIGH), Generator::from_seed(1));
        for _ in 0..100 {
            let action = space.sample(&mut random);
            let mut numbers = box_action(&action).iter().zip(LOW.iter().zip(HIGH));
            assert!(numbers.all(|(number, (low, high))| (*low..=*high).contains(number)));
        }
    }

    #[test]
    fn spaces_survive_json() {
        for (space, json) in [
            (ActionSpace::Discrete(4), json!({"Discrete": 4})),
            (ActionSpace::multi_discrete(&[3, 5]), json!({"MultiDiscrete": [3, 5]})),
            (
                ActionSpace::bounded(&[-2.0, f32::NEG_INFINITY], &[2.5, f32::INFINITY]),
                json!({"Box": {"low": [-2.0, null], "high": [2.5, null]}}),
            ),
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
            (json!({"Box": {"low": [], "high": []}}), "Box([], [])"),
            (json!({"Box": {"low": [0.0], "high": [1.0, 2.0]}}), "Box([0.0], [1.0, 2.0])"),
            (json!({"Box": {"low": [1.0], "high": [1.0]}}), "Box([1.0], [1.0])"),
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
        assert_eq!(space.check(2, &[0, 3, 1]), Err(ActionError::Count { given: 3, num_envs: 2, width: 1 }));
        assert_eq!(
            space.check(2, &[]).unwrap_err().to_string(),
            "actions must be a row of length 1 for each of 2 environments, 2 numbers in all, got 0"
        );
        for (env, wrong) in [(0, [-1, 0]), (1, [0, 4]), (1, [3, i32::MIN])] {
            let error = space.check(2, &wrong).unwrap_err();
            assert!(matches!(error, ActionError::Range { env: found, .. } if found == env), "{error}");
        }
        for branches in [&[3] as &[i32], &[3, 2], &[3, 2, 4]] {
            let (space, width) = (ActionSpace::MultiDiscrete(branches.into()), branches.len());
            let highest: Vec<i32> = branches.iter().map(|choices| choices - 1).cycle().take(40 * width).collect();
            assert_eq!(space.check(40, &highest), Ok(()));
            for place in 0..highest.len() {
                for wrong in [branches[place % width], -1, i32::MIN] {
                    let mut actions = highest.clone();
                    actions[place] = wrong;
                    let error = space.check(40, &actions).unwrap_err();
                    assert!(matches!(error, ActionError::Range { env, .. } if env == place / width), "{error}");
                }
            }
        }
        let space = ActionSpace::bounded(&[-2.0, -2.0], &[2.0, 2.0]);
        let bits = |numbers: [f32; 2]| numbers.map(|number| number.to_bits() as i32);
        assert_eq!(box_action(&bits([0.5, -3.0])), [0.5, -3.0]);
        assert_eq!(space.check(1, &bits([0.5, -3.0])), Ok(()));
        assert_eq!(
            space.check(1, &bits([f32::NAN, 0.0])).unwrap_err().to_string(),
            "the action of environment 0 must be in Box([-2.0, -2.0], [2.0, 2.0]), got [NaN, 0.0]"
        );
        assert!(space.check(usize::MAX, &[0]).is_err());
        let none = ActionSpace::multi_discrete(&[]);
        assert_eq!(none.check(usize::MAX, &[]), Ok(()));
        assert!(none.check(1, &[0]).is_err());
    }
}
