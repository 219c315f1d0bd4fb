//! The same points in every format, and what is read back.
use std::path::Path;

use dipir_cameras::{Camera, Lens, Pose, WorldUp};
use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::raster::Raster;
use dipir_points::depth;
use dipir_points::file::{self, Source};
use glam::{DVec2, DVec3};
use proptest::prelude::*;

/// In axes with +z up, with digits that 32 bits hold.
const POINTS: [[f32; 3]; 6] = [
    [0.5, 1.0, 0.25],
    [-2.0, 3.5, 0.0],
    [10.0, -4.0, 1.5],
    [0.0, 0.0, 0.0],
    [7.25, 8.5, -0.75],
    [1.0, 1.0, 1.0],
];

fn ours() -> Vec<DVec3> {
    let turned = |[x, y, z]: [f32; 3]| DVec3::new(x.into(), z.into(), -f64::from(y));
    POINTS.map(turned).to_vec()
}

fn bytes(values: &[f32], big: bool) -> Vec<u8> {
    let of = |v: &f32| {
        if big {
            v.to_be_bytes()
        } else {
            v.to_le_bytes()
        }
    };
    values.iter().flat_map(of).collect()
}

fn ply(format: &str) -> Vec<u8> {
    let mut file = format!(
        "ply\nformat {format} 1.0\ncomment scan\nelement camera 1\nproperty list uchar int ids\n\
         element vertex {}\nproperty float x\nproperty uchar red\nproperty float y\nproperty float z\n\
         element face 0\nproperty list uchar int vertex_indices\nend_header\n",
        POINTS.len()
    )
    .into_bytes();
    let big = format.ends_with("big_endian");
    match format {
        "ascii" => {
            file.extend(b"2 5 6\n");
            for [x, y, z] in POINTS {
                file.extend(format!("{x} 200 {y} {z}\n").bytes());
            }
        }
        _ => {
            file.push(2);
            file.extend([0u8; 8]);
            for [x, y, z] in POINTS {
                file.extend([bytes(&[x], big), vec![200], bytes(&[y, z], big)].concat());
            }
        }
    }
    file
}

fn pcd(data: &str) -> Vec<u8> {
    let n = POINTS.len() + 1;
    let mut file = format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS intensity x y z normal\nSIZE 1 4 4 4 4\nTYPE U F F F F\n\
         COUNT 1 1 1 1 2\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {data}\n"
    )
    .into_bytes();
    let all = POINTS.into_iter().chain([[f32::NAN; 3]]);
    for [x, y, z] in all {
        match data {
            "ascii" => file.extend(format!("9 {x} {y} {z} 0 1\n").bytes()),
            _ => file.extend([vec![9], bytes(&[x, y, z, 0.0, 1.0], false)].concat()),
        }
    }
    file
}

fn sweep(width: usize) -> Vec<u8> {
    let more = [0.37, 31.0];
    let points = POINTS
        .iter()
        .flat_map(|p| [&p[..], &more[..width - 3]].concat());
    bytes(&points.collect::<Vec<_>>(), false)
}

fn camera() -> Camera {
    Camera {
        pose: Pose {
            position: DVec3::new(0.0, 0.75, 0.0),
            ..Pose::IDENTITY
        },
        lens: Lens::pinhole([80.0, 60.0], DVec2::splat(70.0)),
    }
}

fn source<'a>(path: &'a Path, camera: &'a Camera) -> Source<'a> {
    Source {
        path,
        up: Some(WorldUp::Z),
        scale: 1.0,
        pose: None,
        camera,
    }
}

fn near(found: &[DVec3], want: &[DVec3], what: &str) {
    assert_eq!(found.len(), want.len(), "{what}");
    for (a, b) in found.iter().zip(want) {
        assert!(a.distance(*b) < 1e-9, "{what}: {a} {b}");
    }
}

#[test]
fn every_format_gives_the_same_points() {
    let folder = tempfile::tempdir().unwrap();
    let camera = camera();
    let colmap_text: String = POINTS
        .iter()
        .map(|[x, y, z]| format!("1 {x} {y} {z} 255 0 0 0.5 1 2\n"))
        .collect();
    let mut colmap = (POINTS.len() as u64).to_le_bytes().to_vec();
    for point in POINTS {
        colmap.extend(1u64.to_le_bytes());
        colmap.extend(point.iter().flat_map(|v| f64::from(*v).to_le_bytes()));
        colmap.extend([0; 11 + 8]);
    }
    let files = [
        ("a.ply", ply("ascii")),
        ("b.ply", ply("binary_little_endian")),
        ("c.ply", ply("binary_big_endian")),
        ("d.pcd", pcd("ascii")),
        ("e.pcd", pcd("binary")),
        ("f.bin", sweep(4)),
        ("g.pcd.bin", sweep(5)),
        ("points3D.txt", colmap_text.into_bytes()),
        ("points3D.bin", colmap),
    ];
    for (name, bytes) in files {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let cloud = file::read(&source(&path, &camera)).unwrap();
        near(&cloud.points, &ours(), name);
    }
    // The folder stands for its points.
    let cloud = file::read(&source(folder.path(), &camera)).unwrap();
    near(&cloud.points, &ours(), "folder");
    // And a project for those of its model.
    let model = folder.path().join("project/sparse/0");
    std::fs::create_dir_all(&model).unwrap();
    std::fs::write(model.join("cameras.txt"), "").unwrap();
    std::fs::rename(
        folder.path().join("points3D.txt"),
        model.join("points3D.txt"),
    )
    .unwrap();
    let project = folder.path().join("project");
    assert_eq!(file::part(&project), model.join("points3D.txt"));
    let cloud = file::read(&source(&project, &camera)).unwrap();
    near(&cloud.points, &ours(), "project");
}

