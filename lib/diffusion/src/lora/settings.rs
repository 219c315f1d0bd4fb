//! What says alpha of a LoRA: the header's metadata of diffusers, or peft's `adapter_config.json` beside the file.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::config::ConfigFile;
use crate::error::{Error, Result};
use crate::weights::Weights;

/// Key of the header under which diffusers keeps peft's settings.
pub(super) const METADATA: &str = "lora_adapter_metadata";
/// How the keys begin that peft writes on its own.
pub(super) const OWN_PREFIX: &str = "base_model.model.";
/// peft's settings beside a file of its own.
pub(super) const CONFIG: &str = "adapter_config.json";
/// Names of peft's and diffusers' files in a folder.
const NAMES: [&str; 2] = [
    "adapter_model.safetensors",
    "pytorch_lora_weights.safetensors",
];
/// Beginnings of `init_lora_weights` that take a part out of the model's own weights, so that the adapter fits others.
const CHANGES_BASE: [&str; 5] = ["pissa", "olora", "corda", "loftq", "lora_ga"];

/// The files that a LoRA consists of: `path` itself, or what peft or diffusers wrote into the folder `path`; and
/// `adapter_config.json` beside it, if it is there.
pub fn lora_files(path: &Path) -> Result<(PathBuf, Option<PathBuf>)> {
    let wrong = |problem: String| {
        Err(Error::Lora {
            path: path.to_owned(),
            problems: vec![problem],
        })
    };
    let file = if path.is_dir() {
        let known = NAMES.iter().map(|name| path.join(name));
        match known.into_iter().find(|file| file.is_file()) {
            Some(file) => file,
            None => {
                let names = NAMES.join(" nor ");
                return wrong(format!("the folder holds neither {names}; name the file"));
            }
        }
    } else if path.extension().is_some_and(|e| e == "safetensors") {
        path.to_owned()
    } else {
        return wrong(
            "accepted: a .safetensors file, or a folder that peft or diffusers wrote; convert others first".into(),
        );
    };
    let config = file.with_file_name(CONFIG);
    Ok((file, config.is_file().then_some(config)))
}

/// Settings of the training that matter for reading its result.
pub(super) struct Settings(Value);

impl Settings {
    /// Those of the file `path`, or what is wrong with them.
    pub(super) fn read(path: &Path, weights: &Weights) -> Result<Result<Self, String>> {
        if let Some(text) = weights.metadata().get(METADATA) {
            let value = serde_json::from_str(text);
            let value = value.map_err(|e| format!("metadata {METADATA:?} is not JSON: {e}"));
            return Ok(value.and_then(|value| Self(value).checked(METADATA)));
        }
        if !weights.names().any(|key| key.starts_with(OWN_PREFIX)) {
            return Ok(Ok(Self(Value::Null)));
        }
        let config = path.with_file_name(CONFIG);
        if config.is_file() {
            let value = ConfigFile::read(&config)?.parse::<Value>()?;
            let settings = Self(value);
            if settings.field("lora_alpha").is_none_or(|a| !a.is_number()) {
                return Ok(Err(format!("{CONFIG} beside it has no number lora_alpha")));
            }
            return Ok(settings.checked(CONFIG));
        }
        if weights.names().any(|key| key.ends_with(".alpha")) {
            return Ok(Ok(Self(Value::Null)));
        }
        Ok(Err(format!(
            "nothing tells its alpha: its keys ({OWN_PREFIX}...) are those of peft, which writes alpha into {CONFIG}; put \
             that file beside it, or export the LoRA with diffusers' save_lora_weights"
        )))
    }

    /// Refuses what is no plain LoRA.
    fn checked(self, source: &str) -> Result<Self, String> {
        if self.field("use_dora").and_then(Value::as_bool) == Some(true) {
            return Err(format!(
                "{source} says that it is a DoRA (use_dora); {ACCEPTED}"
            ));
        }
        match self.field("peft_type").and_then(Value::as_str) {
            None | Some("LORA") => {}
            Some(other) => return Err(format!("{source} has peft_type = {other:?}; {ACCEPTED}")),
        }
        let init = self.field("init_lora_weights").and_then(Value::as_str);
        let init = init.map(str::to_lowercase);
        match init.filter(|i| CHANGES_BASE.iter().any(|start| i.starts_with(start))) {
            None => Ok(self),
            Some(init) => Err(format!(
                "{source} has init_lora_weights = {init:?}, which changes the model's own weights; save it with peft's \
                 path_initial_model_for_weight_conversion"
            )),
        }
    }

    /// A setting, for the UNet or for all.
    fn field(&self, name: &str) -> Option<&Value> {
        let own = self.0.get(format!("unet.{name}"));
        own.or_else(|| self.0.get(name)).filter(|v| !v.is_null())
    }

    /// alpha over the rank times the rank, of a layer whose matrices have `rank`; the rank where nothing is said.
    pub(super) fn alpha(&self, layer: &str, rank: usize) -> Result<f64, String> {
        let wanted = match self.of_pattern("rank_pattern", layer)? {
            Some(rank) => Some(rank),
            None => self.field("r").and_then(Value::as_f64),
        };
        if let Some(wanted) = wanted
            && wanted != rank as f64
        {
            return Err(format!(
                "layer {layer:?} has matrices of rank {rank}, the settings of the training say {wanted}: they are of \
                 another LoRA"
            ));
        }
        let alpha = match self.of_pattern("alpha_pattern", layer)? {
            Some(alpha) => Some(alpha),
            None => self.field("lora_alpha").and_then(Value::as_f64),
        };
        let alpha = alpha.unwrap_or(rank as f64);
        Ok(match self.field("use_rslora").and_then(Value::as_bool) {
            // The scale is alpha / sqrt(rank) [Kalajdzievski 2023].
            Some(true) => alpha * (rank as f64).sqrt(),
            _ => alpha,
        })
    }

    /// The number of the pattern's first key that is the layer's name, or its end. A key that starts with `^` is all of it.
    fn of_pattern(&self, name: &str, layer: &str) -> Result<Option<f64>, String> {
        let Some(pattern) = self.field(name).and_then(Value::as_object) else {
            return Ok(None);
        };
        for (key, value) in pattern {
            let (plain, whole) = match key.strip_prefix('^') {
                Some(rest) => (rest, true),
                None => (key.as_str(), false),
            };
            let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '.';
            if !plain.chars().all(is_plain) {
                return Err(format!(
                    "{name} has the regular expression {key:?}; accepted: names of layers, or their ends"
                ));
            }
            if layer == plain || (!whole && layer.ends_with(&format!(".{plain}"))) {
                return Ok(value.as_f64());
            }
        }
        Ok(None)
    }
}

/// The remedy where a file is another kind of adapter.
pub(super) const ACCEPTED: &str =
    "accepted: a plain LoRA; train it again as one (use_dora = false)";
