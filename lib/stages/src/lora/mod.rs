//! The LoRA stage: personalises the model to the photograph, keeping the object's class.
mod base;
mod cache;
mod data;
pub mod folder;
mod history;
mod own;
mod resume;
pub(crate) mod sheet;
pub mod table;

use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use candle_core::Tensor;
use dipir_cli::exit::describe;
use dipir_cli::interrupt;
use dipir_cli::output::json_path;
use dipir_cli::session::Session;
use dipir_diffusion::generate::{GenerateSettings, generate};
use dipir_diffusion::lora::{LoraInfo, LoraStyle};
use dipir_diffusion::model::Model;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::sampler::Solver;
use dipir_diffusion::training::LoraTrainer;
use dipir_diffusion::validation::Validation;
use dipir_imaging::file::{read_photo_within, write_png};
use dipir_imaging::transfer::Transfer;
use dipir_pipeline::fingerprint::Fingerprint;
use dipir_pipeline::manifest::Manifest;
use dipir_pipeline::stage::{StagePlan, StageWriter};
use dipir_scene::config::SceneConfig;
use serde_json::{Value, json};

use self::base::base_hash;
use self::cache::Cache;
use self::data::Data;
use self::history::History;
use self::resume::Resume;
use self::sheet::Sheet;
use self::table::LoraTable;
use crate::concepts::table::ConceptsTable;
use crate::concepts::{
    self,
    folder::{ConceptsFolder, read_latents},
};
use crate::model::{self, ModelTable};
use crate::names::{CONCEPTS, LORA, begin};
use crate::upstream;
use crate::written;

/// Fixed examples of each kind. Their losses are compared with one another, so that few do.
const VALIDATED: usize = 8;
/// An adapter that moves the prediction by less than this share of its size changes nothing that can be seen: rounding the
/// weights to f16 moves it by up to as much (docs/diffusion.md).
const LEAST_CHANGE: f64 = 0.01;

/// What the stage did.
pub struct Done {
    folder: PathBuf,
    manifest: Manifest,
    history: History,
    resumed_at: usize,
    wanted: usize,
    from_cache: bool,
    /// The LoRA of `lora.path`, where none was trained.
    own: Option<own::Read>,
}

/// What a run would be, from the configuration and the concept stage's manifest.
pub fn plan(session: &Session) -> anyhow::Result<StagePlan> {
    plan_with(session, preserves_concepts(session)?)
}

/// What a run would be, but for the concepts stage's results if they are not `with_concepts`.
pub(crate) fn plan_with(session: &Session, with_concepts: bool) -> anyhow::Result<StagePlan> {
    let table: LoraTable = session.config.table("lora")?;
    let model_table: ModelTable = session.config.table("model")?;
    table.check(&session.config)?;
    if let Some(path) = &table.path {
        return own::plan(session, &table, path);
    }
    let (background, transfer) = photo_of(session)?;
    // The class is in the prompts of the sheet.
    let class = (table.sheet_steps > 0)
        .then(|| class(session))
        .transpose()?;
    let params = json!({
        "class": class, "lora": table.deciding(), "transfer": transfer, "precision": model_table.precision,
    });
    let mut plan = LORA.plan(session, params);
    plan.device = session.pipeline.device.clone();
    plan.input("background", &background, &session.resolve(&background))?;
    if with_concepts {
        let concepts = CONCEPTS.manifest(session)?;
        plan.outputs_of(&concepts, &["concepts", "latents"])?;
    }
    model::inputs(session, &model_table, &mut plan)?;
    Ok(plan)
}

/// What prompts call the object.
fn class(session: &Session) -> anyhow::Result<String> {
    let scene: SceneConfig = session.config.table("scene")?;
    Ok(scene.class.unwrap_or_else(|| "object".into()))
}

/// Why training uses no concept images.
pub(crate) fn without_concepts(session: &Session) -> anyhow::Result<Option<&'static str>> {
    let table: LoraTable = session.config.table("lora")?;
    Ok(match preserves_concepts(session)? {
        true => None,
        false if table.path.is_some() => Some("lora.path names a finished LoRA"),
        false => Some("concepts.count or lora.prior_weight is 0"),
    })
}

