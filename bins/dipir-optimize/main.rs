//! `dipir-optimize`: recovers the light of the photograph and its tone curves.
mod cli;

use std::process::ExitCode;

use clap::Parser;
use cli::Cli;
use dipir_cli::exit;
use dipir_cli::session::Session;

fn main() -> ExitCode {
    exit::run(|| {
        let session = Session::start(&Cli::parse().common)?;
        if dipir::materials::are_asked_for(&session)? {
            let done = dipir::materials::run(&session)?;
            session.result(|| done.to_string(), || done.to_json());
            return Ok(());
        }
        let done = dipir::optimize::run(&session)?;
        session.result(|| done.to_string(), || done.to_json());
        Ok(())
    })
}
