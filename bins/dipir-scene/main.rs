//! `dipir-scene`: sets the scene up for all later stages.
use std::process::ExitCode;

use anyhow::Context;
use dipir_cli::args::CommonArgs;
use dipir_cli::exit::{self, Usage, check_png};
use dipir_cli::output::json_path;
use dipir_cli::session::Session;
use dipir_imaging::exposure::automatic_exposure_ev;
use dipir_imaging::marked_png::{Kind, write_display};
use dipir_imaging::raster::LinearImage;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_stages::command_line::scene::{BackgroundArgs, Cli, Command};
use dipir_stages::scene::background::PanoramaView;
use serde_json::json;

fn main() -> ExitCode {
    exit::run(|| {
        let cli = exit::parse::<Cli>()?;
        match &cli.command {
            Some(Command::Background(args)) => background(args),
            None => set_up(&cli.common),
        }
    })
}

fn set_up(args: &CommonArgs) -> anyhow::Result<()> {
    let session = Session::start(args)?;
    let done = dipir_stages::scene::run(&session)?;
    session.result(|| done.to_string(), || done.to_json());
    Ok(())
}

/// Refuses what gives no photograph.
fn check(args: &BackgroundArgs) -> Result<(), Usage> {
    let ranges = [
        ("--fov", args.fov, 0.1, 179.0),
        ("--yaw", args.yaw, -360.0, 360.0),
        ("--pitch", args.pitch, -90.0, 90.0),
        (
            "--exposure-ev",
            args.exposure_ev.unwrap_or_default(),
            -64.0,
            64.0,
        ),
    ];
    for (option, value, least, most) in ranges {
        if !(least..=most).contains(&value) {
            let message = format!("{option} {value}: accepted: {least} to {most}");
            return Err(Usage(message));
        }
    }
    check_png(&args.png, "the photograph", "photo.png")
}

fn background(args: &BackgroundArgs) -> anyhow::Result<()> {
    check(args)?;
    let map = EnvironmentMap::read(&args.from)
        .with_context(|| format!("cannot cut a photograph out of {}", args.from.display()))?;
    let view = PanoramaView {
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
    write_display(
        &args.png,
        &Transfer::Srgb.encode(&exposed),
        Kind::Photograph,
    )
    .with_context(|| format!("cannot write {}", args.png.display()))?;
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
                "png": json_path(&args.png), "exposure_ev": exposure_ev, "fov_deg": args.fov,
                "forward": -rotation.z_axis,
            })
        },
    );
    Ok(())
}
