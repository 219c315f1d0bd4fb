//! `dipir-lora`: personalises the model to the photograph.
use std::process::ExitCode;

use dipir_cli::exit;
use dipir_cli::session::Session;
use dipir_stages::command_line::lora::Cli;

fn main() -> ExitCode {
    exit::run(|| {
        let session = Session::start(&exit::parse::<Cli>()?.common)?;
        let done = session.on_worker(|| dipir_stages::lora::run(&session))?;
        session.result(|| done.to_string(), || done.to_json());
        Ok(())
    })
}
