//! The pinhole camera whose picture stands for a photograph with a lens that bends lines.
//!
//! Everything between the photograph and the composite works on that picture, the working picture.
//! It has the lens's focal lengths, so that its pixels are as large as the photograph's in the
//! middle, and shows all that the photograph shows, up to [`MOST_LARGER`] times its size.
use dipir_cameras::{Camera as LensCamera, Lens, Pose};
use dipir_imaging::ImagingError;
use dipir_imaging::error::MAX_PIXELS;
use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::raster::Raster;
use dipir_imaging::warp::{Ordered, Outside, pick, warp};
use glam::{DVec2, DVec3};

use crate::camera::Camera;
use crate::error::Error;

/// A photograph's lens and the working picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Undistortion {
    lens: Lens,
    /// Where the working picture has its optical axis, pixels.
    principal_px: DVec2,
    resolution: [u32; 2],
}

/// How many times as far from the optical axis as the photograph's border the border of the working
/// picture lies at most: of a fisheye's picture of 180 degrees it shows the inner 145 or so.
const MOST_LARGER: f64 = 2.0;
/// Pixels around what the photograph shows, for filters.
const MARGIN: f64 = 2.0;
/// Positions along a side of the photograph that are followed.
const STEPS: usize = 128;

impl Undistortion {
    /// Of a photograph with `lens`; `None` if it is a pinhole's.
    pub fn of(lens: &Lens) -> Option<Self> {
        if lens.distortion.is_none() {
            return None;
        }
        let size = DVec2::from_array(lens.size);
        let least = -MOST_LARGER * lens.principal_px.max(DVec2::ONE);
        let most = MOST_LARGER * (size - lens.principal_px).max(DVec2::ONE);
        let (mut low, mut high) = (most, least);
        for i in 0..=STEPS {
            let t = i as f64 / STEPS as f64;
            for share in [[t, 0.0], [t, 1.0], [0.0, t], [1.0, t]] {
                let pixel = DVec2::from_array(share) * size;
                let from_axis = match straight(lens, pixel) {
                    Some(point) => point,
                    // Not seen by a pinhole: as far as the picture goes, in the same direction.
                    None => (pixel - lens.principal_px) * 1e6,
                };
                let from_axis = from_axis.clamp(least, most);
                (low, high) = (low.min(from_axis), high.max(from_axis));
            }
        }
        let first = low.floor() - MARGIN;
        let extent = (high.ceil() + MARGIN - first).max(DVec2::ONE);
        Some(Self {
            lens: *lens,
            principal_px: -first,
            resolution: [extent.x as u32, extent.y as u32],
        })
    }

    /// The photograph's lens.
    pub fn lens(&self) -> &Lens {
        &self.lens
    }

    /// Columns and rows of the working picture.
    pub fn size(&self) -> [u32; 2] {
        self.resolution
    }

    /// Refuses a working picture of more pixels than a picture's file has.
    ///
    /// # Errors
    /// On one that is too large.
    pub(crate) fn check_size(&self) -> Result<(), Error> {
        let [width, height] = self.resolution;
        if u64::from(width) * u64::from(height) <= MAX_PIXELS as u64 {
            return Ok(());
        }
        let [w, h] = self.lens.size;
        let detail = format!(
            "without the distortion of its lens the photograph of {w} x {h} pixels is a picture of {width} x {height}, and \
             {MAX_PIXELS} pixels in all are the most"
        );
        Err(Error::malformed(
            detail,
            "scale the photograph down, or check the lens in [scene.camera]",
        ))
    }

    /// The working picture's camera, at a place.
    pub fn camera(&self, pose: &Pose) -> Camera {
        Camera {
            position: pose.position.as_vec3(),
            rotation: pose.rotation.as_mat3(),
            focal_px: self.lens.focal_px.as_vec2(),
            principal_px: self.principal_px.as_vec2(),
            resolution: self.resolution,
        }
    }

    /// Where the working picture shows what the photograph shows at `pixel`; `None` if it does not.
    pub fn to_working(&self, pixel: DVec2) -> Option<DVec2> {
        let point = self.principal_px + straight(&self.lens, pixel)?;
        let [w, h] = self.resolution.map(f64::from);
        let inside = (0.0..=w).contains(&point.x) && (0.0..=h).contains(&point.y);
        inside.then_some(point)
    }

