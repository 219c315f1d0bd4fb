//! Methods on scenes, through the executables: what is done stays, scenes run side by side.
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::{Context, anyhow};
use dipir_cli::exit::Usage;
use dipir_cli::interrupt;
use dipir_cli::progress::Progress;
use dipir_evaluation::scores::{
    LightScores, PictureScores, Touched, compare_lights, compare_pictures,
};
use dipir_imaging::file::read_photo;
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_scene::description::SceneDescription;
use dipir_stages::children::Executables;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::bench::{Bench, SceneInfo, read_json, write_json};
use crate::cli::RunArgs;
use crate::lights;
use crate::methods::{self, Method, Source, Stage};

/// The folder of the truth among the runs; no method may be called so.
pub const TRUTH: &str = "truth";
/// Raised whenever the same run would get another score.
const VERSION: u32 = 1;
/// Seed of the true pictures: not that of the methods', whose noise is to be theirs.
const TRUTH_SEED: u64 = 1_000_003;

/// How good a method is on a scene: the content of `score.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// What decided it: scene, method, settings.
    pub key: String,
    /// The method's name.
    pub method: String,
    /// Its title.
    pub title: String,
    /// The scene.
    pub scene: String,
    /// Errors of the picture; absent for the truth.
    pub picture: Option<PictureScores>,
    /// LPIPS of the picture, if a report was asked for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    /// Errors of the light.
    pub light: Option<LightScores>,
    /// Seconds of the stages before the composite, and of the composite.
    pub seconds: Vec<(String, f64)>,
    /// Most memory of any stage, bytes.
    pub peak_rss_bytes: u64,
}

/// Everything that a worker needs.
struct Runner<'a> {
    bench: Bench,
    executables: Executables,
    args: &'a RunArgs,
    methods: Vec<(Method, Option<PathBuf>)>,
    /// Hash of the diffusion model.
    model: String,
    threads: usize,
}

/// Runs what is not done yet.
pub fn run(args: &RunArgs) -> anyhow::Result<()> {
    if !(args.target_error > 0.0 && args.target_error < 1.0) || args.jobs == 0 {
        let text = "--target-error must lie above 0 and below 1, --jobs must be at least 1";
        return Err(Usage(text.into()).into());
    }
    interrupt::listen()?;
    let bench = Bench::new(&args.folder.out);
    let scenes = bench.chosen(&args.scene)?;
    let methods = chosen_methods(args)?;
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
    let threads = if args.threads == 0 {
        cores
    } else {
        args.threads
    };
    let runner = Runner {
        bench,
        executables: Executables::beside_this()?,
        args,
        methods,
        model: dipir_stages::model::digest(args.model.as_deref())?,
        threads: (threads / args.jobs).max(1),
    };
    let total = scenes.len() * runner.methods.len();
    let progress = Progress::new("evaluate", args.folder.output.quiet);
    let (next, done) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let failures: Mutex<Vec<(String, anyhow::Error)>> = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..args.jobs.min(scenes.len()) {
            scope.spawn(|| {
                while let Some(scene) = scenes.get(next.fetch_add(1, Ordering::Relaxed)) {
                    if interrupt::asked() {
                        break;
                    }
                    let report = &|name: &str, failed: Option<anyhow::Error>| {
                        let n = done.fetch_add(1, Ordering::Relaxed) + 1;
                        progress.set(n as f64 / total as f64);
                        if args.folder.output.verbose {
                            eprintln!("{n} of {total}: {}, {name}", scene.name);
                        }
                        if let (Some(error), Ok(mut list)) = (failed, failures.lock()) {
                            list.push((format!("{}, {name}", scene.name), error));
                        }
                    };
                    runner.scene(scene, report);
                }
            });
        }
    });
    progress.done();
    interrupt::check()?;
    let failures = failures.into_inner().unwrap_or_default();
    for (what, error) in &failures {
        args.folder
            .output
            .warn(&format!("{what}: {}", dipir_cli::exit::describe(error)));
    }
    if let Some((what, error)) = failures.into_iter().next() {
        return Err(error.context(format!(
            "not every run succeeded; the first that failed is {what}"
        )));
    }
    args.folder.output.result(
        || {
            format!(
                "{} methods on {} scenes in {}; show them with dipir-evaluate report",
                runner.methods.len(),
                scenes.len(),
                runner.bench.root().join("runs").display()
            )
        },
        || json!({"scenes": scenes.len(), "methods": runner.methods.len(), "folder": runner.bench.root()}),
    );
    Ok(())
}

