//! `dipir-scene`: sets the scene up for all later stages.
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::{Args, Parser, Subcommand};
use dipir::background::{View, automatic_exposure_ev};
use dipir_cli::args::{CommonArgs, OutputArgs};
use dipir_cli::exit::{self, Usage};
use dipir_cli::session::Session;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::LinearImage;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use serde_json::json;

const EXAMPLES: &str = "\
Examples:
  dipir-scene                                      set up [scene] of ./pipeline.toml
  dipir-scene -p photo/pipeline.toml -o /tmp/try   another file, another folder
  dipir-scene --set scene.objects.0.yaw_deg=90     turn the first object
  dipir-scene --set scene.effects.mode=all         simulate everything
  dipir-scene background --from sky.hdr --fov 50 --yaw 120 --size 960x640 photo.png
                                                   a photograph out of a panorama

Writes OUT/scene/: scene.json effects.json gbuffer.exr stage.json.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Set up the scene: read photo, objects, camera and proxy, and plan which effects to simulate
///
/// Reads the [scene] table. Which effects are worth their time is measured in small pilot
/// renders, under the light of [composite] environment if that is given, else under a sun and
/// sky.
#[derive(Parser)]
#[command(name = "dipir-scene", version, after_help = EXAMPLES, args_conflicts_with_subcommands = true)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,

    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Subcommand)]
enum Command {
    /// Cut a perspective photograph out of a panorama (HDR or EXR)
    Background(BackgroundArgs),
}

#[derive(Args)]
struct BackgroundArgs {
    /// The panorama: latitude-longitude, HDR or EXR
    #[arg(long, value_name = "FILE")]
    from: PathBuf,

    /// Vertical field of view in degrees
    #[arg(long, value_name = "DEG", default_value_t = 50.0)]
    fov: f32,

    /// Turn to the right in degrees; 0 looks along -z, the panorama's left and right edge
    #[arg(
        long,
        value_name = "DEG",
        default_value_t = 0.0,
        allow_negative_numbers = true
    )]
    yaw: f32,

    /// Turn upwards in degrees
    #[arg(
        long,
        value_name = "DEG",
        default_value_t = 0.0,
        allow_negative_numbers = true
    )]
    pitch: f32,

    /// Width and height in pixels
    #[arg(long, value_name = "WxH", default_value = "960x640", value_parser = parse_size)]
    size: [usize; 2],

    /// Exposure in stops [default: log-average to mid-grey; printed, for composite.exposure_ev]
    #[arg(long, value_name = "EV", allow_negative_numbers = true)]
    exposure_ev: Option<f32>,

    /// PNG to write
    #[arg(value_name = "OUT.png")]
    png: PathBuf,

    #[command(flatten)]
    output: OutputArgs,
}

fn main() -> ExitCode {
    exit::run(|| {
        let cli = Cli::parse();
        match &cli.command {
            Some(Command::Background(args)) => background(args),
            None => set_up(&cli.common),
        }
    })
}

fn set_up(args: &CommonArgs) -> anyhow::Result<()> {
    let session = Session::start(args)?;
    let done = dipir::scene::run(&session)?;
    session.result(|| done.to_string(), || done.to_json());
    Ok(())
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

fn background(args: &BackgroundArgs) -> anyhow::Result<()> {
    if !(args.fov > 0.0 && args.fov < 180.0) {
        return Err(Usage(format!(
            "--fov {}: accepted: above 0 and below 180",
            args.fov
        ))
        .into());
    }
    let map = EnvironmentMap::read(&args.from)
        .with_context(|| format!("cannot cut a photograph out of {}", args.from.display()))?;
    let view = View {
        fov_rad: args.fov.to_radians(),
        yaw_rad: args.yaw.to_radians(),
        pitch_rad: args.pitch.to_radians(),
        roll_rad: 0.0,
        width: args.size[0],
        height: args.size[1],
    };
    let image = view.take(&map);
    let exposure_ev = args
        .exposure_ev
        .unwrap_or_else(|| automatic_exposure_ev(&image));
    let gain = exposure_ev.exp2();
    let exposed = LinearImage(image.0.map(|p| *p * gain));
    write_png(&args.png, &Transfer::Srgb.encode(&exposed))?;
    let rotation = view.rotation();
    args.output.result(
        || {
            format!(
                "wrote {}, exposed by {exposure_ev:.3} stops\n\
                 the matching camera: [scene.camera] fov_deg = {}, look_at = position + \
                 [{:.4}, {:.4}, {:.4}]\n\
                 the matching light: [composite] environment = \"{}\", exposure_ev = {exposure_ev:.3}",
                args.png.display(),
                args.fov,
                -rotation.z_axis.x,
                -rotation.z_axis.y,
                -rotation.z_axis.z,
                args.from.display(),
            )
        },
        || {
            json!({
                "png": args.png, "exposure_ev": exposure_ev, "fov_deg": args.fov,
                "forward": -rotation.z_axis,
            })
        },
    );
    Ok(())
}
