//! Measures points by running the executables, each once for every seed; what is measured is kept,
//! so that an interrupted sweep goes on.
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::{DisplayImage, LinearImage};
use dipir_imaging::transfer::Transfer;
use dipir_render::effects::EffectsPlan;
use dipir_stages::children::{Executables, Ran};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::knobs::{Part, Setting, turned};
use crate::scenes::Scene;

/// What one run of one setting showed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// Its seed.
    pub seed: u64,
    /// Display-referred RMSE against the reference, over what object or shadow touch.
    pub error: f64,
    /// The error that the stage itself stated: a 95% bound.
    pub stated_error: Option<f64>,
    /// Processor seconds of the stages that the setting concerns; wall seconds where the system does
    /// not count the former.
    pub cost_s: f64,
    /// Wall seconds of the same.
    pub wall_s: f64,
    /// Most memory of any of them.
    pub peak_rss_bytes: u64,
}

/// All runs of one setting in one scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// The scene.
    pub scene: String,
    /// `render` or `light`.
    pub part: String,
    /// The series it is drawn in.
    pub series: String,
    /// Its values.
    pub label: String,
    /// Keys and values.
    pub set: Vec<(String, String)>,
    /// A run a seed.
    pub samples: Vec<Sample>,
}

/// A converged picture.
struct Reference {
    picture: DisplayImage,
    /// Whether object or shadow touch each pixel.
    touched: Vec<bool>,
}

/// Measures one scene.
pub struct Bench<'a> {
    /// What runs.
    pub executables: &'a Executables,
    /// Where everything goes.
    pub out: &'a Path,
    /// Which scene.
    pub scene: &'a Scene,
    /// `--threads`.
    pub threads: usize,
    /// Where the reference of the render track stops.
    pub reference_error: f64,
}

/// Seed of references: apart from those of points.
const REFERENCE_SEED: u64 = 1_000_003;
/// Error at which the pictures under recovered lights, and the truth that they are recovered from,
/// stop.
const PICTURE_ERROR: &str = "0.003";

