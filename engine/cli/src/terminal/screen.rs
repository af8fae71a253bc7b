//! The terminal while a command draws in it, restored however the command ends.

use std::io::{IsTerminal, stdin, stdout};
use std::time::Duration;

use ratatui::crossterm::cursor::Show;
use ratatui::crossterm::event::{
    self, Event, KeyboardEnhancementFlags, PopKeyboardEnhancementFlags, PushKeyboardEnhancementFlags,
};
use ratatui::crossterm::execute;
use ratatui::crossterm::style::force_color_output;
use ratatui::{DefaultTerminal, Frame};

use super::super::failure::Failure;
use super::super::stop;

/// The alternate screen, in raw mode. Dropping it leaves both, and so do a panic and a second signal.
pub struct Screen(DefaultTerminal);

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
        let entered = ratatui::try_init().map(Screen);
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
        self.0.draw(draw).map(drop).map_err(|error| format!("cannot draw in the terminal: {error}").into())
    }

    /// The next event, or `None` if there is none within that time.
    pub fn event(&self, timeout: Duration) -> Result<Option<Event>, Failure> {
        let read = || if event::poll(timeout)? { event::read().map(Some) } else { Ok(None) };
        read().map_err(|error: std::io::Error| format!("cannot read from the terminal: {error}").into())
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        leave();
    }
}

/// Undoes [`Screen::enter`]. Errors mean that the terminal no longer exists.
fn leave() {
    let _ = execute!(stdout(), PopKeyboardEnhancementFlags);
    let _ = ratatui::try_restore();
    let _ = execute!(stdout(), Show);
}
