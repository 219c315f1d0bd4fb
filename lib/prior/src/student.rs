//! The model while it is trained: networks whose weights are variables, and
//! the loss of a batch of examples.

use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor, Var};
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::parameters::Parameters;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::schedule::NoiseSchedule;
use dipir_diffusion::text_encoder::{LearnedTokens, TextEncoder};
use dipir_diffusion::tokenizer::Tokenizer;
use dipir_diffusion::unet::UNet;
use dipir_diffusion::vae::pixel_unshuffle;

use crate::blueprint::{Blueprint, FACTOR, SCALING};
use crate::error::{Error, Result};
use crate::examples::{Example, Rival, SIZE};
use crate::naming::NamingHead;
use crate::words::{CLOCK, Caption, HEIGHTS, LightWords, PLACEHOLDERS, SKIES};

/// Networks and variables.
#[derive(Debug)]
pub struct Student {
    unet: UNet,
    text: TextEncoder,
    tokenizer: Tokenizer,
    schedule: NoiseSchedule,
    naming: Option<NamingHead>,
    variables: BTreeMap<String, Var>,
}

/// Losses of a batch, scalars in the graph.
pub struct Losses {
    /// Weighted mean squared error of the velocity, that under rivals of which there are pictures included.
    pub velocity: Tensor,
    /// Share of the surprise at the right caption among its rivals; `None` where no example has rivals.
    pub surprise: Option<Tensor>,
    /// Mean squared error of the direction of the sun that is seen, as the middle of the UNet tells it;
    /// `None` where it is not asked.
    pub naming: Option<Tensor>,
}

/// Captions as the text encoder takes them.
pub struct Spoken {
    tokens: Vec<Vec<u32>>,
    /// [mixtures of all captions, vocab_size]
    mixing: Option<Tensor>,
}

/// Nats for the mean squared error of the noise over a picture: as many as made the surprise of one draw of noise
/// least, before lights were contrasted (300; half the number of latent values, 1,500, is too sure of itself by far).
const NATS: f64 = 400.0;

/// Registers the placeholders of [`Caption`] with a tokenizer.
pub fn add_placeholders(tokenizer: &mut Tokenizer) {
    let first = tokenizer.vocab_size() as u32;
    for (i, word) in PLACEHOLDERS.iter().enumerate() {
        tokenizer.add_placeholder(word, first + i as u32);
    }
}

impl Spoken {
    /// Tokens of `captions` and the mixtures of embeddings in them. The
    /// tokenizer knows the placeholders.
    pub fn new(tokenizer: &Tokenizer, captions: &[Option<Caption>]) -> Result<Self> {
        let vocab = tokenizer.vocab_size();
        let mut rows: Vec<f32> = vec![];
        let mut tokens = vec![];
        for caption in captions {
            let Some(caption) = caption else {
                tokens.push(tokenizer.encode("")?);
                continue;
            };
            let shift = (rows.len() / vocab) as u32;
            for mixture in &caption.mixtures {
                let start = rows.len();
                rows.resize(start + vocab, 0.0);
                for (word, weight) in mixture {
                    let ids = tokenizer.words(word)?;
                    let [id] = ids[..] else {
                        return Err(Error::Argument(format!(
                            "the model's tokenizer does not know {word:?} as one word; light words need the model of data/prior or one trained by dipir-pretrain"
                        )));
                    };
                    rows[start + id as usize] += weight;
                }
            }
            let ids = tokenizer.encode(&caption.text)?;
            let moved = ids
                .iter()
                .map(|&t| if t as usize >= vocab { t + shift } else { t });
            tokens.push(moved.collect());
        }
        let count = rows.len() / vocab;
        let mixing = (count > 0)
            .then(|| Tensor::from_vec(rows, (count, vocab), &Device::Cpu))
            .transpose()?;
        Ok(Self { tokens, mixing })
    }

