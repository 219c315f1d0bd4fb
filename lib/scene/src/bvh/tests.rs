use std::f32::consts::TAU;

use glam::Vec2;

mod scale;

use super::*;

/// A stream of numbers in `[0, 1)` (SplitMix64).
struct Random(u64);

impl Random {
    fn unit(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) >> 40) as f32 / (1u64 << 24) as f32
    }

    fn direction(&mut self) -> Vec3 {
        let z = 2.0 * self.unit() - 1.0;
        let (s, c) = (TAU * self.unit()).sin_cos();
        let r = (1.0 - z * z).sqrt();
        Vec3::new(r * c, r * s, z)
    }

    fn point(&mut self) -> Vec3 {
        Vec3::new(self.unit(), self.unit(), self.unit()) * 2.0 - 1.0
    }
}

fn any(_: u32, _: f32, _: f32) -> bool {
    true
}

fn mesh(positions: Vec<Vec3>, indices: Vec<[u32; 3]>) -> TriangleMesh {
    TriangleMesh {
        positions,
        indices,
        ..Default::default()
    }
}

fn quad() -> TriangleMesh {
    mesh(
        vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y],
        vec![[0, 1, 2], [0, 2, 3]],
    )
}

/// A closed sphere of `2 n^2` triangles or so, with bumps of relative height `bump`, seen from
/// outside counter-clockwise.
fn sphere(n: u32, bump: f32) -> TriangleMesh {
    let mut positions = vec![Vec3::Y, Vec3::NEG_Y];
    for i in 1..n {
        for j in 0..2 * n {
            let (st, ct) = (TAU * 0.5 * i as f32 / n as f32).sin_cos();
            let (sp, cp) = (TAU * 0.5 * j as f32 / n as f32).sin_cos();
            let p = Vec3::new(st * cp, ct, -st * sp);
            let height = (5.0 * p.x).sin() * (7.0 * p.y).cos() * (6.0 * p.z + 1.0).sin();
            positions.push(p * (1.0 + bump * height));
        }
    }
    let at = |i: u32, j: u32| 2 + (i - 1) * 2 * n + j % (2 * n);
    let mut indices = Vec::new();
    for j in 0..2 * n {
        indices.push([0, at(1, j), at(1, j + 1)]);
        indices.push([1, at(n - 1, j + 1), at(n - 1, j)]);
        for i in 1..n - 1 {
            indices.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
            indices.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
        }
    }
    mesh(positions, indices)
}

fn moved(mut m: TriangleMesh, scale: f32, offset: Vec3) -> TriangleMesh {
    for p in &mut m.positions {
        *p = *p * scale + offset;
    }
    m
}

/// Distance to one triangle in f64 [Möller, Trumbore 1997], with how decidedly it is hit: the
/// smallest barycentric weight, negative for a miss.
fn reference(ray: &Ray, [a, b, c]: [Vec3; 3]) -> Option<(f64, f64)> {
    let [a, b, c] = [a, b, c].map(|p| p.as_dvec3());
    let (o, d) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
    let (e1, e2) = (b - a, c - a);
    let p = d.cross(e2);
    let det = e1.dot(p);
    if det.abs() < 1e-30 {
        return None;
    }
    let s = o - a;
    let u = s.dot(p) / det;
    let q = s.cross(e1);
    let v = d.dot(q) / det;
    Some((e2.dot(q) / det, u.min(v).min(1.0 - u - v)))
}

fn corners(m: &TriangleMesh, t: u32) -> [Vec3; 3] {
    m.indices[t as usize].map(|i| m.positions[i as usize])
}

/// Compares `rays` with brute force. A hit that another is nearer than, or that passes an edge,
/// by less than rounding may go either way; `slack` is that rounding in barycentric weight and
/// relative distance.
fn check_against_brute_force(m: &TriangleMesh, rays: &[Ray], slack: f64) {
    let bvh = Bvh::build(m);
    for ray in rays {
        let (mut sure, mut possible) = (f64::INFINITY, f64::INFINITY);
        for t in 0..m.indices.len() as u32 {
            if let Some((distance, weight)) = reference(ray, corners(m, t))
                && distance > 0.0
            {
                if weight >= slack {
                    sure = sure.min(distance);
                }
                if weight >= -slack {
                    possible = possible.min(distance);
                }
            }
        }
        let hit = bvh.closest(ray, f32::INFINITY, any);
        match hit {
            Some(hit) => {
                let t = hit.t as f64;
                assert!(
                    possible * (1.0 - slack) <= t && t <= sure * (1.0 + slack),
                    "{ray:?}: found {hit:?}, expected {possible} to {sure}"
                );
                let (there, weight) = reference(ray, corners(m, hit.triangle)).unwrap();
                assert!(
                    (there - t).abs() <= slack * t && weight >= -slack,
                    "{ray:?}: {hit:?}"
                );
            }
            None => assert!(sure == f64::INFINITY, "{ray:?}: missed {sure}"),
        }
        assert_eq!(
            bvh.occluded(ray, f32::INFINITY, any),
            hit.is_some(),
            "{ray:?}"
        );
        if let Some(hit) = hit {
            assert!(bvh.occluded(ray, hit.t * 1.001, any), "{ray:?}");
            assert!(
                !bvh.occluded(ray, (possible * 0.999) as f32, any),
                "{ray:?}"
            );
        }
    }
}

