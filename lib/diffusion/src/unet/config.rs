//! Configuration of a conditional UNet, with diffusers' keys.

use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::config::{ConfigFile, PerLevel};
use crate::error::Result;
use crate::extent::Extent;

/// Most resolution levels: each halves the picture, and 2^16 pixels a side are more than anything has.
pub(crate) const MAX_LEVELS: usize = 16;
/// Largest side of latents, four times that of the largest published models.
const MAX_SAMPLE_SIZE: usize = 512;

/// The keys of `unet/config.json` that shape the network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct UNetConfig {
    /// Latent height and width of the training images.
    pub sample_size: usize,
    /// Channels of the input: 4, or 9 = latents, mask, masked latents.
    pub in_channels: usize,
    /// Channels of the prediction.
    pub out_channels: usize,
    /// `CrossAttnDownBlock2D` or `DownBlock2D`, finest level first.
    pub down_block_types: Vec<String>,
    /// `CrossAttnUpBlock2D` or `UpBlock2D`, coarsest level first.
    pub up_block_types: Vec<String>,
    /// Channels by level, finest first.
    pub block_out_channels: Vec<usize>,
    /// Residual blocks of a level on the way down; one more on the way up.
    pub layers_per_block: usize,
    /// Transformer blocks of each attention.
    pub transformer_layers_per_block: PerLevel,
    /// Number of heads, under the name that a historic mistake gave it.
    pub attention_head_dim: PerLevel,
    /// Number of heads; overrules `attention_head_dim`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub num_attention_heads: Option<PerLevel>,
    /// Width of the text encoder's states.
    pub cross_attention_dim: usize,
    /// Linear layers instead of 1x1 convolutions around the transformers.
    pub use_linear_projection: bool,
    /// Groups of every group normalisation.
    pub norm_num_groups: usize,
    /// Added to variances in the residual blocks.
    pub norm_eps: f64,
    /// Zeros on each side before a downsampling convolution; 0: one after the last row and column alone.
    pub downsample_padding: usize,
    /// Cosines before sines in the timestep embedding.
    pub flip_sin_to_cos: bool,
    /// Offset of the frequency exponent.
    pub freq_shift: f64,
    /// `"text"`: pooled text states join the timestep embedding.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub addition_embed_type: Option<String>,
    /// Heads of that pooling.
    pub addition_embed_type_num_heads: usize,
    /// Prediction of the whole input minus 0.5: never, in this family.
    pub center_input_sample: bool,
}

impl Default for UNetConfig {
    /// diffusers' defaults, which are those of Stable Diffusion 1.
    fn default() -> Self {
        let attention = "CrossAttnDownBlock2D".to_owned();
        let up = "CrossAttnUpBlock2D".to_owned();
        Self {
            sample_size: 64,
            in_channels: 4,
            out_channels: 4,
            down_block_types: vec![
                attention.clone(),
                attention.clone(),
                attention,
                "DownBlock2D".into(),
            ],
            up_block_types: vec!["UpBlock2D".into(), up.clone(), up.clone(), up],
            block_out_channels: vec![320, 640, 1280, 1280],
            layers_per_block: 2,
            transformer_layers_per_block: PerLevel::All(1),
            attention_head_dim: PerLevel::All(8),
            num_attention_heads: None,
            cross_attention_dim: 1280,
            use_linear_projection: false,
            norm_num_groups: 32,
            norm_eps: 1e-5,
            downsample_padding: 1,
            flip_sin_to_cos: true,
            freq_shift: 0.0,
            addition_embed_type: None,
            addition_embed_type_num_heads: 64,
            center_input_sample: false,
        }
    }
}

impl UNetConfig {
    /// Reads and checks a configuration: what this implementation does not
    /// do is refused by name instead of silently left out.
    pub fn from_file(file: &ConfigFile) -> Result<Self> {
        let none = [];
        file.require("_class_name", &[json!("UNet2DConditionModel")])?;
        let middle = json!("UNetMidBlock2DCrossAttn");
        // Null leaves the block out.
        file.require_present("mid_block_type", &middle)?;
        file.require("mid_block_type", &[middle])?;
        file.require("act_fn", &[json!("silu"), json!("swish")])?;
        file.require("resnet_time_scale_shift", &[json!("default")])?;
        file.require("time_embedding_type", &[json!("positional")])?;
        file.require("attention_type", &[json!("default")])?;
        file.require("mid_block_scale_factor", &[json!(1), json!(1.0)])?;
        file.require("conv_in_kernel", &[json!(3)])?;
        file.require("conv_out_kernel", &[json!(3)])?;
        file.require("dropout", &[json!(0), json!(0.0)])?;
        for key in [
            "center_input_sample",
            "only_cross_attention",
            "mid_block_only_cross_attention",
            "dual_cross_attention",
            "resnet_skip_time_act",
            "class_embeddings_concat",
        ] {
            file.require(key, &[json!(false)])?;
        }
        for key in [
            "class_embed_type",
            "num_class_embeds",
            "encoder_hid_dim",
            "encoder_hid_dim_type",
            "time_embedding_dim",
            "time_embedding_act_fn",
            "timestep_post_act",
            "time_cond_proj_dim",
            "projection_class_embeddings_input_dim",
            "cross_attention_norm",
            "reverse_transformer_layers_per_block",
        ] {
            file.require(key, &none)?;
        }
        file.require("addition_embed_type", &[json!("text")])?;
        for key in ["layers_per_block", "cross_attention_dim"] {
            file.require_single(key)?;
        }
        let config: Self = file.parse()?;
        config.check().map_err(|message| file.error(message))?;
        Ok(config)
    }

