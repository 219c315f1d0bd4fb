//! The ground through the points that a camera sees.
use dipir_cameras::{Camera, WorldUp};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::cloud::Cloud;
use crate::error::PointsError;
use crate::plane::{ransac, refine};
use crate::relief::{self, Relief, relief};

/// The ground of a scene, and how sure it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Ground {
    /// A point of the plane below the camera, metres.
    pub point: DVec3,
    /// The plane's unit normal, upwards.
    pub normal: DVec3,
    /// Points on which the plane was looked for.
    pub points: u64,
    /// Those of them that lie on the ground, within three standard deviations.
    pub inliers: u64,
    /// Root mean square of their distances from it, metres.
    pub residual_m: f64,
    /// Heights over the plane, where the ground is not flat.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub relief: Option<Relief>,
}

/// Whether the ground may be other than a plane.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Shape {
    /// A relief where the points are off the plane by more than their noise, and by more than matters:
    /// 5 cm at 10 m. Too few points for a relief give a plane.
    #[default]
    Auto,
    /// A plane.
    Plane,
    /// A relief.
    Relief,
}

/// How the ground is looked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Search<'a> {
    /// The photograph's camera.
    pub camera: &'a Camera,
    /// Roughly up in the world: the ground's normal is within [`MOST_TILT_DEG`] of it.
    pub up: DVec3,
    /// Whether it may be other than a plane.
    pub shape: Shape,
    /// Of the draws.
    pub seed: u64,
}

/// Largest angle between the ground's normal and up, degrees: a slope of 36%.
pub const MOST_TILT_DEG: f64 = 20.0;
/// Points that are looked at, the nearest ones of what the camera sees.
const MOST_USED: usize = 200_000;
/// Fewest points with which a ground is believed.
const FEWEST: usize = 30;
/// Distance from a plane within which a draw counts a point, of the points' median distance from the
/// camera: 5 cm at 10 m.
const THRESHOLD: f64 = 0.005;
/// Share of the points that must lie on the ground.
const LEAST_SHARE: f64 = 0.05;

/// Finds the ground below the camera.
///
/// # Errors
/// If the camera sees too few points below itself, too few of them lie on a plane, or the shape is [`Shape::Relief`] and
/// they are too few for one.
pub fn ground(cloud: &Cloud, search: &Search) -> Result<Ground, PointsError> {
    let camera = search.camera;
    let up = search.up.normalize();
    let Used {
        seen: points,
        below,
    } = used(cloud, camera, up);
    if points.len() < FEWEST {
        return Err(PointsError::NoGround {
            detail: format!("the camera sees {} of them below itself", points.len()),
            remedy: "see whether points_up, points_scale and points_pose are right, or write plane"
                .into(),
        });
    }
    let away = |p: &DVec3| p.distance(camera.pose.position);
    let median = {
        let mut distances: Vec<f64> = points.iter().map(away).collect();
        let middle = distances.len() / 2;
        *distances.select_nth_unstable_by(middle, f64::total_cmp).1
    };
    let threshold = THRESHOLD * median;
    let most = MOST_TILT_DEG.to_radians();
    // Things may hide most of the ground that the camera looks at: a plane is looked for all around, and
    // refined on what the camera sees if a third of that is ground.
    let plane = ransac(&below, threshold, up, most, search.seed);
    let found = plane.map(|plane| {
        let on = |p: &&DVec3| plane.height(**p).abs() < threshold;
        match 3 * points.iter().filter(on).count() < points.len() {
            true => refine(&below, plane, threshold),
            false => refine(&points, plane, threshold),
        }
    });
    let none = |detail: String| PointsError::NoGround {
        detail,
        remedy: "see whether points_up is right, or write plane".into(),
    };
    let (plane, sigma) =
        found.ok_or_else(|| none("no three of them make a plane that lies flat".into()))?;
    // Of a wall a level strip is drawn, which least squares turn upright.
    let tilt = plane.normal.angle_between(up);
    if tilt > most {
        let tilt = tilt.to_degrees();
        return Err(none(format!(
            "they lie on a plane that is {tilt:.0} degrees from level, and ground is {MOST_TILT_DEG} at most"
        )));
    }
    let under = plane.height(camera.pose.position);
    let mut ground = Ground {
        point: camera.pose.position - under * plane.normal,
        normal: plane.normal,
        points: points.len() as u64,
        inliers: 0,
        residual_m: 0.0,
        relief: None,
    };
    ground.count(&points, 3.0 * sigma);
    let on = |p: &&DVec3| plane.height(**p).abs() <= 3.0 * sigma;
    let share = below.iter().filter(on).count() as f64 / below.len() as f64;
    if share < LEAST_SHARE || under <= 0.0 {
        let percent = 100.0 * share;
        return Err(none(format!(
            "only {percent:.1}% lie on a plane below the camera"
        )));
    }
    if search.shape != Shape::Plane {
        let ahead = -camera.pose.rotation.z_axis;
        match relief(&points, &ground, ahead, sigma) {
            Some((found, noise))
                if search.shape == Shape::Relief || !found.is_flat(threshold.max(3.0 * noise)) =>
            {
                ground.relief = Some(found);
                ground.count(&points, 3.0 * noise);
            }
            None if search.shape == Shape::Relief => {
                let fewest = relief::FEWEST;
                return Err(PointsError::NoRelief { fewest });
            }
            _ => {}
        }
    }
    Ok(ground)
}

