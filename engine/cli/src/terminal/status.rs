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

/// Draws lines, the first one in bold, each cut at the area's edge.
pub fn draw(frame: &mut Frame<'_>, area: Rect, lines: &[String]) {
    for (row, line) in (0..area.height).zip(lines) {
        let style = if row == 0 { Style::new().add_modifier(Modifier::BOLD) } else { Style::new() };
        frame.buffer_mut().set_stringn(area.x, area.y + row, line, area.width.into(), style);
    }
}