/// Methods with the folder of their maps, if they are imported ones.
fn chosen_methods(args: &RunArgs) -> anyhow::Result<Vec<(Method, Option<PathBuf>)>> {
    let all = methods::read(args.methods.as_deref())?;
    for name in &args.method {
        if !all.iter().any(|m| m.name == *name) {
            let names: Vec<&str> = all.iter().map(|m| m.name.as_str()).collect();
            return Err(Usage(format!("--method {name}: accepted: {}", names.join(", "))).into());
        };
    }
    let mut chosen: Vec<_> = all
        .into_iter()
        .filter(|m| args.method.is_empty() || args.method.contains(&m.name))
        .map(|m| (m, None))
        .collect();
    if !args.environment_from.is_empty() && args.method.is_empty() {
        chosen.clear();
    }
    for folder in &args.environment_from {
        chosen.push((methods::imported(folder)?, Some(folder.clone())));
    }
    if chosen.iter().any(|(m, _)| m.name == TRUTH) {
        return Err(Usage(format!("no method may be called \"{TRUTH}\"")).into());
    }
    Ok(chosen)
}

impl Runner<'_> {
    /// All methods on one scene; failures are reported and the others go on.
    fn scene(&self, scene: &SceneInfo, report: &dyn Fn(&str, Option<anyhow::Error>)) {
        let truth = match self.truth(scene) {
            Ok(truth) => truth,
            Err(e) => {
                let text = format!("{e:#}");
                for (method, _) in &self.methods {
                    report(&method.name, Some(anyhow!("{text}")));
                }
                return;
            }
        };
        for (method, maps) in &self.methods {
            let result = self.method(scene, method, maps.as_deref(), &truth);
            report(&method.name, result.err());
            if interrupt::asked() {
                return;
            }
        }
    }

    /// The picture under the true light.
    fn truth(&self, scene: &SceneInfo) -> anyhow::Result<Truth> {
        let folder = self.bench.run(TRUTH, &scene.name);
        let score_file = folder.join("score.json");
        let key = self.key(scene, &json!("truth"))?;
        let map_file = self.bench.scene(&scene.name).join(&scene.map);
        if !is_done(&score_file, &key) {
            let work = self.bench.work(&scene.name, TRUTH);
            let mut run = Stages::new(self, scene, &work, TRUTH_SEED);
            run.set("composite.environment", &quoted(&map_file)?);
            run.set("composite.exposure_ev", &scene.exposure_ev.to_string());
            run.set("composite.tone", scene.tone.name());
            run.set(
                "composite.target_error",
                &(0.5 * self.args.target_error).to_string(),
            );
            run.stage("dipir-scene")?;
            run.stage("dipir-composite")?;
            run.keep(&folder)?;
            let score = Score {
                key,
                method: TRUTH.into(),
                title: "Truth".into(),
                scene: scene.name.clone(),
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

    fn method(
        &self,
        scene: &SceneInfo,
        method: &Method,
        maps: Option<&Path>,
        truth: &Truth,
    ) -> anyhow::Result<()> {
        let folder = self.bench.run(&method.name, &scene.name);
        let score_file = folder.join("score.json");
        let imported = maps.map(|f| map_in(f, &scene.name)).transpose()?;
        let decides = json!({
            "method": method, "model": method.model.then_some(&self.model),
            "map": imported.as_deref().map(hash).transpose()?,
        });
        let key = self.key(scene, &decides)?;
        if is_done(&score_file, &key) {
            return Ok(());
        }
        // Methods that differ in [light] and [composite] alone share what runs before.
        let shared: Vec<&String> = method
            .set
            .iter()
            .filter(|s| !s.starts_with("optimize.") && !s.starts_with("composite."))
            .collect();
        let shared = json!([
            key_of_light(method),
            shared,
            method.stages.len() > 2,
            self.args.set,
            method.model.then_some(&self.model)
        ]);
        let shared = self.key(scene, &shared)?;
        let work = self.bench.work(&scene.name, &shared[..16]);
        let mut run = Stages::new(self, scene, &work, 0);
        run.set(
            "composite.target_error",
            &self.args.target_error.to_string(),
        );
        for pair in method.set.iter().chain(&self.args.set) {
            run.set.push(pair.clone());
        }
        if let (true, Some(model)) = (method.model, &self.args.model) {
            let model = model
                .canonicalize()
                .with_context(|| format!("there is no model in {}", model.display()))?;
            run.set("model.path", &quoted(&model)?);
        }
        let given = match method.light {
            Source::Recovered => None,
            _ => Some(self.map(scene, method, imported.as_deref(), &truth.map)?),
        };
        if let Some(map) = &given {
            let file = work.join("given.exr");
            fs::create_dir_all(&work)
                .with_context(|| format!("cannot create {}", work.display()))?;
            map.write(&file)?;
            run.set("composite.environment", &quoted(&file)?);
            run.set("composite.tone", scene.tone.name());
        }
        for stage in &method.stages {
            // The light is the method's own; what comes before may be there already.
            let there = work.join(stage.folder()).join("stage.json").is_file();
            if *stage == Stage::Light || !there {
                run.stage(stage.executable())?;
            }
        }
        run.stage("dipir-composite")?;
        run.keep(&folder)?;
        let light = match &given {
            Some(map) => map.clone(),
            None => EnvironmentMap::read(folder.join("light/environment.exr"))?,
        };
        let found = Shown::read(&folder.join("composite/composite.exr"))?;
        let score = Score {
            key,
            method: method.name.clone(),
            title: method.title.clone(),
            scene: scene.name.clone(),
            picture: Some(compare_pictures(
                &found.picture,
                &truth.picture,
                &truth.touched,
            )),
            lpips: None,
            light: Some(compare_lights(&light, &truth.map)),
            seconds: run.seconds,
            peak_rss_bytes: run.peak_rss_bytes,
        };
        write_json(&score_file, &score)
    }

    /// The map of a method that recovers nothing, on the photograph's scale.
    fn map(
        &self,
        scene: &SceneInfo,
        method: &Method,
        imported: Option<&Path>,
        truth: &EnvironmentMap,
    ) -> anyhow::Result<EnvironmentMap> {
        let folder = self.bench.scene(&scene.name);
        let photo = || read_photo(folder.join("photo.png"), Transfer::Srgb);
        Ok(match (&method.light, imported) {
            (Source::Imported, Some(file)) => EnvironmentMap::read(file)?,
            (Source::Projected, _) => {
                let described = self.bench.run(TRUTH, &scene.name).join("scene.json");
                let camera = SceneDescription::read(&described)?.camera;
                lights::projected(&photo()?.image, scene.tone, &camera)?
            }
            (Source::Fitted, _) => lights::fitted(truth),
            (Source::Truth, _) => truth.clone(),
            _ => lights::neutral(&photo()?.image, scene.tone),
        })
    }

    /// What decides a run: the scene's files, the program, the settings, and `more`.
    fn key(&self, scene: &SceneInfo, more: &Value) -> anyhow::Result<String> {
        let folder = self.bench.scene(&scene.name);
        let mut hasher = blake3::Hasher::new();
        for file in ["pipeline.toml", "photo.png"] {
            hasher.update(hash(&folder.join(file))?.as_bytes());
        }
        hasher.update(hash(&folder.join(&scene.map))?.as_bytes());
        for object in objects(&folder.join("pipeline.toml"))? {
            hasher.update(hash(&object)?.as_bytes());
        }
        let decides = json!([
            VERSION,
            env!("CARGO_PKG_VERSION"),
            scene,
            more,
            self.args.set,
            self.args.target_error,
            dipir_stages::names::ALL.map(|s| s.version),
        ]);
        hasher.update(decides.to_string().as_bytes());
        Ok(hasher.finalize().to_hex().to_string())
    }
}

/// Methods under a given light plan their effects under it: no two share a scene.
fn key_of_light(method: &Method) -> &str {
    match method.light {
        Source::Recovered => "recovered",
        _ => &method.name,
    }
}

fn is_done(score_file: &Path, key: &str) -> bool {
    score_file.is_file() && read_json::<Score>(score_file).is_ok_and(|s| s.key == key)
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

fn hash(path: &Path) -> anyhow::Result<String> {
    let bytes = fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    Ok(blake3::hash(&bytes).to_hex().to_string())
}

/// An absolute path as a TOML string: relative ones would start from the scene's folder.
fn quoted(path: &Path) -> anyhow::Result<String> {
    let absolute =
        std::path::absolute(path).with_context(|| format!("cannot find {}", path.display()))?;
    let text = absolute
        .to_string_lossy()
        .replace('\\', "\\\\")
        .replace('"', "\\\"");
    Ok(format!("\"{text}\""))
}

/// The files of the objects that `pipeline` names.
fn objects(pipeline: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let text = fs::read_to_string(pipeline)
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

/// One run of stages in one folder.
struct Stages<'a> {
    runner: &'a Runner<'a>,
    pipeline: PathBuf,
    work: PathBuf,
    seed: u64,
    set: Vec<String>,
    seconds: Vec<(String, f64)>,
    peak_rss_bytes: u64,
}

impl<'a> Stages<'a> {
    fn new(runner: &'a Runner<'a>, scene: &SceneInfo, work: &Path, seed: u64) -> Self {
        Self {
            runner,
            pipeline: runner.bench.scene(&scene.name).join("pipeline.toml"),
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

    fn stage(&mut self, executable: &str) -> anyhow::Result<()> {
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
        let ran = self.runner.executables.run(executable, &arguments)?;
        self.seconds.push((executable.into(), ran.wall_s));
        let rss = ran.json["peak_rss_bytes"].as_u64().unwrap_or(0);
        self.peak_rss_bytes = self.peak_rss_bytes.max(rss);
        Ok(())
    }

    /// Moves what is worth keeping to `folder`, whatever was there before.
    fn keep(&self, folder: &Path) -> anyhow::Result<()> {
        let failed = || format!("cannot write {}", folder.display());
        if folder.is_dir() {
            fs::remove_dir_all(folder).with_context(failed)?;
        }
        fs::create_dir_all(folder).with_context(failed)?;
        let described = self.work.join("scene/scene.json");
        fs::copy(described, folder.join("scene.json")).with_context(failed)?;
        for stage in ["light", "composite"] {
            let from = self.work.join(stage);
            if from.is_dir() {
                fs::rename(&from, folder.join(stage)).with_context(failed)?;
            }
        }
        Ok(())
    }
}

/// A picture as it is displayed.
pub struct Shown {
    /// The composite.
    pub picture: DisplayImage,
    photo: DisplayImage,
    coverage: Raster<f32>,
}

impl Shown {
    /// Reads the layers of a composite.
    pub fn read(exr: &Path) -> anyhow::Result<Self> {
        let layers = Layers::read_exr(exr)?;
        let shown = |name: &str| anyhow::Ok(Transfer::Srgb.encode(&LinearImage(layers.rgb(name)?)));
        Ok(Self {
            picture: shown("")?,
            photo: shown("background")?,
            coverage: layers.channel("object.A")?.clone(),
        })
    }
}

struct Truth {
    picture: DisplayImage,
    touched: Touched,
    /// On the photograph's scale.
    map: EnvironmentMap,
}

impl Truth {
    fn read(exr: &Path, map: &Path, exposure_ev: f64) -> anyhow::Result<Self> {
        let shown = Shown::read(exr)?;
        Ok(Self {
            touched: Touched::new(&shown.coverage, &shown.picture, &shown.photo),
            picture: shown.picture,
            map: EnvironmentMap::read(map)?.scaled(exposure_ev.exp2() as f32),
        })
    }
}
