//! Meshes of any size at any distance: hits, and rays that leave surfaces.
use super::*;
use crate::ray_offset::spawn_origin;

/// Sizes in metres at distances in metres that f32 can hold with at least 2^-20 of the size.
const SCALES: [(f32, f32); 7] = [
    (1.0, 0.0),
    (1e-6, 0.0),
    (1e-6, 1e-3),
    (1e6, 0.0),
    (1e6, 1e6),
    (1e30, 0.0),
    (1e-30, 0.0),
];

#[test]
fn size_and_offset_change_no_hit() {
    let unit = sphere(8, 0.2);
    for (size, offset) in SCALES {
        let shift = Vec3::new(1.0, -0.5, 0.25) * offset;
        let m = moved(unit.clone(), size, shift);
        let rays: Vec<Ray> = rays_at_unit_cube(2000, 6)
            .iter()
            .map(|r| Ray {
                origin: r.origin * size + shift,
                direction: r.direction,
            })
            .collect();
        // f64 brute force underflows at 1e-30 m: bring mesh and rays back, exactly, by a power
        // of two.
        let unscale = (1.0 / size).log2().round().exp2();
        let back = moved(m.clone(), unscale, Vec3::ZERO);
        let bvh = Bvh::build(&m);
        let reference = Bvh::build(&back);
        let back_rays = |r: &Ray| Ray {
            origin: r.origin * unscale,
            direction: r.direction,
        };
        check_against_brute_force(&back, &rays.iter().map(back_rays).collect::<Vec<_>>(), 2e-3);
        for ray in &rays {
            let (a, b) = (
                bvh.closest(ray, f32::INFINITY, any),
                reference.closest(&back_rays(ray), f32::INFINITY, any),
            );
            assert_eq!(
                a.map(|h| h.triangle),
                b.map(|h| h.triangle),
                "{size} m at {offset} m"
            );
        }
    }
}

#[test]
fn a_mesh_a_million_metres_away_is_hit_like_one_at_the_origin() {
    // Positions there are multiples of 1/16 m: so are these, hence nothing is rounded.
    let mut unit = sphere(8, 0.2);
    for p in &mut unit.positions {
        *p = (*p * 64.0).round() / 16.0;
    }
    let shift = Vec3::new(1e6, -1e6, 1e6);
    let (near, far) = (
        Bvh::build(&unit),
        Bvh::build(&moved(unit.clone(), 1.0, shift)),
    );
    for mut ray in rays_at_unit_cube(5000, 7) {
        ray.origin = (ray.origin * 64.0).round() / 16.0;
        let a = near.closest(&ray, f32::INFINITY, any);
        ray.origin += shift;
        assert_eq!(a, far.closest(&ray, f32::INFINITY, any), "{ray:?}");
    }
}

#[test]
fn a_camera_a_million_sizes_away_sees_the_mesh() {
    let m = sphere(8, 0.0);
    let bvh = Bvh::build(&m);
    let mut random = Random(8);
    for _ in 0..2000 {
        let from = random.direction();
        // Well within the silhouette of the polyhedron; the origin, exact in f32, and the
        // direction, good to 2^-24, aim within 0.06 m at a million metres.
        let ray = Ray {
            origin: from * 1e6,
            direction: (from * -1e6).normalize(),
        };
        let hit = bvh
            .closest(&ray, f32::INFINITY, any)
            .expect("aimed at the centre");
        // One ulp of a million is 1/16.
        assert!((hit.t - 1e6).abs() < 1.5, "{hit:?}");
    }
}

