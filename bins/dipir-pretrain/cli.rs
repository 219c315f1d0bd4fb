//! The command line of `dipir-pretrain`.
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use dipir_cli::args::OutputArgs;
use dipir_prior::blueprint::Blueprint;
use dipir_prior::encoder::EncoderSettings;
use dipir_prior::energy::SHARES;
use dipir_prior::examples::Recipe;
use dipir_prior::trainer::TrainerSettings;

const EXAMPLES: &str = "\
Examples:
  dipir-pretrain train --out model --cache scenes      render scenes, train, write a model folder
  dipir-pretrain encoder --out model --cache scenes    train its light encoder
  dipir-pretrain train --out model --cache scenes --from data/prior --relit 0.4 --learning-rate 4e-4
                                                       train a model further
  dipir-pretrain gates model                           what it can tell, on scenes it never saw
  dipir-pretrain gates model --first 1000 --scenes 48  the same on other scenes, to tune on
  dipir-pretrain sheet model sheet.png                 pictures of its light words

Training goes on from CACHE/checkpoint.safetensors where it stopped. The card of
data/prior says how that model was made, and what came out.
Exit codes: 0 done, 1 failed, 2 wrong usage, 130 interrupted.";

/// Train the small model that knows light, and measure what it can tell
#[derive(Parser)]
#[command(name = "dipir-pretrain", version, after_help = EXAMPLES)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
    #[command(flatten)]
    pub output: OutputArgs,
}

#[derive(Subcommand)]
pub enum Command {
    /// Render training scenes and train text encoder and UNet
    Train(Train),
    /// Train the light encoder of a model
    Encoder(Encoder),
    /// Measure the gates on held-out scenes
    Gates(Gates),
    /// Sample pictures under light words
    Sheet(Sheet),
}

#[derive(Args)]
pub struct Data {
    /// Where the model folder is written
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Where scenes and checkpoints are kept
    #[arg(long, value_name = "DIR")]
    pub cache: PathBuf,
    /// Scenes to render, 350 kB each
    #[arg(long, default_value_t = 6144)]
    pub scenes: usize,
}

#[derive(Args)]
#[command(allow_negative_numbers = true)]
pub struct Train {
    #[command(flatten)]
    pub data: Data,
    /// Examples to train on
    #[arg(long, default_value_t = TrainerSettings::default().samples)]
    pub samples: usize,
    /// Examples of one update
    #[arg(long, default_value_t = TrainerSettings::default().batch)]
    pub batch: usize,
    /// Key of all random numbers
    #[arg(long, default_value_t = TrainerSettings::default().seed)]
    pub seed: u64,
    /// Residual blocks of the UNet at each resolution on the way down; on the way up it has one more. A model that a run
    /// starts from may have fewer
    #[arg(long, default_value_t = Blueprint::default().layers)]
    pub layers: usize,
    /// Share of captions that name the light
    #[arg(long, default_value_t = Recipe::default().light_words)]
    pub light_words: f64,
    /// Share of examples that show the place around the object
    #[arg(long, default_value_t = Recipe::default().background)]
    pub background: f64,
    /// Weight of telling the right light from three wrong ones, whose surprise is 1 at chance; 0: not asked. Three rows
    /// of four are then groups of one noisy picture that four captions are asked about
    #[arg(long, default_value_t = TrainerSettings::default().contrast)]
    pub contrast: f64,
    /// Weight of naming the sun's direction that is seen, whatever is said, by a layer on the middle of the UNet that only
    /// training has; 0: not asked
    #[arg(long, default_value_t = TrainerSettings::default().naming)]
    pub name_light: f64,
    /// Share of examples that are seen under another light than is said, and asked for under the one that is
    #[arg(long, default_value_t = Recipe::default().relit)]
    pub relit: f64,
    /// Learning rate after the warm-up
    #[arg(long, default_value_t = TrainerSettings::default().learning_rate)]
    pub learning_rate: f64,
    /// Model folder whose weights a new run starts from; one that has a checkpoint goes on from that
    #[arg(long, value_name = "MODEL")]
    pub from: Option<PathBuf>,
    /// Updates between checkpoints
    #[arg(long, default_value_t = 200)]
    pub checkpoint_every: usize,
}

#[derive(Args)]
#[command(allow_negative_numbers = true)]
pub struct Encoder {
    #[command(flatten)]
    pub data: Data,
    /// Pictures to train on
    #[arg(long, default_value_t = EncoderSettings::default().samples)]
    pub samples: usize,
    /// Key of all random numbers
    #[arg(long, default_value_t = EncoderSettings::default().seed)]
    pub seed: u64,
    /// Learning rate after the warm-up
    #[arg(long, default_value_t = EncoderSettings::default().learning_rate)]
    pub learning_rate: f64,
    /// Model folder whose encoder it starts from
    #[arg(long, value_name = "MODEL")]
    pub from: Option<PathBuf>,
    /// Also write some of the pictures that it is trained on, side by side
    #[arg(long, value_name = "PNG")]
    pub sheet: Option<PathBuf>,
}

#[derive(Args)]
pub struct Gates {
    /// Folder of the model
    pub model: PathBuf,
    /// Held-out scenes
    #[arg(long, default_value_t = 100)]
    pub scenes: usize,
    /// Number of the first; those of the card are 0 to 99, so choose others to tune on
    #[arg(long, default_value_t = 0)]
    pub first: u64,
    /// Draws of noise at each timestep
    #[arg(long, default_value_t = 4)]
    pub draws: usize,
    /// Timesteps at which lights are compared, shares of all
    #[arg(long, value_delimiter = ',', default_values_t = SHARES)]
    pub timesteps: Vec<f64>,
}

#[derive(Args)]
pub struct Sheet {
    /// Folder of the model
    pub model: PathBuf,
    /// The picture to write
    pub png: PathBuf,
}
