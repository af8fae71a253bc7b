//! The commands of Mortar Mayhem: where they lead, what they look like, and when each is shown.

use serde::{Deserialize, Serialize};

use crate::raster::{Rgb, Sprite, Surface};

/// Number of commands that there are.
pub const COMMANDS: usize = 9;

/// Most commands of an id with a vector observation.
pub const MAX_VECTOR_COMMANDS: usize = 20;

/// Scale of the command pictures relative to the original's 336 pixel screen.
const SCALE: f64 = 0.25;
const WHITE: Rgb = [255, 255, 255];
const BLACK: Rgb = [0, 0, 0];

/// A command, by its number in the original's order; `allowed_commands` counts from the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Command(u8);

/// What is fixed about a command.
struct Kind {
    /// Tiles to the right and down.
    offset: (i32, i32),
    /// Counterclockwise turn of the arrow that points right, in degrees; `None` is drawn as a crossed circle.
    angle: Option<i32>,
    /// Place in a one-hot vector observation.
    one_hot: usize,
}

const fn kind(offset: (i32, i32), angle: Option<i32>, one_hot: usize) -> Kind {
    Kind { offset, angle, one_hot }
}

/// right, down, left, up, stay, right down, right up, left down, left up.
const KINDS: [Kind; COMMANDS] = [
    kind((1, 0), Some(0), 1),
    kind((0, 1), Some(270), 4),
    kind((-1, 0), Some(180), 2),
    kind((0, -1), Some(90), 3),
    kind((0, 0), None, 0),
    kind((1, 1), Some(315), 5),
    kind((1, -1), Some(45), 6),
    kind((-1, 1), Some(225), 7),
    kind((-1, -1), Some(135), 8),
];

impl Command {
    /// The first `count` commands in the original's order.
    pub fn first(count: usize) -> impl Iterator<Item = Command> {
        (0..count.min(COMMANDS) as u8).map(Command)
    }

    /// The command of that number, which is taken modulo their count.
    pub fn from_index(index: usize) -> Command {
        Command((index % COMMANDS) as u8)
    }

    /// Whether there is such a command; a broken snapshot may hold any number.
    pub fn is_valid(self) -> bool {
        self.index() < COMMANDS
    }

    /// Its number in the original's order.
    pub fn index(self) -> usize {
        usize::from(self.0)
    }

    /// Its place in a one-hot vector observation.
    pub fn one_hot(self) -> usize {
        KINDS[self.index()].one_hot
    }

    /// The command at that place of a one-hot vector observation.
    pub fn from_one_hot(place: usize) -> Option<Command> {
        KINDS.iter().position(|kind| kind.one_hot == place).map(Command::from_index)
    }

    /// The tile that it leads to from `tile`.
    pub fn apply(self, tile: (i32, i32)) -> (i32, i32) {
        let (x, y) = KINDS[self.index()].offset;
        (tile.0 + x, tile.1 + y)
    }
}

/// Side of an unrotated command picture in pixels.
pub const PICTURE_SIZE: i32 = (88.0 * SCALE) as i32;

/// The pictures of all commands, by number.
pub fn pictures() -> [Sprite; COMMANDS] {
    let pixels = |length: f64| (length * SCALE) as i32;
    std::array::from_fn(|index| {
        let mut surface = Surface::new(PICTURE_SIZE as usize, PICTURE_SIZE as usize);
        surface.fill(BLACK);
        surface.set_color_key(Some(BLACK));
        let width = pixels(8.0);
        match KINDS[index].angle {
            None => {
                let radius = PICTURE_SIZE / 2 - pixels(4.0);
                let (x, y) = (PICTURE_SIZE - pixels(12.0), PICTURE_SIZE / 2 - pixels(8.0));
                surface.draw_circle(WHITE, (radius, radius), radius, width);
                surface.draw_line(WHITE, (0, y), (x, y), width);
            }
            Some(angle) => {
                let (tail, tip, middle) = (pixels(2.0), pixels(80.0), pixels(40.0));
                surface.draw_line(WHITE, (tail, middle), (tip, middle), width);
                surface.draw_line(WHITE, (tip, middle), (middle, 0), width);
                surface.draw_line(WHITE, (tip, middle), (middle, tip), width);
                surface = surface.rotate(angle);
            }
        }
        Sprite::new(&surface)
    })
}

/// The schedule by which commands are shown: each for `duration` frames, and nothing for `delay` frames after it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Clue {
    /// Number in the sequence of the first command to show.
    first: usize,
    duration: usize,
    delay: usize,
    frame: usize,
    frames: usize,
}

impl Clue {
    /// Shows `count` commands of the sequence, from number `first` on.
    pub fn new(first: usize, count: usize, duration: usize, delay: usize) -> Self {
        Clue { first, duration, delay, frame: 0, frames: count * (duration + delay) }
    }

    /// Whether its numbers are such that it can be gone through.
    pub fn is_valid(&self) -> bool {
        const MANY: u64 = 1 << 32;
        [self.first, self.duration, self.delay, self.frame, self.frames].iter().all(|number| (*number as u64) < MANY)
            && (self.frames == 0 || self.duration + self.delay > 0)
    }

    /// Whether everything has been shown.
    pub fn is_over(&self) -> bool {
        self.frame >= self.frames
    }

    /// Goes on by one frame: the number in the sequence of the command that it shows, if any. Not to be called once it is over.
    pub fn next_frame(&mut self) -> Option<usize> {
        let period = self.duration + self.delay;
        let frame = self.frame;
        self.frame += 1;
        (!self.is_over_at(frame) && frame % period < self.duration).then(|| self.first + frame / period)
    }

    fn is_over_at(&self, frame: usize) -> bool {
        frame >= self.frames
    }
}
