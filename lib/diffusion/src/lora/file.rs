//! LoRA files: PEFT's keys as diffusers writes them, kohya's keys as A1111
//! and ComfyUI read them. Both are read and written.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use serde_json::{Value, json};

use super::settings::{ACCEPTED, METADATA, OWN_PREFIX, Settings};
use super::{Adapter, AdapterTarget, Lora, lora_files};
use crate::error::{Error, Result};
use crate::single_file::original_attention;
use crate::weights::{Weights, write_safetensors};

/// Whose keys a file has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LoraStyle {
    /// `unet.<module>.lora_A.weight`, alpha in the header's metadata.
    Peft,
    /// `lora_unet_<module with _>.lora_down.weight` with an `.alpha` tensor.
    Kohya,
}

/// Free-form facts for the header: prompts, hash of the base model...
pub type LoraInfo = BTreeMap<String, String>;

impl Lora {
    /// Writes the adapters, in f32, with rank, alpha and `info` in the header. Matrices of layers that are 1x1 convolutions
    /// in the model's files have two more dimensions of 1, as other programs want them.
    pub fn save(&self, path: &Path, style: LoraStyle, info: &LoraInfo) -> Result<()> {
        let mut tensors = BTreeMap::new();
        for (name, adapter) in &self.adapters {
            let [down, up] = [adapter.down(), adapter.up()].map(|m| adapter.as_stored(m));
            let (down, up) = (down?, up?);
            match style {
                LoraStyle::Peft => {
                    tensors.insert(format!("unet.{name}.lora_A.weight"), down);
                    tensors.insert(format!("unet.{name}.lora_B.weight"), up);
                }
                LoraStyle::Kohya => {
                    let module = format!("lora_unet_{}", name.replace('.', "_"));
                    let alpha = Tensor::new(adapter.alpha() as f32, &Device::Cpu)?;
                    tensors.insert(format!("{module}.lora_down.weight"), down);
                    tensors.insert(format!("{module}.lora_up.weight"), up);
                    tensors.insert(format!("{module}.alpha"), alpha);
                }
            }
        }
        let mut header = info.clone();
        let (rank, alpha) = self
            .adapters
            .values()
            .next()
            .map_or((0, 0.0), |a| (a.rank(), a.alpha()));
        header.insert("rank".into(), rank.to_string());
        header.insert("alpha".into(), alpha.to_string());
        match style {
            LoraStyle::Peft => {
                header.insert("format".into(), "pt".into());
                header.insert(METADATA.into(), self.peft_metadata(rank, alpha).to_string());
            }
            LoraStyle::Kohya => {
                header.insert("ss_network_module".into(), "networks.lora".into());
                header.insert("ss_network_dim".into(), rank.to_string());
                header.insert("ss_network_alpha".into(), alpha.to_string());
            }
        }
        write_safetensors(path, &tensors, &header)
    }

    fn peft_metadata(&self, rank: usize, alpha: f64) -> Value {
        let modules: Vec<&str> = self.adapters.keys().map(String::as_str).collect();
        let mut rank_pattern = serde_json::Map::new();
        let mut alpha_pattern = serde_json::Map::new();
        for (name, adapter) in &self.adapters {
            if adapter.rank() != rank {
                rank_pattern.insert(name.clone(), json!(adapter.rank()));
            }
            if adapter.alpha() != alpha {
                alpha_pattern.insert(name.clone(), json!(adapter.alpha()));
            }
        }
        // PEFT wants an integer where the number is one.
        let alpha = if alpha.fract() == 0.0 {
            json!(alpha as i64)
        } else {
            json!(alpha)
        };
        json!({
            "unet.r": rank,
            "unet.lora_alpha": alpha,
            "unet.target_modules": modules,
            "unet.rank_pattern": rank_pattern,
            "unet.alpha_pattern": alpha_pattern,
        })
    }

