//! The LoRA stage: personalises the model to the photograph, keeping the object's class.
mod data;
pub mod folder;
mod resume;
pub mod table;

use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::Context;
use candle_core::Tensor;
use dipir_cli::interrupt;
use dipir_cli::session::Session;
use dipir_diffusion::generate::{GenerateSettings, generate};
use dipir_diffusion::lora::{LoraInfo, LoraStyle};
use dipir_diffusion::model::Model;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::sampler::Solver;
use dipir_diffusion::training::{LoraTrainer, StepReport};
use dipir_imaging::file::{read_photo_within, write_png};
use dipir_imaging::transfer::Transfer;
use dipir_pipeline::fingerprint::Fingerprint;
use dipir_pipeline::manifest::Manifest;
use dipir_pipeline::stage::{StagePlan, StageWriter};
use dipir_scene::config::SceneConfig;
use serde_json::{Value, json};

use self::data::Data;
use self::resume::Resume;
use self::table::LoraTable;
use crate::concepts::folder::{ConceptsFolder, read_latents};
use crate::concepts::table::ConceptsTable;
use crate::model::{self, ModelTable};
use crate::names::{CONCEPTS, LORA};
use crate::written;

/// What the stage did.
pub struct Done {
    folder: PathBuf,
    manifest: Manifest,
    history: Vec<StepReport>,
    resumed_at: usize,
}

/// What a run would be, from the configuration and the concept stage's manifest.
pub fn plan(session: &Session) -> anyhow::Result<StagePlan> {
    let table: LoraTable = session.config.table("lora")?;
    let model_table: ModelTable = session.config.table("model")?;
    if !(table.min_crop > 0.0 && table.min_crop <= 1.0) {
        return Err(session
            .config
            .invalid("lora.min_crop", "accepted: above 0, up to 1")
            .into());
    }
    let (background, transfer) = photo_of(session)?;
    // How often the state is kept does not show in the result.
    let table = LoraTable {
        checkpoint_every: 0,
        ..table
    };
    let params = json!({
        "lora": table, "transfer": transfer, "precision": model_table.precision,
    });
    let mut plan = LORA.plan(session, params);
    plan.device = session.pipeline.device.clone();
    plan.input("background", &background, &session.resolve(&background))?;
    if preserves_concepts(session)? {
        let concepts = CONCEPTS.manifest(session)?;
        plan.outputs_of(&concepts, &["concepts", "latents"])?;
    }
    model::inputs(session, &model_table, &mut plan)?;
    Ok(plan)
}

/// Whether training uses concept images beside the photograph.
pub fn preserves_concepts(session: &Session) -> anyhow::Result<bool> {
    let table: LoraTable = session.config.table("lora")?;
    let concepts: ConceptsTable = session.config.table("concepts")?;
    Ok(concepts.count > 0 && table.prior_weight != 0.0)
}

/// The photograph, as the configuration names it, and how it is encoded.
fn photo_of(session: &Session) -> anyhow::Result<(PathBuf, Transfer)> {
    let scene: SceneConfig = session.config.table("scene")?;
    let wrong = |key, message: &str| anyhow::Error::new(session.config.invalid(key, message));
    let transfer = match scene.transfer.as_deref() {
        None | Some("srgb") => Transfer::Srgb,
        Some("gamma22") => Transfer::Gamma22,
        Some("linear") => Transfer::Linear,
        Some(_) => return Err(wrong("scene.transfer", "accepted: srgb, gamma22, linear")),
    };
    match scene.background {
        Some(path) => Ok((path, transfer)),
        None => Err(wrong("scene.background", "is missing: name the photograph")),
    }
}

/// Runs the stage.
pub fn run(session: &Session) -> anyhow::Result<Done> {
    let table: LoraTable = session.config.table("lora")?;
    let model_table: ModelTable = session.config.table("model")?;
    let (background, transfer) = photo_of(session)?;
    let photo_file = session.resolve(&background);
    // First, for it checks the configuration.
    let plan = plan(session)?;
    let concepts = preserves_concepts(session)?
        .then(|| ConceptsFolder::read(session))
        .transpose()?;
    let base_hash = plan
        .inputs
        .iter()
        .find(|i| i.path.to_string_lossy().contains("unet/diffusion"))
        .map(|i| i.blake3.clone());
    let folder = LORA.folder(session);
    let decides = json!({
        "lora": table.without_steps(), "transfer": transfer, "precision": model_table.precision,
    });
    let fingerprint = Fingerprint::of_plan(&plan).params(decides).finish();
    let mut writer = session.begin(plan)?;

    let mut model = model::load(session, &model_table)?;
    let start = table
        .learn_word
        .then(|| learnable(&mut model, &table.word))
        .transpose()?;
    let limits = session.config.table::<SceneConfig>("scene")?.limits;
    let photo = read_photo_within(&photo_file, transfer, limits.photo())?;
    let data = Data {
        photo: dipir_tensors::model_input(&photo.transfer.encode(&photo.image))?,
        size: model.native_size(),
        min_crop: table.min_crop,
        prompt: table.instance_prompt(),
        class_prompt: concepts
            .as_ref()
            .map(|c| c.list.class_prompt.clone())
            .unwrap_or_default(),
        concepts: concepts
            .as_ref()
            .map(|c| read_latents(&c.latents))
            .transpose()?,
        model: &model,
    };
    let mut trainer = LoraTrainer::new(
        &model,
        table.training(session.pipeline.seed),
        start.as_ref(),
    )?;
    let resume = Resume::open(session, &fingerprint)?;
    let mut history = resume.restore(session, &mut trainer, table.steps);
    let resumed_at = trainer.steps();
    if resumed_at > 0 {
        session.remark(|| format!("continuing after update {resumed_at}"));
    }
    let progress = session.progress("lora");
    while trainer.steps() < table.steps {
        if interrupt::asked() {
            resume.save(&trainer, &history)?;
            interrupt::check()?;
        }
        let report = trainer.step(&data).context("fine-tuning stopped")?;
        progress.set(report.step as f64 / table.steps as f64);
        progress.say(format!("loss {:.4}", report.loss));
        history.push(report);
        if table.sample_every > 0 && report.step % table.sample_every == 0 {
            show(&model, &trainer, &data, &resume.sample(report.step))?;
        }
        if table.checkpoint_every > 0 && report.step % table.checkpoint_every == 0 {
            resume.save(&trainer, &history)?;
        }
    }
    progress.done();
    for step in 1..=table.steps {
        if table.sample_every > 0 && step % table.sample_every == 0 {
            let kept = resume.sample(step);
            let target = writer.output("sample", format!("samples/{step:06}.png"))?;
            std::fs::copy(&kept, &target)
                .with_context(|| format!("cannot copy {}", kept.display()))?;
        }
    }
    write_results(
        session,
        &table,
        &trainer,
        &data,
        base_hash,
        &history,
        &mut writer,
    )?;
    let manifest = writer.finish()?;
    resume.remove();
    Ok(Done {
        folder,
        manifest,
        history,
        resumed_at,
    })
}

