//! The terminal while a command draws in it, restored however the command ends.

use std::io::{IsTerminal, stdin, stdout};
use std::mem::ManuallyDrop;
use std::process::exit;
use std::thread;
use std::time::{Duration, Instant};

use ratatui::crossterm::cursor::Show;
use ratatui::crossterm::event::{
    self, Event, KeyboardEnhancementFlags, PopKeyboardEnhancementFlags, PushKeyboardEnhancementFlags,
};
use ratatui::crossterm::execute;
use ratatui::crossterm::style::force_color_output;
use ratatui::{DefaultTerminal, Frame};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::time::Timespec;

use crate::failure::Failure;
use crate::stop;

/// Time in which a command ends by itself after its terminal has gone away.
const GRACE: Duration = Duration::from_secs(2);

/// The alternate screen, in raw mode. Dropping it leaves both, and so do a panic and a second signal.
///
/// `ratatui`'s own clean-up prints its errors, which fails where the terminal was.
pub struct Screen(ManuallyDrop<DefaultTerminal>);

/// Fails if standard input or standard output is not a terminal.
pub fn check() -> Result<(), Failure> {
    match (stdin().is_terminal(), stdout().is_terminal()) {
        (true, true) => Ok(()),
        (false, _) => Err("--terminal needs a terminal, and standard input is none".into()),
        (true, false) => Err("--terminal needs a terminal, and standard output is none".into()),
    }
}

impl Screen {
    /// Enters the alternate screen and raw mode.
    pub fn enter() -> Result<Self, Failure> {
        check()?;
        // Pictures consist of colours, so NO_COLOR has no meaning here.
        force_color_output(true);
        stop::before_exit(leave);
        thread::Builder::new().name("terminal".to_owned()).spawn(end_without_terminal)?;
        let entered = ratatui::try_init().map(|terminal| Screen(ManuallyDrop::new(terminal)));
        let screen = entered.map_err(|error| {
            leave();
            format!("cannot draw in the terminal: {error}")
        })?;
        // Asks the terminal to report key releases; terminals without this protocol ignore it.
        let flags = KeyboardEnhancementFlags::DISAMBIGUATE_ESCAPE_CODES | KeyboardEnhancementFlags::REPORT_EVENT_TYPES;
        execute!(stdout(), PushKeyboardEnhancementFlags(flags))?;
        Ok(screen)
    }

    pub fn draw(&mut self, draw: impl FnOnce(&mut Frame<'_>)) -> Result<(), Failure> {
        let drawn = self.0.draw(draw).map(drop);
        match drawn {
            Err(error) if !self.is_gone() => Err(format!("cannot draw in the terminal: {error}").into()),
            _ => Ok(()),
        }
    }

    /// The next event, or `None` if there is none within that time, or the terminal has gone away.
    pub fn event(&self, timeout: Duration) -> Result<Option<Event>, Failure> {
        let until = Instant::now() + timeout;
        let read = || loop {
            // Reading from a terminal that has gone away, `crossterm` does not return.
            if self.is_gone() {
                return Ok(None);
            }
            if event::poll(Duration::ZERO)? {
                return event::read().map(Some);
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            wait(left);
        };
        read().map_err(|error: std::io::Error| format!("cannot read from the terminal: {error}").into())
    }

    /// Whether the terminal has gone away: its window was closed, or its session was killed.
    pub fn is_gone(&self) -> bool {
        wait(Duration::ZERO).intersects(PollFlags::HUP | PollFlags::ERR | PollFlags::NVAL)
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        leave();
    }
}

/// Waits until the terminal has input or goes away, and returns what happened. A signal ends the wait.
fn wait(timeout: Duration) -> PollFlags {
    let timeout = Timespec::try_from(timeout).unwrap_or_default();
    poll_input(PollFlags::IN, Some(&timeout))
}

fn poll_input(events: PollFlags, timeout: Option<&Timespec>) -> PollFlags {
    let input = stdin();
    let mut watched = [PollFd::new(&input, events)];
    poll(&mut watched, timeout).map_or(PollFlags::empty(), |_| watched[0].revents())
}

/// Ends the process if the terminal goes away just before `crossterm` reads from it, which then reads forever.
fn end_without_terminal() {
    while poll_input(PollFlags::empty(), None).is_empty() {}
    thread::sleep(GRACE);
    exit(0);
}

/// Undoes [`Screen::enter`]. Errors mean that the terminal no longer exists.
fn leave() {
    let _ = execute!(stdout(), PopKeyboardEnhancementFlags);
    let _ = ratatui::try_restore();
    let _ = execute!(stdout(), Show);
}
