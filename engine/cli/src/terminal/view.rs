//! `endless view --terminal`.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use endless_gym_core::batch::Frames;
use endless_gym_core::raster::FrameShape;
use endless_gym_service::{
    ConnectConfig, ErrorKind, Namespace, Observed, Observers, Pictures, ServiceError, running_engines,
};
use endless_gym_view::{RecentEpisodes, RecentRate};
use ratatui::Frame;
use ratatui::crossterm::event::{Event, KeyCode, KeyEvent, KeyModifiers};
use ratatui::layout::Rect;

use super::frame::newest;
use super::picture::{Pixels, fitting};
use super::screen::{Screen, check};
use super::status;
use crate::failure::Failure;
use crate::options::seconds;
use crate::output::{grouped, print};
use crate::stop;

/// Time between two drawings of the screen.
const INTERVAL: Duration = Duration::from_millis(100);

/// Time between two computations of the steps per second.
const RATE_INTERVAL: Duration = Duration::from_secs(1);

/// Longest wait for a batch between checks of the keys.
const SLICE: Duration = Duration::from_millis(20);

/// The smallest side of an environment's picture, unless the terminal is smaller.
const MIN_SIDE: usize = 28;

/// The largest side of the picture of a small frame.
const MAX_SIDE: usize = 84;

/// Arguments of `endless view` for the terminal.
#[derive(clap::Args)]
pub struct TerminalArgs {
    /// Show the environments in the terminal, which must show 24-bit colours.
    #[arg(long)]
    pub terminal: bool,
    /// In the terminal: show this group only [default: all].
    #[arg(long, requires = "terminal")]
    group: Option<usize>,
    /// In the terminal: how long to wait for the engine to start, in seconds.
    #[arg(long, value_name = "SECONDS", default_value_t = 1.0, requires = "terminal")]
    timeout: f64,
}

/// The environments that are shown, by group and number.
struct Wall {
    /// `None` if the environments have no pictures.
    frames: Option<(Frames, FrameShape)>,
    /// By group, what the engine draws if its batches have no frames.
    pictures: BTreeMap<usize, Pictures>,
    num_envs: usize,
    groups: usize,
    /// By group, when it was last seen and its first environments.
    seen: BTreeMap<usize, (Instant, Vec<Pixels>)>,
    /// Number of environments that fit on the screen.
    places: usize,
}

impl Wall {
    /// Stores the frames of a batch, at most as often as the screen is drawn.
    fn add(&mut self, observed: &Observed) {
        let group = observed.lease.group();
        let is_recent = self.seen.get(&group).is_some_and(|(time, _)| time.elapsed() < INTERVAL);
        let Some((frames, shape)) = self.frames.filter(|_| !is_recent && self.pictures.is_empty()) else { return };
        let bytes: usize = frames.shape(shape).iter().product();
        let batch = observed.lease.batch();
        let pictures =
            batch.observation().chunks_exact(bytes).take(self.places).map(|rows| newest(rows, frames, shape));
        self.seen.insert(group, (Instant::now(), pictures.collect()));
    }

    /// Stores what the engine has drawn, and asks it for as many environments as fit.
    fn refresh(&mut self) -> Result<(), ServiceError> {
        let wanted: Vec<_> = (0..self.num_envs.min(self.places)).collect();
        for (group, pictures) in &mut self.pictures {
            pictures.want(*group, &wanted)?;
            if let (true, Some(drawn)) = (pictures.refresh(), pictures.newest()) {
                let frames = drawn.frames.chunks_exact(drawn.shape.bytes());
                let shown = frames.map(|frame| newest(frame, Frames::default(), drawn.shape)).collect();
                self.seen.insert(*group, (Instant::now(), shown));
            }
        }
        Ok(())
    }

    /// Side of a picture in its own size.
    fn own(&self) -> usize {
        self.frames.map_or(1, |(_, shape)| shape.width.max(shape.height))
    }

    /// Draws as many environments as fit, and returns their number.
    fn draw(&self, frame: &mut Frame<'_>, area: Rect) -> usize {
        let total = self.seen.values().map(|(_, pictures)| pictures.len()).sum();
        let Grid { side, columns, rows } = Grid::new(area, total, self.own());
        if side == 0 {
            return 0;
        }
        let pictures = self.seen.values().flat_map(|(_, pictures)| pictures).take(columns * rows);
        let mut drawn = 0;
        for (number, picture) in pictures.enumerate() {
            let (x, y) = (number % columns * (side + 1), number / columns * (side / 2 + 1));
            let place = Rect::new(area.x + x as u16, area.y + y as u16, side as u16, (side / 2) as u16);
            frame.render_widget(&picture.resized(side), place);
            drawn += 1;
        }
        drawn
    }
}

/// Squares in rows, with one character between them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Grid {
    side: usize,
    columns: usize,
    rows: usize,
}

