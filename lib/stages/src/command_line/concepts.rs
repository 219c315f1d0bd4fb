//! The command line.
use clap::Parser;
use dipir_cli::args::CommonArgs;

const EXAMPLES: &str = "\
Examples:
  dipir-concepts                              [concepts] of ./pipeline.toml
  dipir-concepts --set concepts.count=64      more images; finished ones are kept
  dipir-concepts --set concepts.cache=../cars  share images among scenes of one class and model

Writes OUT/concepts/: images/*.png latents.safetensors concepts.json stage.json.
An interrupted run goes on at the first missing image.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Sample images of the object's class, which keep the class in memory while a LoRA is trained
///
/// Reads the tables [model] and [concepts] and the key scene.class.
#[derive(Parser)]
#[command(name = "dipir-concepts", version, after_help = EXAMPLES)]
pub struct Cli {
    #[command(flatten)]
    pub common: CommonArgs,
}
