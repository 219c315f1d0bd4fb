//! The camera's tone curve: Reinhard and one monotonic spline for the object, three monotonic
//! splines for the shadow ratio [DiPIR, section 4.1]. All on linear RGB.
use crate::{
    error::ImagingError,
    raster::{LinearImage, Raster},
    spline::{Curve, KNOTS, KnotGradient, Knots, PARAMETERS, SplineParameters},
};
use dipir_numerics::sum::par_reduce;
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// `x / (1 + x)` [Reinhard et al. 2002, eq. 3]: light in `[0, inf)` to `[0, 1)`. Below 0, where no
/// light is, it goes on as the odd function `x / (1 + |x|)`, so that it is smooth and finite.
#[inline]
pub fn reinhard(x: f64) -> f64 {
    x / (1.0 + x.abs())
}

/// Adjoint of [`reinhard`]. The derivative is 1 at 0 and falls as `1 / x^2`.
#[inline]
pub fn reinhard_vjp(x: f64, gradient: f64) -> f64 {
    let d = 1.0 + x.abs();
    gradient / (d * d)
}

/// Unconstrained parameters of the four curves; zero everywhere is the identity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ToneParameters {
    /// Of the object, after Reinhard.
    pub foreground: SplineParameters,
    /// Of the shadow ratio, red, green, blue.
    pub shadow: [SplineParameters; 3],
}

/// Numbers in [`ToneParameters`].
pub const TONE_PARAMETERS: usize = 4 * PARAMETERS;

/// The four curves, as knots: what `tone.json` holds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ToneCurves {
    /// Of the object, after Reinhard, the same for each channel.
    pub foreground: Knots,
    /// Of the shadow ratio, red, green, blue.
    pub shadow: [Knots; 3],
}

/// Gradient of a scalar with respect to [`ToneCurves`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ToneGradient {
    /// With respect to the object's knots.
    pub foreground: KnotGradient,
    /// With respect to the shadow's knots.
    pub shadow: [KnotGradient; 3],
}

impl ToneGradient {
    fn merge(self, other: Self) -> Self {
        let [r, g, b] = self.shadow;
        Self {
            foreground: self.foreground.merge(other.foreground),
            shadow: [
                r.merge(other.shadow[0]),
                g.merge(other.shadow[1]),
                b.merge(other.shadow[2]),
            ],
        }
    }
}

impl ToneParameters {
    /// What a camera makes of light, Reinhard undone: straight in the shadows, half-way between a
    /// clip and a film's roll-off `1 - exp(-x)` in the lights. The start where radiance is known
    /// on the photograph's scale; the shadow is left as it is.
    pub fn camera() -> Self {
        let x = [0.0, 0.2, 0.35, 0.5, 0.65, 1.0];
        // At u = x / (1 + x): the curve, and its slope dy/dx (1 + x)^2.
        let (mut y, mut slopes) = ([0.0; KNOTS], [0.0; KNOTS]);
        for (k, u) in x.into_iter().enumerate() {
            let light = u / f64::max(1.0 - u, 1e-9);
            y[k] = 0.5 * (light.min(1.0) + 1.0 - (-light).exp());
            let below: f64 = if light < 1.0 { 1.0 } else { 0.0 };
            let rise = 0.5 * (below + (-light).exp()) * (1.0 + light).powi(2);
            slopes[k] = rise.clamp(0.1, 3.0);
        }
        Self {
            foreground: SplineParameters::of(&Knots { x, y, slopes }),
            ..Self::default()
        }
    }

    /// The curves.
    pub fn curves(&self) -> ToneCurves {
        ToneCurves {
            foreground: self.foreground.knots(),
            shadow: self.shadow.map(|s| s.knots()),
        }
    }

    /// Gradient with respect to the parameters, given that with respect to the curves.
    pub fn curves_vjp(&self, gradient: &ToneGradient) -> Self {
        let [r, g, b] = &self.shadow;
        Self {
            foreground: self.foreground.knots_vjp(&gradient.foreground),
            shadow: [
                r.knots_vjp(&gradient.shadow[0]),
                g.knots_vjp(&gradient.shadow[1]),
                b.knots_vjp(&gradient.shadow[2]),
            ],
        }
    }

    /// All parameters in one array: foreground, then the shadow's red, green, blue.
    pub fn to_array(&self) -> [f64; TONE_PARAMETERS] {
        let mut all = [0.0; TONE_PARAMETERS];
        let splines = [
            self.foreground,
            self.shadow[0],
            self.shadow[1],
            self.shadow[2],
        ];
        for (part, spline) in all.as_chunks_mut::<PARAMETERS>().0.iter_mut().zip(splines) {
            *part = spline.to_array();
        }
        all
    }

