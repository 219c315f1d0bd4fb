//! The light that is estimated from the photograph and, where something is known of the sun, from that.
use dipir_cli::session::Session;
use dipir_estimator::{Candidate, KnownAngle, KnownSun, LightEstimate, Visible};
use dipir_light::environment::EnvironmentMap;
use dipir_light::gaussian::SphericalGaussian;
use dipir_optimize::settings::LightTable;
use dipir_scene::description::ProxyRecord;
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::LoadedScene;
use dipir_sun::shadow::{Angle, Ground, sun_of_shadow};
use dipir_sun::table::Taken;
use glam::{DVec2, Vec2};
use serde::Serialize;

use super::views;

/// Candidates that are written.
const CANDIDATES: usize = 8;

/// What `candidates.json` says of one light.
#[derive(Serialize)]
pub(super) struct CandidateEntry {
    /// The number to choose it by, from 1.
    candidate: usize,
    /// How probable it is.
    probability: f64,
    /// Where its light comes from, relative to the view.
    words: String,
}

/// The shadow of `[light]`, which tells the sun's elevation only with a height.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum DrawnShadow {
    /// None is drawn.
    None,
    /// The height of what casts it is not told.
    WithoutHeight,
    /// The height is told.
    WithHeight,
}

impl DrawnShadow {
    /// Of a shadow, by the height of what casts it, metres.
    pub(super) fn of(shadow: Option<Option<f64>>) -> Self {
        match shadow {
            None => Self::None,
            Some(None) => Self::WithoutHeight,
            Some(Some(_)) => Self::WithHeight,
        }
    }
}

/// An estimated light.
pub(super) struct Estimated {
    /// The distribution.
    pub(super) estimate: LightEstimate,
    /// Lights that it allows, the most probable first.
    pub(super) candidates: Vec<CandidateEntry>,
    /// The number of the one that is used, from 1; `None` for the mean of the distribution.
    chosen: Option<usize>,
    /// The same as lights.
    pub(super) lights: Vec<Candidate>,
    /// The chosen light as lobes, its sources first.
    pub(super) lobes: Vec<SphericalGaussian>,
    /// How many of the lobes are sources that [`smooth`](Self::smooth) lacks.
    pub(super) sources: usize,
    /// The light without these sources.
    pub(super) smooth: EnvironmentMap,
    /// What the other photographs of the place show of it.
    pub(super) seen: Vec<Visible>,
    /// How many photographs tell it.
    pub(super) photographs: usize,
    /// Whether a gain map tells how bright what the photograph shows is.
    pub(super) has_gain: bool,
    /// The shadow that is drawn in the photograph.
    pub(super) shadow: DrawnShadow,
}

impl Estimated {
    /// The candidate that is used, in words.
    pub(super) fn chosen(&self) -> Option<String> {
        let entry = self.candidates.get(self.chosen?.checked_sub(1)?)?;
        Some(format!("candidate {}: {}", entry.candidate, entry.words))
    }
}

/// The light of the whole photograph: a function of photograph, camera, other photographs of the place
/// and what is known of the sun, not of objects, presets or seeds.
pub(super) fn estimate(
    session: &Session,
    table: &LightTable,
    loaded: &LoadedScene,
    lobes: usize,
) -> anyhow::Result<Estimated> {
    let (estimate, seen, known) = distribution(session, table, loaded)?;
    if let Some(below) = known.and_then(|sun| sun.elevation).filter(|e| e.deg < 0.0) {
        session.warn(&format!(
            "the sun is {:.0} degrees below the horizon, as [light] sun or the photograph's time and place say, and \
             lights nothing",
            -below.deg
        ));
    }
    let candidates = estimate.candidates(CANDIDATES);
    let entry = |(k, c): (usize, &Candidate)| CandidateEntry {
        candidate: k + 1,
        probability: c.probability,
        words: c.words.clone(),
    };
    let entries = candidates.iter().enumerate().map(entry).collect();
    let (lobes, sources, smooth) = match table.candidate {
        None => {
            let sources = usize::from(estimate.source_lobe().is_some());
            let smooth = match sources {
                0 => estimate.map(),
                _ => estimate.base_map(),
            };
            (estimate.lobes(lobes), sources, smooth)
        }
        Some(number) => {
            let chosen = number.checked_sub(1).and_then(|k| candidates.get(k));
            let chosen = chosen.ok_or_else(|| {
                let most = candidates.len();
                let message = format!("{number} is no candidate; accepted: 1 to {most}");
                session.config.invalid("light.candidate", message)
            })?;
            match chosen.direction {
                Some(_) => (chosen.lobes.clone(), 1, estimate.base_map()),
                None => (chosen.lobes.clone(), 0, chosen.map.clone()),
            }
        }
    };
    Ok(Estimated {
        estimate,
        candidates: entries,
        chosen: table.candidate,
        lights: candidates,
        lobes,
        sources,
        smooth,
        seen,
        has_gain: table.visible.unwrap_or(true) && loaded.taken().gain.is_some(),
        photographs: 1 + views::settings(session)?.len(),
        shadow: DrawnShadow::of(table.shadow.as_ref().map(|s| s.height_m)),
    })
}

