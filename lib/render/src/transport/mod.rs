//! Light transport, recorded once and replayed under any environment.
//!
//! With camera, geometry and materials fixed, the picture of the object is linear in the light,
//! `I = base + T L`, and the shadow ratio on the proxy is `1 - (B L) / (E L)`. [`Transport`]
//! holds the weights, found by path tracing once: for every pixel the texels of a
//! latitude-longitude map that its paths reached and how much of their radiance arrives. A
//! picture under another light is a sparse product (`replay`), and the exact derivative of that
//! picture with respect to every texel is the transposed product.
//!
//! Paths are traced by the very loops that render; only what becomes of the light that they find
//! differs. Directions come from the BSDF and, if one is given, from a light; on a plane from a
//! mixture of that light and uniform ones. So the record is unbiased for every light, and precise
//! for lights like the one in the mixture.
//!
//! What is recorded is what the samples saw: the noise of a record is frozen, the same in every
//! replay. Light that the object sends to the proxy is a third set of rows, `S`, and with what it
//! emits the ratio is `1 - (B L - S L - emitted) / (E L)`.
//!
//! `B` has no colour. What coloured glass lets pass is in `S`; where no light of the object is recorded on the proxy, such
//! glass blocks the luminance of what it takes, in all channels alike.
use std::ops::Range;

use dipir_imaging::raster::Raster;
use dipir_light::environment::solid_angle;
use dipir_light::luminance::luminance;
use dipir_numerics::sum::par_reduce;
use glam::{DVec3, Vec3, Vec4};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

mod file;
mod record;
mod replay;
mod rows;
mod settings;
#[cfg(test)]
mod tests;
mod unit_light;

pub use settings::RecordSettings;

use crate::shadow::LightOnProxy;

use replay::{padded, ratio, ratio_vjp};
use rows::{ColourHalf, ColourSingle, Entry, GreyHalf, GreySingle, Rows};

/// How weights are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 11 bits, each row with its own power of two: 8 bytes an entry of the object, 4 of the
    /// shadow; at most 65536 texels.
    Half,
    /// 24 bits: 16 and 8 bytes an entry, any number of texels.
    Single,
}

/// What catches the shadow.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShadowKind {
    /// Nothing.
    None,
    /// A plane, whose unshadowed light is a sum over texels.
    Plane,
    /// A mesh: the light that arrives is recorded per pixel, over the same samples.
    Mesh,
}

/// What was recorded, and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Columns and rows of the picture.
    pub size: [usize; 2],
    /// Columns and rows of the environment.
    pub environment: [usize; 2],
    /// Paths per pixel.
    pub samples: u32,
    /// Shadow samples per pixel.
    pub shadow_samples: u32,
    /// How weights are stored.
    pub precision: Precision,
    /// What catches the shadow.
    pub shadow: ShadowKind,
    /// Share of a plane's shadow samples that were uniform over the sphere; the others followed
    /// the light.
    pub uniform_share: f32,
    /// Light of the object on the proxy, if it was simulated.
    pub light_on_proxy: Option<LightOnProxy>,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Most interactions of a path with the object.
    pub max_depth: u32,
    /// Bits of [`crate::features`] that were simulated.
    pub features: u32,
    /// What the caller knows the scene by.
    pub scene_hash: String,
}

/// Recorded light transport of one scene.
#[derive(Clone, Debug)]
pub struct Transport {
    header: Header,
    /// Light that does not come from the environment.
    base: Raster<Vec3>,
    coverage: Raster<f32>,
    /// Density per steradian of the light samples of paths, by texel.
    density: Vec<f32>,
    weights: Weights,
}

#[derive(Clone, Debug)]
enum Weights {
    Half(RowSet<ColourHalf, GreyHalf>),
    Single(RowSet<ColourSingle, GreySingle>),
}

#[derive(Clone, Debug)]
struct RowSet<C, G> {
    object: Rows<C>,
    shadow: Shadow<G>,
    sent: Option<Sent<C>>,
}

