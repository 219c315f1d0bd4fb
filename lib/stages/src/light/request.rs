//! What the configuration asks of the light stage.
use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_cli::session::Session;
use dipir_guidance::distillation::DistillationSettings;
use dipir_imaging::file::read_photo_within;
use dipir_imaging::raster::DisplayImage;
use dipir_optimize::lighting::Lighting;
use dipir_optimize::settings::{GuidanceKind, LearningRates, LightTable, Settings, Start};
use dipir_prior::inversion::InversionSettings;
use dipir_scene::config::SceneConfig;
use dipir_scene::views::ViewSettings;
use serde_json::{Value, json};

use crate::light::method::{Method, starts_neutral};
use crate::light::views;
use crate::model::ModelTable;
use crate::scene::folder::SceneFolder;
use crate::scene::transport::{self, Frame};

/// What guides, as far as files go.
pub(crate) enum Guide {
    /// Nothing: the start is the light.
    None,
    /// A picture that the composite should equal.
    Reference {
        /// As the configuration names it.
        path: PathBuf,
        /// Where it is.
        file: PathBuf,
    },
    /// A diffusion model.
    Model {
        table: ModelTable,
        settings: DistillationSettings,
        class: String,
        /// How light is read off the photograph, if it is.
        reading: Option<InversionSettings>,
    },
}

/// What the configuration asks for.
pub(crate) struct Request {
    pub(crate) table: LightTable,
    pub(crate) settings: Settings,
    pub(crate) guide: Guide,
    pub(crate) start: First,
    /// Other photographs of the place, which the estimate uses.
    pub(crate) views: Vec<ViewSettings>,
}

/// Where the light starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum First {
    /// Nearly uniform light.
    Neutral,
    /// What the light estimator says of the photograph.
    Estimated,
    /// What the guiding model reads off the photograph.
    Read,
    /// The light of a file.
    File,
}

impl First {
    fn of(
        session: &Session,
        table: &LightTable,
        method: Method,
        guide: &Guide,
    ) -> anyhow::Result<Self> {
        let first = match (&table.start, guide) {
            (Start::File(path), _) => {
                refuse_misspelt(session, path)?;
                Self::File
            }
            (start, _) if starts_neutral(start, method) => Self::Neutral,
            (
                _,
                Guide::Model {
                    reading: Some(_), ..
                },
            ) => Self::Read,
            (Start::Read | Start::Encoder, _) => {
                let message = "reads with the guiding model, and none guides; accepted: auto, \
                               estimated, neutral, a lighting.json, or guidance = \"lds\" beside it";
                return Err(session.config.invalid("light.start", message).into());
            }
            (Start::Auto | Start::Estimated | Start::Neutral, _) => Self::Estimated,
        };
        Ok(first)
    }

    /// What an estimate alone makes use of is refused where nothing is estimated.
    fn refuse_unused(
        self,
        session: &Session,
        table: &LightTable,
        views: &[ViewSettings],
    ) -> anyhow::Result<()> {
        let how = match self {
            Self::Estimated => return Ok(()),
            Self::Neutral => "from neutral light",
            Self::Read => "from what the guiding model reads off the photograph",
            Self::File => "from the light of a file",
        };
        let views = (!views.is_empty()).then_some(views::KEY);
        match table.only_of_estimates().chain(views).next() {
            None => Ok(()),
            Some(key) => {
                let message = format!(
                    "only an estimated light uses it, and this one starts {how}; remove it, or set \
                     light.start = \"estimated\""
                );
                Err(session.config.invalid(key, message).into())
            }
        }
    }
}

impl Request {
    pub(crate) fn of(session: &Session) -> anyhow::Result<Self> {
        let table: LightTable = session.config.table("light")?;
        let mut settings = transport::settings(session, &table)?;
        let method = Method::of(session)?;
        let guide = match method {
            Method::Reference => {
                let (path, file) = reference_of(session, &table)?;
                Guide::Reference { path, file }
            }
            Method::Model { adapted } => model_guide(session, &table, adapted)?,
            Method::Start | Method::Materials | Method::Given | Method::Taken => Guide::None,
        };
        let start = First::of(session, &table, method, &guide)?;
        let views = views::settings(session)?;
        start.refuse_unused(session, &table, &views)?;
        if let Guide::Model {
            reading: Some(_), ..
        } = &guide
        {
            refine(&table, &mut settings);
        }
        Ok(Self {
            table,
            settings,
            guide,
            start,
            views,
        })
    }