/// Rays from around a mesh within the unit cube to points in it.
fn rays_at_unit_cube(count: usize, seed: u64) -> Vec<Ray> {
    let mut random = Random(seed);
    (0..count)
        .map(|_| {
            let origin = random.direction() * 3.0;
            Ray {
                origin,
                direction: (random.point() - origin).normalize(),
            }
        })
        .collect()
}

#[test]
fn a_ray_from_the_front_sees_the_front_face_and_weights_of_vertices_1_and_2() {
    let bvh = Bvh::build(&quad());
    let ray = Ray {
        origin: Vec3::new(0.75, 0.25, 2.0),
        direction: Vec3::NEG_Z,
    };
    let hit = bvh.closest(&ray, f32::INFINITY, any).unwrap();
    assert_eq!((hit.triangle, hit.t, hit.back_face), (0, 2.0, false));
    // (0.75, 0.25) = 0.25 v0 + 0.5 v1 + 0.25 v2.
    assert_eq!((hit.u, hit.v), (0.5, 0.25));
    let behind = Ray {
        origin: Vec3::new(0.75, 0.25, -2.0),
        direction: Vec3::Z,
    };
    assert!(bvh.closest(&behind, 3.0, any).unwrap().back_face);
}

#[test]
fn t_max_is_included_and_what_lies_beyond_is_not() {
    let bvh = Bvh::build(&quad());
    let ray = Ray {
        origin: Vec3::new(0.75, 0.25, 2.0),
        direction: Vec3::NEG_Z,
    };
    for (t_max, expected) in [(2.0, true), (2.0f32.next_down(), false), (0.0, false)] {
        assert_eq!(bvh.occluded(&ray, t_max, any), expected, "{t_max}");
        assert_eq!(bvh.closest(&ray, t_max, any).is_some(), expected, "{t_max}");
    }
}

#[test]
fn a_rejected_triangle_lets_the_ray_through_to_the_next() {
    let mut m = quad();
    m.positions
        .extend(quad().positions.iter().map(|p| *p - Vec3::Z));
    m.indices.extend([[4, 5, 6], [4, 6, 7]]);
    let bvh = Bvh::build(&m);
    let ray = Ray {
        origin: Vec3::new(0.75, 0.25, 2.0),
        direction: Vec3::NEG_Z,
    };
    let hit = bvh
        .closest(&ray, f32::INFINITY, |t, u, _| t > 1 && u == 0.5)
        .unwrap();
    assert_eq!((hit.triangle, hit.t), (2, 3.0));
    assert!(bvh.occluded(&ray, 3.0, |t, _, _| t > 1));
    assert!(!bvh.occluded(&ray, 2.9, |t, _, _| t > 1));
    assert!(bvh.closest(&ray, f32::INFINITY, |_, _, _| false).is_none());
}

#[test]
fn random_rays_hit_what_brute_force_in_f64_hits() {
    let m = sphere(8, 0.3);
    // In f32, barycentric weights err by some 10 ulps (2^-24) of (distance / height of the
    // triangle)^2: 6e-7 * (4 / 0.1)^2 = 1e-3 at most, for the thin triangles at the poles.
    check_against_brute_force(&m, &rays_at_unit_cube(100_000, 1), 1e-3);
}

#[test]
fn random_triangle_soup_is_hit_as_brute_force_hits_it() {
    let mut random = Random(5);
    let mut m = mesh(Vec::new(), Vec::new());
    for t in 0..300 {
        let center = random.point();
        m.positions
            .extend((0..3).map(|_| center + 0.3 * random.direction()));
        m.indices.push([3 * t, 3 * t + 1, 3 * t + 2]);
    }
    check_against_brute_force(&m, &rays_at_unit_cube(30_000, 2), 2e-3);
}

