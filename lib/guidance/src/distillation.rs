//! Guidance by a diffusion model: what it would change about the composite, as a gradient.
use std::sync::Arc;

use candle_core::{DType, Tensor};
use dipir_diffusion::distillation::{InpaintCondition, ScoreDistillation, ScoreRule, Weighting};
use dipir_diffusion::lora::Lora;
use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::text_encoder::LearnedTokens;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_optimize::OptimizeError;
use dipir_optimize::crop::{CropView, Framing, USUAL_SCALE};
use dipir_optimize::guidance::{Guidance, Guided, Step};
use dipir_optimize::settings::{BadSetting, GuidanceKind, LightTable};
use dipir_prior::caption::{Caption, LightDescription};
use dipir_prior::text_conditioning::{caption_states, guidance_states};
use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// Scale of the gradient: its mean square over the picture is about this over the number of pixels.
/// So guidance weighs as much beside the regularisers as a reference does.
const STRENGTH: f64 = 100.0;
/// Sides of the crops that a model with light captions sees, in sides of the object's box: those of
/// its training.
const LIGHT_SCALE: [f32; 2] = [2.2, 3.0];

/// Denoising steps from pure noise to a picture. An edited picture takes those below its timestep.
const EDIT_STEPS: usize = 10;

/// How a diffusion model guides: its part of the `[light]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DistillationSettings {
    /// Which difference of noise predictions is the gradient.
    pub guidance: GuidanceKind,
    /// Least and largest noise level, as shares of all timesteps: in the first and in the last
    /// iteration.
    pub timesteps: [[f64; 2]; 2],
    /// Noise samples in each iteration.
    pub draws: usize,
    /// Side of the crops that the model sees, pixels; without it, [`default_crop`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub crop: Option<usize>,
    /// Classifier-free guidance of SDS and of edited pictures.
    pub guidance_scale: f64,
    /// What the picture should show. If absent, the prompt is made of class, word and light.
    pub prompt: Option<String>,
    /// Whether a LoRA is used.
    pub adapt: bool,
    /// Whether the model's prediction under the caption of the estimated light is compared with its predictions
    /// under captions of the same light from other sides. If not, the other caption is empty.
    pub turned: bool,
}

impl DistillationSettings {
    /// The settings of `table`, with defaults for models with or without light captions.
    ///
    /// # Errors
    /// A value out of range, with its key.
    pub fn new(table: &LightTable, knows_light: bool) -> std::result::Result<Self, BadSetting> {
        let wrong = |key, message: String| Err(BadSetting { key, message });
        let timesteps = match table.timesteps.as_deref() {
            None if knows_light => [[0.5, 0.9]; 2],
            // [DiPIR, section 4.3].
            None => [[0.02, 0.6], [0.02, 0.3]],
            Some([one]) => [*one; 2],
            Some([first, last]) => [*first, *last],
            Some(_) => {
                let message = "accepted: one pair, or two of which the second is reached at the \
                               end, as in [[0.02, 0.6], [0.02, 0.3]]";
                return wrong("timesteps", message.into());
            }
        };
        if timesteps
            .iter()
            .any(|[low, high]| !(0.0 <= *low && low <= high && *high <= 1.0))
        {
            let message = "accepted: pairs of a lower and a higher share, from 0 to 1";
            return wrong("timesteps", message.into());
        }
        let draws = table.draws.unwrap_or(1);
        if !(1..=64).contains(&draws) {
            return wrong(
                "draws",
                format!("{draws} is out of range; accepted: 1 to 64"),
            );
        }
        if let Some(side) = table.crop
            && !((32..=1024).contains(&side) && side % 8 == 0)
        {
            let message = format!("{side} is refused; accepted: multiples of 8 from 32 to 1024");
            return wrong("crop", message);
        }
        if let Some(scale) = table.guidance_scale
            && !scale.is_finite()
        {
            let message = format!("{scale} is refused; accepted: finite numbers, as in 7.5");
            return wrong("guidance_scale", message);
        }
        Ok(Self {
            guidance: table.guidance,
            timesteps,
            draws,
            crop: table.crop,
            guidance_scale: table.guidance_scale.unwrap_or(7.5),
            prompt: table.prompt.clone(),
            adapt: table.adapt.unwrap_or(true),
            turned: true,
        })
    }
}

/// Side of the crops on a CPU at most: a model of 512 pixels takes a quarter of its time there.
const CPU_CROP: usize = 256;