/// The light as a distribution with what is known of the sun, what the other photographs of the place show of it, and
/// what is known.
pub(super) fn distribution(
    session: &Session,
    table: &LightTable,
    loaded: &LoadedScene,
) -> anyhow::Result<(LightEstimate, Vec<Visible>, Option<KnownSun>)> {
    let (estimate, seen) = views::estimate(session, loaded)?;
    let known = known_sun(session, table, loaded, &estimate)?;
    let estimate = match &known {
        Some(sun) => estimate.knowing(sun),
        None => estimate,
    };
    Ok((estimate, seen, known))
}

/// What to say where the sun that is known and the one of a drawn shadow are more than three standard deviations apart.
fn contradiction(what: &str, sun: Angle, shadow: Angle) -> Option<String> {
    let apart = (sun.deg - shadow.deg + 180.0).rem_euclid(360.0) - 180.0;
    (apart.abs() > 3.0 * sun.sigma_deg.hypot(shadow.sigma_deg)).then(|| {
        format!(
            "light.shadow puts the sun {:.0} degrees in {what} from where light.sun or the photograph's own data have it; \
             the shadow is used",
            apart.abs()
        )
    })
}

/// What is wrong with ends of a shadow that are not pixels of a photograph of so many.
fn outside(ends: [DVec2; 2], size: DVec2) -> Option<String> {
    let is_inside = |end: DVec2| end.cmpge(DVec2::ZERO).all() && end.cmple(size).all();
    let end = ends.into_iter().find(|end| !is_inside(*end))?;
    Some(format!(
        "has an end at [{:?}, {:?}]; accepted: pixels of the photograph, [0, 0] to [{:?}, {:?}]",
        end.x, end.y, size.x, size.y
    ))
}

/// What is wrong with ends of a shadow of which `shown` gives no pixel of the picture without distortion.
fn unseen(ends: [DVec2; 2], shown: impl Fn(DVec2) -> Option<DVec2>) -> Option<String> {
    let end = ends.into_iter().find(|end| shown(*end).is_none())?;
    Some(format!(
        "has an end at [{:?}, {:?}], which the picture without the lens's distortion does not show; accepted: pixels nearer \
         to the middle of the photograph",
        end.x, end.y
    ))
}

