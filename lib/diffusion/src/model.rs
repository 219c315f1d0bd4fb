//! A whole model: a folder in the diffusers layout.

use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};

use crate::config::ConfigFile;
use crate::error::{Error, Result};
use crate::parameters::Parameters;
use crate::schedule::{NoiseSchedule, Prediction};
use crate::single_file::SingleFile;
use crate::text_encoder::{LearnedTokens, TextEncoder};
use crate::tokenizer::Tokenizer;
use crate::unet::{UNet, UNetConfig};
use crate::vae::Vae;
use crate::weights::Weights;

/// Longest side of the images that a model is trained on, pixels: four times that of the largest published ones. The
/// memory of attention grows with its fourth power.
const MAX_SIDE: usize = 4096;

/// Text encoder, UNet and autoencoder with their tokenizer and schedule.
#[derive(Debug)]
pub struct Model {
    /// The folder, or the file, that it came from.
    pub folder: PathBuf,
    /// Text to tokens.
    pub tokenizer: Tokenizer,
    /// Tokens to states.
    pub text_encoder: TextEncoder,
    /// The denoiser.
    pub unet: UNet,
    /// Images to latents and back.
    pub vae: Vae,
    /// Signal and noise by timestep.
    pub schedule: NoiseSchedule,
    device: Device,
    dtype: DType,
}

impl Model {
    /// The side of the images that the model was trained on, in pixels.
    pub fn native_size(&self) -> usize {
        self.unet.config().sample_size * self.vae.downscale()
    }

    /// Loads `model_index.json` and the folders `tokenizer`, `text_encoder`,
    /// `unet`, `vae` and `scheduler`. Half-precision weights are converted to
    /// `dtype`, which has to be f32 on the CPU. Checks that the parts fit
    /// each other.
    pub fn load(folder: &Path, dtype: DType, device: &Device) -> Result<Self> {
        Self::load_as(folder, None, dtype, device)
    }

    /// As [`Self::load`]; `prediction` is what the UNet predicts, whatever
    /// `scheduler_config.json` says.
    pub fn load_as(
        folder: &Path,
        prediction: Option<Prediction>,
        dtype: DType,
        device: &Device,
    ) -> Result<Self> {
        check_precision(dtype, device)?;
        refuse_part_or_cache(folder)?;
        refuse_foreign(&ConfigFile::read(&folder.join("model_index.json"))?)?;
        // What is small comes first: its errors cost nothing.
        let schedule = NoiseSchedule::load_as(&folder.join("scheduler"), prediction)?;
        let tokenizer = Tokenizer::load(&folder.join("tokenizer"))?;
        let text_encoder = TextEncoder::load(&folder.join("text_encoder"), dtype, device)?;
        let unet = load_unet(&folder.join("unet"), dtype, device)?;
        let vae = Vae::load(&folder.join("vae"), dtype, device)?;
        let placed = (dtype, device);
        Self::of_parts(folder, tokenizer, text_encoder, unet, vae, schedule, placed)
    }

    /// Loads a whole model in one safetensors file of the original layout
    /// ([`crate::single_file`]); `prediction` is what its UNet predicts,
    /// where the file does not tell.
    pub fn load_file(
        path: &Path,
        prediction: Option<Prediction>,
        dtype: DType,
        device: &Device,
    ) -> Result<Self> {
        check_precision(dtype, device)?;
        SingleFile::open(path, prediction)?.load(dtype, device)
    }

    /// Puts parts together that are in memory; `path` is where they came
    /// from. Checks that they fit each other.
    pub(crate) fn of_parts(
        path: &Path,
        mut tokenizer: Tokenizer,
        text_encoder: TextEncoder,
        unet: UNet,
        vae: Vae,
        schedule: NoiseSchedule,
        (dtype, device): (DType, &Device),
    ) -> Result<Self> {
        tokenizer.limit_length(text_encoder.config().max_position_embeddings);
        let model = Self {
            folder: path.to_owned(),
            tokenizer,
            text_encoder,
            unet,
            vae,
            schedule,
            device: device.clone(),
            dtype,
        };
        model.check()?;
        Ok(model)
    }

