//! How the configuration gets its light, decided from its tables alone, before any file is read.
use dipir_cli::session::Session;
use dipir_optimize::settings::{GuidanceKind, LightTable, Start};
use dipir_pipeline::config::Place;

use crate::composite::table::CompositeTable;
use crate::model::ModelTable;

/// A way to a light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Method {
    /// Another run has the light, or the materials.
    Taken,
    /// `[light] materials`: materials are recovered under a known light.
    Materials,
    /// `[composite] environment` gives the light.
    Given,
    /// Nothing guides: the light is the one from which an optimisation would start.
    Start,
    /// A reference guides.
    Reference,
    /// A diffusion model guides.
    Model {
        /// Whether with a LoRA.
        adapted: bool,
    },
}

impl Method {
    pub(crate) fn of(session: &Session) -> anyhow::Result<Self> {
        let table: LightTable = session.config.table("light")?;
        let composite: CompositeTable = session.config.table("composite")?;
        let model: ModelTable = session.config.table("model")?;
        if session.light.is_some() {
            return Ok(Self::Taken);
        }
        if !table.materials.is_empty() {
            return Ok(Self::Materials);
        }
        if composite.environment.is_some() {
            return Ok(Self::Given);
        }
        let stands = table.iterations == Some(0);
        // A start that a model reads needs the model.
        let asks_model = asks_model(&table);
        Ok(
            match table.guidance.resolved(model.path.is_some() || asks_model) {
                GuidanceKind::Reference => Self::Reference,
                GuidanceKind::None | GuidanceKind::Auto => Self::Start,
                _ if stands && !asks_model => Self::Start,
                _ => Self::Model {
                    adapted: table.adapt.unwrap_or(true) && !stands,
                },
            },
        )
    }

    /// Why no diffusion model is asked; `None` if one is.
    pub(crate) fn without_model(self) -> Option<&'static str> {
        match self {
            Self::Materials => Some("[light] materials asks no diffusion model"),
            Self::Given => Some("[composite] environment gives the light"),
            Self::Taken => Some("the light is that of the shot"),
            Self::Start => Some("no diffusion model guides ([light] guidance)"),
            Self::Reference => Some("[light] guidance = \"reference\" asks no diffusion model"),
            Self::Model { adapted: false } => {
                Some("[light] adapt = false or iterations = 0 uses the model as it is")
            }
            Self::Model { adapted: true } => None,
        }
    }

    /// Whether light transport is recorded for it.
    pub(crate) fn replays(self) -> bool {
        matches!(self, Self::Reference | Self::Model { .. })
    }
}

/// Whether the light starts nearly uniform: as asked, or because a reference tells the rest.
pub(crate) fn starts_neutral(start: &Start, method: Method) -> bool {
    match start {
        Start::Neutral => true,
        Start::Auto => method == Method::Reference,
        Start::Estimated | Start::Read | Start::Encoder | Start::File(_) => false,
    }
}

/// Keys of `[light]` that only guidance uses.
const OF_GUIDANCE: [&str; 15] = [
    "reference",
    "iterations",
    "time_budget_s",
    "timesteps",
    "prompt",
    "draws",
    "crop",
    "guidance_scale",
    "learning_rates",
    "consistency",
    "regularizer",
    "fused_after",
    "crops",
    "samples",
    "patience",
];

/// A warning that names the keys of guidance that are written though nothing guides.
///
/// # Errors
/// If `[light]`, `[composite]` or `[model]` cannot be read.
pub fn idle_guidance(session: &Session) -> anyhow::Result<Option<String>> {
    let table: LightTable = session.config.table("light")?;
    let model: ModelTable = session.config.table("model")?;
    let is_off = table.guidance.resolved(model.path.is_some()) == GuidanceKind::None;
    if Method::of(session)? != Method::Start || !is_off {
        return Ok(None);
    }
    // Those of a method that is named stand in no file of the user's.
    let is_written = |place: Place| match place {
        Place::Line { file, .. } => file == session.config.path(),
        _ => true,
    };
    let written = |key: &&&str| {
        let place = session.config.place(&format!("light.{key}"));
        place.is_some_and(is_written) && !(**key == "iterations" && table.iterations == Some(0))
    };
    let keys: Vec<String> = OF_GUIDANCE
        .iter()
        .filter(written)
        .map(|key| format!("light.{key}"))
        .collect();
    let guidance = match &keys[..] {
        [] => return Ok(None),
        _ if table.reference.is_some() => "reference",
        _ => "lds",
    };
    let change = if keys.len() == 1 { "changes" } else { "change" };
    Ok(Some(format!(
        "{} {change} nothing, for nothing guides the light: light.guidance = \"{guidance}\" switches guidance on",
        keys.join(", ")
    )))
}

/// Whether the start needs the model.
fn asks_model(table: &LightTable) -> bool {
    matches!(table.start, Start::Read | Start::Encoder)
}
