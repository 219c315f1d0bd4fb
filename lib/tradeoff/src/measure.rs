//! Measures variants by running the executables, once for every seed. What is measured is kept, so that
//! an interrupted sweep goes on.
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_cli::executables::{Executables, Ran};
use dipir_evaluation::results::{read_json, write_json};
use dipir_evaluation::scores::{DisplayedComposite, rmse_over};
use dipir_imaging::raster::DisplayImage;
use dipir_render::effects::EffectsPlan;
use dipir_stages::names::{COMPOSITE, LIGHT, SCENE, StageName};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::knobs::{Part, Variant, beyond_standard, render_cost};
use crate::scenes::{MeasuredScene, folder_of};

/// What one run of a variant showed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// Its seed.
    pub seed: u64,
    /// Display-referred RMSE against the reference, over what object or shadow touch.
    pub error: f64,
    /// The error that the stage itself stated: a 95% bound.
    pub stated_error: Option<f64>,
    /// Processor seconds of the stages that the variant concerns. Wall seconds where the system does
    /// not count processor seconds.
    pub cost_s: f64,
    /// Wall seconds of the same.
    pub wall_s: f64,
    /// Peak memory of any of them, bytes.
    pub peak_rss_bytes: u64,
}

/// All runs of a variant in a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// The scene.
    pub scene: String,
    /// `render` or `light`.
    pub part: String,
    /// The series it is drawn in.
    pub series: String,
    /// Its name within the series.
    pub label: String,
    /// Keys and values.
    pub set: Vec<(String, String)>,
    /// One run for each seed.
    pub samples: Vec<Sample>,
}

impl Point {
    /// All runs of `variant` in `scene`.
    pub fn new(scene: &str, variant: &Variant, samples: Vec<Sample>) -> Self {
        Self {
            scene: scene.into(),
            part: variant.part.name().into(),
            series: variant.series.clone(),
            label: variant.label.clone(),
            set: variant.set.clone(),
            samples,
        }
    }
}

/// A converged picture.
struct Reference {
    picture: DisplayImage,
    /// Whether object or shadow touch each pixel.
    touched: Vec<bool>,
}

impl Reference {
    /// Display-referred RMSE over what the reference's object or shadow touch.
    fn error_of(&self, picture: &DisplayImage) -> f64 {
        rmse_over(picture, &self.picture, &self.touched)
    }
}

/// Measures one scene.
pub struct SceneMeasurement<'a> {
    /// The programs that are measured.
    pub executables: &'a Executables,
    /// Where everything goes.
    pub out: &'a Path,
    /// Which scene.
    pub scene: &'a MeasuredScene,
    /// `--threads`.
    pub threads: usize,
    /// Error at which the reference of the render track stops.
    pub reference_error: f64,
}

/// The scene stage's list of effects, in the folder of artifacts.
const EFFECTS: &str = "scene/effects.json";
/// Seed of references, which no point has.
const REFERENCE_SEED: u64 = 1_000_003;
/// Error at which the pictures under recovered lights, and the truth that they are recovered from,
/// stop.
const PICTURE_ERROR: &str = "0.003";

