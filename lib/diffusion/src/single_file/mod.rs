//! A whole model in one safetensors file, in the layout of the original latent diffusion code [Rombach et al. 2022], as
//! Stable Diffusion 1 and 2 are passed around: `model.diffusion_model.*`, `first_stage_model.*`, `cond_stage_model.*`.
//!
//! Nothing is converted: the file is memory-mapped, and its tensors are read under the names that the layers ask for.
//! Such a file holds weights alone. Sizes are read off the shapes; what shapes do not tell is built in: CLIP's tokenizer,
//! the schedule of both families (scaled linear, 1000 timesteps), 32 groups, heads (8 in family 1, 64 channels each in
//! family 2), the autoencoder's factor .18215.

mod names;
mod sizes;

use std::path::{Path, PathBuf};

use candle_core::{DType, Device};

pub(crate) use names::original_attention;

use crate::error::{Error, Result};
use crate::model::Model;
use crate::parameters::Parameters;
use crate::schedule::{BetaSchedule, NoiseSchedule, Prediction, ScheduleConfig};
use crate::text_encoder::{TextEncoder, TextEncoderConfig};
use crate::tokenizer::{Padding, Tokenizer};
use crate::unet::{UNet, UNetConfig};
use crate::vae::{AutoencoderConfig, AutoencoderKl, Vae};
use crate::weights::Weights;

/// Where the parts begin.
const UNET: &str = "model.diffusion_model.";
const VAE: &str = "first_stage_model.";
const CLIP: &str = "cond_stage_model.transformer.";
const OPEN_CLIP: &str = "cond_stage_model.model.";

/// Which text encoder a file holds: it tells the family.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoder {
    /// CLIP's: Stable Diffusion 1.
    Clip,
    /// OpenCLIP's, with query, key and value in one tensor, of which the last layer is left out: Stable Diffusion 2.
    OpenClip,
}

/// A file and the sizes of the parts in it.
#[derive(Debug)]
pub struct SingleFile {
    path: PathBuf,
    weights: Weights,
    /// Which text encoder.
    pub encoder: Encoder,
    /// Sizes of the UNet.
    pub unet: UNetConfig,
    /// Sizes of the autoencoder.
    pub vae: AutoencoderConfig,
    /// Sizes of the text encoder.
    pub text: TextEncoderConfig,
    /// Noise, and what the UNet predicts.
    pub schedule: ScheduleConfig,
}

impl SingleFile {
    /// Opens a file and reads the sizes off it. What is no Stable Diffusion 1 or 2 is refused by its name. `prediction` is
    /// what the UNet predicts; in family 2 neither names nor shapes tell, so that it is looked for in the header and in a
    /// configuration beside the file (`.yaml` in place of `.safetensors`) if it is not given.
    pub fn open(path: &Path, prediction: Option<Prediction>) -> Result<Self> {
        if path.extension().is_none_or(|e| e != "safetensors") {
            return Err(refused(
                path,
                "accepted is a folder in the layout of diffusers or a file that ends with .safetensors; a .ckpt is a program \
                 as well as weights: convert it first (A1111 and diffusers do)",
            ));
        }
        let weights = Weights::open_file(path)?;
        if let Some(what) = sizes::foreign(&weights) {
            return Err(refused(
                path,
                &format!(
                    "it holds {what}; accepted: Stable Diffusion 1 and 2, plain and inpainting"
                ),
            ));
        }
        let encoder = sizes::encoder(&weights).ok_or_else(|| {
            refused(
                path,
                "it holds no text encoder (cond_stage_model.*); use the full checkpoint",
            )
        })?;
        let missing = |part: &str| refused(path, &format!("tensors of {part} are missing"));
        let unet = sizes::unet(&weights, encoder).ok_or_else(|| missing("the UNet"))?;
        let vae =
            sizes::vae(&weights).ok_or_else(|| missing("the autoencoder (first_stage_model.*)"))?;
        let text = sizes::text(&weights, encoder).ok_or_else(|| missing("the text encoder"))?;
        let prediction = match (prediction, encoder) {
            (Some(given), _) => given,
            (None, Encoder::Clip) => said_prediction(path, &weights)?.unwrap_or(Prediction::Epsilon),
            (None, Encoder::OpenClip) => said_prediction(path, &weights)?.ok_or_else(|| {
                refused(
                    path,
                    "whether a Stable Diffusion 2 predicts noise or v is in no tensor: set [model] prediction = \
                     \"v_prediction\" (2.1 for 768 pixels) or \"epsilon\" (2.1-base for 512), or put its .yaml beside it",
                )
            })?,
        };
        let mut file = Self {
            path: path.to_owned(),
            weights,
            encoder,
            unet,
            vae,
            text,
            schedule: ScheduleConfig {
                beta_start: 0.00085,
                beta_end: 0.012,
                beta_schedule: BetaSchedule::ScaledLinear,
                prediction_type: prediction,
                steps_offset: 1,
                set_alpha_to_one: false,
                ..ScheduleConfig::default()
            },
        };
        // Of the family 2, those for 768 pixels predict v.
        if encoder == Encoder::OpenClip && prediction == Prediction::Velocity {
            file.unet.sample_size = 96;
        }
        Ok(file)
    }