#[test]
fn rays_along_the_axes_and_in_coordinate_planes_hit_axis_aligned_geometry() {
    let m = moved(quad(), 2.0, Vec3::new(-1.0, -1.0, 0.0));
    let bvh = Bvh::build(&m);
    for x in [-1.0f32, -0.5, 0.0, 0.25, 1.0] {
        for y in [-1.0f32, -0.25, 0.0, 0.5, 1.0] {
            for sign in [-1.0, 1.0] {
                // Vertices and edges, the diagonal among them, belong to a triangle.
                let origin = Vec3::new(x, y, -sign * 3.0);
                let ray = Ray {
                    origin,
                    direction: Vec3::Z * sign,
                };
                assert_eq!(
                    bvh.closest(&ray, 10.0, any).map(|h| h.t),
                    Some(3.0),
                    "{ray:?}"
                );
                let ray = Ray {
                    origin,
                    direction: Vec3::new(-0.0, 0.0, sign),
                };
                assert!(bvh.occluded(&ray, 10.0, any), "{ray:?}");
            }
        }
    }
    // Within the plane nothing has an area to hit.
    let ray = Ray {
        origin: Vec3::new(-3.0, 0.25, 0.0),
        direction: Vec3::X,
    };
    assert!(bvh.closest(&ray, 10.0, any).is_none());
    // One component is zero.
    let direction = Vec3::new(0.6, 0.0, -0.8);
    let ray = Ray {
        origin: Vec3::new(0.25, 0.5, 0.0) - direction * 5.0,
        direction,
    };
    let t = bvh.closest(&ray, 10.0, any).unwrap().t;
    assert!((t - 5.0).abs() < 4.0 * f32::EPSILON * 5.0, "{t}");
}

#[test]
fn an_empty_mesh_is_never_hit_and_has_no_bounds() {
    let bvh = Bvh::build(&TriangleMesh::default());
    let ray = Ray {
        origin: Vec3::ZERO,
        direction: Vec3::X,
    };
    assert!(bvh.closest(&ray, f32::INFINITY, any).is_none());
    assert!(!bvh.occluded(&ray, f32::INFINITY, any));
    assert_eq!((bvh.bounds(), bvh.bounding_sphere()), (None, None));
    assert!(bvh.clusters().is_empty());
}

#[test]
fn one_triangle_is_hit() {
    let m = mesh(vec![Vec3::ZERO, Vec3::X, Vec3::Y], vec![[0, 1, 2]]);
    check_against_brute_force(&m, &rays_at_unit_cube(1000, 3), 1e-5);
}

#[test]
fn triangles_without_area_are_not_hit_and_hide_nothing() {
    let mut m = quad();
    // A point, a segment with a repeated corner, three points on a line.
    m.indices.extend([[0, 0, 0], [0, 2, 2], [0, 2, 4]]);
    m.positions.push(Vec3::new(0.5, 0.5, 0.0));
    let bvh = Bvh::build(&m);
    let mut random = Random(4);
    for _ in 0..1000 {
        let target = Vec3::new(random.unit(), random.unit(), 0.0);
        let origin = target + random.direction() * 2.0;
        let ray = Ray {
            origin,
            direction: (target - origin).normalize(),
        };
        let hit = bvh
            .closest(&ray, f32::INFINITY, any)
            .expect("inside the quad");
        assert!(hit.triangle < 2, "{hit:?}");
    }
    let flat = mesh(vec![Vec3::ZERO, Vec3::X], vec![[0, 1, 1], [0, 0, 0]]);
    let ray = Ray {
        origin: Vec3::new(0.5, 0.0, 1.0),
        direction: Vec3::NEG_Z,
    };
    assert!(
        Bvh::build(&flat)
            .closest(&ray, f32::INFINITY, any)
            .is_none()
    );
}

#[test]
fn a_ray_is_asked_once_about_ten_thousand_copies_of_a_triangle() {
    let mut m = mesh(vec![Vec3::ZERO, Vec3::X, Vec3::Y], vec![[0, 1, 2]; 10_000]);
    // The same corners in another order, from a vertex of their own.
    m.positions.push(Vec3::new(-0.0, 0.0, 0.0));
    m.indices[9_000] = [2, 3, 1];
    let ray = Ray {
        origin: Vec3::new(0.25, 0.25, 1.0),
        direction: Vec3::NEG_Z,
    };
    let asked = |m: &TriangleMesh| {
        let count = std::cell::Cell::new(0);
        let hit = Bvh::build(m).closest(&ray, f32::INFINITY, |_, _, _| {
            count.set(count.get() + 1);
            true
        });
        assert_eq!(hit.unwrap().t, 1.0);
        count.get()
    };
    assert_eq!(asked(&m), 1);
    // What a ray can tell apart is kept: a back, another material.
    m.indices[5_000] = [0, 2, 1];
    m.materials = vec![0; 10_000];
    m.materials[7_777] = 1;
    assert_eq!(asked(&m), 3);
    let bvh = Bvh::build(&m);
    for kept in [5_000, 7_777] {
        assert!(bvh.occluded(&ray, 1.0, |t, _, _| t == kept));
    }
}

