//! What judges the picture while the light is looked for: a reference, or a diffusion model and what
//! it reads off the photograph.
use std::path::PathBuf;

use anyhow::Context;
use dipir_cli::session::Session;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_optimize::crop::bounding_box;
use dipir_optimize::settings::{GuidanceKind, LearningRates, LightTable, Settings, Start};
use dipir_prior::caption::LightDescription;
use dipir_prior::inversion::{InversionSettings, Reading};
use dipir_render::render::Renderer;
use dipir_scene::config::SceneConfig;

use crate::light::distillation::{Adapter, Distillation, DistillationSettings};
use crate::light::reading;
use crate::light::reading::Place;
use crate::light::reference_of;
use crate::model;
use crate::model::{Loaded, ModelTable};
use crate::scene::transport;

/// What judges the picture, as far as files go.
pub(crate) enum Judge {
    Reference {
        /// As the configuration names it.
        path: PathBuf,
        file: PathBuf,
    },
    Diffusion {
        table: ModelTable,
        settings: DistillationSettings,
        class: String,
        /// How light is read off the photograph, if it is.
        reads: Option<InversionSettings>,
    },
}

/// What the configuration asks for.
pub(crate) struct Asked {
    pub(crate) table: LightTable,
    pub(crate) settings: Settings,
    pub(crate) judge: Judge,
}

impl Asked {
    pub(crate) fn of(session: &Session) -> anyhow::Result<Self> {
        let table: LightTable = session.config.table("light")?;
        let mut settings = transport::settings(session, &table)?;
        let judge = match table.guidance {
            GuidanceKind::Reference => {
                let (path, file) = reference_of(session, &table)?;
                Judge::Reference { path, file }
            }
            _ => diffusion(session, &table)?,
        };
        if let Judge::Diffusion { reads: Some(_), .. } = &judge {
            refine(&table, &mut settings);
        }
        Ok(Self {
            table,
            settings,
            judge,
        })
    }
}

/// Iterations that refine a light that was read off the photograph.
const REFINEMENT: usize = 50;
/// Their learning rates beside those that find a light from a neutral start: difference of two
/// predictions pulls what the caption does not say away from where it was read (docs/prior.md).
const REFINEMENT_RATE: f64 = 0.05;

/// What `table` leaves open, for a start that is near.
fn refine(table: &LightTable, settings: &mut Settings) {
    settings.iterations = table.iterations.unwrap_or(REFINEMENT);
    if table.learning_rates == LearningRates::default() {
        settings.learning_rates = settings.learning_rates.scaled(REFINEMENT_RATE);
    }
}

/// The model that guides and how it is asked.
fn diffusion(session: &Session, table: &LightTable) -> anyhow::Result<Judge> {
    let model_table: ModelTable = session.config.table("model")?;
    let scene: SceneConfig = session.config.table("scene")?;
    let knows_light = model_table.knows_light(session);
    let reads = match &table.start {
        Start::Auto => knows_light.then(InversionSettings::default),
        Start::Neutral | Start::File(_) => None,
        Start::Read | Start::Encoder if !knows_light => {
            let message = format!(
                "\"{}\" needs a model that knows light, and {} has no {}; accepted: auto, neutral, or \
                 a lighting.json",
                String::from(table.start.clone()),
                model_table.name(),
                dipir_prior::encoder::FILE
            );
            return Err(session.config.invalid("light.start", message).into());
        }
        Start::Read => Some(InversionSettings::default()),
        Start::Encoder => Some(InversionSettings {
            draws: 0,
            ..InversionSettings::default()
        }),
    };
    Ok(Judge::Diffusion {
        settings: DistillationSettings::new(session, table, reads.is_some())?,
        class: scene.class.unwrap_or_else(|| "object".into()),
        table: model_table,
        reads,
    })
}

/// The loaded model, if a model guides.
pub(crate) struct Guide {
    model: Option<Loaded>,
    adapter: Option<Adapter>,
}

impl Guide {
    pub(crate) fn open(session: &Session, judge: &Judge) -> anyhow::Result<Self> {
        let Judge::Diffusion {
            table,
            settings,
            reads,
            ..
        } = judge
        else {
            return Ok(Self {
                model: None,
                adapter: None,
            });
        };
        let mut model = model::load(session, table)?;
        let adapter = settings
            .adapt
            .then(|| Adapter::load(session, &mut model))
            .transpose()?;
        if reads.is_some() {
            dipir_prior::text_conditioning::add_placeholders(&mut model.tokenizer);
        }
        Ok(Self {
            model: Some(model),
            adapter,
        })
    }

    /// What the model reads off the photograph, if it can.
    pub(crate) fn read(
        &self,
        session: &Session,
        judge: &Judge,
        photo: &DisplayImage,
        renderer: &Renderer,
        coverage: &Raster<f32>,
        seed: u64,
    ) -> anyhow::Result<Option<Reading>> {
        let (
            Some(model),
            Judge::Diffusion {
                reads: Some(settings),
                ..
            },
        ) = (&self.model, judge)
        else {
            return Ok(None);
        };
        let object = bounding_box(coverage).context(
            "no pixel shows the object, so nothing can be guided; move it into the picture",
        )?;
        let progress = session.progress("reading");
        let report = |share: f64| progress.set(share);
        let place = Place {
            camera: renderer.camera(),
            proxy: &renderer.scene().proxy,
            object,
        };
        let reading = reading::read_light(model, photo, &place, settings, seed, &report)?;
        progress.done();
        Ok(reading)
    }

    pub(crate) fn distillation(
        &mut self,
        settings: &DistillationSettings,
        class: &str,
        light: Option<&LightDescription>,
        photo: &DisplayImage,
        paint: &Raster<f32>,
    ) -> anyhow::Result<Distillation<'_>> {
        let model = self.model.as_ref().context("no model is loaded")?;
        let (settings, adapter) = (settings.clone(), self.adapter.as_ref());
        Distillation::new(model, settings, adapter, class, light, photo, paint)
    }
}
