//! Names that several families share.

use endless_gym_core::envs::{ActionBranch, Choice, Column, OriginalTypes, RewardType};

/// The ids of a family: easy, medium, hard.
macro_rules! ids {
    ($name:literal) => {
        [
            concat!("popgym-", $name, "Easy-v0"),
            concat!("popgym-", $name, "Medium-v0"),
            concat!("popgym-", $name, "Hard-v0"),
        ]
    };
}
pub(crate) use ids;

/// The place of an id in its family's table; 0 if it is not there.
pub fn place(ids: &[&str], id: &str) -> usize {
    ids.iter().position(|known| *known == id).unwrap_or_default()
}

/// Naming a suit.
pub const SUITS: &[ActionBranch] = &[ActionBranch {
    name: "suit",
    choices: &[
        Choice { name: "spades", description: "names spades" },
        Choice { name: "diamonds", description: "names diamonds" },
        Choice { name: "clubs", description: "names clubs" },
        Choice { name: "hearts", description: "names hearts" },
    ],
}];

/// The types of the families whose rewards of 0 are integers.
pub const INTEGER_ZERO: OriginalTypes =
    OriginalTypes { integers: "int64", reward: RewardType::IntegerZero, numpy_floats: &[] };

/// The shape of a part of the state, which is never freed.
pub fn shape(sizes: &[usize]) -> &'static [usize] {
    sizes.to_vec().leak()
}

/// Columns with numbered names. Their text is never freed, so a registry makes them once.
pub fn numbered(name: &str, count: usize, description: &'static str) -> &'static [Column] {
    let columns = (0..count).map(|number| Column { name: format!("{name}_{number}").leak(), description });
    columns.collect::<Vec<_>>().leak()
}
