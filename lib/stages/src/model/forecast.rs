//! How long the stages that ask a diffusion model will take, from measured parts of it.
use dipir_cli::session::Session;
use dipir_diffusion::bf16_products;
use dipir_diffusion::check::{Times, TimesSettings, times};
use dipir_diffusion::model::Model;
use dipir_guidance::distillation::default_crop;
use dipir_optimize::settings::{GuidanceKind, LightTable, Start};
use serde::Serialize;

use crate::concepts::table::ConceptsTable;
use crate::light::method::Method;
use crate::light::request::{Guide, Request};
use crate::lora::preserves_concepts;
use crate::lora::sheet;
use crate::lora::table::LoraTable;
use crate::model::ModelTable;
use crate::names::{CONCEPTS, LIGHT, LORA};

/// What a stage has to do with the model.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Work {
    /// The stage.
    pub stage: &'static str,
    /// In words: `32 images of 25 steps`.
    pub what: String,
    /// Seconds of it; loading the model and what asks no model come on top.
    pub seconds: f64,
    /// Keys of which each halves the time, with the value that does.
    pub halved_by: Vec<String>,
}

/// What is timed for a session: its adapter, at the size that the model was trained on.
pub fn settings(session: &Session, model: &Model) -> anyhow::Result<TimesSettings> {
    let table: LoraTable = session.config.table("lora")?;
    Ok(TimesSettings {
        side: model.unet.config().sample_size,
        training: table.training(session.pipeline.seed),
        with_prior: preserves_concepts(session)?,
    })
}

/// Times the parts of the session's model. `progress` gets the share done, and returns false to stop.
pub fn measure(
    session: &Session,
    model: &Model,
    progress: impl FnMut(f64) -> bool,
) -> anyhow::Result<Times> {
    Ok(times(model, &settings(session, model)?, progress)?)
}

/// Why nothing can be foretold of the session's configuration, if its light has to be read by a model that knows none.
pub fn hindrance(session: &Session) -> anyhow::Result<Option<String>> {
    let light: LightTable = session.config.table("light")?;
    let model: ModelTable = session.config.table("model")?;
    let reads = matches!(light.start, Start::Read | Start::Encoder);
    // With materials or a map of the light nothing is read.
    let asks = matches!(Method::of(session)?, Method::Model { .. });
    Ok((reads && asks && !model.knows_light(session)).then(|| {
        format!(
            "light.start = \"{}\" needs a model that knows light, and {} has no {}; --set light.start=auto takes any",
            String::from(light.start),
            model.name(),
            dipir_prior::encoder::FILE
        )
    }))
}

/// Whether a stage asks a model under the session's configuration.
pub fn asks_model(session: &Session) -> anyhow::Result<bool> {
    Ok(matches!(Request::of(session)?.guide, Guide::Model { .. }))
}

/// The work of each stage that asks the model under the session's configuration; none if nothing guides.
pub fn works(session: &Session, times: &Times) -> anyhow::Result<Vec<Work>> {
    let request = Request::of(session)?;
    let Guide::Model { settings, .. } = &request.guide else {
        return Ok(vec![]);
    };
    let mut works = vec![];
    if settings.adapt {
        if preserves_concepts(session)? {
            works.push(concepts(session, times)?);
        }
        works.push(lora(session, times)?);
    }
    let iterations = request.settings.iterations;
    // Ten steps of a sampler take the place of one, from the drawn timestep down: half of them on average.
    let one = match settings.guidance {
        GuidanceKind::SdEdit => times.guidance_s + 4.0 * times.sampling_step_s,
        _ => times.guidance_s,
    };
    let native = default_crop(times.size, times.on_cpu);
    let crop = settings.crop.unwrap_or(native);
    // As for the images of concepts.
    let scale = (crop as f64 / times.size as f64).powi(2);
    let seconds = (iterations * settings.draws) as f64 * one * scale;
    let budget = request.settings.time_budget_s.unwrap_or(f64::INFINITY);
    works.push(Work {
        stage: LIGHT.name,
        what: format!(
            "{iterations} iterations of {} {}, {crop} pixels",
            settings.draws,
            draws(settings.draws)
        ),
        seconds: seconds.min(budget),
        halved_by: vec![format!("light.iterations = {}", iterations.div_ceil(2))],
    });
    let table: ModelTable = session.config.table("model")?;
    if let (Some(products), true, "f32") = (
        bf16_products(),
        times.on_cpu && table.path.is_some(),
        table.precision.as_str(),
    ) {
        for work in &mut works {
            work.halved_by
                .push(format!("model.precision = \"bf16\" ({products})"));
        }
    }
    Ok(works)
}

