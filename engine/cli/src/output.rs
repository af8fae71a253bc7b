//! Standard output and standard error: tables and numbers for people, JSON for programs.

use std::fmt::Display;
use std::io::{self, ErrorKind, IsTerminal, Write};

use comfy_table::{ColumnConstraint, ContentArrangement, LineStyle, Table, TableStyle};
use endless_gym_core::printable;
use indicatif::{HumanCount, ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use terminal_size::{Width, terminal_size_of};

use crate::failure::Failure;

/// Width in characters if standard output is not a terminal.
const PIPE_WIDTH: u16 = 120;

/// An empty table with these headings, at most as wide as standard output.
pub fn table<const N: usize>(headings: [&str; N]) -> Table {
    let mut table = Table::new();
    let line = LineStyle::none().fill('─').junction('─');
    table.load_style(TableStyle::new().header_separator(line));
    table.set_content_arrangement(ContentArrangement::Dynamic).set_width(width()).set_header(headings);
    // The first column has names, which people copy.
    if let Some(names) = table.column_mut(0) {
        names.set_constraint(ColumnConstraint::ContentWidth);
    }
    table
}

/// The table's text. If it is wider than standard output, a block of lines for each row instead, so that no word or number breaks.
pub fn fit(table: Table) -> String {
    fit_into(table, usize::from(width()))
}

fn fit_into(mut table: Table, width: usize) -> String {
    table.set_content_arrangement(ContentArrangement::Disabled);
    let text = table.to_string();
    if text.lines().all(|line| line.trim_end().chars().count() <= width) {
        return text;
    }
    let headings: Vec<String> =
        table.header().into_iter().flat_map(|row| row.cell_iter()).map(comfy_table::Cell::content).collect();
    let longest = headings.iter().map(|heading| heading.chars().count()).max().unwrap_or(0);
    let block = |row: &comfy_table::Row| {
        let cells = headings.iter().zip(row.cell_iter());
        cells.map(|(heading, cell)| format!("{heading:longest$}  {}", cell.content())).collect::<Vec<_>>().join("\n")
    };
    table.row_iter().map(block).collect::<Vec<_>>().join("\n\n")
}

/// Width of standard output in characters.
pub fn width() -> u16 {
    terminal_size_of(io::stdout()).map_or(PIPE_WIDTH, |(Width(columns), _)| columns)
}

/// Prints `text` and a newline to standard output. Names and other text of one line that come from files or other processes must be
/// [`printable`] before, since here a line break starts a new line.
pub fn print(text: impl Display) -> Result<(), Failure> {
    let text = text.to_string();
    print_coloured(text.split('\n').map(printable).collect::<Vec<_>>().join("\n"))
}

/// Like [`print()`], with the terminal's escape sequences in `text`, which must be this program's own.
pub fn print_coloured(text: impl Display) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    check(writeln!(stdout, "{text}").and_then(|()| stdout.flush()))
}

/// Clears the terminal, if standard output is one.
pub fn clear() -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    if stdout.is_terminal() { check(write!(stdout, "\x1b[H\x1b[2J")) } else { Ok(()) }
}

/// Prints one JSON document to standard output, with all characters but those of ASCII escaped.
pub fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    print(ascii(&serde_json::to_string_pretty(value)?))
}

/// Prints one JSON document in one line.
pub fn print_json_line(value: &impl Serialize) -> Result<(), Failure> {
    print(ascii(&serde_json::to_string(value)?))
}

/// JSON in ASCII. JSON itself allows control characters above it.
fn ascii(json: &str) -> String {
    let mut units = [0; 2];
    let mut text = |c: char| match c {
        ' '..='~' | '\n' => c.to_string(),
        _ => c.encode_utf16(&mut units).iter().map(|unit| format!("\\u{unit:04x}")).collect(),
    };
    json.chars().map(&mut text).collect()
}

/// Prints the text of `--help` or `--version` to standard output.
pub fn print_help(help: &clap::Error) -> Result<(), Failure> {
    check(help.print().and_then(|()| io::stdout().flush()))
}

/// Prints an error or a warning in one line to standard error. Without standard error, the exit status is the only remaining way to report.
pub fn print_error(error: impl Display) {
    let _ = writeln!(io::stderr(), "endless: {}", printable(error));
}

/// Turns an error of standard output into a failure. A closed pipe is not an error: in `endless list | head -1`, the
/// reader closes it deliberately, and the command's exit status stays the same.
fn check(written: io::Result<()>) -> Result<(), Failure> {
    match written {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(format!("cannot write to standard output: {error}").into())
        }
        _ => Ok(()),
    }
}

/// A number from 0, rounded to an integer, with thousands separators.
pub fn grouped(number: f64) -> String {
    HumanCount(number.round_ties_even() as u64).to_string()
}

/// A progress bar of `length` steps on standard error, hidden if that is not a terminal.
pub fn progress(length: u64, template: &str) -> ProgressBar {
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::with_draw_target(Some(length), ProgressDrawTarget::stderr()).with_style(style)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wide_table_becomes_lines_without_breaks() {
        let made = || {
            let mut table = table(["engine", "environment", "steps"]);
            table.add_row(["a", "Endless-SearingSpotlights-v0", "123,456,789"]);
            table.add_row(["b", "MysteryPath-v0", "7"]);
            table
        };
        assert_eq!(fit_into(made(), 80).lines().count(), 4);
        let lines = "engine       a\nenvironment  Endless-SearingSpotlights-v0\nsteps        123,456,789\n\n\
                     engine       b\nenvironment  MysteryPath-v0\nsteps        7";
        assert_eq!(fit_into(made(), 45), lines);
    }

    #[test]
    fn json_is_ascii_and_keeps_its_values() {
        let given = "\x1b\u{9b}\u{202e}🙂\"\\é\n\x7f";
        let text = ascii(&serde_json::to_string(given).unwrap());
        assert!(text.is_ascii() && !text.contains(char::is_control), "{text}");
        assert_eq!(serde_json::from_str::<String>(&text).unwrap(), given);
    }
}
