//! Polished ground, which shows the object's mirror image.
//!
//! The ground is a matt surface under a coat with microfacets (GGX, height-correlated masking, Schlick's Fresnel factor). Of
//! what the photograph shows, `P`, the coat's part `S` follows from the light: the radiance that its lobe gathers, `P` at
//! most. With the object the shadow ratio `r` holds for the rest of `P`, and of `S` the object hides the share `c` of the
//! lobe that it fills, and sends `m` instead:
//!
//! `(P - S) r + S + (m - S c)`
//!
//! What is in brackets comes from a picture of its own, of the object by way of the ground: one path a sample, whose first
//! direction is drawn from the normals that are visible from the camera. Where it adds light it is a layer, else part of the
//! shadow ratio.
use std::borrow::Cow;
use std::ops::ControlFlow;
use std::time::Instant;

use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::tone::{ToneCurves, ToneMapper};
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::warp::{Frame, balance_heuristic};
use dipir_scene::camera::{Camera, Ray};
use dipir_scene::proxy::Plane;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::adaptive::{EstimatedError, Progress, Stop, Watch};
use crate::blocker::Blocker;
use crate::bsdf::fresnel::schlick_weight;
use crate::bsdf::ggx::{Ggx, reflect};
use crate::coarse::shrink;
use crate::error::RenderError;
use crate::film::Film;
use crate::job::{Job, Layer, PixelSet};
use crate::light::{PathLight, PreparedLight, SceneLight};
use crate::optics::Optics;
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
/// Share of a target error, and of a time budget, that is spent on the picture without its mirror image.
const SHARE: f64 = 0.9;
const SHARE_OF_TIME: f64 = 0.75;
/// The coat's part of what the photograph shows at most, unless it reflects more from above: light that the map has where
/// the mirrored ray goes may not be what is mirrored there, for the map is of one place.
const MOST_OF_COAT: f32 = 0.75;
/// Pixels between the places where the coat's part is known, at least, and most such places.
const LEAST_STEP: f32 = 4.0;
const MOST_PLACES: f32 = 65536.0;
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

    /// Radiance that the coat sends to the camera along the other way of `ray`, and the share of light that it reflects.
    fn radiance(
        &self,
        plane: &Plane,
        light: &impl PathLight,
        ray: &Ray,
        place: u32,
    ) -> (Vec3, f32) {
        if plane_point(plane, ray).is_none() {
            return (Vec3::ZERO, 0.0);
        }
        let frame = Frame::from_normal(plane.normal);
        let wo = frame.to_local(-ray.direction);
        let is_mirror = Ggx::new(self.roughness).is_none();
        let directions = if is_mirror { 1 } else { DIRECTIONS };
        let (mut sum, mut share) = (Vec3::ZERO, 0.0);
        for index in 0..directions {
            let mut sampler = Sampler::new(0, Stream::SHADOW, place, index);
            if let Some(drawn) = self.sample(wo, sampler.next_2d()) {
                let (radiance, light_pdf) = light.eval_with_pdf(frame.to_world(drawn.wi));
                let own = self.eval(wo, drawn.wi).map_or(f32::INFINITY, |e| e.1);
                share += drawn.weight;
                sum += radiance * (drawn.weight * balance_heuristic(own, light_pdf));
            }
            let drawn = light.sample(sampler.next_2d());
            let seen = self.eval(wo, frame.to_local(drawn.direction));
            if let (Some((value, own)), true) = (seen, drawn.pdf > 0.0) {
                let weight = balance_heuristic(drawn.pdf, own) / drawn.pdf;
                sum += drawn.radiance * (value * weight);
            }
        }
        let n = directions as f32;
        (sum / n, share / n)
    }

    /// The most that a direction is off the mirrored one, radians.
    fn spread(&self) -> f32 {
        let alpha = Ggx::new(self.roughness).map_or(0.0, |ggx| ggx.alpha);
        2.0 * (alpha * (LEANING / (1.0 - LEANING)).sqrt()).atan()
    }
}

/// Light that is added to the photograph behind a curve, or, below 0, taken from it.
pub(crate) fn toned(tone: Option<&ToneMapper>, light: Vec3) -> Vec3 {
    match tone {
        Some(tone) if light != Vec3::ZERO => {
            tone.object_pixel(light.max(Vec3::ZERO), 1.0) + light.min(Vec3::ZERO)
        }
        _ => light,
    }
}

