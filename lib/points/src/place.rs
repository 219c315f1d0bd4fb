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
/// What is lower than this share of its radius, as a rug, has no height to judge by: that of the box around it counts.
const FLAT: f64 = 0.1;
/// Share of the picture's size that is kept free at its border.
const MARGIN: f64 = 0.01;
/// Air around the object, metres.
const CLEARANCE_M: f64 = 0.25;
/// What is lower, in the ground's residuals and metres, is ground.
const LOW: (f64, f64) = (4.0, 0.1);

impl Search<'_> {
    /// The foot of the body at the best place; `None` if there is none. In the picture it is beside other
    /// objects, and before or behind them only if all other places are taken.
    pub fn place(&self, body: &Body) -> Option<DVec3> {
        let surroundings = self
            .cloud
            .map(|cloud| Surroundings::new(cloud, self.ground));
        let mut candidates = self.candidates(body);
        candidates.sort_by(|a, b| a.0.total_cmp(&b.0));
        let feet = candidates.into_iter().map(|c| c.1);
        let eye = self.camera.pose.position;
        let is_free = |foot: DVec3| match &surroundings {
            None => true,
            Some(around) => around.is_free(foot, body, self.ground, eye),
        };
        let boxes = self.taken.iter();
        let boxes: Vec<[DVec2; 2]> = boxes
            .filter_map(|(foot, its)| self.seen(*foot, its))
            .collect();
        let mut before = None;
        for foot in feet.filter(|foot| self.is_apart(*foot, body)) {
            let seen = self.seen(foot, body);
            let clear = seen.is_none_or(|own| !boxes.iter().any(|other| overlap(own, *other)));
            if (clear || before.is_none()) && is_free(foot) {
                if clear {
                    return Some(foot);
                }
                before = Some(foot);
            }
        }
        before
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
        let [low, high] = self.seen(foot, body)?;
        let inside =
            (low / size).min_element() > MARGIN && (high / size).max_element() < 1.0 - MARGIN;
        if !inside {
            return None;
        }
        let pixel = |point: DVec3| Some(self.camera.project(point)?.pixel);
        let up = self.ground.normal;
        let (stands, top) = (pixel(foot)?, pixel(foot + body.height_m * up)?);
        let height = match body.height_m < FLAT * body.radius_m {
            true => high.y - low.y,
            false => stands.distance(top),
        } / size.y;
        (height > LEAST_HEIGHT && !(self.hidden)(stands)).then_some(height)
    }

    /// The box of pixels around the body; `None` if it reaches where the camera does not see.
    fn seen(&self, foot: DVec3, body: &Body) -> Option<[DVec2; 2]> {
        let up = self.ground.normal;
        let right = up.any_orthonormal_vector();
        let ahead = up.cross(right);
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for i in 0..8 {
            let angle = f64::from(i) * std::f64::consts::FRAC_PI_4;
            let side = body.radius_m * (angle.cos() * right + angle.sin() * ahead);
            for point in [foot + side, foot + side + body.height_m * up] {
                let pixel = self.camera.project(point)?.pixel;
                (low, high) = (low.min(pixel), high.max(pixel));
            }
        }
        Some([low, high])
    }

    fn is_apart(&self, foot: DVec3, body: &Body) -> bool {
        let apart = |(other, its): &(DVec3, Body)| {
            foot.distance(*other) > body.radius_m + its.radius_m + CLEARANCE_M
        };
        self.taken.iter().all(apart)
    }
}

fn overlap([a, b]: [DVec2; 2], [c, d]: [DVec2; 2]) -> bool {
    a.cmplt(d).all() && c.cmplt(b).all()
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

#[cfg(test)]
mod tests {
    use dipir_cameras::{Lens, Pose};
    use glam::DMat3;

    use super::*;

    /// Eyes of somebody who looks down a little.
    fn camera() -> Camera {
        Camera {
            pose: Pose {
                position: DVec3::new(0.0, 1.6, 0.0),
                rotation: DMat3::from_rotation_x(-0.15),
            },
            lens: Lens::pinhole([900.0, 600.0], DVec2::splat(800.0)),
        }
    }

    fn ground() -> Ground {
        Ground {
            point: DVec3::ZERO,
            normal: DVec3::Y,
            points: 0,
            inliers: 0,
            residual_m: 0.0,
            relief: None,
        }
    }

    /// Places of bodies, one after another, and the box of each in the picture.
    fn placed(bodies: &[Body], draw: u32) -> Vec<(DVec3, [DVec2; 2])> {
        let (camera, ground) = (camera(), ground());
        let (mut taken, mut found) = (Vec::new(), Vec::new());
        for body in bodies {
            let search = Search {
                camera: &camera,
                ground: &ground,
                cloud: None,
                taken: &taken,
                hidden: &|_| false,
                draw,
            };
            let foot = search.place(body).unwrap();
            found.push((foot, search.seen(foot, body).unwrap()));
            taken.push((foot, *body));
        }
        found
    }

    #[test]
    fn objects_stand_beside_each_other_in_the_picture() {
        let body = Body {
            radius_m: 0.3,
            height_m: 0.9,
        };
        for draw in 0..8 {
            let found = placed(&[body; 4], draw);
            for (i, (foot, own)) in found.iter().enumerate() {
                for (other, its) in &found[..i] {
                    assert!(
                        !overlap(*own, *its),
                        "draw {draw}: {own} {its}",
                        own = own[0],
                        its = its[0]
                    );
                    assert!(foot.distance(*other) > 0.85);
                }
            }
        }
    }

    #[test]
    fn where_no_place_beside_them_is_left_objects_are_apart_on_the_ground() {
        let (camera, ground) = (camera(), ground());
        let wide = Body {
            radius_m: 2.5,
            height_m: 3.0,
        };
        let post = Body {
            radius_m: 0.2,
            height_m: 1.2,
        };
        // It fills the picture.
        let taken = [(DVec3::new(0.0, 0.0, -5.0), wide)];
        let search = Search {
            camera: &camera,
            ground: &ground,
            cloud: None,
            taken: &taken,
            hidden: &|_| false,
            draw: 0,
        };
        let foot = search.place(&post).unwrap();
        let boxes = [(foot, post), taken[0]].map(|(foot, body)| search.seen(foot, &body));
        assert!(overlap(boxes[0].unwrap(), boxes[1].unwrap()));
        assert!(foot.distance(taken[0].0) > 2.95);
    }

    #[test]
    fn a_rug_has_a_place_though_it_has_hardly_a_height() {
        for height_m in [0.0, 0.01] {
            let rug = Body {
                radius_m: 0.9,
                height_m,
            };
            for draw in 0..3 {
                let [(foot, [low, high])] = placed(&[rug], draw)[..] else {
                    panic!("one place");
                };
                assert_eq!(foot.y, 0.0);
                assert!((high - low).y > LEAST_HEIGHT * 600.0);
            }
        }
    }
}