impl Bench<'_> {
    fn work(&self) -> PathBuf {
        self.out.join("work").join(folder_name(&self.scene.name))
    }

    fn stage(
        &self,
        name: &str,
        pipeline: &Path,
        out: &Path,
        seed: u64,
        set: &[(String, String)],
    ) -> anyhow::Result<Ran> {
        let mut arguments: Vec<String> = vec![
            "-p".into(),
            pipeline.to_string_lossy().into(),
            "-o".into(),
            out.to_string_lossy().into(),
            "--seed".into(),
            seed.to_string(),
            "-j".into(),
            self.threads.to_string(),
        ];
        for (key, value) in set {
            arguments.extend(["--set".into(), format!("{key}={value}")]);
        }
        self.executables.run(name, &arguments)
    }

    /// The render track's reference: everything simulated, sampled to the reference's error.
    fn reference(&self) -> anyhow::Result<Reference> {
        let folder = self.work().join("reference");
        let done = folder.join("done.json");
        if !done.is_file() {
            let set = own(&[
                ("scene.effects.mode", "all"),
                ("composite.target_error", &self.reference_error.to_string()),
                ("composite.max_samples", "4194304"),
            ]);
            let ran = self.composite(&folder, &set)?;
            write(&done, &ran.json)?;
        }
        load(&folder.join("composite/composite.exr"))
    }

    /// The scene under its known light, made in `folder` with the reference's seed.
    fn composite(&self, folder: &Path, set: &[(String, String)]) -> anyhow::Result<Ran> {
        let lit = &self.scene.lit;
        self.stage("dipir-scene", lit, folder, REFERENCE_SEED, set)?;
        self.stage("dipir-composite", lit, folder, REFERENCE_SEED, set)
    }

    /// Names of the effects that planning leaves on.
    pub fn effects_on(&self) -> anyhow::Result<Vec<String>> {
        let folder = self.work().join("planned");
        let path = folder.join("scene/effects.json");
        if !path.is_file() {
            self.stage("dipir-scene", &self.scene.lit, &folder, 0, &[])?;
        }
        let plan: EffectsPlan = read(&path)?;
        let on = plan.effects.iter().filter(|e| e.enabled);
        let names = on.map(|e| e.name.name().to_owned());
        Ok(names.filter(|n| n != "occluders").collect())
    }

    /// The picture that light is recovered from, made under the known light.
    fn truth(&self, recover: &Path) -> anyhow::Result<Reference> {
        let folder = self.work().join("truth");
        let picture = folder.join("composite/composite.exr");
        let beside = recover.with_file_name("truth.exr");
        if !beside.is_file() {
            let set = own(&[("composite.target_error", PICTURE_ERROR)]);
            self.composite(&folder, &set)?;
            fs::copy(&picture, &beside)
                .with_context(|| format!("cannot write {}", beside.display()))?;
        }
        load(&beside)
    }

    /// Measures `setting` with the seeds below `repeats`, or reads what was measured; `None` for the
    /// light of a scene that has none to be recovered.
    pub fn measure(&self, setting: &Setting, repeats: u64) -> anyhow::Result<Option<Point>> {
        let mut point = Point {
            scene: self.scene.name.clone(),
            part: setting.part.name().into(),
            series: setting.series.clone(),
            label: setting.label.clone(),
            set: setting.set.clone(),
            samples: Vec::new(),
        };
        let mut reference = None;
        for seed in 0..repeats {
            let file = self.sample_file(setting, seed);
            let sample = match file.is_file() {
                true => read(&file)?,
                false => {
                    if reference.is_none() {
                        reference = match (setting.part, &self.scene.recover) {
                            (Part::Render, _) => Some(self.reference()?),
                            (Part::Light, Some(recover)) => Some(self.truth(recover)?),
                            (Part::Light, None) => return Ok(None),
                        };
                    }
                    let Some(reference) = &reference else {
                        return Ok(None);
                    };
                    let sample = match (setting.part, &self.scene.recover) {
                        (Part::Light, Some(recover)) => {
                            self.light(recover, setting, seed, reference)?
                        }
                        _ => self.render(setting, seed, reference)?,
                    };
                    write(&file, &sample)?;
                    sample
                }
            };
            point.samples.push(sample);
        }
        Ok(Some(point))
    }

    /// What is already measured of `setting`.
    pub fn measured(&self, setting: &Setting) -> anyhow::Result<Vec<Sample>> {
        (0..)
            .map(|seed| self.sample_file(setting, seed))
            .take_while(|file| file.is_file())
            .map(|file| read(&file))
            .collect()
    }

    fn sample_file(&self, setting: &Setting, seed: u64) -> PathBuf {
        let name = format!("{}-{seed}.json", key(&turned(&setting.set)));
        let folder = self.out.join("points").join(folder_name(&self.scene.name));
        folder.join(setting.part.name()).join(name)
    }

    fn render(
        &self,
        setting: &Setting,
        seed: u64,
        reference: &Reference,
    ) -> anyhow::Result<Sample> {
        // Runs that differ in [composite] alone share what dipir-scene made.
        let concerns_scene = |key: &str| !key.starts_with("composite.");
        let set_up: Vec<_> = setting
            .set
            .iter()
            .filter(|(k, _)| concerns_scene(k))
            .cloned()
            .collect();
        let folder = self.work().join(format!("{}-{seed}", key(&set_up)));
        let kept = folder.join("cost.json");
        if !kept.is_file() {
            let ran = self.stage("dipir-scene", &self.scene.lit, &folder, seed, &set_up)?;
            write(
                &kept,
                &[ran.cpu_s.unwrap_or(ran.wall_s), ran.wall_s, rss(&ran.json)],
            )?;
        }
        let [scene_cost, scene_wall, scene_rss]: [f64; 3] = read(&kept)?;
        let ran = self.stage(
            "dipir-composite",
            &self.scene.lit,
            &folder,
            seed,
            &setting.set,
        )?;
        let found = load(&folder.join("composite/composite.exr"))?;
        let _ = fs::remove_dir_all(folder.join("composite"));
        Ok(Sample {
            seed,
            error: apart(&found.picture, reference),
            stated_error: ran.json["estimated_error"].as_f64(),
            cost_s: scene_cost + ran.cpu_s.unwrap_or(ran.wall_s),
            wall_s: scene_wall + ran.wall_s,
            peak_rss_bytes: rss(&ran.json).max(scene_rss) as u64,
        })
    }

    fn light(
        &self,
        recover: &Path,
        setting: &Setting,
        seed: u64,
        reference: &Reference,
    ) -> anyhow::Result<Sample> {
        // A record of no use to anybody, so that dipir-light makes its own and its cost is that of
        // recording and optimising, without planning.
        let folder = self.work().join(format!("recover-{seed}"));
        if !folder.join("scene/stage.json").is_file() {
            let tiny = own(&[
                ("light.samples", "1"),
                ("light.size", "8"),
                ("light.environment", "[8, 4]"),
            ]);
            self.stage("dipir-scene", recover, &folder, seed, &tiny)?;
        }
        let ran = self.stage("dipir-light", recover, &folder, seed, &setting.set)?;
        let picture = own(&[("composite.target_error", PICTURE_ERROR)]);
        self.stage("dipir-composite", recover, &folder, seed, &picture)?;
        let found = load(&folder.join("composite/composite.exr"))?;
        Ok(Sample {
            seed,
            error: apart(&found.picture, reference),
            stated_error: ran.json["rmse"].as_f64(),
            cost_s: ran.cpu_s.unwrap_or(ran.wall_s),
            wall_s: ran.wall_s,
            peak_rss_bytes: rss(&ran.json) as u64,
        })
    }
}