impl SceneMeasurement<'_> {
    fn work(&self) -> PathBuf {
        self.out.join("work").join(folder_name(self.scene))
    }

    fn stage(
        &self,
        stage: &StageName,
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
        self.executables.run(stage.executable, &arguments)
    }

    fn reference_folder(&self) -> PathBuf {
        self.work()
            .join(format!("reference-{}", self.reference_error))
    }

    /// The render track's reference: everything simulated, sampled to the reference's error.
    fn converged_picture(&self) -> anyhow::Result<Reference> {
        let folder = self.reference_folder();
        let done = folder.join("done.json");
        if !done.is_file() {
            let set = settings(&[
                ("scene.effects.mode", "all"),
                ("composite.target_error", &self.reference_error.to_string()),
                ("composite.max_samples", "4194304"),
            ]);
            let ran = self.composite(&folder, &set)?;
            write_json(&done, &ran.json)?;
        }
        load(&folder.join("composite/composite.exr"))
    }

    /// The scene under its known light, made in `folder` with the reference's seed.
    fn composite(&self, folder: &Path, set: &[(String, String)]) -> anyhow::Result<Ran> {
        let lit = &self.scene.lit;
        self.stage(&SCENE, lit, folder, REFERENCE_SEED, set)?;
        self.stage(&COMPOSITE, lit, folder, REFERENCE_SEED, set)
    }

    /// Where the scene stage says which effects the scene can show.
    fn planned_folder(&self) -> PathBuf {
        self.work().join("planned")
    }

    /// Names of the effects that the scene can show, asked of the scene stage unless they are known.
    pub fn effects_on(&self) -> anyhow::Result<Vec<String>> {
        let folder = self.planned_folder();
        if !folder.join(EFFECTS).is_file() {
            self.stage(&SCENE, &self.scene.lit, &folder, 0, &[])?;
        }
        self.known_effects()
    }

    /// The same as far as they are known: none of a scene of which nothing is measured.
    pub fn known_effects(&self) -> anyhow::Result<Vec<String>> {
        let path = self.planned_folder().join(EFFECTS);
        if !path.is_file() {
            return Ok(Vec::new());
        }
        let plan: EffectsPlan = read_json(&path)?;
        let on = plan.effects.iter().filter(|e| e.enabled);
        let names = on.map(|e| e.name.name().to_owned());
        Ok(names.filter(|n| n != "occluders").collect())
    }

    /// The picture that light is recovered from, made under the known light.
    fn true_picture(&self, recover: &Path) -> anyhow::Result<Reference> {
        let folder = self.work().join("truth");
        let picture = folder.join("composite/composite.exr");
        let beside = recover.with_file_name("truth.exr");
        if !beside.is_file() {
            let set = settings(&[("composite.target_error", PICTURE_ERROR)]);
            self.composite(&folder, &set)?;
            fs::copy(&picture, &beside)
                .with_context(|| format!("cannot write {}", beside.display()))?;
        }
        load(&beside)
    }

    /// Measures `variant` with the seeds below `repeats`, or reads what was measured; `None` for the
    /// light of a scene whose light is not known.
    pub fn measure(&self, variant: &Variant, repeats: u64) -> anyhow::Result<Option<Point>> {
        if variant.part == Part::Light && self.scene.recover.is_none() {
            return Ok(None);
        }
        let mut reference = None;
        let mut samples = Vec::new();
        for seed in 0..repeats {
            let file = self.sample_file(variant, seed);
            if !file.is_file() {
                let reference = match &mut reference {
                    Some(reference) => reference,
                    none => none.insert(self.reference(variant.part)?),
                };
                write_json(&file, &self.sample(variant, seed, reference)?)?;
            }
            samples.push(read_json(&file)?);
        }
        Ok(Some(Point::new(&self.scene.name, variant, samples)))
    }

    /// What a track is compared with.
    fn reference(&self, part: Part) -> anyhow::Result<Reference> {
        match (part, &self.scene.recover) {
            (Part::Light, Some(recover)) => self.true_picture(recover),
            _ => self.converged_picture(),
        }
    }

    fn sample(
        &self,
        variant: &Variant,
        seed: u64,
        reference: &Reference,
    ) -> anyhow::Result<Sample> {
        match (variant.part, &self.scene.recover) {
            (Part::Light, Some(recover)) => self.light(recover, variant, seed, reference),
            _ => self.render(variant, seed, reference),
        }
    }

    /// About how long it takes to measure what is not measured of `variant`; with `with_reference` the render track's
    /// reference, too, if it is not there.
    pub fn cost(&self, variant: &Variant, repeats: u64, with_reference: bool) -> f64 {
        let is_open = |seed: &u64| !self.sample_file(variant, *seed).is_file();
        let open = (0..repeats).filter(is_open).count();
        if open == 0 || (variant.part == Part::Light && self.scene.recover.is_none()) {
            return 0.0;
        }
        let is_made = self.reference_folder().join("done.json").is_file();
        let reference = match with_reference && variant.part == Part::Render && !is_made {
            true => render_cost(self.reference_error),
            false => 0.0,
        };
        open as f64 * variant.cost() + reference
    }

    /// What is already measured of `variant`.
    pub fn measured(&self, variant: &Variant) -> anyhow::Result<Vec<Sample>> {
        (0..)
            .map(|seed| self.sample_file(variant, seed))
            .take_while(|file| file.is_file())
            .map(|file| read_json(&file))
            .collect()
    }

    fn sample_file(&self, variant: &Variant, seed: u64) -> PathBuf {
        let name = format!("{}-{seed}.json", key(&beyond_standard(&variant.set)));
        let folder = self.out.join("points").join(folder_name(self.scene));
        folder
            .join(track_folder(variant.part, self.reference_error))
            .join(name)
    }

    fn render(
        &self,
        variant: &Variant,
        seed: u64,
        reference: &Reference,
    ) -> anyhow::Result<Sample> {
        // Runs that differ in [composite] alone share what dipir-scene made.
        let concerns_scene = |key: &str| !key.starts_with("composite.");
        let set_up: Vec<_> = variant
            .set
            .iter()
            .filter(|(k, _)| concerns_scene(k))
            .cloned()
            .collect();
        let folder = self.work().join(format!("{}-{seed}", key(&set_up)));
        let kept = folder.join("cost.json");
        if !kept.is_file() {
            let ran = self.stage(&SCENE, &self.scene.lit, &folder, seed, &set_up)?;
            write_json(
                &kept,
                &[ran.cpu_s.unwrap_or(ran.wall_s), ran.wall_s, rss(&ran.json)],
            )?;
        }
        let [scene_cost, scene_wall, scene_rss]: [f64; 3] = read_json(&kept)?;
        let ran = self.stage(&COMPOSITE, &self.scene.lit, &folder, seed, &variant.set)?;
        let found = DisplayedComposite::read(&folder.join("composite/composite.exr"))?;
        let _ = fs::remove_dir_all(folder.join(COMPOSITE.name));
        Ok(Sample {
            seed,
            error: reference.error_of(&found.picture),
            stated_error: ran.json["estimated_error"].as_f64(),
            cost_s: scene_cost + ran.cpu_s.unwrap_or(ran.wall_s),
            wall_s: scene_wall + ran.wall_s,
            peak_rss_bytes: rss(&ran.json).max(scene_rss) as u64,
        })
    }

    fn light(
        &self,
        recover: &Path,
        variant: &Variant,
        seed: u64,
        reference: &Reference,
    ) -> anyhow::Result<Sample> {
        // A record too small to use: dipir-light makes its own, so that its cost is that of recording
        // and optimising, without planning.
        let folder = self.work().join(format!("recover-{seed}"));
        if !folder.join("scene/stage.json").is_file() {
            let tiny = settings(&[
                ("light.samples", "1"),
                ("light.size", "8"),
                ("light.environment", "[8, 4]"),
            ]);
            self.stage(&SCENE, recover, &folder, seed, &tiny)?;
        }
        let ran = self.stage(&LIGHT, recover, &folder, seed, &variant.set)?;
        let picture = settings(&[("composite.target_error", PICTURE_ERROR)]);
        self.stage(&COMPOSITE, recover, &folder, seed, &picture)?;
        let found = DisplayedComposite::read(&folder.join("composite/composite.exr"))?;
        Ok(Sample {
            seed,
            error: reference.error_of(&found.picture),
            stated_error: ran.json["rmse"].as_f64(),
            cost_s: ran.cpu_s.unwrap_or(ran.wall_s),
            wall_s: ran.wall_s,
            peak_rss_bytes: rss(&ran.json) as u64,
        })
    }
}

