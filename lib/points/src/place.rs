//! A free, visible place on the ground for an object.
use dipir_cameras::Camera;
use dipir_numerics::sampler::Sampler;
use glam::{DVec2, DVec3};

use crate::cloud::{Cloud, POINTS};
use crate::ground::Ground;

/// What needs a place: an upright cylinder around the object, however it is turned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body {
    /// Metres.
    pub radius_m: f64,
    /// Metres.
    pub height_m: f64,
}

/// Where a place is looked for.
pub struct Search<'a> {
    /// The photograph's camera.
    pub camera: &'a Camera,
    /// The ground.
    pub ground: &'a Ground,
    /// What is known to stand around.
    pub cloud: Option<&'a Cloud>,
    /// Feet and bodies of objects that have a place already.
    pub taken: &'a [(DVec3, Body)],
    /// Whether something of the photograph stands in front of a pixel.
    pub hidden: &'a dyn Fn(DVec2) -> bool,
    /// 0 takes the best place, near the lower middle. Every other number takes another place.
    pub draw: u32,
}

/// Columns and rows of pixels that are tried.
const TRIED: [usize; 2] = [41, 40];
/// The best place: columns and rows from the left and the top, of the picture's size.
const BEST: DVec2 = DVec2::new(0.5, 0.72);
/// Height in the picture that suits an object best, of the picture's height.
const BEST_HEIGHT: f64 = 0.3;
/// Least height in the picture, of the picture's height.
const LEAST_HEIGHT: f64 = 0.03;
/// Share of the picture's size that is kept free at its border.
const MARGIN: f64 = 0.01;
/// Air around the object, metres.
const CLEARANCE_M: f64 = 0.25;
/// What is lower, in the ground's residuals and metres, is ground.
const LOW: (f64, f64) = (4.0, 0.1);

impl Search<'_> {
    /// The foot of the body at the best place; `None` if there is none.
    pub fn place(&self, body: &Body) -> Option<DVec3> {
        let surroundings = self
            .cloud
            .map(|cloud| Surroundings::new(cloud, self.ground));
        let mut candidates = self.candidates(body);
        candidates.sort_by(|a, b| a.0.total_cmp(&b.0));
        let feet = candidates.into_iter().map(|c| c.1);
        let mut free = feet.filter(|foot| self.is_apart(*foot, body));
        match &surroundings {
            None => free.next(),
            Some(around) => {
                let eye = self.camera.pose.position;
                free.find(|foot| around.is_free(*foot, body, self.ground, eye))
            }
        }
    }

    /// Feet that are in the picture, with what speaks against them.
    fn candidates(&self, body: &Body) -> Vec<(f64, DVec3)> {
        let size = DVec2::from_array(self.camera.lens.size);
        let mut found = Vec::new();
        for k in 0..TRIED[0] * TRIED[1] {
            let cell = [k % TRIED[0], k / TRIED[0]];
            let share = [0, 1].map(|i| (cell[i] as f64 + 0.5) / TRIED[i] as f64);
            let share = DVec2::from_array(share);
            let ray = self.camera.ray(share * size);
            let eye = self.camera.pose.position;
            let Some(foot) = ray.and_then(|ray| self.ground.hit(eye, ray)) else {
                continue;
            };
            let Some(height) = self.height_in_picture(foot, body) else {
                continue;
            };
            let against = match self.draw {
                0 => {
                    let off = (share - BEST) * DVec2::new(1.0, 1.5);
                    off.length_squared() + 0.05 * (height / BEST_HEIGHT).ln().powi(2)
                }
                draw => {
                    let seed = u64::from(draw);
                    f64::from(Sampler::new(seed, POINTS, k as u32, 1).next_1d())
                }
            };
            found.push((against, foot));
        }
        found
    }

    /// Of the picture's height, if all of the body is in the picture and its foot is not hidden.
    fn height_in_picture(&self, foot: DVec3, body: &Body) -> Option<f64> {
        let size = DVec2::from_array(self.camera.lens.size);
        let up = self.ground.normal;
        let right = up.any_orthonormal_vector();
        let ahead = up.cross(right);
        let seen = |point: DVec3| {
            let pixel = self.camera.project(point)?.pixel;
            let share = pixel / size;
            let inside = share.min_element() > MARGIN && share.max_element() < 1.0 - MARGIN;
            inside.then_some(pixel)
        };
        for i in 0..8 {
            let angle = f64::from(i) * std::f64::consts::FRAC_PI_4;
            let side = body.radius_m * (angle.cos() * right + angle.sin() * ahead);
            seen(foot + side)?;
            seen(foot + side + body.height_m * up)?;
        }
        let (low, high) = (seen(foot)?, seen(foot + body.height_m * up)?);
        let height = low.distance(high) / size.y;
        (height > LEAST_HEIGHT && !(self.hidden)(low)).then_some(height)
    }

    fn is_apart(&self, foot: DVec3, body: &Body) -> bool {
        let apart = |(other, its): &(DVec3, Body)| {
            foot.distance(*other) > body.radius_m + its.radius_m + CLEARANCE_M
        };
        self.taken.iter().all(apart)
    }
}

