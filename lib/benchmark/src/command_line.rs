//! The command line of `dipir-evaluate`.
#![allow(missing_docs)] // clap shows doc comments to users: what is flattened has none
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use dipir_cli::args::OutputArgs;

const EXAMPLES: &str = "\
Examples:
  dipir-evaluate make --hdri maps/ --models glb/ --count 20    20 scenes with their true light
  dipir-evaluate make --generated 20 --size 96x96              20 scenes of the project's generator
  dipir-evaluate run --method neutral --method fitted          some of the methods
  dipir-evaluate run --jobs 4                                  all of them, four scenes at a time
  dipir-evaluate run --model path/to/model                     with another diffusion model
  dipir-evaluate run --environment-from estimates/             another estimator's maps: SCENE.exr
  dipir-evaluate report                                        tables and a page of what is there
  dipir-evaluate report --scene generated                      of some scenes
  dipir-evaluate report --lpips alex.safetensors               with LPIPS
  dipir-evaluate study page --method ours                      a page that asks people
  dipir-evaluate study count answers/*.json                    majorities of the answers
  dipir-evaluate left-out maps/ places.safetensors             composites on places left out
  dipir-evaluate spheres true.exr estimate.exr                 two lights, by three spheres

Everything is in one folder, ./evaluation unless --out says otherwise: scenes/, runs/, work/,
report.*, study.html, left-out.*.
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 130 interrupted.";

/// Measure how good the light of a method is, on scenes whose true light is known
#[derive(Parser)]
#[command(name = "dipir-evaluate", version, after_help = EXAMPLES)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Subcommand)]
pub enum Command {
    /// Make scenes with a known light, from panoramas and models or by the project's generator
    Make(MakeArgs),
    /// Run methods on all scenes, as far as that is not done yet
    Run(RunArgs),
    /// Write tables and a page of all scores
    Report(ReportArgs),
    /// Ask people which of two results looks more real
    #[command(subcommand)]
    Study(StudyCommand),
    /// List the methods
    Methods(MethodsArgs),
    /// Compare composites under the estimated light on places that its networks were not trained on
    LeftOut(LeftOutArgs),
    /// Compare two lights by a mirror, a glossy and a diffuse sphere
    Spheres(SpheresArgs),
}

/// Where the evaluation is, and what is printed.
#[derive(Args)]
pub struct FolderArgs {
    /// Folder of the evaluation
    #[arg(long, short = 'o', value_name = "DIR", default_value = "evaluation")]
    pub out: PathBuf,

    #[command(flatten)]
    pub output: OutputArgs,
}

#[derive(Args)]
pub struct MakeArgs {
    #[command(flatten)]
    pub folder: FolderArgs,

    /// Folder of panoramas, HDR or EXR, latitude-longitude
    #[arg(long, value_name = "DIR")]
    pub hdri: Option<PathBuf>,

    /// Folder of models, GLB, glTF or OBJ [default: a matte, a glossy and a metal knot]
    #[arg(long, value_name = "DIR")]
    pub models: Option<PathBuf>,

    /// Scenes to make of panoramas: every pair of panorama and model comes once before one comes again
    #[arg(long, value_name = "N", default_value_t = 10)]
    pub count: u64,

    /// Scenes to make of the project's own generator: a capsule or a pyramid among other solids under a
    /// sun, square
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub generated: u64,

    /// Where generated places are
    #[arg(long, value_enum, default_value_t = Places::Open)]
    pub places: Places,

    /// Table of what kind of place each panorama shows: a line for each, its file's name without the
    /// extension, a tab, the kind. The report has a table by kind
    #[arg(long, value_name = "TSV", requires = "hdri")]
    pub kinds: Option<PathBuf>,

    /// Seed of what is drawn; scenes of one kind in a folder have one
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,

    /// Width and height of the photographs; scenes of one kind in a folder have the same
    #[arg(long, value_name = "WxH", default_value = "192x128", value_parser = parse_size)]
    pub size: [usize; 2],
}

/// Kinds of generated places.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Places {
    /// On open ground
    Open,
    /// In front of houses and trees
    Street,
    /// Among things of all sizes, between walls
    Yard,
}

#[derive(Args)]
pub struct RunArgs {
    #[command(flatten)]
    pub folder: FolderArgs,

    /// Only these methods, by name, beside those of --environment-from; may be repeated
    #[arg(long, value_name = "NAME")]
    pub method: Vec<String>,

    /// More methods, in a file like that which `methods --toml` prints
    #[arg(long, value_name = "FILE")]
    pub methods: Option<PathBuf>,

    /// Maps that another estimator made, DIR/SCENE.exr or .hdr, directions as in the true map of the scene and radiance on the
    /// photograph's scale (the true map times 2^exposure_ev, both in its scene.json): a method called like the folder; may be
    /// repeated
    #[arg(long, value_name = "DIR")]
    pub environment_from: Vec<PathBuf>,

    /// Only scenes whose names begin like this; may be repeated
    #[arg(long, value_name = "NAME")]
    pub scene: Vec<String>,

    /// The diffusion model of the methods that ask one and have none of their own [default: the embedded one]. Methods
    /// that need a model that knows light are left out where this one does not
    #[arg(long, value_name = "DIR")]
    pub model: Option<PathBuf>,

    /// Set a key for every method, as in --set lora.steps=200, that none of them sets itself; may be repeated. Relative
    /// concepts.cache and lora.cache start from the evaluation's folder
    #[arg(long = "set", short = 's', value_name = "KEY=VALUE")]
    pub set: Vec<String>,

    /// Display-referred RMSE of every composite
    #[arg(long, value_name = "RMSE", default_value_t = 0.004)]
    pub target_error: f64,

    /// Scenes at a time
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub jobs: usize,

    /// Worker threads in all, 0 for one a core
    #[arg(long, short = 'j', value_name = "N", default_value_t = 0)]
    pub threads: usize,
}

#[derive(Args)]
pub struct ReportArgs {
    #[command(flatten)]
    pub folder: FolderArgs,

    /// The method that others are compared with, scene by scene [default: ours, else neutral]
    #[arg(long, value_name = "NAME")]
    pub baseline: Option<String>,

    /// Weights of LPIPS with AlexNet, to compute that, too: the tensors of
    /// lpips.LPIPS(net="alex").state_dict() as safetensors
    #[arg(long, value_name = "FILE")]
    pub lpips: Option<PathBuf>,

    /// Only scenes whose names begin like this; may be repeated
    #[arg(long, value_name = "NAME")]
    pub scene: Vec<String>,
}

#[derive(Args)]
pub struct MethodsArgs {
    /// Print the table itself, to start one of your own from
    #[arg(long)]
    pub toml: bool,

    #[command(flatten)]
    pub output: OutputArgs,
}

#[derive(Args)]
pub struct SpheresArgs {
    /// The true light: latitude-longitude, HDR or EXR
    #[arg(value_name = "TRUE")]
    pub truth: PathBuf,

    /// The estimated one, on the same scale
    #[arg(value_name = "ESTIMATED")]
    pub estimate: PathBuf,

    /// Write the spheres under both as a PNG: a row of the truth above a row of the estimate
    #[arg(long, value_name = "FILE")]
    pub png: Option<PathBuf>,

    #[command(flatten)]
    pub output: OutputArgs,
}

#[derive(Args)]
pub struct LeftOutArgs {
    #[command(flatten)]
    pub folder: FolderArgs,

    /// Folder of the panoramas that the estimator was trained on
    #[arg(value_name = "PANORAMAS")]
    pub panoramas: PathBuf,

    /// The weights that the training wrote, with the networks of each fold beside them
    #[arg(value_name = "WEIGHTS")]
    pub weights: PathBuf,

    /// Folder of models, GLB, glTF or OBJ, beside the generator's solids
    #[arg(long, value_name = "DIR")]
    pub models: Option<PathBuf>,

    /// Views of each place
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub views: usize,

    /// Seed of views and objects
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,

    /// Display-referred RMSE of every composite
    #[arg(long, value_name = "RMSE", default_value_t = 0.015)]
    pub target_error: f32,

    /// Render the estimate with parts of it replaced by the truth's, too
    #[arg(long)]
    pub parts: bool,

    /// Write photograph, truth, neutral light and estimate of this many scenes as left-out.png
    #[arg(long, value_name = "N", default_value_t = 24)]
    pub sheet: usize,
}

#[derive(Subcommand)]
pub enum StudyCommand {
    /// Write the page, complete in itself, that shows pairs and keeps the choices
    Page(StudyPageArgs),
    /// Count the choices: majorities, intervals, chances
    Count(StudyCountArgs),
}

#[derive(Args)]
pub struct StudyPageArgs {
    #[command(flatten)]
    pub folder: FolderArgs,

    /// The method that is compared with others
    #[arg(long, value_name = "NAME", default_value = "ours")]
    pub method: String,

    /// The others [default: every method that ran]; may be repeated
    #[arg(long, value_name = "NAME")]
    pub against: Vec<String>,

    /// Seed of the order and the sides; another one for every participant
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

#[derive(Args)]
pub struct StudyCountArgs {
    /// Files that the page saved
    #[arg(required = true, value_name = "FILE")]
    pub answers: Vec<PathBuf>,

    /// The method that is asked about
    #[arg(long, value_name = "NAME", default_value = "ours")]
    pub method: String,

    #[command(flatten)]
    pub output: OutputArgs,
}

fn parse_size(text: &str) -> Result<[usize; 2], String> {
    let sides = text.split_once(['x', 'X']).and_then(|(w, h)| {
        let side = |s: &str| s.parse::<usize>().ok().filter(|n| (8..=8192).contains(n));
        Some([side(w)?, side(h)?])
    });
    sides.ok_or_else(|| "accepted: WIDTHxHEIGHT, each 8 to 8192 pixels, as in 192x128".into())
}
