//! The command line of `dipir-tradeoff`.
#![allow(missing_docs)] // clap shows doc comments to users: what is flattened has none
use std::path::PathBuf;

use clap::{Parser, ValueEnum};
use dipir_cli::args::OutputArgs;

const EXAMPLES: &str = "\
Examples:
  dipir-tradeoff                           all scenes, both tracks, into ./tradeoff; takes hours, and
                                           says how many; goes on where it was stopped
  dipir-tradeoff --track render            only what compositing costs
  dipir-tradeoff -p photo/pipeline.toml    your own scene, lit by its [composite] environment
  dipir-tradeoff --size 48x32 --repeats 1  a quick look
  dipir-tradeoff --report-only             draw again what has been measured

Writes DIR/tradeoff.json, tradeoff.csv, tradeoff.md, and a plot of each track as SVG and PNG.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Measure what accuracy costs: every knob by itself, the important ones together
///
/// Each point is a run of the executables as a user would run them, with other settings. Its error
/// is the difference from a converged reference; its cost is processor time. Points that
/// nothing beats form the Pareto front; the elbow is where accuracy gets dear.
#[derive(Parser)]
#[command(name = "dipir-tradeoff", version, after_help = EXAMPLES)]
pub struct Cli {
    /// Folder of everything that is written
    #[arg(long, short = 'o', value_name = "DIR", default_value = "tradeoff")]
    pub out: PathBuf,

    /// What is measured
    #[arg(long, value_enum, default_value_t = Track::All)]
    pub track: Track,

    /// Measure this project instead of the built-in scenes; may be repeated. It must name [composite]
    /// environment; only the render track is measured
    #[arg(long, short = 'p', value_name = "FILE")]
    pub pipeline: Vec<PathBuf>,

    /// Only these of the built-in scenes, by name; may be repeated
    #[arg(long, value_name = "NAME")]
    pub scene: Vec<String>,

    /// Only points of this series, as the tables name it: "target error", "depth", "preset"; may be
    /// repeated
    #[arg(long, value_name = "NAME")]
    pub knob: Vec<String>,

    /// Width and height of the built-in scenes' photographs
    #[arg(long, value_name = "WxH", default_value = "144x96", value_parser = parse_size)]
    pub size: [usize; 2],

    /// Runs of every point, each with its own seed; tables have their median time and root mean square
    /// error
    #[arg(long, value_name = "N", default_value_t = 3)]
    pub repeats: u64,

    /// Points of the joint search in each track and scene
    #[arg(long, value_name = "N", default_value_t = 12)]
    pub joint: usize,

    /// Display-referred RMSE at which the reference of the render track stops; smaller errors cannot
    /// be measured
    #[arg(long, value_name = "RMSE", default_value_t = 0.0002)]
    pub reference_error: f64,

    /// Worker threads of the executables, 0 for one a core
    #[arg(long, short = 'j', value_name = "N", default_value_t = 0)]
    pub threads: usize,

    /// Measure nothing: only write tables and plots of what has been measured
    #[arg(long)]
    pub report_only: bool,

    #[command(flatten)]
    pub output: OutputArgs,
}

/// What is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Track {
    /// The composite under a known light: sampling and effects.
    Render,
    /// The light recovered from a picture: record and optimisation.
    Light,
    /// Both.
    All,
}

fn parse_size(text: &str) -> Result<[usize; 2], String> {
    let sides = text.split_once(['x', 'X']).and_then(|(w, h)| {
        let side = |s: &str| s.parse::<usize>().ok().filter(|n| (8..=8192).contains(n));
        Some([side(w)?, side(h)?])
    });
    sides.ok_or_else(|| "accepted: WIDTHxHEIGHT, each 8 to 8192 pixels, as in 144x96".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_two_numbers() {
        assert_eq!(parse_size("144x96"), Ok([144, 96]));
        assert!(parse_size("144").is_err() && parse_size("0x5").is_err());
    }
}