    /// What decides the outputs. How often the state is kept does not.
    pub(super) fn params(&self) -> Value {
        let settings = Settings {
            checkpoint_every: 0,
            ..self.settings.clone()
        };
        let table = &self.table;
        let start = (self.start == First::Estimated).then(|| {
            let mut start = json!({
                "estimator": dipir_estimator::VERSION, "candidate": table.candidate,
                "sun": table.sun, "shadow": table.shadow,
            });
            if !self.views.is_empty() {
                start["views"] = self.views.iter().map(|v| json!(v.config)).collect();
            }
            start
        });
        let mut params = match &self.guide {
            Guide::None => {
                let mut params = json!({"lobes": settings.lobes, "start": table.start});
                if self.start != First::Estimated {
                    params["environment"] = json!(settings.environment);
                }
                // Neutral light is the mean of the photograph, taken at that size.
                if self.start == First::Neutral {
                    params["size"] = json!(settings.size);
                }
                params
            }
            Guide::Reference { .. } => {
                json!({"light": settings, "guidance": GuidanceKind::Reference})
            }
            Guide::Model {
                table,
                settings: distillation,
                class,
                reading,
            } => json!({
                "light": settings, "guidance": distillation, "class": class,
                "precision": table.precision, "reading": reading_param(reading),
            }),
        };
        if let Some(params) = params.as_object_mut() {
            params.extend(start.map(|s| ("estimate".to_owned(), s)));
            params.insert("visible".into(), json!(self.shows_visible()));
        }
        params
    }

    /// Whether what the photograph shows belongs to the light.
    pub(super) fn shows_visible(&self) -> bool {
        let default = self.start == First::Estimated && matches!(self.guide, Guide::None);
        self.table.visible.unwrap_or(default)
    }
}

/// How light is read, as far as it decides.
fn reading_param(reading: &Option<InversionSettings>) -> Value {
    match reading {
        Some(settings) if settings.draws == 0 => json!("encoder"),
        other => json!(other.is_some()),
    }
}

/// Iterations that refine a light that was read off the photograph.
const REFINEMENT: usize = 50;
/// Factor on the learning rates for such a start. Guidance has a bias in everything that the caption
/// does not say, and full rates would follow it (docs/prior.md).
const REFINEMENT_RATE: f64 = 0.05;

/// Sets what `table` leaves open, where the optimisation starts near its result: few iterations at low rates.
fn refine(table: &LightTable, settings: &mut Settings) {
    settings.iterations = table.iterations.unwrap_or(REFINEMENT);
    if table.learning_rates == LearningRates::default() {
        settings.learning_rates = settings.learning_rates.scaled(REFINEMENT_RATE);
    }
}

