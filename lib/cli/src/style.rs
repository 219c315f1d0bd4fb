//! Colour, on a terminal that wants it and nowhere else.
use std::io::{IsTerminal, stderr, stdout};

/// Whether standard error takes colour.
pub fn color_on_stderr() -> bool {
    stderr().is_terminal() && wanted()
}

/// Whether standard output takes colour.
pub fn color_on_stdout() -> bool {
    stdout().is_terminal() && wanted()
}

/// <https://no-color.org>: set and not empty means no.
fn wanted() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty())
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