/// Adds light that ground mirrors to an object that has gone through its tone curve, if there is one.
pub fn add(object: &mut Raster<Vec3>, mirrored: &Raster<Vec3>, tone: Option<&ToneCurves>) {
    let mapper = tone.map(ToneCurves::mapper);
    let pixels = object.pixels_mut().par_iter_mut();
    pixels
        .zip(mirrored.pixels())
        .for_each(|(object, &light)| *object += toned(mapper.as_ref(), light));
}

/// The settings of the picture without its mirror image, if that is to follow.
pub(crate) fn before<'a>(follows: bool, settings: &Settings<'a>) -> Settings<'a> {
    let stop = match settings.stop {
        Stop::TargetError(e) if follows => Stop::TargetError((f64::from(e) * SHARE) as f32),
        Stop::TimeBudget(t) if follows => Stop::TimeBudget(t.mul_f64(SHARE_OF_TIME)),
        stop => stop,
    };
    Settings { stop, ..*settings }
}

/// When the mirror image of a picture with such an `error` stops: both together have the error that is wanted.
fn after(stop: Stop, error: &EstimatedError) -> Stop {
    match stop {
        Stop::TargetError(e) => {
            let all = f64::from(e).powi(2);
            let left = all - error.upper_95.powi(2);
            let left = left.max(all * (1.0 - SHARE * SHARE) * 0.5);
            Stop::TargetError(left.sqrt() as f32)
        }
        stop => stop,
    }
}

/// Progress of the picture without its mirror image, if that follows.
pub(crate) fn first<'a, 'w>(
    follows: bool,
    progress: &'a mut Watch<'w>,
) -> impl FnMut(&Progress) -> ControlFlow<()> + use<'a, 'w> {
    let share = if follows { SHARE_OF_TIME } else { 1.0 };
    move |seen| {
        let fraction = share * seen.fraction;
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
        ground: &Polished,
        optics: Optics,
        blocker: &Blocker,
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
        let spread = ground.gloss.spread();
        let seen = ground.seen_at(camera.resolution);
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
        // The ground around a pixel: as far as it is blurred, and mirrored things behind it, infinitely far at most.
        let widened = |[left, top, right, bottom]: [f32; 4]| {
            if optics.is_sharp() {
                return [left, top, right, bottom];
            }
            let corners = [(left, top), (right, top), (left, bottom), (right, bottom)];
            let reach = corners.map(|(x, y)| {
                let depth = at(x, y).map_or(f32::INFINITY, |(p, _)| camera.depth(p.position));
                let reach = |depth| optics.reach_px(camera, Vec2::new(x, y), depth);
                reach(depth).max(reach(f32::INFINITY))
            });
            let reach = reach.into_iter().fold(Vec2::ZERO, Vec2::max);
            [
                left - reach.x,
                top - reach.y,
                right + reach.x,
                bottom + reach.y,
            ]
        };
        let may_show = |sides: [f32; 4]| {
            let widened = widened(sides);
            // Ground that passes behind the camera may be anywhere.
            !widened.iter().all(|side| side.is_finite()) || may_show(widened)
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
                let is_hidden = seen.is_some_and(|s| *s.get(x as usize, y as usize) == 0.0);
                !is_hidden && may_show(sides(pixel))
            });
            (!pixels.is_empty()).then(|| Job::new(Layer::Object, block, pixels, None))
        };
        let blocks: Vec<Block> = self.blocks().collect();
        blocks.into_par_iter().filter_map(job).collect()
    }

    /// How the ground is polished, if it is a plane that mirrors something.
    pub(crate) fn gloss_of(&self, settings: &Settings) -> Option<Gloss> {
        let mirrors = match &self.geometry().proxy {
            ProxyGeometry::Plane(plane) => !self.geometry().is_below(plane),
            _ => false,
        };
        settings.gloss.filter(|_| mirrors)
    }

    /// Adds what the object changes of the light that the ground mirrors. Errors add up.
    pub(crate) fn add_mirrored<L: SceneLight>(
        &self,
        picture: &mut Rendered,
        gloss: Gloss,
        light: &PreparedLight<L>,
        world: &mut World,
        simulation: &Simulation,
        settings: &Settings,
        start: Instant,
        progress: &mut Watch,
    ) -> Result<(), RenderError> {
        let ProxyGeometry::Plane(plane) = &self.geometry().proxy else {
            return Ok(());
        };
        let coat = Coat::new(
            gloss,
            plane,
            self.camera(),
            &light.on_object,
            settings.background,
        );
        let ground = Polished::new(gloss, coat, &mut picture.film, self.camera(), settings);
        let settings = Settings {
            seed: hash_u64s(&[settings.seed, 1]),
            stop: after(settings.stop, &picture.error),
            highlights: false,
            leave_out: None,
            ..*settings
        };
        let simulation = Simulation {
            shadow: false,
            light_on_proxy: None,
            ..*simulation
        };
        let known = picture.error;
        let mut progress = |seen: &Progress| {
            let fraction = SHARE_OF_TIME + (1.0 - SHARE_OF_TIME) * seen.fraction;
            progress(&Progress {
                round: picture.rounds,
                error: known,
                fraction,
                ..*seen
            })
        };
        world.polished = Some(ground);
        let mirrored =
            self.render_layers(light, world, &simulation, &settings, start, &mut progress);
        let ground = world.polished.take();
        let mirrored = mirrored?;
        let error = &mut picture.error;
        error.rmse = error.rmse.hypot(mirrored.error.rmse);
        error.upper_95 = error.upper_95.hypot(mirrored.error.upper_95);
        error.touched_pixels = error.touched_pixels.max(mirrored.error.touched_pixels);
        picture.samples += mirrored.samples;
        picture.counts.merge(&mirrored.counts);
        let effort = mirrored.counts.total() + mirrored.samples;
        picture.foresight.learn_of_effort(effort);
        if let Some(ground) = ground {
            ground.lay(mirrored.film.object, &mut picture.film, settings.background);
        }
        Ok(())
    }
}

