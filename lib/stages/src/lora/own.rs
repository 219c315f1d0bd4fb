//! A LoRA of the user's own, `lora.path`: it is read and checked, and none is trained.
use std::path::{Path, PathBuf};

use anyhow::Context;
use candle_core::{DType, Tensor};
use dipir_cli::output::json_path;
use dipir_cli::session::Session;
use dipir_diffusion::lora::{Lora, LoraInfo, LoraStyle, lora_files};
use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::pass::Pass;
use dipir_pipeline::stage::{StagePlan, StageWriter};
use serde_json::{Value, json};

use super::base::base_hash;
use super::history::History;
use super::sheet::Sheet;
use super::table::LoraTable;
use super::{Done, class, class_prompts};
use crate::model::{self, ModelTable};
use crate::names::{LORA, begin};
use crate::shown;

/// Role of its files among the stage's inputs.
const ROLE: &str = "LoRA";
/// Raised whenever a file gives other outputs. It is added to the stage's version, so that nothing is trained again for it.
const VERSION: u32 = 1;

/// What was read.
pub(super) struct Read {
    /// As the configuration names it.
    pub(super) path: PathBuf,
    /// Layers that are adapted.
    pub(super) layers: usize,
    /// Their ranks, least and largest.
    pub(super) ranks: [usize; 2],
    /// Root of the mean square of what it changes on the sheet.
    pub(super) difference: Option<f64>,
}

/// What a run would be.
pub(super) fn plan(session: &Session, table: &LoraTable, path: &Path) -> anyhow::Result<StagePlan> {
    let model_table: ModelTable = session.config.table("model")?;
    let found = session.resolve(path);
    let wrong = |message: String| session.config.invalid("lora.path", message);
    if !found.exists() {
        return Err(wrong(format!("\"{}\" is not there", path.display())).into());
    }
    let (file, config) = lora_files(&found).map_err(|e| wrong(e.to_string()))?;
    // As the configuration would name them.
    let named = |location: &Path| match (found.is_dir(), location.file_name()) {
        (true, Some(name)) => path.join(name),
        (false, Some(name)) if location != file => path.with_file_name(name),
        _ => path.to_owned(),
    };
    let class = (table.sheet_steps > 0)
        .then(|| class(session))
        .transpose()?;
    let params = json!({
        "class": class, "precision": model_table.precision,
        "lora": {"path": json_path(named(&file)), "word": table.word, "sheet_steps": table.sheet_steps},
    });
    let mut plan = LORA.plan(session, params);
    plan.version += VERSION;
    plan.device = session.pipeline.device.clone();
    for location in std::iter::once(&file).chain(&config) {
        plan.input(ROLE, &named(location), location)?;
    }
    model::inputs(session, &model_table, &mut plan)?;
    Ok(plan)
}

/// Reads the LoRA, checks it against the model, and writes what the stages behind read.
pub(super) fn run(session: &Session, table: &LoraTable, path: &Path) -> anyhow::Result<Done> {
    let plan = plan(session, table, path)?;
    let source = plan.inputs.iter().find(|i| i.role == ROLE);
    let source = source.map(|i| i.blake3.clone()).unwrap_or_default();
    let base = base_hash(&plan).unwrap_or_default();
    let mut writer = begin(session, plan)?;
    let model = model::load(session, &session.config.table("model")?)?;
    model::check_steps(session, &model, "lora.sheet_steps", table.sheet_steps)?;
    let targets = model.unet.adapter_targets();
    let lora = Lora::load(&session.resolve(path), &targets, DType::F32, model.device())
        .map_err(anyhow::Error::from)
        .and_then(finite)
        .and_then(|lora| predicting(&model, lora))
        .with_context(|| format!("cannot use lora.path = \"{}\"", path.display()))?;
    let info = LoraInfo::from([
        ("word".to_owned(), table.word.clone()),
        ("base_model_blake3".to_owned(), base),
        ("source_blake3".to_owned(), source.clone()),
    ]);
    for (role, name, style) in [
        ("lora", "lora.safetensors", LoraStyle::Peft),
        ("lora_kohya", "lora_kohya.safetensors", LoraStyle::Kohya),
    ] {
        lora.save(&writer.output(role, name)?, style, &info)?;
    }
    let (sheet, difference) = sheet(session, table, &model, &lora, &mut writer)?;
    let ranks = || lora.adapters().values().map(|a| a.rank());
    let read = Read {
        path: path.to_owned(),
        layers: lora.adapters().len(),
        ranks: [ranks().min().unwrap_or(0), ranks().max().unwrap_or(0)],
        difference,
    };
    let training = json!({
        "own": {"path": json_path(path), "blake3": source, "layers": read.layers, "ranks": read.ranks},
        "word": table.word, "history": [], "validation": [], "sheet": sheet,
    });
    writer.write_json("training", "training.json", &training)?;
    Ok(Done {
        folder: LORA.folder(session),
        manifest: writer.finish()?,
        history: History::default(),
        resumed_at: 0,
        wanted: 0,
        from_cache: false,
        own: Some(read),
    })
}

