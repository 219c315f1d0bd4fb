//! `dipir-light`: recovers the light of the photograph and its tone curves.
use std::process::ExitCode;

use dipir_cli::exit;
use dipir_cli::session::Session;
use dipir_stages::command_line::light::Cli;
use dipir_stages::light::idle_guidance;

fn main() -> ExitCode {
    exit::run(|| {
        let common = exit::parse::<Cli>()?.common;
        let session = Session::start(&common)?;
        // dipir run has said it.
        if !common.supervised
            && let Some(warning) = idle_guidance(&session)?
        {
            session.warn(&warning);
        }
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
