//! What of the photograph stands in front of the objects and of the ground, by its depths.
use std::path::{Path, PathBuf};

use dipir_imaging::guided::guided;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_imaging::warp::pick;
use dipir_points::scale::{Fitted, Measure, Sample, Scale, fitted};
use dipir_points::{Cloud, PointsError, depth};
use glam::{DVec2, Vec3};
use rayon::prelude::*;

use crate::camera::Camera;
use crate::depth_buffer::{least, nearest};
use crate::error::Error;
use crate::ground;
use crate::mesh::TriangleMesh;
use crate::pixels::ground_at;
use crate::proxy::{Plane, Proxy};
use crate::surfaces::{Map, SeenSurfaces};
use crate::undistortion::Undistortion;

/// Where depths come from.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthSettings {
    /// Their file.
    pub path: PathBuf,
    /// What its values are linear in, if that is said.
    pub measure: Option<Measure>,
    /// Metres of a unit, if that is said.
    pub scale: Option<f32>,
    /// Whether what they show beside the proxy catches shadows.
    pub catches: bool,
}

/// Depths of the undistorted photograph, at any resolution.
#[derive(Clone, Debug)]
pub struct Depths {
    values: Raster<f32>,
    measure: Option<Measure>,
    scale: Option<f32>,
    /// Whether the value 0 is another depth or disparity than 0, if that is known.
    has_shift: Option<bool>,
    wants_surfaces: bool,
}

/// What stands in front.
#[derive(Clone, Debug)]
pub struct Foreground {
    /// 1 where the photograph's own stands before the objects or, where there are none, before the ground.
    pub mask: Raster<f32>,
    /// What they show beside the proxy, if that catches shadows or carries objects.
    pub surfaces: Option<SeenSurfaces>,
    /// What depths were taken for.
    pub fit: DepthFit,
}

/// What depths were taken for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthFit {
    /// Their scale, if it was found on the ground.
    pub fitted: Option<Fitted>,
    /// How much nearer than the object the photograph's own has to be to hide it, as a share of the object's depth.
    pub margin: f64,
    /// The same for the ground and a shadow on it.
    pub ground_margin: f64,
    /// Whether the photograph's own hides all that would be seen of the objects.
    pub hides_objects: bool,
}

