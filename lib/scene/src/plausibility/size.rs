//! Objects of a size that people do not insert, and files without a unit.
use glam::Vec3;

use crate::camera::Camera;
use crate::description::ObjectRecord;
use crate::mesh::bounds;
use crate::proxy::Proxy;
use crate::scene::Scene;
use crate::visibility::{below_a_pixel, short};

/// Largest extents of objects that people insert, metres.
const EXTENT_M: [f64; 2] = [0.005, 50.0];
/// Up to this extent the numbers of a file without a unit are believed to be metres; from there on they look like centimetres.
const METRES_UP_TO: f64 = 5.0;
/// From this extent on, the units of a file are taken for millimetres (.5 m and more), below it for centimetres (5 m and less).
const MILLIMETRES_FROM: f64 = 500.0;
/// Rays are exact to some millionths of the extent of all objects: beyond this one, metres, details of a hand's breadth are
/// not told apart, and every ray is tested against many triangles.
const WIDEST_M: f32 = 1e5;

/// The unit that a model with this largest extent in its file is likely in, and its metres; `None` for metres.
pub fn likely_unit(extent: f64) -> Option<(&'static str, f64)> {
    let [least, most] = EXTENT_M;
    match extent {
        e if e >= MILLIMETRES_FROM => Some(("millimetres", 0.001)),
        e if e > most => Some(("centimetres", 0.01)),
        e if e > 0.0 && e < least => Some(("kilometres", 1000.0)),
        _ => None,
    }
}

/// An object as it is placed.
pub(super) struct Part<'a> {
    /// Its number in the configuration.
    pub number: usize,
    record: &'a ObjectRecord,
    pub triangles: &'a [[u32; 3]],
    /// Lowest and highest coordinates.
    pub bounds: [Vec3; 2],
}

/// The objects that have triangles.
pub(super) fn parts<'a>(scene: &'a Scene, objects: &'a [ObjectRecord]) -> Vec<Part<'a>> {
    let mut rest = &scene.mesh.indices[..];
    let mut found = Vec::new();
    for (number, record) in objects.iter().enumerate() {
        let (triangles, after) = rest.split_at(rest.len().min(record.triangles as usize));
        rest = after;
        let corners = triangles.iter().flatten();
        let corners = corners.map(|&i| scene.mesh.positions[i as usize]);
        if let Some((low, high)) = bounds(corners) {
            found.push(Part {
                number,
                record,
                triangles,
                bounds: [low, high],
            });
        }
    }
    found
}

impl Part<'_> {
    fn extent(&self) -> f64 {
        let [low, high] = self.bounds;
        f64::from((high - low).max_element())
    }

    /// The factor on the lengths of its file.
    fn scale(&self) -> f64 {
        self.record.transform().determinant().abs().cbrt()
    }

    /// A sentence about a size that is none that people insert.
    pub fn unusual_size(&self, camera: &Camera) -> Option<String> {
        let [low, high] = self.bounds;
        // What is smaller than a pixel was warned of when it was loaded.
        match below_a_pixel((low, high), camera) {
            Some(_) => None,
            None => unusual_size(self.number, self.extent(), self.scale()),
        }
    }

    /// A sentence about numbers of a file without a unit that are taken as they are and make a large thing: with `scale`
    /// or `height_m` they are multiplied by another factor than 1.
    pub fn without_unit(&self) -> Option<String> {
        let (number, extent) = (self.number, self.extent());
        let as_they_are = (self.scale() - 1.0).abs() < 1e-6;
        (as_they_are && is_stl(self.record) && extent > METRES_UP_TO).then(|| {
            format!(
                "scene.objects[{number}] is {} m large, for STL has no unit and its numbers are read as metres: for \
                 centimetres write scale = 0.01, which makes it {} m, or write height_m",
                short(extent),
                short(0.01 * extent)
            )
        })
    }
}

fn is_stl(record: &ObjectRecord) -> bool {
    let extension = record.file.path.extension();
    extension.is_some_and(|e| e.eq_ignore_ascii_case("stl"))
}

pub(super) fn proxy_without_unit(record: &ObjectRecord, proxy: &Proxy) -> Option<String> {
    let Proxy::Mesh(mesh) = proxy else {
        return None;
    };
    let (low, high) = mesh.bounds().filter(|_| is_stl(record))?;
    Some(format!(
        "scene.proxy.mesh is {} m large, for STL has no unit and its numbers are read as metres: if they are others, export \
         it in metres",
        short(f64::from((high - low).max_element()))
    ))
}

pub(super) fn too_wide((low, high): (Vec3, Vec3)) -> Option<String> {
    let extent = (high - low).max_element();
    (extent > WIDEST_M).then(|| {
        format!(
            "the objects reach over {} m, so rays are slow and details of less than {} m are lost: see the objects' \
             position, scale and height_m",
            short(extent.into()),
            short(f64::from(extent) * 1e-6)
        )
    })
}

