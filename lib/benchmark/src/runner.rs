//! One method on one scene, through the executables.
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use dipir_cli::executables::Executables;
use dipir_cli::interrupt;
use dipir_evaluation::results::write_json;
use dipir_evaluation::scores::{DisplayedComposite, compare_lights, compare_pictures};
use dipir_imaging::file::read_photo;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_pipeline::fingerprint::Fingerprint;
use dipir_pipeline::manifest::{Artifact, FILE_NAME};
use dipir_pipeline::mark::Owned;
use dipir_pipeline::stage::StagePlan;
use dipir_scene::description::SceneDescription;
use dipir_stages::names::{self, StageName};
use serde_json::{Value, json};

use crate::chosen::Chosen;
use crate::command_line::RunArgs;
use crate::definition::{Definition, UsedModel};
use crate::folder::{EvaluationFolder, SceneInfo, TRUTH, objects};
use crate::lights;
use crate::methods::{BEFORE_COMPOSITE, MODEL_PATH, Method, Source};
use crate::parts::Parts;
use crate::score::{Score, Truth};

/// Raised whenever the same run would get another score.
const VERSION: u32 = 2;
/// Seed of the true pictures. The methods' seed is another one, so that they share no noise.
const TRUTH_SEED: u64 = 1_000_003;

/// What every run needs.
pub struct Runner<'a> {
    /// Where scenes and results are.
    pub evaluation: EvaluationFolder,
    /// What runs.
    pub executables: Executables,
    /// What was asked for.
    pub args: &'a RunArgs,
    /// Methods with their models.
    pub methods: Vec<Chosen>,
    /// Worker threads of each executable.
    pub threads: usize,
    /// The other files of objects.
    pub parts: Parts,
}

