//! A session of a project on disk, for the tests of this crate and of dipir-placing.
use std::path::Path;

use dipir_cli::args::{CommonArgs, OutputArgs};
use dipir_cli::session::Session;

/// Opens `pipeline.toml` of a folder with some keys changed, as `KEY=VALUE`.
pub fn open(folder: &Path, set: &[&str]) -> Session {
    Session::open(&CommonArgs {
        pipeline: folder.join("pipeline.toml"),
        set: set.iter().map(|s| (*s).to_owned()).collect(),
        out: None,
        threads: None,
        seed: None,
        wait: false,
        supervised: false,
        light: None,
        placed: None,
        hashes: None,
        output: OutputArgs {
            json: false,
            quiet: true,
            verbose: false,
        },
    })
    .unwrap()
}
