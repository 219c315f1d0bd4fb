//! What of the photograph stands in front of the objects and of the ground, by its depths.
use std::path::{Path, PathBuf};

use dipir_imaging::guided::guided;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_imaging::warp::pick;
use dipir_points::scale::{Fitted, Measure, Sample, Scale, fitted};
use dipir_points::{PointsError, depth};
use glam::DVec2;
use rayon::prelude::*;

use crate::camera::Camera;
use crate::depth_buffer::{direction, least, nearest};
use crate::error::Error;
use crate::mesh::TriangleMesh;
use crate::proxy::{Plane, Proxy};
use crate::undistortion::Undistortion;

/// Where depths come from.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthSettings {
    /// Their file.
    pub path: PathBuf,
    /// What its values grow with, if that is said.
    pub measure: Option<Measure>,
    /// Metres of a unit, if that is said.
    pub scale: Option<f32>,
}

/// Depths of the undistorted photograph, at any resolution.
#[derive(Clone, Debug)]
pub struct Depths {
    values: Raster<f32>,
    measure: Option<Measure>,
    scale: Option<f32>,
}

/// What stands in front.
#[derive(Clone, Debug)]
pub struct Foreground {
    /// 1 where the photograph's own stands before the objects or, where there are none, before the ground.
    pub mask: Raster<f32>,
    /// What depths were taken for.
    pub fit: DepthFit,
}

/// What depths were taken for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthFit {
    /// Their scale, if it was found on the ground.
    pub fitted: Option<Fitted>,
    /// How much nearer than a surface the photograph's own has to be to hide it, as a share of the surface's depth.
    pub margin: f64,
}

/// As many standard deviations of the depths of the ground the foreground is nearer than what it hides.
const DEVIATIONS: f64 = 3.0;
/// Least and most of that, as a share of the depth.
const MARGINS: [f64; 2] = [0.02, 0.15];
/// That share where the scale is said, and so nothing is known of deviations.
const MARGIN: f64 = 0.05;
/// From the margin on a mask becomes white over this share of it.
const RAMP: f64 = 0.5;
/// Depth networks see about so many pixels along the longer side; what is finer in their maps is interpolated.
const NETWORK_PX: f64 = 512.0;
/// Radii of the filter that brings the mask's edges onto the photograph's, pixels: least and most.
const RADII: [f64; 2] = [2.0, 24.0];
/// Variance of colours, of 1 at white, that the filter takes for noise.
const SOFTNESS: f32 = 4e-4;
/// Where a coarse mask is off, the filter leaves so much of it: this becomes 0, and one minus this 1.
const CLEAR: f32 = 0.2;
/// Places on the ground along the longer side at which depths are compared with it.
const COMPARED: usize = 128;

impl Depths {
    /// Reads the file for a photograph of `resolution` pixels.
    ///
    /// # Errors
    /// If it cannot be used, or has another shape.
    pub fn read(
        settings: &DepthSettings,
        base_dir: &Path,
        resolution: [u32; 2],
        undistortion: Option<&Undistortion>,
    ) -> Result<Self, Error> {
        let path = base_dir.join(&settings.path);
        let photo = resolution.map(f64::from);
        let values = depth::read(&path);
        let values = values.and_then(|v| depth::check_shape(&v, photo).map(|()| v));
        let values = values.map_err(|e| match e {
            PointsError::Read { path, source } => Error::Read {
                role: "the depths".into(),
                path,
                source,
            },
            other => Error::Points(other).in_file(&path),
        })?;
        let values = match undistortion {
            None => values,
            Some(way) => {
                let own = DVec2::new(values.width() as f64, values.height() as f64);
                let scale = own / DVec2::from_array(photo);
                let map = |p| {
                    let pixel = way.to_photo(DVec2::from_array(p))?;
                    Some((pixel * scale).to_array())
                };
                pick(&values, way.size().map(|n| n as usize), f32::NAN, map)
            }
        };
        Ok(Self {
            values,
            measure: settings.measure,
            scale: settings.scale,
        })
    }

    /// What stands before `objects` and `proxy` in `photo`.
    ///
    /// # Errors
    /// If the scale is to be found and the depths do not agree with the ground.
    pub fn foreground(
        &self,
        objects: Option<&TriangleMesh>,
        proxy: &Proxy,
        camera: &Camera,
        photo: &LinearImage,
    ) -> Result<Foreground, Error> {
        let ground = Ground::of(proxy, camera);
        let (fitted, scale, margin) = match self.scale {
            Some(factor) => {
                let scale = Scale {
                    measure: Measure::Depth,
                    factor: f64::from(factor),
                    shift: 0.0,
                };
                (None, scale, MARGIN)
            }
            None => {
                let fitted = self.fitted(&ground, camera)?;
                let margin = (DEVIATIONS * fitted.deviation).clamp(MARGINS[0], MARGINS[1]);
                (Some(fitted), fitted.scale, margin)
            }
        };
        let [width, height] = camera.resolution.map(|n| n as usize);
        let hidden = |i: usize, surface_m: f64| {
            let (x, y) = (i % width, i / width);
            let nearer = 1.0 - scale.metres(self.at(x, y, camera)) / surface_m;
            ((nearer - margin) / (RAMP * margin)).clamp(0.0, 1.0) as f32
        };
        let radius = self.radius(camera);
        let guide = Transfer::Srgb.encode(photo).0;
        let filtered = |mask: Vec<f32>| {
            let mask = Raster::from_pixels(width, height, mask);
            let mut mask = guided(&mask, &guide, radius, SOFTNESS);
            for m in mask.pixels_mut() {
                *m = ((*m - CLEAR) / (1.0 - 2.0 * CLEAR)).clamp(0.0, 1.0);
            }
            mask
        };
        let of_ground = |i: usize| match ground.metres(i % width, i / width, camera) {
            Some(m) => hidden(i, m),
            None => 0.0,
        };
        let pixels = (0..width * height).into_par_iter();
        let mut mask = filtered(pixels.map(of_ground).collect());
        if let Some(objects) = objects {
            // The filter sees twice as far as its radius: there the objects' depth goes on, so that their outlines, which
            // the photograph does not show, are no edges of the mask.
            let nearest = nearest(objects, camera);
            let around = least(&nearest, 2 * radius + 1);
            let pixels = around.pixels().par_iter().enumerate();
            let of_objects = |(i, m): (usize, &f32)| match m.is_finite() {
                true => hidden(i, f64::from(*m)),
                false => 0.0,
            };
            let before_objects = filtered(pixels.map(of_objects).collect());
            let covered = least(&nearest, 1);
            let of_objects = covered.pixels().iter().zip(before_objects.pixels());
            for (m, (depth, before)) in mask.pixels_mut().iter_mut().zip(of_objects) {
                if depth.is_finite() {
                    *m = *before;
                }
            }
        }
        Ok(Foreground {
            mask,
            fit: DepthFit { fitted, margin },
        })
    }

