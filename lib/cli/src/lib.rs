//! What executables share: arguments, progress, exit codes, how errors are printed, and how one starts
//! another.
//!
//! Progress and warnings go to standard error, results to standard output. Exit codes: 0 done,
//! 1 failed, 2 wrong usage or configuration, 130 interrupted.
pub mod args;
pub mod ending;
pub mod executables;
pub mod exit;
pub mod interrupt;
pub mod output;
pub mod progress;
pub mod session;
pub mod style;