/// Side of the crops that a model sees where nothing says it, pixels: that of its training, on the
/// CPU at most [`CPU_CROP`].
pub fn default_crop(native: usize, on_cpu: bool) -> usize {
    match on_cpu {
        true => native.min(CPU_CROP),
        false => native,
    }
}

/// A LoRA that was trained on the photograph.
pub struct Adapter {
    /// Its matrices.
    pub lora: Arc<Lora>,
    /// The embedding of its word, if one was learned.
    pub learned: Option<LearnedTokens>,
    /// The word that stands for the photograph's style in prompts.
    pub word: String,
}

/// Text states of the wanted picture and of those that it is compared with.
struct Contrast {
    conditional: Tensor,
    unconditional: Tensor,
}

impl Contrast {
    fn new(conditional: &Tensor, unconditional: &Tensor) -> Self {
        Self {
            conditional: conditional.detach(),
            unconditional: unconditional.detach(),
        }
    }

    /// Compares a picture of `class` under the light `words` with pictures under other lights.
    fn of_light(
        model: &Model,
        settings: &DistillationSettings,
        class: &str,
        words: &LightDescription,
    ) -> Result<Self> {
        let known = model.tokenizer.words(class)?.len() == 1;
        let class = if known { class } else { "object" };
        // SDS and SDEdit extrapolate away from the unconditional prediction, which must be that of no
        // caption.
        let differs = matches!(settings.guidance, GuidanceKind::Lds | GuidanceKind::Csd);
        let all = match settings.turned && differs {
            true => guidance_states(model, class, words)?,
            false => caption_states(model, &[Some(Caption::new(class, Some(words))), None])?,
        };
        let others = all.dim(0)? - 1;
        Ok(Self::new(&all.narrow(0, 0, 1)?, &all.narrow(0, 1, others)?))
    }
}

/// `picture` with left and right swapped.
fn mirror(picture: &Raster<Vec3>) -> Raster<Vec3> {
    let (width, height) = (picture.width(), picture.height());
    let rows = (0..height).flat_map(|y| picture.row(y).iter().rev().copied());
    Raster::from_pixels(width, height, rows.collect())
}

/// Score distillation on crops of the composite.
pub struct Distillation<'a> {
    model: &'a Model,
    settings: DistillationSettings,
    lora: Option<Arc<Lora>>,
    contrast: Contrast,
    /// The same for the mirror image of the picture, if a light is described.
    mirrored: Option<Contrast>,
    background: Raster<Vec3>,
    paint: Raster<Vec3>,
    side: usize,
    knows_light: bool,
}

impl<'a> Distillation<'a> {
    /// Guides towards an object of `class` under `light`, whose azimuth is relative to the view of the
    /// object's crop. `background` is the photograph; `paint` is 1 where an inpainting model may paint.
    pub fn new(
        model: &'a Model,
        settings: DistillationSettings,
        adapter: Option<&Adapter>,
        class: &str,
        light: Option<&LightDescription>,
        background: &DisplayImage,
        paint: &Raster<f32>,
    ) -> Result<Self> {
        let word = adapter.map(|a| a.word.as_str());
        let learned = adapter.and_then(|a| a.learned.as_ref());
        let (contrast, mirrored) = match (light, &settings.prompt) {
            (Some(words), None) => {
                let of = |words| Contrast::of_light(model, &settings, class, words);
                (of(words)?, Some(of(&words.mirrored())?))
            }
            (_, prompt) => {
                let own = match word {
                    // [DiPIR, section 4.3].
                    Some(word) => {
                        format!("a photo of a {class} in a scene in the style of {word} rendering")
                    }
                    None => format!("a photo of a {class}"),
                };
                let prompt = prompt.clone().unwrap_or(own);
                let conditional = model.encode_prompts(&[&prompt], learned)?;
                let unconditional = model.encode_prompts(&[""], None)?;
                (Contrast::new(&conditional, &unconditional), None)
            }
        };
        Ok(Self {
            model,
            lora: adapter.map(|a| a.lora.clone()),
            contrast,
            mirrored,
            background: background.0.clone(),
            paint: paint.map(|&a| Vec3::splat(a)),
            side: settings
                .crop
                .unwrap_or_else(|| default_crop(model.native_size(), model.device().is_cpu())),
            knows_light: light.is_some(),
            settings,
        })
    }