/// Light that the object sends to the proxy.
#[derive(Clone, Debug)]
struct Sent<C> {
    /// Irradiance by texel of the environment.
    rows: Rows<C>,
    /// Irradiance of every pixel that does not come from the environment.
    base: Vec<Vec3>,
}

#[derive(Clone, Debug)]
enum Shadow<G> {
    None,
    Plane {
        blocked: Rows<G>,
        /// Integral of the cosine to the plane's normal over each texel.
        cosine: Vec<f32>,
    },
    Mesh {
        blocked: Rows<G>,
        arriving: Rows<G>,
        /// Share of each pixel that shows the proxy.
        share: Vec<f32>,
    },
}

/// Evaluates `$body` with `$set` bound to the rows of `$weights`, whatever their precision.
macro_rules! with_rows {
    ($weights:expr, $set:ident => $body:expr) => {
        match $weights {
            $crate::transport::Weights::Half($set) => $body,
            $crate::transport::Weights::Single($set) => $body,
        }
    };
}
use with_rows;

impl Transport {
    /// What was recorded, and how.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Columns and rows of the picture.
    pub fn size(&self) -> [usize; 2] {
        self.header.size
    }

    /// Columns and rows of the environments that it takes.
    pub fn environment_size(&self) -> [usize; 2] {
        self.header.environment
    }

    /// Antialiased coverage of the object.
    pub fn coverage(&self) -> &Raster<f32> {
        &self.coverage
    }

    /// Premultiplied radiance of the object under no light: emission, surfaces without lighting,
    /// and reflections of the photograph.
    pub fn base(&self) -> &Raster<Vec3> {
        &self.base
    }

    /// Weights of the object and of the shadow, light of the object on the proxy included.
    pub fn entries(&self) -> (usize, usize) {
        with_rows!(&self.weights, w => {
            let sent = w.sent.as_ref().map_or(0, |s| s.rows.entries.len());
            (w.object.entries.len(), w.shadow.entries() + sent)
        })
    }

    /// Bytes of weights that the products of the object and of the shadow read, each.
    pub fn bytes(&self) -> (usize, usize) {
        with_rows!(&self.weights, w => {
            let sent = w.sent.as_ref();
            let sent = sent.map_or(0, |s| s.rows.bytes() + size_of_val(&s.base[..]));
            (w.object.bytes(), w.shadow.bytes() + sent)
        })
    }

    /// Premultiplied radiance of the object under `light`: `W * H` texels, row by row from the
    /// top, linear. Panics on another number of texels.
    pub fn foreground(&self, light: &[Vec3]) -> Raster<Vec3> {
        let light = self.checked(light);
        let base = self.base.pixels();
        let lit = |p: usize, sum: Vec4| sum + padded(base[p]);
        let image = with_rows!(&self.weights, w => w.object.product(&light, &lit));
        self.raster(image)
    }

    /// Adjoint of [`foreground`](Self::foreground): the gradient of every texel from that of
    /// every pixel. Pixels whose gradient is 0 cost nothing. Panics on another number of pixels.
    pub fn foreground_vjp(&self, gradient: &[Vec3]) -> Vec<Vec3> {
        self.check_pixels(gradient.len());
        let texels = self.texels();
        with_rows!(&self.weights, w => w.object.product_vjp(texels, &|p| padded(gradient[p])))
    }

    /// Ratio of the light that reaches the proxy with the object to that without it, per channel. It
    /// is at least 0, at most 1 unless the object sends light there, and 1 where there is no proxy or
    /// no light arrives. Panics if `light` has not as many texels as
    /// [`environment_size`](Self::environment_size) says.
    pub fn shadow(&self, light: &[Vec3]) -> Raster<Vec3> {
        let light = self.checked(light);
        let pixels = self.pixels();
        let ratios = with_rows!(&self.weights, w => {
            w.shadow.ratios(&light, pixels, w.sent.as_ref().map(|s| s.arriving(&light)))
        });
        self.raster(ratios)
    }

