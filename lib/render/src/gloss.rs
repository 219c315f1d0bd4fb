//! Polished ground, which shows the object's mirror image.
//!
//! The ground is a matt surface under a coat with microfacets (GGX, height-correlated masking, Schlick's Fresnel factor). Of
//! what the photograph shows, the coat's share `s` follows from the light: the radiance that its lobe gathers over that of
//! the photograph, 1 at most. The object casts a shadow of ratio `r` on the matt surface and hides the share `c` of the lobe,
//! so that the shadow's ratio becomes `(1 - s) r + s (1 - c)`. What the object sends by way of the coat is added.
//!
//! `c` and that light come from a picture of their own, of the object by way of the ground: one path a sample, whose first
//! direction is drawn from the normals that are visible from the camera.
use std::ops::ControlFlow;
use std::time::Instant;

use dipir_imaging::raster::Raster;
use dipir_imaging::tone::ToneCurves;
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::warp::{Frame, balance_heuristic};
use dipir_scene::camera::{Camera, Ray};
use dipir_scene::proxy::Plane;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::adaptive::{Progress, Stop, Watch};
use crate::blocker::Blocker;
use crate::bsdf::fresnel::schlick_weight;
use crate::bsdf::ggx::{Ggx, reflect};
use crate::error::RenderError;
use crate::film::Film;
use crate::job::{Job, Layer, PixelSet};
use crate::light::{PathLight, PreparedLight, SceneLight};
use crate::render::{Rendered, Renderer, Settings, Simulation};
use crate::shadow::Block;
use crate::viewing::background;
use crate::world::{ProxyGeometry, ProxyPoint, World, plane_point};

/// How polished ground is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gloss {
    /// Perceptual roughness, from 0, a mirror, to 1.
    pub roughness: f32,
    /// Share of the light that is reflected at normal incidence, F0, from 0 to 1.
    pub reflectance: f32,
}

/// Share of a lobe's microfacets that lean less than what is looked at.
const LEANING: f32 = 0.99;
/// Share of a target error, and of a time budget, that is spent on the mirror image.
const SHARE: f64 = 0.5;
const SHARE_OF_TIME: f64 = 0.25;
/// Pixels between the places where the coat's part is known.
const STEP: usize = 4;
/// Directions from the lobe, and as many from the light, for the coat's part.
const DIRECTIONS: u32 = 32;

/// A direction that the coat reflects to, in the frame of the ground.
struct Reflected {
    wi: Vec3,
    /// BSDF times cosine over the density of `wi`.
    weight: f32,
}

impl Gloss {
    /// Reflects all light, and none to the side.
    pub(crate) const MIRROR: Self = Self {
        roughness: 0.0,
        reflectance: 1.0,
    };

    /// By way of the microfacets that `wo` sees; `None` for one that reflects into the ground.
    fn sample(&self, wo: Vec3, u: Vec2) -> Option<Reflected> {
        let ggx = Ggx::new(self.roughness);
        let h = ggx.map_or(Vec3::Z, |ggx| ggx.sample(wo, u));
        let (wi, cosine) = reflect(wo, h);
        let masking = match ggx {
            Some(ggx) => {
                let (o, i) = (ggx.stretched_length(wo), ggx.stretched_length(wi));
                2.0 * wi.z * (wo.z + o) * Ggx::visibility(wo.z, o, wi.z, i)
            }
            None => 1.0,
        };
        (wi.z > 0.0).then(|| Reflected {
            wi,
            weight: self.fresnel(cosine) * masking,
        })
    }

    /// BSDF times cosine, and the density of [`Gloss::sample`]; none for a mirror.
    fn eval(&self, wo: Vec3, wi: Vec3) -> Option<(f32, f32)> {
        let ggx = Ggx::new(self.roughness).filter(|_| wi.z > 0.0)?;
        let h = (wo + wi).try_normalize()?;
        let (o, i) = (ggx.stretched_length(wo), ggx.stretched_length(wi));
        let d = ggx.d(h);
        let value = self.fresnel(wo.dot(h)) * d * Ggx::visibility(wo.z, o, wi.z, i) * wi.z;
        Some((value, Ggx::reflection_pdf(d, wo.z, o)))
    }

    fn fresnel(&self, cosine: f32) -> f32 {
        self.reflectance + (1.0 - self.reflectance) * schlick_weight(cosine)
    }

