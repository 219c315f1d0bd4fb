//! Sizes of the small model's networks, and its folder in the layout of diffusers.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Tensor};
use dipir_diffusion::config::PerLevel;
use dipir_diffusion::schedule::{BetaSchedule, Prediction, ScheduleConfig};
use dipir_diffusion::text_encoder::TextEncoderConfig;
use dipir_diffusion::unet::UNetConfig;
use dipir_diffusion::weights::write_safetensors;
use dipir_prior::caption::vocabulary;
use dipir_prior::picture::{LATENT_CHANNELS, LATENT_FACTOR, LATENT_SCALE, SIZE};
use serde_json::{Value, json};

use crate::error::{Result, io};
use crate::tokenizer_files;

/// Tokens of a caption, with start and end.
pub const LENGTH: usize = 20;

/// Prefixes of variables' names in training, and the file of the model folder that holds those variables without the
/// prefix.
pub const WEIGHT_FILES: [(&str, &str); 2] = [
    ("unet.", "unet/diffusion_pytorch_model.safetensors"),
    ("text.", "text_encoder/model.safetensors"),
];

/// Sizes of the networks.
#[derive(Debug, Clone, PartialEq)]
pub struct Architecture {
    /// Channels of the UNet by level, finest first.
    pub channels: Vec<usize>,
    /// Residual blocks of each level in the downward half; the upward half has one more.
    pub layers: usize,
    /// Width of the text encoder.
    pub text_width: usize,
}

impl Default for Architecture {
    fn default() -> Self {
        Self {
            channels: vec![32, 64, 128],
            layers: 1,
            text_width: 64,
        }
    }
}

impl Architecture {
    /// The UNet's configuration. All levels but the finest have attention.
    pub fn unet(&self) -> UNetConfig {
        let levels = self.channels.len();
        let kind = |with: bool, name: &str| {
            let cross = if with { "CrossAttn" } else { "" };
            format!("{cross}{name}Block2D")
        };
        UNetConfig {
            sample_size: SIZE / LATENT_FACTOR,
            in_channels: 2 * LATENT_CHANNELS + 1,
            out_channels: LATENT_CHANNELS,
            down_block_types: (0..levels).map(|l| kind(l > 0, "Down")).collect(),
            up_block_types: (0..levels).rev().map(|l| kind(l > 0, "Up")).collect(),
            block_out_channels: self.channels.clone(),
            layers_per_block: self.layers,
            transformer_layers_per_block: PerLevel::All(1),
            attention_head_dim: PerLevel::Each(
                self.channels
                    .iter()
                    .map(|c| (c / 40).max(1))
                    .map(|h| h.next_power_of_two())
                    .collect(),
            ),
            cross_attention_dim: self.text_width,
            use_linear_projection: true,
            norm_num_groups: 8,
            addition_embed_type: Some("text".into()),
            addition_embed_type_num_heads: 4,
            ..UNetConfig::default()
        }
    }

    /// Name of the variable that initialises `name`, without "unet.", in a UNet with `before` residual blocks a level;
    /// `None` if its block is new. New blocks follow the last one of the downward half and precede the last one of the
    /// upward half, whose skip connection comes from the level above.
    pub fn name_before(&self, name: &str, before: usize) -> Option<String> {
        let mut parts: Vec<&str> = name.split('.').collect();
        let [
            way @ ("down_blocks" | "up_blocks"),
            _,
            "resnets" | "attentions",
            block,
            ..,
        ] = parts[..]
        else {
            return Some(name.to_owned());
        };
        let block: usize = block.parse().ok()?;
        let block = match way {
            "up_blocks" if block == self.layers => before,
            _ if block < before => block,
            _ => return None,
        };
        let block = block.to_string();
        parts[3] = &block;
        Some(parts.join("."))
    }

    /// The text encoder's configuration for a vocabulary of `vocab_size`.
    pub fn text(&self, vocab_size: usize) -> TextEncoderConfig {
        TextEncoderConfig {
            vocab_size,
            hidden_size: self.text_width,
            intermediate_size: 4 * self.text_width,
            num_hidden_layers: 2,
            num_attention_heads: 4,
            max_position_embeddings: LENGTH,
            ..TextEncoderConfig::default()
        }
    }

    /// The noise schedule.
    pub fn schedule(&self) -> ScheduleConfig {
        ScheduleConfig {
            beta_schedule: BetaSchedule::SquaredCosine,
            prediction_type: Prediction::Velocity,
            ..ScheduleConfig::default()
        }
    }

    /// Writes all files of the folder but the weights, and returns the vocabulary's size.
    pub fn write_configs(&self, folder: &Path) -> Result<usize> {
        let vocab = tokenizer_files::write(&folder.join("tokenizer"), &vocabulary(), LENGTH)?;
        let with = |config: Value, extra: &[(&str, Value)]| {
            let mut config = config;
            for (key, value) in extra {
                config[*key] = value.clone();
            }
            config
        };
        let unet = with(
            json!(self.unet()),
            &[("_class_name", json!("UNet2DConditionModel"))],
        );
        let text = with(
            json!(self.text(vocab)),
            &[
                ("architectures", json!(["CLIPTextModel"])),
                ("model_type", json!("clip_text_model")),
                ("bos_token_id", json!(vocab - 2)),
                ("eos_token_id", json!(vocab - 1)),
                ("pad_token_id", json!(vocab - 1)),
            ],
        );
        let schedule = with(
            json!(self.schedule()),
            &[
                ("_class_name", json!("DDIMScheduler")),
                ("clip_sample", json!(false)),
            ],
        );
        let vae = json!({"_class_name": "PixelUnshuffle", "factor": LATENT_FACTOR, "in_channels": 3, "scaling_factor": LATENT_SCALE});
        let index = json!({"_class_name": "StableDiffusionInpaintPipeline"});
        for (name, value) in [
            ("model_index.json", index),
            ("unet/config.json", unet),
            ("text_encoder/config.json", text),
            ("vae/config.json", vae),
            ("scheduler/scheduler_config.json", schedule),
        ] {
            let path = folder.join(name);
            if let Some(parent) = path.parent() {
                std::fs::create_dir_all(parent).map_err(io("create", parent))?;
            }
            let text = serde_json::to_string_pretty(&value).unwrap_or_default();
            std::fs::write(&path, text + "\n").map_err(io("write", &path))?;
        }
        Ok(vocab)
    }

    /// Writes weights, named as in training, in f16.
    pub fn write_weights(&self, folder: &Path, weights: &BTreeMap<String, Tensor>) -> Result<()> {
        for (prefix, file) in WEIGHT_FILES {
            let part = weights
                .iter()
                .filter_map(|(name, t)| name.strip_prefix(prefix).map(|n| (n.to_owned(), t)))
                .map(|(name, t)| Ok((name, t.to_dtype(DType::F16)?)))
                .collect::<Result<BTreeMap<_, _>>>()?;
            let metadata = BTreeMap::from([("format".to_owned(), "pt".to_owned())]);
            write_safetensors(&folder.join(file), &part, &metadata)?;
        }
        Ok(())
    }
}
