//! `dipir-model`: brings diffusion models onto the disk. The only executable that uses the network.
mod cli;
mod fetch;

use std::process::ExitCode;

use clap::Parser;
use cli::{Cli, Command};
use dipir_cli::exit;

fn main() -> ExitCode {
    exit::run(|| match Cli::parse().command {
        Command::Fetch(args) => fetch::run(&args),
    })
}
