//! From a scene, a light and a plan to the layers of a composite.
mod advance;

use std::sync::Arc;
use std::time::Instant;

use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::tone::ToneCurves;
use dipir_imaging::transfer::Transfer;
use dipir_light::luminance::luminance_f64;
use dipir_light::plane::PlaneLight;
use dipir_scene::camera::Camera;
use dipir_scene::scene::{LoadedScene, Scene};
use dipir_scene::surfaces::SeenSurfaces;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use self::advance::{advance_object, advance_shadow};
pub(crate) use self::advance::{pixels_of, sequence};
use crate::adaptive::{EstimatedError, Round, Stop, Watch, refine};
use crate::blocker::Blocker;
use crate::contribution::{LeaveOut, LeftOut};
use crate::counters::RayCounts;
use crate::error::RenderError;
use crate::features::with_features;
use crate::film::Film;
use crate::footprint::Footprint;
use crate::foreground::PathContext;
use crate::foresight::Foresight;
use crate::gbuffer;
use crate::gloss::{self, Gloss};
use crate::guide::PathGuide;
use crate::highlights::{self, Found, Limit};
use crate::job::{Job, Layer, PixelSet};
use crate::light::{PathLight, PreparedLight, SceneLight};
use crate::optics::Optics;
use crate::shadow::{Block, LightDirections, LightOnProxy, ShadowContext};
use crate::viewing::Viewing;
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
    /// What will be done to the layers before they are laid over the photograph, if anything: errors are measured
    /// behind it.
    pub tone: Option<&'a ToneCurves>,
    /// From linear to display values, in which errors are measured.
    pub transfer: Transfer,
    /// How much brighter the picture is shown than it is, where errors are measured: for linear light of any exposure.
    pub gain: f32,
    /// 1 where the photograph's own foreground hides the object, 0 where it does not; of the
    /// camera's size.
    pub occluders: Option<&'a Raster<f32>>,
    /// What of the photograph beside the proxy catches shadows; its share is of the camera's size.
    pub seen_surfaces: Option<&'a SeenSurfaces>,
    /// What hides the shadow, where that is not `occluders`; of the camera's size.
    pub shadow_mask: Option<&'a Raster<f32>>,
    /// Share of a plane's light that may be blocked without being sampled.
    pub shadow_tolerance: f32,
    /// How polished the ground is, if it is a plane; `None` for matt ground.
    pub gloss: Option<Gloss>,
    /// What blurs what the camera sees.
    pub optics: Optics,
    /// Whether to search for [`highlights`] smaller than a pixel; never done where the number of samples is given.
    pub highlights: bool,
    /// Whether noise is [removed](crate::denoise) from object and shadow.
    pub denoise: bool,
    /// Whether [caustics](PathContext::blur_caustics) on the object are blurred. Sharp ones are found by few paths: specks.
    /// The stated error leaves the blur out.
    pub blur_caustics: bool,
    /// A frame of more pixels is rendered at 1/2, 1/4 and so on of its resolution, the finest that has at most
    /// this many, and enlarged. A time budget chooses the resolution itself.
    pub most_pixels: Option<u64>,
    /// What may be left out after the first round, which then measures it.
    pub leave_out: Option<LeaveOut>,
}

impl<'a> Settings<'a> {
    /// For a photograph, its encoding and the mask of its foreground.
    pub fn of(
        background: &'a LinearImage,
        transfer: Transfer,
        occluders: Option<&'a Raster<f32>>,
    ) -> Self {
        Self {
            background: Some(background),
            transfer,
            occluders,
            ..Self::default()
        }
    }

    /// For the photograph of `loaded`, at its full size.
    pub fn of_scene(loaded: &'a LoadedScene) -> Self {
        let photo = &loaded.photo;
        Self {
            seen_surfaces: loaded.catching(),
            shadow_mask: loaded.shadow_mask.as_ref(),
            ..Self::of(&photo.image, photo.transfer, loaded.occluders.as_ref())
        }
    }
}

impl Default for Settings<'_> {
    fn default() -> Self {
        Self {
            seed: 0,
            stop: Stop::TargetError(0.004),
            max_samples: 1 << 14,
            background: None,
            tone: None,
            transfer: Transfer::Srgb,
            gain: 1.0,
            occluders: None,
            seen_surfaces: None,
            shadow_mask: None,
            // Display values change by less than a tenth of an 8-bit step.
            shadow_tolerance: 2e-4,
            gloss: None,
            optics: Optics::default(),
            highlights: true,
            denoise: false,
            blur_caustics: false,
            most_pixels: None,
            leave_out: None,
        }
    }
}