    /// Adjoint of [`shadow`](Self::shadow), whose result under the same `light` is `ratio`: the
    /// gradient of every texel from that of every ratio.
    pub fn shadow_vjp(&self, light: &[Vec3], ratio: &Raster<Vec3>, gradient: &[Vec3]) -> Vec<Vec3> {
        self.check_pixels(gradient.len());
        self.check_pixels(ratio.pixels().len());
        let light = self.checked(light);
        with_rows!(&self.weights, w => {
            w.shadow.ratios_vjp(&light, ratio.pixels(), gradient, w.sent.as_ref())
        })
    }

    /// Kish's effective number of samples behind every pixel of the object under `light`: few
    /// where the picture hangs on few texels that were reached by few paths. Samples that a record
    /// lacks altogether do not show here, but in [`light_sample_size`](Self::light_sample_size).
    pub fn effective_sample_size(&self, light: &[Vec3]) -> Raster<f32> {
        let light = self.checked(light);
        let sizes = with_rows!(&self.weights, w => w.object.effective_sample_size(&light));
        let [width, height] = self.size();
        Raster::from_pixels(width, height, sizes)
    }

    /// What the recorded samples of a pixel are worth under `light`, as a number of samples drawn
    /// for it: `samples / sum(p^2 / q)` over texels, `p` being the share of the light in a
    /// texel and `q` the recorded samples' chance to reach it, from the light that was in the
    /// mixture and from a diffuse BSDF of any orientation. Falls when the light has grown a peak
    /// that the record samples badly: the sign to record again with the light in the mixture.
    pub fn light_sample_size(&self, light: &[Vec3]) -> f64 {
        let light = self.checked(light);
        let [width, height] = self.environment_size();
        let (mut sum, mut squares) = (0.0, 0.0);
        for (t, texel) in light.iter().enumerate() {
            let size = solid_angle(width, height, t / width);
            let power = f64::from(luminance(texel.truncate())) * size;
            let density = f64::from(self.density[t]) + 0.25 / std::f64::consts::PI;
            sum += power;
            squares += power * power / (density * size);
        }
        let samples = f64::from(self.header.samples);
        if squares > 0.0 {
            samples * sum * sum / squares
        } else {
            samples
        }
    }

    fn pixels(&self) -> usize {
        self.header.size[0] * self.header.size[1]
    }

    fn texels(&self) -> usize {
        self.header.environment[0] * self.header.environment[1]
    }

    fn raster(&self, pixels: Vec<Vec3>) -> Raster<Vec3> {
        Raster::from_pixels(self.header.size[0], self.header.size[1], pixels)
    }

    fn checked(&self, light: &[Vec3]) -> Vec<Vec4> {
        let [width, height] = self.header.environment;
        assert_eq!(
            light.len(),
            width * height,
            "the transport was recorded for {width} x {height} texels"
        );
        light.iter().copied().map(padded).collect()
    }

    fn check_pixels(&self, found: usize) {
        let [width, height] = self.header.size;
        assert_eq!(
            found,
            width * height,
            "the transport was recorded for {width} x {height} pixels"
        );
    }
}

/// Pixels whose gradients are summed as one task; a constant, because it fixes the rounding.
const PIXELS_PER_SUM: usize = 1 << 13;

impl<C: Entry> Sent<C> {
    /// Irradiance of every pixel under `light`.
    fn arriving(&self, light: &[Vec4]) -> Vec<Vec3> {
        self.rows
            .product(light, &|p, sum| sum + padded(self.base[p]))
    }
}

impl<G: Entry> Shadow<G> {
    fn entries(&self) -> usize {
        match self {
            Shadow::None => 0,
            Shadow::Plane { blocked, .. } => blocked.entries.len(),
            Shadow::Mesh {
                blocked, arriving, ..
            } => blocked.entries.len() + arriving.entries.len(),
        }
    }

