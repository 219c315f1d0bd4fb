//! The command line.
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use dipir_cli::args::OutputArgs;

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
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Subcommand)]
pub enum Command {
    /// Fetch a model and check that it loads
    #[command(after_help = EXAMPLES)]
    Fetch(FetchArgs),
}

#[derive(Args)]
pub struct FetchArgs {
    /// The repository, owner/name
    #[arg(value_name = "REPO")]
    pub repo: String,

    /// Branch, tag or commit
    #[arg(long, default_value = "main")]
    pub revision: String,

    /// The folder to make [default: the repository's name, in the current folder]
    #[arg(long, value_name = "DIR")]
    pub to: Option<PathBuf>,

    /// Which of the published weights; full precision where there are both
    #[arg(long, value_enum, default_value_t = Precision::Full)]
    pub variant: Precision,

    /// Address of the hub [default: HF_ENDPOINT, or https://huggingface.co]
    #[arg(long, value_name = "URL")]
    pub endpoint: Option<String>,

    /// How often a broken connection is taken up again, for each file
    #[arg(long, value_name = "N", default_value_t = 5)]
    pub retries: u32,

    #[command(flatten)]
    pub output: OutputArgs,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum Precision {
    Full,
    Fp16,
}