    /// Reads a file of either style, of diffusers before PEFT (`.lora.down.weight`) or of PEFT itself, with the
    /// `adapter_config.json` beside it, for the layers `targets` of a UNet; or that of a folder. kohya's keys may have the
    /// original names of blocks (`lora_unet_input_blocks_1_1_...`). The adapters are frozen. Keys that fit no layer are
    /// errors that name them.
    pub fn load(
        path: &Path,
        targets: &[AdapterTarget],
        dtype: DType,
        device: &Device,
    ) -> Result<Self> {
        let (path, _) = &lora_files(path)?;
        let weights = Weights::open_file(path)?;
        let refused = |problems| {
            Err(Error::Lora {
                path: path.to_owned(),
                problems,
            })
        };
        if let Some((key, kind)) = weights
            .names()
            .find_map(|key| Some((key, other_kind(key)?)))
        {
            return refused(vec![format!("it is {kind} ({key:?}); {ACCEPTED}")]);
        }
        let mut problems = vec![];
        let parts = sort_keys(&weights, targets, &mut problems);
        // Keys of another model say more than what is said of them.
        let settings = match Settings::read(path, &weights)? {
            Ok(settings) => settings,
            Err(problem) => {
                problems.push(problem);
                return refused(problems);
            }
        };
        let mut lora = Self::default();
        for target in targets {
            let Some(part) = parts.get(target.name.as_str()) else {
                continue;
            };
            match read_adapter(&weights, target, part, &settings, dtype, device)? {
                Ok(adapter) => lora.insert_frozen(&target.name, adapter),
                Err(problem) => problems.push(problem),
            }
        }
        if lora.adapters.is_empty() && problems.is_empty() {
            problems.push("it holds no adapter".into());
        }
        match problems.is_empty() {
            true => Ok(lora),
            false => refused(problems),
        }
    }
}

/// What is adapted by other means than two matrices whose product is added, by a part of its keys.
const OTHER_KINDS: [(&str, &str); 10] = [
    (".lora_magnitude_vector", "a DoRA, for it holds magnitudes"),
    (".dora_scale", "a DoRA, for it holds magnitudes"),
    (".hada_w", "a LoHa"),
    (".lokr_w", "a LoKr"),
    (".oft_", "an OFT"),
    (".on_input", "an IA3"),
    (".lora_mid.", "a LoCon with a third matrix for a layer"),
    (".lora_B.bias", "a LoRA with biases (lora_bias)"),
    (".base_layer.bias", "a LoRA with biases (bias)"),
    (".diff", "made of whole differences of weights"),
];

/// What a file with this key is, if it is no plain LoRA.
fn other_kind(key: &str) -> Option<&'static str> {
    let is_of = |part: &str| match part {
        // `diffusion_model.` begins the keys of some plain ones.
        ".diff" => key.ends_with(part) || key.ends_with(".diff_b"),
        _ => key.contains(part),
    };
    let found = OTHER_KINDS.iter().find(|(part, _)| is_of(part));
    found.map(|(_, kind)| *kind)
}

/// Parts of the names of a UNet's layers outside its attentions.
const OUTSIDE: [&str; 11] = [
    "resnets",
    "samplers",
    "conv_in",
    "conv_out",
    "time_emb",
    "in_layers",
    "out_layers",
    "emb_layers",
    "skip_connection",
    "_0_op",
    "_conv",
];

/// The keys that belong to one layer.
#[derive(Debug, Default)]
struct Part {
    down: Option<String>,
    up: Option<String>,
    alpha: Option<String>,
}

const DOWN: [&str; 4] = [
    ".lora_A.weight",
    ".lora_down.weight",
    ".lora.down.weight",
    "_lora.down.weight",
];
const UP: [&str; 4] = [
    ".lora_B.weight",
    ".lora_up.weight",
    ".lora.up.weight",
    "_lora.up.weight",
];

/// Residual blocks of a level on the way down: one fewer than on the way up, where each of them may have attention.
fn layers_per_block(targets: &[AdapterTarget]) -> usize {
    let index = |t: &AdapterTarget| {
        let (_, rest) = t
            .name
            .strip_prefix("up_blocks.")?
            .split_once(".attentions.")?;
        rest.split('.').next()?.parse().ok()
    };
    targets.iter().filter_map(index).max().unwrap_or(0)
}