impl Runner<'_> {
    /// All methods on one scene; failures are reported and the others go on.
    pub fn scene(&self, scene: &SceneInfo, report: &dyn Fn(&str, Option<anyhow::Error>)) {
        let truth = match self.truth(scene) {
            Ok(truth) => truth,
            Err(e) => {
                let text = format!("{e:#}");
                for chosen in &self.methods {
                    report(&chosen.method.name, Some(anyhow!("{text}")));
                }
                return;
            }
        };
        for chosen in &self.methods {
            let result = self.method(scene, chosen, &truth);
            report(&chosen.method.name, result.err());
            if interrupt::asked() {
                return;
            }
        }
    }

    /// The picture under the true light.
    fn truth(&self, scene: &SceneInfo) -> anyhow::Result<Truth> {
        let folder = self.evaluation.run(TRUTH, &scene.name);
        let score_file = folder.join("score.json");
        let key = self.fingerprint(scene, json!(TRUTH), &[], None)?;
        let map_file = self.evaluation.scene(&scene.name).join(&scene.map);
        if !Score::is_done(&score_file, &key) {
            let work = self.evaluation.work(&scene.name, TRUTH);
            let mut run = StageRuns::new(self, scene, &work, TRUTH_SEED);
            run.set("composite.environment", &toml_string(&map_file)?);
            run.set("composite.exposure_ev", &scene.exposure_ev.to_string());
            run.set("composite.tone", scene.tone.key());
            run.set(
                "composite.target_error",
                &(0.5 * self.args.target_error).to_string(),
            );
            run.stage(&names::SCENE)?;
            run.stage(&names::COMPOSITE)?;
            run.keep(&folder)?;
            let score = Score {
                key,
                method: TRUTH.into(),
                definition: self.definition(&Method::truth(), None),
                title: "Truth".into(),
                scene: scene.name.clone(),
                scene_digest: Some(self.evaluation.digest(scene)),
                picture: None,
                lpips: None,
                light: None,
                seconds: run.seconds,
                peak_rss_bytes: run.peak_rss_bytes,
            };
            write_json(&score_file, &score)?;
        }
        Truth::read(
            &folder.join("composite/composite.exr"),
            &map_file,
            scene.exposure_ev,
        )
    }

    fn method(&self, scene: &SceneInfo, chosen: &Chosen, truth: &Truth) -> anyhow::Result<()> {
        let method = &chosen.method;
        let folder = self.evaluation.run(&method.name, &scene.name);
        let score_file = folder.join("score.json");
        let maps = chosen.maps.as_deref();
        let imported = maps.map(|f| map_in(f, &scene.name)).transpose()?;
        let params = json!({"method": method, "model": chosen.digest()});
        let key = self.fingerprint(scene, params, &method.set, imported.as_deref())?;
        if Score::is_done(&score_file, &key) {
            return Ok(());
        }
        let work = self.shared_work(scene, chosen)?;
        let mut run = StageRuns::new(self, scene, &work, 0);
        run.set = self.settings(chosen)?;
        let given = match method.light {
            Source::Recovered => None,
            _ => Some(self.map(scene, method, imported.as_deref(), &truth.map)?),
        };
        if let Some(map) = &given {
            let file = work.join("given.exr");
            fs::create_dir_all(&work)
                .with_context(|| format!("cannot create {}", work.display()))?;
            map.write(&file)?;
            run.set("composite.environment", &toml_string(&file)?);
            run.set("composite.tone", scene.tone.key());
        }
        for stage in BEFORE_COMPOSITE {
            let runs = method.stages.iter().any(|s| s == stage.name);
            // The light is the method's own; what comes before may be there already.
            let is_there = work.join(stage.name).join(FILE_NAME).is_file();
            if runs && (*stage == names::LIGHT || !is_there) {
                run.stage(stage)?;
            }
        }
        run.stage(&names::COMPOSITE)?;
        run.keep(&folder)?;
        let light = match given {
            Some(map) => map,
            None => EnvironmentMap::read(folder.join("light/environment.exr"))?,
        };
        let found = DisplayedComposite::read(&folder.join("composite/composite.exr"))?.picture;
        let score = Score {
            key,
            method: method.name.clone(),
            definition: self.definition(method, chosen.model.as_ref().map(|m| m.used.clone())),
            title: method.title.clone(),
            scene: scene.name.clone(),
            scene_digest: Some(self.evaluation.digest(scene)),
            picture: Some(compare_pictures(&found, &truth.picture, &truth.touched)),
            lpips: None,
            light: Some(compare_lights(&light, &truth.map)),
            seconds: run.seconds,
            peak_rss_bytes: run.peak_rss_bytes,
        };
        write_json(&score_file, &score)
    }

    /// Where the stages of a method work. Methods that differ in `[light]` and `[composite]` alone share
    /// what runs before.
    fn shared_work(&self, scene: &SceneInfo, chosen: &Chosen) -> anyhow::Result<PathBuf> {
        let method = &chosen.method;
        let before_light = |s: &&String| !s.starts_with("light.") && !s.starts_with("composite.");
        let params = json!({
            // Where the light is given, no transport is recorded.
            "light": match method.light {
                Source::Recovered => "recovered",
                _ => &method.name,
            },
            "set": method.set.iter().filter(before_light).collect::<Vec<_>>(),
            "is_adapted": method.stages.len() > 2,
            "model": chosen.digest(),
        });
        let key = self.fingerprint(scene, params, &method.set, None)?;
        Ok(self.evaluation.work(&scene.name, &key[..16]))
    }

    /// What the scores of a method are made with.
    fn definition(&self, row: &Method, model: Option<UsedModel>) -> Definition {
        Definition::new(row, model, &self.args.set, self.args.target_error)
    }

    /// The keys of `pipeline.toml` that the command line sets.
    pub fn common_settings(&self) -> anyhow::Result<Vec<String>> {
        let mut all = vec![format!("composite.target_error={}", self.args.target_error)];
        for set in &self.args.set {
            all.push(shared_cache(set, self.evaluation.root())?);
        }
        Ok(all)
    }

    /// Those that command line, method and model set.
    pub fn settings(&self, chosen: &Chosen) -> anyhow::Result<Vec<String>> {
        let mut all = self.common_settings()?;
        for set in &chosen.method.set {
            all.push(shared_cache(set, self.evaluation.root())?);
        }
        if let Some(file) = chosen.model.as_ref().and_then(|m| m.file.as_ref()) {
            all.push(format!("{MODEL_PATH}={}", toml_string(file)?));
        }
        Ok(all)
    }

    /// The map of a method that recovers nothing, on the photograph's scale.
    fn map(
        &self,
        scene: &SceneInfo,
        method: &Method,
        imported: Option<&Path>,
        truth: &EnvironmentMap,
    ) -> anyhow::Result<EnvironmentMap> {
        let folder = self.evaluation.scene(&scene.name);
        let photo = || read_photo(folder.join("photo.png"), Transfer::Srgb);
        Ok(match (&method.light, imported) {
            (Source::Imported, Some(file)) => EnvironmentMap::read(file)?,
            (Source::Projected, _) => {
                let described = self.evaluation.run(TRUTH, &scene.name).join("scene.json");
                let camera = SceneDescription::read(&described)?.camera;
                lights::projected(&photo()?.image, scene.tone, &camera)?
            }
            (Source::Fitted, _) => lights::fitted(truth),
            (Source::Truth, _) => truth.clone(),
            _ => lights::neutral(&photo()?.image, scene.tone),
        })
    }

    /// Hash of what decides a run: the scene's files, the settings, those of the method (`set`), the files that they name,
    /// `params`, and an imported map.
    fn fingerprint(
        &self,
        scene: &SceneInfo,
        params: Value,
        set: &[String],
        imported: Option<&Path>,
    ) -> anyhow::Result<String> {
        let folder = self.evaluation.scene(&scene.name);
        let versions = names::ALL.map(|s| (s.name, s.version));
        let params = json!({
            "scene": scene,
            "run": params,
            "set": self.args.set,
            "target_error": self.args.target_error,
            "stages": versions,
        });
        let mut plan = StagePlan::new("evaluate", VERSION, params, 0);
        let mut add = |role: &str, path: &Path| -> anyhow::Result<()> {
            plan.inputs.push(Artifact::of(role, path, path)?);
            Ok(())
        };
        add("pipeline", &folder.join("pipeline.toml"))?;
        add("photo", &folder.join("photo.png"))?;
        add("truth", &folder.join(&scene.map))?;
        for (n, object) in objects(&folder.join("pipeline.toml"))?.iter().enumerate() {
            add(&format!("object {n}"), object)?;
            for part in self.parts.of(object) {
                add(&format!("part of object {n}"), &part)?;
            }
        }
        if let Some(map) = imported {
            add("map", map)?;
        }
        for set in self.args.set.iter().chain(set) {
            for file in files_of(set, &folder) {
                add(set, &file)?;
            }
        }
        Ok(Fingerprint::of_plan(&plan).finish().as_str().to_owned())
    }
}