/// The points of a scene, by whether they are ground.
struct Surroundings {
    ground: Vec<DVec3>,
    /// Standing on it, with their heights.
    standing: Vec<(DVec3, f64)>,
    viewpoint: Option<DVec3>,
}

impl Surroundings {
    fn new(cloud: &Cloud, ground: &Ground) -> Self {
        let low = (LOW.0 * ground.residual_m).max(LOW.1);
        let (mut flat, mut standing) = (Vec::new(), Vec::new());
        for p in &cloud.points {
            match ground.height(*p) {
                h if h > low => standing.push((*p, h)),
                h if h > -low => flat.push(*p),
                _ => {}
            }
        }
        Self {
            ground: flat,
            standing,
            viewpoint: cloud.viewpoint,
        }
    }

    /// Whether the ground is known all around the foot, nothing stands in the body, and nothing stands
    /// between the body and those who looked: what is behind it is not known to be free.
    fn is_free(&self, foot: DVec3, body: &Body, ground: &Ground, eye: DVec3) -> bool {
        let up = ground.normal;
        let level = |v: DVec3| v - v.dot(up) * up;
        let wide = body.radius_m + CLEARANCE_M;
        let touches = |(p, h): &(DVec3, f64)| {
            *h < body.height_m + CLEARANCE_M && level(*p - foot).length() < wide
        };
        if self.standing.iter().any(touches) || !self.is_known(foot, body, ground, eye) {
            return false;
        }
        let lookers = [Some(eye), self.viewpoint];
        let blocked = |from: DVec3| {
            let height = ground.height(from).max(0.0);
            let way = level(foot - from);
            let distance = way.length();
            if distance < wide {
                return true;
            }
            let ahead = way / distance;
            let blocks = |(p, h): &(DVec3, f64)| {
                let to = level(*p - from);
                let along = to.dot(ahead);
                if along <= 0.0 || along >= distance + wide {
                    return false;
                }
                let share = along / distance;
                let off = (to - along * ahead).length();
                // It blocks the view if it reaches between the lines of sight to the body's foot and to its top.
                let lower = height * (1.0 - along / (distance + wide));
                let upper = height + (body.height_m - height) * share;
                off < wide * share.max(0.2) && *h > lower - CLEARANCE_M && *h < upper + CLEARANCE_M
            };
            self.standing.iter().any(blocks)
        };
        !lookers.into_iter().flatten().any(blocked)
    }

    /// Whether there are points of the ground on all four sides of the foot.
    fn is_known(&self, foot: DVec3, body: &Body, ground: &Ground, eye: DVec3) -> bool {
        let up = ground.normal;
        let distance = foot.distance(eye);
        // Rings of a scanner are farther apart the flatter they meet the ground.
        let spread = 0.012 * distance * distance / ground.height(eye).max(0.1);
        let reach = body.radius_m + spread.max(2.0 * CLEARANCE_M);
        let ahead = (foot - eye).normalize_or(DVec3::X);
        let right = ahead.cross(up).normalize_or(up.any_orthonormal_vector());
        let ahead = up.cross(right);
        let mut sides = [false; 4];
        for p in &self.ground {
            let from = *p - foot;
            if from.length() < reach {
                let (x, y) = (right.dot(from), ahead.dot(from));
                sides[usize::from(x > 0.0) + 2 * usize::from(y > 0.0)] = true;
            }
        }
        sides == [true; 4]
    }
}