/// The model that guides and how it is used.
fn model_guide(session: &Session, table: &LightTable, adapted: bool) -> anyhow::Result<Guide> {
    let model: ModelTable = session.config.table("model")?;
    let scene: SceneConfig = session.config.table("scene")?;
    let knows_light = model.knows_light(session);
    let reading = match &table.start {
        Start::Auto => knows_light.then(InversionSettings::default),
        Start::Neutral | Start::Estimated | Start::File(_) => None,
        Start::Read | Start::Encoder if !knows_light => {
            let message = format!(
                "\"{}\" needs a model that knows light, and {} has no {}; accepted: auto, neutral, or \
                 a lighting.json",
                String::from(table.start.clone()),
                model.name(),
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
    let table = LightTable {
        guidance: table.guidance.resolved(true),
        adapt: Some(adapted),
        ..table.clone()
    };
    let settings = DistillationSettings::new(&table, reading.is_some()).map_err(|e| {
        session
            .config
            .invalid(&format!("light.{}", e.key), e.message)
    })?;
    Ok(Guide::Model {
        settings,
        class: scene.class.unwrap_or_else(|| "object".into()),
        table: model,
        reading,
    })
}

/// Refuses a start that was meant as one of the words: a name without extension, and no such file. A file with an extension
/// that is not there is refused where it is read.
pub(crate) fn refuse_misspelt(session: &Session, path: &Path) -> anyhow::Result<()> {
    if path.extension().is_some() || (path.file_name().is_some() && session.resolve(path).exists())
    {
        return Ok(());
    }
    let word = path.to_string_lossy();
    let mut message = format!(
        "\"{word}\" is neither a file nor one of these words; accepted: auto, estimated, read, encoder, neutral, or a \
         lighting.json"
    );
    if word.to_lowercase().starts_with("candidate") {
        message += "; a candidate is chosen by its number in candidates.png, as in start = \"estimated\" and candidate = 2";
    }
    Err(session.config.invalid("light.start", message).into())
}

/// Lobes of a light: every sample of a picture looks at each of them.
const MOST_LOBES: usize = 4096;

/// The light of `[light] start`, if that is a file.
pub(super) fn first_light(
    session: &Session,
    table: &LightTable,
) -> anyhow::Result<Option<Lighting>> {
    let Start::File(path) = &table.start else {
        return Ok(None);
    };
    refuse_misspelt(session, path)?;
    let file = session.resolve(path);
    let read = || -> anyhow::Result<Lighting> {
        // A pipe would be waited for, and a device be read without end.
        dipir_files::open(&file)?;
        Ok(Lighting::read(&file)?)
    };
    let light =
        read().with_context(|| format!("cannot use light.start = \"{}\"", path.display()))?;
    if light.lobes.len() > MOST_LOBES {
        let message = format!(
            "\"{}\" holds {} lobes; accepted: a lighting.json with at most {MOST_LOBES}",
            path.display(),
            light.lobes.len()
        );
        return Err(session.config.invalid("light.start", message).into());
    }
    if light.lobes.is_empty() {
        let message = format!(
            "\"{}\" holds no lobes; accepted: a lighting.json that holds some",
            path.display()
        );
        return Err(session.config.invalid("light.start", message).into());
    }
    Ok(Some(light))
}

/// The reference, as the configuration names it and where it is.
pub(super) fn reference_of(
    session: &Session,
    table: &LightTable,
) -> anyhow::Result<(PathBuf, PathBuf)> {
    let path = table.reference.clone().ok_or_else(|| {
        let message = "is missing: name the picture that the composite should equal, as in \
                       reference = \"image.exr\"";
        session.config.invalid("light.reference", message)
    })?;
    let file = session.resolve(&path);
    Ok((path, file))
}

/// The reference at the size of `frame`, as it is displayed.
pub(super) fn read_reference(
    session: &Session,
    scene: &SceneFolder,
    frame: &Frame,
    file: &Path,
) -> anyhow::Result<DisplayImage> {
    let transfer = scene.loaded.photo.transfer;
    let limits = session.config.table::<SceneConfig>("scene")?.limits;
    let image = read_photo_within(file, transfer, limits.photo())?.image;
    let found = [image.0.width() as u32, image.0.height() as u32];
    let taken = &scene.loaded.taken().image.0;
    let expected = [taken.width() as u32, taken.height() as u32];
    if found != expected {
        let message = format!(
            "\"{}\" has {} x {} pixels; accepted: a picture of the photograph's size, {} x {}",
            file.display(),
            found[0],
            found[1],
            expected[0],
            expected[1]
        );
        return Err(session.config.invalid("light.reference", message).into());
    }
    let image = scene.loaded.undistorted(image);
    Ok(transfer.encode(&frame.scale(&image)))
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use dipir_cli::exit;

    use super::*;
    use crate::command_line::light::Cli;

    #[test]
    fn a_start_that_is_neither_a_word_nor_a_file_is_told_what_there_is() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pipeline.toml");
        std::fs::write(&file, "[scene]\nbackground = \"photo.png\"\n").unwrap();
        std::fs::write(folder.path().join("mine"), "{}").unwrap();
        let start = |start: &str| {
            let path = file.display().to_string();
            let set = format!("light.start={start:?}");
            let args = ["dipir-light", "-q", "-p", &path, "--set", &set];
            let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
            Request::of(&session).map(|request| request.start)
        };
        let words = "accepted: auto, estimated, read, encoder, neutral, or a lighting.json";
        let number = "start = \"estimated\" and candidate = 2";
        for (value, has_number) in [
            ("candidate", true),
            ("candidate 2", true),
            ("natural", false),
            ("", false),
        ] {
            let error = start(value).unwrap_err();
            assert_eq!(exit::code_of(&error), exit::USAGE);
            let message = exit::describe(&error);
            assert!(
                message.contains(&format!("light.start: {value:?} is neither")),
                "{message}"
            );
            assert!(message.contains(words), "{message}");
            assert_eq!(message.contains(number), has_number, "{message}");
        }
        for there in ["mine", "./mine", "none.json"] {
            assert_eq!(start(there).unwrap(), First::File, "{there}");
        }
    }
}
