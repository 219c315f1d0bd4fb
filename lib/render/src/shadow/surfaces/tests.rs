use dipir_imaging::raster::Raster;
use dipir_light::environment::EnvironmentSampler;
use dipir_scene::camera::Camera;
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::Proxy;
use dipir_scene::surfaces::SeenSurfaces;

use super::*;
use crate::counters::RayKind;
use crate::render::{Rendered, Settings, Simulation};
use crate::shapes::{append, icosphere, quad};
use crate::testing::{camera, ground, lambertian, matte, render, scene, settings, sun};

const SIDE: usize = 32;

fn view() -> Camera {
    let (eye, to) = (Vec3::new(0.0, 1.6, 3.0), Vec3::new(0.0, 0.8, -2.0));
    camera(eye, to, 45.0, SIDE as u32)
}

/// Two metres behind the ball.
const WALL_Z: f32 = -2.0;

fn ball() -> TriangleMesh {
    icosphere(Vec3::Y * 0.7, 0.5, 4)
}

/// From the camera's side, so that the ball's shadow reaches ground and wall.
fn light() -> EnvironmentSampler {
    let direction = Vec3::new(0.25, 0.2, 0.9).normalize();
    EnvironmentSampler::new(sun(direction, 2e3, 1.0, 64))
}

/// Whether the wall is seen in all, in a part or in nothing of a pixel.
fn share(x: usize, y: usize) -> f32 {
    let seen = (0..64).filter(|k| {
        let offset = (Vec2::new((k % 8) as f32, (k / 8) as f32) + 0.5) / 8.0;
        let ray = view().ray(Vec2::new(x as f32, y as f32) + offset);
        let t = (WALL_Z - ray.origin.z) / ray.direction.z;
        (ray.origin + ray.direction * t).y > 0.0
    });
    seen.count() as f32 / 64.0
}

/// The wall as the photograph shows it.
fn wall(share: impl Fn(usize, usize) -> f32) -> SeenSurfaces {
    let shares = (0..SIDE * SIDE).map(|i| share(i % SIDE, i / SIDE));
    let view = view();
    // Its normal in the camera's axes, right, up and ahead, over its distance.
    let normal = view.rotation.transpose() * Vec3::NEG_Z;
    let plane = Vec3::new(normal.x, normal.y, -normal.z) / (view.position.z - WALL_Z);
    SeenSurfaces::new(
        Raster::from_pixels(SIDE, SIDE, shares.collect()),
        Raster::filled(5, 3, plane),
    )
}

fn rendered(proxy: Proxy, settings: &Settings) -> Rendered {
    let s = scene(ball(), matte(Vec3::ONE), view(), proxy);
    let simulation = Simulation {
        proxy_occlusion: false,
        ..lambertian(1)
    };
    render(&s, &light(), &simulation, settings)
}

fn on(surfaces: &SeenSurfaces, samples: u32) -> Settings<'_> {
    Settings {
        seen_surfaces: Some(surfaces),
        ..settings(samples, 7)
    }
}

#[test]
fn a_wall_of_the_photograph_catches_the_shadow_as_one_of_the_proxy_does() {
    let mut room = quad(
        Vec3::new(-50.0, 0.0, 50.0),
        Vec3::X * 100.0,
        Vec3::NEG_Z * 100.0,
    );
    let behind = quad(
        Vec3::new(-50.0, 0.0, WALL_Z),
        Vec3::X * 100.0,
        Vec3::Y * 50.0,
    );
    append(&mut room, behind, 0);
    let wall = wall(share);
    let of_mesh = rendered(Proxy::Mesh(room), &settings(256, 7));
    let of_photo = rendered(ground(), &on(&wall, 256));
    let (mut differ, mut most, mut darkest) = ([0.0; 2], 0f32, [1f32; 2]);
    let mut counts = [0.0; 2];
    for (i, (a, b)) in of_mesh
        .film
        .shadow
        .pixels()
        .iter()
        .zip(of_photo.film.shadow.pixels())
        .enumerate()
    {
        let share = share(i % SIDE, i / SIDE);
        if share != share.round() {
            continue;
        }
        let kind = usize::from(share > 0.5);
        differ[kind] += a.x - b.x;
        counts[kind] += 1.0;
        most = most.max((a.x - b.x).abs());
        darkest[kind] = darkest[kind].min(b.x);
    }
    // A sample meets the sun or not: .5 at most over the root of 512 samples, half of which are the light's, is .03 a pixel. Of
    // two times 900 pixels the largest is four of that, and differences are root 2 of one.
    assert!(most < 4.0 * 0.03 * 2f32.sqrt(), "{most}");
    // Means of some 400 pixels are off by a twentieth of .03 times root 2, and twice that in one of 20.
    for kind in 0..2 {
        assert!(
            (differ[kind] / counts[kind]).abs() < 4.2e-3,
            "{differ:?} {counts:?}"
        );
        assert!(darkest[kind] < 0.7, "{darkest:?}");
    }
}

#[test]
fn ground_in_blocks_without_surfaces_keeps_its_shadow_to_the_bit() {
    let none = rendered(ground(), &settings(16, 7));
    let wall = wall(share);
    let some = rendered(ground(), &on(&wall, 16));
    let mut same = 0;
    for y in (0..SIDE).step_by(8) {
        for x in (0..SIDE).step_by(8) {
            let pixels = || (y..y + 8).flat_map(move |v| (x..x + 8).map(move |u| (u, v)));
            if pixels().all(|(u, v)| share(u, v) == 0.0) {
                for (u, v) in pixels() {
                    assert_eq!(none.film.shadow.get(u, v), some.film.shadow.get(u, v));
                }
                same += 1;
            }
        }
    }
    assert!(same > 3, "{same}");
}

