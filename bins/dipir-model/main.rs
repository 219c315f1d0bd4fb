//! `dipir-model`: brings diffusion models onto the disk, and checks what they compute. The only executable that uses the
//! network.
mod check;
mod fetch;

use std::process::ExitCode;

use dipir_cli::exit;
use dipir_stages::command_line::model::{Cli, Command};

fn main() -> ExitCode {
    exit::run(|| match exit::parse::<Cli>()?.command {
        Command::Fetch(args) => fetch::run(&args),
        Command::Check(args) => check::run(&args),
    })
}