/// Whether training uses concept images beside the photograph.
pub fn preserves_concepts(session: &Session) -> anyhow::Result<bool> {
    let table: LoraTable = session.config.table("lora")?;
    let concepts: ConceptsTable = session.config.table("concepts")?;
    Ok(table.path.is_none() && concepts.count > 0 && table.prior_weight != 0.0)
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
    // First, for it checks the configuration.
    let plan = plan(session)?;
    if let Some(path) = &table.path {
        return own::run(session, &table, path);
    }
    if preserves_concepts(session)? {
        let now = concepts::plan(session)?;
        upstream::warn_of_other_settings(session, &CONCEPTS, "the concept images were", &now);
    }
    let cache = table.cache.as_deref();
    let cache = cache
        .map(|folder| Cache::open(session, folder, &plan))
        .transpose()?;
    let fingerprint = resumable(session, &plan, &table)?;
    let base_hash = base_hash(&plan);
    let mut writer = begin(session, plan)?;
    if let Some(cache) = &cache
        && cache.restore(&mut writer)?
    {
        return from_cache(session, writer, table.steps);
    }
    let run = train(session, &table, &fingerprint, base_hash, &mut writer)?;
    let manifest = writer.finish_and(|| run.resume.remove())?;
    let folder = LORA.folder(session);
    if let Some(cache) = &cache {
        // The stage's own result stands without it.
        if let Err(e) = cache.keep(&folder, &manifest) {
            session.warn(&format!(
                "the adapter is not kept for other scenes: {}",
                describe(&e)
            ));
        }
    }
    Ok(Done {
        folder,
        manifest,
        history: run.history,
        resumed_at: run.resumed_at,
        wanted: table.steps,
        from_cache: false,
        own: None,
    })
}

/// The run that an interrupted one is continued by.
fn resumable(
    session: &Session,
    plan: &StagePlan,
    table: &LoraTable,
) -> anyhow::Result<Fingerprint> {
    let model_table: ModelTable = session.config.table("model")?;
    let (_, transfer) = photo_of(session)?;
    let mut decides = json!({
        "lora": table.without_steps(), "transfer": transfer, "precision": model_table.precision,
    });
    if let Some(prediction) = plan.params.get("prediction") {
        decides["prediction"] = prediction.clone();
    }
    Ok(Fingerprint::of_plan(plan).params(decides).finish())
}

/// Ends a run whose results another scene has made.
fn from_cache(session: &Session, writer: StageWriter, wanted: usize) -> anyhow::Result<Done> {
    let path = writer.partial().join("training.json");
    let text = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let training: Value = serde_json::from_slice(&text)?;
    let part = |key: &str| training[key].clone();
    let history = History {
        updates: serde_json::from_value(part("history"))?,
        validation: serde_json::from_value(part("validation"))?,
    };
    Ok(Done {
        folder: LORA.folder(session),
        manifest: writer.finish()?,
        history,
        resumed_at: 0,
        wanted,
        from_cache: true,
        own: None,
    })
}

/// A training that has ended.
struct Run {
    history: History,
    resumed_at: usize,
    resume: Resume,
}

fn train(
    session: &Session,
    table: &LoraTable,
    fingerprint: &Fingerprint,
    base_hash: Option<String>,
    writer: &mut StageWriter,
) -> anyhow::Result<Run> {
    let mut model = model::load(session, &session.config.table("model")?)?;
    // Here, for the sheet comes after the training.
    model::check_steps(session, &model, "lora.sheet_steps", table.sheet_steps)?;
    let start = table
        .learn_word
        .then(|| learnable(&mut model, &table.word))
        .transpose()?;
    let data = data(session, table, &model)?;
    let training = table.training(session.pipeline.seed);
    let mut trainer = LoraTrainer::new(&model, training, start.as_ref())?;
    let resume = Resume::open(session, fingerprint)?;
    // Before anything is restored: it shows the un-adapted model.
    let progress = session.progress("the model before its training");
    let validation = Validation::new(&trainer, &data, VALIDATED, |share| {
        progress.set(share);
        !interrupt::asked()
    });
    progress.done();
    interrupt::check()?;
    let validation = validation?;
    let mut history = resume.restore(session, &mut trainer, table.steps);
    history.add(validation.start());
    let resumed_at = trainer.steps();
    if resumed_at > 0 {
        session.remark(|| format!("continuing after update {resumed_at}"));
    }
    let course = Course {
        session,
        table,
        data: &data,
        validation: &validation,
        resume: &resume,
    };
    course.follow(&mut trainer, &mut history)?;
    for step in 1..=trainer.steps() {
        if table.sample_every > 0 && step % table.sample_every == 0 {
            let kept = resume.sample(step);
            let target = writer.output("sample", format!("samples/{step:06}.png"))?;
            std::fs::copy(&kept, &target)
                .with_context(|| format!("cannot copy {}", kept.display()))?;
        }
    }
    let shown = show_change(session, table, &trainer, &data, &history, writer)?;
    write_results(
        session, table, &trainer, &data, base_hash, &history, shown, writer,
    )?;
    Ok(Run {
        history,
        resumed_at,
        resume,
    })
}