#[test]
fn a_mask_hides_objects_and_leaves_the_shadow_on_what_it_stands_for() {
    let wall = wall(share);
    let all = Raster::filled(SIDE, SIDE, 1.0);
    let of_shadow = wall.share().map(|s| 1.0 - s);
    let hidden = Settings {
        occluders: Some(&all),
        shadow_mask: Some(&of_shadow),
        ..on(&wall, 16)
    };
    let [seen, hidden] = [on(&wall, 16), hidden].map(|s| rendered(ground(), &s));
    assert!(hidden.film.alpha.pixels().iter().all(|a| *a == 0.0));
    for y in 0..SIDE {
        for x in 0..SIDE {
            let wanted = match share(x, y) {
                1.0 => *seen.film.shadow.get(x, y),
                0.0 => Vec3::ONE,
                _ => continue,
            };
            assert_eq!(*hidden.film.shadow.get(x, y), wanted, "{x} {y}");
        }
    }
}

#[test]
fn surfaces_that_the_object_takes_no_light_from_cost_no_rays() {
    // Everywhere a wall, and all light comes from behind the ball as it sees it.
    let wall = wall(|_, _| 1.0);
    let s = scene(ball(), matte(Vec3::ONE), view(), ground());
    let behind = EnvironmentSampler::new(sun(Vec3::NEG_Z, 60.0, 0.0, 16));
    let r = render(&s, &behind, &lambertian(1), &on(&wall, 4));
    assert!(r.film.shadow.pixels().iter().all(|v| *v == Vec3::ONE));
    assert_eq!(r.counts.get(RayKind::Shadow), 0);
    assert_eq!(r.counts.get(RayKind::Proxy), 0);
}

#[test]
fn a_mask_of_another_size_is_refused() {
    let small = SeenSurfaces::new(Raster::filled(4, 3, 1.0), Raster::filled(4, 3, Vec3::Z));
    let s = scene(ball(), matte(Vec3::ONE), view(), ground());
    let error = crate::render::Renderer::new(&s)
        .render(&light(), &lambertian(1), &on(&small, 4), &mut |_| {
            std::ops::ControlFlow::Continue(())
        })
        .expect_err("sizes differ");
    assert!(
        error.to_string().contains("share of surfaces is 4 x 3"),
        "{error}"
    );
}

#[test]
fn at_a_lower_resolution_the_wall_catches_the_same_shadow() {
    let wall = wall(share);
    let half = Settings {
        most_pixels: Some((SIDE * SIDE / 4) as u64),
        ..on(&wall, 64)
    };
    let [full, half] = [on(&wall, 64), half].map(|s| rendered(ground(), &s));
    assert_eq!(half.divisor, 2);
    let mean = |r: &Rendered| {
        let pixels = (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y)));
        let on_wall: Vec<f32> = pixels
            .filter(|&(x, y)| share(x, y) == 1.0)
            .map(|(x, y)| r.film.shadow.get(x, y).x)
            .collect();
        on_wall.iter().sum::<f32>() / on_wall.len() as f32
    };
    let (full, half) = (mean(&full), mean(&half));
    assert!(full < 0.97, "the test must be able to fail: {full}");
    // One of the wall's rows, of which there are more than 10, is half the ground's, whose ratio is up to .7 off: .035 at most.
    assert!((full - half).abs() < 0.035, "{full} {half}");
}

#[test]
fn a_wall_of_the_photograph_stands_before_a_proxy_mesh_too() {
    let floor = quad(
        Vec3::new(-50.0, 0.0, 50.0),
        Vec3::X * 100.0,
        Vec3::NEG_Z * 100.0,
    );
    let wall = wall(share);
    let [plane, mesh] = [ground(), Proxy::Mesh(floor)].map(|p| rendered(p, &on(&wall, 256)));
    for y in 0..SIDE {
        for x in 0..SIDE {
            if share(x, y) == 1.0 {
                // The same samples.
                let [a, b] = [&plane, &mesh].map(|r| r.film.shadow.get(x, y).x);
                assert!((a - b).abs() < 1e-5, "{x} {y} {a} {b}");
            }
        }
    }
}

/// The picture of `mesh` and an even sky, or one below the horizon, before `wall`; checks that ratios are finite.
fn finite(mesh: TriangleMesh, light: &EnvironmentSampler, wall: &SeenSurfaces) -> Rendered {
    let s = scene(mesh, matte(Vec3::ONE), view(), ground());
    let r = render(&s, light, &crate::testing::everything(2), &on(wall, 4));
    for v in r.film.shadow.pixels() {
        assert!(v.is_finite() && v.min_element() >= 0.0, "{v}");
    }
    r
}

#[test]
fn objects_in_a_surface_or_around_the_camera_and_light_that_reaches_none_leave_finite_ratios() {
    let sky = crate::testing::sky(1.0);
    let wall = wall(share);
    // Half in the wall: what it covers of it gets no light.
    let inside = finite(icosphere(Vec3::new(0.0, 1.0, WALL_Z), 0.5, 4), &sky, &wall);
    let covered = inside.film.shadow.pixels().iter().map(|v| v.x);
    assert!(covered.fold(1f32, f32::min) < 0.2);
    // Around the camera: only what it reflects arrives anywhere in it.
    finite(icosphere(view().position, 1.0, 4), &sky, &wall);
    // All light comes from below the ground and from behind the wall.
    let none = EnvironmentSampler::new(sun(Vec3::new(0.0, -0.6, -0.8), 1e6, 0.0, 16));
    let s = scene(ball(), matte(Vec3::ONE), view(), ground());
    let r = render(&s, &none, &lambertian(1), &on(&wall, 4));
    assert!(r.film.shadow.pixels().iter().all(|v| *v == Vec3::ONE));
}
