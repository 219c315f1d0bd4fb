//! Where the picture shows the objects: nowhere, all over, or behind a mask.
use dipir_imaging::raster::Raster;
use glam::{Vec2, Vec3};

use super::{Part, SMALLEST_PX};
use crate::camera::Camera;
use crate::mesh::TriangleMesh;
use crate::visibility::short;

/// An object that covers more than this share of the picture's width and of its height is unusual.
const MOST_COVERED: f32 = 0.8;
/// An object that is this many times as wide as the picture is unusual.
const WIDEST: f32 = 3.0;
/// What covers less than this share of the picture's height is hardly seen.
const LEAST_SEEN: f32 = 0.05;
/// What is thinner than this share of its length is a floor, a wall or a sheet, which may well go beyond the picture.
const SHEET: f32 = 0.02;
/// From this value on a mask hides all that the picture could show.
const HIDDEN: f32 = 0.99;

/// Why the picture does not show the objects, or hardly.
pub(super) fn visibility(
    mesh: &TriangleMesh,
    camera: &Camera,
    size_is_told: bool,
) -> Option<String> {
    let (mut low, mut high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
    let mut behind = 0;
    for &point in &mesh.positions {
        match camera.project(point) {
            Some(pixel) => (low, high) = (low.min(pixel), high.max(pixel)),
            None => behind += 1,
        }
    }
    if behind == mesh.positions.len() {
        return Some(
            "the objects are behind the camera, so the picture does not show them; see \
             [scene.camera] look_at and [[scene.objects]] position"
                .into(),
        );
    }
    // What reaches behind the camera can cover any pixel.
    if behind > 0 {
        return None;
    }
    let [width, height] = camera.resolution.map(|n| n as f32);
    let sides = [
        (high.x <= 0.0, "left of"),
        (low.x >= width, "right of"),
        (high.y <= 0.0, "above"),
        (low.y >= height, "below"),
    ];
    if let Some((_, side)) = sides.iter().find(|(out, _)| *out) {
        return Some(format!(
            "the objects are {side} the picture (pixels {:.0} to {:.0} across and {:.0} to {:.0} down, of \
             {width} x {height}), so it does not show them; move [[scene.objects]] position or turn \
             [scene.camera] look_at",
            low.x, high.x, low.y, high.y
        ));
    }
    let size = high - low;
    (size.max_element() < SMALLEST_PX && !size_is_told).then(|| {
        format!(
            "the objects take {:.1} x {:.1} pixels of the picture; see [[scene.objects]] scale and \
             position, in metres",
            size.x, size.y
        )
    })
}

/// A sentence about an object around the camera, one that leaves little of the photograph to be seen, or one that goes far
/// beyond both sides of it, unless it is a ground under others of `parts`.
pub(super) fn too_near(
    mesh: &TriangleMesh,
    part: &Part,
    parts: &[Part],
    camera: &Camera,
) -> Option<String> {
    let [low, high] = part.bounds;
    let extent = short(f64::from((high - low).max_element()));
    let object = format!("scene.objects[{}] ({extent} m large)", part.number);
    let size = "is its size right? height_m is its height in metres; or change its position";
    let eye = camera.position;
    if eye.cmpgt(low).all() && eye.cmplt(high).all() {
        return Some(format!(
            "the camera stands inside {object}, within its bounds: {size}"
        ));
    }
    let [low, high] = seen(mesh, part.triangles, camera)?;
    let picture = Vec2::from_array(camera.resolution.map(|n| n as f32));
    let covered = (high.min(picture) - low.max(Vec2::ZERO)) / picture;
    let [across, down] = (100.0 * covered).to_array();
    if covered.min_element() > MOST_COVERED {
        return Some(format!(
            "{object} covers {across:.0}% of the picture's width and {down:.0}% of its height: {size}"
        ));
    }
    let too_wide = high.x - low.x > WIDEST * picture.x
        && covered.x > MOST_COVERED
        && covered.y > LEAST_SEEN
        && !is_sheet(part)
        && !carries_another(part, parts);
    too_wide.then(|| {
        format!(
            "{object} goes far beyond both sides of the picture, and covers {down:.0}% of its height: {size}"
        )
    })
}

fn is_sheet(part: &Part) -> bool {
    let [low, high] = part.bounds;
    let extent = high - low;
    extent.min_element() <= SHEET * extent.max_element()
}

/// Whether the middle of another object is above this one, or in it.
fn carries_another(part: &Part, parts: &[Part]) -> bool {
    let [low, high] = part.bounds;
    parts.iter().any(|other| {
        let middle = 0.5 * (other.bounds[0] + other.bounds[1]);
        let inside = middle.cmpgt(low) & middle.cmplt(high);
        other.number != part.number && inside.test(0) && inside.test(2) && middle.y > low.y
    })
}

/// A sentence about a mask that is white wherever the objects would be seen.
pub(super) fn hides_all(
    mask: &Raster<f32>,
    mesh: &TriangleMesh,
    camera: &Camera,
) -> Option<String> {
    let [low, high] = seen(mesh, &mesh.indices, camera)?;
    let columns = pixels(low.x, high.x, mask.width());
    let mut rows = pixels(low.y, high.y, mask.height());
    let shows_nothing = !columns.is_empty()
        && !rows.is_empty()
        && rows.all(|y| mask.row(y)[columns.clone()].iter().all(|v| *v >= HIDDEN));
    shows_nothing.then(|| {
        "the mask of scene.occluders is white wherever the objects would be seen, so it hides them: white hides the object, \
         black shows it; is the mask inverted?"
            .into()
    })
}

/// The pixels of a row or column of `size` that lie between two places in it.
fn pixels(low: f32, high: f32, size: usize) -> std::ops::Range<usize> {
    // Conversions of floats saturate.
    low.floor() as usize..(high.ceil() as usize).min(size)
}

/// The box of the part of `triangles` that lies in front of the camera, pixels; it may reach far out of the picture.
fn seen(mesh: &TriangleMesh, triangles: &[[u32; 3]], camera: &Camera) -> Option<[Vec2; 2]> {
    /// Where edges that go on behind the camera are cut: this share of the depth of their front end.
    const CUT: f32 = 1e-3;
    let depth = |p: Vec3| camera.depth(p);
    let mut found: Option<[Vec2; 2]> = None;
    let mut add = |p: Vec3| {
        if let Some(pixel) = camera.project(p) {
            let [low, high] = found.unwrap_or([pixel; 2]);
            found = Some([low.min(pixel), high.max(pixel)]);
        }
    };
    for corners in triangles {
        let corners = corners.map(|i| mesh.positions[i as usize]);
        for k in 0..3 {
            let (a, b) = (corners[k], corners[(k + 1) % 3]);
            add(a);
            let (of_a, of_b) = (depth(a), depth(b));
            if (of_a > 0.0) != (of_b > 0.0) {
                let (front, back, near, far) = match of_a > 0.0 {
                    true => (a, b, of_a, of_b),
                    false => (b, a, of_b, of_a),
                };
                add(front + (back - front) * ((1.0 - CUT) * near / (near - far)));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::super::tests::{record, scene};
    use super::super::{implausible_scene, parts};
    use super::*;
    use crate::scene::Scene;

    fn scaled(by: f32, offset: Vec3) -> Scene {
        let mut scene = scene();
        for p in &mut scene.mesh.positions {
            *p = *p * by + offset;
        }
        scene
    }

    fn near(scene: &Scene) -> Option<String> {
        let objects = [record(1.0)];
        let parts = parts(scene, &objects);
        too_near(&scene.mesh, &parts[0], &parts, &scene.camera)
    }

    #[test]
    fn a_camera_inside_an_object_is_told() {
        // The camera stands at (0.3, 1.6, 5).
        let around = scaled(40.0, Vec3::new(-4.0, -4.0, -4.0));
        let found = near(&around).unwrap();
        let said = "the camera stands inside scene.objects[0] (40 m large), within its bounds: is its size right?";
        assert!(found.starts_with(said), "{found}");
        let all = implausible_scene(&around, &[record(1.0)], None, None);
        assert!(all.contains(&found), "{all:?}");
        assert_eq!(near(&scene()), None);
        // Above a floor that reaches behind it.
        let mut floor = scaled(40.0, Vec3::new(-20.0, 0.0, -20.0));
        for p in &mut floor.mesh.positions {
            p.y = 0.0;
        }
        assert_eq!(near(&floor), None);
    }

    #[test]
    fn an_object_all_over_the_picture_is_told() {
        // At the origin the picture shows 5.5 x 3.7 m.
        for (by, told) in [(1.0, false), (2.5, false), (8.0, true)] {
            let offset = Vec3::new(0.3 - 0.5 * by, 0.5 - 0.5 * by, 0.0);
            let mut sheet = scaled(by, offset);
            for p in &mut sheet.mesh.positions {
                p.z = 0.0;
            }
            let found = near(&sheet);
            assert_eq!(found.is_some(), told, "{by}: {found:?}");
            let part =
                "covers 100% of the picture's width and 100% of its height: is its size right?";
            assert!(found.is_none_or(|f| f.contains(part)));
        }
        // A wall from before the camera to behind it, that fills the left half.
        let mut wall = scaled(30.0, Vec3::new(-0.4, -15.0, -15.0));
        for p in &mut wall.mesh.positions {
            p.x = -0.4;
        }
        assert_eq!(near(&wall), None);
    }

    /// A thing of these extents, metres, its middle at the origin of the ground.
    fn lying(extent: Vec3) -> Scene {
        let mut scene = scene();
        for p in &mut scene.mesh.positions {
            *p = *p * extent - Vec3::new(0.5, 0.0, 0.5) * extent;
        }
        scene
    }

    #[test]
    fn a_low_object_far_beyond_both_sides_of_the_picture_is_told() {
        // A plate of 25 cm whose file is read as metres: the camera is above it, 1.6 m high.
        let plate = lying(Vec3::new(25.0, 1.4, 25.0));
        let found = near(&plate).unwrap();
        let said =
            "scene.objects[0] (25 m large) goes far beyond both sides of the picture, and covers ";
        assert!(
            found.starts_with(said) && found.contains("is its size right?"),
            "{found}"
        );
        // A bus of 12 m before the camera, a floor, and a plate far away.
        assert_eq!(near(&lying(Vec3::new(12.0, 2.0, 2.5))), None);
        assert_eq!(near(&lying(Vec3::new(25.0, 0.3, 25.0))), None);
        let mut away = plate.clone();
        for p in &mut away.mesh.positions {
            p.z -= 45.0;
        }
        assert_eq!(near(&away), None);
        // What another object stands on is a ground.
        let mut ground = plate;
        let mut thing = scene().mesh;
        for p in &mut thing.positions {
            p.y += 1.4;
        }
        ground.mesh.append(thing, 0);
        let objects = [record(1.0), record(1.0)];
        let parts = parts(&ground, &objects);
        for part in &parts {
            assert_eq!(too_near(&ground.mesh, part, &parts, &ground.camera), None);
        }
    }

    #[test]
    fn a_mask_that_leaves_nothing_of_the_objects_is_told() {
        let scene = scene();
        let hidden = |mask: &Raster<f32>| hides_all(mask, &scene.mesh, &scene.camera);
        let mut mask = Raster::filled(96, 64, 1.0);
        let found = hidden(&mask).unwrap();
        assert!(found.contains("white hides the object"), "{found}");
        // One corner of the picture is free: not where the object is.
        *mask.get_mut(0, 0) = 0.0;
        assert!(hidden(&mask).is_some());
        let pixel = scene.camera.project(Vec3::new(0.2, 0.2, 0.0)).unwrap();
        *mask.get_mut(pixel.x as usize, pixel.y as usize) = 0.5;
        assert_eq!(hidden(&mask), None);
        assert_eq!(hidden(&Raster::filled(96, 64, 0.0)), None);
        // What the picture does not show anyway, no mask hides.
        let away = scaled(1.0, Vec3::new(-40.0, 0.0, 0.0));
        let mask = Raster::filled(96, 64, 1.0);
        assert_eq!(hides_all(&mask, &away.mesh, &away.camera), None);
    }
}