    /// The reverse of [`to_array`](Self::to_array).
    pub fn from_array(all: &[f64; TONE_PARAMETERS]) -> Self {
        let part = |i: usize| SplineParameters::from_array(all.as_chunks().0[i]);
        Self {
            foreground: part(0),
            shadow: [part(1), part(2), part(3)],
        }
    }
}

/// Pixels of one chunk of a parallel gradient sum. A constant, because the chunks fix the rounding.
const CHUNK: usize = 1 << 12;

impl ToneCurves {
    /// Reinhard alone for the object, no change of the shadow.
    pub fn identity() -> Self {
        ToneParameters::default().curves()
    }

    /// The curves, prepared for many pixels.
    pub fn mapper(&self) -> ToneMapper {
        ToneMapper {
            foreground: self.foreground.curve(),
            shadow: self.shadow.map(|s| s.curve()),
        }
    }

    /// [`ToneMapper::object_pixel`] over an image. Panics if the sizes differ.
    pub fn apply_object(&self, object: &LinearImage, alpha: &Raster<f32>) -> LinearImage {
        let (width, height) = same_size(&object.0, alpha);
        let pixels = object.0.pixels().par_iter().zip(alpha.pixels());
        let mapper = self.mapper();
        let toned = pixels
            .map(|(&rgb, &a)| mapper.object_pixel(rgb, a))
            .collect();
        LinearImage(Raster::from_pixels(width, height, toned))
    }

    /// Adjoint of [`apply_object`](Self::apply_object): the gradients with respect to the
    /// premultiplied object and to the object's knots; the same bytes for any number of threads.
    pub fn apply_object_vjp(
        &self,
        object: &LinearImage,
        alpha: &Raster<f32>,
        gradient: &Raster<Vec3>,
    ) -> (Raster<Vec3>, KnotGradient) {
        same_size(&object.0, alpha);
        let (object, alpha, mapper) = (&object.0, alpha.pixels(), self.mapper());
        let (pixels, tone) = vjp_by_chunks(object, gradient, |i, rgb, g, knots| {
            mapper.object_pixel_vjp(rgb, alpha[i], g, &mut knots.foreground)
        });
        (pixels, tone.foreground)
    }

    /// [`ToneMapper::shadow_pixel`] over an image.
    pub fn apply_shadow(&self, shadow: &LinearImage) -> LinearImage {
        let (width, height) = (shadow.0.width(), shadow.0.height());
        let pixels = shadow.0.pixels().par_iter();
        let mapper = self.mapper();
        let toned = pixels.map(|&beta| mapper.shadow_pixel(beta)).collect();
        LinearImage(Raster::from_pixels(width, height, toned))
    }

    /// Adjoint of [`apply_shadow`](Self::apply_shadow): the gradients with respect to the ratio and
    /// to the shadow's knots; the same bytes for any number of threads.
    pub fn apply_shadow_vjp(
        &self,
        shadow: &LinearImage,
        gradient: &Raster<Vec3>,
    ) -> (Raster<Vec3>, [KnotGradient; 3]) {
        let mapper = self.mapper();
        let (pixels, tone) = vjp_by_chunks(&shadow.0, gradient, |_, beta, g, knots| {
            mapper.shadow_pixel_vjp(beta, g, &mut knots.shadow)
        });
        (pixels, tone.shadow)
    }

    /// Writes `tone.json`.
    pub fn write_json(&self, path: impl AsRef<Path>) -> Result<(), ImagingError> {
        let path = path.as_ref();
        let text = serde_json::to_string_pretty(self).map_err(|e| bad_tone(path, e.to_string()))?;
        std::fs::write(path, text + "\n").map_err(|e| ImagingError::io("write", path, e))
    }

    /// Reads `tone.json` and checks that its curves are monotonic.
    pub fn read_json(path: impl AsRef<Path>) -> Result<Self, ImagingError> {
        let path = path.as_ref();
        let text = std::fs::read(path).map_err(|e| ImagingError::io("read", path, e))?;
        let curves: Self =
            serde_json::from_slice(&text).map_err(|e| bad_tone(path, e.to_string()))?;
        let named = [
            ("foreground", &curves.foreground),
            ("shadow[0]", &curves.shadow[0]),
            ("shadow[1]", &curves.shadow[1]),
            ("shadow[2]", &curves.shadow[2]),
        ];
        for (name, knots) in named {
            knots
                .check()
                .map_err(|what| bad_tone(path, format!("in `{name}`, {what}")))?;
        }
        Ok(curves)
    }
}

