//! From a scene, a light and a plan to the layers of a composite.
use std::ops::ControlFlow;
use std::sync::Arc;

use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::plane::PlaneLight;
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_scene::camera::Camera;
use dipir_scene::scene::Scene;
use glam::{Vec2, Vec3};

use crate::adaptive::{EstimatedError, Progress, Stop, refine};
use crate::blocker::Blocker;
use crate::counters::RayCounts;
use crate::error::RenderError;
use crate::features::{ALPHA, PROXY_RADIANCE, has, with_features};
use crate::film::{Film, Job, Layer, REPLICATES, Viewing};
use crate::footprint::Footprint;
use crate::foreground::{PathContext, PathStart};
use crate::light::SceneLight;
use crate::photo::Photo;
use crate::shadow::{Block, LightOnProxy, SampleRange, ShadowContext};
use crate::world::{Geometry, ProxyGeometry, World};

/// Which phenomena are simulated: what remains of an effects plan for the kernels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Simulation {
    /// Bits of [`crate::features`].
    pub features: u32,
    /// Most interactions of a path with the object, D.
    pub max_depth: u32,
    /// Whether the shadow ratio is computed.
    pub shadow: bool,
    /// Whether a proxy mesh shadows itself.
    pub proxy_occlusion: bool,
    /// Light of the object on the proxy, if it counts.
    pub light_on_proxy: Option<LightOnProxy>,
}

/// How a picture is rendered, whatever is in it.
#[derive(Clone, Copy, Debug)]
pub struct Settings<'a> {
    /// Seed of all random numbers.
    pub seed: u64,
    /// When to stop.
    pub stop: Stop,
    /// Most samples in any pixel.
    pub max_samples: u32,
    /// The photograph, linear, of the camera's size: weighs errors by what is seen of them, and
    /// is what the proxy looks like to rays from the object.
    pub background: Option<&'a LinearImage>,
    /// From linear to display values, in which errors are measured.
    pub transfer: Transfer,
    /// 1 where the photograph's own foreground hides the object, 0 where it does not; of the
    /// camera's size.
    pub occluders: Option<&'a Raster<f32>>,
    /// Share of a plane's light that may be blocked without being looked for.
    pub shadow_tolerance: f32,
}

impl Default for Settings<'_> {
    fn default() -> Self {
        Self {
            seed: 0,
            stop: Stop::TargetError(0.004),
            max_samples: 1 << 14,
            background: None,
            transfer: Transfer::Srgb,
            occluders: None,
            // Display values change by less than a tenth of an 8-bit step.
            shadow_tolerance: 2e-4,
        }
    }
}

/// The layers and how they came about.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// Colour, coverage, shadow ratio and their variances.
    pub film: Film,
    /// Estimated error of the composite.
    pub error: EstimatedError,
    /// Rays traced.
    pub counts: RayCounts,
    /// Image samples drawn, all layers.
    pub samples: u64,
    /// Rounds of adaptive sampling.
    pub rounds: u32,
}

/// Side of the blocks of pixels that are scheduled and refined as one.
const BLOCK: u32 = 8;

/// Interactions after which Russian roulette may end a path. Earlier, the rays that it saves
/// are outweighed by its variance: most paths of opaque objects have left by then.
const ROULETTE_DEPTH: u32 = 4;

/// A scene with its hierarchies built, to be rendered under lights and plans.
#[derive(Clone)]
pub struct Renderer<'a> {
    scene: &'a Scene,
    camera: Camera,
    geometry: Arc<Geometry>,
}

impl<'a> Renderer<'a> {
    /// Builds the hierarchies of `scene`.
    pub fn new(scene: &'a Scene) -> Self {
        Self {
            scene,
            camera: scene.camera,
            geometry: Arc::new(Geometry::new(scene)),
        }
    }

    /// The same scene seen by another camera; the hierarchies are shared.
    pub fn with_camera(&self, camera: Camera) -> Self {
        Self {
            camera,
            ..self.clone()
        }
    }