    /// Where `ray`, from the camera, goes on from the ground, and the share of its light; `None` where it misses the ground,
    /// or ends in it.
    pub(crate) fn ray(&self, world: &World, ray: &Ray, u: Vec2) -> Option<(Ray, f32)> {
        let point = world.proxy_point(ray)?;
        let frame = Frame::from_normal(point.normal);
        let drawn = self.sample(frame.to_local(-ray.direction), u)?;
        Some((point.ray(frame.to_world(drawn.wi)), drawn.weight))
    }

    /// Radiance that the coat sends to the camera along the other way of `ray`.
    fn radiance(&self, plane: &Plane, light: &impl PathLight, ray: &Ray, pixel: u32) -> Vec3 {
        if plane_point(plane, ray).is_none() {
            return Vec3::ZERO;
        }
        let frame = Frame::from_normal(plane.normal);
        let wo = frame.to_local(-ray.direction);
        let is_mirror = Ggx::new(self.roughness).is_none();
        let directions = if is_mirror { 1 } else { DIRECTIONS };
        let mut sum = Vec3::ZERO;
        for index in 0..directions {
            let mut sampler = Sampler::new(0, Stream::SHADOW, pixel, index);
            if let Some(drawn) = self.sample(wo, sampler.next_2d()) {
                let (radiance, light_pdf) = light.eval_with_pdf(frame.to_world(drawn.wi));
                let own = self.eval(wo, drawn.wi).map_or(f32::INFINITY, |e| e.1);
                sum += radiance * (drawn.weight * balance_heuristic(own, light_pdf));
            }
            let drawn = light.sample(sampler.next_2d());
            let seen = self.eval(wo, frame.to_local(drawn.direction));
            if let (Some((value, own)), true) = (seen, drawn.pdf > 0.0) {
                let weight = balance_heuristic(drawn.pdf, own) / drawn.pdf;
                sum += drawn.radiance * (value * weight);
            }
        }
        sum / directions as f32
    }

    /// The most that a direction is off the mirrored one, radians.
    fn spread(&self) -> f32 {
        let alpha = Ggx::new(self.roughness).map_or(0.0, |ggx| ggx.alpha);
        2.0 * (alpha * (LEANING / (1.0 - LEANING)).sqrt()).atan()
    }
}

/// Adds light that ground mirrors to an object that has gone through its tone curve, if there is one.
pub fn add(object: &mut Raster<Vec3>, mirrored: Raster<Vec3>, tone: Option<&ToneCurves>) {
    let mapper = tone.map(ToneCurves::mapper);
    let pixels = object.pixels_mut().par_iter_mut();
    pixels.zip(mirrored.pixels()).for_each(|(object, &light)| {
        if light != Vec3::ZERO {
            *object += mapper
                .as_ref()
                .map_or(light, |m| m.object_pixel(light, 1.0));
        }
    });
}

/// When the picture stops, whose mirror image is known: its error and that of the picture together are as wanted.
pub(crate) fn stop_after(stop: Stop, mirrored: Option<&Rendered>) -> Stop {
    match (stop, mirrored) {
        (Stop::TargetError(target), Some(mirrored)) => {
            let all = f64::from(target).powi(2);
            let left = all - mirrored.error.upper_95.powi(2);
            Stop::TargetError(left.max(all * (1.0 - SHARE * SHARE)).sqrt() as f32)
        }
        _ => stop,
    }
}

/// Progress of the picture, which follows its mirror image if it `is_second`.
pub(crate) fn progress_after<'a>(
    is_second: bool,
    progress: &'a mut Watch,
) -> impl FnMut(&Progress) -> ControlFlow<()> + 'a {
    let before = if is_second { SHARE_OF_TIME } else { 0.0 };
    move |seen| {
        let fraction = before + (1.0 - before) * seen.fraction;
        progress(&Progress { fraction, ..*seen })
    }
}

/// The sides of `block`: left, top, right and bottom.
fn sides(block: Block) -> [f32; 4] {
    let end = [block.x + block.width, block.y + block.height];
    [block.x, block.y, end[0], end[1]].map(|n| n as f32)
}

