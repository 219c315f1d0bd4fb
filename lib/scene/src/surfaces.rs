//! Surfaces that the photograph shows beside the proxy: they catch the objects' shadows, too.
use dipir_imaging::raster::Raster;
use glam::{DMat3, DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;

use crate::camera::Camera;
use crate::foreground::{pixel_of, texels_at};

/// What the photograph shows before the proxy, by its depths. Light passes through it: how it is lit is part of the light.
#[derive(Clone, Debug, PartialEq)]
pub struct SeenSurfaces {
    /// Share of each pixel of the photograph in which they are seen, from 0 to 1.
    share: Raster<f32>,
    /// Planes through the surfaces, at any resolution: one over the depth is `p . (u, v, 1)` where the camera looks `u` to the
    /// right and `v` upwards, per metre ahead. NaN where nothing is known.
    planes: Raster<Vec3>,
}

/// A point of a surface as the camera sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// World space, metres.
    pub position: Vec3,
    /// Unit normal on the side of the camera.
    pub normal: Vec3,
    /// Along the optical axis, metres.
    pub depth: f32,
}

/// Planes along the longer side, at most.
const MOST: usize = 768;
/// Half the side of the window that a plane is fitted in, as a share of the longer side.
const WINDOW: f64 = 1.0 / 80.0;
/// Values of a window, from its middle to a side, at most.
const STEPS: usize = 4;
/// Texels from the middle of a window to a side, at least.
const LEAST: usize = 2;
/// The first fit takes values whose disparity differs from the middle's by less than this share of it.
const NEAR: f64 = 0.1;
/// Later fits leave out values whose disparity is off the plane by this share or more: the larger of the first number, and
/// the second times the standard deviation of the ground's depths.
const CUT: (f64, f64) = (0.02, 4.0);
/// Fits, each with the weights of the one before.
const ROUNDS: usize = 3;
/// Penalty on slopes, in squares of a step: far below what a window weighs, for windows of one row.
const PENALTY: f64 = 1e-3;

/// Times that each plane is compared with its neighbours.
const SETTLED: usize = 2;
/// A plane is kept if the mean square of what the disparities around it are off, in units of [`CUT`], is less than this.
const FITS: f64 = 0.1;
/// A neighbour replaces it if its mean square is less than this share of that.
const BETTER: f64 = 0.5;
/// Texels by which planes are extended at their edges, because the mask, which follows the photograph, may reach so far.
const BEYOND: usize = 2;
/// Where a surface is nearer than the ground by less than so many margins, the two planes decide which is seen; elsewhere the
/// mask does.
const APART: f64 = 2.0;

/// Disparities of a photograph.
pub(crate) struct Map<'a> {
    /// One over depths, 1/metre; NaN where nothing is known.
    pub disparities: &'a Raster<f32>,
    /// Their standard deviation, relative.
    pub deviation: f64,
    /// What is nearer than the ground by this share of its depth is none of it.
    pub margin: f64,
    /// The photograph's.
    pub camera: &'a Camera,
}

impl SeenSurfaces {
    /// Planes at any resolution, as `p . (u, v, 1)` is one over their depth (1/metre) where the camera looks `u` to the right
    /// and `v` upwards, per metre ahead; NaN where nothing is known. They are seen in `share` of each pixel of the photograph.
    pub fn new(share: Raster<f32>, planes: Raster<Vec3>) -> Self {
        Self { share, planes }
    }