/// [`ToneCurves`] prepared for many pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToneMapper {
    foreground: Curve,
    shadow: [Curve; 3],
}

impl ToneMapper {
    /// Tone-maps one premultiplied pixel of the object: Reinhard and the spline act on
    /// `object / alpha`, the colour of the covered part, and the result is premultiplied again.
    /// Black where `alpha` is 0.
    #[inline]
    pub fn object_pixel(&self, object: Vec3, alpha: f32) -> Vec3 {
        if alpha <= 0.0 {
            return Vec3::ZERO;
        }
        let alpha = f64::from(alpha);
        let per_alpha = 1.0 / alpha;
        let tone = |v: f32| {
            let covered = f64::from(v) * per_alpha;
            (alpha * self.foreground.eval(reinhard(covered))) as f32
        };
        Vec3::new(tone(object.x), tone(object.y), tone(object.z))
    }

    /// Adjoint of [`ToneMapper::object_pixel`] for a fixed `alpha`: adds to `knots`, returns
    /// the gradient with respect to the premultiplied colour.
    #[inline]
    fn object_pixel_vjp(
        &self,
        object: Vec3,
        alpha: f32,
        gradient: Vec3,
        knots: &mut KnotGradient,
    ) -> Vec3 {
        if alpha <= 0.0 {
            return Vec3::ZERO;
        }
        let alpha = f64::from(alpha);
        let per_alpha = 1.0 / alpha;
        let mut channel = |v: f32, g: f32| {
            let v = f64::from(v) * per_alpha;
            let to_curve = alpha * f64::from(g);
            let inner = self.foreground.eval_vjp(reinhard(v), to_curve, knots);
            (reinhard_vjp(v, inner) * per_alpha) as f32
        };
        Vec3::new(
            channel(object.x, gradient.x),
            channel(object.y, gradient.y),
            channel(object.z, gradient.z),
        )
    }

    /// Tone-maps one pixel's shadow ratio, each channel by its own curve. 1 stays 1.
    #[inline]
    pub fn shadow_pixel(&self, shadow: Vec3) -> Vec3 {
        let tone = |c: usize| self.shadow[c].eval(f64::from(shadow[c])) as f32;
        Vec3::new(tone(0), tone(1), tone(2))
    }

    /// Adjoint of [`ToneMapper::shadow_pixel`]: adds to `knots`, returns the gradient with
    /// respect to the ratio.
    #[inline]
    fn shadow_pixel_vjp(
        &self,
        shadow: Vec3,
        gradient: Vec3,
        knots: &mut [KnotGradient; 3],
    ) -> Vec3 {
        let mut channel = |c: usize| {
            let (x, g) = (f64::from(shadow[c]), f64::from(gradient[c]));
            self.shadow[c].eval_vjp(x, g, &mut knots[c]) as f32
        };
        Vec3::new(channel(0), channel(1), channel(2))
    }
}

fn bad_tone(path: &Path, detail: String) -> ImagingError {
    ImagingError::BadTone {
        path: path.to_owned(),
        detail,
    }
}

fn same_size<T, U>(a: &Raster<T>, b: &Raster<U>) -> (usize, usize) {
    let size = (a.width(), a.height());
    assert_eq!(size, (b.width(), b.height()), "layers of one size");
    size
}

/// Runs a pixel's adjoint over an image. `pixel` gets the index, the input, its result's gradient
/// and the chunk's knot gradients.
fn vjp_by_chunks(
    input: &Raster<Vec3>,
    gradient: &Raster<Vec3>,
    pixel: impl Fn(usize, Vec3, Vec3, &mut ToneGradient) -> Vec3 + Sync,
) -> (Raster<Vec3>, ToneGradient) {
    let (width, height) = same_size(input, gradient);
    let (input, gradient) = (input.pixels(), gradient.pixels());
    let parts = par_reduce(
        input.len(),
        CHUNK,
        |range| {
            let mut knots = ToneGradient::default();
            let chunk = range.map(|i| pixel(i, input[i], gradient[i], &mut knots));
            let chunk: Vec<Vec3> = chunk.collect();
            (chunk, knots)
        },
        |(mut pixels, knots), (more, further)| {
            pixels.extend(more);
            (pixels, knots.merge(further))
        },
    );
    let (pixels, knots) = parts.unwrap_or_default();
    (Raster::from_pixels(width, height, pixels), knots)
}

#[cfg(test)]
mod tests;
