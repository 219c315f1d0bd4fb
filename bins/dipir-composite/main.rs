//! `dipir-composite`: the object in the photograph, with its layers.
mod cli;

use std::process::ExitCode;

use clap::Parser;
use cli::Cli;
use dipir_cli::exit;
use dipir_cli::session::Session;

fn main() -> ExitCode {
    exit::run(|| {
        let cli = Cli::parse();
        let session = Session::start(&cli.common)?;
        let stop = dipir::composite::StopArgs {
            target_error: cli.target_error,
            time_budget_s: cli.time_budget,
        };
        let done = dipir::composite::run(&session, &stop)?;
        session.result(|| done.to_string(), || done.to_json());
        Ok(())
    })
}
