//! Reading configuration files that carry more keys than matter here:
//! unknown keys are tolerated, known ones with unsupported values refused.

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::error::{Error, Result, io};

/// A parsed JSON configuration and where it came from.
#[derive(Debug, Clone)]
pub struct ConfigFile {
    path: PathBuf,
    value: Value,
}

/// Numbers that Python writes and JSON lacks, as diffusers does for `lambda_min_clipped` of its DPM-Solvers.
const NOT_JSON: [&str; 3] = ["-Infinity", "Infinity", "NaN"];

/// `json` with [`NOT_JSON`] as texts: a key that needs a number refuses them.
fn with_quoted_numbers(json: &[u8]) -> Vec<u8> {
    let (mut out, mut at, mut is_text) = (Vec::with_capacity(json.len()), 0, false);
    while let Some(&byte) = json.get(at) {
        let rest = &json[at..];
        let mut words = NOT_JSON.iter().map(|word| word.as_bytes());
        if !is_text && let Some(word) = words.find(|word| rest.starts_with(word)) {
            out.extend([b"\"", word, b"\""].concat());
            at += word.len();
            continue;
        }
        // A quote after a backslash ends no text.
        let length = if is_text && byte == b'\\' { 2 } else { 1 };
        is_text ^= byte == b'"';
        out.extend(rest.iter().take(length));
        at += length;
    }
    out
}

impl ConfigFile {
    /// Reads `path`. Python's `Infinity` and `NaN` are texts.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = dipir_files::read(path).map_err(io("read", path))?;
        let value = serde_json::from_slice(&bytes)
            .or_else(|_| serde_json::from_slice(&with_quoted_numbers(&bytes)));
        let value: Value = value.map_err(|e| Error::Config {
            path: path.to_owned(),
            message: format!("not JSON: {e}"),
        })?;
        if !value.is_object() {
            return Err(Error::Config {
                path: path.to_owned(),
                message: "not a JSON object".into(),
            });
        }
        Ok(Self {
            path: path.to_owned(),
            value,
        })
    }

    /// A configuration that is in memory already; `path` is for messages.
    pub fn from_value(path: impl Into<PathBuf>, value: Value) -> Self {
        Self {
            path: path.into(),
            value,
        }
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The value of `key`; null counts as absent.
    pub fn get(&self, key: &str) -> Option<&Value> {
        self.value.get(key).filter(|value| !value.is_null())
    }

    /// The same with `defaults` for the keys that are absent or null.
    pub fn with_defaults(mut self, defaults: Map<String, Value>) -> Self {
        if let Value::Object(map) = &mut self.value {
            for (key, value) in defaults {
                let present = map.entry(key).or_insert(Value::Null);
                if present.is_null() {
                    *present = value;
                }
            }
        }
        self
    }

    /// Converts to a typed configuration that takes the keys it knows.
    pub fn parse<T: DeserializeOwned>(&self) -> Result<T> {
        // Null means "default" in diffusers' files.
        let present = match &self.value {
            Value::Object(map) => Value::Object(
                map.iter()
                    .filter(|(_, v)| !v.is_null())
                    .map(|(k, v)| (k.clone(), v.clone()))
                    .collect(),
            ),
            other => other.clone(),
        };
        serde_path_to_error::deserialize(present)
            .map_err(|e| self.error(format!("{}: {}", e.path(), e.inner())))
    }

    /// Refuses `key` unless it is absent, null or one of `accepted`.
    pub fn require(&self, key: &str, accepted: &[Value]) -> Result<()> {
        match self.get(key) {
            Some(value) if !accepted.contains(value) => {
                let accepted: Vec<String> = accepted.iter().map(Value::to_string).collect();
                let accepted = if accepted.is_empty() {
                    "null".into()
                } else {
                    accepted.join(", ")
                };
                Err(self.unsupported(key, value, &accepted))
            }
            _ => Ok(()),
        }
    }

    /// Refuses `key` where it is null, which is not the same as absent there.
    pub fn require_present(&self, key: &str, accepted: &Value) -> Result<()> {
        match self.value.get(key) {
            Some(Value::Null) => Err(self.unsupported(key, &Value::Null, &accepted.to_string())),
            _ => Ok(()),
        }
    }

    /// Refuses `key` where it has a value for each level.
    pub fn require_single(&self, key: &str) -> Result<()> {
        match self.get(key) {
            Some(list @ Value::Array(_)) => {
                Err(self.unsupported(key, list, "one number for all levels"))
            }
            _ => Ok(()),
        }
    }

    fn unsupported(&self, key: &str, value: &Value, accepted: &str) -> Error {
        self.error(format!(
            "{key} = {value} is not supported, accepted: {accepted}; use a model of the Stable Diffusion 1 or 2 family"
        ))
    }

    /// An error about this file.
    pub fn error(&self, message: impl Into<String>) -> Error {
        Error::Config {
            path: self.path.clone(),
            message: message.into(),
        }
    }
}

/// One value for all levels or one for each.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(untagged)]
pub enum PerLevel {
    /// The same at every level.
    All(usize),
    /// From the finest level to the coarsest.
    Each(Vec<usize>),
}

impl PerLevel {
    /// The value at `level`; `None` if the list is too short.
    pub fn at(&self, level: usize) -> Option<usize> {
        match self {
            Self::All(value) => Some(*value),
            Self::Each(values) => values.get(level).copied(),
        }
    }

    /// Whether it fits `levels` levels.
    pub fn fits(&self, levels: usize) -> bool {
        match self {
            Self::All(_) => true,
            Self::Each(values) => values.len() == levels,
        }
    }
}
