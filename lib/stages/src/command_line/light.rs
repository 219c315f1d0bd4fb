//! The command line.
use clap::Parser;
use dipir_cli::args::CommonArgs;

const EXAMPLES: &str = "\
Examples:
  dipir-light                                 [light] of ./pipeline.toml
  dipir-light --set light.reference=shot.png --set light.guidance=reference
                                                 light under which the object looks as in shot.png
  dipir-light --set light.recover_light=false      tone curves alone
  dipir-light --set 'light.materials=[\"paint\"]'
                                                 a material, under [composite] environment
  dipir-light --set pipeline.quality=high     finer environment, more lobes

Reads OUT/scene/, which dipir-scene writes. Writes OUT/light/: reading.json (of a model that knows
light) lighting.json environment.exr tone.json history.json previews/ stage.json; for materials, materials.json history.json stage.json.
An interrupted run goes on where it stopped and ends with the same bytes.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Recover the light and the tone curves under which the object belongs in the photograph
///
/// Reads the [light] table. Every iteration replays recorded light transport; no path is
/// traced unless the light moves away from what was recorded.
#[derive(Parser)]
#[command(name = "dipir-light", version, after_help = EXAMPLES)]
pub struct Cli {
    #[command(flatten)]
    pub common: CommonArgs,
}
