//! The command line of `dipir-pretrain`, and the settings that it asks for.
#![allow(missing_docs)] // clap shows doc comments to users: what is flattened has none
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use dipir_cli::args::OutputArgs;
use dipir_cli::exit::Usage;
use dipir_places::Settings as LightSettings;
use dipir_places::trainer::Training;
use dipir_prior::energy::TIMESTEP_SHARES;

use crate::architecture::Architecture;
use crate::encoder_training::EncoderSettings;
use crate::examples::Recipe;
use crate::trainer::TrainerSettings;
use crate::training_run::{EncoderRun, ModelRunSettings};

const EXAMPLES: &str = "\
Examples:
  dipir-pretrain train --out model --cache scenes      render scenes, train, write a model folder
  dipir-pretrain encoder --out model --cache scenes    train its light encoder
  dipir-pretrain train --out model --cache scenes --from data/prior --relit 0.4 --learning-rate 4e-4
                                                       continue the training of a model
  dipir-pretrain light panoramas places.safetensors    train the light estimator on real places
  dipir-pretrain check model                           how well it recognises light in new scenes
  dipir-pretrain check model --first 1000 --scenes 48  the same on other scenes, to tune on
  dipir-pretrain sheet model sheet.png                 pictures under captions of light

An interrupted `train` goes on from CACHE/checkpoint.safetensors; `light` keeps the folds that were
finished; `encoder` begins its run anew. data/prior/README.md says how that model was made.
Exit codes: 0 done, 1 failed, 2 wrong usage, 130 interrupted.";

/// Train the small model and the light estimator, and measure them
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
    Train(TrainArgs),
    /// Train the light encoder of a model
    Encoder(EncoderArgs),
    /// Train the light estimator on panoramas of real places, and measure it on places left out
    Light(LightArgs),
    /// Print the folds of the places of a folder, for lib/estimator/weights/tune.py: a name, a tab and a number a line
    Folds(FoldsArgs),
    /// Measure how well a model recognises light, on held-out scenes
    Check(CheckArgs),
    /// Sample pictures under captions of light
    Sheet(SheetArgs),
}

#[derive(Args)]
pub struct DataArgs {
    /// Folder of the model to be written
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Folder that keeps scenes and checkpoints
    #[arg(long, value_name = "DIR")]
    pub cache: PathBuf,
    /// Scenes to render, 350 kB each
    #[arg(long, default_value_t = 6144)]
    pub scenes: usize,
}

impl DataArgs {
    fn check(&self) -> Result<(), Usage> {
        match self.scenes {
            0 => Err(Usage("--scenes 0: at least one scene is needed".into())),
            _ => Ok(()),
        }
    }
}

#[derive(Args)]
#[command(allow_negative_numbers = true)]
pub struct TrainArgs {
    #[command(flatten)]
    pub data: DataArgs,
    /// Examples to train on
    #[arg(long, default_value_t = TrainerSettings::default().samples)]
    pub samples: usize,
    /// Examples of an update
    #[arg(long, default_value_t = TrainerSettings::default().batch)]
    pub batch: usize,
    /// Key of all random numbers
    #[arg(long, default_value_t = TrainerSettings::default().seed)]
    pub seed: u64,
    /// Residual blocks of each level of the UNet's downward half; the upward half has one more. A model that a run
    /// starts from may have fewer
    #[arg(long, default_value_t = Architecture::default().layers)]
    pub layers: usize,
    /// Share of captions that describe the light
    #[arg(long, default_value_t = Recipe::default().light_captions)]
    pub light_captions: f64,
    /// Share of examples in which the surroundings of the object are visible
    #[arg(long, default_value_t = Recipe::default().background)]
    pub background: f64,
    /// Weight of the contrastive loss of the right caption among three alternatives, which is 1 at chance. 0: none.
    /// Otherwise three rows of four are groups of one noisy picture with four captions
    #[arg(long, default_value_t = TrainerSettings::default().contrast)]
    pub contrast: f64,
    /// Share of examples whose noisy picture has another light than the caption and the target
    #[arg(long, default_value_t = Recipe::default().relit)]
    pub relit: f64,
    /// Learning rate after the warm-up
    #[arg(long, default_value_t = TrainerSettings::default().learning_rate)]
    pub learning_rate: f64,
    /// Model folder whose weights a new run starts from; a run with a checkpoint continues from that
    #[arg(long, value_name = "MODEL")]
    pub from: Option<PathBuf>,
    /// Updates between checkpoints
    #[arg(long, default_value_t = 200)]
    pub checkpoint_every: usize,
}

