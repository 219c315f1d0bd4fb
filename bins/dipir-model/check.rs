//! `dipir-model check`.
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context;
use candle_core::{DType, Device};
use dipir_cli::exit::{AlreadyReported, FAILED, Usage};
use dipir_cli::interrupt;
use dipir_cli::progress::Progress;
use dipir_cli::session::{Session, duration, size};
use dipir_diffusion::check::{
    Agreement, PART_COUNT, Reference, Times, TimesSettings, compare, sizes, times,
};
use dipir_diffusion::description::Description;
use dipir_diffusion::model::Model;
use dipir_diffusion::schedule::Prediction;
use dipir_diffusion::training::TrainingConfig;
use dipir_pipeline::manifest::peak_rss_bytes;
use dipir_stages::command_line::model::CheckArgs;
use dipir_stages::model::forecast::{self, Work};
use dipir_stages::model::{self, Loaded, ModelTable};
use serde::Serialize;
use serde_json::json;

/// All that was found.
#[derive(Serialize)]
struct Report {
    model: String,
    /// What was read of it.
    description: Description,
    version: &'static str,
    device: String,
    precision: String,
    threads: usize,
    /// What multiplies bf16 faster than f32 on the CPU, if anything does.
    bf16_products: Option<&'static str>,
    reference: &'static str,
    agreement: Vec<Agreement>,
    times: Times,
    peak_rss_bytes: Option<u64>,
    pipeline: Option<String>,
    works: Vec<Work>,
    /// Why nothing is foretold of the pipeline.
    no_forecast: Option<String>,
}

pub fn run(args: &CheckArgs) -> anyhow::Result<()> {
    let output = args.common.output;
    let session = session(args)?;
    let no_forecast = session
        .as_ref()
        .map(forecast::hindrance)
        .transpose()?
        .flatten();
    let foretold = session.as_ref().filter(|_| no_forecast.is_none());
    if let Some(session) = foretold {
        // What the configuration has wrong is said before minutes are spent.
        forecast::works(session, &Times::default())?;
    }
    let path = chosen(args, session.as_ref())?;
    if session.is_none() {
        interrupt::listen()?;
    }
    let placed = model::device(&args.device, "--device ")?;
    if let Some(why) = &placed.fallback {
        output.warn(why);
    }
    let device = placed.device;
    let dtype = match &args.precision {
        Some(word) => model::precision(word).map_err(|m| Usage(format!("--precision: {m}")))?,
        None if device.is_cpu() => DType::F32,
        None => DType::BF16,
    };
    let prediction = prediction(args, session.as_ref())?;
    let name = match &path {
        Some(path) => path.display().to_string(),
        None => "the embedded model".into(),
    };
    let open = |dtype, device: &Device| open(path.as_deref(), dtype, prediction, device);
    let model = open(dtype, &device)?;
    let progress = Progress::new("comparing", output.quiet);
    // The second copy is dropped before anything is timed.
    let composed = device.is_cpu() && dtype == DType::F32;
    let on_cpu = match composed {
        true => None,
        false => Some(open(DType::F32, &Device::Cpu)?),
    };
    let agreement = agreement(args.small, &model, on_cpu.as_deref(), &progress);
    drop(on_cpu);
    progress.done();
    let agreement = agreement.map_err(interrupted)?;
    let progress = Progress::new("timing", output.quiet);
    let times = measure(session.as_ref(), &model, &progress).map_err(interrupted);
    progress.done();
    let times = times?;
    let works = match foretold {
        Some(session) => forecast::works(session, &times)?,
        None => vec![],
    };
    let report = Report {
        model: name,
        description: Description::of(&model)?,
        version: env!("CARGO_PKG_VERSION"),
        device: placed_name(&device),
        precision: dtype.as_str().into(),
        threads: rayon_threads(),
        bf16_products: dipir_diffusion::bf16_products(),
        reference: match composed {
            true => "the same layers of candle's operations",
            false => "the same model on the CPU in f32",
        },
        agreement,
        times,
        peak_rss_bytes: peak_rss_bytes(),
        pipeline: session
            .as_ref()
            .map(|s| s.config.path().display().to_string()),
        works,
        no_forecast,
    };
    output.result(|| report.in_words(), || json!(report));
    match report.agreement.iter().all(Agreement::holds) {
        true => Ok(()),
        false => Err(AlreadyReported(FAILED).into()),
    }
}

/// The configuration, if there is one, with the model that is checked: a file that is named has to be there.
fn session(args: &CheckArgs) -> anyhow::Result<Option<Session>> {
    let usual = args.common.pipeline == Path::new("pipeline.toml");
    if usual && !args.common.pipeline.exists() {
        return Ok(None);
    }
    let mut common = args.common.clone();
    if let Some(path) = &args.model {
        let path =
            std::path::absolute(path).with_context(|| format!("cannot find {}", path.display()))?;
        common
            .set
            .push(format!("model.path={:?}", path.display().to_string()));
    }
    Session::start(&common).map(Some)
}

/// The model's path: that of the command line, else that of the configuration. `None` is the embedded model.
fn chosen(args: &CheckArgs, session: Option<&Session>) -> anyhow::Result<Option<PathBuf>> {
    let Some(session) = session.filter(|_| args.model.is_none()) else {
        return Ok(args.model.clone());
    };
    let table: ModelTable = session.config.table("model")?;
    Ok(table.path.map(|path| session.resolve(&path)))
}