/// The margin, by how much what hides is nearer, in standard deviations of the ground's depths.
const DEVIATIONS: f64 = 3.0;
/// Least and greatest margin, as a share of the depth.
const MARGINS: [f64; 2] = [0.03, 0.15];
/// Least margin before the ground: real ground is no plane, and over a bump of that share of the camera's height the shadow
/// goes on.
const GROUND_MARGIN: f64 = 0.08;
/// The margin where the scale is said, and so nothing is known of deviations.
const MARGIN: f64 = 0.05;
/// From the margin on a mask becomes white over this share of it.
const RAMP: f64 = 0.5;
/// From this value on a mask hides.
const HIDDEN: f32 = 0.99;
/// Depth networks are taken to see so many pixels along the longer side (Depth Anything: 518); what is finer in their maps is
/// interpolated.
const NETWORK_PX: f64 = 512.0;
/// Radii of the filter that brings the mask's edges onto the photograph's, pixels: least and most.
const RADII: [f64; 2] = [2.0, 24.0];
/// Variance of colours, of 1 at white, that the filter takes for noise.
const SOFTNESS: f32 = 4e-4;
/// Where a coarse mask is wrong, the filter leaves about so much of the error: masks up to this become 0, those from one minus
/// this on 1.
const CLEAR: f32 = 0.2;
/// Texels to each side within which a blurred edge of a map is made sharp, and within which holes are filled.
const AROUND: usize = 2;
/// At an edge the disparity above the ground's changes within [`AROUND`] texels by at least this share of the largest disparity
/// there, and by at least so many standard deviations of the ground's depths.
const EDGE: (f64, f64) = (0.08, 6.0);
/// By how much the shapes of map and photograph may differ, relative: networks work on multiples of 14 to 32 pixels.
const SAME_SHAPE: f64 = 0.05;
/// From this deviation on there is a doubt: it is at most the 5% within which depths agree with the ground.
const DOUBTFUL: f64 = 0.0495;
/// A map of fewer texels along the longer side, and than the photograph has pixels, shows no surfaces.
const COARSE: usize = 128;
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
        let values = values.and_then(|v| depth::check_shape(&v, photo, SAME_SHAPE).map(|()| v));
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
                // At its own resolution.
                let own = DVec2::new(values.width() as f64, values.height() as f64);
                let scale = own / DVec2::from_array(photo);
                let working = DVec2::from_array(way.size().map(f64::from));
                let size = (working * scale).round().max(DVec2::ONE);
                let map = |p| {
                    let pixel = way.to_photo(DVec2::from_array(p) / size * working)?;
                    Some((pixel * scale).to_array())
                };
                pick(&values, size.to_array().map(|n| n as usize), f32::NAN, map)
            }
        };
        Ok(Self {
            values,
            measure: settings.measure,
            scale: settings.scale,
            has_shift: None,
            wants_surfaces: settings.catches,
        })
    }

    /// Of the kind that was found before, in the same map or in that of the same shot.
    pub(crate) fn like(mut self, found: Option<Scale>) -> Self {
        self.measure = self.measure.or(found.map(|f| f.measure));
        self.has_shift = found.map(|f| f.shift != 0.0);
        self
    }

    /// Looks for surfaces also where they catch no shadows, if an object `rests` on them.
    pub(crate) fn with_surfaces(mut self, rests: bool) -> Self {
        self.wants_surfaces |= rests;
        self
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
        let (scale, mut fit) = self.fit(&ground, camera)?;
        let disparities = self.disparities(&scale, &fit, &ground, camera);
        let [width, height] = camera.resolution.map(|n| n as usize);
        let hidden = |i: usize, surface_m: f64, margin: f64| {
            let disparity = between(&disparities, i % width, i / width, camera);
            // What is unknown or infinitely far hides nothing.
            if !(disparity > 0.0) {
                return 0.0;
            }
            let nearer = 1.0 - 1.0 / (f64::from(disparity) * surface_m);
            ((nearer - margin) / (RAMP * margin)).clamp(0.0, 1.0) as f32
        };
        let radius = self.radius(camera);
        let encoded = |v| Transfer::Srgb.encode_scalar(v);
        let guide = |i: usize| Vec3::from(photo.0.pixels()[i].to_array().map(encoded));
        let filtered = |mask: Vec<f32>| {
            let mask = Raster::from_pixels(width, height, mask);
            let mut mask = guided(&mask, guide, radius, SOFTNESS);
            for m in mask.pixels_mut() {
                *m = ((*m - CLEAR) / (1.0 - 2.0 * CLEAR)).clamp(0.0, 1.0);
            }
            mask
        };
        let of_ground = |i: usize| match ground.metres(i % width, i / width, camera) {
            Some(m) => hidden(i, m, fit.ground_margin),
            None => 0.0,
        };
        let pixels = (0..width * height).into_par_iter();
        let mut mask = filtered(pixels.map(of_ground).collect());
        let surfaces = match self.wants_surfaces && self.is_fine(camera) {
            false => None,
            true => {
                let before_ground = |i: usize| {
                    let metres = ground.metres(i % width, i / width, camera);
                    // Above the horizon all that is known is before the ground.
                    hidden(i, metres.unwrap_or(f64::INFINITY), fit.margin)
                };
                let pixels = (0..width * height).into_par_iter();
                let share = filtered(pixels.map(before_ground).collect());
                let behind = |x: usize, y: usize| {
                    let metres = ground.metres(x, y, camera);
                    metres.map_or(0.0, f64::recip)
                };
                let map = Map {
                    disparities: &disparities,
                    deviation: fit.fitted.map_or(0.0, |f| f.deviation),
                    margin: fit.margin,
                    camera,
                };
                Some(SeenSurfaces::of_map(share, &map, behind))
            }
        };
        if let Some(objects) = objects {
            // The filter sees twice as far as its radius: there the objects' depth goes on, so that their outlines, which
            // the photograph does not show, are no edges of the mask.
            let nearest = nearest(objects, camera);
            let around = least(&nearest, 2 * radius + 1);
            let pixels = around.pixels().par_iter().enumerate();
            let of_objects = |(i, m): (usize, &f32)| match m.is_finite() {
                true => hidden(i, f64::from(*m), fit.margin),
                false => 0.0,
            };
            let before_objects = filtered(pixels.map(of_objects).collect());
            let covered = least(&nearest, 1);
            let of_objects = covered.pixels().iter().zip(before_objects.pixels());
            let (mut seen, mut hidden) = (0usize, 0usize);
            for (m, (depth, before)) in mask.pixels_mut().iter_mut().zip(of_objects) {
                if depth.is_finite() {
                    *m = *before;
                    seen += 1;
                    hidden += usize::from(*before >= HIDDEN);
                }
            }
            fit.hides_objects = seen > 0 && hidden == seen;
        }
        Ok(Foreground {
            mask,
            surfaces,
            fit,
        })
    }

    fn fit(&self, ground: &Ground, camera: &Camera) -> Result<(Scale, DepthFit), Error> {
        let (scale, fitted, margin) = match self.scale {
            Some(factor) => {
                let scale = Scale {
                    measure: Measure::Depth,
                    factor: f64::from(factor),
                    shift: 0.0,
                };
                (scale, None, MARGIN)
            }
            None => {
                let fitted = self.fitted(ground, camera)?;
                let margin = (DEVIATIONS * fitted.deviation).clamp(MARGINS[0], MARGINS[1]);
                (fitted.scale, Some(fitted), margin)
            }
        };
        let fit = DepthFit {
            fitted,
            margin,
            ground_margin: margin.max(GROUND_MARGIN),
            hides_objects: false,
        };
        Ok((scale, fit))
    }

    fn fitted(&self, ground: &Ground, camera: &Camera) -> Result<Fitted, Error> {
        if matches!(ground, Ground::None) {
            return Err(Error::Missing {
                key: "scene.proxy".into(),
                remedy: "the scale of scene.depth is found on the ground: write one, or depth_scale, metres of a unit".into(),
            });
        }
        let (width, height) = (self.values.width(), self.values.height());
        let step = width.max(height).div_ceil(COMPARED);
        let mut samples = Vec::new();
        for y in (step / 2..height).step_by(step) {
            for x in (step / 2..width).step_by(step) {
                let value = f64::from(*self.values.get(x, y));
                if let Some(ground_m) = self.ground_m(x, y, ground, camera) {
                    samples.push(Sample { value, ground_m });
                }
            }
        }
        fitted(&samples, self.measure, self.has_shift).map_err(Error::Points)
    }

    /// Depth of the ground at a texel, metres.
    fn ground_m(&self, x: usize, y: usize, ground: &Ground, camera: &Camera) -> Option<f64> {
        let size = [self.values.width(), self.values.height()];
        let [column, row] = pixel_of([x, y], size, camera);
        ground.metres(column, row, camera)
    }

    /// The same at no more than twice as many texels along a side as a picture of `size` pixels has.
    pub fn within(&self, size: [u32; 2]) -> Self {
        let own = [self.values.width(), self.values.height()];
        let to = [0, 1].map(|k| own[k].min(2 * size[k] as usize));
        let map = |p: [f64; 2]| Some([0, 1].map(|k| p[k] * own[k] as f64 / to[k] as f64));
        Self {
            values: pick(&self.values, to, f32::NAN, map),
            ..*self
        }
    }

    /// One over the depths, 1/metre; NaN where nothing is known. Small holes are filled. A value on a blurred edge becomes that
    /// of the nearer or the farther side. Edges are looked for in what the disparity is above the ground's: bare ground has
    /// none.
    fn disparities(
        &self,
        scale: &Scale,
        fit: &DepthFit,
        ground: &Ground,
        camera: &Camera,
    ) -> Raster<f32> {
        let (width, height) = (self.values.width(), self.values.height());
        let of_ground = |i: usize| {
            let metres = self.ground_m(i % width, i / width, ground, camera);
            metres.map_or(0.0, f64::recip)
        };
        let values = self.values.pixels().par_iter().enumerate();
        let over = values.map(|(i, &value)| {
            let disparity = scale.disparity(value)?;
            Some([disparity, disparity - of_ground(i)].map(|v| v as f32))
        });
        let over: Vec<Option<[f32; 2]>> = over.collect();
        let deviation = fit.fitted.map_or(0.0, |f| f.deviation);
        let edge = EDGE.0.max(EDGE.1 * deviation) as f32;
        let sharp = |i: usize| {
            let (x, y) = (i % width, i / width);
            let columns = x.saturating_sub(AROUND)..(x + AROUND + 1).min(width);
            let rows = y.saturating_sub(AROUND)..(y + AROUND + 1).min(height);
            let around = rows.flat_map(|y| columns.clone().map(move |x| y * width + x));
            let (mut low, mut high, mut most) = (f32::INFINITY, f32::NEG_INFINITY, 0.0f32);
            let (mut sum, mut count) = (0.0, 0.0);
            for [disparity, over] in around.filter_map(|i| over[i]) {
                (low, high, most) = (low.min(over), high.max(over), most.max(disparity));
                (sum, count) = (sum + over, count + 1.0);
            }
            if count == 0.0 {
                return f32::NAN;
            }
            let own = over[i].map_or(sum / count, |[_, over]| over);
            let own = match high - low > edge * most {
                true if own - low < high - own => low,
                true => high,
                false => own,
            };
            (own + of_ground(i) as f32).max(0.0)
        };
        let pixels = (0..width * height).into_par_iter().map(sharp);
        Raster::from_pixels(width, height, pixels.collect())
    }

    /// Points that the depths show, metres, and the standard deviation of the ground's heights among them.
    ///
    /// # Errors
    /// As [`Self::foreground`].
    pub(crate) fn cloud(&self, proxy: &Proxy, camera: &Camera) -> Result<(Cloud, f64), Error> {
        let ground = Ground::of(proxy, camera);
        let (scale, fit) = self.fit(&ground, camera)?;
        let disparities = self.disparities(&scale, &fit, &ground, camera);
        let metres = disparities.map(|d| match *d > 0.0 {
            true => d.recip(),
            false => f32::NAN,
        });
        let cloud = depth::seen_points(&metres, &ground::view(camera, None));
        let height_m = match proxy {
            Proxy::Plane(plane) => (camera.position - plane.point).dot(plane.normal),
            _ => 0.0,
        };
        let deviation = fit.fitted.map_or(0.0, |f| f.deviation);
        Ok((cloud, deviation * f64::from(height_m)))
    }

    /// The error if an object is to rest on surfaces and the map has too few texels for these.
    pub(crate) fn too_coarse(&self) -> Error {
        Error::Config {
            key: "scene.depth".into(),
            value: format!(
                "a map of {} x {} texels",
                self.values.width(),
                self.values.height()
            ),
            accepted: format!("at least {COARSE} along the longer side, for rest = \"surface\""),
        }
    }

    /// Whether the map has enough texels for surfaces.
    fn is_fine(&self, camera: &Camera) -> bool {
        let longest = camera.resolution[0].max(camera.resolution[1]) as usize;
        self.values.width().max(self.values.height()) >= COARSE.min(longest)
    }

    fn radius(&self, camera: &Camera) -> usize {
        let longest = f64::from(camera.resolution[0].max(camera.resolution[1]));
        let own = self.values.width().max(self.values.height()) as f64;
        let radius = (longest / NETWORK_PX).max(1.5 * longest / own);
        radius.clamp(RADII[0], RADII[1]).ceil() as usize
    }
}