/// `extent` is that of the placed object, `scale` the factor on the lengths of its file.
fn unusual_size(object: usize, extent: f64, scale: f64) -> Option<String> {
    let [least, most] = EXTENT_M;
    let usual = extent == 0.0 || (least..=most).contains(&extent);
    if usual || !(extent.is_finite() && scale > 0.0) {
        return None;
    }
    let key = format!("scene.objects[{object}]");
    let in_file = extent / scale;
    Some(match likely_unit(in_file) {
        Some((unit, metres)) => format!(
            "{key} is {} m large, and its file looks like {unit}: write scale = {metres} for {} m, or height_m",
            short(extent),
            short(in_file * metres)
        ),
        None => format!(
            "{key} is {} m large, and in its file {} m: check its scale, a factor, or its height_m, metres",
            short(extent),
            short(in_file)
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::super::implausible_scene;
    use super::super::tests::{record, scene};
    use super::*;

    #[test]
    fn a_model_in_another_unit_is_told_with_its_scale() {
        for (extent, scale, said) in [
            (50.0, 1.0, None),
            (
                90.0,
                1.0,
                Some(
                    "is 90 m large, and its file looks like centimetres: write scale = 0.01 for 0.90 m",
                ),
            ),
            (
                1800.0,
                1.0,
                Some(
                    "is 1800 m large, and its file looks like millimetres: write scale = 0.001 for 1.80 m",
                ),
            ),
            (
                90.0,
                0.05,
                Some(
                    "is 90 m large, and its file looks like millimetres: write scale = 0.001 for 1.80 m",
                ),
            ),
            (
                0.0009,
                1.0,
                Some(
                    "is 9.0e-4 m large, and its file looks like kilometres: write scale = 1000 for 0.90 m",
                ),
            ),
            (0.005, 1.0, None),
            (
                180.0,
                100.0,
                Some(
                    "is 180 m large, and in its file 1.80 m: check its scale, a factor, or its height_m",
                ),
            ),
        ] {
            let found = unusual_size(2, extent, scale);
            let said = said.map(|s| format!("scene.objects[2] {s}"));
            match (&found, &said) {
                (Some(found), Some(said)) => assert!(found.starts_with(said), "{found}"),
                _ => assert_eq!(found, said, "{extent}"),
            }
        }
    }

    #[test]
    fn each_object_is_measured_for_itself() {
        // Two objects of a metre, a hundred metres apart; then the second is stretched.
        let mut scene = scene();
        let other = scene.mesh.clone();
        scene.mesh.append(other, 0);
        let objects = [record(1.0), record(1.0)];
        for p in &mut scene.mesh.positions[4..] {
            p.x += 100.0;
        }
        let unusual_sizes = |scene: &Scene| -> Vec<String> {
            let parts = parts(scene, &objects);
            let told = parts.iter().filter_map(|p| p.unusual_size(&scene.camera));
            told.collect()
        };
        assert_eq!(unusual_sizes(&scene), Vec::<String>::new());
        scene.mesh.positions[5].x += 200.0;
        let found = unusual_sizes(&scene);
        assert!(
            found.len() == 1 && found[0].starts_with("scene.objects[1] is 201 m large"),
            "{found:?}"
        );
    }

    #[test]
    fn the_missing_unit_of_an_stl_is_told_where_nothing_is_set() {
        let told = |path: &str, scale: f64, metres: f32| {
            let mut record = record(scale);
            record.file.path = path.into();
            let mut scene = scene();
            scene.mesh.positions.iter_mut().for_each(|p| *p *= metres);
            let found = implausible_scene(&scene, &[record], None, None);
            found.into_iter().find(|w| w.contains("STL"))
        };
        let found = told("part.STL", 1.0, 8.0).unwrap();
        let said = "scene.objects[0] is 8.00 m large, for STL has no unit";
        assert!(found.starts_with(said), "{found}");
        assert!(
            found.contains("scale = 0.01, which makes it 0.080 m"),
            "{found}"
        );
        for (path, scale, metres) in [
            ("a.stl", 0.7, 8.0),
            ("a.glb", 1.0, 8.0),
            ("a.stl", 1.0, 1.0),
        ] {
            assert_eq!(told(path, scale, metres), None, "{path} {scale} {metres}");
        }
        let proxy = Proxy::Mesh(scene().mesh);
        let mut room = record(1.0);
        assert_eq!(proxy_without_unit(&room, &proxy), None);
        room.file.path = "room.stl".into();
        let found = proxy_without_unit(&room, &proxy).unwrap();
        assert!(
            found.starts_with("scene.proxy.mesh is 1.00 m large"),
            "{found}"
        );
    }

    #[test]
    fn objects_at_both_ends_of_a_country_are_told() {
        let mut scene = scene();
        scene.mesh.positions[3] = Vec3::new(0.0, 0.0, -9e4);
        assert_eq!(too_wide(scene.mesh.bounds().unwrap()), None);
        scene.mesh.positions[3].z = -3e6;
        let found = implausible_scene(&scene, &[], None, None);
        let said = "the objects reach over 3.0e6 m, so rays are slow and details of less than 3.00 m are lost";
        assert!(found.iter().any(|f| f.starts_with(said)), "{found:?}");
    }
}
