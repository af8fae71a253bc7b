//! `endless play --terminal`.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use endless_gym_core::pool::{OptionMap, Registry};
use ratatui::Frame;
use ratatui::crossterm::event::Event;
use ratatui::layout::Rect;

use super::controls::Controls;
use super::game::Game;
use super::keys::{self, Command, Direction, Keys};
use super::picture::fitting;
use super::screen::{Screen, check};
use super::status;
use crate::failure::Failure;
use crate::stop;

/// Longest wait for a key between checks of the stop flag.
const SLICE: Duration = Duration::from_millis(50);

/// How long a key acts after it was last reported, in seconds, and the pace up to which a key is one step instead.
const HOLD: f64 = 0.15;
const SLOW_FPS: u32 = 10;

/// Arguments of `endless play` for the terminal.
#[derive(clap::Args)]
pub struct TerminalArgs {
    /// Play in the terminal, which must show 24-bit colours, at best with 84 columns and 48 lines.
    #[arg(long)]
    pub terminal: bool,
    /// In the terminal: steps per second, 1 to 100 [default: the environment's].
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100), requires = "terminal")]
    fps: Option<u32>,
    /// In the terminal: how long a key acts after the terminal last reported it, in seconds; 0 for one step [default: 0.15; 0 at 10
    /// steps per second or fewer].
    #[arg(long, value_name = "SECONDS", requires = "terminal")]
    hold: Option<f64>,
}

/// A game that keys control.
struct Player {
    game: Game,
    controls: Controls,
    keys: Keys,
    clock: Clock,
    period: Duration,
    /// When the next step is played.
    due: Instant,
}

/// Whether steps are due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Clock {
    /// The episode waits for its first key.
    Waiting,
    Running,
    Paused,
}

/// Plays until a key or a signal ends it, or the terminal goes away.
pub fn run(registry: &Registry, id: &str, options: OptionMap, seed: u64, args: &TerminalArgs) -> Result<(), Failure> {
    let fps = args.fps.unwrap_or(registry.spec(id)?.render_fps);
    let hold = args.hold.unwrap_or(if fps > SLOW_FPS { HOLD } else { 0.0 });
    let hold =
        Duration::try_from_secs_f64(hold).map_err(|_| format!("--hold must be finite and 0 or more, got {hold}"))?;
    let game = Game::start(registry, id, options, seed)?;
    check()?;
    let stop = stop::on_signal()?;
    let mut screen = Screen::enter()?;
    let period = Duration::from_secs(1) / fps;
    let mut player = Player::new(game, Keys::new(hold), period);
    let ends = |screen: &Screen| stop.load(Ordering::Relaxed) || screen.is_gone();
    while !ends(&screen) {
        player.draw(&mut screen)?;
        loop {
            let (is_running, now) = (player.is_running(), Instant::now());
            if is_running && now >= player.due {
                player.step(now)?;
                break;
            }
            let wait = if is_running { (player.due - now).min(SLICE) } else { SLICE };
            match screen.event(wait)? {
                Some(Event::Key(event)) => match keys::command(event) {
                    Some(Command::Quit) => return Ok(()),
                    // The key Q where there is nothing to move.
                    Some(Command::Move([Direction::Left, Direction::Up])) if !player.controls.has_directions() => {
                        return Ok(());
                    }
                    Some(command) => player.carry_out(command)?,
                    None => continue,
                },
                Some(Event::Resize(..)) => {}
                Some(_) => continue,
                None if ends(&screen) => {}
                None => continue,
            }
            break;
        }
    }
    Ok(())
}

impl Player {
    fn new(game: Game, keys: Keys, period: Duration) -> Self {
        let controls = Controls::new(game.spec());
        Player { game, controls, keys, clock: Clock::Waiting, period, due: Instant::now() }
    }

    /// Whether steps are played without a key.
    fn is_running(&self) -> bool {
        self.clock == Clock::Running && self.controls.is_timed() && !self.game.is_over()
    }

    fn step(&mut self, now: Instant) -> Result<(), Failure> {
        let action = self.controls.action(&self.keys.act(now));
        self.game.step(&action)?;
        // After a pause of the process, the game does not catch up.
        self.due = (self.due + self.period).max(now);
        Ok(())
    }