    /// The surfaces of `map`, which are seen in `share` of each pixel. `ground` is the proxy's disparity at a pixel, 0 where
    /// there is none.
    ///
    /// Planes are fitted to what is nearer than the ground by the margin. At the foot of a wall the distance is smaller. There
    /// the plane above is extended downwards while it is nearer than the ground and the map agrees with it.
    pub(crate) fn of_map(
        share: Raster<f32>,
        map: &Map,
        ground: impl Fn(usize, usize) -> f64 + Sync,
    ) -> Self {
        let disparities = map.disparities;
        let own = [disparities.width(), disparities.height()];
        let is_before = |i: usize| {
            let disparity = f64::from(disparities.pixels()[i]);
            let [x, y] = pixel_of([i % own[0], i / own[0]], own, map.camera);
            disparity > 0.0 && 1.0 - ground(x, y) / disparity > map.margin
        };
        let before = (0..own[0] * own[1]).into_par_iter().map(is_before);
        let window = Window {
            map,
            before: Raster::from_pixels(own[0], own[1], before.collect()),
        };
        let every = own[0].max(own[1]).div_ceil(MOST);
        let size = own.map(|n| n.div_ceil(every));
        let middle = |x: usize, y: usize| {
            let side = |k: usize, i: usize| (i * every + every / 2).min(own[k] - 1);
            [side(0, x), side(1, y)]
        };
        let plane = |i: usize| window.plane(middle(i % size[0], i / size[0]));
        let planes = (0..size[0] * size[1]).into_par_iter().map(plane);
        let planes = Raster::from_pixels(size[0], size[1], planes.collect::<Vec<_>>());
        let mut planes = (0..SETTLED).fold(planes, |planes, _| window.settled(&planes, middle));
        for y in 1..size[1] {
            for x in 0..size[0] {
                let above = *planes.get(x, y - 1);
                if above.is_nan() || !planes.get(x, y).is_nan() {
                    continue;
                }
                let at = middle(x, y);
                let way = window.way(at[0], at[1]).extend(1.0);
                let (goes_on, found) = (above.as_dvec3().dot(way), *disparities.get(at[0], at[1]));
                let [u, v] = pixel_of(at, own, map.camera);
                let agrees = (f64::from(found) / goes_on - 1.0).abs() < map.margin;
                if goes_on > ground(u, v) && agrees {
                    *planes.get_mut(x, y) = above;
                }
            }
        }
        let mut surfaces = Self {
            share,
            planes: (0..BEYOND).fold(planes, |planes, _| grown(&planes)),
        };
        surfaces.meet(map, ground);
        surfaces
    }

    /// Sets the share to 0 or 1 where ground and surface are close to each other: the nearer one is seen. Where no plane is
    /// known, no surface is seen.
    fn meet(&mut self, map: &Map, ground: impl Fn(usize, usize) -> f64 + Sync) {
        let camera = map.camera;
        let width = self.share.width();
        let seen = |i: usize| {
            let (x, y) = (i % width, i / width);
            let behind = ground(x, y);
            let own = *self.share.get(x, y);
            if own == 0.0 && behind == 0.0 {
                return 0.0;
            }
            let pixel = Vec2::new(x as f32, y as f32) + 0.5;
            let found = self.point_at(camera, pixel);
            let found = found.map(|s| f64::from(s.depth));
            match found {
                Some(depth) if behind > 0.0 && 1.0 - depth * behind < APART * map.margin => {
                    f32::from(u8::from(depth * behind < 1.0))
                }
                Some(_) => own,
                None => 0.0,
            }
        };
        let shares = (0..self.share.pixels().len()).into_par_iter().map(seen);
        self.share = Raster::from_pixels(width, self.share.height(), shares.collect());
    }

    /// Share of each pixel of the photograph in which they are seen, from 0 to 1.
    pub fn share(&self) -> &Raster<f32> {
        &self.share
    }

    /// `mask`, of the photograph's size, without the surfaces: it hides shadows on what is behind them, not on themselves.
    pub(crate) fn shadow_mask(&self, mask: &Raster<f32>) -> Raster<f32> {
        let both = mask.pixels().par_iter().zip(self.share.pixels());
        let hides = both.map(|(mask, share)| (mask - share).max(0.0));
        Raster::from_pixels(mask.width(), mask.height(), hides.collect())
    }

    /// Whether they are seen in any of the pixels from `first` up to, not including, `end` of a picture of `resolution` pixels.
    pub fn are_seen(&self, first: [u32; 2], end: [u32; 2], resolution: [u32; 2]) -> bool {
        let size = [self.share.width(), self.share.height()];
        let [columns, rows] = [0, 1].map(|k| {
            let own = |at: u32, up: usize| (at as usize * size[k] + up) / resolution[k] as usize;
            own(first[k], 0)..own(end[k], resolution[k] as usize - 1).min(size[k])
        });
        let mut rows = rows.map(|y| &self.share.row(y)[columns.clone()]);
        rows.any(|row| row.iter().any(|s| *s > 0.0))
    }

    /// The share of a pixel in which they are seen. `camera` is the photograph's, at any resolution.
    #[inline]
    pub fn share_at(&self, camera: &Camera, pixel: Vec2) -> f32 {
        let index = |k: usize, size: usize| {
            let at = pixel[k] / camera.resolution[k] as f32 * size as f32;
            (at as usize).min(size - 1)
        };
        let (x, y) = (index(0, self.share.width()), index(1, self.share.height()));
        *self.share.get(x, y)
    }

