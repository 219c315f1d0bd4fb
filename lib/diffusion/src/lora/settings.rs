//! What says alpha of a LoRA: the header's metadata of diffusers, or peft's `adapter_config.json` beside the file.

use std::path::{Path, PathBuf};

use serde_json::Value;
use tokenizers::utils::SysRegex;

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
#[derive(Default)]
pub(super) struct Settings {
    value: Value,
    ranks: Vec<Pattern>,
    alphas: Vec<Pattern>,
}

/// A number for the layers whose whole name, or its end after a dot, a regular expression matches, as in peft.
struct Pattern {
    layers: SysRegex,
    number: f64,
}

/// Most [`steps`] of all patterns of a setting. Compiled, a class of characters such as `\w` takes 67 kB.
const MOST_STEPS: usize = 4000;

/// Characters of a regular expression, repetitions written out; 0 of a plain name, which is compiled to little. Its dots
/// may be escaped.
fn steps(pattern: &str) -> usize {
    let is_plain = |b: u8| b.is_ascii_alphanumeric() || b"_.^$".contains(&b);
    if pattern.replace(r"\.", ".").bytes().all(is_plain) {
        return 0;
    }
    let most = |repetition: &str| {
        let inside = repetition.split('}').next().unwrap_or_default();
        let numbers = inside.split(',').filter_map(|n| n.trim().parse().ok());
        numbers.max().unwrap_or(1).max(1)
    };
    let repetitions = pattern.split('{').skip(1).map(most);
    repetitions.fold(pattern.len(), usize::saturating_mul)
}

/// Whether a value is of the kind that a setting takes.
type Accepts = fn(&Value) -> bool;

/// Settings that are used here, and what peft takes for each.
const ACCEPTED_VALUES: [(&str, &str, Accepts); 8] = [
    ("r", WHOLE_NUMBER, is_rank),
    ("lora_alpha", NUMBER, Value::is_number),
    ("use_rslora", "true or false", Value::is_boolean),
    ("use_dora", "true or false", Value::is_boolean),
    ("peft_type", "a text", Value::is_string),
    ("init_lora_weights", "true, false or a text", |v| {
        v.is_boolean() || v.is_string()
    }),
    ("rank_pattern", PATTERNS, Value::is_object),
    ("alpha_pattern", PATTERNS, Value::is_object),
];
const PATTERNS: &str = "names of layers with their numbers, as in {\"to_q\": 8}";
const NUMBER: &str = "a number without quotes";
const WHOLE_NUMBER: &str = "a whole number above 0, without quotes";

fn is_rank(value: &Value) -> bool {
    value.as_f64().is_some_and(|r| r >= 1.0 && r.fract() == 0.0)
}

/// Characters of a value that a message quotes.
const QUOTED: usize = 60;

/// `"key": value`, as the file has it.
fn quoted(key: &str, value: &Value) -> String {
    let text = value.to_string();
    let cut = match text.char_indices().nth(QUOTED) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    };
    format!("{key:?}: {cut}")
}

/// Whether a key is one that peft writes, on its own or for a UNet that is not part of a pipeline. Keys that begin with
/// `unet.` are of diffusers, which reads no configuration beside them: without metadata, alpha is the rank.
fn is_of_peft(key: &str) -> bool {
    let is_matrix = key.ends_with(".lora_A.weight") || key.ends_with(".lora_B.weight");
    key.starts_with(OWN_PREFIX) || (is_matrix && !key.starts_with("unet."))
}

impl Settings {
    /// Those of the file `path`, or what is wrong with them.
    pub(super) fn read(path: &Path, weights: &Weights) -> Result<Result<Self, String>> {
        if let Some(text) = weights.metadata().get(METADATA) {
            let value = serde_json::from_str(text);
            let value = value.map_err(|e| format!("metadata {METADATA:?} is not JSON: {e}"));
            return Ok(value.and_then(|value| Self::checked(value, METADATA)));
        }
        if !weights.names().any(is_of_peft) {
            return Ok(Ok(Self::default()));
        }
        let config = path.with_file_name(CONFIG);
        if config.is_file() {
            let value = ConfigFile::read(&config)?.parse::<Value>()?;
            return Ok(Self::checked(value, CONFIG).and_then(|settings| {
                match settings.field("lora_alpha") {
                    Some(_) => Ok(settings),
                    None => Err(format!("{CONFIG} beside it has no number lora_alpha")),
                }
            }));
        }
        let is_own = weights.names().any(|key| key.starts_with(OWN_PREFIX));
        if !is_own || weights.names().any(|key| key.ends_with(".alpha")) {
            return Ok(Ok(Self::default()));
        }
        Ok(Err(format!(
            "nothing tells its alpha: its keys ({OWN_PREFIX}...) are those of peft, which writes alpha into {CONFIG}; put \
             that file beside it, or export the LoRA with diffusers' save_lora_weights"
        )))
    }

