//! From parameters to the picture, and from the picture's gradient back: the chain and its exact
//! adjoint, each step the adjoint of the one that stands beside it in its own crate.
//!
//! ```text
//! lobes -> maps            integrating rasteriser
//! maps -> fused maps       by s from 0 to 1        + consistency (eq. 10), Cauchy (eq. 11) on the maps
//! fused -> object          transport of the foreground
//! fused -> shadow ratio    transport of the shadow
//! object -> toned object   Reinhard, then a spline
//! ratio -> toned ratio     a spline per channel
//! toned -> composite       background * ratio * (1 - coverage) + object (eq. 6)
//! composite -> picture     display transfer
//! ```
//!
//! Pixels and texels are f32, parameters and sums f64. Not differentiated: coverage, geometry,
//! materials, and the shadow's side of the consistency.
use dipir_imaging::composite::{composite_pixel, composite_pixel_vjp};
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::tone::{ToneCurves, ToneGradient};
use dipir_imaging::transfer::Transfer;
use dipir_light::fusion::{Fused, fuse, fuse_vjp};
use dipir_light::gaussian::SphericalGaussian;
use dipir_light::rasterize::Rasterizer;
use dipir_light::regularizer::{cauchy, cauchy_vjp, consistency, consistency_vjp};
use glam::Vec3;

use crate::error::OptimizeError;
use crate::parameters::Parameters;
use crate::transport::LinearTransport;

/// Weights of the terms beside the guidance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TermWeights {
    /// Of the consistency of both maps, lambda of eq. 10.
    pub consistency: f64,
    /// Of the Cauchy regulariser on the shadow's map, lambda of eq. 11.
    pub regularizer: f64,
}

impl TermWeights {
    /// The guidance alone.
    pub const NONE: Self = Self {
        consistency: 0.0,
        regularizer: 0.0,
    };
}

/// The chain for one photograph and one recorded scene.
pub struct Objective {
    transport: Box<dyn LinearTransport>,
    background: LinearImage,
    transfer: Transfer,
    weights: TermWeights,
    rasterizer: Rasterizer,
}

/// Everything that the chain computed on its way to the picture.
#[derive(Clone, Debug)]
pub struct Forward {
    fusion: f32,
    lobes: [Vec<SphericalGaussian>; 2],
    /// The maps of the foreground and of the shadow before fusion.
    pub maps: [Vec<Vec3>; 2],
    /// The maps that light the object and cast the shadow.
    pub fused: Fused,
    /// Radiance of the object, premultiplied.
    pub object: LinearImage,
    /// Light on the proxy with the object over light without it.
    pub ratio: LinearImage,
    curves: ToneCurves,
    toned_ratio: LinearImage,
    composite: LinearImage,
    /// The picture as it is displayed.
    pub picture: DisplayImage,
    /// Consistency, weighted.
    pub consistency: f64,
    /// Cauchy regulariser, weighted.
    pub regularizer: f64,
}

impl Objective {
    /// For a photograph, in linear light and of the transport's size, that is displayed through
    /// `transfer`.
    pub fn new(
        transport: Box<dyn LinearTransport>,
        background: LinearImage,
        transfer: Transfer,
        weights: TermWeights,
    ) -> Result<Self, OptimizeError> {
        let (width, height) = transport.environment_size();
        let found = (background.0.width(), background.0.height());
        if found != transport.size() {
            return Err(OptimizeError::Size {
                what: "the background",
                found,
                expected: transport.size(),
                reference: "the recorded transport",
            });
        }
        Ok(Self {
            transport,
            background,
            transfer,
            weights,
            rasterizer: Rasterizer::new(width, height),
        })
    }

    /// How light reaches the picture.
    pub fn transport(&self) -> &dyn LinearTransport {
        &*self.transport
    }

    /// Takes a new record of the same scene. Panics if its sizes differ.
    pub fn set_transport(&mut self, transport: Box<dyn LinearTransport>) {
        let sizes = |t: &dyn LinearTransport| (t.size(), t.environment_size());
        assert_eq!(sizes(&*transport), sizes(&*self.transport), "one scene");
        self.transport = transport;
    }

    /// Changes the weights of the terms beside the guidance.
    pub fn set_weights(&mut self, weights: TermWeights) {
        self.weights = weights;
    }

    /// The photograph, in linear light.
    pub fn background(&self) -> &LinearImage {
        &self.background
    }

    /// The picture under `parameters`, with the maps fused by `fusion` in [0, 1].
    pub fn forward(&self, parameters: &Parameters, fusion: f32) -> Forward {
        let (width, height) = self.transport.environment_size();
        let lobes = [parameters.foreground_lobes(), parameters.shadow_lobes()];
        let maps = [0, 1].map(|set| {
            let mut texels = vec![Vec3::ZERO; width * height];
            self.rasterizer.rasterize_into(&lobes[set], &mut texels);
            texels
        });
        let fused = fuse(&maps[0], &maps[1], fusion);
        let object = LinearImage(self.transport.foreground(&fused.foreground));
        let ratio = LinearImage(self.transport.shadow(&fused.shadow));
        let curves = parameters.tone.curves();
        let toned_object = curves.apply_object(&object, self.transport.coverage());
        let toned_ratio = curves.apply_shadow(&ratio);
        let composite = self.composite(&toned_object, &toned_ratio);
        let agreement = consistency(&maps[0], &maps[1], width, height);
        let sparsity = cauchy(&maps[1], width, height);
        Forward {
            fusion,
            lobes,
            fused,
            object,
            ratio,
            curves,
            toned_ratio,
            picture: self.transfer.encode(&composite),
            composite,
            consistency: self.weights.consistency * agreement,
            regularizer: self.weights.regularizer * sparsity,
            maps,
        }
    }

