//! How a lens bends the straight lines of a pinhole camera.
use glam::{DMat2, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// A model of distortion, between directions and the image plane at distance 1.
///
/// Each model holds up to the angle at which its image would begin to move back towards the centre;
/// beyond it nothing is seen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Model", into = "Model")]
pub struct Distortion {
    model: Model,
    /// Largest undistorted radius (Brown-Conrady) or angle in radians (Kannala-Brandt) that is seen.
    limit: f64,
}

/// The numbers of a model, as files of ours keep them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Model {
    None,
    #[serde(rename = "brown_conrady")]
    Brown {
        numerator: [f64; 4],
        denominator: [f64; 3],
        tangential: [f64; 2],
    },
    #[serde(rename = "kannala_brandt")]
    Fisheye {
        k: [f64; 4],
    },
}

impl TryFrom<Model> for Distortion {
    type Error = &'static str;

    fn try_from(model: Model) -> Result<Self, Self::Error> {
        let lens = match model {
            Model::None => Some(Self::NONE),
            Model::Brown {
                numerator,
                denominator,
                tangential,
            } => Self::brown_conrady(numerator, denominator, tangential),
            Model::Fisheye { k } => Self::kannala_brandt(k),
        };
        lens.ok_or("a coefficient of the lens is not finite")
    }
}

impl From<Distortion> for Model {
    fn from(lens: Distortion) -> Self {
        lens.model
    }
}

/// Newton's method doubles the digits a step; more are needed only where steps are shortened.
const MOST_STEPS: usize = 60;
/// Residual at which a point is found, in focal lengths: 1e-8 of a pixel at 1e4 pixels.
const FOUND: f64 = 1e-12;
/// Radii beyond this (89.4 degrees) are no longer a picture on a plane.
const MOST_RADIUS: f64 = 100.0;

impl Distortion {
    /// A pinhole camera.
    pub const NONE: Self = Self {
        model: Model::None,
        limit: f64::INFINITY,
    };

    /// Brown and Conrady's model, as OpenCV writes it: radius `r` is stretched by
    /// `(1 + n1 r^2 + n2 r^4 + n3 r^6 + n4 r^8) / (1 + d1 r^2 + d2 r^4 + d3 r^6)`, and
    /// `tangential` (p1, p2) shifts by decentring. `None` if a number is not finite.
    pub fn brown_conrady(
        numerator: [f64; 4],
        denominator: [f64; 3],
        tangential: [f64; 2],
    ) -> Option<Self> {
        let all = numerator.iter().chain(&denominator).chain(&tangential);
        if !all.clone().all(|v| v.is_finite()) {
            return None;
        }
        if all.clone().all(|&v| v == 0.0) {
            return Some(Self::NONE);
        }
        let model = Model::Brown {
            numerator,
            denominator,
            tangential,
        };
        let grows = |r: f64| {
            let (factor, slope) = radial(&numerator, &denominator, r * r);
            // Behind a pole of the denominator the picture is mirrored.
            if factor > 0.0 {
                factor + 2.0 * r * r * slope
            } else {
                0.0
            }
        };
        let limit = first_turn(grows, MOST_RADIUS);
        Some(Self { model, limit })
    }

    /// Kannala and Brandt's model of fisheye lenses: angle `a` from the axis is imaged at radius
    /// `a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8)`. `None` if a number is not finite.
    pub fn kannala_brandt(k: [f64; 4]) -> Option<Self> {
        if !k.iter().all(|v| v.is_finite()) {
            return None;
        }
        let grows = |a: f64| {
            let (factor, slope) = radial(&k, &[0.0; 3], a * a);
            factor + 2.0 * a * a * slope
        };
        let limit = first_turn(grows, std::f64::consts::PI);
        Some(Self {
            model: Model::Fisheye { k },
            limit,
        })
    }

    /// Of a picture that was turned by a quarter, clockwise.
    pub(crate) fn turned_by_a_quarter(mut self) -> Self {
        if let Model::Brown { tangential, .. } = &mut self.model {
            let [p1, p2] = *tangential;
            *tangential = [p2, -p1];
        }
        self
    }

    /// Whether this is a pinhole camera.
    pub fn is_none(&self) -> bool {
        self.model == Model::None
    }

    /// Whether this is Kannala and Brandt's model.
    pub fn is_fisheye(&self) -> bool {
        matches!(self.model, Model::Fisheye { .. })
    }

    /// Where light from `direction`, of any length, falls on the image plane at distance 1; `None` where the lens does
    /// not see.
    pub fn image(&self, direction: DVec3) -> Option<DVec2> {
        if let Model::Fisheye { k } = self.model {
            return self.image_fisheye(&k, direction);
        }
        if !(direction.z > 0.0) {
            return None;
        }
        let plane = direction.truncate() / direction.z;
        let (point, _) = self.distort(plane);
        (plane.length() <= self.limit).then_some(point)
    }