    /// The camera that renders.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The scene.
    pub fn scene(&self) -> &'a Scene {
        self.scene
    }

    /// Shapes and hierarchies.
    pub fn geometry(&self) -> &Arc<Geometry> {
        &self.geometry
    }

    /// Makes the scene ready for the effects in `mask`.
    pub fn world(&self, mask: u32) -> Result<World<'a>, RenderError> {
        World::new(self.scene, self.camera, self.geometry.clone(), mask)
    }

    /// Renders the layers. `progress` is told after every round and may break off. The result
    /// does not depend on the number of threads.
    pub fn render<L: SceneLight>(
        &self,
        light: &L,
        simulation: &Simulation,
        settings: &Settings,
        progress: &mut dyn FnMut(&Progress) -> ControlFlow<()>,
    ) -> Result<Rendered, RenderError> {
        self.check_sizes(settings)?;
        let world = self.world(simulation.features)?;
        let photo = settings
            .background
            .filter(|_| has(simulation.features, PROXY_RADIANCE))
            .map(|image| Photo { image });
        let path = PathContext {
            world: &world,
            light,
            photo: photo.as_ref(),
            max_depth: simulation.max_depth,
            start: PathStart::Camera,
            roulette_depth: ROULETTE_DEPTH,
        };
        let plane = match &self.geometry.proxy {
            ProxyGeometry::Plane(plane) if simulation.shadow => Some(light.on_plane(plane.normal)),
            _ => None,
        };
        let blocker = self
            .geometry
            .bvh
            .bounding_sphere()
            .map(|whole| Blocker::new(whole, self.geometry.bvh.clusters()));
        let mut jobs = self.object_jobs(settings);
        if let (Some(blocker), true) = (&blocker, simulation.shadow) {
            let arriving = plane.as_ref().map(|p| p.irradiance().as_vec3());
            let shadow = ShadowContext {
                path,
                blocker,
                plane: plane.as_ref(),
                proxy_occlusion: simulation.proxy_occlusion,
                light_on_proxy: simulation.light_on_proxy,
                tolerance: settings.shadow_tolerance,
            };
            jobs.extend(self.shadow_jobs(&shadow, arriving, settings));
            let advance = |job: &mut Job, goal: u32| match job.layer {
                Layer::Object => advance_object(&path, settings.seed, job, goal),
                _ => advance_shadow(&shadow, settings.seed, job, goal),
            };
            self.run(jobs, settings, &advance, progress)
        } else {
            let advance =
                |job: &mut Job, goal: u32| advance_object(&path, settings.seed, job, goal);
            self.run(jobs, settings, &advance, progress)
        }
    }

    fn run(
        &self,
        mut jobs: Vec<Job>,
        settings: &Settings,
        advance: &(impl Fn(&mut Job, u32) + Sync),
        progress: &mut dyn FnMut(&Progress) -> ControlFlow<()>,
    ) -> Result<Rendered, RenderError> {
        let [width, height] = self.camera.resolution.map(|n| n as usize);
        let viewing = Viewing {
            background: settings.background,
            transfer: settings.transfer,
        };
        let refined = refine(
            (width, height),
            &mut jobs,
            settings.stop,
            settings.max_samples,
            &viewing,
            advance,
            progress,
        )?;
        let mut film = refined.film;
        if let Some(mask) = settings.occluders {
            film.hide_behind(mask);
        }
        Ok(Rendered {
            film,
            error: refined.error,
            counts: refined.counts,
            samples: refined.samples,
            rounds: refined.rounds,
        })
    }

    fn check_sizes(&self, settings: &Settings) -> Result<(), RenderError> {
        let [camera_width, camera_height] = self.camera.resolution.map(|n| n as usize);
        let check = |what, width, height| {
            if (width, height) == (camera_width, camera_height) {
                return Ok(());
            }
            Err(RenderError::SizeMismatch {
                what,
                width,
                height,
                camera_width,
                camera_height,
            })
        };
        if let Some(image) = settings.background {
            check("background", image.0.width(), image.0.height())?;
        }
        if let Some(mask) = settings.occluders {
            check("occluder mask", mask.width(), mask.height())?;
        }
        Ok(())
    }

    fn blocks(&self) -> impl Iterator<Item = Block> {
        let [width, height] = self.camera.resolution;
        (0..height.div_ceil(BLOCK)).flat_map(move |j| {
            (0..width.div_ceil(BLOCK)).map(move |i| {
                let (x, y) = (i * BLOCK, j * BLOCK);
                Block {
                    x,
                    y,
                    width: BLOCK.min(width - x),
                    height: BLOCK.min(height - y),
                }
            })
        })
    }

    fn object_jobs(&self, settings: &Settings) -> Vec<Job> {
        let bvh = &self.geometry.bvh;
        let footprint = Footprint::new(&self.camera, bvh.bounds(), bvh.clusters());
        self.blocks()
            .filter(|b| footprint.overlaps(b.x, b.y, b.width, b.height))
            .filter_map(|block| {
                let pixels: Vec<_> = pixels_of(block)
                    .filter(|&(x, y)| footprint.holds(x, y) && is_visible(settings, x, y))
                    .collect();
                (!pixels.is_empty()).then(|| Job::new(Layer::Object, block, pixels, None))
            })
            .collect()
    }

    fn shadow_jobs<L: SceneLight>(
        &self,
        shadow: &ShadowContext<L, L::OnPlane>,
        arriving: Option<Vec3>,
        settings: &Settings,
    ) -> Vec<Job> {
        let layer = match &self.geometry.proxy {
            ProxyGeometry::None => return Vec::new(),
            ProxyGeometry::Plane(plane) if self.geometry.is_below(plane) => return Vec::new(),
            ProxyGeometry::Plane(_) => Layer::PlaneShadow,
            ProxyGeometry::Mesh { .. } => Layer::MeshShadow,
        };
        let mut cone = shadow.plane.map(|p| p.cone());
        self.blocks()
            .filter(|&block| match &mut cone {
                Some(cone) => shadow.may_shade(block, cone),
                None => true,
            })
            .filter_map(|block| {
                let pixels: Vec<_> = pixels_of(block).collect();
                let visible = pixels.iter().any(|&(x, y)| is_visible(settings, x, y));
                visible.then(|| Job::new(layer, block, pixels, arriving))
            })
            .collect()
    }
}

