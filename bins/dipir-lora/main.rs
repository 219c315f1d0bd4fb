//! `dipir-lora`: personalises the model to the photograph.
mod cli;

use std::process::ExitCode;

use clap::Parser;
use cli::Cli;
use dipir_cli::exit;
use dipir_cli::session::Session;

fn main() -> ExitCode {
    exit::run(|| {
        let session = Session::start(&Cli::parse().common)?;
        let done = dipir::lora::run(&session)?;
        session.result(|| done.to_string(), || done.to_json());
        Ok(())
    })
}
