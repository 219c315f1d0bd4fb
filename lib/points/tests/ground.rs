//! Generated scans of streets: the ground through them, and places on it.
use dipir_cameras::{Camera, Lens, Pose, WorldUp};
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_points::ground::{Search, Shape, ground, other_up};
use dipir_points::place::{self, Body};
use dipir_points::{Cloud, Ground};
use glam::{DMat3, DVec2, DVec3};

/// Where the scanner stands above the ground, as on a car.
const SCANNER: DVec3 = DVec3::new(0.0, 1.73, 0.3);
const NOISE_M: f64 = 0.02;

/// The camera beside the scanner, pitched a little.
fn camera() -> Camera {
    Camera {
        pose: Pose {
            position: DVec3::new(0.05, 1.65, 0.0),
            rotation: DMat3::from_rotation_x(-0.03),
        },
        lens: Lens {
            principal_px: DVec2::new(609.0, 172.0),
            ..Lens::pinhole([1242.0, 375.0], DVec2::splat(721.5))
        },
    }
}

/// Numbers of one scene.
struct Numbers(Sampler);

impl Numbers {
    fn new(scene: u32, index: u32) -> Self {
        Self(Sampler::new(7, Stream::TEST, scene, index))
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * f64::from(self.0.next_1d())
    }

    fn normal(&mut self) -> f64 {
        let (u, v) = (self.between(0.0, 1.0), self.between(0.0, 1.0));
        (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    }
}

/// A street with a slope and boxes on it.
struct Street {
    normal: DVec3,
    /// Corners of the boxes, their sides along the axes.
    boxes: Vec<[DVec3; 2]>,
}

impl Street {
    fn new(scene: u32, boxes: u32) -> Self {
        let mut n = Numbers::new(scene, 0);
        let slope = n.between(0.0, 0.08);
        let (sin, cos) = n.between(0.0, std::f64::consts::TAU).sin_cos();
        let normal = DVec3::new(slope * sin, 1.0, slope * cos).normalize();
        let mut found = Vec::new();
        for i in 0..boxes {
            let mut n = Numbers::new(scene, 1 + i);
            let (x, z) = (n.between(-12.0, 12.0), n.between(-32.0, -4.5));
            let half = DVec3::new(n.between(0.15, 1.8), 0.0, n.between(0.15, 2.2));
            let foot = DVec3::new(x, 0.0, z);
            let on = foot - normal.dot(foot) / normal.y * DVec3::Y;
            let top = on + DVec3::Y * n.between(0.4, 2.6);
            found.push([on - half - DVec3::Y, top + half]);
        }
        Self {
            normal,
            boxes: found,
        }
    }

    /// Distance to what a ray from the scanner meets, and whether that is the ground.
    fn hit(&self, origin: DVec3, direction: DVec3) -> Option<(f64, bool)> {
        let descent = -self.normal.dot(direction);
        let ground = self.normal.dot(origin) / descent;
        let mut best = (ground > 0.0).then_some((ground, true));
        for [low, high] in &self.boxes {
            let (a, b) = ((*low - origin) / direction, (*high - origin) / direction);
            let (near, far) = (a.min(b).max_element(), a.max(b).min_element());
            if near > 0.0 && near <= far && best.is_none_or(|b| near < b.0) {
                best = Some((near, false));
            }
        }
        best.filter(|b| b.0 < 80.0)
    }

    /// A sweep of 64 beams; with so much of it off the ground, if that is asked.
    fn scan(&self, scene: u32, off_ground: Option<f64>) -> Cloud {
        let (mut on, mut off) = (Vec::new(), Vec::new());
        for beam in 0..64u32 {
            let elevation = (2.0 - 26.8 * f64::from(beam) / 63.0).to_radians();
            for step in 0..900u32 {
                let azimuth = (0.4 * f64::from(step)).to_radians();
                let flat = DVec3::new(azimuth.sin(), 0.0, azimuth.cos()) * elevation.cos();
                let direction = flat + DVec3::Y * elevation.sin();
                let Some((distance, is_ground)) = self.hit(SCANNER, direction) else {
                    continue;
                };
                let mut n = Numbers::new(scene, 1000 + beam * 900 + step);
                let point = SCANNER + (distance + NOISE_M * n.normal()) * direction;
                match is_ground {
                    true => on.push(point),
                    false => off.push(point),
                }
            }
        }
        if let Some(share) = off_ground {
            // The larger part is thinned evenly.
            let all = (on.len() as f64 / (1.0 - share)).min(off.len() as f64 / share);
            let thinned = |points: Vec<DVec3>, wanted: f64| -> Vec<DVec3> {
                let every = points.len() as f64 / wanted.floor();
                let count = wanted as usize;
                (0..count)
                    .map(|i| points[(i as f64 * every) as usize])
                    .collect()
            };
            on = thinned(on, all * (1.0 - share));
            off = thinned(off, all * share);
        }
        on.append(&mut off);
        Cloud {
            points: on,
            viewpoint: Some(SCANNER),
        }
    }

