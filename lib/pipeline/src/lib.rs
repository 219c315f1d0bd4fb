//! Configuration, stage manifests and atomic outputs: everything that the executables share
//! and that knows nothing of pictures or light.
//!
//! - [`config`]: `pipeline.toml` with `--set` overrides, read into the domain crates' own types.
//! - [`stage`]: a stage's output folder, written beside its target and swapped in whole.
//! - [`manifest`]: `stage.json`, the last file that a stage writes.
//! - [`fingerprint`]: why a stage has to run again, in words.
//! - [`mark`]: what in a folder is ours, and what is left alone.
//! - [`hashing`]: the hash of each file, taken once.
//! - [`resume`]: where an interrupted run goes on.
//! - [`lock`]: one writer a folder.
//! - [`graph`]: which stage reads what another wrote.
//! - [`status`]: which stages are up to date, and why the others are not.
//! - [`runner`]: the stages' executables as child processes, in order.
pub mod config;
pub mod error;
pub mod fingerprint;
pub mod graph;
pub mod hashing;
pub mod lock;
pub mod manifest;
pub mod mark;
pub mod resume;
pub mod runner;
pub mod stage;
pub mod status;