impl Grid {
    /// The largest squares of which `count` fit; if there are too many, as many squares of the smallest useful size as
    /// fit.
    fn new(area: Rect, count: usize, own: usize) -> Self {
        let largest = fitting(area.width, area.height, own).min((MAX_SIDE / own).max(1) * own);
        let grid = |side: usize| {
            let columns = (usize::from(area.width) + 1) / (side + 1);
            Grid { side, columns, rows: (usize::from(area.height) + 1) / (side / 2 + 1) }
        };
        let smallest = MIN_SIDE.min(largest);
        let sides = (smallest..=largest).rev().filter(|side| side % 2 == 0);
        sides.map(grid).find(|grid| grid.columns * grid.rows >= count).unwrap_or_else(|| grid(smallest))
    }
}

/// Shows an engine until a key or a signal ends it, or the terminal goes away.
pub fn run(service: Option<&str>, args: &TerminalArgs) -> Result<(), Failure> {
    let service = named_or_only(service)?;
    check()?;
    let timeout = seconds("--timeout", args.timeout)?;
    let stop = stop::on_signal()?;
    let Some(mut observers) = connect(&service, args.group, timeout, stop)? else { return Ok(()) };
    let specification = observers.specification().clone();
    let groups = args.group.map_or(0..specification.groups, |group| group..group + 1);
    let mut pictures = BTreeMap::new();
    for group in groups.clone() {
        pictures.extend(Pictures::of(observers.first())?.map(|pictures| (group, pictures)));
    }
    let shape = pictures.values().next().map(|pictures| (Frames::default(), pictures.shape()));
    let mut wall = Wall {
        frames: specification.frames.zip(specification.frame).or(shape),
        pictures,
        num_envs: specification.num_envs,
        groups: groups.len(),
        seen: BTreeMap::new(),
        places: specification.num_envs,
    };
    let (mut steps, mut episodes) = (0, RecentEpisodes::default());
    let title = format!("{service} {}", specification.id);
    let mut screen = Screen::enter()?;
    let (mut has_ended, mut drawn, mut rate, mut rated) = (false, None::<Instant>, 0.0, Instant::now());
    let mut recent = RecentRate::default();
    recent.add(rated, 0);
    while !stop.load(Ordering::Relaxed) && !is_quit(&screen, has_ended)? {
        if !has_ended {
            match observers.next(SLICE) {
                Ok(observed) => {
                    let played = observed.missed.saturating_add(1).saturating_mul(specification.num_envs as u64);
                    steps = played.saturating_add(steps);
                    episodes.add(&observed.lease.batch());
                    wall.add(&observed);
                }
                Err(ServiceError::TimedOut { .. }) => {}
                Err(ServiceError::EngineLost { .. }) => has_ended = true,
                Err(error) => return Err(error.into()),
            }
        }
        if rated.elapsed() >= RATE_INTERVAL {
            rated = Instant::now();
            rate = recent.add(rated, steps).unwrap_or(0.0);
        }
        if drawn.is_none_or(|time| time.elapsed() >= INTERVAL) {
            drawn = Some(Instant::now());
            wall.refresh()?;
            let lines = lines(&title, &episodes, if has_ended { 0.0 } else { rate }, has_ended);
            screen.draw(|frame| draw(frame, &mut wall, lines))?;
        }
    }
    drop(screen);
    if has_ended { print("the engine has ended") } else { Ok(()) }
}

/// The name of an engine, by default of the only one that runs. `endless` is meant if it runs among others, or may start.
fn named_or_only(service: Option<&str>) -> Result<String, Failure> {
    const DEFAULT: &str = "endless";
    if let Some(service) = service {
        return Ok(service.to_owned());
    }
    let mut running = running_engines(&Namespace::default())?;
    match running.len() {
        1 => Ok(running.remove(0)),
        0 => Ok(DEFAULT.to_owned()),
        _ if running.iter().any(|name| name == DEFAULT) => Ok(DEFAULT.to_owned()),
        _ => Err(format!("several engines run: {}; give the name of one", running.join(", ")).into()),
    }
}

/// The observers, or `None` if a signal came while waiting for the engine.
fn connect(
    service: &str,
    group: Option<usize>,
    timeout: Duration,
    stop: &AtomicBool,
) -> Result<Option<Observers>, Failure> {
    let start = Instant::now();
    loop {
        let left = timeout.saturating_sub(start.elapsed());
        let config = ConnectConfig::new(service).timeout(left.min(SLICE));
        match Observers::connect(&config, group) {
            Err(error) if left > SLICE && matches!(error.kind(), ErrorKind::Unavailable | ErrorKind::Lost) => {}
            connected => return Ok(Some(connected?)),
        }
        if stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
    }
}