impl TrainArgs {
    /// The run of these arguments. An error names a value that is out of range.
    pub fn run(&self) -> Result<ModelRunSettings, Usage> {
        for (name, share) in [
            ("light-captions", self.light_captions),
            ("background", self.background),
            ("relit", self.relit),
        ] {
            if !(0.0..=1.0).contains(&share) {
                return Err(Usage(format!("--{name} {share}: accepted are 0 to 1")));
            }
        }
        let contrast = self.contrast;
        if !(contrast >= 0.0 && contrast.is_finite()) {
            let message = format!("--contrast {contrast}: accepted are 0 and more");
            return Err(Usage(message));
        }
        check_rate(self.learning_rate)?;
        if !(1..=8).contains(&self.layers) {
            let message = format!("--layers {}: accepted are 1 to 8", self.layers);
            return Err(Usage(message));
        }
        self.data.check()?;
        Ok(ModelRunSettings {
            out: self.data.out.clone(),
            cache: self.data.cache.clone(),
            from: self.from.clone(),
            checkpoint_every: self.checkpoint_every,
            architecture: Architecture {
                layers: self.layers,
                ..Architecture::default()
            },
            settings: TrainerSettings {
                samples: self.samples,
                batch: self.batch,
                seed: self.seed,
                contrast,
                learning_rate: self.learning_rate,
            },
            recipe: Recipe {
                light_captions: self.light_captions,
                background: self.background,
                relit: self.relit,
                ..Recipe::default()
            },
        })
    }
}

#[derive(Args)]
#[command(allow_negative_numbers = true)]
pub struct EncoderArgs {
    #[command(flatten)]
    pub data: DataArgs,
    /// Pictures to train on
    #[arg(long, default_value_t = EncoderSettings::default().samples)]
    pub samples: usize,
    /// Key of all random numbers
    #[arg(long, default_value_t = EncoderSettings::default().seed)]
    pub seed: u64,
    /// Learning rate after the warm-up
    #[arg(long, default_value_t = EncoderSettings::default().learning_rate)]
    pub learning_rate: f64,
    /// Model folder whose encoder the run starts from
    #[arg(long, value_name = "MODEL")]
    pub from: Option<PathBuf>,
    /// Also write some of the training's pictures, side by side
    #[arg(long, value_name = "PNG")]
    pub sheet: Option<PathBuf>,
}

impl EncoderArgs {
    /// The run of these arguments. An error names a value that is out of range.
    pub fn run(&self) -> Result<EncoderRun, Usage> {
        check_rate(self.learning_rate)?;
        if self.samples == 0 {
            return Err(Usage("--samples 0: at least one picture is needed".into()));
        }
        self.data.check()?;
        Ok(EncoderRun {
            out: self.data.out.clone(),
            from: self.from.clone(),
            sheet: self.sheet.clone(),
            settings: EncoderSettings {
                samples: self.samples,
                seed: self.seed,
                learning_rate: self.learning_rate,
            },
        })
    }
}

#[derive(Args)]
#[command(allow_negative_numbers = true)]
pub struct LightArgs {
    /// Folder of panoramas, HDR or EXR; panoramas.tsv in it (columns name, kind) may name kinds of places
    #[arg(value_name = "PANORAMAS")]
    pub panoramas: PathBuf,
    /// The weights to write; figures are written beside them as .json
    #[arg(value_name = "OUT")]
    pub out: PathBuf,
    /// Folds of places; each is left out once
    #[arg(long, value_name = "N", default_value_t = 5)]
    pub folds: usize,
    /// Networks of each fold, whose answers are averaged
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub networks: usize,
    /// Photographs of each place to train on
    #[arg(long, value_name = "N", default_value_t = 256)]
    pub views: usize,
    /// Photographs of each place on which the networks are judged
    #[arg(long, value_name = "N", default_value_t = 8)]
    pub judged: usize,
    /// Train on at most this many places of each fold: for the error over the number of places
    #[arg(long, value_name = "N")]
    pub places: Option<usize>,
    /// Tunings of the backbone by lib/estimator/weights/tune.py, one for each fold
    #[arg(long, value_name = "FILE")]
    pub tuned: Option<PathBuf>,
    /// Key of all random numbers
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Units of each hidden layer
    #[arg(long, value_name = "N", default_value_t = Training::default().hidden)]
    pub hidden: usize,
    /// Passes over all photographs
    #[arg(long, value_name = "N", default_value_t = Training::default().epochs)]
    pub epochs: usize,
    /// Share of hidden units that a step leaves out
    #[arg(long, value_name = "SHARE", default_value_t = Training::default().dropout)]
    pub dropout: f32,
    /// Share of a weight that a unit of learning rate removes
    #[arg(long, value_name = "SHARE", default_value_t = Training::default().weight_decay)]
    pub decay: f32,
    /// Highest learning rate
    #[arg(long, value_name = "RATE", default_value_t = Training::default().learning_rate)]
    pub learning_rate: f32,
    /// Keep the networks that each fold was left out of as OUT.foldN, for dipir-evaluate left-out
    #[arg(long)]
    pub keep_folds: bool,
}

