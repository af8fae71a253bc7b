//! Names that several families share.

use endless_gym_core::envs::{ActionBranch, Choice, Column, EnvSpec, OriginalTypes, ParameterError, RewardType, Task};

use crate::pictures::PICTURE;

/// The specifications of a family in its difficulties, which have these arguments and a picture. The id of `family` is the name of the original's class.
pub fn levels<T: Task>(family: EnvSpec, arguments: [&str; 3]) -> Vec<EnvSpec> {
    let level = |(level, arguments)| -> Result<EnvSpec, ParameterError> {
        let id = format!("popgym-{}{level}-v0", family.id).leak();
        let spec = EnvSpec { id, picture: Some(PICTURE), ..family.with_arguments(arguments)? };
        let parameters = T::parameters(&spec.reset_parameters(&Default::default())?);
        T::with_arguments(spec, &parameters)
    };
    let levels = ["Easy", "Medium", "Hard"].into_iter().zip(arguments).map(level);
    levels.collect::<Result<_, _>>().expect("the arguments of the difficulties are valid")
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
pub const INTEGER_ZERO: OriginalTypes = OriginalTypes { reward: RewardType::IntegerZero, ..OriginalTypes::DEFAULT };

/// The shape of a part of the state, which is never freed.
pub fn shape(sizes: &[usize]) -> &'static [usize] {
    sizes.to_vec().leak()
}

/// Columns with numbered names. Their text is never freed, so a registry makes them once.
pub fn numbered(name: &str, count: usize, description: &'static str) -> &'static [Column] {
    let columns = (0..count).map(|number| Column { name: format!("{name}_{number}").leak(), description });
    columns.collect::<Vec<_>>().leak()
}
