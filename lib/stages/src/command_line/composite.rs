//! The command line.
use clap::Parser;
use dipir_cli::args::CommonArgs;

const EXAMPLES: &str = "\
Examples:
  dipir-composite                                      composite [scene] of ./pipeline.toml
  dipir-composite --set composite.environment=sky.hdr  light by another map (the path is
                                                       relative to pipeline.toml)
  dipir-composite --target-error 0.01                  stop at a display-referred RMSE of 0.01
  dipir-composite --time-budget 20                     or after 20 seconds

Reads OUT/scene/ and OUT/light/, which dipir-scene and dipir-light write. Writes OUT/composite/:
composite.png, composite.exr (layers: R G B A, object, shadow, background, depth, normal, albedo),
effects.json, stage.json; of a lens that bends lines st_distort.exr st_undistort.exr.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Render the objects and their shadow at full quality and lay them over the photograph
///
/// Reads the [composite] table. The light is [composite] environment if given, else what the
/// light stage recovered.
#[derive(Parser)]
#[command(name = "dipir-composite", version, after_help = EXAMPLES)]
pub struct Cli {
    #[command(flatten)]
    pub common: CommonArgs,

    /// Stop when the estimated error of the composite is at most this display-referred RMSE;
    /// short for --set composite.target_error=RMSE
    #[arg(long, value_name = "RMSE", conflicts_with = "time_budget")]
    pub target_error: Option<f32>,

    /// Stop after about this many seconds; short for --set composite.time_budget_s=SECONDS
    #[arg(long, value_name = "SECONDS")]
    pub time_budget: Option<f64>,
}
