//! Small renders that measure what an effect contributes.
use std::ops::ControlFlow;

use dipir_imaging::composite::composite_pixel;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sampler::Stream;
use dipir_numerics::stats::Running;
use dipir_scene::camera::Camera;
use glam::Vec3;

use crate::adaptive::Stop;
use crate::coarse::{at_resolution, shrink};
use crate::error::RenderError;
use crate::features::{CLEARCOAT, NORMAL_MAPPING, SPECULAR, TEXTURES, TRANSMISSION, has};
use crate::film::Viewing;
use crate::footprint::Footprint;
use crate::light::{PreparedLight, SceneLight};
use crate::render::{Rendered, Renderer, Settings, Simulation};
use crate::world::ProxyGeometry;

/// Pixels of the object that a pilot render aims at: enough that a mean over them is precise to a
/// few per cent.
const OBJECT_PIXELS: f32 = 1024.0;
/// Least pixels of the object from which anything is learnt, where a ray takes so long that fewer are affordable.
const FEW_OBJECT_PIXELS: f32 = 64.0;
/// Most pixels of a pilot render.
const MAX_PIXELS: f32 = 16384.0;
/// Samples per pixel of each of the two pictures.
const SAMPLES: u32 = 16;

/// A scene at low resolution, under one light.
pub struct Pilot<'a, L: SceneLight> {
    renderer: Renderer<'a>,
    light: PreparedLight<L>,
    seed: u64,
    transfer: Transfer,
    background: Option<LinearImage>,
    occluders: Option<Raster<f32>>,
}

/// Two pictures with independent seeds.
pub struct Pictures {
    composites: [Raster<Vec3>; 2],
    touched: Vec<bool>,
    cost: f64,
}

/// How much two pictures differ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Difference {
    /// Display-referred RMSE over the pixels that the object or its shadow touches.
    pub rmse: f64,
    /// Standard error of `rmse`.
    pub std_error: f64,
    /// Mean squared difference and its standard error.
    mean_square: (f64, f64),
    /// Share of the reference's effort that is saved.
    pub cost_share: f64,
}

impl Difference {
    /// One-sided 95% confidence bound of the RMSE.
    pub fn upper_95(&self) -> f64 {
        (self.mean_square.0.max(0.0) + 1.645 * self.mean_square.1).sqrt()
    }
}

/// Effort of an image sample beside its rays, in rays: what a material's parts cost to look up and
/// evaluate. Measured with one part at a time on a sphere under a 1024 x 512 map, where a camera
/// ray with a Lambertian surface took 0.5 us, the specular lobe 0.1 us more and a coat 0.25 us;
/// the parts that only look textures up are set like one random memory access, 0.05 us.
fn shading_weight(mask: u32) -> f64 {
    let parts = [
        (SPECULAR, 0.2),
        (TEXTURES, 0.1),
        (NORMAL_MAPPING, 0.1),
        (CLEARCOAT, 0.5),
        (TRANSMISSION, 0.2),
    ];
    0.5 + parts
        .into_iter()
        .filter(|&(part, _)| has(mask, part))
        .map(|(_, weight)| weight)
        .sum::<f64>()
}

impl<'a, L: SceneLight> Pilot<'a, L> {
    /// Prepares the renderer's scene, with the photograph and mask of `settings` scaled down.
    pub fn new(renderer: &Renderer<'a>, light: &L, settings: &Settings) -> Self {
        let camera = pilot_camera(renderer);
        let size = camera.resolution.map(|n| n as usize);
        let normal = match &renderer.geometry().proxy {
            ProxyGeometry::Plane(plane) => Some(plane.normal),
            _ => None,
        };
        Self {
            renderer: renderer.with_camera(camera),
            light: PreparedLight::new(light, normal),
            seed: settings.seed,
            transfer: settings.transfer,
            background: settings
                .background
                .map(|image| LinearImage(shrink(&image.0, size))),
            occluders: settings.occluders.map(|mask| shrink(mask, size)),
        }
    }

    /// Whether rays are fast enough for effects to be measured: all of it then takes a bounded number of visits to
    /// the hierarchy's nodes, whatever the objects are.
    pub fn is_affordable(&self) -> bool {
        OBJECT_PIXELS * self.renderer.geometry().bvh.affordable_share() >= FEW_OBJECT_PIXELS
    }

    /// One picture of `simulation`.
    pub fn render(&self, simulation: &Simulation) -> Result<Rendered, RenderError> {
        self.render_seeded(simulation, 0)
    }

    fn render_seeded(
        &self,
        simulation: &Simulation,
        picture: u64,
    ) -> Result<Rendered, RenderError> {
        let settings = Settings {
            seed: hash_u64s(&[self.seed, u64::from(Stream::PILOT.0), picture]),
            stop: Stop::Samples(SAMPLES),
            background: self.background.as_ref(),
            transfer: self.transfer,
            occluders: self.occluders.as_ref(),
            ..Settings::default()
        };
        self.renderer
            .render(&self.light, simulation, &settings, &mut |_| {
                ControlFlow::Continue(())
            })
    }