    /// Adjoint of [`forward`](Self::forward): the gradient of `picture . gradient + consistency +
    /// regularizer` with respect to every parameter. The same bytes for any number of threads.
    pub fn vjp(
        &self,
        parameters: &Parameters,
        forward: &Forward,
        gradient: &Raster<Vec3>,
    ) -> Parameters {
        let (to_maps, to_curves) = self.maps_vjp(forward, gradient);
        let to_lobes =
            |set: usize, map: &[Vec3]| self.rasterizer.rasterize_vjp(&forward.lobes[set], map);
        parameters.vjp(
            &to_lobes(0, &to_maps.foreground),
            &to_lobes(1, &to_maps.shadow),
            parameters.tone.curves_vjp(&to_curves),
        )
    }

    /// From the picture back to both maps before fusion and to the tone curves.
    fn maps_vjp(&self, forward: &Forward, gradient: &Raster<Vec3>) -> (Fused, ToneGradient) {
        let (width, height) = self.transport.environment_size();
        let to_composite = self.transfer.encode_vjp(&forward.composite, gradient);
        let (to_object, to_ratio) = self.composite_vjp(&forward.toned_ratio, &to_composite);
        let curves = &forward.curves;
        let coverage = self.transport.coverage();
        let (to_object, by_object) = curves.apply_object_vjp(&forward.object, coverage, &to_object);
        let (to_ratio, by_ratio) = curves.apply_shadow_vjp(&forward.ratio, &to_ratio);
        let to_fused = Fused {
            foreground: self.transport.foreground_vjp(to_object.pixels()),
            shadow: self.transport.shadow_vjp(
                &forward.fused.shadow,
                &forward.ratio.0,
                to_ratio.pixels(),
            ),
        };
        let [foreground, shadow] = &forward.maps;
        let mut to_maps = fuse_vjp(foreground, shadow, forward.fusion, &to_fused);
        let TermWeights {
            consistency,
            regularizer,
        } = self.weights;
        let more = consistency_vjp(foreground, shadow, width, height, consistency);
        add(&mut to_maps.foreground, &more);
        add(
            &mut to_maps.shadow,
            &cauchy_vjp(shadow, width, height, regularizer),
        );
        let to_curves = ToneGradient {
            foreground: by_object,
            shadow: by_ratio,
        };
        (to_maps, to_curves)
    }

    fn composite(&self, object: &LinearImage, ratio: &LinearImage) -> LinearImage {
        let alpha = self.transport.coverage().pixels();
        let background = self.background.0.pixels();
        let pixels = (0..alpha.len())
            .map(|p| {
                composite_pixel(
                    background[p],
                    object.0.pixels()[p],
                    alpha[p],
                    ratio.0.pixels()[p],
                )
            })
            .collect();
        self.raster(pixels)
    }

    fn composite_vjp(
        &self,
        ratio: &LinearImage,
        gradient: &Raster<Vec3>,
    ) -> (Raster<Vec3>, Raster<Vec3>) {
        let alpha = self.transport.coverage().pixels();
        let background = self.background.0.pixels();
        let (object, shadow) = (0..alpha.len())
            .map(|p| {
                let (beta, g) = (ratio.0.pixels()[p], gradient.pixels()[p]);
                let back = composite_pixel_vjp(background[p], alpha[p], beta, g);
                (back.object, back.shadow)
            })
            .unzip();
        (self.raster(object).0, self.raster(shadow).0)
    }

    fn raster(&self, pixels: Vec<Vec3>) -> LinearImage {
        let (width, height) = self.transport.size();
        LinearImage(Raster::from_pixels(width, height, pixels))
    }
}

impl Forward {
    /// The first thing on the way to the picture that holds a NaN or an infinity.
    pub fn first_not_finite(&self) -> Option<&'static str> {
        let steps: [(&'static str, &[Vec3]); 8] = [
            ("map of the foreground", &self.maps[0]),
            ("map of the shadow", &self.maps[1]),
            ("fused map of the foreground", &self.fused.foreground),
            ("fused map of the shadow", &self.fused.shadow),
            ("object", self.object.0.pixels()),
            ("shadow ratio", self.ratio.0.pixels()),
            ("toned shadow ratio", self.toned_ratio.0.pixels()),
            ("composite", self.composite.0.pixels()),
        ];
        let bad = |(_, values): &&(&str, &[Vec3])| values.iter().any(|v| !v.is_finite());
        let scalars = [
            ("consistency", self.consistency),
            ("regularizer", self.regularizer),
        ];
        let by_scalar = || scalars.iter().find(|(_, v)| !v.is_finite()).map(|s| s.0);
        steps.iter().find(bad).map(|s| s.0).or_else(by_scalar)
    }
}

fn add(sum: &mut [Vec3], more: &[Vec3]) {
    sum.iter_mut().zip(more).for_each(|(a, b)| *a += *b);
}

#[cfg(test)]
#[path = "objective_tests.rs"]
mod tests;
