//! `dipir`: all stages with one command, each only if it has to run.
mod clean;
mod hashed;
mod init;
mod keys;
mod lock;
mod made;
mod manual;
mod place;
mod plan;
mod preview;
mod project;
mod report;
mod run;
mod shot;
mod status;
mod suggestion;
mod watch;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use dipir_cli::exit;

const EXAMPLES: &str = "\
Examples:
  dipir init photo.jpg chair.glb            write a first pipeline.toml that runs
  dipir place                               a page in the browser: put the objects where they belong
  dipir preview                             preview.png: grid, boxes and a draft, within seconds
  dipir run                                 what ./pipeline.toml says, as far as it is not done yet
  dipir run photo/pipeline.toml             another project; several are run one after the other
  dipir run --set light.iterations=50       a key set for this run; only what it concerns runs
  dipir run --plan                          what would run, how long and with how much memory
  dipir run --until lora                    that stage and what it needs
  dipir run --from light --force            that stage and all that read it, once more
  dipir status                              what would run, and why
  dipir shot frames/*.jpg                   every frame of a shot, under the light of one photograph
  dipir report                              show the run as one page, out/report.html
  dipir keys shadow                         keys of pipeline.toml that are about shadows
  dipir clean                               remove what the stages wrote

  dipir run --set composite.environment=sky.hdr     light by a map of yours instead of an estimate
  dipir run --set model.path=models/sd15    guidance by a Stable Diffusion of yours (dipir-model)

Results, in [pipeline] out: composite/composite.png the picture, composite/composite.exr its layers,
light/environment.exr the light, report.html all of it on one page.
Stages: scene concepts lora light composite. Each is an executable of its own, such as dipir-scene,
and can be run by itself; dipir runs them in order, leaves out what is up to date, and goes on where
it was stopped.
Beside them: dipir-inspect shows what any artifact holds; dipir-model fetches, checks and times
diffusion models; dipir-evaluate and dipir-tradeoff compare methods and settings; dipir-pretrain
trains the small model and the light estimator. Each has --help, and a page in dipir man.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Put a 3D object into a photograph: all stages, each only if it has to run
#[derive(Parser)]
#[command(name = manual::DIPIR, version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Write a first pipeline.toml from a photograph and models
    Init(init::InitArgs),
    /// Open a page in the browser on which objects are placed, and the camera and the light set
    Place(place::PlaceArgs),
    /// Draw ground grid, horizon, boxes and a draft of the objects into a PNG
    Preview(preview::PreviewArgs),
    /// Run what is not up to date
    Run(run::RunArgs),
    /// Put the objects into every frame of a shot, under one light
    Shot(shot::ShotArgs),
    /// Say of each stage whether it is up to date, and if not, why
    Status(status::StatusArgs),
    /// Show which stage reads which
    Graph(status::GraphArgs),
    /// Show what the stages wrote as one page, complete in itself
    Report(report::ReportArgs),
    /// Remove what stages wrote
    Clean(clean::CleanArgs),
    /// Show the keys of pipeline.toml: what they accept, their defaults, what they are
    Keys(keys::KeysArgs),
    /// Print what makes a shell complete the options of an executable
    Completions(manual::CompletionsArgs),
    /// Print the manual page of an executable, or write those of all
    Man(manual::ManArgs),
}

fn main() -> ExitCode {
    exit::run(|| match suggestion::parse()?.command {
        Command::Init(args) => init::run(&args),
        Command::Place(args) => place::run(&args),
        Command::Preview(args) => preview::run(&args),
        Command::Run(args) => run::run(&args),
        Command::Shot(args) => shot::run(&args),
        Command::Status(args) => status::run(&args),
        Command::Graph(args) => status::graph(&args),
        Command::Report(args) => report::run(&args),
        Command::Clean(args) => clean::run(&args),
        Command::Keys(args) => keys::run(&args),
        Command::Completions(args) => manual::completions(&args),
        Command::Man(args) => manual::man(&args),
    })
}
