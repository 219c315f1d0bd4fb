//! Set-ups that can be meant but seldom are: a field of view in radians, a camera under the ground,
//! an object that no pixel shows, a mask that hides nothing. Each is one sentence with the value that was found and the key
//! to look at.
mod grey;
mod in_picture;
mod size;

use std::path::Path;

use dipir_cameras::Lens;
use dipir_imaging::raster::Raster;
use glam::{DVec2, DVec3, Vec3};

use crate::camera::Camera;
use crate::description::{ObjectRecord, ProxyRecord};
use crate::mesh::TriangleMesh;
use crate::proxy::{Plane, Proxy};
use crate::scene::{LoadedScene, Scene};
use crate::visibility::{below_a_pixel, short};
use size::{Part, parts, proxy_without_unit, too_wide};

pub use size::likely_unit;

/// Vertical fields of view of lenses that people have: an 800 mm lens has 1.7 degrees.
const FIELD_OF_VIEW_DEG: [f64; 2] = [1.5, 140.0];
/// An object smaller than this in the picture cannot be judged, pixels.
const SMALLEST_PX: f32 = 3.0;

/// A fisheye whose picture ends before this angle from the axis is none, degrees.
const LEAST_FISHEYE_DEG: f64 = 80.0;
/// Steps from the optical axis to a corner in which the end of a lens's picture is looked for.
const STEPS: usize = 256;
/// Rounding of positions in the scene that matters, metres.
const MOST_ROUNDED_M: f64 = 1e-3;

/// What is unlikely about a scene, one sentence each.
pub fn implausible(loaded: &LoadedScene) -> Vec<String> {
    let lens = loaded.original.as_ref().map(|o| o.undistortion.lens());
    let Scene {
        mesh,
        materials,
        camera,
        ..
    } = &loaded.scene;
    let camera_file = loaded.inputs.iter().find(|i| i.role == "camera");
    let camera_file = camera_file.map(|i| i.path.as_path());
    let objects = &loaded.description.objects;
    let mut found = implausible_scene(&loaded.scene, objects, lens, camera_file);
    if let ProxyRecord::Mesh(record) = &loaded.description.proxy {
        found.extend(proxy_without_unit(record, &loaded.scene.proxy));
    }
    if let Some(mask) = loaded.mask() {
        found.extend(hides_nothing(mask));
        found.extend(in_picture::hides_all(mask, mesh, camera));
    }
    if loaded.depth_fit.is_some_and(|fit| fit.hides_objects) {
        found.push(
            "by scene.depth the objects are behind what the photograph shows: bring them nearer, or see whether camera and \
             ground are right"
                .into(),
        );
    }
    found.extend(grey::coloured_in_grey(
        &loaded.taken().image,
        mesh,
        materials,
    ));
    found
}

/// `lens` is the photograph's, if it bends lines; `camera_file` is the file that its camera is from.
fn implausible_scene(
    scene: &Scene,
    objects: &[ObjectRecord],
    lens: Option<&Lens>,
    camera_file: Option<&Path>,
) -> Vec<String> {
    let mut found = Vec::new();
    found.extend(rounded(scene.camera.position.as_dvec3()));
    found.extend(lens.and_then(turns_back));
    // A fisheye's is not that of the picture without distortion, which shows the inner part of it.
    if !lens.is_some_and(|l| l.distortion.is_fisheye()) {
        let half = 0.5 * scene.camera.resolution[1] as f32 / scene.camera.focal_px.y;
        let degrees = f64::from((2.0 * half.atan()).to_degrees());
        found.extend(field_of_view(degrees, camera_file));
    }
    let ground = match &scene.proxy {
        Proxy::Plane(plane) => Some(plane),
        Proxy::None | Proxy::Mesh(_) => None,
    };
    found.extend(ground.and_then(|plane| camera_below(&scene.camera, plane)));
    let Some(whole) = scene.mesh.bounds() else {
        return found;
    };
    let parts = parts(scene, objects);
    let sizes: Vec<Option<String>> = parts
        .iter()
        .map(|p| p.unusual_size(&scene.camera))
        .collect();
    let size_is_told =
        below_a_pixel(whole, &scene.camera).is_some() || sizes.iter().any(Option::is_some);
    for (part, size) in parts.iter().zip(sizes) {
        if size.is_none() {
            found.extend(part.without_unit());
            found.extend(in_picture::too_near(
                &scene.mesh,
                part,
                &parts,
                &scene.camera,
            ));
        }
        found.extend(size);
    }
    found.extend(too_wide(whole));
    found.extend(ground.and_then(|plane| object_below(&scene.mesh, plane)));
    found.extend(in_picture::visibility(
        &scene.mesh,
        &scene.camera,
        size_is_told,
    ));
    found
}

