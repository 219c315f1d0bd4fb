//! Depths of the nearest surfaces at the middles of a camera's pixels.
use dipir_imaging::raster::Raster;
use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::camera::Camera;
use crate::mesh::TriangleMesh;

/// What is nearer to the camera is not drawn, metres.
const NEAREST_M: f64 = 1e-3;

/// Through the middle of a pixel, in the camera's axes, one metre ahead.
fn direction(x: usize, y: usize, camera: &Camera) -> DVec3 {
    let pixel = DVec2::new(x as f64, y as f64) + 0.5;
    let d = (pixel - camera.principal_px.as_dvec2()) / camera.focal_px.as_dvec2();
    DVec3::new(d.x, -d.y, -1.0)
}

/// Depths of the nearest surfaces along the optical axis, metres; infinite where there is none.
pub(crate) fn nearest(mesh: &TriangleMesh, camera: &Camera) -> Raster<f32> {
    let [width, height] = camera.resolution.map(|n| n as usize);
    let mut depths = Raster::filled(width, height, f32::INFINITY);
    let turn = camera.rotation.as_dmat3().transpose();
    let eye = camera.position.as_dvec3();
    let seen: Vec<DVec3> = (mesh.positions.par_iter())
        .map(|p| turn * (p.as_dvec3() - eye))
        .collect();
    for corners in &mesh.indices {
        let corners = corners.map(|i| seen[i as usize]);
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
        let away = normal.dot(corners[0]);
        let (ahead, count) = clipped(&corners);
        let ahead = &ahead[..count];
        let on_picture = |p: &DVec3| {
            let d = DVec2::new(p.x, -p.y) / -p.z;
            camera.principal_px.as_dvec2() + d * camera.focal_px.as_dvec2()
        };
        let mut outline = [DVec2::ZERO; 4];
        for (place, p) in outline.iter_mut().zip(ahead) {
            *place = on_picture(p);
        }
        let (mut near, mut far) = (f64::INFINITY, 0.0f64);
        for p in ahead {
            (near, far) = (near.min(-p.z), far.max(-p.z));
        }
        spans(&outline[..count], [width, height], |x, y| {
            let depth = away / -normal.dot(direction(x, y, camera));
            // A triangle that is seen from its edge has no depth of its own.
            let depth = if depth.is_nan() { near } else { depth.abs() };
            let depth = depth.clamp(near, far) as f32;
            let kept = depths.get_mut(x, y);
            *kept = kept.min(depth);
        });
    }
    depths
}

/// The corners of the part of a triangle in the camera's axes that lies before it, and how many they are.
fn clipped(corners: &[DVec3; 3]) -> ([DVec3; 4], usize) {
    let (mut ahead, mut count) = ([DVec3::ZERO; 4], 0);
    let mut add = |p| {
        ahead[count] = p;
        count += 1;
    };
    for k in 0..3 {
        let (a, b) = (corners[k], corners[(k + 1) % 3]);
        let (of_a, of_b) = (-a.z - NEAREST_M, -b.z - NEAREST_M);
        if of_a >= 0.0 {
            add(a);
        }
        if (of_a >= 0.0) != (of_b >= 0.0) {
            add(a + (b - a) * (of_a / (of_a - of_b)));
        }
    }
    (ahead, count)
}

/// Calls `each` for the pixels of a picture whose middles lie in a convex outline.
fn spans(outline: &[DVec2], [width, height]: [usize; 2], mut each: impl FnMut(usize, usize)) {
    let (mut top, mut bottom) = (f64::INFINITY, f64::NEG_INFINITY);
    for p in outline {
        (top, bottom) = (top.min(p.y), bottom.max(p.y));
    }
    // Conversions of floats saturate, and the first pixel whose middle is at a place or beyond is this one.
    let first = |at: f64| (at - 0.5).ceil().max(0.0) as usize;
    for y in first(top)..first(bottom).min(height) {
        let at = y as f64 + 0.5;
        let (mut left, mut right) = (f64::INFINITY, f64::NEG_INFINITY);
        for k in 0..outline.len() {
            let (a, b) = (outline[k], outline[(k + 1) % outline.len()]);
            if (a.y <= at) != (b.y <= at) {
                let x = a.x + (b.x - a.x) * ((at - a.y) / (b.y - a.y));
                (left, right) = (left.min(x), right.max(x));
            }
        }
        for x in first(left)..first(right).min(width) {
            each(x, y);
        }
    }
}

