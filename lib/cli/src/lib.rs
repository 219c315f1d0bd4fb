//! What all executables share: arguments, progress, exit codes, and how errors are printed.
//!
//! Progress and warnings go to standard error, results to standard output. Exit codes: 0 done,
//! 1 failed, 2 wrong usage or configuration, 130 interrupted.
pub mod args;
pub mod ending;
pub mod exit;
pub mod interrupt;
pub mod progress;
pub mod session;
pub mod style;
