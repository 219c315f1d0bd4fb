//! A free, visible place on the ground for an object.
use dipir_cameras::Camera;
use dipir_numerics::sampler::Sampler;
use glam::{DVec2, DVec3};

use crate::cells::{Cells, Chart, square};
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
/// Least width of a view of a body, near the eyes, of the body's.
const NARROWEST: f64 = 0.2;

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
        let pixel = |point: DVec3| self.camera.project(point);
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
                let pixel = self.camera.project(point)?;
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

/// A point that stands on the ground, and its height over it, metres.
type Standing = (DVec3, f64);

/// The points of a scene, by whether they are ground.
struct Surroundings {
    chart: Chart,
    ground: Cells<DVec3>,
    standing: Cells<Standing>,
    viewpoint: Option<DVec3>,
}

impl Surroundings {
    fn new(cloud: &Cloud, ground: &Ground) -> Self {
        let low = (LOW.0 * ground.residual_m).max(LOW.1);
        let chart = Chart::new(ground.point, ground.normal);
        let (mut flat, mut standing) = (Vec::new(), Vec::new());
        for p in &cloud.points {
            match ground.height(*p) {
                h if h > low => standing.push((chart.at(*p), (*p, h))),
                h if h > -low => flat.push((chart.at(*p), *p)),
                _ => {}
            }
        }
        Self {
            chart,
            ground: Cells::new(flat.into_iter()),
            standing: Cells::new(standing.into_iter()),
            viewpoint: cloud.viewpoint,
        }
    }

    /// Whether the ground is known all around the foot, nothing stands in the body, and nothing stands
    /// between the body and those who looked: what is behind it is not known to be free.
    fn is_free(&self, foot: DVec3, body: &Body, ground: &Ground, eye: DVec3) -> bool {
        let up = ground.normal;
        let wide = body.radius_m + CLEARANCE_M;
        let touches = |(p, h): &Standing| {
            *h < body.height_m + CLEARANCE_M && level(*p - foot, up).length() < wide
        };
        let around = square(self.chart.at(foot), wide);
        if self.standing.any(&around, touches) || !self.is_known(foot, body, ground, eye) {
            return false;
        }
        let lookers = [Some(eye), self.viewpoint];
        let blocked = |from: DVec3| match Sight::new(from, foot, body, ground) {
            None => true,
            Some(sight) => {
                let corners = sight.corners(&self.chart);
                let blocks = |(p, h): &Standing| sight.is_blocked_by(*p, *h);
                self.standing.any(&corners, blocks)
            }
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
        self.ground.any(&square(self.chart.at(foot), reach), |p| {
            let from = *p - foot;
            if from.length() < reach {
                let (x, y) = (right.dot(from), ahead.dot(from));
                sides[usize::from(x > 0.0) + 2 * usize::from(y > 0.0)] = true;
            }
            sides == [true; 4]
        })
    }
}

/// The part of a vector along the ground.
fn level(v: DVec3, up: DVec3) -> DVec3 {
    v - v.dot(up) * up
}

/// The view that somebody has of a body.
struct Sight {
    from: DVec3,
    /// Height of the eyes over the ground, metres.
    eyes_m: f64,
    up: DVec3,
    /// Along the ground to the body, a unit vector.
    ahead: DVec3,
    /// Along the ground to the body's middle, metres.
    distance: f64,
    /// Radius of the body and the air around it, metres.
    wide: f64,
    height_m: f64,
}

impl Sight {
    /// `None` from within the body.
    fn new(from: DVec3, foot: DVec3, body: &Body, ground: &Ground) -> Option<Self> {
        let up = ground.normal;
        let way = level(foot - from, up);
        let (distance, wide) = (way.length(), body.radius_m + CLEARANCE_M);
        (distance >= wide).then(|| Self {
            from,
            eyes_m: ground.height(from).max(0.0),
            up,
            ahead: way / distance,
            distance,
            wide,
            height_m: body.height_m,
        })
    }

    /// Whether a point of this height over the ground hides a part of the body.
    fn is_blocked_by(&self, p: DVec3, height: f64) -> bool {
        let to = level(p - self.from, self.up);
        let along = to.dot(self.ahead);
        if along <= 0.0 || along >= self.distance + self.wide {
            return false;
        }
        let share = along / self.distance;
        let off = (to - along * self.ahead).length();
        // It blocks the view if it reaches between the lines of sight to the body's foot and to its top.
        let lower = self.eyes_m * (1.0 - along / (self.distance + self.wide));
        let upper = self.eyes_m + (self.height_m - self.eyes_m) * share;
        off < self.wide * share.max(NARROWEST)
            && height > lower - CLEARANCE_M
            && height < upper + CLEARANCE_M
    }

