//! A plane by pixels that lie on it, and lengths between them.
use glam::{DMat3, DVec3, Vec2};

use crate::error::Error;

/// What is known of a plane.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelPlane {
    /// Of the photograph.
    pub pixels: Vec<Vec2>,
    /// Numbers of two pixels, and the metres between their points.
    pub lengths: Vec<(usize, usize, f64)>,
    /// Whether the pixels are the four corners of a rectangle.
    pub rectangle: bool,
    /// Metres from the plane to the camera.
    pub height_m: Option<f64>,
}

/// A plane as a camera sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Found {
    /// Unit normal towards the camera.
    pub normal: DVec3,
    /// Metres from the plane to the camera.
    pub height_m: f64,
    /// How far the known lengths are from those on the plane, relative, root mean square.
    pub misfit: f64,
}

/// Known lengths with which the plane need not be level.
const LENGTHS_OF_TILT: usize = 3;
/// Steps of Levenberg's and Marquardt's method.
const STEPS: usize = 100;

impl PixelPlane {
    /// The plane; `rays` are the directions in which the camera sees the pixels.
    ///
    /// # Errors
    /// If a pixel does not see the plane, or the rectangle is none.
    pub fn found(&self, rays: &[DVec3]) -> Result<Found, Error> {
        let normal = match (self.rectangle, rays) {
            (true, [a, b, c, d]) => rectangle([*a, *b, *c, *d])
                .ok_or_else(|| self.wrong("the corners of no rectangle that is seen"))?,
            _ => DVec3::Y,
        };
        let tilts = !self.rectangle && self.lengths.len() >= LENGTHS_OF_TILT;
        let normal = match tilts {
            true => self.tilted(rays, normal),
            false => normal,
        };
        if rays
            .iter()
            .any(|ray| !(-normal.dot(*ray) > 1e-6 * ray.length()))
        {
            return Err(self.wrong("a pixel at or above the horizon of their plane"));
        }
        if let Some(height_m) = self.height_m {
            return Ok(Found {
                normal,
                height_m,
                misfit: 0.0,
            });
        }
        let heights = self.log_heights(rays, normal);
        let heights = heights.ok_or_else(|| self.wrong("two pixels at the same point"))?;
        let count = heights.len() as f64;
        let mean = heights.iter().sum::<f64>() / count;
        let spread = heights.iter().map(|h| (h - mean).powi(2)).sum::<f64>() / count;
        Ok(Found {
            normal,
            height_m: mean.exp(),
            misfit: spread.sqrt(),
        })
    }

    fn wrong(&self, what: &str) -> Error {
        let pixels: Vec<String> = self
            .pixels
            .iter()
            .map(|p| format!("[{:?}, {:?}]", p.x, p.y))
            .collect();
        Error::Config {
            key: "scene.proxy.pixels".into(),
            value: format!("[{}], {what}", pixels.join(", ")),
            accepted: "pixels that lie on one plane below the camera, as far apart as they can be"
                .into(),
        }
    }

    /// Logarithms of the camera's height that each known length asks for, if the normal is this one.
    fn log_heights(&self, rays: &[DVec3], normal: DVec3) -> Option<Vec<f64>> {
        let at = |i: usize| {
            let ray = rays.get(i)?;
            let descent = -normal.dot(*ray);
            (descent > 1e-9 * ray.length()).then(|| *ray / descent)
        };
        let of = |&(a, b, metres): &(usize, usize, f64)| {
            let apart = at(a)?.distance(at(b)?);
            (apart > 0.0).then(|| (metres / apart).ln())
        };
        self.lengths.iter().map(of).collect()
    }

    /// The normal near `start` with which the lengths agree best.
    fn tilted(&self, rays: &[DVec3], start: DVec3) -> DVec3 {
        // Two tilts and the logarithm of the height, which only the differences of these depend on.
        let misfits = |normal: DVec3| {
            let heights = self.log_heights(rays, normal)?;
            let mean = heights.iter().sum::<f64>() / heights.len() as f64;
            Some(heights.iter().map(|h| h - mean).collect::<Vec<f64>>())
        };
        let squares = |off: &[f64]| off.iter().map(|v| v * v).sum::<f64>();
        let (mut normal, mut damping) = (start, 1e-3);
        for _ in 0..STEPS {
            let Some(off) = misfits(normal) else { break };
            let right = normal.any_orthonormal_vector();
            let axes = [right, normal.cross(right)];
            let step = 1e-6;
            let slopes = axes.map(|axis| {
                let turned = misfits((normal + step * axis).normalize()).unwrap_or(off.clone());
                let slope = turned.iter().zip(&off).map(|(a, b)| (a - b) / step);
                slope.collect::<Vec<f64>>()
            });
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let [xx, xy, yy] = [(0, 0), (0, 1), (1, 1)].map(|(i, j)| dot(&slopes[i], &slopes[j]));
            let [x, y] = [0, 1].map(|i| -dot(&slopes[i], &off));
            let more = damping * (xx + yy).max(1e-12);
            let determinant = (xx + more) * (yy + more) - xy * xy;
            let tilt = [
                ((yy + more) * x - xy * y) / determinant,
                ((xx + more) * y - xy * x) / determinant,
            ];
            let next = (normal + tilt[0] * axes[0] + tilt[1] * axes[1]).normalize();
            let better = misfits(next).is_some_and(|n| squares(&n) < squares(&off));
            match better {
                true => (normal, damping) = (next, damping * 0.2),
                false => damping *= 8.0,
            }
            if tilt[0].hypot(tilt[1]) < 1e-12 || damping > 1e12 {
                break;
            }
        }
        normal
    }
}