/// The files that a setting names from a scene's `folder`: a file, or those in a folder. A cache is what runs leave, not
/// what they begin with.
fn files_of(set: &str, folder: &Path) -> Vec<PathBuf> {
    let Some((key, value)) = set.split_once('=').filter(|(k, _)| !k.contains("cache")) else {
        return Vec::new();
    };
    let value = value.trim().trim_matches(['"', '\'']);
    if value.is_empty() || key.trim() == MODEL_PATH {
        return Vec::new();
    }
    let path = folder.join(value);
    let mut files = match path.is_file() {
        true => vec![path],
        false => fs::read_dir(path).map_or(Vec::new(), |all| {
            all.flatten()
                .map(|e| e.path())
                .filter(|p| p.is_file())
                .collect()
        }),
    };
    files.sort();
    files
}

/// `set`, where it names a cache by a relative path, with that path from the evaluation's `folder`: all scenes share it.
fn shared_cache(set: &str, folder: &Path) -> anyhow::Result<String> {
    let Some((key, value)) = set.split_once('=') else {
        return Ok(set.into());
    };
    if !["concepts.cache", "lora.cache"].contains(&key.trim()) {
        return Ok(set.into());
    }
    let cache = folder.join(value.trim().trim_matches(['"', '\'']));
    Ok(format!("{key}={}", toml_string(&cache)?))
}

/// The map of `scene` in a folder of imported ones.
fn map_in(folder: &Path, scene: &str) -> anyhow::Result<PathBuf> {
    let candidates = ["exr", "hdr"].map(|e| folder.join(format!("{scene}.{e}")));
    candidates
        .into_iter()
        .find(|f| f.is_file())
        .with_context(|| {
            format!(
                "there is no map of this scene in {}: accepted: {scene}.exr or {scene}.hdr",
                folder.display()
            )
        })
}

/// An absolute path as a TOML string: relative ones would start from the scene's folder.
pub(crate) fn toml_string(path: &Path) -> anyhow::Result<String> {
    let absolute =
        std::path::absolute(path).with_context(|| format!("cannot find {}", path.display()))?;
    let text = absolute
        .to_string_lossy()
        .replace('\\', "\\\\")
        .replace('"', "\\\"");
    Ok(format!("\"{text}\""))
}

/// Stages that run in one folder with the same settings.
struct StageRuns<'a> {
    runner: &'a Runner<'a>,
    pipeline: PathBuf,
    work: PathBuf,
    seed: u64,
    set: Vec<String>,
    seconds: Vec<(String, f64)>,
    peak_rss_bytes: u64,
}

impl<'a> StageRuns<'a> {
    fn new(runner: &'a Runner<'a>, scene: &SceneInfo, work: &Path, seed: u64) -> Self {
        Self {
            runner,
            pipeline: runner.evaluation.scene(&scene.name).join("pipeline.toml"),
            work: work.into(),
            seed,
            set: Vec::new(),
            seconds: Vec::new(),
            peak_rss_bytes: 0,
        }
    }