/// Ground that camera rays go on from.
pub(crate) struct Polished {
    pub(crate) gloss: Gloss,
    coat: Coat,
    /// What is seen of it in each pixel of the picture, beside the object.
    seen: Raster<f32>,
    /// The picture without what the object changes of the light that it mirrors.
    laid: LinearImage,
}

impl Polished {
    /// Lightens the shadow of `film` by what the coat sends.
    fn new(
        gloss: Gloss,
        coat: Coat,
        film: &mut Film,
        camera: &Camera,
        settings: &Settings,
    ) -> Self {
        let [width, height] = [film.alpha.width(), film.alpha.height()];
        let size = Vec2::new(width as f32, height as f32);
        let mask = settings.shadow_mask.or(settings.occluders);
        let mut laid = Raster::filled(width, height, Vec3::ZERO);
        let mut seen = Raster::filled(width, height, 0.0);
        let rows = laid.pixels_mut().par_chunks_mut(width);
        let rows = rows.zip(seen.pixels_mut().par_chunks_mut(width));
        let rows = rows.zip(film.shadow.pixels_mut().par_chunks_mut(width));
        let (alpha, surfaces) = (&film.alpha, settings.seen_surfaces);
        rows.enumerate().for_each(|(y, ((laid, seen), shadows))| {
            for x in 0..width {
                let pixel = Vec2::new(x as f32, y as f32) + 0.5;
                let beside = surfaces.map_or(1.0, |s| 1.0 - s.share_at(camera, pixel));
                let photo = background(settings.background, x, y);
                let shadow = &mut shadows[x];
                if *shadow != Vec3::ONE {
                    let sent = coat.at(pixel / size).sent.min(photo);
                    *shadow += over(sent, photo) * (Vec3::ONE - *shadow) * beside;
                }
                let is_hidden =
                    *alpha.get(x, y) >= 1.0 || mask.is_some_and(|m| *m.get(x, y) >= 1.0);
                seen[x] = if is_hidden { 0.0 } else { beside };
                laid[x] = photo * *shadow;
            }
        });
        Self {
            gloss,
            coat,
            seen,
            laid: LinearImage(laid),
        }
    }

    /// Radiance that is missing at the place `at` in the picture where the object fills the lobe.
    #[inline]
    pub(crate) fn hidden(&self, world: &World, at: Vec2) -> Vec3 {
        let [width, height] = world.camera().resolution.map(|n| n as f32);
        self.coat.at(at / Vec2::new(width, height)).from_everywhere
    }

    /// How much of it is seen, if that is known at this resolution.
    fn seen_at(&self, resolution: [u32; 2]) -> Option<&Raster<f32>> {
        let size = [self.seen.width(), self.seen.height()];
        (size == resolution.map(|n| n as usize)).then_some(&self.seen)
    }