    /// The surface point at `pixel`, also where the proxy hides it; `None` where no surface is known.
    pub fn point_at(&self, camera: &Camera, pixel: Vec2) -> Option<Seen> {
        let d = (pixel - camera.principal_px) / camera.focal_px;
        let way = Vec3::new(d.x, -d.y, 1.0);
        let plane = self.plane_at(pixel, camera.resolution, way)?;
        let depth = plane.dot(way).recip();
        // Behind the camera, or farther than a float tells apart.
        if !(depth > 0.0 && depth < FARTHEST_M) {
            return None;
        }
        let to_world = |v: Vec3| camera.rotation * Vec3::new(v.x, v.y, -v.z);
        Some(Seen {
            position: camera.position + to_world(way * depth),
            normal: -to_world(plane).normalize(),
            depth,
        })
    }

    /// The surface point at `pixel`, if surfaces are seen in more than half of the pixel.
    pub fn seen_at(&self, camera: &Camera, pixel: Vec2) -> Option<Seen> {
        match self.share_at(camera, pixel) > 0.5 {
            true => self.point_at(camera, pixel),
            false => None,
        }
    }

    /// Interpolates the planes of the four texels around a pixel of a picture of `resolution` pixels. Texels whose disparity
    /// along `way` differs from the nearest texel's are left out: they belong to another surface.
    fn plane_at(&self, pixel: Vec2, resolution: [u32; 2], way: Vec3) -> Option<Vec3> {
        let size = [self.planes.width(), self.planes.height()];
        let [columns, rows] = [0, 1].map(|k| {
            let place = f64::from(pixel[k]) / f64::from(resolution[k]);
            let (first, second, share) = texels_at(place, size[k]);
            [(first, 1.0 - share), (second, share)]
        });
        let texel = |k: usize| {
            let ((x, u), (y, v)) = (columns[k % 2], rows[k / 2]);
            (*self.planes.get(x, y), u * v)
        };
        let texels = [0, 1, 2, 3].map(texel);
        let known = || texels.iter().filter(|(plane, _)| !plane.is_nan());
        let (nearest, _) = known().max_by(|a, b| a.1.total_cmp(&b.1))?;
        let disparity = nearest.dot(way);
        let (mut sum, mut weights) = (Vec3::ZERO, 0.0);
        for (plane, weight) in known() {
            if (plane.dot(way) - disparity).abs() <= NEAR as f32 * disparity.abs() {
                sum += *plane * *weight;
                weights += weight;
            }
        }
        Some(sum / weights)
    }
}

/// What is farther is no surface, metres.
const FARTHEST_M: f32 = 1e6;

/// Fills unknown texels beside known ones with a neighbour's plane; of several, with that of the smallest depth.
fn grown(planes: &Raster<Vec3>) -> Raster<Vec3> {
    let (width, height) = (planes.width(), planes.height());
    let plane = |i: usize| {
        let (x, y) = (i % width, i / width);
        if !planes.get(x, y).is_nan() {
            return *planes.get(x, y);
        }
        let rows = y.saturating_sub(1)..(y + 2).min(height);
        let around = rows.flat_map(|v| &planes.row(v)[x.saturating_sub(1)..(x + 2).min(width)]);
        let known = around.filter(|p| !p.is_nan());
        *known
            .max_by(|a, b| a.z.total_cmp(&b.z))
            .unwrap_or(&Vec3::NAN)
    };
    let all = (0..width * height).into_par_iter().map(plane);
    Raster::from_pixels(width, height, all.collect())
}

/// Fits planes to disparities around texels. A plane's disparity is linear in the picture.
struct Window<'a> {
    map: &'a Map<'a>,
    /// Where the map is before the ground.
    before: Raster<bool>,
}