/// What is wrong with a camera at `position`, metres, so far from the origin that the scene's single precision moves it.
pub fn rounded(position: DVec3) -> Option<String> {
    let farthest = position.abs().max_element();
    let step = f64::from((farthest as f32).next_up()) - f64::from(farthest as f32);
    (step > MOST_ROUNDED_M).then(|| {
        format!(
            "the camera stands {:.0} km from the origin of its world, where lengths are rounded to {:.0} mm: subtract the \
             same point from the cameras and points of the scene",
            farthest / 1000.0,
            step * 1000.0
        )
    })
}

/// What is wrong with a vertical field of view that no lens has, degrees, of the camera in `file` or, without one, in the
/// configuration.
pub fn field_of_view(degrees: f64, file: Option<&Path>) -> Option<String> {
    let [least, most] = FIELD_OF_VIEW_DEG;
    if (least..=most).contains(&degrees) {
        return None;
    }
    let (at, may_be_radians) = match file {
        None => ("[scene.camera] fov_deg, in degrees".to_string(), true),
        Some(file)
            if file
                .extension()
                .is_some_and(|e| e.eq_ignore_ascii_case("chan")) =>
        {
            (
                format!(
                    "the last number of its line in {file:?} or, where there is none, [scene.camera] fov_deg, in degrees"
                ),
                true,
            )
        }
        Some(file) => (
            format!("its field of view or focal length in {file:?}"),
            false,
        ),
    };
    // 0.2 to 2.5 radians are fields of view that lenses have.
    let as_radians = degrees.to_degrees();
    let meant = match may_be_radians && (10.0..=150.0).contains(&as_radians) {
        true => format!("; if {degrees:.3} was meant in radians, write {as_radians:.1}"),
        false => String::new(),
    };
    Some(format!(
        "the camera's vertical field of view is {} degrees; lenses have {least} to {most}: see {at}{meant}",
        short(degrees)
    ))
}

/// A lens whose picture would fold over itself before a corner of the photograph: no light falls there.
fn turns_back(lens: &Lens) -> Option<String> {
    let size = DVec2::from_array(lens.size);
    let end = |corner: DVec2| {
        let way = corner * size - lens.principal_px;
        let seen = |share: f64| lens.distortion.direction(share * way / lens.focal_px);
        let shares = (1..=STEPS).map(|i| i as f64 / STEPS as f64);
        let share = shares.clone().find(|s| seen(*s).is_none())?;
        let last = seen(share - 1.0 / STEPS as f64)?;
        // Around the circle of a fisheye's picture there is nothing to see.
        let circle = last.z < LEAST_FISHEYE_DEG.to_radians().cos();
        (!(lens.distortion.is_fisheye() && circle)).then(|| share * way.length())
    };
    let corners = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]];
    let ends = corners.into_iter().filter_map(|c| end(c.into()));
    let percent = 100.0 * ends.reduce(f64::min)? / (0.5 * size.length());
    Some(format!(
        "the lens's curve turns back inside the picture, {percent:.0}% of the half diagonal from the optical axis, and what is \
         beyond is wrong: check the lens's coefficients, [scene.camera] distortion (k1 = -0.12, not -12) or those of the \
         camera's file, and its field of view"
    ))
}

fn hides_nothing(mask: &Raster<f32>) -> Option<String> {
    let hides = mask.pixels().iter().any(|v| *v > 0.0);
    (!hides).then(|| {
        "the mask of scene.occluders is black everywhere, so nothing stands before the objects; white is what hides them".into()
    })
}

fn camera_below(camera: &Camera, plane: &Plane) -> Option<String> {
    let above = (camera.position - plane.point).dot(plane.normal);
    if above > 0.0 {
        return None;
    }
    let [x, y, z] = plane.normal.to_array();
    Some(match plane.normal.y < 0.0 {
        true => format!(
            "the ground's normal [{x:.2}, {y:.2}, {z:.2}] points down, away from the camera, so no \
             shadow is caught; turn it round: [scene.proxy] plane normal = [{:.2}, {:.2}, {:.2}]",
            -x, -y, -z
        ),
        false => format!(
            "the camera is {} m below the ground, so no shadow is caught; raise [scene.camera] \
             position, or lower [scene.proxy] plane point",
            short((-above).into())
        ),
    })
}

fn object_below(mesh: &TriangleMesh, plane: &Plane) -> Option<String> {
    let above = |p: &Vec3| (*p - plane.point).dot(plane.normal);
    let highest = mesh.positions.iter().map(above).fold(f32::MIN, f32::max);
    (highest < 0.0).then(|| {
        format!(
            "the objects lie {} m or more below the ground, which hides them; raise \
             [[scene.objects]] position",
            short((-highest).into())
        )
    })
}