    fn bytes(&self) -> usize {
        match self {
            Shadow::None => 0,
            Shadow::Plane { blocked, cosine } => blocked.bytes() + size_of_val(&cosine[..]),
            Shadow::Mesh {
                blocked,
                arriving,
                share,
            } => blocked.bytes() + arriving.bytes() + size_of_val(&share[..]),
        }
    }

    /// The ratios of all pixels; `sent` is the irradiance that the object sends to each.
    fn ratios(&self, light: &[Vec4], pixels: usize, sent: Option<Vec<Vec3>>) -> Vec<Vec3> {
        let missing = |p: usize, blocked: Vec4| match &sent {
            Some(sent) => blocked - padded(sent[p]),
            None => blocked,
        };
        match self {
            Shadow::None => vec![Vec3::ONE; pixels],
            Shadow::Plane { blocked, cosine } => {
                let arriving = irradiance(cosine, light);
                blocked.product(light, &|p, b| ratio(missing(p, b), arriving, 1.0))
            }
            Shadow::Mesh {
                blocked,
                arriving,
                share,
            } => {
                let arriving = arriving.product(light, &|_, a| a);
                blocked.product(light, &|p, b| {
                    ratio(missing(p, b), padded(arriving[p]), share[p])
                })
            }
        }
    }

    fn ratios_vjp<C: Entry>(
        &self,
        light: &[Vec4],
        ratios: &[Vec3],
        gradient: &[Vec3],
        sent: Option<&Sent<C>>,
    ) -> Vec<Vec3> {
        // What is sent is missing less.
        let add_sent = |sums: &mut [Vec3], missing: &(dyn Fn(usize) -> Vec4 + Sync)| {
            if let Some(sent) = sent {
                let more = sent.rows.product_vjp(light.len(), &|p| -missing(p));
                sums.iter_mut().zip(more).for_each(|(sum, m)| *sum += m);
            }
        };
        match self {
            Shadow::None => vec![Vec3::ZERO; light.len()],
            Shadow::Plane { blocked, cosine } => {
                let arriving = irradiance(cosine, light);
                let at = |p| ratio_vjp(padded(ratios[p]), arriving, 1.0, padded(gradient[p]));
                let mut sums = blocked.product_vjp(light.len(), &|p| at(p).0);
                // The irradiance is one number for all pixels.
                let at_arriving = |p| at(p).1.truncate().as_dvec3();
                let sum = |pixels: Range<usize>| pixels.map(at_arriving).sum::<DVec3>();
                let total = par_reduce(ratios.len(), PIXELS_PER_SUM, sum, |a, b| a + b);
                let total = total.unwrap_or(DVec3::ZERO).as_vec3();
                sums.iter_mut()
                    .zip(cosine)
                    .for_each(|(sum, &e)| *sum += total * e);
                add_sent(&mut sums, &|p| at(p).0);
                sums
            }
            Shadow::Mesh {
                blocked,
                arriving,
                share,
            } => {
                let light_there = arriving.product(light, &|_, a| a);
                let at = |p: usize| {
                    let [ratio, light, gradient] = [ratios[p], light_there[p], gradient[p]];
                    ratio_vjp(padded(ratio), padded(light), share[p], padded(gradient))
                };
                let mut sums = blocked.product_vjp(light.len(), &|p| at(p).0);
                let others = arriving.product_vjp(light.len(), &|p| at(p).1);
                sums.iter_mut()
                    .zip(others)
                    .for_each(|(sum, other)| *sum += other);
                add_sent(&mut sums, &|p| at(p).0);
                sums
            }
        }
    }
}

/// `E L` of a plane, summed in f64.
fn irradiance(cosine: &[f32], light: &[Vec4]) -> Vec4 {
    let terms = cosine.iter().zip(light);
    let sum: DVec3 = terms
        .map(|(&e, l)| l.truncate().as_dvec3() * f64::from(e))
        .sum();
    padded(sum.as_vec3())
}