    fn check(&self) -> Result<()> {
        let fail = |message: String| {
            Err(Error::Config {
                path: match self.folder.is_file() {
                    true => self.folder.clone(),
                    false => self.folder.join("model_index.json"),
                },
                message: format!("the parts do not fit: {message}"),
            })
        };
        let (unet, text) = (self.unet.config(), self.text_encoder.config());
        if unet.cross_attention_dim != text.hidden_size {
            return fail(format!(
                "unet has cross_attention_dim {}, text_encoder has hidden_size {}",
                unet.cross_attention_dim, text.hidden_size
            ));
        }
        let (size, downscale) = (unet.sample_size, self.vae.downscale());
        if size * downscale > MAX_SIDE {
            return fail(format!(
                "unet has sample_size {size}, and vae makes {downscale} pixels of each latent one: images of {} \
                 pixels a side; accepted: up to {MAX_SIDE}",
                size * downscale
            ));
        }
        let latent = self.vae.latent_channels();
        if unet.out_channels != latent || ![latent, 2 * latent + 1].contains(&unet.in_channels) {
            return fail(format!(
                "unet takes {} channels and gives {}, vae has {latent}; accepted: {latent} or {} to {latent}",
                unet.in_channels,
                unet.out_channels,
                2 * latent + 1
            ));
        }
        if self.tokenizer.vocab_size() > text.vocab_size {
            return fail(format!(
                "tokenizer has {} tokens, text_encoder has vocab_size {}",
                self.tokenizer.vocab_size(),
                text.vocab_size
            ));
        }
        Ok(())
    }

    /// Where the weights live.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Precision of weights and activations.
    pub fn dtype(&self) -> DType {
        self.dtype
    }

    /// Whether the UNet takes mask and masked latents too.
    pub fn is_inpainting(&self) -> bool {
        self.unet.config().in_channels != self.vae.latent_channels()
    }

    /// States of prompts, [prompts, tokens, width].
    pub fn encode_prompts(
        &self,
        prompts: &[&str],
        learned: Option<&LearnedTokens>,
    ) -> Result<Tensor> {
        let tokens = prompts
            .iter()
            .map(|p| self.tokenizer.encode(p))
            .collect::<Result<Vec<_>>>()?;
        self.text_encoder.forward(&tokens, learned)
    }
}

/// Refuses a folder below or above a model's: one of its parts, or the hub's cache of it.
fn refuse_part_or_cache(folder: &Path) -> Result<()> {
    if folder.join("model_index.json").exists() {
        return Ok(());
    }
    let fail = |message: String| {
        Err(Error::Config {
            path: folder.to_owned(),
            message: format!("no model_index.json is in it; {message}"),
        })
    };
    let entries = std::fs::read_dir(folder.join("snapshots"));
    let names = entries.into_iter().flatten().flatten();
    let mut snapshots: Vec<String> = names
        .map(|entry| format!("snapshots/{}", entry.file_name().to_string_lossy()))
        .collect();
    snapshots.sort();
    if !snapshots.is_empty() {
        return fail(format!(
            "it is the hub's cache: name a folder in it, {}",
            snapshots.join(" or ")
        ));
    }
    let parts = [
        "config.json",
        "scheduler_config.json",
        "tokenizer_config.json",
    ];
    match parts.iter().any(|name| folder.join(name).is_file()) {
        true => fail("it is one part of a model: name the model's folder".into()),
        false => Ok(()),
    }
}

/// Refuses the families of models that this code does not compute, by their name.
fn refuse_foreign(index: &ConfigFile) -> Result<()> {
    let class = index.get("_class_name").and_then(|name| name.as_str());
    let families = [
        ("StableDiffusionXL", "Stable Diffusion XL"),
        ("StableDiffusion3", "Stable Diffusion 3"),
        ("Flux", "Flux"),
    ];
    match families.iter().find(|(start, _)| class.is_some_and(|c| c.starts_with(start))) {
        None => Ok(()),
        Some((_, family)) => Err(index.error(format!(
            "_class_name says that this is {family}; accepted: Stable Diffusion 1 and 2, plain and inpainting"
        ))),
    }
}

fn check_precision(dtype: DType, device: &Device) -> Result<()> {
    if device.is_cpu() && dtype == DType::F16 {
        return crate::error::argument(
            "precision f16 on the CPU: accepted are f32 and bf16; half-precision files are converted while reading",
        );
    }
    Ok(())
}

/// Loads the folder `unet/` of a model with frozen weights.
pub fn load_unet(folder: &Path, dtype: DType, device: &Device) -> Result<UNet> {
    let file = ConfigFile::read(&folder.join("config.json"))?;
    let config = UNetConfig::from_file(&file)?;
    let weights = Weights::open(folder, "diffusion_pytorch_model")?;
    config.fits(&weights.extent()).map_err(|m| file.error(m))?;
    UNet::new(
        config,
        Parameters::from_weights(weights, dtype, device, false),
    )
}