    /// The picture, at a resolution no finer than its own.
    pub(crate) fn laid_at(&self, resolution: [u32; 2]) -> Cow<'_, LinearImage> {
        match self.seen_at(resolution) {
            Some(_) => Cow::Borrowed(&self.laid),
            None => {
                let size = resolution.map(|n| n as usize);
                Cow::Owned(LinearImage(shrink(&self.laid.0, size)))
            }
        }
    }

    /// Adds to the picture what the object `changes`.
    fn lay(self, changes: Raster<Vec3>, film: &mut Film, photo: Option<&LinearImage>) {
        let mut changes = changes;
        let width = changes.width();
        let alpha = &film.alpha;
        let shadows = film.shadow.pixels_mut().par_chunks_mut(width);
        let rows = shadows.zip(changes.pixels_mut().par_chunks_mut(width));
        rows.enumerate().for_each(|(y, (shadows, changes))| {
            for (x, (shadow, change)) in shadows.iter_mut().zip(changes).enumerate() {
                if *change != Vec3::ZERO {
                    let seen = *self.seen.get(x, y);
                    let photo = background(photo, x, y);
                    let taken = over(change.min(Vec3::ZERO), photo);
                    *shadow = (*shadow + taken * seen).max(Vec3::ZERO);
                    let uncovered = 1.0 - alpha.get(x, y).clamp(0.0, 1.0);
                    *change = change.max(Vec3::ZERO) * (seen * uncovered);
                }
            }
        });
        film.mirrored = Some(changes);
    }
}

/// `light` over what the photograph shows, 0 where that is black.
fn over(light: Vec3, photo: Vec3) -> Vec3 {
    let share = |c: usize| {
        if photo[c] > 0.0 {
            light[c] / photo[c]
        } else {
            0.0
        }
    };
    Vec3::new(share(0), share(1), share(2))
}

/// The coat without the object, on a grid over the picture.
struct Coat(Raster<CoatPoint>);

#[derive(Clone, Copy, Debug, Default)]
struct CoatPoint {
    /// Radiance that it sends to the camera, that of the photograph around at most.
    sent: Vec3,
    /// That over the share of light that the coat reflects: the mean radiance in its lobe.
    from_everywhere: Vec3,
}

impl CoatPoint {
    fn mix(self, other: Self, along: f32) -> Self {
        Self {
            sent: self.sent.lerp(other.sent, along),
            from_everywhere: self.from_everywhere.lerp(other.from_everywhere, along),
        }
    }
}

impl Coat {
    fn new(
        gloss: Gloss,
        plane: &Plane,
        camera: &Camera,
        light: &impl PathLight,
        photo: Option<&LinearImage>,
    ) -> Self {
        let size = camera.resolution.map(|n| n as usize);
        let step = LEAST_STEP.max(((size[0] * size[1]) as f32 / MOST_PLACES).sqrt());
        let [columns, rows] = size.map(|n| (n as f32 / step).ceil() as usize + 1);
        let at = |i: usize| {
            let place =
                |n: usize, all: usize, k: usize| n as f32 / (all - 1) as f32 * size[k] as f32;
            let at = Vec2::new(place(i % columns, columns, 0), place(i / columns, rows, 1));
            let (sent, share) = gloss.radiance(plane, light, &camera.ray(at), i as u32);
            let around = |k: usize| {
                let end = (at[k] + 0.5 * step).ceil() as usize;
                ((at[k] - 0.5 * step).max(0.0) as usize).min(size[k] - 1)..end.min(size[k])
            };
            let (mut sum, mut count) = (Vec3::ZERO, 0.0);
            for y in around(1) {
                for x in around(0) {
                    sum += background(photo, x, y);
                    count += 1.0;
                }
            }
            let most = MOST_OF_COAT.max(gloss.reflectance);
            let sent = sent.min(sum * (most / count));
            CoatPoint {
                sent,
                from_everywhere: if share > 0.0 {
                    sent / share
                } else {
                    Vec3::ZERO
                },
            }
        };
        let points = (0..columns * rows).into_par_iter().map(at).collect();
        Self(Raster::from_pixels(columns, rows, points))
    }

    /// At a place in the picture, a share of its sides.
    fn at(&self, place: Vec2) -> CoatPoint {
        let size = [self.0.width(), self.0.height()];
        let [(x, u), (y, v)] = [0, 1].map(|k| {
            let at = place[k].clamp(0.0, 1.0) * (size[k] - 1) as f32;
            let first = (at as usize).min(size[k] - 2);
            (first, at - first as f32)
        });
        let row = |y: usize| self.0.get(x, y).mix(*self.0.get(x + 1, y), u);
        row(y).mix(row(y + 1), v)
    }
}

#[cfg(test)]
mod tests;