impl LightArgs {
    /// The training of these arguments. An error names a value that is out of range.
    pub fn settings(&self) -> Result<LightSettings, Usage> {
        check_rate(f64::from(self.learning_rate))?;
        let decay = self.decay;
        if !(decay >= 0.0 && decay.is_finite()) {
            let message = format!("--decay {decay}: accepted are 0 and more");
            return Err(Usage(message));
        }
        if self.epochs == 0 {
            return Err(Usage("--epochs 0: at least one pass is needed".into()));
        }
        Ok(LightSettings {
            folds: self.folds,
            networks: self.networks,
            views: self.views,
            judged: self.judged,
            places: self.places,
            tuned: self.tuned.clone(),
            seed: self.seed,
            training: Training {
                hidden: self.hidden,
                epochs: self.epochs,
                dropout: self.dropout,
                weight_decay: self.decay,
                learning_rate: self.learning_rate,
                ..Training::default()
            },
            keep: self.keep_folds,
            ..LightSettings::new(self.panoramas.clone(), self.out.clone())
        })
    }
}

#[derive(Args)]
pub struct FoldsArgs {
    /// Folder of panoramas
    #[arg(value_name = "PANORAMAS")]
    pub panoramas: PathBuf,
    /// Folds of places
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u64).range(2..=1000))]
    pub folds: u64,
}

#[derive(Args)]
pub struct CheckArgs {
    /// Folder of the model
    pub model: PathBuf,
    /// Held-out scenes
    #[arg(long, default_value_t = 100)]
    pub scenes: usize,
    /// Number of the first scene; published figures are of 0 to 99, so choose others to tune on
    #[arg(long, default_value_t = 0)]
    pub first: u64,
    /// Draws of noise at each timestep
    #[arg(long, default_value_t = 4)]
    pub draws: usize,
    /// Timesteps at which lights are compared, shares of all
    #[arg(long, value_delimiter = ',', default_values_t = TIMESTEP_SHARES)]
    pub timesteps: Vec<f64>,
}

impl CheckArgs {
    /// Refuses values that are out of range.
    pub fn check(&self) -> Result<(), Usage> {
        if self.scenes == 0 || self.draws == 0 {
            return Err(Usage("--scenes and --draws must be at least 1".into()));
        }
        match self.timesteps.iter().find(|t| !(0.0..1.0).contains(*t)) {
            Some(t) => Err(Usage(format!("--timesteps {t}: accepted are 0 to below 1"))),
            None => Ok(()),
        }
    }
}

#[derive(Args)]
pub struct SheetArgs {
    /// Folder of the model
    pub model: PathBuf,
    /// The picture to write
    pub png: PathBuf,
}

fn check_rate(rate: f64) -> Result<(), Usage> {
    match rate > 0.0 && rate.is_finite() {
        true => Ok(()),
        false => {
            let message = format!("--learning-rate {rate}: accepted are numbers above 0");
            Err(Usage(message))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Why the arguments are refused, if they are.
    fn refusal(args: &[&str]) -> Option<String> {
        let cli = Cli::try_parse_from([&["dipir-pretrain"], args].concat());
        let checked = match cli.expect("arguments").command {
            Command::Encoder(args) => args.run().map(|_| ()),
            Command::Light(args) => args.settings().map(|_| ()),
            _ => unreachable!("not tested here"),
        };
        checked.err().map(|Usage(message)| message)
    }

    #[test]
    fn trainings_of_nothing_or_out_of_range_are_refused_by_option() {
        for (option, value) in [
            ("--decay", "nan"),
            ("--decay", "inf"),
            ("--decay", "-0.5"),
            ("--learning-rate", "nan"),
            ("--epochs", "0"),
        ] {
            let message = refusal(&["light", "panoramas", "out", option, value]).expect(option);
            assert!(message.starts_with(option), "{message}");
        }
        assert_eq!(
            refusal(&["light", "panoramas", "out", "--decay", "0"]),
            None
        );
        let encoder = ["encoder", "--out", "model", "--cache", "cache"];
        assert_eq!(
            refusal(&[&encoder[..], &["--samples", "0"]].concat()).as_deref(),
            Some("--samples 0: at least one picture is needed")
        );
        assert_eq!(refusal(&encoder), None);
    }
}
