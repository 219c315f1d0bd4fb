//! The sun from a shadow that the user marked in the photograph.
use glam::{DVec2, DVec3};

use crate::direction::angles;

/// An angle and how sure it is, degrees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Angle {
    /// The angle.
    pub deg: f64,
    /// Its standard deviation.
    pub sigma_deg: f64,
}

/// A shadow in the picture: of something upright, from where it stands to the end of its shadow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shadow {
    /// Pixel where the thing stands on the ground.
    pub foot: DVec2,
    /// Pixel where the shadow of its top falls.
    pub tip: DVec2,
    /// Height of the thing, metres.
    pub height_m: Option<f64>,
    /// Standard deviation of each coordinate of both pixels.
    pub sigma_px: f64,
    /// Standard deviation of the height as a share of it.
    pub sigma_height: f64,
}

/// Standard deviation of a coordinate of a point that the user clicked on, pixels.
pub const CLICK_SIGMA_PX: f64 = 2.0;
/// Standard deviation of a stated height, as a share of it.
pub const HEIGHT_SIGMA: f64 = 0.05;

/// The ground that the shadow falls onto.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ground {
    /// Any point of it, metres.
    pub point: DVec3,
    /// Unit vector.
    pub normal: DVec3,
}

/// What a shadow says of the sun, in angles of the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FromShadow {
    /// Azimuth.
    pub azimuth: Angle,
    /// Elevation, if the height is known.
    pub elevation: Option<Angle>,
}

/// Why a shadow gives no direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoShadow {
    /// A pixel sees no ground.
    #[error(
        "the {0} of the shadow lies above the horizon or behind the ground; mark it on the ground"
    )]
    NotOnGround(&'static str),
    /// Both pixels see nearly the same point.
    #[error("foot and tip of the shadow are the same point; mark the end of a longer shadow")]
    NoLength,
}

/// The sun that makes a shadow.
///
/// The sun lies in the upright plane through foot and tip, on the foot's side; with the thing's
/// height its elevation follows. `ray` gives origin and direction of the line of sight through a
/// pixel. Errors are carried over to first order, with differences over one standard deviation.
///
/// # Errors
/// If a pixel does not see the ground, or both see the same point.
pub fn sun_of_shadow(
    shadow: &Shadow,
    ground: &Ground,
    ray: impl Fn(DVec2) -> (DVec3, DVec3),
) -> Result<FromShadow, NoShadow> {
    let at = |pixel, which| hit(ground, ray(pixel)).ok_or(NoShadow::NotOnGround(which));
    let to_sun = |foot: DVec2, tip: DVec2, height: f64| {
        let (foot, tip) = (at(foot, "foot")?, at(tip, "tip")?);
        Ok(foot + DVec3::new(0.0, height, 0.0) - tip)
    };
    let height = shadow.height_m.unwrap_or(0.0);
    let straight = to_sun(shadow.foot, shadow.tip, height)?;
    let seen_from = ray(shadow.foot).0;
    let distance = at(shadow.foot, "foot")?.distance(seen_from);
    if straight.x.hypot(straight.z) < 1e-6 * distance {
        return Err(NoShadow::NoLength);
    }
    let (azimuth, elevation) = angles(straight);
    let mut variance = [0.0; 2];
    let mut add = |moved: DVec3| {
        let (a, e) = angles(moved);
        let turn = (a - azimuth + 180.0).rem_euclid(360.0) - 180.0;
        variance[0] += turn * turn;
        variance[1] += (e - elevation).powi(2);
    };
    for step in [DVec2::X, DVec2::Y] {
        let step = step * shadow.sigma_px;
        // If a step leads over the horizon, the opposite one is taken.
        let either = |f: &dyn Fn(f64) -> Result<DVec3, NoShadow>| f(1.0).or_else(|_| f(-1.0));
        add(either(&|s| {
            to_sun(shadow.foot + s * step, shadow.tip, height)
        })?);
        add(either(&|s| {
            to_sun(shadow.foot, shadow.tip + s * step, height)
        })?);
    }
    let higher = height * (1.0 + shadow.sigma_height);
    add(to_sun(shadow.foot, shadow.tip, higher)?);
    let of = |deg, variance: f64| Angle {
        deg,
        sigma_deg: variance.sqrt().min(180.0),
    };
    Ok(FromShadow {
        azimuth: of(azimuth, variance[0]),
        elevation: shadow.height_m.map(|_| of(elevation, variance[1])),
    })
}

