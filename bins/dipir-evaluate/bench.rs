//! The folder of an evaluation: its scenes, and where runs leave their results.
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use dipir_cli::exit::Usage;
use glam::Vec3;
use serde::{Deserialize, Serialize};

/// The folder.
#[derive(Clone, Debug)]
pub struct Bench {
    root: PathBuf,
}

/// What is known of a scene, beside its `pipeline.toml`: the content of `scene.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneInfo {
    /// Name, which is that of its folder.
    pub name: String,
    /// What it was made from, in words.
    pub made_from: String,
    /// The true light, relative to the scene's folder.
    pub map: PathBuf,
    /// Stops that bring it to the photograph's scale.
    pub exposure_ev: f64,
    /// The camera's curve, known to methods whose light is a map.
    pub tone: Tone,
}

/// The curve between exposed light and the photograph's linear values.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Tone {
    /// None: what is beyond white is clipped.
    None,
    /// `x / (1 + x)`.
    Reinhard,
}

impl Tone {
    /// As `composite.tone` has it.
    pub fn name(self) -> &'static str {
        match self {
            Tone::None => "none",
            Tone::Reinhard => "reinhard",
        }
    }

    /// Light before the curve, as far as the curve tells: values near white are taken as `LARGEST`.
    pub fn undone(self, value: Vec3) -> Vec3 {
        /// Beyond it the curve is flat.
        const LARGEST: f32 = 0.95;
        match self {
            Tone::None => value,
            Tone::Reinhard => {
                let v = value.clamp(Vec3::ZERO, Vec3::splat(LARGEST));
                v / (Vec3::ONE - v)
            }
        }
    }
}

impl Bench {
    /// The evaluation in `root`.
    pub fn new(root: &Path) -> Self {
        Self { root: root.into() }
    }

    /// Where it is.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// A scene's own folder.
    pub fn scene(&self, name: &str) -> PathBuf {
        self.root.join("scenes").join(name)
    }

    /// Where a method leaves what it made of a scene.
    pub fn run(&self, method: &str, scene: &str) -> PathBuf {
        self.root.join("runs").join(method).join(scene)
    }

    /// Where stages work.
    pub fn work(&self, scene: &str, key: &str) -> PathBuf {
        self.root.join("work").join(scene).join(key)
    }

    /// All scenes by name; an error that says what to do if there is none.
    pub fn scenes(&self) -> anyhow::Result<Vec<SceneInfo>> {
        let folder = self.root.join("scenes");
        let names = folders(&folder)?;
        if names.is_empty() {
            bail!(
                "there is no scene in {}; make some with dipir-evaluate make",
                folder.display()
            );
        }
        names
            .iter()
            .map(|n| read_json(&folder.join(n).join("scene.json")))
            .collect()
    }

    /// The scenes whose names begin with one of `prefixes`, all without any; an error that names them
    /// if one of `prefixes` begins none.
    pub fn chosen(&self, prefixes: &[String]) -> anyhow::Result<Vec<SceneInfo>> {
        let all = self.scenes()?;
        for prefix in prefixes {
            if !all.iter().any(|s| s.name.starts_with(prefix)) {
                let names: Vec<&str> = all.iter().map(|s| s.name.as_str()).collect();
                let text = format!("--scene {prefix}: accepted: {}", names.join(", "));
                return Err(Usage(text).into());
            }
        }
        let wanted = |s: &SceneInfo| prefixes.iter().any(|p| s.name.starts_with(p));
        let chosen = all.into_iter().filter(|s| prefixes.is_empty() || wanted(s));
        Ok(chosen.collect())
    }

    /// Names of the methods that ran, by name.
    pub fn methods(&self) -> anyhow::Result<Vec<String>> {
        folders(&self.root.join("runs"))
    }
}

/// Names of the folders in `folder`, sorted; none if it is not there.
fn folders(folder: &Path) -> anyhow::Result<Vec<String>> {
    let failed = || format!("cannot read {}", folder.display());
    let mut names = Vec::new();
    match fs::read_dir(folder) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(names),
        entries => {
            for entry in entries.with_context(failed)? {
                let entry = entry.with_context(failed)?;
                if entry.path().is_dir() {
                    names.push(entry.file_name().to_string_lossy().into_owned());
                }
            }
        }
    }
    names.sort();
    Ok(names)
}

/// Reads a JSON file.
pub fn read_json<T: for<'de> Deserialize<'de>>(path: &Path) -> anyhow::Result<T> {
    let text =
        fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    serde_json::from_str(&text)
        .with_context(|| format!("{} is damaged or of another version", path.display()))
}

/// Writes a file beside its place and renames it: there or not, never half.
pub fn write(path: &Path, content: impl AsRef<[u8]>) -> anyhow::Result<()> {
    let failed = || format!("cannot write {}", path.display());
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).with_context(failed)?;
    }
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".partial");
    let beside = path.with_file_name(name);
    fs::write(&beside, content).with_context(failed)?;
    fs::rename(&beside, path).with_context(failed)
}

/// Writes JSON that people can read.
pub fn write_json(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_vec_pretty(value)?;
    text.push(b'\n');
    write(path, text)
}