    /// Where the photograph shows what the working picture shows at `pixel`, which may be beyond its
    /// borders; `None` if the lens does not see it.
    pub fn to_photo(&self, pixel: DVec2) -> Option<DVec2> {
        let plane = (pixel - self.principal_px) / self.lens.focal_px;
        let direction = DVec3::new(plane.x, -plane.y, -1.0);
        let camera = LensCamera {
            pose: Pose::IDENTITY,
            lens: self.lens,
        };
        camera.project(direction)
    }

    /// The working picture of something that has the photograph's pixels; beyond the photograph its
    /// border is drawn out.
    pub fn undistort<T: Ordered>(&self, image: &Raster<T>) -> Raster<T> {
        let size = self.resolution.map(|n| n as usize);
        warp(image, size, Outside::Border, |p| {
            let p = DVec2::from_array(p);
            // What the lens does not see gets the pixel of the border in the same direction.
            let beside = || p - self.principal_px + self.lens.principal_px;
            Some(self.to_photo(p).unwrap_or_else(beside).to_array())
        })
    }

    /// What the photograph would show of something that has the working picture's pixels; `outside`
    /// where the working picture shows nothing.
    pub fn distort<T: Ordered>(&self, image: &Raster<T>, outside: T) -> Raster<T> {
        let map = |p| self.to_working(DVec2::from_array(p)).map(|p| p.to_array());
        warp(image, self.photo_size(), Outside::Value(outside), map)
    }

    /// As [`distort`](Self::distort), without mixing values of neighbours.
    pub fn distort_unmixed<T: Copy + Send + Sync>(
        &self,
        image: &Raster<T>,
        outside: T,
    ) -> Raster<T> {
        let map = |p| self.to_working(DVec2::from_array(p)).map(|p| p.to_array());
        pick(image, self.photo_size(), outside, map)
    }

    /// Maps for compositing programs (Nuke's STMap): the one that distorts, of the photograph's size, and
    /// the one that undistorts, of the working picture's. Red and green are where to take a pixel from,
    /// in widths and heights from the bottom left corner; -1 where there is nothing.
    pub fn st_maps(&self) -> Result<[Layers; 2], ImagingError> {
        let working = self.resolution.map(|n| n as usize);
        let photo = self.photo_size();
        Ok([
            st_map(photo, working, |p| self.to_working(p))?,
            st_map(working, photo, |p| self.to_photo(p))?,
        ])
    }

    fn photo_size(&self) -> [usize; 2] {
        self.lens.size.map(|n| n as usize)
    }
}

/// Where a pinhole with the lens's focal lengths would show what the lens shows at `pixel`, pixels from
/// the optical axis; `None` where the lens sees nothing, or what is not before the camera.
fn straight(lens: &Lens, pixel: DVec2) -> Option<DVec2> {
    let plane = (pixel - lens.principal_px) / lens.focal_px;
    let direction = lens.distortion.direction(plane)?;
    (direction.z > 1e-6).then(|| direction.truncate() / direction.z * lens.focal_px)
}

fn st_map(
    [width, height]: [usize; 2],
    source: [usize; 2],
    map: impl Fn(DVec2) -> Option<DVec2>,
) -> Result<Layers, ImagingError> {
    let at = |i: usize| {
        let pixel = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let found = map(pixel).map(|p| [p.x / source[0] as f64, 1.0 - p.y / source[1] as f64]);
        found.unwrap_or([-1.0, -1.0]).map(|v| v as f32)
    };
    let both: Vec<[f32; 2]> = (0..width * height).map(at).collect();
    let mut layers = Layers::new(width, height);
    for (k, name) in ["R", "G"].into_iter().enumerate() {
        let values = both.iter().map(|v| v[k]).collect();
        let channel = Raster::from_pixels(width, height, values);
        layers.insert(name, Precision::Full, channel)?;
    }
    layers.insert("B", Precision::Full, Raster::filled(width, height, 0.0))?;
    Ok(layers)
}

#[cfg(test)]
mod tests {
    use dipir_cameras::Distortion;

    use super::*;

