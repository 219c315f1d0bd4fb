//! `dipir-model`: brings diffusion models onto the disk. The only executable that uses the network.
mod fetch;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use dipir_cli::exit;

const EXAMPLES: &str = "\
Examples:
  dipir-model fetch OWNER/NAME                       into ./NAME
  dipir-model fetch OWNER/NAME --to models/sd        into models/sd
  dipir-model fetch OWNER/NAME --revision fp16       a branch, tag or commit
  dipir-model fetch OWNER/NAME --variant fp16        half the bytes, where they are published

Takes the files of a pipeline in the diffusers layout and no others: *.safetensors, configurations
and the tokenizer; never pickles. An interrupted run goes on where it stopped; every file is
compared with the hub's hash; the folder appears when all of it is there and loads.
Environment: HF_ENDPOINT, HF_TOKEN (for gated models), HTTPS_PROXY.
Exit codes: 0 done, 1 failed, 2 wrong usage, 130 interrupted.";

/// Fetch diffusion models from a hub
#[derive(Parser)]
#[command(name = "dipir-model", version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Fetch a model and check that it loads
    #[command(after_help = EXAMPLES)]
    Fetch(fetch::Args),
}

fn main() -> ExitCode {
    exit::run(|| match Cli::parse().command {
        Command::Fetch(args) => fetch::run(&args),
    })
}