/// Points among which another axis is looked for.
const JUDGED: usize = 50_000;
/// Times as many points of the ground that are seen if another axis points up, from which on it is believed.
const CLEARLY_MORE: usize = 3;

/// The axis that points up instead of `up`, by which the file of `cloud` was turned into the camera's world, if then the
/// camera sees clearly more ground.
pub fn other_up(cloud: &Cloud, search: &Search, up: WorldUp) -> Option<WorldUp> {
    let every = cloud.points.len().div_ceil(JUDGED).max(1);
    let ground_seen = |axis: WorldUp| {
        let turn = axis.to_ours() * up.to_ours().transpose();
        let points = cloud.points.iter().step_by(every).map(|p| turn * *p);
        let cloud = Cloud {
            points: points.collect(),
            viewpoint: None,
        };
        let flat = Search {
            shape: Shape::Plane,
            ..*search
        };
        let Ok(ground) = ground(&cloud, &flat) else {
            return 0;
        };
        // Flat ground in a file of few digits has no residual.
        let reach = (3.0 * ground.residual_m).max(1e-6);
        let seen = cloud.points.iter().filter(|p| is_seen(search.camera, **p));
        let (mut on, mut below) = (0usize, 0usize);
        for height in seen.map(|p| ground.height(*p)) {
            on += usize::from(height.abs() <= reach);
            below += usize::from(height < -3.0 * reach);
        }
        // What stands on the ground is below it where it is upside down.
        on.saturating_sub(below)
    };
    let least = FEWEST.max(CLEARLY_MORE * ground_seen(up));
    let others = WorldUp::USUAL.into_iter().filter(|axis| *axis != up);
    let seen = others.map(|axis| (ground_seen(axis), axis));
    let (most, axis) = seen.max_by_key(|s| s.0)?;
    (most >= least).then_some(axis)
}

/// Whether the point is in the picture.
fn is_seen(camera: &Camera, point: DVec3) -> bool {
    let [w, h] = camera.lens.size;
    camera
        .project(point)
        .is_some_and(|p| (0.0..=w).contains(&p.x) && (0.0..=h).contains(&p.y))
}

/// Points below the camera.
struct Used {
    /// Those that the camera sees, the nearest ones; all of them, if it sees few.
    seen: Vec<DVec3>,
    /// All around, the nearest ones.
    below: Vec<DVec3>,
}

fn used(cloud: &Cloud, camera: &Camera, up: DVec3) -> Used {
    let from = camera.pose.position;
    let below = cloud.points.iter().filter(|p| (**p - from).dot(up) < 0.0);
    let mut below: Vec<DVec3> = below.copied().collect();
    let seen = below.iter().filter(|p| is_seen(camera, **p));
    let mut seen: Vec<DVec3> = seen.copied().collect();
    for points in [&mut seen, &mut below] {
        if points.len() > MOST_USED {
            let away = |p: &DVec3| p.distance_squared(from);
            let order = |a: &DVec3, b: &DVec3| away(a).total_cmp(&away(b));
            points.select_nth_unstable_by(MOST_USED, order);
            points.truncate(MOST_USED);
        }
    }
    if seen.len() < FEWEST {
        seen.clone_from(&below);
    }
    Used { seen, below }
}

impl Ground {
    /// Counts the points within `reach` of the ground, and their distances from it.
    fn count(&mut self, points: &[DVec3], reach: f64) {
        let off = points.iter().map(|p| self.height(*p));
        let on: Vec<f64> = off.filter(|h| h.abs() <= reach).collect();
        let squares = on.iter().map(|h| h * h).sum::<f64>();
        self.inliers = on.len() as u64;
        self.residual_m = (squares / on.len().max(1) as f64).sqrt();
    }

    /// Metres over the ground, along the plane's normal.
    pub fn height(&self, point: DVec3) -> f64 {
        let over_plane = self.normal.dot(point - self.point);
        over_plane - self.relief.as_ref().map_or(0.0, |r| r.height(point))
    }

    /// The first point of the ground on a ray from above it; the direction has any length.
    pub fn hit(&self, origin: DVec3, direction: DVec3) -> Option<DVec3> {
        let descent = -self.normal.dot(direction);
        let height = self.normal.dot(origin - self.point);
        if !(height > 0.0 && descent > 1e-6 * direction.length()) {
            return None;
        }
        let mut point = origin + height / descent * direction;
        // A relief is low and smooth: each step leaves slope over descent of the error.
        for _ in 0..if self.relief.is_some() { 40 } else { 0 } {
            point += self.height(point) / descent * direction;
        }
        let above = (point - origin).dot(direction) > 0.0;
        (above && self.height(point).abs() < 1e-3 * height).then_some(point)
    }

    /// In one line, for people.
    pub fn words(&self) -> String {
        let shape = match &self.relief {
            Some(relief) => format!(
                "not flat: a relief of {} by {} cells",
                relief.columns, relief.rows
            ),
            None => "a plane".into(),
        };
        format!(
            "{shape}, on which {} of {} points lie within {:.3} m (rms)",
            self.inliers, self.points, self.residual_m
        )
    }
}