/// The normal, towards the camera, of a rectangle with corners in these directions: its sides meet at
/// two vanishing points, which are at right angles to it.
fn rectangle([a, b, c, d]: [DVec3; 4]) -> Option<DVec3> {
    let along =
        |p: DVec3, q: DVec3, r: DVec3, s: DVec3| p.cross(q).cross(r.cross(s)).try_normalize();
    let (first, second) = (along(a, b, d, c)?, along(a, d, b, c)?);
    let normal = first.cross(second).try_normalize()?;
    let middle = a.normalize() + b.normalize() + c.normalize() + d.normalize();
    // Near 0 the picture is of its edge.
    let determinant = DMat3::from_cols(first, second, normal).determinant();
    (determinant.abs() > 1e-6).then(|| -normal * normal.dot(middle).signum())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rays to four corners of a rectangle of 2.4 x 3 m on a plane that is tilted by this much.
    fn scene(tilt: f64) -> (DVec3, f64, [DVec3; 4]) {
        let turn = DMat3::from_rotation_x(tilt) * DMat3::from_rotation_z(0.7 * tilt);
        let eye = DVec3::new(0.3, 1.7, 4.0);
        let corners = [(-1.0, 0.0), (1.4, 0.0), (1.4, -3.0), (-1.0, -3.0)];
        let corners = corners.map(|(x, z)| turn * DVec3::new(x, 0.0, z));
        let normal = turn * DVec3::Y;
        (normal, normal.dot(eye), corners.map(|p| p - eye))
    }

    fn plane(
        lengths: &[(usize, usize, f64)],
        rectangle: bool,
        height_m: Option<f64>,
    ) -> PixelPlane {
        PixelPlane {
            pixels: vec![Vec2::ZERO; 4],
            lengths: lengths.to_vec(),
            rectangle,
            height_m,
        }
    }

    #[test]
    fn a_length_on_level_ground_gives_its_height() {
        let (_, height, rays) = scene(0.0);
        let found = plane(&[(0, 1, 2.4)], false, None).found(&rays).unwrap();
        assert!((found.height_m - height).abs() < 1e-9 && found.normal == DVec3::Y);
        let twice = plane(&[(0, 1, 2.5), (1, 2, 2.9)], false, None)
            .found(&rays)
            .unwrap();
        assert!(twice.misfit > 0.03 && (twice.height_m - height).abs() < 0.05);
    }

    #[test]
    fn a_rectangle_and_a_length_give_a_tilted_plane() {
        for tilt in [0.0, 0.12, -0.2, 0.6] {
            let (normal, height, rays) = scene(tilt);
            let found = plane(&[(1, 2, 3.0)], true, None).found(&rays).unwrap();
            assert!(
                found.normal.abs_diff_eq(normal, 1e-9),
                "{tilt}: {}",
                found.normal
            );
            assert!((found.height_m - height).abs() < 1e-9);
            let by_height = plane(&[], true, Some(height)).found(&rays).unwrap();
            assert_eq!(by_height.height_m, height);
        }
    }

    #[test]
    fn lengths_between_four_pixels_give_a_tilted_plane() {
        for tilt in [0.0, 0.12, -0.15] {
            let (normal, height, rays) = scene(tilt);
            let diagonal = 2.4f64.hypot(3.0);
            let lengths = [
                (0, 1, 2.4),
                (1, 2, 3.0),
                (2, 3, 2.4),
                (0, 3, 3.0),
                (0, 2, diagonal),
            ];
            let found = plane(&lengths, false, None).found(&rays).unwrap();
            assert!(
                found.normal.abs_diff_eq(normal, 1e-6),
                "{tilt}: {}",
                found.normal
            );
            assert!((found.height_m - height).abs() < 1e-6 && found.misfit < 1e-6);
        }
    }

    #[test]
    fn pixels_of_the_sky_are_refused() {
        let (_, _, mut rays) = scene(0.0);
        rays[2] = DVec3::new(0.0, 0.2, -1.0);
        let error = plane(&[(0, 1, 2.4)], false, None).found(&rays).unwrap_err();
        assert!(
            error.to_string().contains("at or above the horizon"),
            "{error}"
        );
    }
}
