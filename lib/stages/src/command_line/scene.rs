//! The command line.
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use dipir_cli::args::{CommonArgs, OutputArgs};

const EXAMPLES: &str = "\
Examples:
  dipir-scene                                      set up [scene] of ./pipeline.toml
  dipir-scene -p photo/pipeline.toml -o photo/try   another file, another folder
  dipir-scene --set scene.objects.0.yaw_deg=90     turn the first object
  dipir-scene --set scene.effects.mode=all         simulate everything
  dipir-scene background --from sky.hdr --fov 50 --yaw 120 --size 960x640 photo.png
                                                   a photograph out of a panorama

Writes OUT/scene/: scene.json effects.json gbuffer.exr stage.json, and transport.safetensors
where a guidance recovers the light.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Set up the scene: read photo, objects, camera and proxy, and say which effects they can show
///
/// Reads the [scene] table. Which of these effects are worth their time is measured by the first
/// samples of dipir-composite.
#[derive(Parser)]
#[command(name = "dipir-scene", version, after_help = EXAMPLES, args_conflicts_with_subcommands = true)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Option<Command>,

    #[command(flatten)]
    pub common: CommonArgs,
}

#[derive(Subcommand)]
pub enum Command {
    /// Cut a perspective photograph out of a panorama (HDR or EXR)
    Background(BackgroundArgs),
}

#[derive(Args)]
pub struct BackgroundArgs {
    /// The panorama: latitude-longitude, HDR or EXR
    #[arg(long, value_name = "FILE")]
    pub from: PathBuf,

    /// Vertical field of view in degrees
    #[arg(long, value_name = "DEG", default_value_t = 50.0)]
    pub fov: f32,

    /// Turn to the right in degrees; 0 looks along -z, the panorama's left and right edge
    #[arg(
        long,
        value_name = "DEG",
        default_value_t = 0.0,
        allow_negative_numbers = true
    )]
    pub yaw: f32,

    /// Turn upwards in degrees
    #[arg(
        long,
        value_name = "DEG",
        default_value_t = 0.0,
        allow_negative_numbers = true
    )]
    pub pitch: f32,

    /// Width and height in pixels
    #[arg(long, value_name = "WxH", default_value = "960x640", value_parser = parse_size)]
    pub size: [usize; 2],

    /// Exposure in stops [default: log-average to mid-grey; printed, for composite.exposure_ev]
    #[arg(long, value_name = "EV", allow_negative_numbers = true)]
    pub exposure_ev: Option<f32>,

    /// PNG to write
    #[arg(value_name = "OUT.png")]
    pub png: PathBuf,

    #[command(flatten)]
    pub output: OutputArgs,
}

fn parse_size(text: &str) -> Result<[usize; 2], String> {
    let wrong = || "not a size; accepted: WIDTHxHEIGHT in pixels, as in 960x640".to_string();
    let (width, height) = text.split_once(['x', 'X']).ok_or_else(wrong)?;
    let side = |s: &str| match s.parse::<usize>() {
        Ok(n) if (1..=16384).contains(&n) => Ok(n),
        Ok(_) => Err("each side must have 1 to 16384 pixels".to_string()),
        Err(_) => Err(wrong()),
    };
    Ok([side(width)?, side(height)?])
}