fn load(exr: &Path) -> anyhow::Result<Reference> {
    let composite = DisplayedComposite::read(exr)?;
    Ok(Reference {
        touched: composite.touched().any,
        picture: composite.picture,
    })
}

/// Keys and values.
fn settings(set: &[(&str, &str)]) -> Vec<(String, String)> {
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

/// Where what belongs to a scene is kept. Projects of the user's may lie in folders of the same name, and are edited: theirs
/// has a hash of their place and one of their content.
fn folder_name(scene: &MeasuredScene) -> String {
    let keep = |c: char| if c.is_ascii_alphanumeric() { c } else { '-' };
    let plain = |name: &str| name.chars().map(keep).collect::<String>();
    if scene.recover.is_some() {
        return plain(&scene.name);
    }
    let place = scene.lit.canonicalize();
    let place = place.unwrap_or_else(|_| scene.lit.clone());
    let hash = blake3::hash(place.as_os_str().as_encoded_bytes()).to_hex();
    let (name, digest) = (plain(&folder_of(&scene.lit)), &scene.digest);
    format!("{name}-{}-{digest}", &hash[..8])
}

/// Where the points of a track are kept: errors of renders are known beside one reference alone.
fn track_folder(part: Part, reference_error: f64) -> String {
    match part {
        Part::Render => format!("{}-{reference_error}", part.name()),
        Part::Light => part.name().to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use dipir_imaging::file::write_png;
    use dipir_imaging::raster::Raster;

    use super::*;
    use crate::scenes::projects;

    #[test]
    fn projects_in_folders_of_the_same_name_are_kept_apart() {
        let folder = tempfile::tempdir().unwrap();
        let files = ["a/photo/pipeline.toml", "b/photo/pipeline.toml"].map(|p| {
            let path = folder.path().join(p);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, "").unwrap();
            path
        });
        let [first, second] = files.clone().map(|f| projects(&[f]).remove(0));
        assert_eq!(
            (first.name.as_str(), second.name.as_str()),
            ("photo", "photo")
        );
        assert_ne!(folder_name(&first), folder_name(&second));
        // Beside one another, tables tell them apart, too.
        let both = projects(&files);
        assert_ne!(both[0].name, both[1].name);
        assert_eq!(both[0].name, files[0].display().to_string());
        // What was measured of one alone is found again.
        assert_eq!(folder_name(&both[0]), folder_name(&first));
    }

    #[test]
    fn a_project_that_was_edited_is_measured_again() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pipeline.toml");
        let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
        let kept = || folder_name(&projects(std::slice::from_ref(&file))[0]);
        write("car.obj", "v 0 0 0");
        write("pipeline.toml", "objects = [{ path = \"car.obj\" }]");
        let first = kept();
        assert_eq!(kept(), first);
        write("car.obj", "v 0 0 1");
        let other_object = kept();
        assert_ne!(other_object, first);
        write(
            "pipeline.toml",
            "objects = [{ path = 'car.obj', yaw_deg = 3 }]",
        );
        assert!(![first, other_object].contains(&kept()));
    }

    #[test]
    fn a_project_whose_object_has_other_materials_or_textures_is_measured_again() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pipeline.toml");
        let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
        let kept = || folder_name(&projects(std::slice::from_ref(&file))[0]);
        let object = "mtllib car.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
        write("car.obj", object);
        write("car.mtl", "newmtl m\nKd 0.5 0.5 0.5\nmap_Kd car.png\n");
        let picture = |value: f32| {
            let grey = DisplayImage(Raster::filled(2, 2, glam::Vec3::splat(value)));
            write_png(folder.path().join("car.png"), &grey).unwrap();
        };
        picture(0.5);
        write("pipeline.toml", "objects = [{ path = \"car.obj\" }]");
        let first = kept();
        assert_eq!(kept(), first);
        picture(1.0);
        let other_texture = kept();
        assert_ne!(other_texture, first);
        write("car.mtl", "newmtl m\nKd 0.9 0.5 0.5\nmap_Kd car.png\n");
        assert!(![first, other_texture].contains(&kept()));
    }

    #[test]
    fn points_beside_another_reference_are_measured_again() {
        let of = |part| [2e-4, 1e-3].map(|error| track_folder(part, error));
        let [fine, coarse] = of(Part::Render);
        assert_ne!(fine, coarse);
        let [fine, coarse] = of(Part::Light);
        assert_eq!(fine, coarse);
    }
}