/// Gives `word` a token of its own and returns the embedding that it starts from: the mean of
/// the tokens that the word had.
fn learnable(model: &mut Model, word: &str) -> anyhow::Result<Tensor> {
    let tokens = model.tokenizer.words(word)?;
    let rows = tokens
        .iter()
        .map(|&t| model.text_encoder.embedding(t))
        .collect::<Result<Vec<_>, _>>()?;
    anyhow::ensure!(
        !rows.is_empty(),
        "lora.word = \"{word}\" has no token; name a word"
    );
    let token = model.text_encoder.config().vocab_size as u32;
    model.tokenizer.add_placeholder(word, token);
    Ok(Tensor::stack(&rows, 0)?.mean(0)?)
}

/// A sample under the photograph's caption.
fn show(model: &Model, trainer: &LoraTrainer, data: &Data, path: &Path) -> anyhow::Result<()> {
    let settings = GenerateSettings {
        solver: Solver::DpmSolver2M,
        steps: 20,
        guidance: 5.0,
        size: (data.size, data.size),
        seed: 1,
    };
    let pass = Pass::with_lora(trainer.lora());
    let generated = generate(
        model,
        &data.prompt,
        &settings,
        &pass,
        trainer.learned().as_ref(),
        |_| !interrupt::asked(),
    );
    interrupt::check()?;
    // Beside its place and renamed: a sample that is there is whole.
    let partial = path.with_extension("partial.png");
    write_png(&partial, &dipir_tensors::model_output(&generated?.image)?)?;
    std::fs::rename(&partial, path).with_context(|| format!("cannot write {}", path.display()))
}

fn write_results(
    session: &Session,
    table: &LoraTable,
    trainer: &LoraTrainer,
    data: &Data,
    base_hash: Option<String>,
    history: &[StepReport],
    writer: &mut StageWriter,
) -> anyhow::Result<()> {
    let info = LoraInfo::from([
        ("instance_prompt".to_owned(), data.prompt.clone()),
        ("class_prompt".to_owned(), data.class_prompt.clone()),
        (
            "base_model_blake3".to_owned(),
            base_hash.unwrap_or_default(),
        ),
        ("steps".to_owned(), trainer.steps().to_string()),
    ]);
    trainer.lora().save(
        &writer.output("lora", "lora.safetensors")?,
        LoraStyle::Peft,
        &info,
    )?;
    trainer.lora().save(
        &writer.output("lora_kohya", "lora_kohya.safetensors")?,
        LoraStyle::Kohya,
        &info,
    )?;
    if table.learn_word {
        trainer.save_token(&writer.output("word", "word.safetensors")?, &table.word)?;
    }
    let training = json!({
        "settings": table.training(session.pipeline.seed), "word": table.word,
        "instance_prompt": data.prompt, "class_prompt": data.class_prompt, "history": history,
    });
    writer.write_json("training", "training.json", &training)?;
    Ok(())
}

impl Done {
    /// Mean loss over a tenth of the run, at its end or its start.
    fn loss(&self, at_end: bool) -> f64 {
        let n = self.history.len().div_ceil(10).max(1);
        let reports: Vec<f64> = match at_end {
            true => self.history.iter().rev().take(n).map(|r| r.loss).collect(),
            false => self.history.iter().take(n).map(|r| r.loss).collect(),
        };
        reports.iter().sum::<f64>() / reports.len().max(1) as f64
    }

    /// For programs.
    pub fn to_json(&self) -> Value {
        json!({
            "folder": self.folder, "steps": self.history.len(), "resumed_at": self.resumed_at,
            "loss_at_start": self.loss(false), "loss_at_end": self.loss(true),
            "elapsed_s": self.manifest.elapsed_s, "peak_rss_bytes": self.manifest.peak_rss_bytes,
        })
    }
}

impl fmt::Display for Done {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        written(f, &self.folder, &self.manifest)?;
        write!(
            f,
            "\n  {} updates, loss {:.4} at the start, {:.4} at the end (means of a tenth)",
            self.history.len(),
            self.loss(false),
            self.loss(true)
        )
    }
}
