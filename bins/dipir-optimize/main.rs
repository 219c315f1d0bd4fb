//! `dipir-optimize`: the earlier name of `dipir-light`.
use std::process::ExitCode;

use dipir_cli::exit::{self, Usage};

fn main() -> ExitCode {
    exit::run(|| Err(Usage("dipir-optimize is called dipir-light now".into()).into()))
}