#[test]
fn scale_axis_and_sensor_move_points() {
    let folder = tempfile::tempdir().unwrap();
    let camera = camera();
    let put = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    };
    let scan = put("scan.bin", &sweep(4));
    let scaled = file::read(&Source {
        scale: 2.0,
        ..source(&scan, &camera)
    });
    assert_eq!(scaled.unwrap().points[0], 2.0 * ours()[0]);
    // A lidar 1.8 m over the ground, turned to the left by 90 degrees.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let record = format!(
        "{{\"translation\": [1, 0, 1.8], \"rotation\": [{half}, 0, 0, {half}], \"camera_intrinsic\": []}}"
    );
    let record = put("lidar.json", record.as_bytes());
    let moved = file::read(&Source {
        pose: Some(&record),
        ..source(&scan, &camera)
    });
    let cloud = moved.unwrap();
    // (0.5, 1, 0.25) becomes (-1, 0.5, 0.25), shifted (0, 0.5, 2.05) with +z up.
    assert!(cloud.points[0].abs_diff_eq(DVec3::new(0.0, 2.05, -0.5), 1e-9));
    assert!(
        cloud
            .viewpoint
            .unwrap()
            .abs_diff_eq(DVec3::new(1.0, 1.8, 0.0), 1e-9)
    );
}

#[test]
fn a_depth_map_gives_the_points_that_the_camera_sees() {
    let folder = tempfile::tempdir().unwrap();
    let camera = camera();
    // The ground 0.75 m below a level camera, at half the photograph's size.
    let depth = |i: usize| {
        let below = (i / 40) as f64 + 0.5 - 15.0;
        if below > 0.0 {
            (0.75 * 35.0 / below) as f32
        } else {
            0.0
        }
    };
    let depth = Raster::from_pixels(40, 30, (0..1200).map(depth).collect());
    let exr = folder.path().join("depth.exr");
    let mut layers = Layers::new(40, 30);
    layers.insert("Z", Precision::Full, depth.clone()).unwrap();
    layers.write_exr(&exr).unwrap();
    let png = folder.path().join("depth.png");
    let millimetres = depth.pixels().iter().map(|m| (m * 1e3).round() as u16);
    let grey = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(
        40,
        30,
        millimetres.collect::<Vec<_>>(),
    );
    grey.unwrap().save(&png).unwrap();
    for (path, tolerance) in [(exr, 1e-5), (png, 1e-3)] {
        let depths = Source {
            up: None,
            ..source(&path, &camera)
        };
        let cloud = file::read(&depths).unwrap();
        assert_eq!(cloud.points.len(), 600);
        for point in &cloud.points {
            // Half a millimetre of the nearest depths is less in height.
            assert!(point.y.abs() < tolerance, "{point}");
        }
        assert_eq!(cloud.viewpoint, Some(camera.pose.position));
    }
    // Twice as far is twice as far below the camera, which stands 0.75 m above the ground.
    let exr = folder.path().join("depth.exr");
    let far = Source {
        scale: 2.0,
        up: None,
        ..source(&exr, &camera)
    };
    for point in &file::read(&far).unwrap().points {
        assert!((point.y + 0.75).abs() < 1e-5, "{point}");
    }
    let error = file::read(&source(&exr, &camera)).unwrap_err().to_string();
    assert!(
        error.contains("leave points_up and points_pose out"),
        "{error}"
    );
    let wide = Raster::filled(40, 10, 1.0f32);
    let error = depth::points(&wide, &camera).unwrap_err().to_string();
    assert!(
        error.contains("it has 40 x 10 pixels, and the photograph 80 x 60"),
        "{error}"
    );
}

#[test]
fn coordinates_without_values_are_refused_in_pcd() {
    for counts in ["1 1 0", "0 0 0"] {
        let header = format!(
            "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT {counts}\nPOINTS 1\nDATA binary\n"
        );
        let error = file::pcd(&[header.as_bytes(), &[0; 64]].concat()).unwrap_err();
        assert!(
            error.to_string().contains("no numbers of 4 or 8 bytes"),
            "{error}"
        );
    }
}