#[test]
fn triangles_that_share_a_centre_make_a_tree_of_bounded_depth_and_size() {
    // Nested and slightly turned, so that no two are equal.
    let mut m = mesh(Vec::new(), Vec::new());
    for i in 0..30_000u32 {
        let (s, c) = (i as f32 * 1e-4).sin_cos();
        let size = 1.0 + i as f32 * 1e-3;
        for corner in [
            Vec2::new(-1.0, -1.0),
            Vec2::new(1.0, 0.0),
            Vec2::new(0.0, 1.0),
        ] {
            let p = Vec2::new(c, s).rotate(corner) * size;
            m.positions.push(p.extend(0.0));
        }
        m.indices.push([3 * i, 3 * i + 1, 3 * i + 2]);
    }
    let tree = Bvh::build(&m).tree;
    let (mut deepest, mut held) = (0, 0);
    let mut stack = vec![(tree.root, 1)];
    while let Some((child, level)) = stack.pop() {
        deepest = deepest.max(level);
        if child.is_pack() {
            let ids = tree.triangles[child.index()];
            held += ids.iter().filter(|id| **id != u32::MAX).count();
        } else {
            let children = tree.nodes[child.index()].half_areas();
            stack.extend(children.map(|(_, c)| (c, level + 1)));
        }
    }
    assert_eq!(held, 30_000);
    assert!(deepest <= traverse::MAX_DEPTH, "{deepest}");
    // A node has two children or more, a pack a triangle or more.
    assert!(tree.packs.len() <= 30_000 && tree.nodes.len() < tree.packs.len());
}

#[test]
fn triangles_that_are_not_finite_or_out_of_range_are_left_out() {
    let mut m = quad();
    m.positions.extend([Vec3::NAN, Vec3::splat(f32::INFINITY)]);
    m.indices.extend([[0, 1, 4], [0, 1, 5], [0, 1, 99]]);
    let bvh = Bvh::build(&m);
    assert_eq!(bvh.bounds().unwrap().max, Vec3::new(1.0, 1.0, 0.0));
    let ray = Ray {
        origin: Vec3::new(0.75, 0.25, 2.0),
        direction: Vec3::NEG_Z,
    };
    assert_eq!(bvh.closest(&ray, f32::INFINITY, any).unwrap().triangle, 0);
}

#[test]
fn rays_that_are_not_finite_hit_nothing() {
    let bvh = Bvh::build(&quad());
    for (origin, direction) in [
        (Vec3::NAN, Vec3::X),
        (Vec3::ZERO, Vec3::NAN),
        (Vec3::ZERO, Vec3::ZERO),
        (Vec3::splat(f32::INFINITY), Vec3::X),
        (Vec3::Z, Vec3::new(0.0, f32::NAN, -1.0)),
    ] {
        let ray = Ray { origin, direction };
        assert!(bvh.closest(&ray, f32::INFINITY, any).is_none(), "{ray:?}");
        assert!(!bvh.occluded(&ray, f32::INFINITY, any), "{ray:?}");
    }
    let ray = Ray {
        origin: Vec3::new(0.5, 0.5, 1.0),
        direction: Vec3::NEG_Z,
    };
    assert!(!bvh.occluded(&ray, f32::NAN, any) && !bvh.occluded(&ray, -1.0, any));
}

#[test]
fn the_bounding_sphere_and_the_clusters_hold_every_vertex() {
    let mut m = sphere(16, 0.2);
    // A second ball far off, and a vertex that no triangle uses.
    let count = m.positions.len() as u32;
    m.positions.extend(
        sphere(16, 0.2)
            .positions
            .iter()
            .map(|p| *p + 20.0 * Vec3::X),
    );
    m.indices
        .extend(sphere(16, 0.2).indices.iter().map(|t| t.map(|i| i + count)));
    m.positions.push(Vec3::splat(1e3));
    let bvh = Bvh::build(&m);
    let whole = bvh.bounding_sphere().unwrap();
    // Centres 20 apart, radii at most 1.2.
    assert!(whole.radius <= 11.3 && whole.radius >= 10.7, "{whole:?}");
    let inside =
        |s: &Sphere, p: Vec3| s.center.as_dvec3().distance(p.as_dvec3()) <= s.radius as f64;
    for t in 0..m.indices.len() as u32 {
        let corners = corners(&m, t);
        assert!(corners.iter().all(|p| inside(&whole, *p)));
        assert!(
            bvh.clusters()
                .iter()
                .any(|s| corners.iter().all(|p| inside(s, *p)))
        );
    }
    assert!(bvh.clusters().len() <= 16);
    // No cluster spans the gap.
    assert!(
        bvh.clusters().iter().all(|s| s.radius < 1.3),
        "{:?}",
        bvh.clusters()
    );
}