impl DepthFit {
    /// Whether the depths follow the ground only roughly: then nothing catches shadows.
    pub fn is_doubted(&self) -> bool {
        self.fitted.is_some_and(|f| f.deviation >= DOUBTFUL)
    }

    /// What may be wrong with the depths, a sentence.
    pub fn doubt(&self) -> Option<String> {
        let fitted = self.fitted.filter(|_| self.is_doubted())?;
        Some(format!(
            "scene.depth: {:.0}% of the depths follow the ground, and these only roughly, so that only what is {:.0}% nearer \
             hides an object, and nothing catches its shadow: are pitch and roll of the camera right, and are they depths along the optical axis, not distances?",
            100.0 * fitted.agreeing,
            100.0 * self.margin
        ))
    }

    /// `disparities; 83% of the ground's agree with it to 1.2%; what is 4% nearer than the object hides it, and what is 4%
    /// nearer than the ground catches its shadow`. Where nothing `catches` shadows, `what is 8% nearer than the ground hides`
    /// them.
    pub fn words(&self, catches: bool) -> String {
        let (of_shadow, does) = match catches {
            true => (self.margin, "catches"),
            false => (self.ground_margin, "hides"),
        };
        let hides = format!(
            "what is {:.0}% nearer than the object hides it, and what is {:.0}% nearer than the ground {does} its shadow",
            100.0 * self.margin,
            100.0 * of_shadow
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

/// The pixel at the middle of a texel of a map of `size` texels.
pub(crate) fn pixel_of(texel: [usize; 2], size: [usize; 2], camera: &Camera) -> [usize; 2] {
    [0, 1].map(|k| (2 * texel[k] + 1) * camera.resolution[k] as usize / (2 * size[k]))
}

/// The two of `size` texels around a place, a share of the map's side from 0 to 1, and the weight of the second.
pub(crate) fn texels_at(place: f64, size: usize) -> (usize, usize, f32) {
    let at = (place * size as f64 - 0.5).clamp(0.0, (size - 1) as f64);
    let first = at as usize;
    (first, (first + 1).min(size - 1), (at - first as f64) as f32)
}

/// The value at a pixel of the camera, between those of the map's; the nearest where one of these is not finite.
fn between(map: &Raster<f32>, x: usize, y: usize, camera: &Camera) -> f32 {
    let size = [map.width(), map.height()];
    let [(left, right, u), (above, below, v)] = [(0, x), (1, y)]
        .map(|(k, i)| texels_at((i as f64 + 0.5) / f64::from(camera.resolution[k]), size[k]));
    let around = [(left, above), (right, above), (left, below), (right, below)];
    let around = around.map(|(column, row)| *map.get(column, row));
    if around.iter().any(|v| !v.is_finite()) {
        let nearest = |a, b, share| if share < 0.5 { a } else { b };
        return *map.get(nearest(left, right, u), nearest(above, below, v));
    }
    let across = |a: f32, b: f32| a + (b - a) * u;
    let [above, below] = [across(around[0], around[1]), across(around[2], around[3])];
    above + (below - above) * v
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
                let point = ground_at(camera, plane, DVec2::new(x as f64, y as f64) + 0.5)?;
                let ahead = -camera.rotation.z_axis.as_dvec3();
                Some((point - camera.position.as_dvec3()).dot(ahead))
            }
        }
    }
}

#[cfg(test)]
mod tests;
