//! A progress bar on standard error; where that is not a terminal, a line every half minute and
//! what is worth keeping.
use std::fmt::Write as _;
use std::io::{IsTerminal, stderr};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

use crate::exit::printable;
use crate::output::say;

/// Steps of a bar; fine enough for a wide terminal.
const STEPS: u64 = 1000;
/// How often a bar is drawn, whether the work has come further or not.
const DRAW_EVERY: Duration = Duration::from_millis(200);
/// How often a line is written where there is no bar.
const LINE_EVERY: Duration = Duration::from_secs(30);
/// The time left is shown only after this share of the work and this time have passed.
const SHARE_TO_JUDGE_BY: f64 = 0.02;
const TIME_TO_JUDGE_BY: Duration = Duration::from_secs(2);
/// Steps that take this long, as those of a large diffusion model, tell the pace before that share of them is done.
const ENOUGH_TIME: Duration = Duration::from_secs(30);

/// How far a piece of work has come.
#[derive(Debug)]
pub struct Progress {
    bar: ProgressBar,
    quiet: bool,
    course: Shared,
    /// Ends the lines when it is dropped, and the thread that writes them.
    lines: Option<(Sender<()>, JoinHandle<()>)>,
}

type Shared = Arc<Mutex<Course>>;

/// What is done by when.
#[derive(Clone, Debug)]
struct Course {
    begun: Instant,
    /// Where the work began: time since `begun`, share done. Work that goes on from a checkpoint
    /// begins there.
    first: Option<(Duration, f64)>,
    /// The last share that was reported.
    last: (Duration, f64),
}

impl Course {
    fn new(begun: Instant) -> Self {
        Self {
            begun,
            first: None,
            last: (Duration::ZERO, 0.0),
        }
    }

    fn set(&mut self, passed: Duration, share: f64) {
        self.last = (passed, share);
        self.first.get_or_insert(match share < SHARE_TO_JUDGE_BY {
            true => (Duration::ZERO, 0.0),
            false => (passed, share),
        });
    }

    /// Seconds until the end at the pace so far, less those since the last report; at least what is left would take if all
    /// that is done had taken the time since then, so that a late report does not end in 0 s.
    fn left_s(&self, passed: Duration) -> Option<f64> {
        let (start, first) = self.first?;
        let (then, share) = self.last;
        let done = share - first;
        let worked = then.saturating_sub(start);
        let enough = done >= SHARE_TO_JUDGE_BY || (done > 0.0 && worked >= ENOUGH_TIME);
        if !enough || passed.saturating_sub(start) < TIME_TO_JUDGE_BY {
            return None;
        }
        let rest = (1.0 - share) / done;
        let since = passed.saturating_sub(then).as_secs_f64();
        Some((worked.as_secs_f64() * rest - since).max(since * rest))
    }

    /// `43%, about 12 s left`.
    fn in_words(&self, passed: Duration) -> String {
        let mut text = format!("{:.0}%", (100.0 * self.last.1).floor());
        if let Some(left) = self.left_s(passed) {
            let _ = write!(text, ", about {} left", roughly(left));
        }
        text
    }
}

/// `9 s`, `3 min 20 s`, `2 h 05 min`.
fn roughly(seconds: f64) -> String {
    match seconds.ceil() as u64 {
        s if s < 60 => format!("{s} s"),
        s if s < 3600 => format!("{} min {:02} s", s / 60, s % 60),
        s => format!("{} h {:02} min", s / 3600, s / 60 % 60),
    }
}

fn locked(course: &Shared) -> MutexGuard<'_, Course> {
    course.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What is left behind the bar.
fn left(course: &Shared) -> String {
    let course = locked(course);
    match course.left_s(course.begun.elapsed()) {
        Some(seconds) => format!("about {} left", roughly(seconds)),
        None => String::new(),
    }
}

/// Writes a line every `every` until the other end of the returned channel is dropped.
fn write_lines(
    every: Duration,
    line: impl Fn() -> String + Send + 'static,
    mut to: impl FnMut(&str) + Send + 'static,
) -> (Sender<()>, JoinHandle<()>) {
    let (end, ended) = channel();
    let thread = std::thread::spawn(move || {
        while ended.recv_timeout(every) == Err(RecvTimeoutError::Timeout) {
            to(&line());
        }
    });
    (end, thread)
}