impl Window<'_> {
    /// The plane through a texel; NaN where it is not before the ground.
    fn plane(&self, [x, y]: [usize; 2]) -> Vec3 {
        let map = self.map.disparities;
        let size = [map.width(), map.height()];
        if !*self.before.get(x, y) {
            return Vec3::NAN;
        }
        let middle = f64::from(*map.get(x, y));
        let cut = CUT.0.max(CUT.1 * self.map.deviation);
        let longest = size[0].max(size[1]) as f64;
        let reach = ((WINDOW * longest).ceil() as usize).max(LEAST);
        let step = reach.div_ceil(STEPS);
        let offsets = -(reach.div_ceil(step) as isize)..=reach.div_ceil(step) as isize;
        let at = |i: usize, offset: isize, size: usize| {
            i.checked_add_signed(offset * step as isize)
                .filter(|i| *i < size)
        };
        let here = self.way(x, y);
        // Relative to the middle, so that the sums are well conditioned.
        let mut around = Vec::new();
        for v in offsets.clone().filter_map(|o| at(y, o, size[1])) {
            for u in offsets.clone().filter_map(|o| at(x, o, size[0])) {
                if *self.before.get(u, v) {
                    let way = self.way(u, v) - here;
                    let value = f64::from(*map.get(u, v)) / middle - 1.0;
                    around.push((DVec3::new(way.x, way.y, 1.0), value));
                }
            }
        }
        let penalty = PENALTY * self.extent(step).powf(2.0);
        // The first fit is to what is near in depth.
        let mut plane = fitted(&around, |_, value| value / NEAR, penalty);
        for _ in 1..ROUNDS {
            plane = fitted(&around, |p, value| (value - plane.dot(p)) / cut, penalty);
        }
        if !(plane.is_finite() && plane.z.abs() < NEAR) {
            plane = DVec3::ZERO;
        }
        let offset = 1.0 + plane.z - plane.x * here.x - plane.y * here.y;
        (middle * DVec3::new(plane.x, plane.y, offset)).as_vec3()
    }

    /// Replaces planes that do not fit the disparities around them by a neighbour's that does. At an edge a window sees two
    /// sides of a thing, and the fitted plane is neither. `middle` gives the map's texel of a plane.
    fn settled(
        &self,
        planes: &Raster<Vec3>,
        middle: impl Fn(usize, usize) -> [usize; 2] + Sync,
    ) -> Raster<Vec3> {
        let size = [planes.width(), planes.height()];
        let cut = CUT.0.max(CUT.1 * self.map.deviation);
        let near = |[x, y]: [usize; 2], step: usize, size: [usize; 2]| {
            let side = move |at: usize, size: usize| {
                let offsets = [-2isize, -1, 0, 1, 2].map(|o| o * step as isize);
                let places = offsets.map(|o| at.checked_add_signed(o).filter(|i| *i < size));
                places.into_iter().flatten()
            };
            side(y, size[1]).flat_map(move |v| side(x, size[0]).map(move |u| [u, v]))
        };
        let map = self.map.disparities;
        let own = [map.width(), map.height()];
        let settled = |i: usize| {
            let at = [i % size[0], i / size[0]];
            let plane = *planes.get(at[0], at[1]);
            if plane.is_nan() {
                return plane;
            }
            let around =
                near(middle(at[0], at[1]), 1, own).filter(|[u, v]| *self.before.get(*u, *v));
            let around: Vec<(DVec3, f64)> = around
                .map(|[u, v]| (self.way(u, v).extend(1.0), f64::from(*map.get(u, v))))
                .collect();
            let off = |plane: Vec3| -> f64 {
                let each = around.iter().map(|(way, disparity)| {
                    let off = (plane.as_dvec3().dot(*way) / disparity - 1.0) / cut;
                    (off * off).min(1.0)
                });
                each.sum::<f64>() / around.len() as f64
            };
            let kept = off(plane);
            if kept < FITS {
                return plane;
            }
            let beside = near(at, 2, size).map(|[u, v]| *planes.get(u, v));
            let beside = beside.filter(|p| !p.is_nan()).map(|p| (off(p), p));
            match beside.min_by(|a, b| a.0.total_cmp(&b.0)) {
                Some((off, better)) if off < BETTER * kept => better,
                _ => plane,
            }
        };
        let all = (0..size[0] * size[1]).into_par_iter().map(settled);
        Raster::from_pixels(size[0], size[1], all.collect())
    }

    /// Where the camera looks at the middle of a texel: to the right and upwards, per metre ahead.
    fn way(&self, x: usize, y: usize) -> DVec2 {
        let own = self.map.disparities;
        let size = DVec2::new(own.width() as f64, own.height() as f64);
        let camera = self.map.camera;
        let [w, h] = camera.resolution.map(f64::from);
        let pixel = (DVec2::new(x as f64, y as f64) + 0.5) / size * DVec2::new(w, h);
        let d = (pixel - camera.principal_px.as_dvec2()) / camera.focal_px.as_dvec2();
        DVec2::new(d.x, -d.y)
    }

    /// The same for an offset of `step` texels.
    fn extent(&self, step: usize) -> DVec2 {
        self.way(step, 0) - self.way(0, step)
    }
}

/// Slopes and offset of the plane through `samples` by weighted least squares, with Tukey's weights: 0 where `off` is 1 or more.
fn fitted(samples: &[(DVec3, f64)], off: impl Fn(DVec3, f64) -> f64, penalty: DVec2) -> DVec3 {
    let mut squares = DMat3::from_diagonal(penalty.extend(1e-9));
    let mut products = DVec3::ZERO;
    for (p, value) in samples {
        let off = off(*p, *value);
        let left = 1.0 - off * off;
        if left > 0.0 {
            let weighted = *p * (left * left);
            squares += DMat3::from_cols(weighted * p.x, weighted * p.y, weighted * p.z);
            products += weighted * *value;
        }
    }
    squares.inverse() * products
}

#[cfg(test)]
mod tests;
