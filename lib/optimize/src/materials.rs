//! Recovering materials from a reference picture under a known light.
//!
//! The light is fixed, so it is the transport that changes from step to step, and every step traces
//! paths: once for the picture, once for its derivatives
//! ([`material_gradient`](dipir_render::material_gradient)). **The two use independent random
//! numbers.** The loss's derivative depends on the picture; were its noise the same as that of the
//! derivatives, their product would on average not be the gradient but the gradient plus a
//! covariance, which pulls towards materials that render with less noise. What bias remains is that
//! of a curved loss and of the display's curve applied to a noisy picture; it falls with the number
//! of samples of the picture.
//!
//! Parameters are held within their ranges by clamping after each step; the strength of emission is
//! optimised as a logarithm. What is returned is the mean over the last quarter of the steps, whose
//! noise is smaller than that of the last one.
use std::ops::ControlFlow;
use std::path::Path;

use dipir_imaging::composite::{composite_pixel, composite_pixel_vjp};
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::tone::ToneCurves;
use dipir_imaging::transfer::Transfer;
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sum::Neumaier;
use dipir_render::adaptive::Stop;
use dipir_render::error::RenderError;
use dipir_render::light::SceneLight;
use dipir_render::material_gradient::{GradientSettings, MaterialGradient};
use dipir_render::render::{Renderer, Settings, Simulation};
use dipir_scene::material::Material;
use dipir_scene::scene::Scene;
use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::error::OptimizeError;
use crate::guidance::{PHOTOMETRIC_SCALE, charbonnier};
use crate::material_checkpoint::MaterialState;
use crate::optimization::MOST_BAD_IN_A_ROW;
use crate::tensors::{Group, Tensor, Tensors};

/// Least base colour: at 0 a diffuse lobe is never sampled and could not come back.
const LEAST_COLOR: f64 = 1e-3;
/// Least roughness: below, the surface is a mirror without a derivative.
const LEAST_ROUGHNESS: f64 = 0.02;
/// Logarithm of the largest change of the strength of emission.
const LOG_STRENGTH: f64 = 9.0;
/// Share of the steps at the end whose mean is the result.
const AVERAGED: f64 = 0.25;
/// Share of the first step's rate that the last step has. Averaging takes care of the noise, so it
/// may be larger than where the last step's parameters are the result.
const LAST_RATE: f64 = 0.1;

/// One recovered material: the factors that multiply its textures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecoveredMaterial {
    /// As the object's file names it.
    pub name: String,
    /// Linear Rec.709.
    pub base_color: [f32; 3],
    /// In `[0, 1]`.
    pub metallic: f32,
    /// Perceptual, in `[0, 1]`.
    pub roughness: f32,
    /// What multiplies the emission that the file states.
    pub emissive_strength: f32,
}

impl RecoveredMaterial {
    /// Puts the factors into the material that they were recovered for.
    pub fn apply(&self, material: &mut Material) {
        let color = Vec3::from(self.base_color);
        material.base_color = color.extend(material.base_color.w);
        material.metallic = self.metallic;
        material.roughness = self.roughness;
        material.emissive *= self.emissive_strength;
    }
}

/// How materials are recovered.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaterialSettings {
    /// Steps.
    pub iterations: usize,
    /// Paths per pixel of each step's picture; a multiple of 4 is drawn.
    pub picture_samples: u32,
    /// Paths per pixel of each step's derivatives.
    pub gradient_samples: u32,
    /// How far a parameter moves in the first steps; falls along a cosine.
    pub rate: f64,
    /// Steps between checkpoints; 0 for none.
    pub checkpoint_every: usize,
    /// Key of every random number.
    pub seed: u64,
}

impl Default for MaterialSettings {
    fn default() -> Self {
        Self {
            iterations: 200,
            picture_samples: 64,
            gradient_samples: 16,
            // From one end of a range to the other in 40 steps.
            rate: 0.025,
            checkpoint_every: 25,
            seed: 0,
        }
    }
}