/// What the configuration and the photograph's own data say of the sun, relative to the view.
fn known_sun(
    session: &Session,
    table: &LightTable,
    loaded: &LoadedScene,
    estimate: &LightEstimate,
) -> anyhow::Result<Option<KnownSun>> {
    let camera = &loaded.scene.camera;
    let forward = -camera.rotation.z_axis.as_dvec3();
    let facts = &loaded.photo.facts;
    let taken = Taken {
        time: facts.time.clone(),
        latitude_deg: facts.latitude_deg,
        longitude_deg: facts.longitude_deg,
        heading_deg: facts.heading.map(|h| h.deg),
        heading_is_magnetic: facts.heading.is_some_and(|h| h.magnetic),
    };
    let sun = table.sun.clone().unwrap_or_default();
    let wrong = |key: &str, e: String| session.config.invalid(key, e);
    let mut known = sun
        .resolve("light.sun", &taken, forward)
        .map_err(|e| wrong("light.sun", e.to_string()))?;
    if let Some(missing) = table.sun.as_ref().and_then(|sun| sun.idle(&taken)) {
        session.warn(&format!("light.sun: {missing}"));
    }
    if let Some((time, offset)) = sun.time.as_deref().zip(sun.assumed_offset(&taken)) {
        session.warn(&format!(
            "light.sun.time has no offset of its zone, and {offset} is assumed by the longitude, which may be an hour off, \
             as with summer time: write it, as in \"{}{offset}\"",
            time.trim()
        ));
    }
    if let Some(shadow) = &table.shadow {
        let shadow = shadow
            .resolve("light.shadow")
            .map_err(|e| wrong("light.shadow", e.to_string()))?;
        let size = DVec2::from_array(facts.size.map(f64::from));
        let ends = [shadow.foot, shadow.tip];
        let shown = |end: DVec2| loaded.undistorted_pixel(end);
        if let Some(message) = outside(ends, size).or_else(|| unseen(ends, shown)) {
            return Err(wrong("light.shadow", message).into());
        }
        let ground = match (&loaded.scene.proxy, &loaded.description.proxy) {
            (Proxy::Plane(plane), _) => Ground {
                point: plane.point.as_dvec3(),
                normal: plane.normal.as_dvec3(),
            },
            (_, ProxyRecord::Ground(ground)) => Ground {
                point: ground.point,
                normal: ground.normal,
            },
            _ => {
                let message = "needs [scene.proxy] plane: the shadow falls onto it";
                return Err(wrong("light.shadow", message.into()).into());
            }
        };
        let ray = |pixel: DVec2| {
            // Both ends are shown.
            let pixel = loaded.camera_pixel(pixel).unwrap_or(pixel);
            let ray = camera.ray(Vec2::new(pixel.x as f32, pixel.y as f32));
            (ray.origin.as_dvec3(), ray.direction.as_dvec3())
        };
        let found = sun_of_shadow(&shadow, &ground, ray)
            .map_err(|e| wrong("light.shadow", e.to_string()))?;
        let azimuths = known.azimuth.map(|a| (a, found.azimuth));
        let elevations = known.elevation.zip(found.elevation);
        for (what, both) in [("azimuth", azimuths), ("elevation", elevations)] {
            if let Some(warning) = both.and_then(|(sun, shadow)| contradiction(what, sun, shadow)) {
                session.warn(&warning);
            }
        }
        known.azimuth = Some(found.azimuth);
        known.elevation = found.elevation.or(known.elevation);
    }
    let heading_deg = estimate.heading_rad.to_degrees();
    let angle = |a: Angle, from: f64| KnownAngle {
        deg: a.deg - from,
        sigma_deg: a.sigma_deg,
    };
    let says_something = known.azimuth.is_some()
        || known.elevation.is_some()
        || known.share.is_some()
        || known.radius_deg.is_some();
    Ok(says_something.then(|| KnownSun {
        azimuth: known.azimuth.map(|a| angle(a, heading_deg)),
        elevation: known.elevation.map(|a| angle(a, 0.0)),
        radius_deg: known.radius_deg,
        share: known.share,
        shines: sun.azimuth_deg.is_some() || sun.elevation_deg.is_some() || table.shadow.is_some(),
    }))
}

#[cfg(test)]
mod tests {
    use dipir_cameras::{Distortion, Lens};
    use dipir_scene::undistortion::Undistortion;

    use super::*;

    #[test]
    fn a_shadow_ends_where_the_picture_without_distortion_shows_it() {
        // A fisheye that sees 180 degrees along the diagonal.
        let lens = Lens {
            distortion: Distortion::kannala_brandt([0.0; 4]).unwrap(),
            ..Lens::pinhole(
                [400.0, 300.0],
                DVec2::splat(250.0 / std::f64::consts::FRAC_PI_2),
            )
        };
        let way = Undistortion::of(&lens).unwrap();
        let shown = |end: DVec2| way.to_working(end);
        let (middle, corner) = (DVec2::new(220.0, 160.0), DVec2::new(399.0, 2.5));
        assert_eq!(unseen([middle, DVec2::new(260.0, 90.0)], shown), None);
        let message = unseen([middle, corner], shown).unwrap();
        let start = "has an end at [399.0, 2.5], which the picture without the lens's distortion does not show";
        assert!(message.starts_with(start), "{message}");
    }
}