/// Checks for keys that quit, and whether the terminal has gone away. Waits for them if there is nothing else to wait for.
fn is_quit(screen: &Screen, is_waiting: bool) -> Result<bool, Failure> {
    let mut timeout = if is_waiting { INTERVAL } else { Duration::ZERO };
    while let Some(event) = screen.event(timeout)? {
        timeout = Duration::ZERO;
        if let Event::Key(KeyEvent { code, modifiers, .. }) = event {
            match code {
                KeyCode::Esc | KeyCode::Char('q' | 'Q') => return Ok(true),
                KeyCode::Char('c') if modifiers.contains(KeyModifiers::CONTROL) => return Ok(true),
                _ => {}
            }
        }
    }
    Ok(screen.is_gone())
}

fn lines(title: &str, episodes: &RecentEpisodes, rate: f64, has_ended: bool) -> [String; 2] {
    let mut first = format!("{title}: {} steps/s, {} episodes", grouped(rate), grouped(episodes.ended as f64));
    if let Some((mean_return, mean_length)) = episodes.means() {
        first += &format!(", mean return {mean_return:.3}, mean length {mean_length:.1}");
    }
    let second = if has_ended { "the engine has ended; Q, Esc or Ctrl-C quits" } else { "Q, Esc or Ctrl-C quits" };
    [first, second.to_owned()]
}

fn draw(frame: &mut Frame<'_>, wall: &mut Wall, [first, last]: [String; 2]) {
    let width = frame.area().width;
    let total = wall.num_envs * wall.groups;
    let lines = |wall: &Wall, shown: usize| {
        let middle = match wall.frames {
            None => "these environments have no pictures".to_owned(),
            Some(_) if wall.seen.is_empty() => "no trainer has stepped the engine since".to_owned(),
            Some(_) => format!("{shown} of {total} environments are shown"),
        };
        status::wrapped(&[first.clone(), middle, last.clone()], width)
    };
    let (above, below) = status::divide(frame.area(), lines(wall, total).len() as u16);
    let Grid { columns, rows, .. } = Grid::new(above, usize::MAX, wall.own());
    wall.places = (columns * rows).max(1);
    let shown = wall.draw(frame, above);
    status::draw(frame, below, &lines(wall, shown));
}

#[cfg(test)]
mod tests {
    use endless_gym_memory_gym::{FRAME, SCREEN};
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;
    use ratatui::style::Color;

    use super::*;

    fn wall(groups: usize, count: u8) -> Wall {
        let picture =
            |group: usize, env: u8| Pixels { side: SCREEN, pixels: vec![[group as u8, env, 7]; SCREEN * SCREEN] };
        let pictures = |group| (0..count).map(|env| picture(group, env)).collect();
        Wall {
            frames: Some((Frames::default(), FRAME)),
            pictures: BTreeMap::new(),
            num_envs: count.into(),
            groups,
            seen: (0..groups).map(|group| (group, (Instant::now(), pictures(group)))).collect(),
            places: 0,
        }
    }

    #[test]
    fn grids_are_as_large_as_fits() {
        let grid = |columns, lines, count| Grid::new(Rect::new(0, 0, columns, lines), count, SCREEN);
        assert_eq!(grid(200, 60, 1), Grid { side: 84, columns: 2, rows: 1 });
        assert_eq!(grid(169, 85, 4), Grid { side: 84, columns: 2, rows: 2 });
        assert_eq!(grid(80, 21, 1).side, 42);
        assert_eq!(grid(80, 21, 1000), Grid { side: 28, columns: 2, rows: 1 });
        assert_eq!(grid(10, 3, 1000).side, 6);
        assert_eq!(grid(0, 3, 1).side, 0);
    }

    #[test]
    fn environments_are_drawn_in_rows_by_group_and_number() {
        let mut wall = wall(2, 3);
        let mut terminal = Terminal::new(TestBackend::new(86, 32)).unwrap();
        terminal.draw(|frame| draw(frame, &mut wall, ["first".to_owned(), "last".to_owned()])).unwrap();
        let buffer = terminal.backend().buffer();
        // Three columns of 28 characters, one apart, and two rows of 14 lines.
        for (number, (group, env)) in [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)].into_iter().enumerate() {
            let (x, y) = (number % 3 * 29, number / 3 * 15);
            for (column, row) in [(x, y), (x + 27, y + 13)] {
                let cell = &buffer[(column as u16, row as u16)];
                assert_eq!((cell.fg, cell.bg), (Color::Rgb(group, env, 7), Color::Rgb(group, env, 7)), "{number}");
            }
        }
        assert_eq!(buffer[(28, 0)].symbol(), " ");
        let line = |row: u16| (0..86).map(|column| buffer[(column, row)].symbol()).collect::<String>();
        assert_eq!(line(30).trim_end(), "6 of 6 environments are shown");
        assert_eq!(line(31).trim_end(), "last");
    }
}
