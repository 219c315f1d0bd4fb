//! Configuration of an autoencoder, with diffusers' keys.

use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::config::ConfigFile;
use crate::error::Result;
use crate::extent::Extent;
use crate::unet::MAX_LEVELS;

/// The keys of `vae/config.json` that shape an `AutoencoderKL`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct AutoencoderConfig {
    /// Channels of the image.
    pub in_channels: usize,
    /// Channels of the reconstruction.
    pub out_channels: usize,
    /// Channels of the latents.
    pub latent_channels: usize,
    /// Channels by level, finest first.
    pub block_out_channels: Vec<usize>,
    /// Residual blocks of a level of the encoder; one more in the decoder.
    pub layers_per_block: usize,
    /// Groups of every group normalisation.
    pub norm_num_groups: usize,
    /// Factor from the encoder's mean to the latents that the UNet sees.
    pub scaling_factor: f64,
    /// 1x1 convolution after the encoder.
    pub use_quant_conv: bool,
    /// 1x1 convolution before the decoder.
    pub use_post_quant_conv: bool,
    /// Attention in the middle of encoder and decoder.
    pub mid_block_add_attention: bool,
}

impl Default for AutoencoderConfig {
    /// diffusers' defaults.
    fn default() -> Self {
        Self {
            in_channels: 3,
            out_channels: 3,
            latent_channels: 4,
            block_out_channels: vec![64],
            layers_per_block: 1,
            norm_num_groups: 32,
            scaling_factor: 0.18215,
            use_quant_conv: true,
            use_post_quant_conv: true,
            mid_block_add_attention: true,
        }
    }
}

impl AutoencoderConfig {
    /// Reads and checks a configuration.
    pub fn from_file(file: &ConfigFile) -> Result<Self> {
        file.require("_class_name", &[json!("AutoencoderKL")])?;
        file.require("act_fn", &[json!("silu"), json!("swish")])?;
        file.require("shift_factor", &[json!(0), json!(0.0)])?;
        for key in ["latents_mean", "latents_std"] {
            file.require(key, &[])?;
        }
        file.require_single("layers_per_block")?;
        for (key, known) in [
            ("down_block_types", "DownEncoderBlock2D"),
            ("up_block_types", "UpDecoderBlock2D"),
        ] {
            let types = file
                .get(key)
                .and_then(|v| v.as_array())
                .into_iter()
                .flatten();
            if let Some(unknown) = types.into_iter().find(|t| t.as_str() != Some(known)) {
                return Err(file.error(format!("{key} has {unknown}, accepted: {known}")));
            }
        }
        let config: Self = file.parse()?;
        config.check().map_err(|message| file.error(message))?;
        Ok(config)
    }

    /// Image pixels to a latent pixel, along one side.
    pub fn downscale(&self) -> usize {
        1 << (self.block_out_channels.len() - 1)
    }

    /// Checks the sizes against the weights.
    pub(crate) fn fits(&self, extent: &Extent) -> Result<(), String> {
        extent.layers("layers_per_block", self.layers_per_block)?;
        for (level, &channels) in self.block_out_channels.iter().enumerate() {
            extent.width(&format!("block_out_channels[{level}]"), channels)?;
        }
        for (key, value) in [
            ("in_channels", self.in_channels),
            ("out_channels", self.out_channels),
            ("latent_channels", self.latent_channels),
        ] {
            extent.width(key, value)?;
        }
        Ok(())
    }

    /// Says what is impossible about this configuration.
    pub fn check(&self) -> Result<(), String> {
        if self.block_out_channels.is_empty()
            || self.layers_per_block == 0
            || self.latent_channels == 0
        {
            return Err(
                "block_out_channels, layers_per_block and latent_channels must not be empty or 0"
                    .into(),
            );
        }
        let levels = self.block_out_channels.len();
        if levels > MAX_LEVELS {
            return Err(format!(
                "block_out_channels has {levels} entries; accepted: 1 to {MAX_LEVELS}"
            ));
        }
        let groups = self.norm_num_groups;
        if let Some(odd) = self
            .block_out_channels
            .iter()
            .find(|&&c| c == 0 || groups == 0 || c % groups != 0)
        {
            return Err(format!(
                "block_out_channels has {odd}, no multiple of norm_num_groups = {groups}"
            ));
        }
        if !(self.scaling_factor.is_finite() && self.scaling_factor > 0.0) {
            return Err(format!(
                "scaling_factor = {} must be positive",
                self.scaling_factor
            ));
        }
        Ok(())
    }
}