#[cfg(test)]
mod tests {
    use dipir_cameras::Distortion;
    use glam::{DMat4, Vec2};

    use super::*;
    use crate::camera::FieldOfView;
    use crate::description::FileRecord;

    pub(super) fn scene() -> Scene {
        let corners = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z];
        let mesh = TriangleMesh {
            positions: corners.to_vec(),
            indices: vec![[0, 1, 2], [0, 2, 3]],
            normals: vec![Vec3::Z; 4],
            tangents: vec![glam::Vec4::X; 4],
            uvs: [vec![Vec2::ZERO; 4], vec![Vec2::ZERO; 4]],
            colors: vec![glam::Vec4::ONE; 4],
            materials: vec![0; 2],
        };
        Scene {
            mesh,
            materials: vec![],
            textures: vec![],
            camera: Camera::look_at(
                Vec3::new(0.3, 1.6, 5.0),
                Vec3::new(0.3, 0.5, 0.0),
                Vec3::Y,
                FieldOfView::Vertical(0.7),
                [96, 64],
            ),
            proxy: Proxy::Plane(Plane {
                point: Vec3::ZERO,
                normal: Vec3::Y,
            }),
        }
    }

    fn one(scene: &Scene, part: &str) {
        let found = implausible_scene(scene, &[], None, None);
        assert!(
            found.len() == 1 && found[0].contains(part),
            "{part:?}: {found:?}"
        );
    }

    #[test]
    fn nothing_is_said_of_an_object_on_the_ground_before_the_camera() {
        assert_eq!(
            implausible_scene(&scene(), &[], None, None),
            Vec::<String>::new()
        );
    }

    #[test]
    fn a_camera_where_the_scene_rounds_positions_is_told() {
        let at = |x: f32| {
            let mut scene = scene();
            scene.camera.position.x = x;
            implausible_scene(&scene, &[], None, None)
        };
        let is_told = |x: f32| at(x).iter().any(|said| said.contains("are rounded to"));
        // Floats are 0.98 mm apart below 2^14 metres, 1.95 mm above.
        assert!(!is_told(16_000.0) && is_told(16_500.0));
        let want = "stands 5428 km from the origin of its world, where lengths are rounded to 500 mm: subtract";
        assert!(at(-5_428_000.0)[0].contains(want), "{:?}", at(-5_428_000.0));
    }

    #[test]
    fn a_field_of_view_in_radians_is_said_in_degrees() {
        let mut scene = scene();
        // 0.7 degrees: 0.7 radians are 40.1 degrees. Only the middle of the object is seen.
        scene.camera = Camera::look_at(
            Vec3::new(0.3, 1.6, 5.0),
            Vec3::new(0.3, 0.5, 0.0),
            Vec3::Y,
            FieldOfView::Vertical(0.7f32.to_radians()),
            [96, 64],
        );
        one(&scene, "if 0.700 was meant in radians, write 40.1");
    }

    #[test]
    fn the_field_of_view_of_a_camera_s_file_is_mended_there() {
        let of = |file: &str| field_of_view(0.7, Some(Path::new(file))).unwrap();
        let chan = of("shot.chan");
        let want = "see the last number of its line in \"shot.chan\" or, where there is none, [scene.camera] fov_deg, in \
                    degrees; if 0.700 was meant in radians, write 40.1";
        assert!(chan.ends_with(want), "{chan}");
        let other = of("transforms.json");
        let want = "see its field of view or focal length in \"transforms.json\"";
        assert!(other.ends_with(want), "{other}");
    }

    #[test]
    fn a_camera_under_the_ground_and_a_ground_upside_down_are_told_apart() {
        let mut below = scene();
        below.proxy = Proxy::Plane(Plane {
            point: Vec3::new(0.0, 1.9, 0.0),
            normal: Vec3::Y,
        });
        assert!(
            implausible_scene(&below, &[], None, None)[0]
                .contains("the camera is 0.30 m below the ground")
        );
        let mut turned = scene();
        turned.proxy = Proxy::Plane(Plane {
            point: Vec3::ZERO,
            normal: Vec3::NEG_Y,
        });
        assert!(implausible_scene(&turned, &[], None, None)[0].contains("points down"));
        assert!(
            implausible_scene(&turned, &[], None, None)[0]
                .contains("normal = [-0.00, 1.00, -0.00]")
        );
    }

    /// The object of [`scene`], `scale` times as large as in its file.
    pub(super) fn record(scale: f64) -> ObjectRecord {
        ObjectRecord {
            file: FileRecord {
                path: "o.glb".into(),
                blake3: String::new(),
            },
            dependencies: vec![],
            transform: ObjectRecord::rows(&DMat4::from_scale(DVec3::splat(scale))),
            vertices: 4,
            triangles: 2,
        }
    }

    #[test]
    fn small_heights_are_told_with_digits_that_count() {
        let mut scene = scene();
        scene.proxy = Proxy::Plane(Plane {
            point: Vec3::new(0.0, 1.0004, 0.0),
            normal: Vec3::Y,
        });
        let found = implausible_scene(&scene, &[], None, None);
        assert!(found[0].contains("lie 4.0e-4 m or more below"), "{found:?}");
    }

    #[test]
    fn a_tiny_object_is_warned_of_once() {
        // Below a pixel `visibility::hidden` warns of each object; above, its height or its pixels are told.
        for (scale, warnings) in [(1e-7, 0), (1e-3, 0), (0.04, 1), (0.06, 1)] {
            let mut scene = scene();
            for p in &mut scene.mesh.positions {
                *p = *p * scale + Vec3::new(0.3, 0.0, 0.0);
            }
            let whole = scene.mesh.bounds().unwrap();
            let hidden = below_a_pixel(whole, &scene.camera).is_some();
            assert_eq!(hidden, warnings == 0, "{scale}");
            let found = implausible_scene(&scene, &[record(scale.into())], None, None);
            assert_eq!(found.len(), warnings, "{scale}: {found:?}");
        }
    }

    #[test]
    fn an_object_that_no_pixel_shows_is_said_to_be_where_it_is() {
        for (offset, part) in [
            (Vec3::new(0.0, 0.0, 20.0), "behind the camera"),
            (Vec3::new(-40.0, 0.0, 0.0), "left of the picture"),
            (Vec3::new(40.0, 0.0, 0.0), "right of the picture"),
            (Vec3::new(0.0, 4.0, 0.0), "above the picture"),
            (Vec3::new(0.0, -5.0, 0.0), "below the ground"),
            (Vec3::new(0.3, 0.0, -100.0), "pixels of the picture"),
        ] {
            let mut scene = scene();
            for p in &mut scene.mesh.positions {
                *p += offset;
            }
            let found = implausible_scene(&scene, &[], None, None);
            assert!(found.iter().any(|f| f.contains(part)), "{part}: {found:?}");
        }
    }

    fn lens(distortion: Option<Distortion>) -> Lens {
        Lens {
            distortion: distortion.unwrap(),
            ..Lens::pinhole([300.0, 200.0], DVec2::splat(180.0))
        }
    }

    #[test]
    fn a_lens_that_folds_the_picture_is_told_with_where_it_does() {
        let brown = |k1| {
            lens(Distortion::brown_conrady(
                [k1, 0.0, 0.0, 0.0],
                [0.0; 3],
                [0.0; 2],
            ))
        };
        let fisheye = |k1| lens(Distortion::kannala_brandt([k1, 0.0, 0.0, 0.0]));
        for good in [brown(-0.12), brown(0.3), fisheye(-0.02)] {
            assert_eq!(turns_back(&good), None);
        }
        // r (1 - 5 r^2) turns where it is two thirds of 1 / sqrt(15), .172 focal lengths: 31 pixels of 180.3.
        let found = turns_back(&brown(-5.0)).unwrap();
        assert!(found.contains(" 17% of the half diagonal"), "{found}");
        assert!(turns_back(&brown(1e300)).is_some());
        assert!(turns_back(&fisheye(-5.0)).is_some());
        let found = implausible_scene(&scene(), &[], Some(&brown(-5.0)), None);
        assert!(found.len() == 1 && found[0].contains("17%"), "{found:?}");
        // The picture of half a sphere is a circle in a larger frame.
        let mut circular = fisheye(-0.05);
        circular.focal_px = DVec2::splat(60.0);
        assert_eq!(turns_back(&circular), None);
    }

    #[test]
    fn the_field_of_view_of_a_fisheyes_working_picture_is_no_setting() {
        let mut wide = scene();
        wide.camera.focal_px = Vec2::splat(10.0);
        let part = "vertical field of view is 145";
        assert!(implausible_scene(&wide, &[], None, None)[0].contains(part));
        let fisheye = lens(Distortion::kannala_brandt([0.0; 4]));
        let found = implausible_scene(&wide, &[], Some(&fisheye), None);
        assert!(!found.iter().any(|f| f.contains(part)), "{found:?}");
    }

    #[test]
    fn a_black_mask_is_told() {
        let mut mask = Raster::filled(3, 2, 0.0);
        assert!(hides_nothing(&mask).unwrap().contains("scene.occluders"));
        mask.pixels_mut()[4] = 0.01;
        assert_eq!(hides_nothing(&mask), None);
    }
}
