//! The concepts stage: images of the object's class, made by the un-adapted model.
pub mod folder;
pub mod table;

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use anyhow::Context;
use candle_core::{DType, Device, Tensor};
use dipir_cli::interrupt;
use dipir_cli::output::json_path;
use dipir_cli::session::Session;
use dipir_diffusion::concepts::{Concept, class_prompt, concept};
use dipir_diffusion::generate::{GenerateSettings, generate};
use dipir_diffusion::model::Model;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::sampler::Solver;
use dipir_diffusion::weights::write_safetensors;
use dipir_imaging::file::write_png;
use dipir_pipeline::error::StageError;
use dipir_pipeline::fingerprint::Fingerprint;
use dipir_pipeline::manifest::{Manifest, hash_file};
use dipir_pipeline::mark::Kind;
use dipir_pipeline::resume::Resume;
use dipir_pipeline::stage::StagePlan;
use dipir_scene::config::SceneConfig;
use serde_json::{Value, json};

use crate::model::{self, ModelTable};
use crate::names::{CONCEPTS, begin};
use crate::written;
use folder::{ConceptEntry, ConceptList, read_latents};
use table::ConceptsTable;

/// The files of an image in the cache, and what tensors are called while they are written.
const CACHED: [&str; 4] = ["#.png", "#.safetensors", "#.blake3", "#.partial"];

/// What the stage did.
pub struct Done {
    folder: PathBuf,
    manifest: Manifest,
    made: usize,
    reused: usize,
}

/// What a run would be, from the configuration.
pub fn plan(session: &Session) -> anyhow::Result<StagePlan> {
    let table: ConceptsTable = session.config.table("concepts")?;
    let model_table: ModelTable = session.config.table("model")?;
    table.check(&session.config)?;
    let without_cache = ConceptsTable {
        cache: None,
        ..table
    };
    let params = json!({
        "concepts": without_cache, "class": class(session)?, "precision": model_table.precision,
    });
    let mut plan = CONCEPTS.plan(session, params);
    plan.device = session.pipeline.device.clone();
    model::inputs(session, &model_table, &mut plan)?;
    Ok(plan)
}

fn class(session: &Session) -> anyhow::Result<String> {
    let scene: SceneConfig = session.config.table("scene")?;
    Ok(scene.class.unwrap_or_else(|| "object".into()))
}

/// Runs the stage.
pub fn run(session: &Session) -> anyhow::Result<Done> {
    let table: ConceptsTable = session.config.table("concepts")?;
    let model_table: ModelTable = session.config.table("model")?;
    let class = class(session)?;
    let plan = plan(session)?;
    let cache = cache_folder(session, &table, &plan, &class)?;
    let folder = CONCEPTS.folder(session);
    let mut writer = begin(session, plan)?;
    let model = model::load(session, &model_table)?;
    model::check_steps(session, &model, "concepts.steps", table.steps)?;
    let side = side(session, &table, &model)?;
    model::warn_of_sampler(session, &model);

    let mut list = ConceptList {
        class_prompt: class_prompt(&class),
        class,
        concepts: vec![],
    };
    let (mut latents, mut made) = (vec![], 0);
    let progress = session.progress("concepts");
    for index in 0..table.count {
        interrupt::check()?;
        let concept = concept(&list.class, index, session.pipeline.seed);
        let stem = format!("{index:04}");
        let image = CachedImage::new(&cache, &stem);
        if !image.is_whole() {
            let settings = GenerateSettings {
                solver: Solver::DpmSolver2M,
                steps: table.steps,
                guidance: table.guidance,
                size: (side, side),
                seed: concept.seed,
            };
            let share = |part: f64| (index as f64 + part) / table.count as f64;
            image.make(&model, &concept, &settings, |part| {
                progress.set(share(part))
            })?;
            made += 1;
        }
        let png = cache.file(&image.png);
        latents.push(read_latents(&cache.file(&image.tensor))?);
        let name = PathBuf::from(format!("images/{stem}.png"));
        let target = writer.output("image", &name)?;
        std::fs::copy(&png, &target).with_context(|| format!("cannot copy {}", png.display()))?;
        list.concepts.push(ConceptEntry {
            image: name,
            concept,
        });
    }
    progress.done();
    if !latents.is_empty() {
        let path = writer.output("latents", "latents.safetensors")?;
        let all = BTreeMap::from([("latents".to_owned(), Tensor::cat(&latents, 0)?)]);
        write_safetensors(&path, &all, &BTreeMap::new())?;
    }
    writer.write_json("concepts", "concepts.json", &list)?;
    let manifest = writer.finish()?;
    Ok(Done {
        folder,
        manifest,
        made,
        reused: table.count - made,
    })
}

