//! Whether a model computes on a device what it should, part by part, and how long each part takes there.

mod times;

use candle_core::{DType, Device, Tensor};

pub use times::{Times, TimesSettings, times};

use crate::error::{Error, Result};
use crate::layers::composed;
use crate::model::Model;
use crate::noise::NoiseStream;
use crate::pass::Pass;

/// Longest side of the latents that are compared: composed attention keeps a score for every pair of pixels, and those of
/// 96 x 96 latents would take 9 GB.
const LARGEST: usize = 64;
/// Longest side of the latents of the comparison at a small size.
const SMALL: usize = 16;

/// What a part is compared with.
#[derive(Debug, Clone, Copy)]
pub enum Reference<'a> {
    /// The same model on the CPU in f32.
    Cpu(&'a Model),
    /// The model itself, its layers composed of candle's operations: for a model on the CPU.
    Composed,
}

/// How far a part is from its reference.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Agreement {
    /// What is compared.
    pub part: &'static str,
    /// Side of the image, pixels; tokens for the text encoder.
    pub size: usize,
    /// Largest difference over the largest value.
    pub error: f64,
    /// The error up to which they count as equal.
    pub tolerance: f64,
}

impl Agreement {
    /// Whether the part computes what it should.
    pub fn holds(&self) -> bool {
        self.error <= self.tolerance
    }
}

/// The error that is expected of a precision. f32: sums in another order, ten times the largest of docs/diffusion.md. f16
/// and bf16 have 11 and 8 bits: the largest deviations of the small models in tests/stability.rs, doubled.
fn tolerance(dtype: DType) -> f64 {
    match dtype {
        DType::BF16 => 0.16,
        DType::F16 => 0.02,
        _ => 1e-4,
    }
}

/// Sides of the latents at which a model is compared: a small one, and that of its training as far as [`LARGEST`] allows.
pub fn sizes(model: &Model) -> Vec<usize> {
    let native = model.unet.config().sample_size.min(LARGEST);
    // Every level halves the side.
    let least = 1 << (model.unet.config().levels() - 1);
    let small = SMALL.min(native).max(least);
    match small < native {
        true => vec![small, native],
        false => vec![native],
    }
}

/// Compares every part at latents of `side` x `side`. `progress` is called after each with the number of those done, and
/// returns false to stop, which is an error.
pub fn compare(
    model: &Model,
    reference: Reference,
    side: usize,
    mut progress: impl FnMut(usize) -> bool,
) -> Result<Vec<Agreement>> {
    let mut found = vec![];
    for (done, (part, compute)) in PARTS.iter().enumerate() {
        let got = compute(model, side)?;
        let wanted = match reference {
            Reference::Cpu(other) => compute(other, side)?,
            Reference::Composed => composed(|| compute(model, side))?,
        };
        let size = match *part {
            "text encoder" => model.tokenizer.length(),
            _ => side * model.vae.downscale(),
        };
        found.push(Agreement {
            part,
            size,
            error: relative_error(&got, &wanted)?,
            tolerance: tolerance(model.dtype()),
        });
        if !progress(done + 1) {
            return Err(Error::Argument("the comparison was stopped".into()));
        }
    }
    Ok(found)
}

/// How many parts are compared.
pub const PART_COUNT: usize = PARTS.len();

type Compute = fn(&Model, usize) -> Result<Tensor>;

const PARTS: [(&str, Compute); 5] = [
    ("text encoder", text),
    ("UNet", unet),
    ("VAE encoder", encoder),
    ("VAE encoder's gradient", encoder_gradient),
    ("VAE decoder", decoder),
];

fn relative_error(got: &Tensor, wanted: &Tensor) -> Result<f64> {
    let plain = |t: &Tensor| t.to_device(&Device::Cpu)?.to_dtype(DType::F64);
    let largest = |t: &Tensor| t.abs()?.max_all()?.to_scalar::<f64>();
    let (got, wanted) = (plain(got)?, plain(wanted)?);
    let difference = largest(&(&got - &wanted)?)?;
    let error = difference / largest(&wanted)?.max(f64::MIN_POSITIVE);
    // A maximum passes over what is no number.
    let finite = got.sum_all()?.to_scalar::<f64>()?.is_finite();
    Ok(if finite { error } else { f64::INFINITY })
}

/// Standard normal numbers, the same on every device.
fn normal(model: &Model, stream: u64, shape: &[usize]) -> Result<Tensor> {
    let noise = NoiseStream::new(0xc4ec, stream).normal_tensor(shape, DType::F32, &Device::Cpu)?;
    Ok(noise.to_device(model.device())?.to_dtype(model.dtype())?)
}

fn image(model: &Model, side: usize) -> Result<Tensor> {
    let pixels = side * model.vae.downscale();
    Ok(normal(model, 1, &[1, 3, pixels, pixels])?.tanh()?)
}

fn latents(model: &Model, side: usize) -> Result<Tensor> {
    normal(model, 2, &[1, model.vae.latent_channels(), side, side])
}

fn text(model: &Model, _: usize) -> Result<Tensor> {
    model.encode_prompts(
        &["a photo of a car in the style of sks rendering", ""],
        None,
    )
}

fn unet(model: &Model, side: usize) -> Result<Tensor> {
    let config = model.unet.config();
    let sample = normal(model, 3, &[1, config.in_channels, side, side])?;
    let context = normal(
        model,
        4,
        &[1, model.tokenizer.length(), config.cross_attention_dim],
    )?;
    let t = model.schedule.timestep_at(0.4) as f64;
    let output = model
        .unet
        .forward(&sample, &[t], &context, &Pass::default())?;
    Ok(output.detach())
}

fn encoder(model: &Model, side: usize) -> Result<Tensor> {
    Ok(model.vae.encode(&image(model, side)?)?.detach())
}

fn encoder_gradient(model: &Model, side: usize) -> Result<Tensor> {
    let encoding = model.vae.trace(&image(model, side)?)?;
    let at_latents = normal(model, 5, encoding.latents().dims())?;
    encoding.gradient(&at_latents)
}

fn decoder(model: &Model, side: usize) -> Result<Tensor> {
    Ok(model.vae.decode(&latents(model, side)?)?.detach())
}
