//! The step between images and latents: the autoencoder of Stable Diffusion,
//! or an exact rearrangement of pixels for small pixel-space models.

mod coder;
mod config;
mod unshuffle;

use std::path::Path;

use candle_core::{DType, Device, Tensor};
use serde_json::json;

use coder::{Decoder, Encoder};
pub use config::AutoencoderConfig;
pub use unshuffle::{pixel_shuffle, pixel_unshuffle};

use crate::config::ConfigFile;
use crate::error::Result;
use crate::layers::{Conv2d, Padding};
use crate::parameters::Parameters;
use crate::recompute::gradient_through;
use crate::weights::Weights;

/// Bounds of the encoder's log variance, as in training.
const LOG_VARIANCE: (f64, f64) = (-30.0, 20.0);

/// Largest factor, and most channels, of a rearrangement of pixels: it has no weights that would bound them.
const MAX_UNSHUFFLE: usize = 64;

/// The normal distribution that the encoder gives for an image.
#[derive(Debug, Clone)]
pub struct Moments {
    /// [batch, latent channels, h, w], not scaled.
    pub mean: Tensor,
    /// Log variance of the same shape.
    pub log_variance: Tensor,
}

/// Variational autoencoder [Kingma & Welling 2014] as Stable Diffusion has it.
#[derive(Debug)]
pub struct AutoencoderKl {
    config: AutoencoderConfig,
    encoder: Encoder,
    quantize: Option<Conv2d>,
    decoder: Decoder,
    unquantize: Option<Conv2d>,
}

impl AutoencoderKl {
    /// Builds the network from parameters named as diffusers names them.
    pub fn new(config: AutoencoderConfig, parameters: Parameters) -> Result<Self> {
        config.check().map_err(crate::error::Error::Argument)?;
        let latent = config.latent_channels;
        let pointwise = |name: &str, channels| {
            Conv2d::new(
                &parameters.sub(name),
                (channels, channels),
                1,
                1,
                Padding::Same(0),
            )
        };
        let encoder = Encoder::new(&parameters.sub("encoder"), &config)?;
        let decoder = Decoder::new(&parameters.sub("decoder"), &config)?;
        let quantize = config
            .use_quant_conv
            .then(|| pointwise("quant_conv", 2 * latent))
            .transpose()?;
        let unquantize = config
            .use_post_quant_conv
            .then(|| pointwise("post_quant_conv", latent))
            .transpose()?;
        parameters.finish(|_| false)?;
        Ok(Self {
            config,
            encoder,
            quantize,
            decoder,
            unquantize,
        })
    }

    /// The configuration.
    pub fn config(&self) -> &AutoencoderConfig {
        &self.config
    }

    /// Encodes images [batch, 3, h, w] in [-1, 1].
    pub fn encode(&self, image: &Tensor) -> Result<Moments> {
        self.moments(&self.encoder.forward(image)?)
    }

    fn moments(&self, h: &Tensor) -> Result<Moments> {
        let h = match &self.quantize {
            Some(quantize) => &quantize.forward(h)?,
            None => h,
        };
        let parts = h.chunk(2, 1)?;
        let log_variance = parts[1].clamp(LOG_VARIANCE.0, LOG_VARIANCE.1)?;
        Ok(Moments {
            mean: parts[0].contiguous()?,
            log_variance,
        })
    }

    /// Decodes unscaled latents to images, nominally in [-1, 1].
    pub fn decode(&self, z: &Tensor) -> Result<Tensor> {
        match &self.unquantize {
            Some(unquantize) => self.decoder.forward(&unquantize.forward(z)?),
            None => self.decoder.forward(z),
        }
    }
}

/// What a model folder's `vae/` holds.
#[derive(Debug)]
pub enum Vae {
    /// Learned autoencoder.
    Kl(Box<AutoencoderKl>),
    /// `PixelUnshuffle`: `factor` x `factor` pixels to channels, exact.
    PixelUnshuffle {
        /// Pixels to a latent pixel, along one side.
        factor: usize,
        /// Channels of the image.
        in_channels: usize,
        /// Factor from rearranged pixels to latents.
        scaling_factor: f64,
    },
}