    /// States [captions, tokens, width].
    pub fn states(&self, text: &TextEncoder) -> Result<Tensor> {
        let learned = self
            .mixing
            .as_ref()
            .map(|m| -> Result<_> {
                Ok(LearnedTokens {
                    embeddings: m.matmul(text.table())?,
                })
            })
            .transpose()?;
        Ok(text.forward(&self.tokens, learned.as_ref())?)
    }
}

/// A batch as tensors.
pub struct Batch {
    /// Latents of the pictures, [batch, c, h, w].
    pub latents: Tensor,
    /// Latents that noise is put on: the same, or the picture under another light.
    pub seen: Tensor,
    /// Whether they differ.
    pub relit: Vec<bool>,
    /// Mask and masked latents, [batch, 1 + c, h, w].
    pub condition: Tensor,
    /// Weights of latent values.
    pub weights: Tensor,
    /// What is said.
    pub captions: Vec<Option<Caption>>,
    /// The lights that the objects are seen under.
    pub lights: Vec<LightWords>,
    /// Other lights, as many for each of the first examples; the others have none.
    pub rivals: Vec<Vec<Rival>>,
}

/// Scaled latents of pictures in [0, 1], each [3, SIZE, SIZE].
pub fn latents_of(pictures: Vec<f32>) -> Result<Tensor> {
    let count = pictures.len() / (3 * SIZE * SIZE);
    let x = Tensor::from_vec(pictures, (count, 3, SIZE, SIZE), &Device::Cpu)?;
    let x = x.affine(2.0, -1.0)?;
    Ok((pixel_unshuffle(&x, FACTOR)? * SCALING)?)
}

/// Mask and masked latents, [batch, 1 + c, h, w], from pictures in [0, 1]
/// and masks.
pub fn condition_of(shown: Vec<f32>, masks: &[Vec<f32>]) -> Result<Tensor> {
    let mut blanked = shown;
    let pixels = SIZE * SIZE;
    for (i, v) in blanked.iter_mut().enumerate() {
        let (item, pixel) = (i / (3 * pixels), i % pixels);
        if masks[item][pixel] >= 0.5 {
            *v = 0.5;
        }
    }
    let side = SIZE / FACTOR;
    // A latent pixel is masked as its top left pixel is.
    let small: Vec<f32> = masks
        .iter()
        .flat_map(|m| {
            (0..side * side).map(|i| {
                let (x, y) = (i % side * FACTOR, i / side * FACTOR);
                f32::from(m[y * SIZE + x] >= 0.5)
            })
        })
        .collect();
    let mask = Tensor::from_vec(small, (masks.len(), 1, side, side), &Device::Cpu)?;
    Ok(Tensor::cat(&[&mask, &latents_of(blanked)?], 1)?)
}

impl Batch {
    /// Puts examples together, those with rivals first. All that have rivals have as many.
    pub fn new(mut examples: Vec<Example>) -> Result<Self> {
        examples.sort_by_key(|e| e.rivals.is_empty());
        let weights: Vec<f32> = examples
            .iter()
            .flat_map(|e| e.weight.iter().copied())
            .collect();
        let weights = Tensor::from_vec(weights, (examples.len(), 1, SIZE, SIZE), &Device::Cpu)?;
        let weights = pixel_unshuffle(&weights, FACTOR)?;
        let masks: Vec<Vec<f32>> = examples.iter().map(|e| e.mask.clone()).collect();
        let shown = examples
            .iter()
            .flat_map(|e| e.shown.iter().copied())
            .collect();
        let pictures = |of: fn(&Example) -> &Vec<f32>| {
            latents_of(
                examples
                    .iter()
                    .flat_map(|e| of(e).iter().copied())
                    .collect(),
            )
        };
        Ok(Self {
            latents: pictures(|e| &e.image)?,
            seen: pictures(|e| e.seen.as_ref().unwrap_or(&e.image))?,
            relit: examples.iter().map(|e| e.seen.is_some()).collect(),
            condition: condition_of(shown, &masks)?,
            weights: Tensor::cat(&[&weights, &weights, &weights], 1)?,
            rivals: examples
                .iter_mut()
                .map(|e| std::mem::take(&mut e.rivals))
                .take_while(|r| !r.is_empty())
                .collect(),
            lights: examples.iter().map(|e| e.light).collect(),
            captions: examples.into_iter().map(|e| e.caption).collect(),
        })
    }
}