#[test]
fn no_ray_escapes_from_inside_a_closed_mesh() {
    for (m, seed) in [
        (sphere(16, 0.2), 9),
        (moved(sphere(16, 0.0), 1e-6, Vec3::ZERO), 10),
    ] {
        let bvh = Bvh::build(&m);
        let size = m.positions[0].y.abs();
        let mut random = Random(seed);
        for i in 0..100_000 {
            let origin = random.point() * 0.2 * size;
            // Every other ray is aimed at a vertex or at the middle of an edge.
            let triangle = corners(&m, (random.unit() * m.indices.len() as f32) as u32);
            let target = match i % 4 {
                0 => triangle[0],
                1 => (triangle[0] + triangle[1]) * 0.5,
                _ => origin + random.direction() * size,
            };
            let ray = Ray {
                origin,
                direction: (target - origin).normalize(),
            };
            assert!(bvh.closest(&ray, f32::INFINITY, any).is_some(), "{ray:?}");
            assert!(bvh.occluded(&ray, f32::INFINITY, any), "{ray:?}");
        }
    }
}

/// Sizes and offsets at which rays leave surfaces: f32 resolves each offset to 2^-7 of the size
/// or better.
const SURFACES: [(f32, f32); 6] = [
    (1.0, 0.0),
    (1e-6, 0.0),
    (1e-6, 0.1),
    (1e6, 0.0),
    (10.0, 1e6),
    (1e6, 1e6),
];

#[test]
fn a_ray_that_leaves_a_convex_surface_does_not_meet_it_again() {
    // Rounding of its corners to f32 may make a polyhedron slightly concave. Then the ray may meet its neighbours, and the
    // test only asks that it does not meet the triangle it left.
    for (size, offset) in SURFACES {
        let m = moved(sphere(10, 0.0), size, Vec3::splat(offset));
        let bvh = Bvh::build(&m);
        let mut random = Random(11);
        for _ in 0..20_000 {
            let origin = random.direction() * 3.0 * size + Vec3::splat(offset);
            let target = random.point() * 0.5 * size + Vec3::splat(offset);
            let ray = Ray {
                origin,
                direction: (target - origin).normalize(),
            };
            let Some(hit) = bvh.closest(&ray, f32::INFINITY, any) else {
                continue;
            };
            let p = bvh.surface_point(&m, &hit);
            let out = random.direction();
            let out = if out.dot(p.geometric_normal) < 0.0 {
                -out
            } else {
                out
            };
            let origin = spawn_origin(p.position, p.geometric_normal, out, p.error);
            let ray = Ray {
                origin,
                direction: out,
            };
            let again = bvh.closest(&ray, f32::INFINITY, |t, _, _| t == hit.triangle);
            assert_eq!(again, None, "{size} m at {offset} m: {p:?} {ray:?}");
            if offset == 0.0 {
                let any_again = bvh.closest(&ray, f32::INFINITY, any);
                assert_eq!(any_again, None, "{size} m: {hit:?} {p:?} {ray:?}");
            }
        }
    }
}

#[test]
fn a_ray_that_enters_a_closed_surface_meets_its_other_side() {
    for (size, offset) in SURFACES {
        let m = moved(sphere(10, 0.0), size, Vec3::splat(offset));
        let bvh = Bvh::build(&m);
        let mut random = Random(12);
        let mut leaks = 0;
        for _ in 0..20_000 {
            let origin = random.direction() * 3.0 * size + Vec3::splat(offset);
            let target = random.point() * 0.5 * size + Vec3::splat(offset);
            let ray = Ray {
                origin,
                direction: (target - origin).normalize(),
            };
            let Some(hit) = bvh.closest(&ray, f32::INFINITY, any) else {
                continue;
            };
            let p = bvh.surface_point(&m, &hit);
            let inwards = random.direction();
            let inwards = if inwards.dot(p.geometric_normal) > 0.0 {
                -inwards
            } else {
                inwards
            };
            // A point within the error of an edge may lie beyond the neighbour's plane.
            let edge = hit.u.min(hit.v).min(1.0 - hit.u - hit.v) * 0.1 * size;
            let origin = spawn_origin(p.position, p.geometric_normal, inwards, p.error);
            if edge < 8.0 * p.error {
                continue;
            }
            let ray = Ray {
                origin,
                direction: inwards,
            };
            leaks += bvh.closest(&ray, f32::INFINITY, any).is_none() as u32;
        }
        assert_eq!(leaks, 0, "{size} m at {offset} m");
    }
}