impl Vae {
    /// Loads the folder `vae/` of a model.
    pub fn load(folder: &Path, dtype: DType, device: &Device) -> Result<Self> {
        let file = ConfigFile::read(&folder.join("config.json"))?;
        file.require(
            "_class_name",
            &[json!("AutoencoderKL"), json!("PixelUnshuffle")],
        )?;
        if file.get("_class_name") != Some(&json!("PixelUnshuffle")) {
            let config = AutoencoderConfig::from_file(&file)?;
            let weights = Weights::open(folder, "diffusion_pytorch_model")?;
            config.fits(&weights.extent()).map_err(|m| file.error(m))?;
            let parameters = Parameters::from_weights(weights, dtype, device, false);
            return Ok(Self::Kl(Box::new(AutoencoderKl::new(config, parameters)?)));
        }
        #[derive(serde::Deserialize)]
        struct Unshuffle {
            factor: usize,
            #[serde(default = "three")]
            in_channels: usize,
            #[serde(default = "one")]
            scaling_factor: f64,
        }
        let three_channels: Unshuffle = file.parse()?;
        let Unshuffle {
            factor,
            in_channels,
            scaling_factor,
        } = three_channels;
        for (key, value) in [("factor", factor), ("in_channels", in_channels)] {
            if !(1..=MAX_UNSHUFFLE).contains(&value) {
                return Err(file.error(format!("{key} = {value}; accepted: 1 to {MAX_UNSHUFFLE}")));
            }
        }
        if !(scaling_factor > 0.0 && scaling_factor.is_finite()) {
            return Err(file.error(format!(
                "scaling_factor = {scaling_factor}; accepted: a positive number"
            )));
        }
        Ok(Self::PixelUnshuffle {
            factor,
            in_channels,
            scaling_factor,
        })
    }

    /// Image pixels to a latent pixel, along one side.
    pub fn downscale(&self) -> usize {
        match self {
            Self::Kl(vae) => vae.config.downscale(),
            Self::PixelUnshuffle { factor, .. } => *factor,
        }
    }

    /// Channels of the latents.
    pub fn latent_channels(&self) -> usize {
        match self {
            Self::Kl(vae) => vae.config.latent_channels,
            Self::PixelUnshuffle {
                factor,
                in_channels,
                ..
            } => factor * factor * in_channels,
        }
    }

    /// [`Vae::encode`] that can carry a gradient back to the image.
    pub fn trace(&self, image: &Tensor) -> Result<Encoding<'_>> {
        let (inputs, last) = match self {
            Self::Kl(vae) => vae.encoder.trace(image)?,
            Self::PixelUnshuffle { .. } => (vec![], image.detach()),
        };
        let latents = self.latents_of(&last)?;
        Ok(Encoding {
            vae: self,
            inputs,
            last,
            latents,
        })
    }

    /// Scaled latents of images [batch, 3, h, w] in [-1, 1]: the mean of the
    /// encoder's distribution. Differentiable in the image.
    pub fn encode(&self, image: &Tensor) -> Result<Tensor> {
        match self {
            Self::Kl(vae) => self.latents_of(&vae.encoder.forward(image)?),
            Self::PixelUnshuffle { .. } => self.latents_of(image),
        }
    }

    /// Of the encoder's last values, or of the image where there is no encoder.
    fn latents_of(&self, last: &Tensor) -> Result<Tensor> {
        match self {
            Self::Kl(vae) => Ok((vae.moments(last)?.mean * vae.config.scaling_factor)?),
            Self::PixelUnshuffle {
                factor,
                scaling_factor,
                ..
            } => Ok((pixel_unshuffle(last, *factor)? * *scaling_factor)?),
        }
    }

    /// Images of scaled latents, nominally in [-1, 1].
    pub fn decode(&self, latents: &Tensor) -> Result<Tensor> {
        match self {
            Self::Kl(vae) => vae.decode(&(latents / vae.config.scaling_factor)?),
            Self::PixelUnshuffle {
                factor,
                scaling_factor,
                ..
            } => pixel_shuffle(&(latents / *scaling_factor)?, *factor),
        }
    }
}

/// Latents of an image, with what their gradient at the image takes: the input of every unit of the encoder. All
/// inner values would take 5 GiB at 768 pixels; they are computed again.
#[derive(Debug)]
pub struct Encoding<'a> {
    vae: &'a Vae,
    inputs: Vec<Tensor>,
    last: Tensor,
    latents: Tensor,
}

impl Encoding<'_> {
    /// As [`Vae::encode`] gives them.
    pub fn latents(&self) -> &Tensor {
        &self.latents
    }

    /// The gradient at the image, where that at the latents is `at_latents`, of their shape.
    pub fn gradient(self, at_latents: &Tensor) -> Result<Tensor> {
        let vae = self.vae;
        let g = gradient_through(|last| vae.latents_of(last), self.last, at_latents)?;
        match vae {
            Vae::Kl(vae) => vae.encoder.gradient(self.inputs, g),
            Vae::PixelUnshuffle { .. } => Ok(g),
        }
    }
}

fn three() -> usize {
    3
}

fn one() -> f64 {
    1.0
}
