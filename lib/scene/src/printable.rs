//! Names and values from files as they may stand in a message.
use std::fmt::Display;

/// `text` with every control character written as an escape, `\u{1b}`: a name in a file shall not
/// move the cursor, colour the terminal or turn the direction of reading.
pub fn printable(text: impl Display) -> String {
    let text = text.to_string();
    if !text.contains(is_hidden) {
        return text;
    }
    let mut shown = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        match is_hidden(c) {
            true => shown.extend(c.escape_default()),
            false => shown.push(c),
        }
    }
    shown
}

/// Control characters, and those that turn the direction of reading.
fn is_hidden(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_would_obey_is_escaped_and_letters_stay() {
        assert_eq!(printable("Käse 木 \"a b\""), "Käse 木 \"a b\"");
        assert_eq!(
            printable("\u{1b}[31mred\u{9b}0m\r\n\u{202e}gpj"),
            "\\u{1b}[31mred\\u{9b}0m\\r\\n\\u{202e}gpj"
        );
    }
}
