//! The folder of an evaluation: its scenes, and where runs leave their results.
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use dipir_cli::exit::Usage;
use dipir_evaluation::results::read_json;
use dipir_scene::import::load_object;
use dipir_stages::composite::table::Tone;
use serde::{Deserialize, Serialize};

use crate::score::Score;

/// The folder.
#[derive(Clone, Debug)]
pub struct EvaluationFolder {
    root: PathBuf,
}

/// The folder of the truth among the runs; no method may have this name.
pub const TRUTH: &str = "truth";

/// What the scenes of one set have in common.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drawn {
    /// "panoramas", or the kind of generated places.
    pub set: String,
    /// The seed of what is drawn.
    pub seed: u64,
    /// Width and height of the photographs.
    pub size: [usize; 2],
}

impl Drawn {
    fn options(&self) -> String {
        let [width, height] = self.size;
        format!("--seed {} --size {width}x{height}", self.seed)
    }
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
    /// The kind of place, if it is known: the report has a table by kind.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kind: Option<String>,
    /// How it was drawn, if `dipir-evaluate make` made it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drawn: Option<Drawn>,
}

impl EvaluationFolder {
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

    /// A method's picture of a scene.
    pub fn picture(&self, method: &str, scene: &str) -> PathBuf {
        self.run(method, scene).join("composite/composite.png")
    }

    /// Hash of what a scene is: its `scene.json`, its files, its objects' files and those that these consist of: materials,
    /// buffers, textures. A file that cannot be read counts as an empty one.
    pub fn digest(&self, scene: &SceneInfo) -> String {
        let folder = self.scene(&scene.name);
        let pipeline = folder.join("pipeline.toml");
        let mut files = objects(&pipeline).unwrap_or_default();
        let parts = |object: &PathBuf| load_object(object).map_or(Vec::new(), |o| o.dependencies);
        let parts: Vec<PathBuf> = files.iter().flat_map(parts).collect();
        files.extend(parts);
        files.extend([pipeline, folder.join("photo.png"), folder.join(&scene.map)]);
        let mut hash = blake3::Hasher::new();
        hash.update(&serde_json::to_vec(scene).unwrap_or_default());
        for file in files {
            let bytes = dipir_files::read(&file).unwrap_or_default();
            hash.update(blake3::hash(&bytes).as_bytes());
        }
        hash.finalize().to_hex()[..16].to_owned()
    }

    /// Whether a method's score was made of a scene whose [`digest`](Self::digest) was another one; false where no score
    /// tells.
    pub fn is_earlier(&self, method: &str, scene: &str, digest: &str) -> bool {
        let score = read_json::<Score>(&self.run(method, scene).join("score.json"));
        score.is_ok_and(|s| s.scene_digest.is_some_and(|d| d != digest))
    }

    /// Where stages work.
    pub fn work(&self, scene: &str, key: &str) -> PathBuf {
        self.root.join("work").join(scene).join(key)
    }

    /// All scenes by name.
    ///
    /// # Errors
    /// If there is none, or one cannot be read.
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

    /// Refuses to add scenes that are `drawn` so to those of the same set that were drawn otherwise.
    ///
    /// # Errors
    /// If there are such scenes, or one that is there cannot be read.
    pub fn refuse_others(&self, drawn: &Drawn) -> anyhow::Result<()> {
        let folder = self.root.join("scenes");
        for name in folders(&folder)? {
            let file = folder.join(&name).join("scene.json");
            // A scene without it is not finished.
            if !file.is_file() {
                continue;
            }
            let info: SceneInfo = read_json(&file)?;
            let other = info.drawn.filter(|d| d.set == drawn.set && d != drawn);
            if let Some(other) = other {
                let text = format!(
                    "{} holds {name}, made with {}, and {} is asked for: a set has one seed and one size; ask \
                     for the same, name another folder with --out, or remove the scenes that are there",
                    folder.display(),
                    other.options(),
                    drawn.options()
                );
                return Err(Usage(text).into());
            }
        }
        Ok(())
    }

    /// The scenes whose names begin with one of `prefixes`; all if there are no prefixes.
    ///
    /// # Errors
    /// If no scene begins with one of `prefixes`.
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

    /// Names of the methods that ran, sorted.
    ///
    /// # Errors
    /// If the folder cannot be read.
    pub fn methods(&self) -> anyhow::Result<Vec<String>> {
        folders(&self.root.join("runs"))
    }
}

/// The files of the objects that `pipeline` names.
pub(crate) fn objects(pipeline: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let text = dipir_files::read_to_string(pipeline)
        .with_context(|| format!("cannot read {}", pipeline.display()))?;
    let table: toml::Table =
        toml::from_str(&text).with_context(|| format!("cannot read {}", pipeline.display()))?;
    let objects = table.get("scene").and_then(|s| s.get("objects"));
    let paths = objects
        .and_then(|o| o.as_array())
        .into_iter()
        .flatten()
        .filter_map(|o| o.get("path")?.as_str());
    let folder = pipeline.parent().unwrap_or(Path::new(""));
    Ok(paths.map(|p| folder.join(p)).collect())
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_materials_make_another_scene() {
        let folder = tempfile::tempdir().unwrap();
        let evaluation = EvaluationFolder::new(folder.path());
        let info: SceneInfo = serde_json::from_value(serde_json::json!({
            "name": "a", "made_from": "", "map": "map.exr", "exposure_ev": 0.0, "tone": "none",
        }))
        .unwrap();
        let at = |name: &str| evaluation.scene("a").join(name);
        fs::create_dir_all(at("")).unwrap();
        fs::write(at("pipeline.toml"), "[[scene.objects]]\npath = \"a.obj\"\n").unwrap();
        let mesh = "mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
        fs::write(at("a.obj"), mesh).unwrap();
        let with = |materials: &str| {
            fs::write(at("a.mtl"), format!("newmtl m\n{materials}\n")).unwrap();
            evaluation.digest(&info)
        };
        let plain = with("Kd 1 0 0");
        assert_ne!(plain, with("Kd 0 1 0"));
        assert_eq!(plain, with("Kd 1 0 0"));
        // A texture counts from when it is there.
        let without = with("map_Kd a.png");
        fs::write(at("a.png"), "pixels").unwrap();
        assert_ne!(without, evaluation.digest(&info));
    }
}
