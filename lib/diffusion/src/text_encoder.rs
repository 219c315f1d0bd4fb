//! The text encoder of CLIP [Radford et al. 2021].

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Device, Tensor, Var};
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::config::ConfigFile;
use crate::error::{Error, Result, argument};
use crate::extent::Extent;
use crate::layers::{Activation, Attention, Causality, Embedding, LayerNorm, Linear, activate};
use crate::parameters::{Init, Parameters};
use crate::weights::Weights;

/// The keys of `text_encoder/config.json` that shape the network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct TextEncoderConfig {
    /// Entries of the token table.
    pub vocab_size: usize,
    /// Width of the states.
    pub hidden_size: usize,
    /// Width inside the feed-forward layers.
    pub intermediate_size: usize,
    /// Transformer layers.
    pub num_hidden_layers: usize,
    /// Heads of each attention.
    pub num_attention_heads: usize,
    /// Longest sequence, both markers included.
    pub max_position_embeddings: usize,
    /// `quick_gelu` (first CLIP) or `gelu` (OpenCLIP).
    pub hidden_act: String,
    /// Added to variances.
    pub layer_norm_eps: f64,
}

impl Default for TextEncoderConfig {
    /// transformers' defaults, which are those of Stable Diffusion 1's encoder
    /// but for its width.
    fn default() -> Self {
        Self {
            vocab_size: 49408,
            hidden_size: 512,
            intermediate_size: 2048,
            num_hidden_layers: 12,
            num_attention_heads: 8,
            max_position_embeddings: 77,
            hidden_act: "quick_gelu".into(),
            layer_norm_eps: 1e-5,
        }
    }
}

impl TextEncoderConfig {
    /// Reads and checks a configuration.
    pub fn from_file(file: &ConfigFile) -> Result<Self> {
        file.require("model_type", &[json!("clip_text_model")])?;
        let config: Self = file.parse()?;
        config.check().map_err(|message| file.error(message))?;
        Ok(config)
    }

    /// Checks the sizes against the weights.
    pub(crate) fn fits(&self, extent: &Extent) -> Result<(), String> {
        extent.layers("num_hidden_layers", self.num_hidden_layers)?;
        for (key, value) in [
            ("vocab_size", self.vocab_size),
            ("hidden_size", self.hidden_size),
            ("intermediate_size", self.intermediate_size),
            ("max_position_embeddings", self.max_position_embeddings),
        ] {
            extent.width(key, value)?;
        }
        Ok(())
    }

    fn check(&self) -> Result<Activation, String> {
        if self.num_attention_heads == 0
            || !self.hidden_size.is_multiple_of(self.num_attention_heads)
        {
            return Err(format!(
                "hidden_size = {} is no multiple of num_attention_heads = {}",
                self.hidden_size, self.num_attention_heads
            ));
        }
        if self.vocab_size == 0 || self.hidden_size == 0 || self.max_position_embeddings < 2 {
            return Err(
                "vocab_size and hidden_size must be at least 1, max_position_embeddings at least 2"
                    .into(),
            );
        }
        Activation::from_name(&self.hidden_act).ok_or_else(|| {
            format!(
                "hidden_act = {:?}, accepted: quick_gelu, gelu, silu",
                self.hidden_act
            )
        })
    }
}

#[derive(Debug)]
struct Layer {
    norm1: LayerNorm,
    q: Linear,
    k: Linear,
    v: Linear,
    out: Linear,
    norm2: LayerNorm,
    expand: Linear,
    contract: Linear,
    attention: Attention,
    activation: Activation,
}