    /// The settings `value` of `source`. Refused is what is no plain LoRA, or has values of another kind than peft's.
    fn checked(value: Value, source: &str) -> Result<Self, String> {
        if !value.is_object() {
            return Err(format!("{source} is not a JSON object"));
        }
        let mut settings = Self {
            value,
            ..Self::default()
        };
        let mut wrong = vec![];
        for (name, accepted, is_accepted) in ACCEPTED_VALUES {
            if let Some((key, value)) = settings.entry(name)
                && !is_accepted(value)
            {
                wrong.push(format!("{} (accepted: {accepted})", quoted(&key, value)));
            }
        }
        if !wrong.is_empty() {
            return Err(format!("{source} has {}; correct it", wrong.join(", ")));
        }
        settings.ranks = settings.patterns(source, "rank_pattern", WHOLE_NUMBER, is_rank)?;
        settings.alphas = settings.patterns(source, "alpha_pattern", NUMBER, Value::is_number)?;
        if settings.field("use_dora").and_then(Value::as_bool) == Some(true) {
            return Err(format!(
                "{source} says that it is a DoRA (use_dora); {ACCEPTED}"
            ));
        }
        match settings.field("peft_type").and_then(Value::as_str) {
            None | Some("LORA") => {}
            Some(other) => return Err(format!("{source} has peft_type = {other:?}; {ACCEPTED}")),
        }
        let init = settings.field("init_lora_weights").and_then(Value::as_str);
        let init = init.map(str::to_lowercase);
        match init.filter(|i| CHANGES_BASE.iter().any(|start| i.starts_with(start))) {
            None => Ok(settings),
            Some(init) => Err(format!(
                "{source} has init_lora_weights = {init:?}, which changes the model's own weights; save it with peft's \
                 path_initial_model_for_weight_conversion"
            )),
        }
    }

    /// A setting, for the UNet or for all, and its key.
    fn entry(&self, name: &str) -> Option<(String, &Value)> {
        let keys = [format!("unet.{name}"), name.to_owned()];
        let mut found = keys
            .into_iter()
            .filter_map(|key| self.value.get(&key).map(|value| (key, value)));
        found.next().filter(|(_, value)| !value.is_null())
    }

    fn field(&self, name: &str) -> Option<&Value> {
        self.entry(name).map(|(_, value)| value)
    }

    /// The numbers that `name` gives to layers, in the file's order.
    fn patterns(
        &self,
        source: &str,
        name: &str,
        accepted: &str,
        is_accepted: Accepts,
    ) -> Result<Vec<Pattern>, String> {
        let Some(entries) = self.field(name).and_then(Value::as_object) else {
            return Ok(vec![]);
        };
        let pattern = |(key, value): (&String, &Value)| {
            let number = value.as_f64().filter(|_| is_accepted(value));
            let number = number.ok_or_else(|| {
                let quoted = quoted(key, value);
                format!("{source} has {quoted} in {name} (accepted: {accepted}); correct it")
            })?;
            let layers = SysRegex::new(&format!(r"^(.*\.)?({key})$")).map_err(|e| {
                format!(
                    "{source}: {name} has {key:?}, which is no regular expression ({e}); correct it"
                )
            })?;
            Ok(Pattern { layers, number })
        };
        let steps = entries.keys().map(|key| steps(key));
        let steps = steps.fold(0, usize::saturating_add);
        if steps > MOST_STEPS {
            return Err(format!(
                "{source}: the regular expressions of {name} have {steps} characters, repetitions written out (accepted: \
                 {MOST_STEPS}); write the names of layers"
            ));
        }
        entries.iter().map(pattern).collect()
    }

    /// alpha over the rank times the rank, of a layer whose matrices have `rank`; the rank where nothing is said.
    pub(super) fn alpha(&self, layer: &str, rank: usize) -> Result<f64, String> {
        let number = |patterns: &[Pattern], name: &str| {
            let first = patterns
                .iter()
                .find(|p| p.layers.find_iter(layer).next().is_some());
            match first {
                Some(pattern) => Some(pattern.number),
                None => self.field(name).and_then(Value::as_f64),
            }
        };
        if let Some(wanted) = number(&self.ranks, "r")
            && wanted != rank as f64
        {
            return Err(format!(
                "layer {layer:?} has matrices of rank {rank}, the settings of the training say {wanted}: they are of \
                 another LoRA"
            ));
        }
        let alpha = number(&self.alphas, "lora_alpha").unwrap_or(rank as f64);
        Ok(match self.field("use_rslora").and_then(Value::as_bool) {
            // The scale is alpha / sqrt(rank) [Kalajdzievski 2023].
            Some(true) => alpha * (rank as f64).sqrt(),
            _ => alpha,
        })
    }
}

/// The remedy where a file is another kind of adapter.
pub(super) const ACCEPTED: &str = "accepted: a plain LoRA; train it again as one";