/// Weighted squared errors of rows, [rows].
fn errors(output: &Tensor, target: &Tensor, weights: &Tensor) -> Result<Tensor> {
    let error = ((output - target)?.sqr()? * weights)?;
    Ok(error.flatten_from(1)?.sum(1)?)
}

/// Timesteps of training: one in four anywhere, the others where light is
/// recognised.
pub fn draw_timestep(steps: usize, stream: &mut NoiseStream) -> usize {
    let share = if stream.uniform() < 0.25 {
        0.01 + 0.98 * stream.uniform()
    } else {
        0.37 + 0.6 * stream.uniform()
    };
    ((share * steps as f64) as usize).min(steps - 1)
}

impl Student {
    /// Fresh networks; `folder` holds the configurations and the tokenizer.
    pub fn new(blueprint: &Blueprint, folder: &std::path::Path, seed: u64) -> Result<Self> {
        let mut tokenizer = Tokenizer::load(&folder.join("tokenizer"))?;
        let vocab = tokenizer.vocab_size();
        add_placeholders(&mut tokenizer);
        let text = TextEncoder::new(
            blueprint.text(vocab),
            Parameters::random(seed, &Device::Cpu),
        )?;
        let unet = UNet::new(
            blueprint.unet(),
            Parameters::random(seed ^ 0xa11, &Device::Cpu),
        )?;
        let name = |prefix: &str, v: &BTreeMap<String, Var>| -> Vec<(String, Var)> {
            v.iter()
                .map(|(n, v)| (format!("{prefix}{n}"), v.clone()))
                .collect()
        };
        let mut variables: BTreeMap<_, _> = name("unet.", unet.variables()).into_iter().collect();
        variables.extend(name("text.", text.variables()));
        let student = Self {
            unet,
            text,
            tokenizer,
            schedule: NoiseSchedule::new(blueprint.schedule())?,
            naming: None,
            variables,
        };
        student.prepare()?;
        Ok(student)
    }

    /// The same with a head that names the light that is seen; its variables are named "naming." and belong to no model.
    pub fn with_naming(mut self, seed: u64) -> Result<Self> {
        let config = self.unet.config();
        let side = config.sample_size >> (config.levels() - 1);
        let channels = config.block_out_channels[config.levels() - 1];
        let head = NamingHead::new(channels * side * side, seed ^ 0x4ead)?;
        let variables = head.variables().iter();
        self.variables
            .extend(variables.map(|(n, v)| (format!("naming.{n}"), v.clone())));
        self.naming = Some(head);
        Ok(self)
    }

    /// Residual branches start at nothing, words of one scale in its order.
    fn prepare(&self) -> Result<()> {
        for (name, variable) in &self.variables {
            let ends = [
                ".conv2.weight",
                ".conv2.bias",
                ".proj_out.weight",
                ".proj_out.bias",
            ];
            if ends.iter().any(|e| name.ends_with(e)) || name.starts_with("unet.conv_out.") {
                variable.set(&variable.zeros_like()?)?;
            }
        }
        let name = "text.text_model.embeddings.token_embedding.weight";
        let Some(table) = self.variables.get(name) else {
            return Err(Error::Argument(format!("the text encoder has no {name}")));
        };
        let width = table.dims()[1];
        let mut rows = table.to_vec2::<f32>()?;
        let scale = 0.15;
        let mut place = |word: &str, at: usize, values: &[f32]| -> Result<()> {
            if let [id] = self.tokenizer.words(word)?[..] {
                for (i, v) in values.iter().enumerate() {
                    if at + i < width {
                        rows[id as usize][at + i] += scale * v;
                    }
                }
            }
            Ok(())
        };
        for (hour, word) in CLOCK.iter().enumerate() {
            let a = hour as f32 / 12.0 * std::f32::consts::TAU;
            let harmonics = [a.cos(), a.sin(), (2.0 * a).cos(), (2.0 * a).sin()];
            place(word, 0, &harmonics)?;
        }
        for (scale, at) in [(HEIGHTS, 4), (SKIES, 6)] {
            for (i, (word, _)) in scale.iter().enumerate() {
                let x = i as f32 - 1.0;
                place(word, at, &[x, x * x - 0.5])?;
            }
        }
        table.set(&Tensor::new(rows, &Device::Cpu)?)?;
        Ok(())
    }