    fn set(&mut self, key: &str, value: &str) {
        self.set.push(format!("{key}={value}"));
    }

    fn stage(&mut self, stage: &StageName) -> anyhow::Result<()> {
        let mut arguments: Vec<String> = vec![
            "-p".into(),
            self.pipeline.to_string_lossy().into(),
            "-o".into(),
            self.work.to_string_lossy().into(),
            "--seed".into(),
            self.seed.to_string(),
            "-j".into(),
            self.runner.threads.to_string(),
        ];
        for pair in &self.set {
            arguments.extend(["--set".into(), pair.clone()]);
        }
        let ran = self.runner.executables.run(stage.executable, &arguments)?;
        self.seconds.push((stage.executable.into(), ran.wall_s));
        let rss = ran.json["peak_rss_bytes"].as_u64().unwrap_or(0);
        self.peak_rss_bytes = self.peak_rss_bytes.max(rss);
        Ok(())
    }

    /// Moves what is kept of a run to `folder`, and replaces the stages of an earlier run.
    fn keep(&self, folder: &Path) -> anyhow::Result<()> {
        let failed = || format!("cannot write {}", folder.display());
        fs::create_dir_all(folder).with_context(failed)?;
        let described = self.work.join("scene/scene.json");
        fs::copy(described, folder.join("scene.json")).with_context(failed)?;
        for stage in [names::LIGHT.name, names::COMPOSITE.name] {
            replace(&self.work.join(stage), &folder.join(stage), stage).with_context(failed)?;
        }
        Ok(())
    }
}

/// Puts the result `from` of `stage`, if it is there, in the place of an earlier one. What others put beside that stays.
fn replace(from: &Path, to: &Path, stage: &str) -> anyhow::Result<()> {
    let is_there = from.is_dir();
    match Owned::of_stage(to, stage) {
        Some(earlier) if is_there => earlier.absorb(to, from)?,
        Some(earlier) => earlier.remove(to)?,
        None => {}
    }
    if is_there {
        fs::rename(from, to)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use dipir_pipeline::lock::WhenLocked;
    use dipir_pipeline::stage::StageWriter;

    use super::*;

    #[test]
    fn what_others_put_beside_an_earlier_result_stays_with_the_new_one() {
        let root = tempfile::tempdir().unwrap();
        let (from, to) = (root.path().join("work/light"), root.path().join("light"));
        let run = |content: &str| {
            let plan = StagePlan::new("light", 1, json!({}), 0);
            let mut writer = StageWriter::begin(&from, plan, WhenLocked::Refuse).unwrap();
            fs::write(writer.output("map", "map.exr").unwrap(), content).unwrap();
            writer.finish().unwrap();
            replace(&from, &to, "light").unwrap();
        };
        run("first");
        fs::write(to.join("notes.txt"), "mine").unwrap();
        run("second");
        assert_eq!(fs::read(to.join("map.exr")).unwrap(), b"second");
        assert_eq!(fs::read(to.join("notes.txt")).unwrap(), b"mine");
        // A run without this stage.
        replace(&from, &to, "light").unwrap();
        assert!(to.join("notes.txt").exists() && !to.join("map.exr").exists());
    }

    #[test]
    fn a_relative_cache_starts_from_the_evaluation_and_nothing_else_changes() {
        let of = |set| shared_cache(set, Path::new("/evaluation")).unwrap();
        assert_eq!(
            of("concepts.cache=\"cars\""),
            "concepts.cache=\"/evaluation/cars\""
        );
        assert_eq!(of("lora.cache=loras"), "lora.cache=\"/evaluation/loras\"");
        assert_eq!(of("lora.cache=/elsewhere"), "lora.cache=\"/elsewhere\"");
        assert_eq!(of("lora.steps=3"), "lora.steps=3");
    }

    #[test]
    fn files_that_a_setting_names_count() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir(at("lora")).unwrap();
        for name in ["map.exr", "lora/b.json", "lora/a.safetensors"] {
            fs::write(at(name), "").unwrap();
        }
        for (set, files) in [
            ("light.reference=map.exr", &["map.exr"][..]),
            (
                "lora.path = \"lora\"",
                &["lora/a.safetensors", "lora/b.json"],
            ),
            ("lora.cache=lora", &[]),
            ("model.path=lora", &[]),
            ("light.guidance=sds", &[]),
            ("scene.class=\"\"", &[]),
        ] {
            let wanted: Vec<PathBuf> = files.iter().map(|f| at(f)).collect();
            assert_eq!(files_of(set, folder.path()), wanted, "{set}");
        }
    }
}
