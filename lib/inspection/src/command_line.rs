//! The command line of `dipir-inspect`.
#![allow(missing_docs)] // clap shows doc comments to users: what is flattened has none
use std::path::PathBuf;

use clap::{Args, Parser};
use dipir_cli::args::OutputArgs;

const EXAMPLES: &str = "\
Examples:
  dipir-inspect out/scene                      a stage's folder, its files checked by hash
  dipir-inspect out/composite/composite.exr    layers, ranges, NaNs
  dipir-inspect sky.hdr --png sky.png          an environment map, its peak marked
  dipir-inspect out/composite/composite.exr --png shadow.png --layer shadow
  dipir-inspect --json out/scene/effects.json  the same for a program

Exit codes: 0 whole, 1 damaged or unreadable, 2 wrong usage.";

/// Show any artifact: images, stage folders, JSON, safetensors, 3D objects
#[derive(Parser)]
#[command(name = "dipir-inspect", version, after_help = EXAMPLES)]
pub struct Cli {
    /// Files or stage folders
    #[arg(required = true, value_name = "PATH")]
    pub paths: Vec<PathBuf>,

    #[command(flatten)]
    pub view: ViewArgs,

    #[command(flatten)]
    pub output: OutputArgs,
}

/// Options of the picture.
#[derive(Args, Clone, Debug, Default)]
pub struct ViewArgs {
    /// Write a PNG of the image: tone-mapped if it is an environment map, whose brightest
    /// texel gets a ring
    #[arg(long, value_name = "FILE")]
    pub png: Option<PathBuf>,

    /// Layer of an EXR file to show, as in shadow, depth or normal [default: beauty]
    #[arg(long, value_name = "NAME", requires = "png")]
    pub layer: Option<String>,

    /// Stops of exposure on top of the automatic one [default: 0]
    #[arg(
        long,
        value_name = "EV",
        requires = "png",
        allow_negative_numbers = true
    )]
    pub exposure_ev: Option<f32>,
}