    /// Everything that is trained, by name.
    pub fn variables(&self) -> &BTreeMap<String, Var> {
        &self.variables
    }

    /// The losses of a batch under noise from `stream`.
    pub fn loss(&self, batch: &Batch, stream: &mut NoiseStream) -> Result<Losses> {
        let count = batch.latents.dims()[0];
        let steps = self.schedule.len();
        let contrasted = batch.rivals.len();
        let timesteps: Vec<usize> = (0..count)
            .map(|i| match i < contrasted || batch.relit[i] {
                true => ((0.4 + 0.5 * stream.uniform()) * steps as f64) as usize,
                false => draw_timestep(steps, stream),
            })
            .collect();
        let noise = stream.normal_tensor(batch.latents.dims(), DType::F32, &Device::Cpu)?;
        let noisy = self
            .schedule
            .add_noise_each(&batch.seen, &noise, &timesteps)?;
        // From what is seen to the light that is said, the rest of the noise as it is.
        let noise = self
            .schedule
            .noise_between_each(&batch.latents, &noisy, &timesteps)?;
        let target = self.schedule.target(&batch.latents, &noise, &timesteps)?;
        let input = Tensor::cat(&[&noisy, &batch.condition], 1)?;
        // A row for every caption: the right ones, then the rivals of each.
        let rivals: Vec<&Rival> = batch.rivals.iter().flatten().collect();
        let rows: Vec<u32> = (0..count as u32)
            .chain((0..contrasted).flat_map(|i| vec![i as u32; batch.rivals[i].len()]))
            .collect();
        let captions: Vec<Option<Caption>> = batch
            .captions
            .iter()
            .cloned()
            .chain(rivals.iter().map(|r| Some(r.caption.clone())))
            .collect();
        let t: Vec<f64> = rows.iter().map(|&i| timesteps[i as usize] as f64).collect();
        let index = Tensor::new(rows.as_slice(), &Device::Cpu)?;
        let of_rows = |t: &Tensor| t.index_select(&index, 0);
        let context = Spoken::new(&self.tokenizer, &captions)?.states(&self.text)?;
        let (output, middle) =
            self.unet
                .forward_and_middle(&of_rows(&input)?, &t, &context, &Pass::default())?;
        let naming = self.naming.as_ref().map(|head| {
            let lights: Vec<_> = rows.iter().map(|&i| batch.lights[i as usize]).collect();
            head.loss(&middle, &lights)
        });
        let naming = naming.transpose()?;
        let weights = of_rows(&batch.weights)?;
        let error = errors(&output, &of_rows(&target)?, &weights)?;
        let mut sum = error.narrow(0, 0, count)?.sum_all()?;
        let mut total = batch.weights.sum_all()?;
        // Rows of the rivals whose pictures are asked for, too.
        let asked: Vec<usize> = (0..rivals.len())
            .filter(|&i| rivals[i].image.is_some())
            .map(|i| count + i)
            .collect();
        if !asked.is_empty() {
            let index: Vec<u32> = asked.iter().map(|&row| row as u32).collect();
            let index = Tensor::new(index, &Device::Cpu)?;
            let of_asked = |t: &Tensor| t.index_select(&index, 0);
            let at: Vec<usize> = asked
                .iter()
                .map(|&row| timesteps[rows[row] as usize])
                .collect();
            let pictures = rivals.iter().filter_map(|r| r.image.as_ref()).flatten();
            let latents = latents_of(pictures.copied().collect())?;
            let noisy = of_asked(&of_rows(&noisy)?)?;
            let noise = self.schedule.noise_between_each(&latents, &noisy, &at)?;
            let target = self.schedule.target(&latents, &noise, &at)?;
            let weights = of_asked(&weights)?;
            sum = (sum + errors(&of_asked(&output)?, &target, &weights)?.sum_all()?)?;
            total = (total + weights.sum_all()?)?;
        }
        let velocity = sum.div(&total)?;
        if contrasted == 0 {
            return Ok(Losses {
                velocity,
                surprise: None,
                naming,
            });
        }
        // The mean error of the noise, as it is compared where light is read.
        let weights = batch.weights.flatten_from(1)?.sum(1)?;
        let weights = weights.narrow(0, 0, contrasted)?.to_vec1::<f32>()?;
        let scales: Vec<f32> = (0..contrasted)
            .map(|i| {
                let alpha = self.schedule.alpha_bar(timesteps[i])?;
                Ok((NATS * alpha) as f32 / weights[i])
            })
            .collect::<Result<_>>()?;
        let scales = Tensor::from_vec(scales, (contrasted, 1), &Device::Cpu)?;
        let right = error.narrow(0, 0, contrasted)?.unsqueeze(1)?;
        let wrong = error.narrow(0, count, rows.len() - count)?;
        let wrong = wrong.reshape((contrasted, ()))?;
        let nats = (Tensor::cat(&[&right, &wrong], 1)?.broadcast_mul(&scales)?).neg()?;
        let surprise = (nats.log_sum_exp(1)? - nats.narrow(1, 0, 1)?.squeeze(1)?)?;
        let even = (1.0 + (rows.len() - count) as f64 / contrasted as f64).ln();
        Ok(Losses {
            velocity,
            surprise: Some((surprise.mean_all()? / even)?),
            naming,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn light(azimuth: f32) -> LightWords {
        LightWords {
            azimuth,
            elevation: 0.5,
            sun_share: 0.8,
        }
    }

    fn caption(azimuth: f32) -> Option<Caption> {
        Some(Caption::new("red car", Some(&light(azimuth))))
    }

    fn rival(azimuth: f32, image: Option<Vec<f32>>) -> Rival {
        Rival {
            caption: caption(azimuth).expect("a caption"),
            image,
        }
    }

    fn small() -> Student {
        let folder = tempfile::tempdir().expect("a folder");
        let blueprint = Blueprint {
            channels: vec![8, 16],
            layers: 1,
            text_width: 16,
        };
        blueprint.write_configs(folder.path()).expect("written");
        Student::new(&blueprint, folder.path(), 1).expect("built")
    }

    #[test]
    fn a_model_that_knows_nothing_is_as_surprised_as_chance() {
        let student = small();
        let example = |value: f32, rivals: usize| Example {
            image: vec![value; 3 * SIZE * SIZE],
            seen: None,
            shown: vec![0.5; 3 * SIZE * SIZE],
            mask: vec![1.0; SIZE * SIZE],
            weight: vec![0.5 + value; SIZE * SIZE],
            caption: caption(0.3),
            light: light(0.3),
            rivals: (1..=rivals).map(|k| rival(0.3 + k as f32, None)).collect(),
        };
        let loss = |examples: Vec<Example>| {
            let batch = Batch::new(examples).expect("a batch");
            let mut stream = NoiseStream::new(3, 3);
            let losses = student.loss(&batch, &mut stream).expect("a loss");
            let value = |t: Tensor| t.to_scalar::<f32>().expect("a value");
            (value(losses.velocity), losses.surprise.map(value))
        };
        // Its output is 0 whatever is said, so all captions are as likely.
        let (mixed, surprise) = loss(vec![example(0.2, 0), example(0.7, 3), example(0.4, 3)]);
        let surprise = surprise.expect("rivals");
        assert!((surprise - 1.0).abs() < 1e-5, "{surprise}");
        // Rivals leave the first loss alone; without them there is no second.
        let (fewer, _) = loss(vec![example(0.2, 0), example(0.7, 1), example(0.4, 1)]);
        assert_eq!(mixed, fewer);
        assert!(loss(vec![example(0.7, 0), example(0.4, 0)]).1.is_none());

        // One that is to be painted as what is seen is asks for the same, one that is not for more.
        let painted = |value: f32| Example {
            rivals: vec![rival(1.3, Some(vec![value; 3 * SIZE * SIZE]))],
            ..example(0.7, 0)
        };
        let alone = loss(vec![example(0.7, 1)]).0;
        let (same, other) = (loss(vec![painted(0.7)]), loss(vec![painted(0.2)]));
        assert!((same.0 / alone - 1.0).abs() < 1e-5, "{same:?} {alone}");
        assert!(other.0 > 1.02 * alone, "{other:?} {alone}");
        // What is told apart is the noise of what is seen.
        assert!((other.1.expect("a rival") - 1.0).abs() < 1e-5, "{other:?}");

        // Once it says something: rows meet their own picture, for rivals that say the same as the
        // right caption are as likely again; others are not.
        for (name, variable) in student.variables() {
            if name.starts_with("unet.conv_out.") || name.ends_with(".proj_out.weight") {
                let mut noise = NoiseStream::new(9, variable.elem_count() as u64);
                let values = noise.normal_tensor(variable.dims(), DType::F32, &Device::Cpu);
                let small = (values.expect("noise") * 0.1).expect("noise");
                variable.set(&small).expect("set");
            }
        }
        let same = |value: f32| Example {
            rivals: vec![rival(0.3, None); 3],
            ..example(value, 0)
        };
        let surprise = loss(vec![same(0.7), same(0.4)]).1.expect("rivals");
        // Errors of about 1 in f32, times 400 nats; others differ by several times as much.
        assert!((surprise - 1.0).abs() < 1e-3, "{surprise}");
        let surprise = loss(vec![example(0.7, 3), example(0.4, 3)]).1;
        let surprise = surprise.expect("rivals");
        assert!((surprise - 1.0).abs() > 4e-3, "{surprise}");
    }

    #[test]
    fn the_light_that_is_seen_is_named_whatever_is_said() {
        let student = small();
        let unet_alone = student.variables().len();
        let student = student.with_naming(4).expect("built");
        assert_eq!(student.variables().len(), unet_alone + 4);
        // A head that answers 0 errs by the length of what is asked for, in rows that have a sun.
        for (name, variable) in student.variables() {
            if name.starts_with("naming.out.") {
                let nothing = variable.zeros_like().expect("zeros");
                variable.set(&nothing).expect("set");
            }
        }
        let seen = |light: LightWords| Example {
            image: vec![0.4; 3 * SIZE * SIZE],
            seen: None,
            shown: vec![0.5; 3 * SIZE * SIZE],
            mask: vec![1.0; SIZE * SIZE],
            weight: vec![1.0; SIZE * SIZE],
            caption: caption(2.0),
            light,
            rivals: vec![],
        };
        let overcast = LightWords {
            sun_share: 0.0,
            ..light(0.0)
        };
        let high = LightWords {
            elevation: 1.25,
            ..light(0.0)
        };
        let naming = |examples: Vec<Example>| {
            let batch = Batch::new(examples).expect("a batch");
            let losses = student.loss(&batch, &mut NoiseStream::new(3, 3));
            let naming = losses.expect("a loss").naming.expect("a head");
            naming.to_scalar::<f32>().expect("a value")
        };
        for (lights, expected) in [
            (vec![light(1.0)], 1.0 + 0.25f32.powi(2)),
            (vec![light(1.0), overcast], 1.0 + 0.25f32.powi(2)),
            (vec![high, light(3.0)], 1.0 + 0.5 * (0.25 + 0.0625)),
            (vec![overcast], 0.0),
        ] {
            let found = naming(lights.into_iter().map(seen).collect());
            assert!((found - expected).abs() < 1e-5, "{found} {expected}");
        }
    }

    #[test]
    fn what_is_seen_under_another_light_is_asked_for_under_the_one_that_is_said() {
        let student = small();
        let flat = |value: f32| vec![value; 3 * SIZE * SIZE];
        let example = Example {
            image: flat(0.2),
            seen: Some(flat(0.7)),
            shown: flat(0.5),
            mask: vec![1.0; SIZE * SIZE],
            weight: vec![1.0; SIZE * SIZE],
            caption: caption(0.3),
            light: light(0.3),
            rivals: vec![],
        };
        let batch = Batch::new(vec![example]).expect("a batch");
        let latent = |t: &Tensor| {
            t.mean_all()
                .expect("mean")
                .to_scalar::<f32>()
                .expect("value")
        };
        let [asked, seen] = [&batch.latents, &batch.seen].map(|t| f64::from(latent(t)));
        for seed in 0..4 {
            let losses = student
                .loss(&batch, &mut NoiseStream::new(3, seed))
                .expect("a loss");
            // It answers 0, so the loss is the mean square of what is asked for: of signal e + (signal^2 seen - asked) / noise.
            let t = (0.4 + 0.5 * NoiseStream::new(3, seed).uniform()) * 1000.0;
            let (signal, noise) = student
                .schedule
                .signal_and_noise(t as usize)
                .expect("in range");
            let mean = (signal * signal * seen - asked) / noise;
            let expected = signal * signal + mean * mean;
            let found = f64::from(losses.velocity.to_scalar::<f32>().expect("a value"));
            // Means over 3,072 normal numbers: .018 of e, .026 of its square.
            let tolerance = 4.0 * (0.026 * signal * signal + 2.0 * 0.018 * signal * mean.abs());
            assert!((found - expected).abs() < tolerance, "{found} {expected}");
        }
    }

    #[test]
    fn captions_carry_each_number_of_the_light() {
        let folder = tempfile::tempdir().expect("a folder");
        let blueprint = Blueprint::default();
        blueprint.write_configs(folder.path()).expect("written");
        let student = Student::new(&blueprint, folder.path(), 1).expect("built");
        let spoken = |captions: &[Option<Caption>]| {
            let spoken = Spoken::new(&student.tokenizer, captions).expect("tokens");
            let vocab = student.tokenizer.vocab_size() as u32;
            let mixed = spoken
                .tokens
                .iter()
                .flatten()
                .filter(|t| **t >= vocab)
                .count();
            (spoken.states(&student.text).expect("states"), mixed)
        };
        let (states, mixed) = spoken(&[caption(0.1), caption(2.0), None]);
        assert_eq!(mixed, 6, "three places in each of two captions");
        let row = |i: usize| states.get(i).expect("row").flatten_all().expect("flat");
        let apart = |i: usize, j: usize| {
            let d = (row(i) - row(j)).expect("difference");
            d.abs()
                .expect("abs")
                .max_all()
                .expect("max")
                .to_scalar::<f32>()
                .expect("value")
        };
        assert!(apart(0, 1) > 1e-2 && apart(0, 2) > 1e-2);
        // The same caption means the same wherever it stands in a batch.
        let (alone, _) = spoken(&[caption(2.0)]);
        let d = (alone.get(0).expect("row").flatten_all().expect("flat") - row(1)).expect("d");
        assert!(
            d.abs()
                .expect("abs")
                .max_all()
                .expect("max")
                .to_scalar::<f32>()
                .expect("v")
                < 1e-5
        );
    }
}
