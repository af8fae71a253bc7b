//! Text from files and other processes, for a terminal.

use std::fmt::{Display, Write};

/// The text in one line, with escapes in place of control characters, which a terminal obeys, and of invisible characters that reorder
/// or hide text.
///
/// ```
/// use endless_gym_core::printable;
///
/// assert_eq!(printable("naïve\x1b[2J\n"), r"naïve\u{1b}[2J\n");
/// ```
pub fn printable(text: impl Display) -> String {
    let mut printed = String::new();
    for c in text.to_string().chars() {
        let reorders_or_hides = matches!(c, '\u{ad}' | '\u{61c}' | '\u{180e}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}'
            | '\u{2060}'..='\u{206f}' | '\u{feff}' | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}');
        if c.is_control() || reorders_or_hides {
            let _ = write!(printed, "{}", c.escape_default());
        } else {
            printed.push(c);
        }
    }
    printed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_obeys_or_hides_is_escaped() {
        assert_eq!(printable("\x1b]0;title\x07"), r"\u{1b}]0;title\u{7}");
        assert_eq!(printable("\u{9b}2J\u{90}q\u{9c}\x7f"), r"\u{9b}2J\u{90}q\u{9c}\u{7f}");
        assert_eq!(printable("a\r\n\tb\0"), r"a\r\n\tb\u{0}");
        assert_eq!(
            printable("\u{202e}txt.exe\u{2066}\u{200f}\u{2028}\u{e0041}"),
            r"\u{202e}txt.exe\u{2066}\u{200f}\u{2028}\u{e0041}"
        );
        let plain = r#"Größe “5” 'x' "y" \ 文字 🙂"#;
        assert_eq!(printable(plain), plain);
    }
}