    fn lenses() -> Vec<Lens> {
        let lens = |distortion: Option<Distortion>, focal: f64| Lens {
            principal_px: DVec2::new(167.0, 114.0),
            distortion: distortion.unwrap(),
            ..Lens::pinhole([320.0, 240.0], DVec2::new(focal, 1.02 * focal))
        };
        vec![
            lens(
                Distortion::brown_conrady([-0.25, 0.06, 0.0, 0.0], [0.0; 3], [1e-3, -2e-3]),
                240.0,
            ),
            lens(
                Distortion::brown_conrady([0.15, 0.0, 0.0, 0.0], [0.0; 3], [0.0; 2]),
                240.0,
            ),
            lens(Distortion::kannala_brandt([-0.02, 0.01, 0.0, 0.0]), 160.0),
        ]
    }

    /// Coverage of squares of a board of `step` pixels, over a pixel's area, where `at` says how far a
    /// position is along the board.
    fn board(size: [u32; 2], step: f64, at: impl Fn(DVec2) -> DVec2) -> Raster<f32> {
        const FINE: usize = 8;
        let [w, h] = size.map(|n| n as usize);
        let pixel = |i: usize| {
            let mut sum = 0.0;
            for k in 0..FINE * FINE {
                let inside = DVec2::new((k % FINE) as f64, (k / FINE) as f64) + 0.5;
                let corner = DVec2::new((i % w) as f64, (i / w) as f64);
                let square = (at(corner + inside / FINE as f64) / step).floor();
                sum += (square.x + square.y).rem_euclid(2.0);
            }
            (sum / (FINE * FINE) as f64) as f32
        };
        Raster::from_pixels(w, h, (0..w * h).map(pixel).collect())
    }

    /// How far edges of the board are apart in two pictures, around `corner`: the difference of the
    /// pictures over what a shift by a pixel changes.
    fn shift(found: &Raster<f32>, want: &Raster<f32>, corner: DVec2) -> DVec2 {
        let (mut normal, mut right) = (glam::DMat2::ZERO, DVec2::ZERO);
        for i in 0..169 {
            let (x, y) = (
                corner.x as usize + i % 13 - 6,
                corner.y as usize + i / 13 - 6,
            );
            let v = |x: usize, y: usize| f64::from(*want.get(x, y));
            let slope = 0.5 * DVec2::new(v(x + 1, y) - v(x - 1, y), v(x, y + 1) - v(x, y - 1));
            let off = v(x, y) - f64::from(*found.get(x, y));
            normal += glam::DMat2::from_cols(slope * slope.x, slope * slope.y);
            right += slope * off;
        }
        normal.inverse() * right
    }

    #[test]
    fn a_distorted_checkerboard_comes_back_within_a_tenth_of_a_pixel() {
        for lens in lenses() {
            let way = Undistortion::of(&lens).unwrap();
            let taken = board([320, 240], 24.0, |p| {
                way.to_working(p).unwrap_or(DVec2::splat(-1e4))
            });
            let want = board(way.resolution, 24.0, |p| p);
            let found = way.undistort(&taken);
            let back = way.distort(&want, 0.0);
            for corner in [[0.3, 0.3], [0.5, 0.5], [0.7, 0.4], [0.85, 0.8]] {
                let pixel = DVec2::from_array(corner) * DVec2::new(320.0, 240.0);
                let nearest = (way.to_working(pixel).unwrap() / 24.0).round() * 24.0;
                let off = shift(&found, &want, nearest);
                assert!(off.length() < 0.1, "{lens:?} {nearest} {off}");
                let nearest = way.to_photo(nearest).unwrap();
                let off = shift(&back, &taken, nearest);
                assert!(off.length() < 0.1, "{lens:?} {nearest} {off}");
            }
        }
    }

