//! `dipir-lora`: personalises the model to the photograph.
use std::process::ExitCode;

use clap::Parser;
use dipir_cli::args::CommonArgs;
use dipir_cli::exit;
use dipir_cli::session::Session;

const EXAMPLES: &str = "\
Examples:
  dipir-lora                                [lora] of ./pipeline.toml
  dipir-lora --set lora.steps=1000          train longer
  dipir-lora --set lora.learn_word=true     learn an embedding for the word, too
  dipir-lora --set lora.sample_every=100    look at samples on the way
  dipir-lora --set concepts.count=0         without concept preservation

Reads OUT/concepts/, which dipir-concepts writes. Writes OUT/lora/: lora.safetensors (diffusers,
PEFT) lora_kohya.safetensors (A1111, ComfyUI) training.json stage.json.
An interrupted run goes on where it stopped and ends with the same bytes.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Fine-tune a LoRA of the diffusion model on the photograph
///
/// Reads the tables [model], [concepts] and [lora] and the keys scene.background and
/// scene.transfer.
#[derive(Parser)]
#[command(name = "dipir-lora", version, after_help = EXAMPLES)]
struct Cli {
    #[command(flatten)]
    common: CommonArgs,
}

fn main() -> ExitCode {
    exit::run(|| {
        let session = Session::start(&Cli::parse().common)?;
        let done = dipir::lora::run(&session)?;
        session.result(|| done.to_string(), || done.to_json());
        Ok(())
    })
}