impl Renderer<'_> {
    /// The jobs that show the object by way of the ground.
    pub(crate) fn mirror_jobs(
        &self,
        gloss: &Gloss,
        blocker: &Blocker,
        hidden: Option<&Raster<f32>>,
    ) -> Vec<Job> {
        let ProxyGeometry::Plane(plane) = &self.geometry().proxy else {
            return vec![];
        };
        let camera = self.camera();
        let at = |x: f32, y: f32| -> Option<(ProxyPoint, Vec3)> {
            let ray = camera.ray(Vec2::new(x, y));
            let along = ray.direction;
            let mirrored = along - 2.0 * along.dot(plane.normal) * plane.normal;
            Some((plane_point(plane, &ray)?, mirrored))
        };
        let spread = gloss.spread();
        // Whether the object may be in the lobe of any point of a rectangle; for one that is cut by the horizon it may.
        let may_show = |[left, top, right, bottom]: [f32; 4]| {
            let corners = [(left, top), (right, top), (left, bottom), (right, bottom)];
            let corners = corners.map(|(x, y)| at(x, y));
            if corners.iter().all(Option::is_none) {
                return false;
            }
            let [Some(a), Some(b), Some(c), Some(d)] = corners else {
                return true;
            };
            let corners = [a, b, c, d];
            let center = 0.25 * corners.iter().map(|c| c.0.position).sum::<Vec3>();
            let middle = corners.iter().map(|c| c.1).sum::<Vec3>().normalize();
            let most = |of: &dyn Fn(&(ProxyPoint, Vec3)) -> f32| {
                corners.iter().map(of).fold(0f32, f32::max)
            };
            let reach = most(&|c| c.0.position.distance(center));
            let turn = most(&|c| c.1.angle_between(middle));
            let cone = blocker.cone(center, reach);
            let half = cone.cos_half_angle.clamp(-1.0, 1.0).acos();
            // Angles come from cosines: a thousandth covers their rounding.
            middle.angle_between(cone.axis) <= half + turn + spread + 1e-3
        };
        let job = |block: Block| {
            if !may_show(sides(block)) {
                return None;
            }
            let pixels = PixelSet::new(block, |(x, y)| {
                let pixel = Block {
                    x,
                    y,
                    width: 1,
                    height: 1,
                };
                let is_hidden = hidden.is_some_and(|m| *m.get(x as usize, y as usize) >= 1.0);
                !is_hidden && may_show(sides(pixel))
            });
            (!pixels.is_empty()).then(|| Job::new(Layer::Object, block, pixels, None))
        };
        let blocks: Vec<Block> = self.blocks().collect();
        blocks.into_par_iter().filter_map(job).collect()
    }

    /// The object by way of the ground, if that is polished and the scene has such ground: its light, and as its coverage the
    /// share of the lobe that it hides.
    pub(crate) fn render_mirrored<L: SceneLight>(
        &self,
        light: &PreparedLight<L>,
        world: &mut World,
        simulation: &Simulation,
        settings: &Settings,
        start: Instant,
        progress: &mut Watch,
    ) -> Result<Option<Rendered>, RenderError> {
        let is_level = match &self.geometry().proxy {
            ProxyGeometry::Plane(plane) => !self.geometry().is_below(plane),
            _ => false,
        };
        let Some(gloss) = settings.gloss.filter(|_| is_level && simulation.shadow) else {
            return Ok(None);
        };
        let stop = match settings.stop {
            Stop::Samples(n) => Stop::Samples(n),
            Stop::TargetError(e) => Stop::TargetError((f64::from(e) * SHARE) as f32),
            Stop::TimeBudget(budget) => {
                let left = budget.saturating_sub(start.elapsed());
                Stop::TimeBudget(start.elapsed() + left.mul_f64(SHARE_OF_TIME))
            }
        };
        let settings = Settings {
            seed: hash_u64s(&[settings.seed, 1]),
            stop,
            highlights: false,
            leave_out: None,
            occluders: None,
            ..*settings
        };
        let simulation = Simulation {
            shadow: false,
            light_on_proxy: None,
            ..*simulation
        };
        let mut progress = |seen: &Progress| {
            let fraction = SHARE_OF_TIME * seen.fraction;
            progress(&Progress {
                round: 0,
                fraction,
                ..*seen
            })
        };
        world.gloss = Some(gloss);
        let rendered = match stop {
            Stop::TimeBudget(budget) => self.render_within(
                light,
                world,
                &simulation,
                &settings,
                budget,
                start,
                &mut progress,
            ),
            _ => {
                let most = settings.most_pixels;
                self.render_at_most(
                    most,
                    light,
                    world,
                    &simulation,
                    &settings,
                    start,
                    &mut progress,
                )
            }
        };
        world.gloss = None;
        rendered.map(Some)
    }

    /// Adds the `mirrored` object to the picture, whose errors add up.
    pub(crate) fn lay_mirrored(
        &self,
        rendered: &mut Rendered,
        mirrored: Rendered,
        light: &impl PathLight,
        settings: &Settings,
    ) {
        rendered.error.rmse = rendered.error.rmse.hypot(mirrored.error.rmse);
        rendered.error.upper_95 = rendered.error.upper_95.hypot(mirrored.error.upper_95);
        rendered.error.touched_pixels =
            (rendered.error.touched_pixels).max(mirrored.error.touched_pixels);
        rendered.samples += mirrored.samples;
        rendered.counts.merge(&mirrored.counts);
        rendered
            .foresight
            .learn_of_effort(mirrored.counts.total() + mirrored.samples);
        let (Some(gloss), ProxyGeometry::Plane(plane)) = (settings.gloss, &self.geometry().proxy)
        else {
            return;
        };
        let film = &mut rendered.film;
        let Film {
            object,
            alpha: covered,
            ..
        } = mirrored.film;
        let is_touched =
            |x: usize, y: usize| *covered.get(x, y) > 0.0 || *film.shadow.get(x, y) != Vec3::ONE;
        let coat = Coat::new(self.camera(), &is_touched, |ray, pixel| {
            gloss.radiance(plane, light, ray, pixel)
        });
        let mut added = object;
        let width = added.width();
        let shadows = film.shadow.pixels_mut().par_chunks_mut(width);
        let rows = shadows.zip(added.pixels_mut().par_chunks_mut(width));
        let alpha = &film.alpha;
        rows.enumerate().for_each(|(y, (shadows, added))| {
            for (x, (shadow, added)) in shadows.iter_mut().zip(added).enumerate() {
                let covered = *covered.get(x, y);
                if covered == 0.0 && *shadow == Vec3::ONE {
                    continue;
                }
                let pixel = Vec2::new(x as f32, y as f32) + 0.5;
                let surfaces = settings.seen_surfaces;
                let seen = surfaces.map_or(1.0, |s| 1.0 - s.share_at(self.camera(), pixel));
                let share = coat.share(x, y, background(settings.background, x, y)) * seen;
                *shadow += share * (Vec3::splat(1.0 - covered) - *shadow);
                *added *= seen * (1.0 - alpha.get(x, y).clamp(0.0, 1.0));
            }
        });
        film.mirrored = Some(added);
    }
}

