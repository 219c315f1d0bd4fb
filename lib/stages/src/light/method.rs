//! How the configuration gets its light, decided from its tables alone, before any file is read.
use dipir_cli::session::Session;
use dipir_optimize::settings::{GuidanceKind, LightTable, Start};

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

/// Whether the start needs the model.
fn asks_model(table: &LightTable) -> bool {
    matches!(table.start, Start::Read | Start::Encoder)
}