fn sort_keys<'a>(
    weights: &Weights,
    targets: &'a [AdapterTarget],
    problems: &mut Vec<String>,
) -> BTreeMap<&'a str, Part> {
    let dotted: BTreeSet<&str> = targets.iter().map(|t| t.name.as_str()).collect();
    let flat = |name: &str| name.replace('.', "_");
    let layers = layers_per_block(targets);
    let originals = targets
        .iter()
        .filter_map(|t| Some((flat(&original_attention(&t.name, layers)?), t.name.as_str())));
    let kohya: BTreeMap<String, &str> = targets
        .iter()
        .map(|t| (flat(&t.name), t.name.as_str()))
        .chain(originals)
        .collect();
    let mut parts: BTreeMap<&str, Part> = BTreeMap::new();
    for key in weights.names() {
        let strip = |ends: &[&'static str]| ends.iter().find_map(|end| key.strip_suffix(end));
        let (module, which) = if let Some(module) = strip(&DOWN) {
            (module, 0)
        } else if let Some(module) = strip(&UP) {
            (module, 1)
        } else if let Some(module) = strip(&[".alpha"]) {
            (module, 2)
        } else {
            problems.push(format!(
                "key {key:?} is neither a down nor an up matrix nor an alpha"
            ));
            continue;
        };
        let layer = match module.strip_prefix("lora_unet_") {
            Some(flat) => kohya.get(flat).copied(),
            None => {
                let name = module.strip_prefix(OWN_PREFIX).unwrap_or(module);
                let name = name.strip_prefix("unet.").unwrap_or(name);
                // diffusers before PEFT wrote `attn1.processor.to_out_lora.down`.
                let mut renamed = name.replace(".processor.", ".");
                if renamed.ends_with(".to_out") {
                    renamed.push_str(".0");
                }
                dotted.get(renamed.as_str()).copied()
            }
        };
        let Some(layer) = layer else {
            let own = module.strip_prefix(OWN_PREFIX).unwrap_or(module);
            let of_text = ["lora_te", "text_encoder", "text_model"];
            let hint = if of_text.iter().any(|start| own.starts_with(start)) {
                "adapts the text encoder, accepted are adapters of the UNet; train or export with the UNet only"
            } else if OUTSIDE.iter().any(|part| own.contains(part)) {
                "adapts a layer outside the attentions, as LoCon does, accepted are adapters of attention blocks; train it \
                 without convolutions (no conv_dim) and time embeddings"
            } else {
                "belongs to no layer of this UNet"
            };
            problems.push(format!("key {key:?} {hint}"));
            continue;
        };
        let part = parts.entry(layer).or_default();
        let place = match which {
            0 => &mut part.down,
            1 => &mut part.up,
            _ => &mut part.alpha,
        };
        match place {
            None => *place = Some(key.to_owned()),
            Some(other) => problems.push(format!(
                "keys {other:?} and {key:?} are of one matrix or alpha; keep one of them"
            )),
        }
    }
    parts
}

fn read_adapter(
    weights: &Weights,
    target: &AdapterTarget,
    part: &Part,
    settings: &Settings,
    dtype: DType,
    device: &Device,
) -> Result<Result<Adapter, String>> {
    let (Some(down_key), Some(up_key)) = (&part.down, &part.up) else {
        return Ok(Err(format!(
            "layer {:?} has only one of its two matrices",
            target.name
        )));
    };
    let matrix = |key: &str| -> Result<Option<Tensor>> {
        let tensor = weights.tensor(key, dtype, device)?;
        Ok(match tensor {
            // 1x1 convolutions of the same meaning.
            Some(t) if t.rank() == 4 && t.dims()[2..] == [1, 1] => {
                Some(t.reshape((t.dims()[0], t.dims()[1]))?)
            }
            other => other,
        })
    };
    let (Some(down), Some(up)) = (matrix(down_key)?, matrix(up_key)?) else {
        return Ok(Err(format!(
            "layer {:?}: its matrices vanished",
            target.name
        )));
    };
    let fits = down.rank() == 2
        && up.rank() == 2
        && down.dims()[1] == target.inputs
        && up.dims()[0] == target.outputs
        && down.dims()[0] == up.dims()[1]
        && down.dims()[0] > 0;
    if !fits {
        return Ok(Err(format!(
            "tensors {down_key:?} {:?} and {up_key:?} {:?} do not fit the layer of {} inputs and {} outputs",
            down.dims(),
            up.dims(),
            target.inputs,
            target.outputs
        )));
    }
    let rank = down.dims()[0];
    let alpha = match &part.alpha {
        Some(key) => match weights.tensor(key, DType::F32, &Device::Cpu)? {
            Some(alpha) if alpha.elem_count() == 1 => {
                alpha.flatten_all()?.to_vec1::<f32>()?[0] as f64
            }
            _ => return Ok(Err(format!("tensor {key:?} is not a single number"))),
        },
        None => match settings.alpha(&target.name, rank) {
            Ok(alpha) => alpha,
            Err(problem) => return Ok(Err(problem)),
        },
    };
    let adapter = Adapter::new(down, up, alpha).map(|adapter| match target.pointwise_conv {
        true => adapter.of_pointwise_conv(),
        false => adapter,
    });
    Ok(adapter.map_err(|e| format!("layer {:?}: {e}", target.name)))
}