/// What the coat sends to the camera without the object, at places [`STEP`] pixels apart.
struct Coat(Raster<Vec3>);

impl Coat {
    /// Where pixels are touched; `radiance(ray, number)` is that along a camera's ray.
    fn new(
        camera: &Camera,
        is_touched: &(impl Fn(usize, usize) -> bool + Sync),
        radiance: impl Fn(&Ray, u32) -> Vec3 + Sync,
    ) -> Self {
        let size = camera.resolution.map(|n| n as usize);
        let [columns, rows] = size.map(|n| n / STEP + 2);
        let near =
            |at: usize, end: usize| (STEP * at).saturating_sub(STEP)..(STEP * (at + 1)).min(end);
        let at = |i: usize| {
            let (column, row) = (i % columns, i / columns);
            let mut pixels =
                near(row, size[1]).flat_map(|y| near(column, size[0]).map(move |x| (x, y)));
            if !pixels.any(|(x, y)| is_touched(x, y)) {
                return Vec3::ZERO;
            }
            let place = Vec2::new(column as f32, row as f32) * STEP as f32;
            radiance(&camera.ray(place), i as u32)
        };
        let values = (0..columns * rows).into_par_iter().map(at).collect();
        Self(Raster::from_pixels(columns, rows, values))
    }

    /// Its share of `photo`, which a pixel shows.
    fn share(&self, x: usize, y: usize, photo: Vec3) -> Vec3 {
        let place = (Vec2::new(x as f32, y as f32) + 0.5) / STEP as f32;
        let first = place.floor();
        let along = place - first;
        let row = |y: usize| {
            let x = first.x as usize;
            self.0.get(x, y).lerp(*self.0.get(x + 1, y), along.x)
        };
        let y = first.y as usize;
        let sent = row(y).lerp(row(y + 1), along.y);
        let share = |c: usize| match photo[c] > 0.0 {
            true => (sent[c] / photo[c]).min(1.0),
            false => 0.0,
        };
        Vec3::new(share(0), share(1), share(2))
    }
}

#[cfg(test)]
mod tests;