fn is_visible(settings: &Settings, x: u32, y: u32) -> bool {
    settings
        .occluders
        .is_none_or(|mask| *mask.get(x as usize, y as usize) < 1.0)
}

fn pixels_of(block: Block) -> impl Iterator<Item = (u32, u32)> {
    (block.y..block.y + block.height)
        .flat_map(move |y| (block.x..block.x + block.width).map(move |x| (x, y)))
}

/// The sequence of one replicate of one pixel. Rows are padded to 2^16 columns, so that a crop or
/// another resolution keeps a pixel's numbers.
fn sequence(seed: u64, stream: Stream, replicate: usize, (x, y): (u32, u32)) -> Sampler {
    Sampler::new(
        hash_u64s(&[seed, replicate as u64]),
        stream,
        (y << 16) | (x & 0xffff),
        0,
    )
}

/// Brings `job` to `goal` samples per pixel and replicate.
fn advance_object<L: SceneLight>(path: &PathContext<L>, seed: u64, job: &mut Job, goal: u32) {
    with_features!(path.world.mask, F => advance_object_with::<L, F>(path, seed, job, goal))
}

fn advance_object_with<L: SceneLight, const F: u32>(
    path: &PathContext<L>,
    seed: u64,
    job: &mut Job,
    goal: u32,
) {
    let mut counts = job.counts;
    for index in 0..job.pixels.len() {
        let (x, y) = job.pixels[index];
        let corner = Vec2::new(x as f32, y as f32);
        for replicate in 0..REPLICATES {
            let base = sequence(seed, Stream::FOREGROUND, replicate, (x, y));
            let (mut radiance, mut coverage) = (Vec3::ZERO, 0.0);
            for sample in job.samples..goal {
                let mut sampler = base.with_sample(sample);
                let s = path.camera_sample::<F>(corner, &mut sampler, &mut counts);
                radiance += s.radiance;
                coverage += s.coverage;
            }
            job.add(index, replicate, &[radiance.x, radiance.y, radiance.z, coverage]);
        }
    }
    job.counts = counts;
    job.samples = goal;
}