    fn carry_out(&mut self, command: Command) -> Result<(), Failure> {
        let (now, seed) = (Instant::now(), self.game.seed);
        match command {
            Command::Move(directions) if self.controls.press(directions) => {
                self.keys.press(directions, now);
                if self.clock == Clock::Paused || !self.controls.is_timed() {
                    self.step_alone(now)?;
                }
                self.begin(now);
            }
            Command::Move(_) => self.begin(now),
            Command::Stop(directions) => self.keys.release(directions),
            Command::Digit(digit) => {
                if self.controls.digit(digit) {
                    self.step_alone(now)?;
                }
                self.begin(now);
            }
            Command::Select => self.controls.select(),
            Command::Play if !self.controls.is_timed() && self.controls.can_play_chosen() => self.step_alone(now)?,
            Command::Play => self.begin(now),
            Command::Pause => {
                self.clock = if self.clock == Clock::Running { Clock::Paused } else { Clock::Running };
                self.keys.clear();
                self.due = now + self.period;
            }
            Command::OneStep if self.controls.can_play_chosen() => {
                self.clock = Clock::Paused;
                self.step_alone(now)?;
            }
            Command::OneStep => {}
            Command::Restart => self.restart(seed)?,
            Command::NextSeed => self.restart(seed.saturating_add(1))?,
            Command::PreviousSeed => self.restart(seed.saturating_sub(1))?,
            Command::Quit => {}
        }
        Ok(())
    }

    /// Starts the clock of an episode that waits.
    fn begin(&mut self, now: Instant) {
        if self.clock == Clock::Waiting {
            (self.clock, self.due) = (Clock::Running, now);
        }
    }

    /// A step that no later one continues.
    fn step_alone(&mut self, now: Instant) -> Result<(), Failure> {
        self.step(now)?;
        self.keys.clear();
        Ok(())
    }

    fn restart(&mut self, seed: u64) -> Result<(), Failure> {
        self.keys.clear();
        if self.clock == Clock::Running {
            self.clock = Clock::Waiting;
        }
        self.game.restart(seed)
    }

    fn draw(&self, screen: &mut Screen) -> Result<(), Failure> {
        let lines = self.lines()?;
        screen.draw(|frame| draw(frame, &self.game, &lines))
    }

    fn lines(&self) -> Result<Vec<String>, Failure> {
        let state = match () {
            () if self.game.is_over() => "the episode is over",
            () if !self.controls.is_timed() => "",
            () if self.clock == Clock::Paused => "paused",
            () if self.clock == Clock::Waiting => "waits for the first key",
            () => "",
        };
        let spec = self.game.spec();
        let commands = self.game.commands();
        let task = if commands.is_empty() { spec.summary.to_owned() } else { format!("{commands}  {}", spec.summary) };
        let chosen = Some(self.controls.chosen()).filter(|chosen| !chosen.is_empty());
        let progress = [state.to_owned(), self.game.progress()?].into_iter().filter(|part| !part.is_empty());
        let lines = [self.game.numbers(), progress.collect::<Vec<_>>().join("  "), task];
        Ok(lines.into_iter().chain(chosen).chain([self.controls.help()]).collect())
    }
}

/// Draws the picture in the middle, or features where there is none, and the lines below it.
fn draw(frame: &mut Frame<'_>, game: &Game, lines: &[String]) {
    let area = frame.area();
    let lines = status::wrapped(lines, area.width);
    let (above, below) = status::divide(area, lines.len() as u16);
    status::draw(frame, below, &lines);
    if game.spec().shown().is_none() {
        return status::draw(frame, above, &status::wrapped(&[String::new(), game.features()], area.width));
    }
    let picture = game.frame();
    let side = fitting(above.width, above.height, picture.side);
    if side > 0 {
        let columns = side as u16;
        let area = Rect::new(above.x + (above.width - columns) / 2, above.y, columns, columns / 2);
        frame.render_widget(&picture.resized(side), area);
    }
}

#[cfg(test)]
mod tests {
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;
    use ratatui::style::Color;

    use endless_gym_memory_gym::memory_gym;

    use super::*;

    fn player(id: &str) -> Player {
        let game = Game::start(memory_gym(), id, OptionMap::new(), 3).unwrap();
        Player::new(game, Keys::new(Duration::ZERO), Duration::from_millis(1))
    }

    #[test]
    fn the_screen_shows_the_frame_and_the_numbers() {
        let player = player("MortarMayhemB-Grid-v0");
        let lines = player.lines().unwrap();
        assert_eq!(lines[1], "waits for the first key  commands 0 of 10");
        assert_eq!(lines[2].split("  ").next().unwrap().split(' ').count(), 10, "{}", lines[2]);
        let mut terminal = Terminal::new(TestBackend::new(90, 46)).unwrap();
        terminal.draw(|frame| draw(frame, &player.game, &lines)).unwrap();
        let buffer = terminal.backend().buffer();
        assert_eq!(buffer[(3, 0)].fg, Color::from(player.game.frame().pixels[0]), "in the middle");
        let line = |row: u16| (0..90).map(|column| buffer[(column, row)].symbol()).collect::<String>();
        assert!(line(42).starts_with("MortarMayhemB-Grid-v0  seed 3  step 0  reward 0.000  return 0.000"));
        assert!(line(45).starts_with("arrows or W A S D move"));
        // Drawing where nothing fits does not fail.
        for (columns, rows) in [(1, 1), (3, 5), (200, 4)] {
            let mut small = Terminal::new(TestBackend::new(columns, rows)).unwrap();
            small.draw(|frame| draw(frame, &player.game, &lines)).unwrap();
        }
    }
}