fn draws(count: usize) -> &'static str {
    match count {
        1 => "draw of noise",
        _ => "draws of noise",
    }
}

fn concepts(session: &Session, times: &Times) -> anyhow::Result<Work> {
    let table: ConceptsTable = session.config.table("concepts")?;
    let side = table.size.unwrap_or(times.size) as f64;
    // The time of convolutions, which are most of it, goes with the pixels.
    let scale = (side / times.size as f64).powi(2);
    let image = table.steps as f64 * times.sampling_step_s + times.decode_s;
    Ok(Work {
        stage: CONCEPTS.name,
        what: format!("{} images of {} steps", table.count, table.steps),
        seconds: table.count as f64 * (image * scale + times.text_s),
        halved_by: vec![
            format!("concepts.count = {}", table.count.div_ceil(2)),
            format!("concepts.steps = {}", table.steps.div_ceil(2)),
            "concepts.cache shares images among scenes".into(),
        ],
    })
}

/// Pictures on the sheet of a finished LoRA: two prompts, each without it and with it.
const OWN_PICTURES: usize = 4;

/// What a finished LoRA takes: its check, which asks the model once, and its sheet.
fn own_lora(table: &LoraTable, times: &Times) -> Work {
    let steps = table.sheet_steps;
    // As for the images of concepts.
    let scale = (sheet::LONGEST.min(times.size) as f64 / times.size as f64).powi(2);
    let picture = (steps as f64 * times.sampling_step_s + times.decode_s) * scale + times.text_s;
    let (mut what, mut seconds) = ("check of a finished LoRA".to_owned(), times.unet_s);
    if steps > 0 {
        what += &format!(", {OWN_PICTURES} pictures of {steps} steps for its sheet");
        seconds += OWN_PICTURES as f64 * picture;
    }
    let halved = steps.div_ceil(2);
    let halved = (halved < steps).then(|| format!("lora.sheet_steps = {halved}"));
    Work {
        stage: LORA.name,
        what,
        seconds,
        halved_by: halved.into_iter().collect(),
    }
}

/// The training of a LoRA, or the check of a finished one.
fn lora(session: &Session, times: &Times) -> anyhow::Result<Work> {
    let table: LoraTable = session.config.table("lora")?;
    if table.path.is_some() {
        return Ok(own_lora(&table, times));
    }
    let updates = (table.steps * table.accumulation) as f64 * times.lora_step_s;
    let mut halved_by = vec![format!("lora.steps = {}", table.steps.div_ceil(2))];
    if table.prior_weight != 0.0 {
        halved_by.push("lora.prior_weight = 0 (without the class's images)".into());
    }
    if table.recompute.unwrap_or(times.on_cpu) {
        halved_by.push("lora.recompute = false saves a quarter for more memory".into());
    }
    halved_by.push("lora.cache shares adapters among scenes of one photograph".into());
    let what = match table.accumulation {
        1 => format!("{} updates", table.steps),
        n => format!("{} updates of {n} examples", table.steps),
    };
    Ok(Work {
        stage: LORA.name,
        what,
        seconds: updates.min(table.time_budget_s.unwrap_or(f64::INFINITY)),
        halved_by,
    })
}
