//! What was read of a model, for people who compare it with what they meant to use.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::error::Result;
use crate::model::Model;
use crate::schedule::{BetaSchedule, Prediction};
use crate::vae::Vae;
use crate::weights::Weights;

/// Widths of the text states of both families.
const FAMILIES: [(usize, &str); 2] = [(768, "Stable Diffusion 1"), (1024, "Stable Diffusion 2")];

/// What a model is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Description {
    /// By the width of its text states.
    pub family: String,
    /// Whether its UNet takes mask and masked latents too.
    pub inpainting: bool,
    /// What its UNet predicts.
    pub prediction: Prediction,
    /// Timesteps of its training.
    pub timesteps: usize,
    /// How its noise grows; `None` where every variance is spelled out.
    pub beta_schedule: Option<BetaSchedule>,
    /// First and last noise variance of that curve.
    pub betas: Option<[f64; 2]>,
    /// Whether the last timestep is noise alone.
    pub zero_terminal_snr: bool,
    /// Side of the images of its training, pixels.
    pub native_size: usize,
    /// Precisions of the weights on the disk, by part.
    pub stored: BTreeMap<&'static str, Vec<String>>,
    /// Settings of the named sampler that nothing here heeds.
    pub unused: Vec<String>,
}

impl Description {
    /// Of a model whose files are still where they were read.
    pub fn of(model: &Model) -> Result<Self> {
        let width = model.unet.config().cross_attention_dim;
        let family = FAMILIES.iter().find(|(w, _)| *w == width);
        let schedule = model.schedule.config();
        let is_curve = schedule.trained_betas.is_none();
        Ok(Self {
            family: match family {
                Some((_, name)) => (*name).to_owned(),
                None => format!("a model of other sizes (text states of {width})"),
            },
            inpainting: model.is_inpainting(),
            prediction: schedule.prediction_type,
            timesteps: schedule.num_train_timesteps,
            beta_schedule: is_curve.then_some(schedule.beta_schedule),
            betas: is_curve.then_some([schedule.beta_start, schedule.beta_end]),
            zero_terminal_snr: schedule.rescale_betas_zero_snr,
            native_size: model.native_size(),
            stored: stored(model)?,
            unused: model.schedule.unused().to_vec(),
        })
    }

    /// Lines of a name and what it is.
    pub fn in_words(&self) -> Vec<(&'static str, String)> {
        let word = |value: serde_json::Result<serde_json::Value>| match value {
            Ok(serde_json::Value::String(word)) => word,
            _ => String::new(),
        };
        let inpainting = if self.inpainting { ", inpainting" } else { "" };
        let curve = match (self.beta_schedule, self.betas) {
            (Some(curve), Some([first, last])) => {
                let curve = word(serde_json::to_value(curve));
                format!("{curve}, {first} to {last}")
            }
            _ => "spelled out".into(),
        };
        let snr = match self.zero_terminal_snr {
            true => ", zero terminal SNR",
            false => "",
        };
        let stored = self.stored.iter();
        let stored = stored.map(|(part, all)| format!("{part} {}", all.join(" and ")));
        let mut lines = vec![
            ("family", format!("{}{inpainting}", self.family)),
            ("prediction", word(serde_json::to_value(self.prediction))),
            (
                "noise",
                format!("{curve}, {} timesteps{snr}", self.timesteps),
            ),
            ("size", format!("{} pixels", self.native_size)),
            ("on the disk", stored.collect::<Vec<_>>().join(", ")),
        ];
        if !self.unused.is_empty() {
            let unused = self.unused.join(", ");
            lines.push(("not used", format!("{unused} of the scheduler")));
        }
        lines
    }
}

fn stored(model: &Model) -> Result<BTreeMap<&'static str, Vec<String>>> {
    let path = &model.folder;
    if path.is_file() {
        return Ok([("file", Weights::open_file(path)?.precisions())].into());
    }
    let open = |part: &str, stem| -> Result<Vec<String>> {
        Ok(Weights::open(&path.join(part), stem)?.precisions())
    };
    let diffusers = "diffusion_pytorch_model";
    let mut stored = BTreeMap::from([
        ("text_encoder", open("text_encoder", "model")?),
        ("unet", open("unet", diffusers)?),
    ]);
    if let Vae::Kl(_) = model.vae {
        stored.insert("vae", open("vae", diffusers)?);
    }
    Ok(stored)
}