/// What the adapter is trained on: the photograph, and the images of the concepts stage.
fn data<'a>(session: &Session, table: &LoraTable, model: &'a Model) -> anyhow::Result<Data<'a>> {
    let (background, transfer) = photo_of(session)?;
    let concepts = preserves_concepts(session)?
        .then(|| ConceptsFolder::read(session))
        .transpose()?;
    let limits = session.config.table::<SceneConfig>("scene")?.limits;
    let photo = read_photo_within(session.resolve(&background), transfer, limits.photo())?;
    Ok(Data {
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
        model,
    })
}

/// The updates of a run, with what is kept and looked at on the way.
struct Course<'a> {
    session: &'a Session,
    table: &'a LoraTable,
    data: &'a Data<'a>,
    validation: &'a Validation,
    resume: &'a Resume,
}

impl Course<'_> {
    fn follow(&self, trainer: &mut LoraTrainer, history: &mut History) -> anyhow::Result<()> {
        let table = self.table;
        let progress = self.session.progress("lora");
        let budget = table.time_budget_s.unwrap_or(f64::INFINITY);
        let (mut spent_s, mut last_s) = (0.0, 0.0);
        while trainer.steps() < table.steps && (spent_s == 0.0 || spent_s + last_s <= budget) {
            if interrupt::asked() {
                self.resume.save(trainer, history)?;
                interrupt::check()?;
            }
            let (clock, recomputed) = (Instant::now(), trainer.recomputes());
            let report = trainer.step(self.data).map_err(|e| self.stopped(e))?;
            if trainer.recomputes() && !recomputed {
                self.session.warn(
                    "the GPU's memory ran out: activations are recomputed from here on, which takes \
                     longer (lora.recompute = true does so from the start)",
                );
            }
            last_s = clock.elapsed().as_secs_f64();
            spent_s += last_s;
            let of_steps = report.step as f64 / table.steps as f64;
            progress.set(of_steps.max((spent_s / budget).min(1.0)));
            progress.say(format!("loss {:.4}", report.loss));
            history.updates.push(report);
            let every = |n: usize| n > 0 && report.step % n == 0;
            if every(table.sample_every) {
                let path = self.resume.sample(report.step);
                show(self.data.model, trainer, self.data, &path)?;
            }
            if every(table.validate_every) {
                self.validate(trainer, history, |_| ())?;
            }
            if every(table.checkpoint_every) {
                self.resume.save(trainer, history)?;
            }
        }
        progress.done();
        let progress = self.session.progress("validation");
        let seen = self.validate(trainer, history, |share| progress.set(share));
        progress.done();
        seen
    }

    /// An update that failed, with the key that mends it where the gradient is not finite.
    fn stopped(&self, error: dipir_diffusion::Error) -> anyhow::Error {
        let diverged = matches!(error, dipir_diffusion::Error::Gradient { .. });
        let rate = self.table.learning_rate;
        anyhow::Error::new(error).context(match diverged {
            true => format!("fine-tuning stopped; lower lora.learning_rate, which is {rate}"),
            false => "fine-tuning stopped".into(),
        })
    }

    /// Adds the losses of the fixed examples, unless they are known. Ctrl-C keeps the updates so far.
    fn validate(
        &self,
        trainer: &LoraTrainer,
        history: &mut History,
        mut progress: impl FnMut(f64),
    ) -> anyhow::Result<()> {
        if history.is_validated(trainer.steps()) {
            return Ok(());
        }
        let row = self.validation.evaluate(trainer, |share| {
            progress(share);
            !interrupt::asked()
        });
        if interrupt::asked() {
            self.resume.save(trainer, history)?;
            interrupt::check()?;
        }
        history.add(row?);
        Ok(())
    }
}