    /// Number of resolution levels.
    pub fn levels(&self) -> usize {
        self.block_out_channels.len()
    }

    /// Heads at `level`, finest first.
    pub fn heads(&self, level: usize) -> usize {
        self.num_attention_heads
            .as_ref()
            .unwrap_or(&self.attention_head_dim)
            .at(level)
            .unwrap_or(1)
    }

    /// Transformer blocks of each attention at `level`.
    pub fn transformer_layers(&self, level: usize) -> usize {
        self.transformer_layers_per_block.at(level).unwrap_or(1)
    }

    /// Whether level `level` has attention on the way down.
    pub fn attends_down(&self, level: usize) -> bool {
        self.down_block_types[level] == "CrossAttnDownBlock2D"
    }

    /// Whether level `level` (finest first) has attention on the way up.
    pub fn attends_up(&self, level: usize) -> bool {
        self.up_block_types[self.levels() - 1 - level] == "CrossAttnUpBlock2D"
    }

    /// Checks the sizes against the weights.
    pub(crate) fn fits(&self, extent: &Extent) -> Result<(), String> {
        extent.layers("layers_per_block", self.layers_per_block)?;
        for level in 0..self.levels() {
            let middle = level + 1 == self.levels();
            if middle || self.attends_down(level) || self.attends_up(level) {
                let blocks = self.transformer_layers(level);
                extent.layers("transformer_layers_per_block", blocks)?;
            }
            let channels = self.block_out_channels[level];
            extent.width(&format!("block_out_channels[{level}]"), channels)?;
        }
        for (key, value) in [
            ("in_channels", self.in_channels),
            ("out_channels", self.out_channels),
            ("cross_attention_dim", self.cross_attention_dim),
        ] {
            extent.width(key, value)?;
        }
        Ok(())
    }

    /// Says what is impossible about this configuration.
    pub fn check(&self) -> Result<(), String> {
        let levels = self.levels();
        if levels == 0 || levels > MAX_LEVELS {
            return Err(format!(
                "block_out_channels has {levels} entries; accepted: 1 to {MAX_LEVELS}"
            ));
        }
        if self.layers_per_block == 0 {
            return Err("layers_per_block = 0; accepted: at least 1".into());
        }
        if !(1..=MAX_SAMPLE_SIZE).contains(&self.sample_size) {
            return Err(format!(
                "sample_size = {}; accepted: 1 to {MAX_SAMPLE_SIZE}",
                self.sample_size
            ));
        }
        if self.downsample_padding > 1 {
            return Err(format!(
                "downsample_padding = {}; accepted: 0 or 1",
                self.downsample_padding
            ));
        }
        if !(self.norm_eps > 0.0 && self.norm_eps < 1.0) {
            return Err(format!(
                "norm_eps = {}; accepted: above 0 and below 1",
                self.norm_eps
            ));
        }
        for (name, types, known) in [
            (
                "down_block_types",
                &self.down_block_types,
                ["CrossAttnDownBlock2D", "DownBlock2D"],
            ),
            (
                "up_block_types",
                &self.up_block_types,
                ["CrossAttnUpBlock2D", "UpBlock2D"],
            ),
        ] {
            if types.len() != levels {
                return Err(format!(
                    "{name} has {} entries, block_out_channels has {levels}",
                    types.len()
                ));
            }
            if let Some(unknown) = types.iter().find(|t| !known.contains(&t.as_str())) {
                return Err(format!(
                    "{name} has {unknown:?}, accepted: {}",
                    known.join(", ")
                ));
            }
        }
        let heads = self
            .num_attention_heads
            .as_ref()
            .unwrap_or(&self.attention_head_dim);
        if !heads.fits(levels) || !self.transformer_layers_per_block.fits(levels) {
            return Err(format!(
                "attention_head_dim and transformer_layers_per_block need 1 or {levels} entries"
            ));
        }
        for (level, &channels) in self.block_out_channels.iter().enumerate() {
            let heads = self.heads(level);
            if channels == 0 || self.norm_num_groups == 0 || channels % self.norm_num_groups != 0 {
                let groups = self.norm_num_groups;
                return Err(format!(
                    "block_out_channels[{level}] = {channels} is no multiple of norm_num_groups = {groups}"
                ));
            }
            if heads == 0 || channels % heads != 0 {
                return Err(format!(
                    "block_out_channels[{level}] = {channels} is no multiple of {heads} heads"
                ));
            }
        }
        if self.in_channels == 0 || self.out_channels == 0 || self.cross_attention_dim == 0 {
            return Err(
                "in_channels, out_channels and cross_attention_dim must be at least 1".into(),
            );
        }
        let heads = self.addition_embed_type_num_heads;
        if self.addition_embed_type.is_some()
            && (heads == 0 || !self.cross_attention_dim.is_multiple_of(heads))
        {
            let width = self.cross_attention_dim;
            return Err(format!(
                "cross_attention_dim = {width} is no multiple of addition_embed_type_num_heads = {heads}"
            ));
        }
        if !self.block_out_channels[0].is_multiple_of(2) {
            return Err("block_out_channels[0] must be even: half sines, half cosines".into());
        }
        if !(0.0..self.block_out_channels[0] as f64 / 2.0).contains(&self.freq_shift) {
            return Err(format!(
                "freq_shift = {}; accepted: 0 to half of block_out_channels[0], without that",
                self.freq_shift
            ));
        }
        Ok(())
    }
}