    #[test]
    fn a_corner_of_an_object_is_drawn_where_the_lens_shows_it() {
        for lens in lenses() {
            let way = Undistortion::of(&lens).unwrap();
            let pose = Pose {
                position: DVec3::new(0.1, 1.0, 4.0),
                ..Pose::IDENTITY
            };
            let (pinhole, real) = (way.camera(&pose), LensCamera { pose, lens });
            for corner in [
                [0.0, 0.0, 0.0],
                [-0.9, 0.4, -0.5],
                [1.1, 2.1, -0.2],
                [0.9, 0.1, -1.0],
            ] {
                let point = DVec3::from_array(corner);
                let want = real.project(point).unwrap();
                let working = pinhole.project(point.as_vec3()).unwrap().as_dvec2();
                let got = way.to_photo(working).unwrap();
                // Single precision of the renderer's camera.
                assert!(got.distance(want) < 1e-3, "{got} {want}");
                // A dot of the rendered picture lands on the same pixel of the photograph.
                let dot = Raster::from_pixels(
                    pinhole.resolution[0] as usize,
                    pinhole.resolution[1] as usize,
                    (0..pinhole.resolution.iter().product::<u32>())
                        .map(|i| {
                            let p = DVec2::new(
                                f64::from(i % pinhole.resolution[0]) + 0.5,
                                f64::from(i / pinhole.resolution[0]) + 0.5,
                            );
                            (-0.5 * (p - working).length_squared() / 9.0).exp() as f32
                        })
                        .collect(),
                );
                let drawn = way.distort(&dot, 0.0);
                let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
                for (i, v) in drawn.pixels().iter().enumerate() {
                    let p = DVec2::new((i % 320) as f64 + 0.5, (i / 320) as f64 + 0.5);
                    sum += p * f64::from(*v);
                    weight += f64::from(*v);
                }
                // The dot is 3 pixels wide: the lens bends it by hundredths of a pixel.
                assert!(
                    (sum / weight).distance(want) < 0.1,
                    "{} {want}",
                    sum / weight
                );
            }
        }
    }

    #[test]
    fn the_working_picture_shows_all_of_the_photograph_of_a_lens_that_is_no_fisheye() {
        for lens in &lenses()[..2] {
            let way = Undistortion::of(lens).unwrap();
            for i in 0..=20 {
                for share in [[i, 0], [i, 20], [0, i], [20, i]] {
                    let pixel = DVec2::new(16.0 * f64::from(share[0]), 12.0 * f64::from(share[1]));
                    let there = way.to_working(pixel).expect("shown");
                    assert!(way.to_photo(there).unwrap().distance(pixel) < 1e-6);
                }
            }
        }
    }

    #[test]
    fn st_maps_lead_to_where_pixels_come_from() {
        let way = Undistortion::of(&lenses()[0]).unwrap();
        let [distort, undistort] = way.st_maps().unwrap();
        assert_eq!([distort.width(), distort.height()], [320, 240]);
        let read = |layers: &Layers, x: usize, y: usize| {
            ["R", "G"].map(|name| f64::from(*layers.channel(name).unwrap().get(x, y)))
        };
        let [s, t] = read(&distort, 40, 30);
        let want = way.to_working(DVec2::new(40.5, 30.5)).unwrap();
        let size = way.resolution.map(f64::from);
        assert!((s * size[0] - want.x).abs() < 1e-3 && ((1.0 - t) * size[1] - want.y).abs() < 1e-3);
        let [s, t] = read(&undistort, 100, 90);
        let want = way.to_photo(DVec2::new(100.5, 90.5)).unwrap();
        assert!((s * 320.0 - want.x).abs() < 1e-3 && ((1.0 - t) * 240.0 - want.y).abs() < 1e-3);
    }

    #[test]
    fn a_lens_that_makes_too_large_a_picture_is_named() {
        let fisheye = |size: [f64; 2]| {
            let lens = Lens {
                distortion: Distortion::kannala_brandt([0.0; 4]).unwrap(),
                ..Lens::pinhole(size, DVec2::splat(size[1] / std::f64::consts::PI))
            };
            Undistortion::of(&lens).unwrap().check_size()
        };
        fisheye([6000.0, 4000.0]).unwrap();
        assert_eq!(
            fisheye([12000.0, 8000.0]).unwrap_err().to_string(),
            "without the distortion of its lens the photograph of 12000 x 8000 pixels is a picture of 24004 x 16004, and \
             268435456 pixels in all are the most; scale the photograph down, or check the lens in [scene.camera]"
        );
    }

    #[test]
    fn a_pinhole_needs_none() {
        assert_eq!(
            Undistortion::of(&Lens::pinhole([4.0, 3.0], DVec2::ONE)),
            None
        );
    }
}
