//! Colour, on a terminal that wants it and nowhere else.
use std::io::{IsTerminal, stderr, stdout};

/// Whether standard error takes colour.
pub fn color_on_stderr() -> bool {
    stderr().is_terminal() && wanted() && escapes::are_obeyed(&stderr())
}

/// Whether standard output takes colour.
pub fn color_on_stdout() -> bool {
    stdout().is_terminal() && wanted() && escapes::are_obeyed(&stdout())
}

/// Terminals obey escapes, but for consoles of Windows, which print them until they are told.
#[cfg(not(windows))]
mod escapes {
    pub(super) fn are_obeyed<T>(_: &T) -> bool {
        true
    }
}

#[cfg(windows)]
mod escapes {
    use std::ffi::c_void;
    use std::os::windows::io::AsRawHandle;

    /// A console's mode in which it obeys escapes.
    const ENABLE_VIRTUAL_TERMINAL_PROCESSING: u32 = 4;

    #[link(name = "kernel32")]
    unsafe extern "system" {
        fn GetConsoleMode(console: *mut c_void, mode: *mut u32) -> i32;
        fn SetConsoleMode(console: *mut c_void, mode: u32) -> i32;
    }

    /// Tells the console behind `stream` to obey escapes; false if it cannot. What is no console, as the pipe of a
    /// terminal of its own, is left alone.
    pub(super) fn are_obeyed(stream: &impl AsRawHandle) -> bool {
        let (console, mut mode) = (stream.as_raw_handle(), 0);
        // SAFETY: the handle is that of a standard stream, which stays open, and `mode` outlives the calls.
        unsafe {
            GetConsoleMode(console, &mut mode) == 0
                || SetConsoleMode(console, mode | ENABLE_VIRTUAL_TERMINAL_PROCESSING) != 0
        }
    }
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