    /// The corners of a trapezoid on the ground with all points that can block the view.
    fn corners(&self, chart: &Chart) -> [DVec2; 4] {
        let end = self.distance + self.wide;
        let [start, ahead, tip] =
            [0.0, 1.0, end].map(|along| chart.at(self.from + along * self.ahead));
        let side = (ahead - start).perp() * self.wide;
        let (near, far) = (NARROWEST * side, end / self.distance * side);
        [start + near, start - near, tip - far, tip + far]
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

    /// As [`Surroundings::is_free`], by a walk through all points.
    fn is_free_by_walk(
        cloud: &Cloud,
        foot: DVec3,
        body: &Body,
        ground: &Ground,
        eye: DVec3,
    ) -> bool {
        let low = (LOW.0 * ground.residual_m).max(LOW.1);
        let heights = cloud.points.iter().map(|p| (*p, ground.height(*p)));
        let (standing, flat): (Vec<_>, Vec<_>) =
            heights.filter(|s| s.1 > -low).partition(|s| s.1 > low);
        let wide = body.radius_m + CLEARANCE_M;
        let touches = |(p, h): &Standing| {
            *h < body.height_m + CLEARANCE_M && level(*p - foot, ground.normal).length() < wide
        };
        let blocked = |from: DVec3| match Sight::new(from, foot, body, ground) {
            None => true,
            Some(sight) => standing.iter().any(|(p, h)| sight.is_blocked_by(*p, *h)),
        };
        let all = Surroundings {
            // All are in one cell, that of the foot.
            chart: Chart::new(foot, ground.normal),
            ground: Cells::new(flat.iter().map(|(p, _)| (DVec2::ZERO, *p))),
            standing: Cells::new(std::iter::empty()),
            viewpoint: None,
        };
        let known = all.is_known(foot, body, ground, eye);
        let lookers = [Some(eye), cloud.viewpoint];
        !standing.iter().any(touches) && known && !lookers.into_iter().flatten().any(blocked)
    }

    #[test]
    fn a_place_is_free_if_a_walk_through_all_points_finds_it_free() {
        let mut found = [0; 2];
        for scene in 0..12u32 {
            let number = |index: u32, low: f64, high: f64| {
                let seed = dipir_numerics::sampler::Stream::TEST;
                let u = Sampler::new(u64::from(scene), seed, index, 0).next_1d();
                low + (high - low) * f64::from(u)
            };
            // A slope with posts on it, far from the origin in some scenes.
            let origin = DVec3::new(f64::from(scene) * 4e5, 0.0, f64::from(scene) * -9e5);
            let normal = DVec3::new(number(0, -0.1, 0.1), 1.0, number(1, -0.1, 0.1)).normalize();
            let ground = Ground {
                point: origin,
                normal,
                ..ground()
            };
            let on = |x: f64, z: f64, h: f64| {
                let level = DVec3::new(x, 0.0, z);
                origin + level + (h - normal.dot(level) / normal.y) * DVec3::Y
            };
            let flat = (0..3000).map(|i| {
                on(
                    number(10 + 2 * i, -15.0, 15.0),
                    number(11 + 2 * i, -30.0, 0.0),
                    0.0,
                )
            });
            let posts = (0..600).map(|i| {
                let post = 9000 + 2 * (i / 40);
                let [x, z] = [number(post, -9.0, 9.0), number(post + 1, -25.0, -2.0)];
                on(x, z, 0.05 * f64::from(i % 40))
            });
            let cloud = Cloud {
                points: flat.chain(posts).collect(),
                viewpoint: Some(origin + DVec3::new(1.0, 1.9, 0.5)),
            };
            let eye = origin + DVec3::new(0.0, 1.6, 0.0);
            let around = Surroundings::new(&cloud, &ground);
            for i in 0..300 {
                let body = Body {
                    radius_m: number(20_000 + 4 * i, 0.05, 1.5),
                    height_m: number(20_001 + 4 * i, 0.0, 2.5),
                };
                let [x, z] = [
                    number(20_002 + 4 * i, -9.0, 9.0),
                    number(20_003 + 4 * i, -28.0, 0.0),
                ];
                let foot = on(x, z, 0.0);
                let got = around.is_free(foot, &body, &ground, eye);
                assert_eq!(
                    got,
                    is_free_by_walk(&cloud, foot, &body, &ground, eye),
                    "{scene} {i}"
                );
                found[usize::from(got)] += 1;
            }
        }
        // Both answers are common, so that each is compared.
        assert!(found.iter().all(|count| *count > 300), "{found:?}");
    }
}