/// Writes the sheet, and warns where the adapter changes nothing. What the sheet shows.
fn show_change(
    session: &Session,
    table: &LoraTable,
    trainer: &LoraTrainer,
    data: &Data,
    history: &History,
    writer: &mut StageWriter,
) -> anyhow::Result<Value> {
    if let Some((_, end)) = history.ends()
        && end.change < LEAST_CHANGE
    {
        session.warn(&format!(
            "the adapter moves the prediction by {:.2}% of its size, less than {:.0}%: it changes nothing that can be seen; \
             raise lora.steps or lora.learning_rate",
            100.0 * end.change,
            100.0 * LEAST_CHANGE
        ));
    }
    if table.sheet_steps == 0 {
        return Ok(Value::Null);
    }
    let [own, plain] = class_prompts(&class(session)?, &table.word);
    let sheet = Sheet {
        prompts: vec![data.prompt.clone(), own, plain],
        steps: table.sheet_steps,
        of: "what was trained".into(),
    };
    let progress = session.progress("sheet");
    let path = writer.output("sheet", "sheet.png")?;
    let learned = trainer.learned();
    let difference = sheet.write(
        data.model,
        trainer.lora(),
        learned.as_ref(),
        &path,
        |share| {
            progress.set(share);
        },
    )?;
    progress.done();
    Ok(json!({"prompts": sheet.prompts, "steps": sheet.steps, "rms_difference": difference}))
}

/// Prompts that guide the light: for the class in the photograph's light, and for the class alone.
fn class_prompts(class: &str, word: &str) -> [String; 2] {
    [
        format!("a photo of a {class} in a scene in the style of {word} rendering"),
        format!("a photo of a {class}"),
    ]
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
        steps: 20.min(model.schedule.len()),
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
    history: &History,
    sheet: Value,
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
        "instance_prompt": data.prompt, "class_prompt": data.class_prompt, "history": history.updates,
        "validation": history.validation, "sheet": sheet,
    });
    writer.write_json("training", "training.json", &training)?;
    let path = writer.output("history", "training.csv")?;
    std::fs::write(&path, history.to_csv())
        .with_context(|| format!("cannot write {}", path.display()))?;
    Ok(())
}

impl Done {
    /// For programs.
    pub fn to_json(&self) -> Value {
        let ends = self.history.ends();
        json!({
            "folder": json_path(&self.folder), "steps": self.history.updates.len(), "resumed_at": self.resumed_at,
            "from_cache": self.from_cache,
            "loss_at_start": ends.map(|e| e.0.instance_loss), "loss_at_end": ends.map(|e| e.1.instance_loss),
            "class_loss_at_start": ends.map(|e| e.0.prior_loss), "class_loss_at_end": ends.map(|e| e.1.prior_loss),
            "change": ends.map(|e| e.1.change), "own": self.own.as_ref().map(own::Read::to_json),
            "elapsed_s": self.manifest.elapsed_s, "peak_rss_bytes": self.manifest.peak_rss_bytes,
        })
    }
}

impl fmt::Display for Done {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        written(f, &self.folder, &self.manifest)?;
        if let Some(own) = &self.own {
            return write!(f, "\n  {}", own.in_words());
        }
        let updates = self.history.updates.len();
        write!(f, "\n  {updates} updates")?;
        if self.from_cache {
            write!(f, ", from the cache")?;
        } else if updates < self.wanted {
            write!(f, " of {} within lora.time_budget_s", self.wanted)?;
        }
        let Some((start, end)) = self.history.ends() else {
            return Ok(());
        };
        write!(
            f,
            "; at fixed noise the photograph's loss went from {:.4} to {:.4}",
            start.instance_loss, end.instance_loss
        )?;
        if start.prior_loss > 0.0 {
            write!(
                f,
                ", the class's from {:.4} to {:.4}",
                start.prior_loss, end.prior_loss
            )?;
        }
        write!(
            f,
            "\n  the adapter moves the prediction by {:.1}% of its size",
            100.0 * end.change
        )
    }
}

#[cfg(test)]
mod tests;
