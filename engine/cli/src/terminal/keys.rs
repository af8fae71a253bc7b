//! Turns keys into commands, and says which directions are held.
//!
//! Most terminals report that a key was pressed, repeatedly while it is down, but not that it was released. A key acts
//! in at least one step, until a short time after its last report. In terminals with the kitty keyboard protocol, which
//! reports releases, a key acts while it is down.

use std::time::{Duration, Instant};

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

/// A direction of movement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    Left,
    Right,
    Up,
    Down,
}

use Direction::{Down, Left, Right, Up};

/// What a key does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// A movement; two directions make a diagonal.
    Move(&'static [Direction]),
    /// The end of a movement.
    Stop(&'static [Direction]),
    /// A digit.
    Digit(i32),
    /// Selects the next number.
    Select,
    /// A step with the chosen action.
    Play,
    Pause,
    OneStep,
    Restart,
    NextSeed,
    PreviousSeed,
    Quit,
}

/// The command of a key's event.
pub fn command(event: KeyEvent) -> Option<Command> {
    let moved: &[Direction] = match event.code {
        KeyCode::Char('c') if event.modifiers.contains(KeyModifiers::CONTROL) => return Some(Command::Quit),
        KeyCode::Left => &[Left],
        KeyCode::Right => &[Right],
        KeyCode::Up => &[Up],
        KeyCode::Down => &[Down],
        KeyCode::Char(letter) => match letter.to_ascii_lowercase() {
            'a' => &[Left],
            'd' => &[Right],
            'w' => &[Up],
            's' => &[Down],
            'q' => &[Left, Up],
            'e' => &[Right, Up],
            'z' => &[Left, Down],
            'c' => &[Right, Down],
            _ => &[],
        },
        _ => &[],
    };
    match (event.kind, moved) {
        (KeyEventKind::Release, []) => return None,
        (KeyEventKind::Release, moved) => return Some(Command::Stop(moved)),
        (_, []) => {}
        (_, moved) => return Some(Command::Move(moved)),
    }
    match event.code {
        KeyCode::Char(digit @ '0'..='9') => Some(Command::Digit(digit as i32 - '0' as i32)),
        KeyCode::Tab => Some(Command::Select),
        KeyCode::Enter => Some(Command::Play),
        KeyCode::Char(' ' | 'p' | 'P') => Some(Command::Pause),
        KeyCode::Char('n' | 'N') => Some(Command::OneStep),
        KeyCode::Char('r' | 'R') => Some(Command::Restart),
        KeyCode::PageUp => Some(Command::NextSeed),
        KeyCode::PageDown => Some(Command::PreviousSeed),
        KeyCode::Esc => Some(Command::Quit),
        _ => None,
    }
}

/// A key that is held.
#[derive(Clone, Copy, Debug)]
struct Held {
    direction: Direction,
    pressed: Instant,
    /// Whether it has acted in a step since it was last reported.
    has_acted: bool,
    is_released: bool,
}

/// The directions that are held, in the order in which they were pressed.
#[derive(Debug)]
pub struct Keys {
    hold: Duration,
    held: Vec<Held>,
    /// Whether the terminal reports releases.
    has_releases: bool,
}

impl Keys {
    /// `hold` is how long a key acts after it was last reported.
    pub fn new(hold: Duration) -> Self {
        Keys { hold, held: Vec::new(), has_releases: false }
    }

    /// Directions were pressed at that time. They replace those of earlier steps, unless the terminal reports releases.
    pub fn press(&mut self, directions: &[Direction], now: Instant) {
        let opposite = |direction| match direction {
            Left => Right,
            Right => Left,
            Up => Down,
            Down => Up,
        };
        let has_releases = self.has_releases;
        self.held.retain(|held| {
            let is_replaced = directions.iter().any(|new| held.direction == *new || held.direction == opposite(*new));
            !is_replaced && (has_releases || !held.has_acted)
        });
        let new =
            |direction: &Direction| Held { direction: *direction, pressed: now, has_acted: false, is_released: false };
        self.held.extend(directions.iter().map(new));
    }

    /// Directions were released. A key that has not acted yet still acts in the next step.
    pub fn release(&mut self, directions: &[Direction]) {
        self.has_releases = true;
        for held in self.held.iter_mut().filter(|held| directions.contains(&held.direction)) {
            held.is_released = true;
        }
        self.held.retain(|held| !(held.is_released && held.has_acted));
    }

    /// Releases all keys.
    pub fn clear(&mut self) {
        self.held.clear();
    }

    /// The directions that act in a step at that time, in the order in which they were pressed.
    pub fn act(&mut self, now: Instant) -> Vec<Direction> {
        let Keys { hold, has_releases, .. } = *self;
        self.held.retain(|held| {
            let is_held = if has_releases { !held.is_released } else { now.duration_since(held.pressed) < hold };
            !held.has_acted || is_held
        });
        self.held.iter_mut().for_each(|held| held.has_acted = true);
        self.held.iter().map(|held| held.direction).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOLD: Duration = Duration::from_millis(150);

    fn after(start: Instant, milliseconds: u64) -> Instant {
        start + Duration::from_millis(milliseconds)
    }

    #[test]
    fn a_key_acts_at_least_once_and_while_it_is_reported() {
        let start = Instant::now();
        let mut keys = Keys::new(HOLD);
        keys.press(&[Left], start);
        assert_eq!(keys.act(after(start, 400)), [Left], "a step that comes late");
        assert_eq!(keys.act(after(start, 440)), []);
        keys.press(&[Left], after(start, 500));
        keys.press(&[Left], after(start, 530));
        assert_eq!(keys.act(after(start, 540)), [Left]);
        assert_eq!(keys.act(after(start, 670)), [Left]);
        assert_eq!(keys.act(after(start, 690)), []);
        let mut grid = Keys::new(Duration::ZERO);
        grid.press(&[Left], start);
        assert_eq!(grid.act(start), [Left]);
        assert_eq!(grid.act(start), []);
    }

    #[test]
    fn a_new_direction_replaces_the_old_one_unless_pressed_in_the_same_step() {
        let start = Instant::now();
        let mut keys = Keys::new(HOLD);
        keys.press(&[Left], start);
        keys.press(&[Up], start);
        assert_eq!(keys.act(start), [Left, Up]);
        keys.press(&[Down], after(start, 20));
        assert_eq!(keys.act(after(start, 30)), [Down]);
        keys.press(&[Right], after(start, 40));
        assert_eq!(keys.act(after(start, 50)), [Right]);
        keys.press(&[Left, Up], after(start, 60));
        assert_eq!(keys.act(after(start, 70)), [Left, Up]);
        keys.clear();
        assert_eq!(keys.act(after(start, 80)), []);
    }

    #[test]
    fn reported_releases_end_a_movement() {
        let start = Instant::now();
        let mut keys = Keys::new(HOLD);
        keys.press(&[Left], start);
        keys.release(&[Left]);
        assert_eq!(keys.act(start), [Left], "a short press acts once");
        assert_eq!(keys.act(start), []);
        keys.press(&[Right], start);
        assert_eq!(keys.act(after(start, 5000)), [Right]);
        keys.press(&[Up], after(start, 5001));
        assert_eq!(keys.act(after(start, 9000)), [Right, Up], "both are down");
        keys.release(&[Right]);
        assert_eq!(keys.act(after(start, 9000)), [Up]);
    }

    #[test]
    fn keys_have_commands() {
        let press = |code| command(KeyEvent::new(code, KeyModifiers::NONE));
        assert_eq!(press(KeyCode::Char('W')), Some(Command::Move(&[Up])));
        assert_eq!(press(KeyCode::Char('c')), Some(Command::Move(&[Right, Down])));
        assert_eq!(command(KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL)), Some(Command::Quit));
        assert_eq!(press(KeyCode::PageDown), Some(Command::PreviousSeed));
        assert_eq!(press(KeyCode::Char('7')), Some(Command::Digit(7)));
        assert_eq!(press(KeyCode::Char('y')), None);
        let release = |code| command(KeyEvent::new_with_kind(code, KeyModifiers::NONE, KeyEventKind::Release));
        assert_eq!(release(KeyCode::Left), Some(Command::Stop(&[Left])));
        assert_eq!(release(KeyCode::Esc), None);
    }
}
