//! `pipeline.toml`: one file for all stages, each of which reads its own table.
//!
//! Values keep the line that they came from, so that a wrong one is reported as
//! `file:line: key is …, accepted: …`. The tables are read into the domain crates' own serde
//! types; a type that refuses unknown fields makes a misspelt key an error that names the
//! accepted keys and the nearest one.
mod alternatives;
mod deserialize;
mod methods;
mod renamed;
mod tree;

use std::fmt;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::error::{ConfigError, plain};
use tree::{Node, Value};

/// The tables that a `pipeline.toml` may hold.
pub const TABLES: [&str; 8] = [
    "pipeline",
    "model",
    "scene",
    "concepts",
    "lora",
    "light",
    "composite",
    "report",
];

pub use methods::Method;
pub use renamed::renamed;

/// Where a value was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// A line of a file, counted from 1.
    Line {
        /// As it was named on the command line.
        file: PathBuf,
        /// Counted from 1.
        line: usize,
    },
    /// A file as a whole.
    File {
        /// As it was named on the command line.
        file: PathBuf,
    },
    /// A command-line option, quoted.
    Flag(String),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line { file, line } => write!(f, "{}:{line}", file.display()),
            Self::File { file } => write!(f, "{}", file.display()),
            Self::Flag(text) => write!(f, "{text}"),
        }
    }
}

/// How much work is done where the configuration does not say.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Quality {
    /// Quick looks.
    Draft,
    /// Results.
    #[default]
    Standard,
    /// Final frames.
    High,
}

/// More worker threads than this are refused: they would only fill the memory with stacks.
pub const MAX_THREADS: usize = 1024;

/// The `[pipeline]` table, which every executable reads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PipelineTable {
    /// Folder of all artifacts; each stage writes a folder of its own in it.
    #[schemars(extend("format" = "path"), example = &"out")]
    pub out: PathBuf,
    /// Key of every random number; the same key gives the same files.
    #[schemars(example = 7)]
    pub seed: u64,
    /// Worker threads; 0 is one for every core. They never change a result.
    #[schemars(range(min = 0, max = MAX_THREADS), example = 8)]
    pub threads: usize,
    /// What computes diffusion models: `cpu`, `cuda:N` (the N-th NVIDIA GPU, from 0), `metal:N` (Apple's; never tried) or
    /// `auto` (an NVIDIA GPU if there is one).
    #[schemars(example = &"auto")]
    pub device: String,
    /// How much work is done where a key does not say it.
    #[schemars(example = &"draft")]
    pub quality: Quality,
    /// A published method whose settings hold where a key does not say otherwise: what the paper of DiPIR states for
    /// Stable Diffusion 2.1.
    #[schemars(extend("x-default" = "none: the defaults of each key"), example = &"dipir-outdoors")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub method: Option<Method>,
}

impl Default for PipelineTable {
    fn default() -> Self {
        Self {
            out: "out".into(),
            seed: 0,
            threads: 0,
            device: "cpu".into(),
            quality: Quality::Standard,
            method: None,
        }
    }
}

/// A `pipeline.toml` with its overrides applied.
#[derive(Clone, Debug)]
pub struct Config {
    path: PathBuf,
    root: Node,
    overrides: Vec<String>,
}

impl Config {
    /// Reads `path` and applies `overrides`, each `table.key=value`: a TOML value, or else a bare
    /// string. Later overrides win, and they take the place of keys of the file that exclude them.
    pub fn read(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let bytes = dipir_files::read(path).map_err(|e| ConfigError::Read {
            path: path.into(),
            cause: plain(&e),
        })?;
        Self::parse(path, tree::text(path, &bytes)?, overrides)
    }

    /// As [`read`](Self::read), with the file's text at hand.
    pub fn parse(path: &Path, text: &str, overrides: &[String]) -> Result<Self, ConfigError> {
        let mut root = tree::parse_file(path, text)?;
        for text in overrides {
            tree::apply_override(&mut root, text)?;
        }
        alternatives::drop_replaced(&mut root, overrides);
        methods::fill(&mut root)?;
        let config = Self {
            path: path.into(),
            root,
            overrides: overrides.to_vec(),
        };
        renamed::check(&config)?;
        config.check_tables()?;
        Ok(config)
    }

    /// Refuses tables that nothing reads. Those of `[scene]` are known by their names.
    fn check_tables(&self) -> Result<(), ConfigError> {
        let Value::Table(entries) = &self.root.value else {
            unreachable!("a TOML file is a table");
        };
        for entry in entries {
            if !TABLES.contains(&entry.name.as_str()) {
                return Err(ConfigError::UnknownKey {
                    at: entry.place.clone(),
                    key: entry.name.clone(),
                    table: String::new(),
                    nearest: match entry.name.as_str() {
                        name
                        @ ("objects" | "camera" | "proxy" | "views" | "effects" | "limits") => {
                            Some(format!("scene.{name}"))
                        }
                        name => nearest(name, TABLES),
                    },
                    accepted: TABLES.map(String::from).into(),
                });
            }
        }
        Ok(())
    }

