//! The commands of Mortar Mayhem.

use serde::{Deserialize, Serialize};

/// Number of different commands.
pub const COMMANDS: usize = 9;

/// Maximum number of commands of an id with a vector observation.
pub const MAX_VECTOR_COMMANDS: usize = 20;

/// A command, by its number in the original's order; `allowed_commands` counts from the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Command(u8);

/// The properties of a command.
struct Properties {
    /// The movement in tiles, to the right and down.
    offset: (i32, i32),
    /// Counterclockwise turn of the arrow, in degrees from right; `None` is shown as a crossed circle.
    angle: Option<i32>,
    /// Index in a one-hot vector observation.
    one_hot: usize,
}

const fn command(offset: (i32, i32), angle: Option<i32>, one_hot: usize) -> Properties {
    Properties { offset, angle, one_hot }
}

/// right, down, left, up, stay, right down, right up, left down, left up.
const PROPERTIES: [Properties; COMMANDS] = [
    command((1, 0), Some(0), 1),
    command((0, 1), Some(270), 4),
    command((-1, 0), Some(180), 2),
    command((0, -1), Some(90), 3),
    command((0, 0), None, 0),
    command((1, 1), Some(315), 5),
    command((1, -1), Some(45), 6),
    command((-1, 1), Some(225), 7),
    command((-1, -1), Some(135), 8),
];

impl Command {
    /// The first `count` commands in the original's order.
    pub fn first(count: usize) -> impl Iterator<Item = Command> {
        (0..count.min(COMMANDS) as u8).map(Command)
    }

    /// The command with this number, modulo [`COMMANDS`].
    pub fn from_index(index: usize) -> Command {
        Command((index % COMMANDS) as u8)
    }

    /// The command's number in the original's order, from 0.
    pub fn index(self) -> usize {
        usize::from(self.0)
    }

    /// Turn of the arrow that shows the command, counterclockwise from right in degrees; `None` is shown as a crossed
    /// circle.
    pub fn angle(self) -> Option<i32> {
        PROPERTIES[self.index()].angle
    }

    /// The command's index in a one-hot vector observation.
    pub fn one_hot(self) -> usize {
        PROPERTIES[self.index()].one_hot
    }

    /// The command at an index of a one-hot vector observation.
    pub fn from_one_hot(place: usize) -> Option<Command> {
        PROPERTIES.iter().position(|command| command.one_hot == place).map(Command::from_index)
    }

    /// The tile that the command leads to from `tile`.
    pub fn apply(self, tile: (i32, i32)) -> (i32, i32) {
        let (x, y) = PROPERTIES[self.index()].offset;
        (tile.0 + x, tile.1 + y)
    }
}