/// Where a ray meets the ground.
fn hit(ground: &Ground, (origin, direction): (DVec3, DVec3)) -> Option<DVec3> {
    let slope = direction.dot(ground.normal);
    let distance = (ground.point - origin).dot(ground.normal) / slope;
    let point = origin + distance * direction;
    (distance > 0.0 && point.is_finite()).then_some(point)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::direction::direction;

    const FOCAL_PX: f64 = 800.0;

    /// A camera 1.6 m above the origin that looks along -z, with its axis through pixel (500, 300).
    fn ray(pixel: DVec2) -> (DVec3, DVec3) {
        let d = (pixel - DVec2::new(500.0, 300.0)) / FOCAL_PX;
        (DVec3::new(0.0, 1.6, 0.0), DVec3::new(d.x, -d.y, -1.0))
    }

    fn project(point: DVec3) -> DVec2 {
        let d = point - DVec3::new(0.0, 1.6, 0.0);
        DVec2::new(500.0, 300.0) + FOCAL_PX * DVec2::new(d.x, -d.y) / -d.z
    }

    fn ground(slope: f64) -> Ground {
        Ground {
            point: DVec3::ZERO,
            normal: DVec3::new(slope, 1.0, 0.0).normalize(),
        }
    }

    /// The shadow of a post of `height` under a sun.
    fn drawn(ground: &Ground, sun: DVec3, height: f64) -> Shadow {
        let foot = hit(ground, (DVec3::new(0.5, 9.0, -8.0), DVec3::NEG_Y)).unwrap();
        let tip = hit(ground, (foot + DVec3::new(0.0, height, 0.0), -sun)).unwrap();
        Shadow {
            foot: project(foot),
            tip: project(tip),
            height_m: Some(height),
            sigma_px: CLICK_SIGMA_PX,
            sigma_height: HEIGHT_SIGMA,
        }
    }

    #[test]
    fn the_sun_that_made_a_shadow_is_found_on_level_and_sloping_ground() {
        for slope in [0.0, 0.08] {
            for (azimuth, elevation) in [(60.0, 35.0), (200.0, 50.0), (300.0, 20.0)] {
                let ground = ground(slope);
                let shadow = drawn(&ground, direction(azimuth, elevation), 1.0);
                let got = sun_of_shadow(&shadow, &ground, ray).unwrap();
                assert!((got.azimuth.deg - azimuth).abs() < 1e-6, "{got:?}");
                assert!((got.elevation.unwrap().deg - elevation).abs() < 1e-6);
                let unknown = Shadow {
                    height_m: None,
                    ..shadow
                };
                let got = sun_of_shadow(&unknown, &ground, ray).unwrap();
                assert!((got.azimuth.deg - azimuth).abs() < 1e-6);
                assert_eq!(got.elevation, None);
            }
        }
    }

    #[test]
    fn the_stated_uncertainty_is_that_of_many_clicks() {
        let ground = ground(0.0);
        let shadow = drawn(&ground, direction(60.0, 35.0), 1.0);
        let got = sun_of_shadow(&shadow, &ground, ray).unwrap();
        // Clicks on the corners of a cube have the variance of its half side; 16 of them.
        let mut squares = [0.0; 2];
        for k in 0..16u32 {
            let sign = |bit: u32| f64::from(k >> bit & 1) * 2.0 - 1.0;
            let moved = Shadow {
                foot: shadow.foot + shadow.sigma_px * DVec2::new(sign(0), sign(1)),
                tip: shadow.tip + shadow.sigma_px * DVec2::new(sign(2), sign(3)),
                ..shadow
            };
            let other = sun_of_shadow(&moved, &ground, ray).unwrap();
            squares[0] += (other.azimuth.deg - 60.0).powi(2) / 16.0;
            squares[1] += (other.elevation.unwrap().deg - 35.0).powi(2) / 16.0;
        }
        // First order: terms of second order are a tenth at two pixels of forty; the height's 5% add
        // to the elevation.
        let [azimuth, elevation] = squares.map(f64::sqrt);
        assert!(
            (got.azimuth.sigma_deg / azimuth - 1.0).abs() < 0.15,
            "{got:?} {azimuth}"
        );
        let sigma = got.elevation.unwrap().sigma_deg;
        assert!(
            sigma > elevation * 0.9 && sigma < elevation + 2.0,
            "{sigma} {elevation}"
        );
        let sure = Shadow {
            sigma_px: 0.2,
            ..shadow
        };
        let sure = sun_of_shadow(&sure, &ground, ray).unwrap();
        assert!(sure.azimuth.sigma_deg < 0.2 * got.azimuth.sigma_deg);
    }

    #[test]
    fn pixels_that_see_no_ground_are_named() {
        let ground = ground(0.0);
        let shadow = drawn(&ground, direction(60.0, 35.0), 1.0);
        let sky = DVec2::new(500.0, 100.0);
        let with = |foot, tip| {
            sun_of_shadow(
                &Shadow {
                    foot,
                    tip,
                    ..shadow
                },
                &ground,
                ray,
            )
        };
        assert_eq!(with(sky, shadow.tip), Err(NoShadow::NotOnGround("foot")));
        assert_eq!(with(shadow.foot, sky), Err(NoShadow::NotOnGround("tip")));
        assert_eq!(with(shadow.foot, shadow.foot), Err(NoShadow::NoLength));
    }
}
