//! `dipir-light`: recovers the light of the photograph and its tone curves.
use std::process::ExitCode;

use dipir_cli::exit;
use dipir_cli::session::Session;
use dipir_stages::command_line::light::Cli;

fn main() -> ExitCode {
    exit::run(|| {
        let session = Session::start(&exit::parse::<Cli>()?.common)?;
        if dipir_stages::light::materials::are_asked_for(&session)? {
            let done = dipir_stages::light::materials::run(&session)?;
            session.result(|| done.to_string(), || done.to_json());
            return Ok(());
        }
        let done = session.on_worker(|| dipir_stages::light::run(&session))?;
        session.result(|| done.to_string(), || done.to_json());
        Ok(())
    })
}