    /// The pictures that others are compared with.
    pub fn reference(&self, simulation: &Simulation) -> Result<Pictures, RenderError> {
        let rendered = [
            self.render_seeded(simulation, 0)?,
            self.render_seeded(simulation, 1)?,
        ];
        let viewing = Viewing {
            background: self.background.as_ref(),
            transfer: self.transfer,
        };
        let [width, height] = self.renderer.camera().resolution.map(|n| n as usize);
        let touched = (0..width * height)
            .map(|i| {
                let (x, y) = (i % width, i / width);
                rendered.iter().any(|r| viewing.is_touched(&r.film, x, y))
            })
            .collect();
        Ok(Pictures {
            cost: cost(&rendered, simulation),
            composites: rendered.map(|r| self.display(&r)),
            touched,
        })
    }

    /// How much the picture changes if `simulation` replaces the reference's.
    pub fn difference(
        &self,
        reference: &Pictures,
        simulation: &Simulation,
    ) -> Result<Difference, RenderError> {
        let rendered = [
            self.render_seeded(simulation, 0)?,
            self.render_seeded(simulation, 1)?,
        ];
        let cost = cost(&rendered, simulation);
        let composites = rendered.map(|r| self.display(&r));
        let mut squares = Running::default();
        let mut each = [0.0; 2];
        for i in 0..reference.touched.len() {
            if reference.touched[i] {
                let [a, b] =
                    [0, 1].map(|k| composites[k].pixels()[i] - reference.composites[k].pixels()[i]);
                squares.push(f64::from(a.dot(b)) / 3.0);
                each[0] += f64::from(a.dot(a)) / 3.0;
                each[1] += f64::from(b.dot(b)) / 3.0;
            }
        }
        let (mean, se) = match squares.count() {
            0 => (0.0, 0.0),
            1 => (squares.mean(), 0.0),
            n => {
                // A rare event occurs in both pictures, but seldom in the same pixel of both: then all
                // products are 0, and so is their spread. Their size if the events were scattered at
                // random is a lower bound of the standard error.
                let scattered = (each[0] * each[1] / (n as f64).powi(3)).sqrt();
                (squares.mean(), squares.std_error().max(scattered))
            }
        };
        let rmse = mean.max(0.0).sqrt();
        Ok(Difference {
            rmse,
            // d sqrt(m) = dm / (2 sqrt(m)), but no more than the root of the error itself.
            std_error: (se / (2.0 * rmse).max(se.sqrt())).max(0.0),
            mean_square: (mean, se),
            cost_share: (1.0 - cost / reference.cost.max(1.0)).clamp(0.0, 1.0),
        })
    }

    /// The composite in display values.
    fn display(&self, rendered: &Rendered) -> Raster<Vec3> {
        let film = &rendered.film;
        let (width, height) = (film.alpha.width(), film.alpha.height());
        let pixels = (0..width * height)
            .map(|i| {
                let background = self
                    .background
                    .as_ref()
                    .map_or(Vec3::splat(0.18), |b| b.0.pixels()[i]);
                let linear = composite_pixel(
                    background,
                    film.object.pixels()[i],
                    film.alpha.pixels()[i],
                    film.shadow.pixels()[i],
                );
                Vec3::from_array(
                    linear
                        .to_array()
                        .map(|c| self.transfer.encode_scalar(c).clamp(0.0, 1.0)),
                )
            })
            .collect();
        Raster::from_pixels(width, height, pixels)
    }
}

fn cost(rendered: &[Rendered; 2], simulation: &Simulation) -> f64 {
    let weight = shading_weight(simulation.features);
    rendered
        .iter()
        .map(|r| r.counts.total() as f64 + r.samples as f64 * weight)
        .sum()
}

/// The renderer's camera at a resolution at which the object fills about [`OBJECT_PIXELS`].
fn pilot_camera(renderer: &Renderer) -> Camera {
    let camera = *renderer.camera();
    let [width, height] = camera.resolution;
    let bvh = &renderer.geometry().bvh;
    let footprint = Footprint::new(&camera, bvh.bounds(), bvh.clusters());
    // Counted in blocks of 4 x 4 pixels.
    let held = (0..height.div_ceil(4))
        .flat_map(|y| (0..width.div_ceil(4)).map(move |x| (4 * x, 4 * y)))
        .filter(|&(x, y)| footprint.overlaps(x, y, 4, 4))
        .count();
    let object = (16 * held).max(1) as f32;
    let all = width as f32 * height as f32;
    let wanted = (OBJECT_PIXELS * bvh.affordable_share()).max(FEW_OBJECT_PIXELS);
    let scale = (wanted / object).min(MAX_PIXELS / all).sqrt().min(1.0);
    let resolution = camera
        .resolution
        .map(|n| ((n as f32 * scale).round() as u32).max(1));
    at_resolution(camera, resolution)
}
