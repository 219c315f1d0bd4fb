//! The command line.
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use dipir_cli::args::{CommonArgs, OutputArgs};

const CHECK_EXAMPLES: &str = "\
Examples:
  dipir-model check                                     the embedded model, on a GPU if there is one
  dipir-model check models/sd21 --device cuda:0         in bf16, against the CPU in f32
  dipir-model check v1-5.safetensors --device cpu       one file; kernels against plain operations
  dipir-model check models/sd21 -p scene/pipeline.toml  and what that scene will take
  dipir-model check models/sd21 --json > check.json     for a bug report

Says what was read: family, prediction, noise, size, precision on the disk.
Compares text encoder, UNet, autoencoder and the gradient of its encoder at a small size and at
that of the model: on a GPU with the same model on the CPU in f32, on the CPU with the same layers
made of candle's operations. Then times the parts, and says what the stages of pipeline.toml would
take.
Exit codes: 0 all parts agree, 1 failed or a part does not agree, 2 wrong usage, 130 interrupted.";

const EXAMPLES: &str = "\
Examples:
  dipir-model check                                  the embedded model on this machine
  dipir-model check models/sd21 --device cuda:0      what a bug report about a GPU should hold
  dipir-model fetch OWNER/NAME                       into ./NAME
  dipir-model fetch OWNER/NAME --to models/sd        into models/sd
  dipir-model fetch OWNER/NAME --revision fp16       a branch, tag or commit
  dipir-model fetch OWNER/NAME --variant fp16        half the bytes, where they are published

Takes the files of a pipeline in the diffusers layout and no others: *.safetensors, configurations
and the tokenizer; never pickles. An interrupted run goes on where it stopped; every file is
compared with the hub's hash; the folder appears when all of it is there and loads.
Environment: HF_ENDPOINT, HF_TOKEN (for gated models), HTTPS_PROXY.
Exit codes: 0 done, 1 failed, 2 wrong usage, 130 interrupted.";

/// Fetch diffusion models from a hub, and check them on this machine
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
    /// Compare a model's parts with a reference on this machine, time them, and say what a run would take
    #[command(after_help = CHECK_EXAMPLES)]
    Check(CheckArgs),
}

/// Options of `dipir-model check`.
#[derive(Args)]
pub struct CheckArgs {
    /// A model's folder, or one .safetensors file [default: that of pipeline.toml, or the embedded
    /// model]
    #[arg(value_name = "MODEL")]
    pub model: Option<PathBuf>,

    /// What computes: cpu, cuda:N, metal:N (never tried), or auto for an NVIDIA GPU if there is one
    #[arg(long, default_value = "auto")]
    pub device: String,

    /// f32, bf16 or f16 [default: f32 on the CPU, bf16 on a GPU]
    #[arg(long)]
    pub precision: Option<String>,

    /// What its UNet predicts, whatever its files say: epsilon or v_prediction
    #[arg(long)]
    pub prediction: Option<String>,

    /// Compare at the small size alone
    #[arg(long)]
    pub small: bool,

    #[command(flatten)]
    pub common: CommonArgs,
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