impl Progress {
    /// A bar called `title`; lines where standard error is not a terminal, nothing if `quiet`.
    pub fn new(title: &str, quiet: bool) -> Self {
        let visible = !quiet && stderr().is_terminal();
        let target = match visible {
            true => ProgressDrawTarget::stderr_with_hz(10),
            false => ProgressDrawTarget::hidden(),
        };
        let bar = ProgressBar::with_draw_target(Some(STEPS), target);
        let course: Shared = Arc::new(Mutex::new(Course::new(Instant::now())));
        let style = ProgressStyle::with_template(
            "{prefix:>12.bold} {spinner} [{bar:32}] {percent:>3}% {elapsed} {left} {msg}",
        );
        if let Ok(style) = style {
            let course = course.clone();
            let left = move |_: &ProgressState, text: &mut dyn std::fmt::Write| {
                let _ = text.write_str(&left(&course));
            };
            bar.set_style(style.progress_chars("=> ").with_key("left", left));
        }
        bar.set_prefix(title.to_string());
        if visible {
            bar.enable_steady_tick(DRAW_EVERY);
        }
        let lines = (!visible && !quiet).then(|| {
            let (title, course) = (title.to_string(), course.clone());
            let line = move || {
                let course = locked(&course);
                format!("{title}: {}", course.in_words(course.begun.elapsed()))
            };
            write_lines(LINE_EVERY, line, |line| say(line))
        });
        Self {
            bar,
            quiet,
            course,
            lines,
        }
    }

    /// Shows `fraction` done, in `[0, 1]`.
    pub fn set(&self, fraction: f64) {
        let fraction = if fraction.is_finite() { fraction } else { 0.0 };
        let fraction = fraction.clamp(0.0, 1.0);
        {
            let mut course = locked(&self.course);
            let passed = course.begun.elapsed();
            course.set(passed, fraction);
        }
        self.bar.set_position((fraction * STEPS as f64) as u64);
    }

    /// Shows `message` behind the bar, as in the error so far.
    pub fn say(&self, message: impl Into<String>) {
        self.bar.set_message(printable(&message.into()));
    }

    /// Writes `line`, which stays: above the bar, or without a terminal as a line of the log.
    pub fn note(&self, line: &str) {
        match self.bar.is_hidden() {
            false => self.bar.println(line),
            true if self.quiet => {}
            true => say(line),
        }
    }

    /// Takes the bar away.
    pub fn done(self) {}
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some((end, thread)) = self.lines.take() {
            drop(end);
            let _ = thread.join();
        }
        if !self.bar.is_finished() {
            self.bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn s(seconds: f64) -> Duration {
        Duration::from_secs_f64(seconds)
    }

    #[test]
    fn the_time_left_comes_from_the_work_done_and_runs_down_between_two_reports() {
        let mut course = Course::new(Instant::now());
        assert_eq!(course.in_words(s(60.0)), "0%");
        course.set(s(0.5), 0.0);
        course.set(s(10.0), 0.1);
        // A tenth in 10 s: nine more of them.
        assert_eq!(course.left_s(s(10.0)), Some(90.0));
        assert_eq!(course.left_s(s(14.0)), Some(86.0));
        // Nothing has been done for 490 s: nine times that, as nine times as much is left as was done.
        assert_eq!(course.left_s(s(500.0)), Some(4410.0));
        course.set(s(20.0), 0.5);
        assert_eq!(course.left_s(s(20.0)), Some(20.0));
    }

    #[test]
    fn nothing_is_said_before_there_is_something_to_judge_by() {
        let mut course = Course::new(Instant::now());
        course.set(s(1.0), 0.01);
        course.set(s(20.0), 0.015);
        assert_eq!(course.left_s(s(20.0)), None);
        // A fiftieth of the work is enough, and so is half a minute of it.
        course.set(s(21.0), 0.02);
        assert!(course.left_s(s(21.0)).is_some());
        course.set(s(40.0), 0.015);
        assert!(course.left_s(s(40.0)).is_some());
        let mut fast = Course::new(Instant::now());
        fast.set(s(0.1), 0.01);
        fast.set(s(1.9), 0.5);
        assert_eq!(fast.left_s(s(1.9)), None);
    }

    #[test]
    fn work_that_goes_on_from_a_checkpoint_is_judged_by_what_was_done_since() {
        let mut course = Course::new(Instant::now());
        course.set(s(1.0), 0.5);
        assert_eq!(course.left_s(s(9.0)), None);
        course.set(s(11.0), 0.6);
        // A tenth in 10 s, four more to go.
        let left = course.left_s(s(11.0)).unwrap();
        assert!((left - 40.0).abs() < 1e-9, "{left}");
    }

    #[test]
    fn lines_come_until_the_work_ends_and_none_after() {
        let (told, heard) = channel();
        let tell = move |line: &str| {
            let _ = told.send(line.to_string());
        };
        let (end, thread) = write_lines(Duration::from_millis(1), || "a: 3%".into(), tell);
        assert_eq!(heard.recv().unwrap(), "a: 3%");
        assert_eq!(heard.recv().unwrap(), "a: 3%");
        drop(end);
        thread.join().unwrap();
        while heard.try_recv().is_ok() {}
        assert!(heard.recv().is_err(), "the thread is gone");
    }

    #[test]
    fn times_read_well() {
        assert_eq!(roughly(8.2), "9 s");
        assert_eq!(roughly(200.0), "3 min 20 s");
        assert_eq!(roughly(7500.0), "2 h 05 min");
    }
}