#[test]
fn points_of_colmap_that_are_nowhere_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("points3D.txt");
    std::fs::write(
        &path,
        "1 nan 0 0 9 9 9 0\n2 1 2 3 9 9 9 0\n3 inf 0 0 9 9 9 0\n",
    )
    .unwrap();
    let camera = camera();
    let source = Source {
        up: None,
        ..source(&path, &camera)
    };
    let found = file::read(&source).unwrap().points;
    near(&found, &[DVec3::new(1.0, -2.0, -3.0)], "points3D.txt");
}

#[test]
fn what_is_no_points_is_explained() {
    let said = |bytes: &[u8]| file::pcd(bytes).unwrap_err().to_string();
    let packed = String::from_utf8(pcd("ascii"))
        .unwrap()
        .replace("DATA ascii", "DATA binary_compressed");
    assert!(said(packed.as_bytes()).contains("pcl_convert_pcd_ascii_binary"));
    assert!(file::sweep(&[0; 7]).is_err());
    assert!(file::sweep(&[]).is_err());
    let many = "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\n\
                property float y\nproperty float z\nend_header\n";
    let error = file::ply(many.as_bytes()).unwrap_err().to_string();
    assert!(error.contains("the file ends here"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    /// Points that are finite, or an error, never a panic.
    #[test]
    fn damaged_files_never_panic(
        damage in proptest::collection::vec((0usize..600, any::<u8>()), 0..8),
        length in 0usize..700,
    ) {
        let damaged = |bytes: &[u8]| {
            let mut bytes = bytes.to_vec();
            for (at, value) in &damage {
                let at = at % bytes.len();
                bytes[at] = *value;
            }
            bytes.truncate(length);
            bytes
        };
        let formats = ["ascii", "binary_little_endian", "binary_big_endian"];
        let plys = formats.map(|f| file::ply(&damaged(&ply(f))));
        let pcds = ["ascii", "binary"].map(|f| file::pcd(&damaged(&pcd(f))));
        let sweeps = [4, 5].map(|w| file::sweep(&damaged(&sweep(w))));
        for cloud in plys.into_iter().chain(pcds).chain(sweeps).flatten() {
            prop_assert!(cloud.points.iter().all(|p| p.is_finite()));
        }
        let _ = file::depth_png(&damaged(&pcd("binary")));
    }
}

#[test]
fn the_number_of_points_in_pcd_is_that_of_its_grid_where_it_is_not_stated() {
    let whole = String::from_utf8(pcd("ascii")).unwrap();
    let lines = whole.lines().filter(|l| !l.starts_with("POINTS"));
    let short: Vec<&str> = lines.collect();
    let tabs = whole.replace("FIELDS intensity x", "FIELDS\tintensity x");
    for text in [short.join("\n"), tabs] {
        assert_eq!(
            file::pcd(text.as_bytes()).unwrap().points.len(),
            POINTS.len()
        );
    }
}

#[test]
fn points_and_numbers_that_are_missing_in_pcd_are_told() {
    let whole = String::from_utf8(pcd("ascii")).unwrap();
    let (head, _) = whole.trim_end().rsplit_once('\n').unwrap();
    let pose = whole.replace("VIEWPOINT 0 0 0 1 0 0 0", "VIEWPOINT 5 0 0 1 0 0");
    for (text, said) in [
        (head, "it is cut short"),
        (&pose, "its viewpoint is no rotation and position"),
    ] {
        let error = file::pcd(text.as_bytes()).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}

#[test]
fn an_axis_beside_a_calibration_of_kitti_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let camera = camera();
    let (scan, pose) = (folder.path().join("a.bin"), folder.path().join("calib.txt"));
    std::fs::write(&scan, sweep(4)).unwrap();
    std::fs::write(&pose, "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n").unwrap();
    let of = |up| {
        let source = Source {
            up,
            pose: Some(&pose),
            ..source(&scan, &camera)
        };
        file::read(&source).map_err(|e| e.to_string())
    };
    assert!(of(None).is_ok());
    let error = of(Some(WorldUp::Y)).unwrap_err();
    assert!(error.contains("leave points_up out"), "{error}");
}

#[test]
fn far_points_are_left_out_by_their_metres_and_not_by_the_unit_of_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scan.ply");
    let camera = camera();
    let of = |points: &str, scale: f64| {
        let header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n";
        std::fs::write(&path, format!("{header}end_header\n{points}")).unwrap();
        let source = Source {
            up: None,
            scale,
            ..source(&path, &camera)
        };
        file::read(&source).unwrap().points
    };
    // A house in UTM, in millimetres, and a pixel without an echo.
    let house = "458000000 520000 5428000000\n1e30 1e30 1e30\n";
    near(
        &of(house, 1e-3),
        &[DVec3::new(458_000.0, 520.0, 5_428_000.0)],
        "UTM",
    );
    assert_eq!(of(house, 1.0), []);
    // Just south of the equator, where northings count from ten million: its distance from the origin is more.
    let south = "500000 0 9999000\n1e308 1e308 1e308\n";
    near(
        &of(south, 1.0),
        &[DVec3::new(500_000.0, 0.0, 9_999_000.0)],
        "south",
    );
    near(&of(south, 10.0), &[], "all are too far");
}
