//! Colour, on a terminal that wants it and nowhere else.
use std::io::{IsTerminal, stderr, stdout};

use anstyle_query::{no_color, term_supports_ansi_color, windows};

/// Whether standard error takes colour.
pub fn color_on_stderr() -> bool {
    stderr().is_terminal() && is_wanted()
}

/// Whether standard output takes colour.
pub fn color_on_stdout() -> bool {
    stdout().is_terminal() && is_wanted()
}

/// Whether the user wants colour (<https://no-color.org>) and the terminal obeys escapes. Consoles of Windows print them
/// until they are told; a terminal of its own there names itself in `TERM`.
fn is_wanted() -> bool {
    !no_color() && (windows::enable_ansi_colors().unwrap_or(true) || term_supports_ansi_color())
}

/// Bold red if `color`.
pub fn bold_red(text: &str, color: bool) -> String {
    paint(text, "1;31", color)
}

/// Bold yellow if `color`.
pub fn bold_yellow(text: &str, color: bool) -> String {
    paint(text, "1;33", color)
}

/// Bold if `color`.
pub fn bold(text: &str, color: bool) -> String {
    paint(text, "1", color)
}

/// Faint if `color`.
pub fn faint(text: &str, color: bool) -> String {
    paint(text, "2", color)
}

fn paint(text: &str, code: &str, color: bool) -> String {
    if color {
        format!("\x1b[{code}m{text}\x1b[0m")
    } else {
        text.into()
    }
}