    /// The three networks.
    pub fn networks(&self, dtype: DType, device: &Device) -> Result<(UNet, Vae, TextEncoder)> {
        // The axes of a tensor without numbers are sizes of nothing.
        let extent = self.weights.extent();
        let fits = [
            self.unet.fits(&extent),
            self.vae.fits(&extent),
            self.text.fits(&extent),
        ];
        for part in fits {
            part.map_err(|message| refused(&self.path, &message))?;
        }
        let of = |weights| Parameters::from_weights(weights, dtype, device, false);
        let layers = self.unet.layers_per_block;
        let unet = self.weights.renamed(|name| match name.strip_prefix(UNET) {
            Some(name) => vec![names::unet(name, layers)],
            None => vec![],
        })?;
        let levels = self.vae.block_out_channels.len();
        let vae = self.weights.renamed(|name| match name.strip_prefix(VAE) {
            Some(name) if names::is_of_training(name) => vec![],
            Some(name) => vec![names::vae(name, levels)],
            None => vec![],
        })?;
        let text = self.weights.renamed(|name| {
            match self.encoder {
                Encoder::Clip => name.strip_prefix(CLIP).map(|n| vec![n.to_owned()]),
                Encoder::OpenClip => name
                    .strip_prefix(OPEN_CLIP)
                    .map(|n| names::open_clip(n, self.text.num_hidden_layers)),
            }
            .unwrap_or_default()
        })?;
        let autoencoder = AutoencoderKl::new(self.vae.clone(), of(vae))?;
        Ok((
            UNet::new(self.unet.clone(), of(unet))?,
            Vae::Kl(Box::new(autoencoder)),
            TextEncoder::new(self.text.clone(), of(text))?,
        ))
    }

    /// The model, with CLIP's tokenizer.
    pub fn load(&self, dtype: DType, device: &Device) -> Result<Model> {
        let padding = match self.encoder {
            Encoder::Clip => Padding::End,
            Encoder::OpenClip => Padding::First,
        };
        let (unet, vae, text_encoder) = self.networks(dtype, device)?;
        let schedule = NoiseSchedule::new(self.schedule.clone())?;
        Model::of_parts(
            &self.path,
            Tokenizer::clip(padding)?,
            text_encoder,
            unet,
            vae,
            schedule,
            (dtype, device),
        )
    }
}

fn refused(path: &Path, message: &str) -> Error {
    Error::Config {
        path: path.to_owned(),
        message: message.into(),
    }
}

/// What header or `.yaml` say of the prediction.
fn said_prediction(path: &Path, weights: &Weights) -> Result<Option<Prediction>> {
    let of_word = |word: &str| match word {
        "epsilon" | "eps" => Some(Prediction::Epsilon),
        "v" | "v_prediction" | "v-prediction" => Some(Prediction::Velocity),
        _ => None,
    };
    if let Some(word) = weights.metadata().get("modelspec.prediction_type") {
        return Ok(of_word(word));
    }
    let yaml = path.with_extension("yaml");
    if !yaml.is_file() {
        return Ok(None);
    }
    let text = dipir_files::read_to_string(&yaml).map_err(crate::error::io("read", &yaml))?;
    let mut values = text
        .lines()
        .filter_map(|line| line.trim().strip_prefix("parameterization:"));
    let Some(value) = values.next() else {
        // The original code's default.
        return Ok(Some(Prediction::Epsilon));
    };
    // What follows # is a comment.
    let word = value.split('#').next().unwrap_or_default().trim();
    match of_word(word.trim_matches(['"', '\''])) {
        Some(prediction) => Ok(Some(prediction)),
        None => Err(refused(
            &yaml,
            &format!("parameterization: {word} is not supported; accepted: eps, v"),
        )),
    }
}