fn advance_shadow<L: SceneLight>(
    shadow: &ShadowContext<L, L::OnPlane>,
    seed: u64,
    job: &mut Job,
    goal: u32,
) {
    // Blocking alone asks nothing of a surface but its coverage.
    let wanted = match shadow.light_on_proxy {
        Some(_) => shadow.path.world.mask,
        None if has(shadow.path.world.mask, ALPHA) => ALPHA,
        None => 0,
    };
    with_features!(wanted, F => advance_shadow_with::<L, F>(shadow, seed, job, goal))
}

fn advance_shadow_with<L: SceneLight, const F: u32>(
    shadow: &ShadowContext<L, L::OnPlane>,
    seed: u64,
    job: &mut Job,
    goal: u32,
) {
    let mut counts = job.counts;
    let range = SampleRange {
        first: job.samples,
        count: goal - job.samples,
    };
    let block = job.block;
    for replicate in 0..REPLICATES {
        let sampler = |x, y| sequence(seed, Stream::SHADOW, replicate, (x, y));
        if let Some(plane) = shadow.plane {
            let mut cone = plane.cone();
            shadow.plane_block::<F>(
                block,
                range,
                &sampler,
                &mut cone,
                &mut counts,
                &mut |x, y, blocked| {
                    let index = ((y - block.y) * block.width + (x - block.x)) as usize;
                    job.add(index, replicate, &blocked.to_array());
                },
            );
        } else {
            for index in 0..job.pixels.len() {
                let (x, y) = job.pixels[index];
                let s = shadow.mesh_pixel::<F>((x, y), range, &sampler(x, y), &mut counts);
                let (b, a) = (s.blocked, s.arriving);
                job.add(index, replicate, &[b.x, b.y, b.z, a.x, a.y, a.z, s.hits]);
            }
        }
    }
    job.counts = counts;
    job.samples = goal;
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use dipir_light::environment::EnvironmentSampler;
    use dipir_light::gaussian::{SgMixture, SphericalGaussian};
    use dipir_light::rasterize::rasterize;
    use dipir_scene::proxy::Proxy;

    use super::*;
    use crate::features::ALL;
    use crate::shapes::{icosphere, torus_knot};
    use crate::testing::{
        camera, carry_on, everything, ground, lambertian, matte, render, scene, settings, sky, sun,
    };

    fn knot_scene(n: u32) -> Scene {
        let view = camera(Vec3::new(0.0, 2.0, 4.0), Vec3::Y * 0.5, 40.0, n);
        let knot = torus_knot(Vec3::Y * 0.7, 0.4, 0.15, 96, 12);
        scene(knot, matte(Vec3::splat(0.6)), view, ground())
    }

    fn sunny() -> EnvironmentSampler {
        let direction = Vec3::new(0.5, 0.8, 0.4).normalize();
        EnvironmentSampler::new(sun(direction, 2000.0, 0.5, 64))
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bytes() {
        let s = knot_scene(40);
        let settings = Settings {
            stop: Stop::TargetError(0.02),
            ..settings(0, 5)
        };
        let with = |threads| {
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .expect("a pool")
                .install(|| render(&s, &sunny(), &everything(3), &settings))
        };
        let (one, two) = (with(1), with(2));
        assert_eq!(one.film.object, two.film.object);
        assert_eq!(one.film.alpha, two.film.alpha);
        assert_eq!(one.film.shadow, two.film.shadow);
        assert_eq!(one.film.shadow_variance, two.film.shadow_variance);
        assert_eq!((one.counts, one.rounds), (two.counts, two.rounds));
        assert_eq!(one.error, two.error);
    }

    #[test]
    fn the_estimated_error_is_the_real_one() {
        // Against a converged picture, over 12 seeds: both mean squares are averages over
        // thousands of pixels and agree within the spread of their ratio, about 5%.
        let s = knot_scene(24);
        let light = sunny();
        let converged = render(&s, &light, &lambertian(2), &settings(8192, 99));
        let (mut estimated, mut real) = (0.0, 0.0);
        for seed in 0..12 {
            let r = render(&s, &light, &lambertian(2), &settings(32, seed));
            estimated += r.error.rmse.powi(2) * r.error.touched_pixels as f64;
            for i in 0..24 * 24 {
                let display = |r: &Rendered| {
                    let linear = dipir_imaging::composite::composite_pixel(
                        Vec3::splat(0.18),
                        r.film.object.pixels()[i],
                        r.film.alpha.pixels()[i],
                        r.film.shadow.pixels()[i],
                    );
                    linear.clamp(Vec3::ZERO, Vec3::ONE)
                };
                real += f64::from((display(&r) - display(&converged)).length_squared()) / 3.0;
            }
        }
        let ratio = (estimated / real).sqrt();
        assert!((0.88..1.12).contains(&ratio), "{ratio}");
    }

    #[test]
    fn a_target_error_is_met_and_costs_more_the_lower_it_is() {
        let s = knot_scene(32);
        let mut samples = Vec::new();
        for target in [0.02, 0.008] {
            let settings = Settings {
                stop: Stop::TargetError(target),
                transfer: Transfer::Srgb,
                ..settings(0, 1)
            };
            let mut errors = Vec::new();
            let r = Renderer::new(&s)
                .render(&sunny(), &lambertian(2), &settings, &mut |p| {
                    errors.push(p.error.upper_95);
                    ControlFlow::Continue(())
                })
                .expect("renders");
            assert!(r.error.upper_95 <= f64::from(target), "{:?}", r.error);
            assert!(r.error.rmse > 0.3 * f64::from(target), "wasteful: {:?}", r.error);
            assert_eq!(errors.len() as u32, r.rounds);
            samples.push(r.samples);
        }
        assert!(samples[1] > 2 * samples[0], "{samples:?}");
    }

    #[test]
    fn a_time_budget_ends_after_a_round_and_a_target_that_cannot_be_met_at_the_most_samples() {
        let s = knot_scene(16);
        let none = Settings {
            stop: Stop::TimeBudget(Duration::ZERO),
            ..settings(0, 1)
        };
        let r = render(&s, &sunny(), &lambertian(2), &none);
        assert_eq!(r.rounds, 1);
        let impossible = Settings {
            stop: Stop::TargetError(1e-9),
            max_samples: 64,
            ..settings(0, 1)
        };
        let r = render(&s, &sunny(), &lambertian(2), &impossible);
        assert!(r.error.rmse > 1e-9 && r.samples <= 2 * 64 * 256);
    }

    #[test]
    fn progress_can_break_off() {
        let s = knot_scene(16);
        let result = Renderer::new(&s).render(
            &sunny(),
            &lambertian(1),
            &settings(64, 1),
            &mut |_| ControlFlow::Break(()),
        );
        assert!(matches!(result, Err(RenderError::Interrupted)));
    }

    #[test]
    fn images_of_another_size_are_refused_in_words() {
        let s = knot_scene(16);
        let photo = LinearImage(Raster::filled(4, 3, Vec3::ONE));
        let settings = Settings {
            background: Some(&photo),
            ..settings(4, 1)
        };
        let error = Renderer::new(&s)
            .render(&sunny(), &lambertian(1), &settings, &mut carry_on)
            .expect_err("sizes differ");
        assert_eq!(
            error.to_string(),
            "the background is 4 x 3 pixels, the camera 16 x 16: give images of the camera's size"
        );
    }

    #[test]
    fn occluders_hide_object_and_shadow_and_save_their_rays() {
        let s = knot_scene(16);
        let mask = Raster::filled(16, 16, 1.0);
        let hidden = Settings {
            occluders: Some(&mask),
            ..settings(4, 1)
        };
        let r = render(&s, &sunny(), &lambertian(1), &hidden);
        assert!(r.film.alpha.pixels().iter().all(|&a| a == 0.0));
        assert!(r.film.shadow.pixels().iter().all(|v| *v == Vec3::ONE));
        assert_eq!(r.counts.total(), 0);
    }

    #[test]
    fn an_empty_scene_and_a_picture_of_one_pixel_render() {
        let view = camera(Vec3::Z * 4.0, Vec3::ZERO, 40.0, 1);
        let empty = scene(Default::default(), matte(Vec3::ONE), view, ground());
        let r = render(&empty, &sky(1.0), &everything(4), &settings(4, 1));
        assert_eq!((r.counts.total(), r.samples), (0, 0));
        assert_eq!(r.film.shadow.pixels(), [Vec3::ONE]);
        let ball = icosphere(Vec3::ZERO, 1.0, 2);
        let one = scene(ball, matte(Vec3::ONE), view, Proxy::None);
        let r = render(&one, &sky(1.0), &everything(4), &settings(16, 1));
        assert!(r.film.alpha.pixels()[0] > 0.0);
    }

    #[test]
    fn gaussian_lobes_and_their_fine_map_light_the_same_picture() {
        let lobes = vec![
            SphericalGaussian {
                direction: Vec3::new(0.5, 0.8, 0.4).normalize(),
                radiance: Vec3::new(60.0, 50.0, 40.0),
                sigma: 0.05,
            },
            SphericalGaussian {
                direction: Vec3::new(-0.4, 0.6, -0.3).normalize(),
                radiance: Vec3::new(0.5, 0.7, 1.0),
                sigma: 0.8,
            },
        ];
        let s = knot_scene(16);
        let map = EnvironmentSampler::new(rasterize(&lobes, 512, 256));
        let mixture = SgMixture::new(lobes).expect("valid lobes");
        let a = Renderer::new(&s)
            .render(&mixture, &everything(2), &settings(512, 1), &mut carry_on)
            .expect("renders");
        let b = render(&s, &map, &everything(2), &settings(512, 1));
        let mean = |r: &Raster<Vec3>| {
            let sum: Vec3 = r.pixels().iter().sum();
            sum / 256.0
        };
        // Standard errors of the means are below 2e-3; the map is integrated to 1%.
        let (x, y) = (mean(&a.film.object), mean(&b.film.object));
        assert!(x.abs_diff_eq(y, 0.01 * y.max_element() + 4e-3), "{x} {y}");
        let (x, y) = (mean(&a.film.shadow), mean(&b.film.shadow));
        assert!(x.abs_diff_eq(y, 4e-3), "{x} {y}");
        assert!(x.max_element() < 0.97, "the test must be able to fail");
    }

    #[test]
    fn superset_kernels_draw_the_same_picture() {
        // A matte object needs only the specular lobe; the widest kernel must agree to rounding.
        let s = knot_scene(16);
        let light = sunny();
        let narrow = Simulation {
            features: crate::features::SPECULAR,
            ..everything(2)
        };
        let wide = Simulation {
            features: ALL,
            ..everything(2)
        };
        let a = render(&s, &light, &narrow, &settings(16, 1)).film;
        let b = render(&s, &light, &wide, &settings(16, 1)).film;
        for (a, b) in a.object.pixels().iter().zip(b.object.pixels()) {
            assert!(a.abs_diff_eq(*b, 1e-4 * (1.0 + a.max_element())), "{a} {b}");
        }
        assert_eq!(a.shadow, b.shadow);
    }
}