    /// The value at a pixel, between those of the map's, unless one of them is 0 or unknown: then the nearest.
    fn at(&self, x: usize, y: usize, camera: &Camera) -> f32 {
        let size = [self.values.width(), self.values.height()];
        let [(left, right, u), (above, below, v)] = [(0, x), (1, y)].map(|(k, i)| {
            let at = (i as f64 + 0.5) * size[k] as f64 / f64::from(camera.resolution[k]) - 0.5;
            let at = at.clamp(0.0, (size[k] - 1) as f64);
            let first = at as usize;
            let share = (at - first as f64) as f32;
            (first, (first + 1).min(size[k] - 1), share)
        });
        let of = |column, row| *self.values.get(column, row);
        let around = [
            of(left, above),
            of(right, above),
            of(left, below),
            of(right, below),
        ];
        if around.iter().any(|v| !v.is_finite() || *v == 0.0) {
            let nearest = |a, b, share| if share < 0.5 { a } else { b };
            return of(nearest(left, right, u), nearest(above, below, v));
        }
        let across = |a: f32, b: f32| a + (b - a) * u;
        let [above, below] = [across(around[0], around[1]), across(around[2], around[3])];
        above + (below - above) * v
    }

    fn fitted(&self, ground: &Ground, camera: &Camera) -> Result<Fitted, Error> {
        let [w, h] = camera.resolution.map(|n| n as usize);
        let step = w.max(h).div_ceil(COMPARED);
        let mut samples = Vec::new();
        for y in (step / 2..h).step_by(step) {
            for x in (step / 2..w).step_by(step) {
                let value = f64::from(self.at(x, y, camera));
                if let Some(ground_m) = ground.metres(x, y, camera) {
                    samples.push(Sample { value, ground_m });
                }
            }
        }
        fitted(&samples, self.measure).map_err(Error::Points)
    }

    fn radius(&self, camera: &Camera) -> usize {
        let longest = f64::from(camera.resolution[0].max(camera.resolution[1]));
        let own = self.values.width().max(self.values.height()) as f64;
        let radius = (longest / NETWORK_PX).max(1.5 * longest / own);
        radius.clamp(RADII[0], RADII[1]).ceil() as usize
    }
}

impl DepthFit {
    /// `disparities; 83% of the ground's agree with it to 1.2%; what is 4% nearer than object or ground hides it`.
    pub fn words(&self) -> String {
        let hides = format!(
            "what is {:.0}% nearer than object or ground hides it",
            100.0 * self.margin
        );
        match &self.fitted {
            None => hides,
            Some(fitted) => {
                let kind = match fitted.scale.measure {
                    Measure::Depth => "depths",
                    Measure::Disparity => "disparities",
                };
                format!(
                    "{kind}; {:.0}% of the ground's agree with it to {:.1}%; {hides}",
                    100.0 * fitted.agreeing,
                    100.0 * fitted.deviation
                )
            }
        }
    }
}

/// Depths of the ground.
enum Ground {
    None,
    Plane(Plane),
    Mesh(Raster<f32>),
}

impl Ground {
    fn of(proxy: &Proxy, camera: &Camera) -> Self {
        match proxy {
            Proxy::None => Self::None,
            Proxy::Plane(plane) => Self::Plane(*plane),
            Proxy::Mesh(mesh) => Self::Mesh(nearest(mesh, camera)),
        }
    }

    /// Along the optical axis, metres, where the pixel sees it.
    fn metres(&self, x: usize, y: usize, camera: &Camera) -> Option<f64> {
        match self {
            Self::None => None,
            Self::Mesh(depths) => {
                let depth = *depths.get(x, y);
                depth.is_finite().then_some(f64::from(depth))
            }
            Self::Plane(plane) => {
                let direction = camera.rotation.as_dmat3() * direction(x, y, camera);
                let normal = plane.normal.as_dvec3();
                let away = normal.dot(plane.point.as_dvec3() - camera.position.as_dvec3());
                let depth = away / normal.dot(direction);
                (depth.is_finite() && depth > 0.0).then_some(depth)
            }
        }
    }
}

#[cfg(test)]
mod tests;
