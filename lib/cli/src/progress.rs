//! A progress bar on standard error; where that is not a terminal, only what is worth keeping.
use std::io::{IsTerminal, stderr};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// Steps of a bar; fine enough for a wide terminal.
const STEPS: u64 = 1000;

/// How far a piece of work has come.
#[derive(Debug)]
pub struct Progress {
    bar: ProgressBar,
    quiet: bool,
}

impl Progress {
    /// A bar called `title`; invisible if `quiet` or where standard error is not a terminal.
    pub fn new(title: &str, quiet: bool) -> Self {
        let visible = !quiet && stderr().is_terminal();
        let target = match visible {
            true => ProgressDrawTarget::stderr_with_hz(10),
            false => ProgressDrawTarget::hidden(),
        };
        let bar = ProgressBar::with_draw_target(Some(STEPS), target);
        let style = ProgressStyle::with_template(
            "{prefix:>12.bold} [{bar:32}] {percent:>3}% {elapsed} (ends in {eta}) {msg}",
        )
        .map(|style| style.progress_chars("=> "));
        if let Ok(style) = style {
            bar.set_style(style);
        }
        bar.set_prefix(title.to_string());
        if visible {
            bar.enable_steady_tick(Duration::from_millis(200));
        }
        Self { bar, quiet }
    }

    /// Shows `fraction` done, in `[0, 1]`.
    pub fn set(&self, fraction: f64) {
        let fraction = if fraction.is_finite() { fraction } else { 0.0 };
        self.bar
            .set_position((fraction.clamp(0.0, 1.0) * STEPS as f64) as u64);
    }

    /// Shows `message` behind the bar, as in the error so far.
    pub fn say(&self, message: impl Into<String>) {
        self.bar.set_message(message.into());
    }

    /// Writes `line` to stay: above the bar, or as it is into the log of hours of work without a terminal.
    pub fn note(&self, line: &str) {
        match self.bar.is_hidden() {
            false => self.bar.println(line),
            true if self.quiet => {}
            true => eprintln!("{line}"),
        }
    }

    /// Takes the bar away.
    pub fn done(self) {
        self.bar.finish_and_clear();
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if !self.bar.is_finished() {
            self.bar.finish_and_clear();
        }
    }
}