/// Whether every value of a tensor in f32 is finite.
fn all_finite(values: &Tensor) -> candle_core::Result<bool> {
    // 0 times anything else is NaN.
    let sum = (values * 0.0)?.sum_all()?.to_scalar::<f32>()?;
    Ok(sum == 0.0)
}

/// Refuses matrices that are not finite: every prediction with them would not be, either.
fn finite(lora: Lora) -> anyhow::Result<Lora> {
    for (layer, adapter) in lora.adapters() {
        for matrix in [adapter.down(), adapter.up()] {
            anyhow::ensure!(
                all_finite(matrix)?,
                "the matrices of layer \"{layer}\" are not finite; train the LoRA again, or export it in f32"
            );
        }
    }
    Ok(lora)
}

/// Refuses a LoRA with which the model's prediction is not finite, where it is without: the model is whole.
fn predicting(model: &Model, lora: Lora) -> anyhow::Result<Lora> {
    let config = model.unet.config();
    // The smallest picture that every level of the network can halve.
    let side = 1 << (config.levels() - 1);
    let dims = [1, config.in_channels, side, side];
    let noise = NoiseStream::new(1, 0).normal_tensor(&dims, DType::F32, model.device())?;
    let noise = noise.to_dtype(model.dtype())?;
    let context = model.encode_prompts(&[""], None)?;
    let middle = [(model.schedule.len() / 2) as f64];
    let is_finite = |pass: &Pass| -> anyhow::Result<bool> {
        let prediction = model.unet.predict(&noise, &middle, &context, pass)?;
        Ok(all_finite(&prediction.to_dtype(DType::F32)?)?)
    };
    let adapted = Pass {
        lora: Some(lora.constant(model.dtype())?.into()),
        ..Pass::default()
    };
    // Without it only where something is wrong, for it takes as long.
    if is_finite(&adapted)? || !is_finite(&Pass::default())? {
        return Ok(lora);
    }
    let (mut largest, mut of) = (0.0, "");
    for (layer, adapter) in lora.adapters() {
        for matrix in [adapter.down(), adapter.up()] {
            let value = matrix.abs()?.max_all()?.to_scalar::<f32>()?;
            if value > largest {
                (largest, of) = (value, layer);
            }
        }
    }
    anyhow::bail!(
        "with it the model's prediction is not finite, without it it is: its values reach {largest:.1e} (layer \"{of}\"); \
         train the LoRA again with a lower learning rate, or use one that was saved earlier"
    )
}

/// A root mean square difference of display values that is not seen: a tenth of an 8-bit step.
const LEAST_SEEN: f64 = 0.1 / 255.0;

/// The LoRA's file or folder, as the configuration names it.
fn path_of(table: &LoraTable) -> String {
    table
        .path
        .as_ref()
        .map_or(String::new(), |p| p.display().to_string())
}

/// Writes the sheet, if one is wanted: what it shows, and how far both columns are apart.
fn sheet(
    session: &Session,
    table: &LoraTable,
    model: &Model,
    lora: &Lora,
    writer: &mut StageWriter,
) -> anyhow::Result<(Value, Option<f64>)> {
    if table.sheet_steps == 0 {
        return Ok((Value::Null, None));
    }
    let sheet = Sheet {
        prompts: class_prompts(&class(session)?, &table.word).into(),
        steps: table.sheet_steps,
        of: format!("lora.path = \"{}\"", path_of(table)),
    };
    let progress = session.progress("sheet");
    let path = writer.output("sheet", "sheet.png")?;
    let difference = sheet.write(model, lora, None, &path, |share| progress.set(share))?;
    progress.done();
    if difference < LEAST_SEEN {
        session.warn(&format!(
            "{}: on the sheet it moves display values by {difference:.5}, which is not seen: is it of this model, its alpha \
             not 0, and does lora.word (\"{}\") hold the words that it knows?",
            path_of(table),
            table.word
        ));
    }
    let shown = json!({
        "prompts": sheet.prompts, "steps": sheet.steps, "rms_difference": difference,
    });
    Ok((shown, Some(difference)))
}

impl Read {
    /// For programs.
    pub(super) fn to_json(&self) -> Value {
        json!({
            "path": json_path(&self.path), "layers": self.layers, "ranks": self.ranks, "rms_difference": self.difference,
        })
    }

    /// One line for people.
    pub(super) fn in_words(&self) -> String {
        let ranks = match self.ranks {
            [least, most] if least == most => format!("rank {least}"),
            [least, most] => format!("rank {least} to {most}"),
        };
        let mut words = format!("{}: {} layers of {ranks}", shown(&self.path), self.layers);
        if let Some(difference) = self.difference {
            words += &format!("; on the sheet it moves display values by {difference:.4}");
        }
        words
    }
}
