//! The command line.
use clap::Parser;
use dipir_cli::args::CommonArgs;

const EXAMPLES: &str = "\
Examples:
  dipir-lora                                [lora] of ./pipeline.toml
  dipir-lora --set lora.steps=1000          train longer
  dipir-lora --set lora.learn_word=true     learn an embedding for the word, too
  dipir-lora --set lora.sample_every=100    look at samples on the way
  dipir-lora --set lora.time_budget_s=600   train no longer than that
  dipir-lora --set lora.cache=../loras      train once for all scenes of one photograph
  dipir-lora --set concepts.count=0         without concept preservation
  dipir-lora --set lora.path=my.safetensors use a finished LoRA; nothing is trained

Reads OUT/concepts/, which dipir-concepts writes. Writes OUT/lora/: lora.safetensors (diffusers,
PEFT) lora_kohya.safetensors (A1111, ComfyUI) word.safetensors (with lora.learn_word) sheet.png
(prompts without and with the adapter) samples/ training.json training.csv stage.json.
An interrupted run goes on where it stopped and ends with the same bytes.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Fine-tune a LoRA of the diffusion model on the photograph
///
/// Reads the tables [model], [concepts] and [lora] and the keys scene.background, scene.class and
/// scene.transfer.
#[derive(Parser)]
#[command(name = "dipir-lora", version, after_help = EXAMPLES)]
pub struct Cli {
    #[command(flatten)]
    pub common: CommonArgs,
}