    /// Planes [1, 3, side, side] in [-1, 1].
    fn tensor(&self, picture: &Raster<Vec3>) -> Result<Tensor> {
        let image = dipir_tensors::model_input(&DisplayImage(picture.clone()))?;
        let image = image.unsqueeze(0)?.to_device(self.model.device())?;
        Ok(image.to_dtype(self.model.dtype())?)
    }

    fn condition(&self, view: &CropView, swap: bool) -> Result<Option<InpaintCondition>> {
        if !self.model.is_inpainting() {
            return Ok(None);
        }
        let seen = |picture: &Raster<Vec3>| match swap {
            true => mirror(&view.apply(picture)),
            false => view.apply(picture),
        };
        let shown = self.tensor(&seen(&self.background))?;
        let mask = dipir_tensors::mask(&seen(&self.paint).map(|p| p.x), 0.02)?;
        let mask = mask.to_device(self.model.device())?;
        let mask = mask.to_dtype(self.model.dtype())?;
        Ok(Some(InpaintCondition::new(&self.model.vae, &shown, &mask)?))
    }

    fn evaluate(&self, picture: &Raster<Vec3>, view: &CropView, step: Step) -> Result<Guided> {
        // Every other iteration uses the mirror image: part of the model's error changes sign there
        // (docs/prior.md).
        let swapped = self.mirrored.as_ref().filter(|_| step.iteration % 2 == 1);
        let contrast = swapped.unwrap_or(&self.contrast);
        let image = match swapped {
            Some(_) => self.tensor(&mirror(picture))?,
            None => self.tensor(picture)?,
        };
        let encoding = self.model.vae.trace(&image)?;
        let latents = encoding.latents();
        let condition = self.condition(view, swapped.is_some())?;
        let rule = match self.settings.guidance {
            GuidanceKind::Sds => ScoreRule::Sds {
                scale: self.settings.guidance_scale,
            },
            GuidanceKind::Csd => ScoreRule::Csd,
            GuidanceKind::SdEdit => ScoreRule::Edit {
                scale: self.settings.guidance_scale,
                steps: EDIT_STEPS,
            },
            _ => ScoreRule::Lds,
        };
        let distillation = ScoreDistillation {
            unet: &self.model.unet,
            schedule: &self.model.schedule,
            rule,
            weighting: Weighting::NoiseVariance,
            lora: self.lora.as_ref(),
            conditional: &contrast.conditional,
            unconditional: &contrast.unconditional,
            inpaint: condition.as_ref(),
        };
        let mut stream = NoiseStream::new(step.seed ^ 0xd15711, step.iteration as u64);
        let share = step.iteration as f64 / (step.iterations.max(2) - 1) as f64;
        let [first, last] = self.settings.timesteps;
        let bound = |k: usize| first[k] + (last[k] - first[k]) * share;
        let (low, high) = (bound(0), bound(1));
        let draws = self.settings.draws;
        let mut sum: Option<Tensor> = None;
        let (mut size, mut mean_t) = (0.0, 0.0);
        for draw in 0..draws {
            // Stratified over the draws.
            let u = (draw as f64 + stream.uniform()) / draws as f64;
            let at = low + (high - low) * u;
            let t = self.model.schedule.timestep_at(at);
            let noise = stream
                .normal_tensor(latents.dims(), DType::F32, self.model.device())?
                .to_dtype(self.model.dtype())?;
            let found = distillation.gradient(latents, t, &noise)?;
            size += found.difference / draws as f64;
            mean_t += at / draws as f64;
            sum = Some(match sum {
                None => found.gradient,
                Some(sum) => (sum + found.gradient)?,
            });
        }
        let sum = sum.ok_or(Error::Cut("no noise was drawn"))?.detach();
        let scale = STRENGTH / (draws * latents.elem_count()) as f64;
        let at_image = encoding.gradient(&sum)?;
        let at_image = (at_image.to_dtype(DType::F32)? * (2.0 * scale))?;
        let gradient = dipir_tensors::picture(&at_image)?;
        Ok(Guided {
            loss: size,
            gradient: match swapped {
                Some(_) => mirror(&gradient),
                None => gradient,
            },
            timestep: Some(mean_t),
        })
    }
}