/// The layers and how they came about.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// Colour, coverage, shadow ratio and their variances.
    pub film: Film,
    /// The picture was rendered at one over this of the frame's resolution and enlarged: above 1
    /// where a time budget is too short for the frame, or where it has more than
    /// [`most_pixels`](Settings::most_pixels).
    pub divisor: u32,
    /// Estimated error of the composite: what samples leave, not what a lower resolution does.
    pub error: EstimatedError,
    /// Rays traced.
    pub counts: RayCounts,
    /// Image samples drawn, all layers.
    pub samples: u64,
    /// Rounds of adaptive sampling.
    pub rounds: u32,
    /// What other errors of the rendered picture cost.
    pub foresight: Foresight,
    /// What effects contribute and what was left out, where the settings ask for it.
    pub left_out: Option<LeftOut>,
}

/// Side of the blocks of pixels that are scheduled and refined as one.
const BLOCK: u32 = 8;

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

    /// The same shapes with the materials of `scene`, whose mesh and proxy must be this one's;
    /// the hierarchies are shared.
    pub fn with_materials_of<'b>(&self, scene: &'b Scene) -> Renderer<'b> {
        let shapes = |s: &Scene| (s.mesh.positions.len(), s.mesh.indices.len());
        assert_eq!(shapes(scene), shapes(self.scene), "the same shapes");
        Renderer {
            scene,
            camera: self.camera,
            geometry: self.geometry.clone(),
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
    /// does not depend on the number of threads, unless a time budget decides how much is sampled.
    ///
    /// Memory: 28 bytes for every pixel of the frame, and for those that the object or its shadow
    /// may touch 40 (a plane's shadow), 56 (the object) and 72 (a mesh's shadow) more.
    pub fn render<L: SceneLight>(
        &self,
        light: &L,
        simulation: &Simulation,
        settings: &Settings,
        progress: &mut Watch,
    ) -> Result<Rendered, RenderError> {
        let mut world = self.world(simulation.features)?;
        light.render(self, &mut world, simulation, settings, progress)
    }

    /// What [`SceneLight::render`] does. For its implementations alone: everybody else would compile the kernels once
    /// more.
    pub fn render_under<L: SceneLight>(
        &self,
        world: &mut World,
        light: &L,
        simulation: &Simulation,
        settings: &Settings,
        progress: &mut Watch,
    ) -> Result<Rendered, RenderError> {
        let start = Instant::now();
        self.check_images(settings.background, settings.occluders)?;
        let share = settings.seen_surfaces.map(SeenSurfaces::share);
        for (what, image) in [
            ("share of surfaces", share),
            ("shadow mask", settings.shadow_mask),
        ] {
            if let Some(image) = image {
                self.check_size(what, image.width(), image.height())?;
            }
        }
        let light: &PreparedLight<L> = &PreparedLight {
            on_object: light.on_object(),
            on_plane: match &self.geometry.proxy {
                ProxyGeometry::Plane(plane) if simulation.shadow => light.on_plane(plane.normal),
                _ => Vec::new(),
            },
        };
        world.optics = settings.optics;
        let gloss = self.gloss_of(settings);
        let plain = &gloss::before(gloss.is_some(), settings);
        let mut first = gloss::first(gloss.is_some(), progress);
        let mut rendered =
            self.render_layers(light, world, simulation, plain, start, &mut first)?;
        drop(first);
        self.blur_shadow(&mut rendered.film.shadow, world, settings);
        if let Some(gloss) = gloss {
            self.add_mirrored(
                &mut rendered,
                gloss,
                light,
                world,
                simulation,
                settings,
                start,
                progress,
            )?;
        }
        if let Some(mask) = settings.occluders {
            let of_shadow = settings.shadow_mask.unwrap_or(mask);
            rendered.film.hide_behind(mask, of_shadow);
        }
        Ok(rendered)
    }

    /// Renders the layers at the resolution that the settings ask for, occluders left aside.
    pub(crate) fn render_layers<L: SceneLight>(
        &self,
        light: &PreparedLight<L>,
        world: &mut World,
        simulation: &Simulation,
        settings: &Settings,
        start: Instant,
        progress: &mut Watch,
    ) -> Result<Rendered, RenderError> {
        match settings.stop {
            Stop::TimeBudget(budget) => {
                self.render_within(light, world, simulation, settings, budget, start, progress)
            }
            _ => {
                let most = settings.most_pixels;
                self.render_at_most(most, light, world, simulation, settings, start, progress)
            }
        }
    }

    /// Renders the layers of `world`, occluders left aside; `coarse` is the same picture at a lower
    /// resolution.
    pub(crate) fn render_world<L: SceneLight>(
        &self,
        light: &PreparedLight<L>,
        world: &World,
        simulation: &Simulation,
        settings: &Settings,
        start: Instant,
        coarse: Option<&Film>,
        progress: &mut Watch,
    ) -> Result<Rendered, RenderError> {
        let mut path =
            PathContext::from_camera(world, &light.on_object, simulation, settings.background);
        let plane = &light.on_plane;
        let blocker = self
            .geometry
            .bvh
            .bounding_sphere()
            .map(|whole| Blocker::new(whole, self.geometry.bvh.clusters()));
        let mut jobs = match (&world.polished, &blocker) {
            (Some(ground), Some(blocker)) => self.mirror_jobs(ground, world.optics, blocker),
            _ => self.object_jobs(settings),
        };
        let mut guide_rays = RayCounts::default();
        let guide = match simulation.max_depth {
            0 | 1 => None,
            _ => {
                let (light, seed) = (&light.on_object, settings.seed);
                let pixels = jobs.iter().map(|job| job.pixels.len()).sum();
                with_features!(world.mask, F => {
                    PathGuide::new::<_, F>(world, light, pixels, seed, &mut guide_rays)
                })
            }
        };
        path.guide = guide.as_ref();
        path.blur_caustics = settings.blur_caustics;
        let mut rendered = if let (Some(blocker), true) = (&blocker, simulation.shadow) {
            let irradiance: DVec3 = plane.iter().map(PlaneLight::irradiance).sum();
            let arriving = match self.geometry.proxy {
                ProxyGeometry::Plane(_) => Some(irradiance.as_vec3()),
                _ => None,
            };
            let shadow = ShadowContext {
                path,
                blocker,
                plane,
                irradiance: luminance_f64(irradiance),
                seen_surfaces: settings.seen_surfaces,
                proxy_occlusion: simulation.proxy_occlusion,
                light_on_proxy: simulation.light_on_proxy,
                tolerance: settings.shadow_tolerance,
            };
            jobs.extend(self.shadow_jobs(&shadow, arriving, settings));
            let advance = |job: &mut Job, goal: u32, round: &Round| match job.layer {
                Layer::Object => advance_object(path, settings.seed, job, goal, round),
                _ => advance_shadow(shadow, settings.seed, job, goal, round),
            };
            self.run(
                jobs, settings, start, simulation, &path, &advance, coarse, progress,
            )
        } else {
            let advance = |job: &mut Job, goal: u32, round: &Round| {
                advance_object(path, settings.seed, job, goal, round);
            };
            self.run(
                jobs, settings, start, simulation, &path, &advance, coarse, progress,
            )
        }?;
        rendered.counts.merge(&guide_rays);
        rendered.foresight.learn_of_effort(guide_rays.total());
        Ok(rendered)
    }

    fn run<L: PathLight>(
        &self,
        jobs: Vec<Job>,
        settings: &Settings,
        start: Instant,
        simulation: &Simulation,
        path: &PathContext<L>,
        advance: &(impl Fn(&mut Job, u32, &Round) + Sync),
        coarse: Option<&Film>,
        progress: &mut Watch,
    ) -> Result<Rendered, RenderError> {
        let [width, height] = self.camera.resolution.map(|n| n as usize);
        let laid = path.world.polished.as_ref();
        let laid = laid.map(|ground| ground.laid_at(self.camera.resolution));
        let viewing = Viewing {
            background: laid.as_deref().or(settings.background),
            tone: settings.tone.map(ToneCurves::mapper),
            transfer: settings.transfer,
            gain: settings.gain,
            adds: path.world.polished.is_some(),
            is_blurred: !path.world.optics.is_sharp(),
        };
        let find_highlights = |film: &Film, jobs: &[Job]| {
            // Of what is blurred, a point of the image does not tell where a glint is.
            let is_given = matches!(settings.stop, Stop::Samples(_));
            if !settings.highlights || is_given || !settings.optics.is_sharp() {
                return Found::default();
            }
            let objects = jobs.iter().filter(|job| job.layer == Layer::Object);
            let pixels: Vec<_> = objects.flat_map(|job| job.pixels.iter()).collect();
            let limit = match settings.stop {
                Stop::TimeBudget(budget) => Limit::Until(Instant::now() + budget / 10),
                _ => Limit::Samples(jobs.iter().map(Job::samples_drawn).sum()),
            };
            highlights::find(path, film, &viewing, &pixels, limit, settings.seed)
        };
        // Without the denoiser, what it would save is foreseen for a target.
        let is_foreseen = matches!(settings.stop, Stop::TargetError(_));
        let auxiliary = (settings.denoise || is_foreseen).then(|| {
            // Other samples than those that are filtered.
            gbuffer::auxiliary(path.world, &jobs, !settings.seed)
        });
        let refined = refine(
            (width, height),
            jobs,
            settings.stop,
            start,
            settings.max_samples,
            &viewing,
            *simulation,
            settings.leave_out.as_ref(),
            advance,
            &find_highlights,
            auxiliary.as_ref(),
            settings.denoise,
            coarse,
            progress,
        )?;
        Ok(Rendered {
            film: refined.film,
            divisor: 1,
            error: refined.error,
            counts: refined.counts,
            samples: refined.samples,
            rounds: refined.rounds,
            foresight: refined.foresight,
            left_out: refined.left_out,
        })
    }

    /// Whether images have the camera's size.
    pub(crate) fn check_images(
        &self,
        background: Option<&LinearImage>,
        occluders: Option<&Raster<f32>>,
    ) -> Result<(), RenderError> {
        if let Some(image) = background {
            self.check_size("background", image.0.width(), image.0.height())?;
        }
        if let Some(mask) = occluders {
            self.check_size("occluder mask", mask.width(), mask.height())?;
        }
        Ok(())
    }

    fn check_size(
        &self,
        what: &'static str,
        width: usize,
        height: usize,
    ) -> Result<(), RenderError> {
        let [camera_width, camera_height] = self.camera.resolution.map(|n| n as usize);
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
    }

    pub(crate) fn blocks(&self) -> impl Iterator<Item = Block> {
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
        let footprint = Footprint::new(&self.camera, settings.optics, bvh.bounds(), bvh.clusters());
        self.blocks()
            .filter(|b| footprint.overlaps(b.x, b.y, b.width, b.height))
            .filter_map(|block| {
                let pixels = PixelSet::new(block, |(x, y)| {
                    footprint.holds(x, y) && leaves(settings.occluders, x, y)
                });
                (!pixels.is_empty()).then(|| Job::new(Layer::Object, block, pixels, None))
            })
            .collect()
    }

    fn shadow_jobs<L: PathLight, P: PlaneLight>(
        &self,
        shadow: &ShadowContext<L, P>,
        arriving: Option<Vec3>,
        settings: &Settings,
    ) -> Vec<Job> {
        let layer = match &self.geometry.proxy {
            ProxyGeometry::None => return Vec::new(),
            ProxyGeometry::Plane(plane) if self.geometry.is_below(plane) => return Vec::new(),
            ProxyGeometry::Plane(_) => Layer::PlaneShadow,
            ProxyGeometry::Mesh { .. } => Layer::MeshShadow,
        };
        let blocks: Vec<Block> = self.blocks().collect();
        let directions = shadow
            .seen_surfaces
            .map(|_| LightDirections::new(shadow.path.light));
        let shaded = |blocks: &[Block]| {
            let mut cones: Vec<P::Cone<'_>> = shadow.plane.iter().map(PlaneLight::cone).collect();
            let layer = |block: Block| {
                let of_surfaces = match &directions {
                    Some(directions) => shadow.may_shade_surfaces(block, directions),
                    None => false,
                };
                let shades = of_surfaces
                    || layer == Layer::MeshShadow
                    || shadow.may_shade(block, &mut cones);
                let layer = match of_surfaces {
                    true => Layer::MeshShadow,
                    false => layer,
                };
                shades.then_some((layer, block))
            };
            blocks.iter().copied().filter_map(layer).collect::<Vec<_>>()
        };
        let shaded: Vec<Vec<_>> = blocks.par_chunks(BLOCKS_AT_ONCE).map(shaded).collect();
        let mask = settings.shadow_mask.or(settings.occluders);
        // What is blurred is seen beside what hides it.
        let is_blurred = !settings.optics.is_sharp();
        let shows =
            |block: &Block| is_blurred || pixels_of(*block).any(|(x, y)| leaves(mask, x, y));
        shaded
            .into_iter()
            .flatten()
            .filter(|(_, block)| shows(block))
            .map(|(layer, block)| {
                let arriving = arriving.filter(|_| layer == Layer::PlaneShadow);
                Job::new(layer, block, PixelSet::new(block, |_| true), arriving)
            })
            .collect()
    }
}

/// Blocks that are looked at with the same samplers of cones.
const BLOCKS_AT_ONCE: usize = 1024;

fn leaves(mask: Option<&Raster<f32>>, x: u32, y: u32) -> bool {
    mask.is_none_or(|mask| *mask.get(x as usize, y as usize) < 1.0)
}

#[cfg(test)]
mod tests;