/// What the UNet predicts, if the command line says it, or the configuration of the model that is named there. With a
/// model on the command line the file's own key is another model's, and one that `--set` sets is this one's.
fn prediction(args: &CheckArgs, session: Option<&Session>) -> anyhow::Result<Option<Prediction>> {
    if let Some(word) = &args.prediction {
        let found = model::prediction(word).map_err(|m| Usage(format!("--prediction: {m}")))?;
        return Ok(Some(found));
    }
    let is_set = |set: &String| set.trim_start().starts_with("model.prediction");
    let is_meant = args.model.is_none() || args.common.set.iter().any(is_set);
    let Some(session) = session.filter(|_| is_meant) else {
        return Ok(None);
    };
    let table: ModelTable = session.config.table("model")?;
    let found = table.prediction.as_deref().map(model::prediction);
    let found = found.transpose();
    Ok(found.map_err(|m| session.config.invalid("model.prediction", m))?)
}

fn open(
    path: Option<&Path>,
    dtype: DType,
    prediction: Option<Prediction>,
    device: &Device,
) -> anyhow::Result<Loaded> {
    model::open(path, dtype, prediction, device).with_context(|| match path {
        Some(path) => format!("cannot use {}", path.display()),
        None => "cannot use the embedded model".into(),
    })
}

/// Every part at every size.
fn agreement(
    small: bool,
    model: &Model,
    on_cpu: Option<&Model>,
    progress: &Progress,
) -> anyhow::Result<Vec<Agreement>> {
    let mut sides = sizes(model);
    if small {
        sides.truncate(1);
    }
    let reference = match on_cpu {
        Some(other) => Reference::Cpu(other),
        None => Reference::Composed,
    };
    let all = (sides.len() * PART_COUNT) as f64;
    let mut found = vec![];
    for (index, &side) in sides.iter().enumerate() {
        found.extend(compare(model, reference, side, |done| {
            progress.set((index * PART_COUNT + done) as f64 / all);
            !interrupt::asked()
        })?);
    }
    Ok(found)
}

fn measure(
    session: Option<&Session>,
    model: &Loaded,
    progress: &Progress,
) -> anyhow::Result<Times> {
    let watch = |share| {
        progress.set(share);
        !interrupt::asked()
    };
    match session {
        Some(session) => forecast::measure(session, model, watch),
        None => {
            let settings = TimesSettings {
                side: model.unet.config().sample_size,
                training: TrainingConfig::default(),
                with_prior: true,
            };
            Ok(times(model, &settings, watch)?)
        }
    }
}

/// After Ctrl-C, the error that says so; else `error`.
fn interrupted(error: anyhow::Error) -> anyhow::Error {
    interrupt::check().map_or_else(Into::into, |()| error)
}

fn placed_name(device: &Device) -> String {
    match device.location() {
        candle_core::DeviceLocation::Cpu => "cpu".into(),
        candle_core::DeviceLocation::Cuda { gpu_id } => format!("cuda:{gpu_id}"),
        candle_core::DeviceLocation::Metal { gpu_id } => format!("metal:{gpu_id}"),
    }
}

fn rayon_threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

impl Report {
    fn in_words(&self) -> String {
        let multiplied = match (self.device.as_str(), self.precision.as_str()) {
            ("cpu", "bf16") => match self.bf16_products {
                Some(products) => format!(" ({products})"),
                None => " (products in f32: this processor has no tiles of bf16)".into(),
            },
            _ => String::new(),
        };
        let mut text = format!(
            "{} on {} in {}{multiplied}, against {}\n\n",
            self.model, self.device, self.precision, self.reference
        );
        for (name, what) in self.description.in_words() {
            let _ = writeln!(text, "  {name:12} {what}");
        }
        text += "\n  part                     size        error\n";
        for part in &self.agreement {
            let unit = match part.part {
                "text encoder" => "tokens",
                _ => "pixels",
            };
            let verdict = match part.holds() {
                true => "",
                false => "  DOES NOT AGREE",
            };
            let _ = writeln!(
                text,
                "  {:22} {:>4} {unit}  {:9.1e}{verdict}",
                part.part, part.size, part.error
            );
        }
        let t = &self.times;
        let _ = writeln!(text, "\n  time at {} pixels", t.size);
        for (part, seconds) in [
            ("UNet, one prediction", t.unet_s),
            ("VAE encoder", t.encode_s),
            ("VAE encoder with its gradient", t.encode_with_gradient_s),
            ("VAE decoder", t.decode_s),
            ("one step of a sampler", t.sampling_step_s),
            ("one iteration of guidance (LDS)", t.guidance_s),
            ("one update of a LoRA", t.lora_step_s),
        ] {
            let _ = writeln!(text, "  {part:34} {:>12}", brief(seconds));
        }
        if let Some(bytes) = self.peak_rss_bytes {
            let _ = writeln!(text, "\n  peak memory {} (not of a GPU)", size(bytes));
        }
        if let (Some(file), false) = (&self.pipeline, self.works.is_empty()) {
            let _ = writeln!(text, "\n  {file} with this model");
        }
        for work in &self.works {
            let _ = writeln!(
                text,
                "  {:9} {:34} about {}\n            halved by {}",
                work.stage,
                work.what,
                duration(work.seconds),
                work.halved_by.join("; ")
            );
        }
        match (&self.pipeline, &self.no_forecast) {
            (Some(file), Some(why)) => {
                let _ = writeln!(text, "\n  {file}: nothing is foretold of its stages: {why}");
            }
            (Some(_), None) if self.works.is_empty() => {
                let _ = writeln!(text, "\n  pipeline.toml asks no diffusion model");
            }
            _ => {}
        }
        text.truncate(text.trim_end().len());
        text
    }
}

/// `12.3 ms`, `1.20 s`.
fn brief(seconds: f64) -> String {
    match seconds {
        s if s < 1.0 => format!("{:.1} ms", s * 1e3),
        s => duration(s),
    }
}