impl Guidance for Distillation<'_> {
    fn framing(&self) -> Framing {
        Framing::Crops {
            side: self.side,
            scale: if self.knows_light {
                LIGHT_SCALE
            } else {
                USUAL_SCALE
            },
        }
    }

    fn gradient(
        &mut self,
        picture: &Raster<Vec3>,
        view: &CropView,
        step: Step,
    ) -> std::result::Result<Guided, OptimizeError> {
        self.evaluate(picture, view, step)
            .map_err(|e| OptimizeError::Guidance {
                iteration: step.iteration,
                source: e.into(),
            })
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use candle_core::Device;

    use super::*;

    #[test]
    fn crops_are_those_of_the_training_and_smaller_on_a_cpu_unless_set() {
        assert_eq!(default_crop(512, false), 512);
        assert_eq!(default_crop(768, true), 256);
        assert_eq!(default_crop(64, true), 64);
        let with = |crop| {
            DistillationSettings::new(
                &LightTable {
                    crop,
                    ..Default::default()
                },
                false,
            )
        };
        assert_eq!(with(Some(512)).unwrap().crop, Some(512));
        for bad in [0, 24, 260, 1032] {
            let refusal = with(Some(bad)).unwrap_err();
            assert_eq!(refusal.key, "crop");
            let message = format!("{bad} is refused; accepted: multiples of 8 from 32 to 1024");
            assert_eq!(refusal.message, message);
        }
    }

    #[test]
    fn a_scale_of_guidance_is_a_finite_number() {
        let with = |guidance_scale| {
            let table = LightTable {
                guidance_scale: Some(guidance_scale),
                ..Default::default()
            };
            DistillationSettings::new(&table, false)
        };
        assert_eq!(with(-1.5).unwrap().guidance_scale, -1.5);
        for bad in [f64::NAN, f64::INFINITY] {
            assert_eq!(with(bad).unwrap_err().key, "guidance_scale");
        }
    }

    #[test]
    fn an_odd_iteration_is_that_of_the_mirror_image_turned_back() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data/prior");
        let mut model = Model::load(&folder, DType::F32, &Device::Cpu).unwrap();
        dipir_prior::text_conditioning::add_placeholders(&mut model.tokenizer);
        let side = model.native_size();
        let drawn = |value: fn(f32, f32) -> Vec3| {
            let unit = |k: usize| k as f32 / side as f32;
            let pixels = (0..side * side).map(|i| value(unit(i % side), unit(i / side)));
            Raster::from_pixels(side, side, pixels.collect())
        };
        let photo = drawn(|x, y| Vec3::new(0.3 + 0.4 * x, 0.5, 0.4 + 0.3 * y));
        let picture = drawn(|x, y| match (x - 0.4).hypot(y - 0.5) < 0.2 {
            true => Vec3::new(0.9 - x, 0.4, 0.3),
            false => Vec3::new(0.3 + 0.4 * x, 0.5 * x.max(0.5), 0.4 + 0.3 * y),
        });
        let paint = drawn(|x, y| Vec3::splat(f32::from((x - 0.4).hypot(y - 0.5) < 0.25)));
        let settings = DistillationSettings {
            guidance: GuidanceKind::Lds,
            timesteps: [[0.5, 0.8]; 2],
            draws: 2,
            crop: None,
            guidance_scale: 7.5,
            prompt: None,
            adapt: false,
            turned: true,
        };
        let light = LightDescription {
            azimuth: 1.1,
            elevation: 0.6,
            sun_share: 0.8,
        };
        let distillation = |light: &LightDescription,
                            photo: &Raster<Vec3>,
                            paint: &Raster<Vec3>| {
            let (photo, paint) = (DisplayImage(photo.clone()), paint.map(|p| p.x));
            let settings = settings.clone();
            Distillation::new(&model, settings, None, "car", Some(light), &photo, &paint).unwrap()
        };
        let gradient = |d: &Distillation<'_>, picture: &Raster<Vec3>, iteration: usize| {
            let step = Step {
                iteration,
                iterations: 10,
                seed: 5,
            };
            d.evaluate(picture, &CropView::whole(), step)
                .unwrap()
                .gradient
        };
        let as_it_is = distillation(&light, &photo, &paint);
        let mut turned = distillation(&light.mirrored(), &mirror(&photo), &mirror(&paint));
        turned.mirrored = None;
        let found = gradient(&as_it_is, &picture, 1);
        assert_eq!(found, mirror(&gradient(&turned, &mirror(&picture), 1)));
        assert_ne!(found, mirror(&found));
        // An even one sees the picture itself.
        let mut only = distillation(&light, &photo, &paint);
        only.mirrored = None;
        let plain = gradient(&only, &picture, 2);
        assert_eq!(gradient(&as_it_is, &picture, 2), plain);
        assert_ne!(
            gradient(&as_it_is, &picture, 1),
            gradient(&only, &picture, 1)
        );
    }
}