    /// From the disc around a foot to the nearest box, seen from above.
    fn room(&self, foot: DVec3, radius: f64) -> f64 {
        let apart = |[low, high]: &[DVec3; 2]| {
            let nearest = foot.clamp(*low, *high);
            DVec2::new(nearest.x - foot.x, nearest.z - foot.z).length() - radius
        };
        self.boxes.iter().map(apart).fold(f64::INFINITY, f64::min)
    }
}

fn found(cloud: &Cloud, camera: &Camera, shape: Shape) -> Ground {
    let search = Search {
        camera,
        up: DVec3::Y,
        shape,
        seed: 0,
    };
    ground(cloud, &search).unwrap()
}

#[test]
fn the_ground_of_a_scan_half_off_it_is_found_within_a_third_of_a_degree_and_two_centimetres() {
    let camera = camera();
    let mut within = 0;
    for scene in 0..24 {
        // Boxes stand closely, so that half of what the scanner sees is on them.
        let mut street = Street::new(scene, 60);
        for wall in [-14.0, 14.0] {
            let low = DVec3::new(wall - 0.5, -9.0, -60.0);
            street.boxes.push([low, DVec3::new(wall + 0.5, 6.0, 60.0)]);
        }
        let cloud = street.scan(scene, Some(0.5));
        let ground = found(&cloud, &camera, Shape::Plane);
        let angle = ground.normal.angle_between(street.normal).to_degrees();
        // Below the camera, and ten metres before it.
        let off = [DVec3::ZERO, DVec3::new(0.0, 0.0, -10.0)].map(|p| {
            let on = p - street.normal.dot(p) / street.normal.y * DVec3::Y;
            ground.height(on).abs()
        });
        assert!(angle < 0.3, "scene {scene}: {angle} degrees");
        assert!(off[0] < 0.02 && off[1] < 0.02, "scene {scene}: {off:?}");
        assert!(ground.residual_m < 2.0 * NOISE_M && ground.inliers < ground.points);
        within += 1;
    }
    assert_eq!(within, 24);
}

#[test]
fn a_place_is_never_inside_an_obstacle_and_its_foot_is_on_the_ground() {
    let camera = camera();
    let bodies = [
        Body {
            radius_m: 0.45,
            height_m: 0.95,
        },
        Body {
            radius_m: 1.2,
            height_m: 1.5,
        },
    ];
    let (mut draws, mut placed) = (0, 0);
    for scene in 100..150 {
        let street = Street::new(scene, 14);
        let cloud = street.scan(scene, None);
        let ground = found(&cloud, &camera, Shape::Auto);
        for draw in 0..4 {
            let body = bodies[draw as usize % 2];
            let search = place::Search {
                camera: &camera,
                ground: &ground,
                cloud: Some(&cloud),
                taken: &[],
                hidden: &|_| false,
                draw,
            };
            draws += 1;
            let Some(foot) = search.place(&body) else {
                continue;
            };
            placed += 1;
            let room = street.room(foot, body.radius_m);
            assert!(room > 0.0, "scene {scene}, draw {draw}: {foot} {room}");
            let truth = foot - street.normal.dot(foot) / street.normal.y * DVec3::Y;
            let pixel = |p: DVec3| camera.project(p).unwrap();
            let off = pixel(foot).distance(pixel(truth));
            assert!(off < 2.0, "scene {scene}: {off} pixels at {foot}");
            // Nothing stands in the way.
            let sight = street.hit(camera.pose.position, truth - camera.pose.position);
            assert!(
                sight.is_some_and(|s| s.1),
                "scene {scene}: hidden at {foot}"
            );
        }
    }
    assert_eq!(draws, 200);
    // Streets so full that nothing is free are few.
    assert!(placed > 120, "{placed}");
}

#[test]
fn without_points_the_place_is_in_the_lower_middle_and_whole() {
    let camera = camera();
    let ground = Ground {
        point: DVec3::ZERO,
        normal: DVec3::Y,
        points: 0,
        inliers: 0,
        residual_m: 0.0,
        relief: None,
    };
    let body = Body {
        radius_m: 0.5,
        height_m: 1.0,
    };
    let search = |taken, draw| place::Search {
        camera: &camera,
        ground: &ground,
        cloud: None,
        taken,
        hidden: &|_| false,
        draw,
    };
    let first = search(&[], 0).place(&body).unwrap();
    let pixel = camera.project(first).unwrap();
    assert!(
        (pixel.x / 1242.0 - 0.5).abs() < 0.1 && pixel.y > 0.6 * 375.0,
        "{pixel}"
    );
    assert!(camera.project(first + DVec3::Y).unwrap().y > 0.0);
    // A second one stands beside it.
    let taken = [(first, body)];
    let second = search(&taken, 0).place(&body).unwrap();
    assert!(second.distance(first) > 1.0);
    assert_ne!(search(&[], 1).place(&body), search(&[], 2).place(&body));
    let tower = Body {
        radius_m: 0.5,
        height_m: 400.0,
    };
    assert_eq!(search(&[], 0).place(&tower), None);
}

#[test]
fn ground_that_rises_behind_a_bend_gets_a_relief_and_flat_ground_none() {
    let camera = camera();
    // Level up to 9 m, then up by 10%, rounded over 4 m.
    let height = |z: f64| 0.05 * ((-z - 9.0) + ((-z - 9.0).powi(2) + 4.0).sqrt());
    let cloud = |bent: f64| {
        let points = (0..40_000).map(|i| {
            let mut n = Numbers::new(5, i);
            let (x, z) = (n.between(-9.0, 9.0), n.between(-24.0, -3.0));
            let clutter = match n.between(0.0, 1.0) < 0.3 {
                true => n.between(0.3, 2.0),
                false => NOISE_M * n.normal(),
            };
            DVec3::new(x, bent * height(z) + clutter, z)
        });
        Cloud {
            points: points.collect(),
            viewpoint: None,
        }
    };
    assert_eq!(found(&cloud(0.0), &camera, Shape::Auto).relief, None);
    let ground = found(&cloud(1.0), &camera, Shape::Auto);
    let relief = ground.relief.as_ref().expect("not flat");
    assert!(relief.is_whole());
    let mut worst = 0.0f64;
    for i in -4..=4 {
        for j in 6..=20 {
            let (x, z) = (0.5 * f64::from(i), -f64::from(j));
            worst = worst.max(ground.height(DVec3::new(x, height(z), z)).abs());
        }
    }
    // Noise of 2 cm, averaged over hundreds of points, and the bend's rounding by smoothing.
    assert!(worst < 0.03, "{worst}");
    // Rays meet it, and its triangles face up.
    let hit = ground
        .hit(camera.pose.position, DVec3::new(0.0, -0.06, -1.0))
        .unwrap();
    assert!(ground.height(hit).abs() < 1e-3);
    let (corners, triangles) = relief.triangles();
    let [a, b, c] = triangles[0].map(|i| corners[i as usize]);
    assert!((b - a).cross(c - a).y > 0.0);
}

#[test]
fn points_without_a_ground_are_explained() {
    let camera = camera();
    let search = Search {
        camera: &camera,
        up: DVec3::Y,
        shape: Shape::Auto,
        seed: 0,
    };
    let said = |cloud: &Cloud| ground(cloud, &search).unwrap_err().to_string();
    assert!(said(&Cloud::default()).contains("the camera sees 0 of them below itself"));
    let wall = (0..400).map(|i| DVec3::new(f64::from(i % 20), f64::from(i / 20) * 0.05, -9.0));
    let wall = Cloud {
        points: wall.collect(),
        viewpoint: None,
    };
    let error = said(&wall);
    assert!(
        error.contains("no ground is found in the points"),
        "{error}"
    );
}

#[test]
fn the_axis_that_points_up_is_the_one_by_which_the_camera_sees_ground() {
    // The origin is at the camera: ground through the origin would be ground upside down, too.
    let mut camera = camera();
    let origin = std::mem::take(&mut camera.pose.position);
    let search = Search {
        camera: &camera,
        up: DVec3::Y,
        shape: Shape::Auto,
        seed: 0,
    };
    for scene in 0..6 {
        let mut cloud = Street::new(scene, 20).scan(scene, None);
        cloud.points.iter_mut().for_each(|p| *p -= origin);
        for written in WorldUp::USUAL {
            for taken in WorldUp::USUAL {
                let turn = taken.to_ours() * written.to_ours().transpose();
                let points = cloud.points.iter().map(|p| turn * *p).collect();
                let cloud = Cloud {
                    points,
                    viewpoint: None,
                };
                let found = other_up(&cloud, &search, taken);
                let want = (taken != written).then_some(written);
                assert_eq!(found, want, "{scene} {written:?} {taken:?}");
            }
        }
    }
}

#[test]
fn a_wall_is_no_ground_though_a_strip_of_it_is_level() {
    let camera = camera();
    let points = (0..4000).map(|i| {
        let mut n = Numbers::new(11, i);
        let (x, y) = (n.between(-4.0, 4.0), n.between(-2.0, 1.5));
        DVec3::new(x, y, -6.0 + 0.01 * n.normal())
    });
    let wall = Cloud {
        points: points.collect(),
        viewpoint: None,
    };
    let search = Search {
        camera: &camera,
        up: DVec3::Y,
        shape: Shape::Auto,
        seed: 0,
    };
    let error = ground(&wall, &search).unwrap_err().to_string();
    assert!(
        error.contains("degrees from level, and ground is 20 at most"),
        "{error}"
    );
}

/// Ground of so many points with 2 cm of noise, before the camera.
fn sparse(count: u32) -> Cloud {
    let points = (0..count).map(|i| {
        let mut n = Numbers::new(9, i);
        let (x, z) = (n.between(-4.0, 4.0), n.between(-14.0, -5.0));
        DVec3::new(x, NOISE_M * n.normal(), z)
    });
    Cloud {
        points: points.collect(),
        viewpoint: None,
    }
}

#[test]
fn a_relief_that_is_asked_of_too_few_points_is_refused() {
    let camera = camera();
    let of = |count, shape| {
        let up = DVec3::Y;
        let seed = 0;
        let search = Search {
            camera: &camera,
            up,
            shape,
            seed,
        };
        ground(&sparse(count), &search).map_err(|e| e.to_string())
    };
    assert_eq!(of(60, Shape::Auto).unwrap().relief, None);
    let error = of(60, Shape::Relief).unwrap_err();
    let want = "cannot be a relief: fewer than 100 of them are ground near the camera; leave points_shape out";
    assert!(error.contains(want), "{error}");
    assert!(of(400, Shape::Relief).unwrap().relief.is_some());
}

#[test]
fn a_camera_that_looks_straight_down_sees_a_relief() {
    let mut camera = camera();
    camera.pose.position = DVec3::new(0.0, 30.0, -9.0);
    camera.pose.rotation = DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y);
    // A plane without noise has a normal straight up.
    let mut cloud = sparse(4000);
    cloud.points.iter_mut().for_each(|p| p.y = 0.0);
    let ground = found(&cloud, &camera, Shape::Relief);
    assert!(ground.normal.abs_diff_eq(DVec3::Y, 1e-12) && ground.relief.is_some());
}

#[test]
fn a_scan_in_utm_coordinates_has_the_same_ground() {
    let here = camera();
    let utm = DVec3::new(458_000.0, 520.0, -5_428_000.0);
    let mut there = here;
    there.pose.position += utm;
    let cloud = Street::new(3, 20).scan(3, None);
    let moved = Cloud {
        points: cloud.points.iter().map(|p| *p + utm).collect(),
        viewpoint: cloud.viewpoint.map(|p| p + utm),
    };
    let (near, far) = (
        found(&cloud, &here, Shape::Auto),
        found(&moved, &there, Shape::Auto),
    );
    // Coordinates of 5e6 m have steps of 1e-9 m, sums of 1e4 of them are off by 1e-5 at most, their mean by far less.
    assert!(near.normal.abs_diff_eq(far.normal, 1e-6));
    assert!((far.point - utm).abs_diff_eq(near.point, 1e-5));
    assert!((near.residual_m - far.residual_m).abs() < 1e-5);
}
