//! Previews of a small project.
use std::fs;

use dipir_cli::args::{CommonArgs, OutputArgs};
use dipir_cli::session::Session;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_preview::lines::Kind;
use dipir_preview::marks::Marks;
use dipir_preview::picture::Preview;
use dipir_preview::small::SmallScene;
use glam::{DVec3, Vec3};
use tempfile::TempDir;

/// A box that lies off its origin, twice, one of them turned in every way.
const TEXT: &str = "[scene]\nbackground = \"photo.png\"\n\
    [[scene.objects]]\npath = \"box.obj\"\nat_pixel = [100.0, 150.0]\nanchor = \"center\"\nheight_m = 0.5\nyaw_deg = 20.0\n\
    [[scene.objects]]\npath = \"box.obj\"\nposition = [1.0, 0.0, -5.0]\nyaw_deg = -70.0\npitch_deg = -90.0\nroll_deg = 10.0\n\
    [scene.camera]\nposition = [0.0, 1.6, 0.0]\npitch_deg = -10.0\nfov_deg = 50.0\n\
    [scene.proxy]\nplane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }\n\
    [light]\nstart = \"neutral\"\n";

const BOX: &str = "v 3 5 7\nv 4 5 7\nv 4 7 7\nv 3 7 7\nv 3 5 10\nv 4 5 10\nv 4 7 10\nv 3 7 10\n\
    f 1 4 3 2\nf 5 6 7 8\nf 1 5 8 4\nf 2 3 7 6\nf 4 8 7 3\nf 1 2 6 5\n";

fn project() -> (TempDir, Session) {
    let folder = tempfile::tempdir().unwrap();
    let grey = Raster::filled(300, 200, Vec3::splat(0.5));
    write_png(folder.path().join("photo.png"), &DisplayImage(grey)).unwrap();
    fs::write(folder.path().join("box.obj"), BOX).unwrap();
    fs::write(folder.path().join("pipeline.toml"), TEXT).unwrap();
    let session = Session::open(&CommonArgs {
        pipeline: folder.path().join("pipeline.toml"),
        set: Vec::new(),
        out: None,
        threads: None,
        seed: None,
        wait: false,
        supervised: false,
        hashes: None,
        output: OutputArgs::default(),
    });
    (folder, session.unwrap())
}

#[test]
fn objects_that_are_arranged_again_stand_where_they_were_loaded() {
    let (_folder, session) = project();
    let (mut small, arrangement) = SmallScene::load(&session, 150).unwrap();
    let loaded = small.loaded.scene.mesh.clone();
    small.arrange(&arrangement);
    let again = &small.loaded.scene.mesh;
    assert_eq!(loaded.indices.len(), again.indices.len());
    for (a, b) in loaded.corners().zip(again.corners()) {
        // Two more roundings of coordinates of some metres.
        assert!(a.distance(b) < 1e-5, "{a} {b}");
    }
    assert_eq!(small.loaded.scene.camera.resolution, [150, 100]);
    assert_eq!(arrangement.camera.resolution, [300, 200]);
}

#[test]
fn boxes_hold_their_objects_and_stand_on_the_ground() {
    let (_folder, session) = project();
    let (small, arrangement) = SmallScene::load(&session, 300).unwrap();
    let triangles = small.loaded.scene.mesh.indices.len() / 2;
    let corners: Vec<DVec3> = small
        .loaded
        .scene
        .mesh
        .corners()
        .map(|c| c.as_dvec3())
        .collect();
    for (object, corners) in arrangement
        .objects
        .iter()
        .zip(corners.chunks(3 * triangles))
    {
        for corner in corners {
            let p = object.axes.transpose() * *corner;
            let out = (object.low - p).max(p - object.high).max_element();
            assert!(out < 1e-5, "{out}");
        }
        assert!(object.low.y.abs() < 1e-5 && object.contact.y.abs() < 1e-5);
    }
    let first = &arrangement.objects[0];
    let seen = arrangement.camera.project(first.contact.as_vec3()).unwrap();
    // at_pixel, in single precision.
    assert!(
        seen.distance(glam::Vec2::new(100.0, 150.0)) < 1e-2,
        "{seen}"
    );
    // The file's box is 1 x 2 x 3 m, and the height is halved thrice over.
    let size = first.size() - DVec3::new(0.25, 0.5, 0.75);
    assert!(size.abs().max_element() < 1e-5, "{size}");
    // Upright the front of the file's z is the front; lying on its back, its height is its depth.
    assert!((arrangement.objects[1].size().y - 3.0).abs() < 0.3);
}

#[test]
fn marks_stay_in_the_picture_and_below_the_horizon() {
    let (_folder, session) = project();
    let (_, arrangement) = SmallScene::load(&session, 300).unwrap();
    let marks = Marks::of(&arrangement);
    let of = |kind| marks.pieces.iter().filter(move |p| p.kind == kind);
    for kind in Kind::ALL {
        assert!(of(kind).next().is_some(), "{kind:?}");
    }
    let row = of(Kind::Horizon).next().unwrap().from.y;
    for piece in &marks.pieces {
        for p in [piece.from, piece.to] {
            assert!((-1e-6..300.001).contains(&p.x) && (-1e-6..200.001).contains(&p.y));
        }
    }
    for piece in of(Kind::Grid).chain(of(Kind::MainGrid)) {
        assert!(piece.from.y > row && piece.to.y > row);
    }
    assert_eq!(marks.spacing_m, 1.0);
    assert_eq!(marks.labels[0].text, "1 m");
}

#[test]
fn a_preview_is_written_again_but_not_over_another_s_picture() {
    let (folder, session) = project();
    let path = folder.path().join("preview.png");
    for draft in [false, true] {
        let preview = Preview::new(&session, draft).unwrap();
        assert_eq!(preview.light.is_some(), draft);
        preview.write(&path).unwrap();
    }
    let photo = folder.path().join("photo.png");
    let before = fs::read(&photo).unwrap();
    let error = Preview::new(&session, false).unwrap().write(&photo);
    assert!(format!("{:#}", error.unwrap_err()).contains("dipir did not make it"));
    assert_eq!(fs::read(&photo).unwrap(), before);
}