/// The side of the images; refused where the model's latents cannot make it.
fn side(session: &Session, table: &ConceptsTable, model: &Model) -> anyhow::Result<usize> {
    let multiple = model.vae.downscale();
    match table.size {
        None => Ok(model.native_size()),
        Some(size) if size.is_multiple_of(multiple) => Ok(size),
        Some(size) => {
            let accepted = format!(
                "multiples of {multiple}, the pixels that a latent one of the model stands for"
            );
            Err(session
                .config
                .out_of_range("concepts.size", size, &accepted)
                .into())
        }
    }
}

/// The cache of this class, model and settings: named by what decides an image, not by how many
/// there are.
fn cache_folder(
    session: &Session,
    table: &ConceptsTable,
    plan: &StagePlan,
    class: &str,
) -> anyhow::Result<Resume> {
    let root = match &table.cache {
        Some(path) => session.resolve(path),
        None => session.out.join("concepts-cache"),
    };
    // How many images there are does not show in any of them.
    let params = json!({
        "class": class, "steps": table.steps, "guidance": table.guidance, "size": table.size,
        "precision": plan.params["precision"], "prediction": plan.params["prediction"],
    });
    let fingerprint = Fingerprint::of_plan(plan).params(params).finish();
    Ok(Resume::open(
        &root,
        Kind::Cache,
        CONCEPTS.name,
        &fingerprint,
        &CACHED,
    )?)
}

/// An image in the cache: the names of its files.
struct CachedImage<'a> {
    cache: &'a Resume,
    png: String,
    tensor: String,
    /// The hashes of both.
    seal: String,
}

impl<'a> CachedImage<'a> {
    fn new(cache: &'a Resume, stem: &str) -> Self {
        Self {
            cache,
            png: format!("{stem}.png"),
            tensor: format!("{stem}.safetensors"),
            seal: format!("{stem}.blake3"),
        }
    }

    /// Whether both files are there with the hashes that were noted when they were made.
    fn is_whole(&self) -> bool {
        let noted = std::fs::read_to_string(self.cache.file(&self.seal)).ok();
        noted.is_some() && noted == self.hashes().ok()
    }

    fn hashes(&self) -> Result<String, StageError> {
        let hash = |name: &String| hash_file(&self.cache.file(name)).map(|(_, hash)| hash);
        Ok(format!("{}\n{}\n", hash(&self.png)?, hash(&self.tensor)?))
    }

    /// Makes both files, then notes their hashes, which say that they are whole.
    fn make(
        &self,
        model: &Model,
        concept: &Concept,
        settings: &GenerateSettings,
        mut progress: impl FnMut(f64),
    ) -> anyhow::Result<()> {
        let outcome = generate(
            model,
            &concept.prompt,
            settings,
            &Pass::default(),
            None,
            |part| {
                progress(part);
                !interrupt::asked()
            },
        );
        interrupt::check()?;
        let generated = outcome?;
        self.cache.put(&self.png, |own| {
            let picture = dipir_tensors::model_output(&generated.image)?;
            Ok::<_, anyhow::Error>(write_png(own, &picture)?)
        })?;
        let latents = generated
            .latents
            .to_device(&Device::Cpu)?
            .to_dtype(DType::F32)?;
        let latents = BTreeMap::from([("latents".to_owned(), latents)]);
        self.cache.put(&self.tensor, |own| {
            Ok::<_, anyhow::Error>(write_safetensors(own, &latents, &BTreeMap::new())?)
        })?;
        let text = self.hashes()?;
        let seal = self.cache.file(&self.seal);
        self.cache.put(&self.seal, |own| {
            std::fs::write(own, text).with_context(|| format!("cannot write {}", seal.display()))
        })
    }
}

impl Done {
    /// For programs.
    pub fn to_json(&self) -> Value {
        json!({
            "folder": json_path(&self.folder), "made": self.made, "reused": self.reused,
            "elapsed_s": self.manifest.elapsed_s, "peak_rss_bytes": self.manifest.peak_rss_bytes,
        })
    }
}

impl fmt::Display for Done {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        written(f, &self.folder, &self.manifest)?;
        write!(
            f,
            "\n  {} images made, {} from the cache",
            self.made, self.reused
        )
    }
}