    /// The unit direction whose light falls on `point`; `None` where the lens sees nothing.
    pub fn direction(&self, point: DVec2) -> Option<DVec3> {
        if !point.is_finite() {
            return None;
        }
        match self.model {
            Model::None => Some(point.extend(1.0).normalize()),
            Model::Brown { .. } => Some(self.undistort(point)?.extend(1.0).normalize()),
            Model::Fisheye { k } => self.direction_fisheye(&k, point),
        }
    }

    /// A point of the plane without distortion to one with it, and its derivative.
    fn distort(&self, p: DVec2) -> (DVec2, DMat2) {
        let Model::Brown {
            numerator,
            denominator,
            tangential: [p1, p2],
        } = self.model
        else {
            return (p, DMat2::IDENTITY);
        };
        let (factor, slope) = radial(&numerator, &denominator, p.length_squared());
        let (x, y) = (p.x, p.y);
        let r2 = x * x + y * y;
        let shift = DVec2::new(
            2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let across = 2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
        let jacobian = DMat2::from_cols(
            DVec2::new(
                factor + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
                across,
            ),
            DVec2::new(
                across,
                factor + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
            ),
        );
        (p * factor + shift, jacobian)
    }

    /// Inverse of [`distort`](Self::distort) within the limit: Newton's method, with steps halved
    /// until they bring the point nearer.
    fn undistort(&self, target: DVec2) -> Option<DVec2> {
        let mut p = DVec2::ZERO;
        let (mut at, mut jacobian) = self.distort(p);
        for _ in 0..MOST_STEPS {
            let off = at - target;
            if off.length() <= FOUND * (1.0 + target.length()) {
                return (p.length() <= self.limit).then_some(p);
            }
            if jacobian.determinant().abs() < 1e-12 {
                return None;
            }
            let step = jacobian.inverse() * off;
            let mut share = 1.0;
            let next = loop {
                let next = p - share * step;
                let (there, slope) = self.distort(next);
                let nearer = (there - target).length() < off.length();
                if nearer && next.length() <= 1.01 * self.limit {
                    (at, jacobian) = (there, slope);
                    break next;
                }
                share *= 0.5;
                if share < 1e-6 {
                    return None;
                }
            };
            p = next;
        }
        None
    }

    fn image_fisheye(&self, k: &[f64; 4], direction: DVec3) -> Option<DVec2> {
        let across = direction.truncate().length();
        let angle = across.atan2(direction.z);
        let length = direction.length();
        let straight_behind = across < 1e-9 * length && direction.z < 0.0;
        if !(length > 0.0 && angle <= self.limit) || straight_behind {
            return None;
        }
        let (factor, _) = radial(k, &[0.0; 3], angle * angle);
        // Radius over the distance from the axis; on the axis their limit.
        let scale = match across < 1e-9 * length {
            true => factor / direction.z,
            false => angle * factor / across,
        };
        Some(scale * direction.truncate())
    }

    /// The angle is found between 0 and the limit, by Newton's method with bisection for safety.
    fn direction_fisheye(&self, k: &[f64; 4], point: DVec2) -> Option<DVec3> {
        let radius = point.length();
        if radius < 1e-15 {
            return Some(DVec3::Z);
        }
        let of = |a: f64| {
            let (factor, slope) = radial(k, &[0.0; 3], a * a);
            (a * factor - radius, factor + 2.0 * a * a * slope)
        };
        let (mut low, mut high) = (0.0, self.limit);
        if of(high).0 < -FOUND {
            return None;
        }
        let mut angle = radius.min(high);
        for _ in 0..200 {
            let (off, slope) = of(angle);
            if off.abs() <= FOUND * (1.0 + radius) {
                break;
            }
            match off > 0.0 {
                true => high = angle,
                false => low = angle,
            }
            let next = angle - off / slope;
            angle = match next > low && next < high {
                true => next,
                false => 0.5 * (low + high),
            };
        }
        let (sin, cos) = angle.sin_cos();
        let across = point / radius * sin;
        Some(DVec3::new(across.x, across.y, cos))
    }
}

/// The radial factor at the squared radius `s`, and its derivative by `s`.
fn radial(numerator: &[f64], denominator: &[f64], s: f64) -> (f64, f64) {
    let polynomial = |c: &[f64]| {
        let (mut value, mut slope) = (0.0, 0.0);
        for &c in c.iter().rev() {
            slope = slope * s + value;
            value = value * s + c;
        }
        // Without its constant 1: 1 + s * value.
        (1.0 + s * value, value + s * slope)
    };
    let ((n, by_n), (d, by_d)) = (polynomial(numerator), polynomial(denominator));
    (n / d, (by_n * d - n * by_d) / (d * d))
}

/// The first place in `(0, most]` at which `grows` is no longer above 0.
fn first_turn(grows: impl Fn(f64) -> f64, most: f64) -> f64 {
    const STEPS: usize = 4096;
    // Finer near 0, where the pictures are.
    let at = |i: usize| most * (i as f64 / STEPS as f64).powi(3);
    let turn = (1..=STEPS).find(|&i| !(grows(at(i)) > 1e-9));
    let Some(turn) = turn else {
        return most;
    };
    let (mut low, mut high) = (at(turn - 1), at(turn));
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        match grows(middle) > 1e-9 {
            true => low = middle,
            false => high = middle,
        }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn lenses() -> Vec<Distortion> {
        let brown = |n, d, t| Distortion::brown_conrady(n, d, t).unwrap();
        let fisheye = |k| Distortion::kannala_brandt(k).unwrap();
        vec![
            Distortion::NONE,
            // A telephone, a wide lens with a strong barrel, a pincushion, a rational model.
            brown([0.05, -0.1, 0.04, 0.0], [0.0; 3], [1e-3, -5e-4]),
            brown([-0.3, 0.1, -0.015, 0.0], [0.0; 3], [0.0, 2e-4]),
            brown([0.2, 0.0, 0.0, 0.0], [0.0; 3], [0.0; 2]),
            brown([8.0, 4.0, 0.2, 0.0], [8.3, 6.0, 1.0], [1e-4, 1e-4]),
            fisheye([0.0; 4]),
            fisheye([-0.02, 0.005, -0.003, 0.0005]),
        ]
    }

    #[test]
    fn what_is_imaged_comes_from_where_it_came() {
        for lens in lenses() {
            for i in -20..=20 {
                for j in -20..=20 {
                    let plane = DVec2::new(f64::from(i), f64::from(j)) * 0.04;
                    let direction = plane.extend(1.0).normalize();
                    let Some(image) = lens.image(direction) else {
                        assert!(plane.length() > 0.9, "{lens:?} {plane}");
                        continue;
                    };
                    let back = lens.direction(image).unwrap();
                    assert!(
                        back.abs_diff_eq(direction, 1e-10),
                        "{lens:?} {plane} {back}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_fisheye_sees_behind_itself() {
        let lens = Distortion::kannala_brandt([0.0; 4]).unwrap();
        let behind = DVec3::new(1.0, 0.0, -0.5).normalize();
        let image = lens.image(behind).unwrap();
        assert!((image.x - (1.0f64).atan2(-0.5)).abs() < 1e-12);
        assert!(lens.direction(image).unwrap().abs_diff_eq(behind, 1e-10));
        assert_eq!(lens.direction(DVec2::new(3.2, 0.0)), None);
    }

    #[test]
    fn points_beyond_the_turn_are_not_seen() {
        let lens = Distortion::brown_conrady([-0.3, 0.0, 0.0, 0.0], [0.0; 3], [0.0; 2]).unwrap();
        // r (1 - .3 r^2) turns at 1 / sqrt(.9), where it is two thirds of that.
        let turn = 0.9f64.sqrt().recip();
        assert!((lens.limit - turn).abs() < 1e-6, "{}", lens.limit);
        assert!(lens.image(DVec3::new(turn + 0.01, 0.0, 1.0)).is_none());
        assert!(
            lens.direction(DVec2::new(turn * 2.0 / 3.0 + 0.01, 0.0))
                .is_none()
        );
        assert!(
            lens.direction(DVec2::new(turn * 2.0 / 3.0 - 0.01, 0.0))
                .is_some()
        );
        assert!(lens.image(DVec3::new(0.0, 0.0, -1.0)).is_none());
    }

    #[test]
    fn the_derivatives_follow_central_differences() {
        for lens in lenses() {
            for p in [[0.27, -0.18], [0.0, 0.0], [-0.5, 0.01]].map(DVec2::from) {
                let got = lens.distort(p).1;
                // Truncation h^2 times third derivatives of a few, rounding 1e-16 / h.
                let h = 1e-5;
                for (axis, step) in DVec2::AXES.into_iter().enumerate() {
                    let at = |h: f64| lens.distort(p + h * step).0;
                    let want = (at(h) - at(-h)) / (2.0 * h);
                    let got = got.col(axis);
                    assert!(got.abs_diff_eq(want, 1e-8), "{lens:?} {p} {got} {want}");
                }
            }
        }
    }

    proptest! {
        /// A direction, or none: never a panic, never one that is not finite, and never a wrong one.
        #[test]
        fn any_lens_at_any_point_gives_a_direction_or_none(
            n in proptest::array::uniform4(-2.0f64..2.0),
            d in proptest::array::uniform3(-1.0f64..1.0),
            t in proptest::array::uniform2(-0.1f64..0.1),
            x in -3.0f64..3.0,
            y in -3.0f64..3.0,
        ) {
            let point = DVec2::new(x, y);
            for lens in [
                Distortion::brown_conrady(n, d, t).unwrap(),
                Distortion::kannala_brandt(n).unwrap(),
            ] {
                if let Some(direction) = lens.direction(point) {
                    prop_assert!((direction.length() - 1.0).abs() < 1e-9);
                    if let Some(image) = lens.image(direction) {
                        prop_assert!(image.abs_diff_eq(point, 1e-6), "{image}");
                    }
                }
            }
        }
    }
}
