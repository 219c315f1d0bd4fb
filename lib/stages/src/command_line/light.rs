//! The command line.
use clap::Parser;
use dipir_cli::args::CommonArgs;

const EXAMPLES: &str = "\
Examples:
  dipir-light                                 [light] of ./pipeline.toml
  dipir-light --set light.reference=shot.png --set light.guidance=reference
                                                 light under which the object looks as in shot.png
  dipir-light --set light.recover_light=false      under a guidance: tone curves alone
  dipir-light --set 'light.materials=[\"paint\"]' --set light.reference=shot.png
                                                 a material, under [composite] environment
  dipir-light --set pipeline.quality=high     under a guidance: more paths, a larger picture

Reads OUT/scene/, which dipir-scene writes. Writes OUT/light/: lighting.json environment.exr
tone.json stage.json; of an estimate, estimate.json candidates.json candidates.png
surroundings.exr; under guidance, history.json previews/, and reading.json of a model that knows
light; for materials, materials.json history.json.
An interrupted run goes on where it stopped and ends with the same bytes.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Find the light under which the object belongs in the photograph
///
/// Reads the [light] table. By default the light is estimated from the photograph alone. With a
/// guidance, a picture or a diffusion model, light and tone curves are recovered: every iteration
/// replays recorded light transport, which is recorded anew when the light has changed too much.
#[derive(Parser)]
#[command(name = "dipir-light", version, after_help = EXAMPLES)]
pub struct Cli {
    #[command(flatten)]
    pub common: CommonArgs,
}
