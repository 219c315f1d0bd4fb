//! `dipir-composite`: the object in the photograph, with its layers.
use std::process::ExitCode;

use dipir_cli::exit;
use dipir_cli::session::Session;
use dipir_stages::command_line::composite::Cli;

fn main() -> ExitCode {
    exit::run(|| {
        let cli = exit::parse::<Cli>()?;
        let session = Session::start(&cli.common)?;
        let stop = dipir_stages::composite::StopArgs {
            target_error: cli.target_error,
            time_budget_s: cli.time_budget,
        };
        let done = dipir_stages::composite::run(&session, &stop)?;
        session.result(|| done.to_string(), || done.to_json());
        Ok(())
    })
}