/// Display-referred RMSE over what the reference's object or shadow touch.
fn apart(found: &DisplayImage, reference: &Reference) -> f64 {
    let (a, b) = (found.0.pixels(), reference.picture.0.pixels());
    let (mut sum, mut count) = (0.0, 0.0);
    for k in 0..a.len().min(b.len()) {
        if reference.touched[k] {
            sum += f64::from((a[k] - b[k]).length_squared()) / 3.0;
            count += 1.0;
        }
    }
    (sum / f64::max(count, 1.0)).sqrt()
}

fn load(exr: &Path) -> anyhow::Result<Reference> {
    let layers = Layers::read_exr(exr)?;
    let shown = |name: &str| anyhow::Ok(Transfer::Srgb.encode(&LinearImage(layers.rgb(name)?)));
    let (picture, photo) = (shown("")?, shown("background")?);
    let coverage = layers.channel("object.A")?;
    let touched = dipir_evaluation::scores::Touched::new(coverage, &picture, &photo);
    Ok(Reference {
        picture,
        touched: touched.any,
    })
}

fn own(set: &[(&str, &str)]) -> Vec<(String, String)> {
    set.iter()
        .map(|(k, v)| (k.to_string(), v.to_string()))
        .collect()
}

fn rss(json: &Value) -> f64 {
    json["peak_rss_bytes"].as_f64().unwrap_or(0.0)
}

/// A short name for settings.
fn key(set: &[(String, String)]) -> String {
    let text: Vec<String> = set.iter().map(|(k, v)| format!("{k}={v}")).collect();
    blake3::hash(text.join("\n").as_bytes()).to_hex()[..12].to_owned()
}

fn folder_name(scene: &str) -> String {
    let keep = |c: char| if c.is_ascii_alphanumeric() { c } else { '-' };
    scene.chars().map(keep).collect()
}

fn read<T: for<'de> Deserialize<'de>>(path: &Path) -> anyhow::Result<T> {
    let text =
        fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    serde_json::from_str(&text).with_context(|| {
        format!(
            "{} is damaged: remove it to measure it again",
            path.display()
        )
    })
}

/// Written beside its place and renamed: there or not, never half.
pub fn write(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let failed = || format!("cannot write {}", path.display());
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).with_context(failed)?;
    }
    let beside = path.with_extension("partial");
    fs::write(&beside, serde_json::to_vec_pretty(value)?).with_context(failed)?;
    fs::rename(&beside, path).with_context(failed)
}