/// What is known, and what is asked for.
pub struct MaterialOptimization<'a, L> {
    /// The object; its scene holds the materials to start from.
    pub renderer: &'a Renderer<'a>,
    /// The known light.
    pub light: &'a L,
    /// What is simulated; the shadow is left out, for it does not depend on materials.
    pub simulation: Simulation,
    /// The tone curves on the object; none where it is laid over the photograph as it is.
    pub tone: Option<ToneCurves>,
    /// The photograph behind the object, times the toned shadow ratio.
    pub background: &'a LinearImage,
    /// From linear to display values.
    pub transfer: Transfer,
    /// What the picture should be.
    pub reference: &'a DisplayImage,
    /// Indices of the materials that are recovered; the others stay as they are.
    pub materials: Vec<usize>,
    /// How.
    pub settings: MaterialSettings,
    /// File that keeps the state between steps; the run goes on from it if it exists.
    pub checkpoint: Option<&'a Path>,
}

/// Recovered materials and how the loss fell.
#[derive(Clone, Debug, PartialEq)]
pub struct MaterialOutcome {
    /// In the order asked for.
    pub materials: Vec<RecoveredMaterial>,
    /// Loss of every step's picture, where it is a number.
    pub losses: Vec<f64>,
}

impl<L: SceneLight> MaterialOptimization<'_, L> {
    /// Runs all steps, from the checkpoint on if the file is there. `progress` hears the share
    /// that is done and may break off: then the state is kept and the error is
    /// [`OptimizeError::Interrupted`]. The result is a function of the inputs: an interruption
    /// does not show in it.
    pub fn run(
        &self,
        progress: &mut dyn FnMut(f64) -> ControlFlow<()>,
    ) -> Result<MaterialOutcome, OptimizeError> {
        let settings = &self.settings;
        let start = self.renderer.scene();
        let mut scene = start.clone();
        let mut state = match self.checkpoint {
            Some(path) => self.restored(path)?,
            None => None,
        }
        .unwrap_or_else(|| MaterialState::new(self.parameters(start)));
        while state.iteration < settings.iterations {
            let share = state.iteration as f64 / settings.iterations as f64;
            if progress(share).is_break() {
                self.keep(&state)?;
                return Err(OptimizeError::Interrupted);
            }
            self.apply(&state.parameters, start, &mut scene);
            let (loss, gradients) = self.step(&scene, state.iteration)?;
            let gradient = self.gradient(&scene, &gradients);
            self.take(&mut state, loss, &gradient)?;
            let every = settings.checkpoint_every;
            if every > 0 && state.iteration.is_multiple_of(every) {
                self.keep(&state)?;
            }
        }
        // Without a step there is nothing to average.
        let found = match settings.iterations {
            0 => &state.parameters,
            _ => &state.mean,
        };
        Ok(MaterialOutcome {
            materials: self.recovered(found, start),
            losses: state.losses,
        })
    }

    /// Ends the iteration with a step against `gradient`, or without one where something is not finite: then the next
    /// iteration draws other paths. An error after [`MOST_BAD_IN_A_ROW`] of these.
    fn take(
        &self,
        state: &mut MaterialState,
        loss: f64,
        gradient: &Tensors,
    ) -> Result<(), OptimizeError> {
        let (iteration, iterations) = (state.iteration, self.settings.iterations);
        let bad = match loss.is_finite() {
            true => gradient.first_not_finite(),
            false => Some("loss"),
        };
        if loss.is_finite() {
            state.losses.push(loss);
        }
        if let Some(tensor) = bad {
            state.bad_in_a_row += 1;
            if state.bad_in_a_row >= MOST_BAD_IN_A_ROW {
                return Err(OptimizeError::NotFinite {
                    tensor: tensor.into(),
                    iteration,
                    in_a_row: state.bad_in_a_row,
                });
            }
        } else {
            state.bad_in_a_row = 0;
            let share = iteration as f64 / iterations as f64;
            let cosine = 0.5 * (1.0 + (std::f64::consts::PI * share).cos());
            let rate = self.settings.rate * (LAST_RATE + (1.0 - LAST_RATE) * cosine);
            let parameters = &mut state.parameters;
            state.adam.step(parameters, gradient, |_| rate)?;
            clamp(parameters);
        }
        let first_averaged = ((1.0 - AVERAGED) * iterations as f64) as usize;
        if iteration >= first_averaged {
            let weight = 1.0 / (iterations - first_averaged) as f64;
            for (m, p) in state.mean.0.iter_mut().zip(&state.parameters.0) {
                m.values
                    .iter_mut()
                    .zip(&p.values)
                    .for_each(|(m, p)| *m += weight * p);
            }
        }
        state.iteration += 1;
        Ok(())
    }

    /// The state that a checkpoint holds; `None` if there is no file.
    pub fn restored(&self, path: &Path) -> Result<Option<MaterialState>, OptimizeError> {
        let shape = self.parameters(self.renderer.scene());
        MaterialState::read(path, &self.materials, &self.settings, &shape)
    }

    fn keep(&self, state: &MaterialState) -> Result<(), OptimizeError> {
        match self.checkpoint {
            Some(path) => state.write(path, &self.materials, &self.settings),
            None => Ok(()),
        }
    }

    /// Loss of a picture of `scene`, and an estimate of its derivatives.
    fn step(
        &self,
        scene: &Scene,
        iteration: usize,
    ) -> Result<(f64, Vec<MaterialGradient>), OptimizeError> {
        let renderer = self.renderer.with_materials_of(scene);
        let seed = |part: u64| hash_u64s(&[self.settings.seed, iteration as u64, part]);
        let simulation = Simulation {
            shadow: false,
            ..self.simulation
        };
        let rendering = Settings {
            seed: seed(0),
            stop: Stop::Samples(self.settings.picture_samples),
            background: Some(self.background),
            transfer: self.transfer,
            ..Settings::default()
        };
        let rendered = renderer
            .render(self.light, &simulation, &rendering, &mut |_| {
                ControlFlow::Continue(())
            })
            .map_err(render_error)?;
        let object = LinearImage(rendered.film.object);
        let (loss, gradient) = self.loss(&object, &rendered.film.alpha);
        let derivatives = GradientSettings {
            seed: seed(1),
            samples: self.settings.gradient_samples,
            background: Some(self.background),
        };
        let gradients = renderer
            .material_gradient(self.light, &simulation, &derivatives, &gradient)
            .map_err(render_error)?;
        Ok((loss, gradients))
    }

    /// The mean of Charbonnier's loss over the object's pixels, and its derivative with respect to
    /// the premultiplied object.
    fn loss(&self, object: &LinearImage, alpha: &Raster<f32>) -> (f64, Raster<Vec3>) {
        let toned = match &self.tone {
            Some(tone) => tone.apply_object(object, alpha),
            None => object.clone(),
        };
        let count = alpha.pixels().iter().filter(|&&a| a > 0.0).count();
        let share = 1.0 / (3.0 * count.max(1) as f64);
        let mut loss = Neumaier::default();
        let pixels = (0..alpha.pixels().len()).map(|p| {
            let a = alpha.pixels()[p];
            if a <= 0.0 {
                return Vec3::ZERO;
            }
            let (behind, in_front) = (self.background.0.pixels()[p], toned.0.pixels()[p]);
            let linear = composite_pixel(behind, in_front, a, Vec3::ONE);
            let reference = self.reference.0.pixels()[p];
            let channel = |c: usize| {
                let shown = self.transfer.encode_scalar(linear[c]);
                let difference = f64::from(shown) - f64::from(reference[c]);
                let (value, slope) = charbonnier(difference, PHOTOMETRIC_SCALE);
                let slope = (share * slope) as f32;
                (value, self.transfer.encode_scalar_vjp(linear[c], slope))
            };
            let [x, y, z] = [channel(0), channel(1), channel(2)];
            loss.add(share * (x.0 + y.0 + z.0));
            composite_pixel_vjp(behind, a, Vec3::ONE, Vec3::new(x.1, y.1, z.1)).object
        });
        let gradient = Raster::from_pixels(alpha.width(), alpha.height(), pixels.collect());
        let gradient = match &self.tone {
            Some(tone) => tone.apply_object_vjp(object, alpha, &gradient).0,
            None => gradient,
        };
        (loss.total(), gradient)
    }

    fn tensors(&self, of: impl Fn(usize) -> ([f64; 3], f64, f64, f64)) -> Tensors {
        let all: Vec<_> = self.materials.iter().map(|&m| of(m)).collect();
        let tensor = |name, values| Tensor {
            name,
            group: Group::Material,
            values,
        };
        Tensors(vec![
            tensor(
                "materials.base_color",
                all.iter().flat_map(|m| m.0).collect(),
            ),
            tensor("materials.metallic", all.iter().map(|m| m.1).collect()),
            tensor("materials.roughness", all.iter().map(|m| m.2).collect()),
            tensor("materials.log_emissive", all.iter().map(|m| m.3).collect()),
        ])
    }

    fn parameters(&self, start: &Scene) -> Tensors {
        let mut parameters = self.tensors(|k| {
            let m = &start.materials[k];
            let color = m.base_color.truncate().as_dvec3().to_array();
            (color, f64::from(m.metallic), f64::from(m.roughness), 0.0)
        });
        clamp(&mut parameters);
        parameters
    }

    /// The derivatives by parameter; that of the logarithm of emission is emission times its own.
    fn gradient(&self, scene: &Scene, gradients: &[MaterialGradient]) -> Tensors {
        self.tensors(|k| {
            let (g, emissive) = (&gradients[k], scene.materials[k].emissive.as_dvec3());
            let by_strength = g.emissive.dot(emissive);
            (
                g.base_color.to_array(),
                g.metallic,
                g.roughness,
                by_strength,
            )
        })
    }

    fn recovered(&self, parameters: &Tensors, start: &Scene) -> Vec<RecoveredMaterial> {
        let value = |tensor: usize, k: usize| parameters.0[tensor].values[k] as f32;
        let materials = self.materials.iter().enumerate();
        materials
            .map(|(k, &m)| RecoveredMaterial {
                name: start.materials[m].name.clone(),
                base_color: [value(0, 3 * k), value(0, 3 * k + 1), value(0, 3 * k + 2)],
                metallic: value(1, k),
                roughness: value(2, k),
                emissive_strength: value(3, k).exp(),
            })
            .collect()
    }

    fn apply(&self, parameters: &Tensors, start: &Scene, scene: &mut Scene) {
        let recovered = self.recovered(parameters, start);
        for (&k, material) in self.materials.iter().zip(&recovered) {
            scene.materials[k].emissive = start.materials[k].emissive;
            material.apply(&mut scene.materials[k]);
        }
    }
}

fn clamp(parameters: &mut Tensors) {
    let ranges = [
        (LEAST_COLOR, 1.0),
        (0.0, 1.0),
        (LEAST_ROUGHNESS, 1.0),
        (-LOG_STRENGTH, LOG_STRENGTH),
    ];
    for (tensor, (low, high)) in parameters.0.iter_mut().zip(ranges) {
        for value in &mut tensor.values {
            *value = value.clamp(low, high);
        }
    }
}

fn render_error(error: RenderError) -> OptimizeError {
    match error {
        RenderError::Interrupted => OptimizeError::Interrupted,
        other => OptimizeError::Render(other),
    }
}

#[cfg(test)]
#[path = "materials_tests.rs"]
mod tests;