    /// The table `[name]` as a `T`; an absent table reads as an empty one.
    pub fn table<T: DeserializeOwned>(&self, name: &str) -> Result<T, ConfigError> {
        let empty = Node {
            value: Value::Table(Vec::new()),
            place: Place::File {
                file: self.path.clone(),
            },
        };
        let node = self.root.get(name).unwrap_or(&empty);
        deserialize::read(node, name)
    }

    /// Whether the dotted key is set, in the file or on the command line.
    pub fn has(&self, dotted: &str) -> bool {
        self.place(dotted).is_some()
    }

    /// Where the dotted key was set, for a message about its value.
    pub fn place(&self, dotted: &str) -> Option<Place> {
        let mut node = &self.root;
        for step in dotted.split('.') {
            node = node.get(step)?;
        }
        Some(node.place.clone())
    }

    /// Where the dotted key, or the nearest table around it, was set.
    pub fn nearest_place(&self, dotted: &str) -> Place {
        let mut key = dotted;
        loop {
            if let Some(place) = self.place(key) {
                return place;
            }
            match key.rsplit_once('.') {
                Some((table, _)) => key = table,
                None => {
                    return Place::File {
                        file: self.path.clone(),
                    };
                }
            }
        }
    }

    /// An error about the value of a dotted key, found by its reader. A message about a table that begins with a key of it is
    /// about that key.
    pub fn invalid(&self, dotted: &str, message: impl Into<String>) -> ConfigError {
        let message = message.into();
        let begins = message.split_whitespace().next().unwrap_or_default();
        let begins = begins.trim_end_matches(':');
        let key = match begins.strip_prefix(dotted) {
            Some(rest) if rest.starts_with('.') => begins,
            _ => dotted,
        };
        ConfigError::Invalid {
            at: self.nearest_place(key),
            key: key.into(),
            message,
        }
    }

    /// As [`invalid`](Self::invalid), for a value that is not among those that are accepted.
    pub fn out_of_range(
        &self,
        dotted: &str,
        value: impl std::fmt::Display,
        accepted: &str,
    ) -> ConfigError {
        let message = format!("{value} is out of range; accepted: {accepted}");
        self.invalid(dotted, message)
    }

    /// The `[pipeline]` table. Whether there is such a device is found out where a model is loaded onto it.
    pub fn pipeline(&self) -> Result<PipelineTable, ConfigError> {
        let table: PipelineTable = self.table("pipeline")?;
        let device = &table.device;
        let is_numbered = |(kind, number): (&str, &str)| {
            ["cuda", "metal"].contains(&kind) && number.parse::<usize>().is_ok()
        };
        let is_known = ["cpu", "auto"].contains(&device.as_str())
            || device.split_once(':').is_some_and(is_numbered);
        match is_known {
            true => Ok(table),
            false => {
                let message =
                    format!("\"{device}\" is no device; accepted: cpu, cuda:N, metal:N, auto");
                Err(self.invalid("pipeline.device", message))
            }
        }
    }

    /// All texts of the file and of `--set` with their dotted keys. Which of them name files their readers know.
    pub fn texts(&self) -> Vec<(String, String)> {
        let mut found = Vec::new();
        self.root.collect_texts("", &mut found);
        found
    }

    /// What replaced or added keys of the file, each `table.key=value`.
    pub fn overrides(&self) -> &[String] {
        &self.overrides
    }

    /// The file that was read.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The folder that relative paths in the file start from, itself relative to the current
    /// folder; empty if it is the current folder.
    pub fn base_dir(&self) -> PathBuf {
        self.path.parent().unwrap_or(Path::new("")).into()
    }

    /// A path of the file, made relative to the current folder.
    pub fn resolve(&self, path: &Path) -> PathBuf {
        self.base_dir().join(path)
    }
}

/// The candidate nearest to `name`, if it is near enough to be a slip of the pen.
pub fn nearest<S: AsRef<str>>(
    name: &str,
    candidates: impl IntoIterator<Item = S>,
) -> Option<String> {
    // Jaro-Winkler of 0.75 accepts transpositions and one or two lost letters in a word of
    // usual length, and rejects unrelated words of the same length.
    const NEAR: f64 = 0.75;
    // In a word of three or four letters, two swapped letters leave little similarity.
    let likeness = |c: &str| match strsim::osa_distance(name, c) {
        1 if name.len() > 2 => strsim::jaro_winkler(name, c).max(NEAR),
        _ => strsim::jaro_winkler(name, c),
    };
    candidates
        .into_iter()
        .map(|c| (likeness(c.as_ref()), c))
        .filter(|(score, _)| *score >= NEAR)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, c)| c.as_ref().to_string())
}

#[cfg(test)]
mod tests;