/// The least value within `radius` pixels of each along either side.
pub(crate) fn least(values: &Raster<f32>, radius: usize) -> Raster<f32> {
    let (width, height) = (values.width(), values.height());
    let mut across = values.clone();
    let rows = across.pixels_mut().par_chunks_mut(width.max(1));
    rows.for_each(|row| {
        // What is finite reaches over few places: the rest is passed over.
        let from = row.to_vec();
        for (x, v) in from.iter().enumerate().filter(|(_, v)| v.is_finite()) {
            for near in &mut row[x.saturating_sub(radius)..(x + radius + 1).min(width)] {
                *near = near.min(*v);
            }
        }
    });
    let has_some: Vec<bool> = (0..height)
        .map(|y| across.row(y).iter().any(|v| v.is_finite()))
        .collect();
    let mut both = across.clone();
    let rows = both.pixels_mut().par_chunks_mut(width.max(1));
    rows.enumerate().for_each(|(y, row)| {
        let near = y.saturating_sub(radius)..(y + radius + 1).min(height);
        for v in near.filter(|v| has_some[*v]) {
            for (least, v) in row.iter_mut().zip(across.row(v)) {
                *least = least.min(*v);
            }
        }
    });
    both
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use proptest::prelude::*;

    use super::*;
    use crate::bvh::Bvh;
    use crate::camera::FieldOfView;

    fn camera() -> Camera {
        let (eye, to) = (Vec3::new(0.3, 1.2, 3.0), Vec3::new(0.0, 0.4, -1.0));
        let field_of_view = FieldOfView::Vertical(0.9);
        Camera::look_at(eye, to, Vec3::Y, field_of_view, [37, 23])
    }

    fn triangles(corners: &[[[f32; 3]; 3]]) -> TriangleMesh {
        let positions: Vec<Vec3> = corners.iter().flatten().map(|p| Vec3::from(*p)).collect();
        let indices = (0..corners.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]);
        TriangleMesh {
            positions,
            indices: indices.collect(),
            materials: vec![0; corners.len()],
            ..TriangleMesh::default()
        }
    }

    proptest! {
        /// Triangles reach behind the camera, too. Rays find the same depths; an edge may go to either side.
        #[test]
        fn depths_are_those_of_rays(
            corners in prop::collection::vec(prop::array::uniform3(prop::array::uniform3(-4.0..4.0f32)), 1..12)
        ) {
            let mesh = triangles(&corners);
            let (camera, bvh) = (camera(), Bvh::build(&mesh));
            let depths = nearest(&mesh, &camera);
            let mut differ = 0;
            for y in 0..23 {
                for x in 0..37 {
                    let ray = camera.ray(glam::Vec2::new(x as f32, y as f32) + 0.5);
                    let ahead = -ray.direction.dot(camera.rotation.z_axis);
                    let hit = bvh.closest(&ray, f32::INFINITY, |_, _, _| true);
                    let wanted = hit.map_or(f32::INFINITY, |h| h.t * ahead);
                    let found = *depths.get(x, y);
                    // What is hardly before the camera is seen by rays alone.
                    if found.min(wanted) < 0.02 {
                        continue;
                    }
                    let same = found == wanted || (found / wanted - 1.0).abs() < 1e-3;
                    differ += usize::from(!same);
                }
            }
            // Of 12 triangles' outlines, each some 100 pixels long, a few pass through the middle of a pixel.
            prop_assert!(differ <= 3, "{}", differ);
        }
    }

    #[test]
    fn nothing_is_seen_of_what_has_no_extent_or_lies_behind() {
        let behind = [[-1.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0.0, 1.0, 5.0]];
        let point = [[0.0, 0.4, 0.0]; 3];
        let depths = nearest(&triangles(&[behind, point]), &camera());
        assert!(depths.pixels().iter().all(|d| d.is_infinite()));
    }

    #[test]
    fn the_least_value_reaches_as_far_as_the_radius_in_all_directions() {
        let mut values = Raster::filled(9, 7, f32::INFINITY);
        *values.get_mut(4, 3) = 2.0;
        let found = least(&values, 2);
        for y in 0..7usize {
            for x in 0..9usize {
                let near = x.abs_diff(4) <= 2 && y.abs_diff(3) <= 2;
                assert_eq!(found.get(x, y).is_finite(), near, "{x} {y}");
            }
        }
    }
}