impl Layer {
    fn new(
        parameters: &Parameters,
        config: &TextEncoderConfig,
        activation: Activation,
    ) -> Result<Self> {
        let width = config.hidden_size;
        let linear =
            |name: &str, inputs, outputs| Linear::new(&parameters.sub(name), inputs, outputs);
        let norm = |name: &str| LayerNorm::new(&parameters.sub(name), width, config.layer_norm_eps);
        Ok(Self {
            norm1: norm("layer_norm1")?,
            q: linear("self_attn.q_proj", width, width)?,
            k: linear("self_attn.k_proj", width, width)?,
            v: linear("self_attn.v_proj", width, width)?,
            out: linear("self_attn.out_proj", width, width)?,
            norm2: norm("layer_norm2")?,
            expand: linear("mlp.fc1", width, config.intermediate_size)?,
            contract: linear("mlp.fc2", config.intermediate_size, width)?,
            attention: Attention {
                heads: config.num_attention_heads,
                causality: Causality::Causal,
            },
            activation,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let h = self.norm1.forward(x)?;
        let (q, k, v) = (
            self.q.forward(&h)?,
            self.k.forward(&h)?,
            self.v.forward(&h)?,
        );
        let x = (x + self.out.forward(&self.attention.forward(&q, &k, &v)?)?)?;
        let h = activate(
            self.activation,
            &self.expand.forward(&self.norm2.forward(&x)?)?,
        )?;
        Ok((&x + self.contract.forward(&h)?)?)
    }
}

/// Embeddings of tokens that are not in the vocabulary: token
/// `vocab_size + i` is row i.
#[derive(Debug, Clone)]
pub struct LearnedTokens {
    /// [tokens, hidden_size]; gradients reach it.
    pub embeddings: Tensor,
}

/// Tokens to states, one for each.
#[derive(Debug)]
pub struct TextEncoder {
    config: TextEncoderConfig,
    tokens: Embedding,
    positions: Tensor,
    layers: Vec<Layer>,
    norm: LayerNorm,
    variables: BTreeMap<String, Var>,
}

impl TextEncoder {
    /// Loads the folder `text_encoder/` of a model, whose tensors may have
    /// the prefix `text_model.` or not.
    pub fn load(folder: &Path, dtype: DType, device: &Device) -> Result<Self> {
        let file = ConfigFile::read(&folder.join("config.json"))?;
        let config = TextEncoderConfig::from_file(&file)?;
        let weights = Weights::open(folder, "model")?;
        config.fits(&weights.extent()).map_err(|m| file.error(m))?;
        Self::new(
            config,
            Parameters::from_weights(weights, dtype, device, false),
        )
    }

    /// Builds the network from parameters named as transformers names them.
    pub fn new(config: TextEncoderConfig, parameters: Parameters) -> Result<Self> {
        let activation = config.check().map_err(Error::Argument)?;
        let root = parameters.with_optional_prefix("text_model.");
        let p = root.sub("text_model");
        let width = config.hidden_size;
        let tokens = Embedding::new(
            &p.sub("embeddings.token_embedding"),
            config.vocab_size,
            width,
        )?;
        let positions = p.sub("embeddings.position_embedding");
        let positions = positions.get(
            "weight",
            &[config.max_position_embeddings, width],
            Init::Normal(0.01),
        )?;
        let layers = (0..config.num_hidden_layers)
            .map(|i| Layer::new(&p.sub(format!("encoder.layers.{i}")), &config, activation))
            .collect::<Result<_>>()?;
        let norm = LayerNorm::new(&p.sub("final_layer_norm"), width, config.layer_norm_eps)?;
        // A buffer of 0, 1, 2... that older files carry, and the projection
        // of files exported together with one.
        let variables =
            root.finish(|name| name.ends_with("position_ids") || name == "text_projection.weight")?;
        Ok(Self {
            config,
            tokens,
            positions,
            layers,
            norm,
            variables,
        })
    }

    /// Trainable parameters by name; empty if the weights are frozen.
    pub fn variables(&self) -> &BTreeMap<String, Var> {
        &self.variables
    }

    /// Embeddings of the vocabulary, [vocab_size, hidden_size].
    pub fn table(&self) -> &Tensor {
        self.tokens.table()
    }

    /// The configuration.
    pub fn config(&self) -> &TextEncoderConfig {
        &self.config
    }

    /// The vocabulary's embedding of a token, [hidden_size].
    pub fn embedding(&self, token: u32) -> Result<Tensor> {
        if token as usize >= self.config.vocab_size {
            return argument(format!(
                "token {token} is outside the vocabulary of {}",
                self.config.vocab_size
            ));
        }
        Ok(self.tokens.table().get(token as usize)?)
    }

    /// States [batch, tokens, hidden_size] after the final norm, of
    /// sequences of equal length.
    pub fn forward(&self, tokens: &[Vec<u32>], learned: Option<&LearnedTokens>) -> Result<Tensor> {
        let mut x = self.embed(tokens, learned)?;
        for layer in &self.layers {
            x = layer.forward(&x)?;
        }
        self.norm.forward(&x)
    }

    fn embed(&self, tokens: &[Vec<u32>], learned: Option<&LearnedTokens>) -> Result<Tensor> {
        let length = tokens.first().map_or(0, Vec::len);
        if length == 0
            || tokens.iter().any(|t| t.len() != length)
            || length > self.config.max_position_embeddings
        {
            return argument(format!(
                "text encoder: sequences must have one length of 1 to {}, got {:?}",
                self.config.max_position_embeddings,
                tokens.iter().map(Vec::len).collect::<Vec<_>>()
            ));
        }
        let known = self.config.vocab_size;
        let extra = learned.map_or(0, |l| l.embeddings.dims()[0]);
        if let Some(token) = tokens
            .iter()
            .flatten()
            .find(|&&t| t as usize >= known + extra)
        {
            return argument(format!(
                "token {token}: the vocabulary has {known} entries and {extra} learned ones"
            ));
        }
        let device = self.positions.device();
        let dtype = self.positions.dtype();
        let shape = (tokens.len(), length);
        let ids: Vec<u32> = tokens
            .iter()
            .flatten()
            .map(|&t| if (t as usize) < known { t } else { 0 })
            .collect();
        let mut x = self
            .tokens
            .forward(&Tensor::from_vec(ids, shape, device)?)?;
        if let Some(learned) = learned {
            // Choose by products with 0 and 1, through which gradients pass.
            let chosen =
                |i: usize| (0..extra).map(move |j| if i == known + j { 1f32 } else { 0.0 });
            let choice: Vec<f32> = tokens
                .iter()
                .flatten()
                .flat_map(|&t| chosen(t as usize))
                .collect();
            let keep: Vec<f32> = tokens
                .iter()
                .flatten()
                .map(|&t| if (t as usize) < known { 1.0 } else { 0.0 })
                .collect();
            let choice = Tensor::from_vec(choice, (tokens.len() * length, extra), device)?
                .to_dtype(dtype)?;
            let keep =
                Tensor::from_vec(keep, (tokens.len(), length, 1), device)?.to_dtype(dtype)?;
            let added = choice
                .matmul(&learned.embeddings.to_dtype(dtype)?)?
                .reshape(x.shape())?;
            x = (x.broadcast_mul(&keep)? + added)?;
        }
        Ok(x.broadcast_add(&self.positions.narrow(0, 0, length)?)?)
    }
}
