//! Lines of text below pictures.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Modifier, Style};

/// Splits an area: pictures above, `lines` lines below.
pub fn divide(area: Rect, lines: u16) -> (Rect, Rect) {
    let below = lines.min(area.height);
    let above = area.height - below;
    (Rect { height: above, ..area }, Rect { y: area.y + above, height: below, ..area })
}

/// Breaks lines that are longer than `width` characters between words.
pub fn wrapped(lines: &[String], width: u16) -> Vec<String> {
    let mut rows: Vec<String> = Vec::new();
    for line in lines {
        rows.push(String::new());
        for word in line.split(' ') {
            match rows.last_mut() {
                Some(row) if row.is_empty() => row.push_str(word),
                Some(row) if row.chars().count() + 1 + word.chars().count() <= width.into() => {
                    row.push(' ');
                    row.push_str(word);
                }
                _ => rows.push(word.to_owned()),
            }
        }
    }
    rows
}

/// Draws lines, the first one in bold, each cut at the area's edge.
pub fn draw(frame: &mut Frame<'_>, area: Rect, lines: &[String]) {
    for (row, line) in (0..area.height).zip(lines) {
        let style = if row == 0 { Style::new().add_modifier(Modifier::BOLD) } else { Style::new() };
        frame.buffer_mut().set_stringn(area.x, area.y + row, line, area.width.into(), style);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_broken_between_words() {
        let lines = ["one two  three four".to_owned(), String::new(), "seventeen".to_owned()];
        assert_eq!(wrapped(&lines, 9), ["one two ", "three", "four", "", "seventeen"]);
        assert_eq!(wrapped(&lines, 80), lines);
    }
}
