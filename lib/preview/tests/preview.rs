//! Previews of a small project.
use std::fs;
use std::ops::ControlFlow;
use std::sync::Arc;

use dipir_cli::session::Session;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_light::environment::EnvironmentMap;
use dipir_light::gaussian::{SgMixture, SphericalGaussian};
use dipir_preview::draft::Draft;
use dipir_preview::lines::Kind;
use dipir_preview::marks::Marks;
use dipir_preview::picture::Preview;
use dipir_preview::relit::Relit;
use dipir_preview::small::SmallScene;
use dipir_render::error::RenderError;
use dipir_stages::composite::shutter::that_blurs;
use dipir_stages::light::at_hand::{AtHand, Origin, at_hand};
use glam::{DVec3, Vec3};
use tempfile::TempDir;

mod opened;
use opened::open;

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
    project_of(TEXT)
}

fn project_of(text: &str) -> (TempDir, Session) {
    let folder = tempfile::tempdir().unwrap();
    let grey = Raster::filled(300, 200, Vec3::splat(0.5));
    write_png(folder.path().join("photo.png"), &DisplayImage(grey)).unwrap();
    fs::write(folder.path().join("box.obj"), BOX).unwrap();
    fs::write(folder.path().join("pipeline.toml"), text).unwrap();
    let session = open(folder.path(), &[]);
    (folder, session)
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
fn a_photograph_stays_one_that_a_camera_exposed_at_any_size() {
    let (_folder, session) = project();
    for longest in [150, 300] {
        let (small, _) = SmallScene::load(&session, longest).unwrap();
        let photo = &small.loaded.photo;
        let values = photo.values.as_ref().expect("values of 8 bits");
        assert_eq!(values.width(), photo.image.0.width());
        assert_eq!(values.pixels()[0], [128; 3]);
        // As a run does, a draft bends the light of the object.
        assert!(at_hand(&session, &small.loaded).unwrap().tone.is_some());
    }
}

#[test]
fn a_drawn_shadow_tells_the_same_sun_at_any_size() {
    let shadow = "start = \"auto\"\nshadow = { foot = [150.0, 140.0], tip = [60.0, 170.0], height_m = 1.0 }\n";
    for lens in ["", "distortion = { k1 = -0.1 }\n"] {
        let text = TEXT.replace("start = \"neutral\"\n", shadow);
        let text = text.replace("fov_deg = 50.0\n", &format!("fov_deg = 50.0\n{lens}"));
        let (folder, session) = project_of(&text);
        let suns = [300, 100].map(|longest| {
            let (small, _) = SmallScene::load(&session, longest).unwrap();
            let found = at_hand(&session, &small.loaded).unwrap();
            let lobes = found.lobes.lobes().to_vec();
            lobes[0].direction
        });
        // Pixels and directions are f32: some roundings of 6e-8.
        assert!(suns[0].distance(suns[1]) < 1e-6, "{suns:?}");
        drop(folder);
    }
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

/// A sky that is brighter on one side, and a sun of half a degree's width.
fn sunny(direction: Vec3) -> AtHand {
    let texels = (0..32 * 16).map(|k| Vec3::splat(if k % 32 < 16 { 0.2 } else { 0.5 }));
    let sun = SphericalGaussian {
        direction: direction.normalize(),
        radiance: Vec3::new(4000.0, 3600.0, 3000.0),
        sigma: 0.008,
    };
    AtHand {
        lobes: SgMixture::new(vec![sun]).unwrap(),
        map: Some(Arc::new(
            EnvironmentMap::new(32, 16, texels.collect()).unwrap(),
        )),
        tone: None,
        gloss: None,
        optics: Default::default(),
        origin: Origin::Estimate,
    }
}

#[test]
fn drafts_glow_as_much_as_the_keys_say() {
    let text = TEXT.replace("box.obj", "lamp.obj");
    let (folder, _) = project_of(&text);
    let lamp = format!("mtllib lamp.mtl\nusemtl lamp\n{BOX}");
    fs::write(folder.path().join("lamp.obj"), lamp).unwrap();
    let material = "newmtl lamp\nKd 0 0 0\nKs 0 0 0\nNs 0\nKe .4 .4 .4\n";
    fs::write(folder.path().join("lamp.mtl"), material).unwrap();
    let glow = |set: &[&str]| {
        // Without a curve, that light is seen as it is.
        let set = [&["composite.tone=none"], set].concat();
        let session = open(folder.path(), &set);
        let (small, _) = SmallScene::load(&session, 150).unwrap();
        let light = at_hand(&session, &small.loaded).unwrap();
        let go_on = &mut || ControlFlow::Continue(());
        let draft = Draft::render(&small.loaded, &light, 4, go_on).unwrap();
        let picture = small.loaded.photo.transfer.decode(draft.picture);
        let pixels = picture.0.pixels().iter().zip(draft.alpha.pixels());
        let whole: Vec<f32> = pixels
            .filter(|(_, a)| **a == 1.0)
            .map(|(p, _)| p.x)
            .collect();
        assert!(whole.len() > 50);
        whole.iter().sum::<f32>() / whole.len() as f32
    };
    let reflected = glow(&["scene.effects.emission=off"]);
    let emitted = |set: &[&str]| glow(set) - reflected;
    // Values have 8 bits.
    let whole = emitted(&[]);
    assert!((whole - 0.4).abs() < 5e-3, "{whole} {reflected}");
    let dimmer = emitted(&["composite.emission_ev=-1"]);
    assert!((dimmer - 0.2).abs() < 5e-3, "{dimmer}");
    let red = emitted(&["composite.emission_tint=[1.0, 0.0, 0.0]"]);
    assert!((red - 0.8).abs() < 0.01, "{red}");
}

#[test]
fn the_lens_of_a_draft_is_known_wherever_its_objects_stand() {
    let text = format!("{TEXT}[composite]\nfocus_m = 5.0\naperture_mm = 40.0\n");
    let (folder, session) = project_of(&text);
    let (mut small, _) = SmallScene::load(&session, 150).unwrap();
    let light = at_hand(&session, &small.loaded).unwrap();
    let lens = |small: &SmallScene| that_blurs(light.optics, &small.loaded).0.lens;
    assert_eq!(lens(&small), None);
    let near = open(
        folder.path(),
        &["scene.objects.1.position=[0.0, 1.0, -2.3]"],
    );
    let config = near.config.table("scene").unwrap();
    let arrangement = small.props.arranged(&config).unwrap();
    small.arrange(&arrangement);
    assert!(light.optics.lens.is_some());
    assert_eq!(lens(&small), light.optics.lens);
}

#[test]
fn a_record_shows_another_sun_and_exposure_as_a_draft_does() {
    let (_folder, session) = project();
    let (small, arrangement) = SmallScene::load(&session, 300).unwrap();
    let normal = arrangement.ground().normal;
    let start = sunny(Vec3::new(1.0, 1.0, 0.3));
    let relit = Relit::record(&small.loaded, normal, &start, || ControlFlow::Continue(())).unwrap();
    let mut shown = Vec::new();
    for (direction, exposure) in [
        (Vec3::new(1.0, 1.0, 0.3), 1.0),
        (Vec3::new(-1.0, 0.7, 0.2), 1.0),
        (Vec3::new(0.2, 0.5, 1.0), 0.5),
    ] {
        let light = sunny(direction);
        let piece = relit.under(&light, exposure).unwrap().expect("an object");
        let exposed = AtHand {
            lobes: SgMixture::new(
                light
                    .lobes
                    .lobes()
                    .iter()
                    .map(|l| SphericalGaussian {
                        radiance: l.radiance * exposure,
                        ..*l
                    })
                    .collect(),
            )
            .unwrap(),
            map: light.map.map(|m| Arc::new(m.scaled(exposure))),
            ..light
        };
        let mut go_on = || ControlFlow::Continue(());
        let draft = Draft::render(&small.loaded, &exposed, 64, &mut go_on).unwrap();
        // All that the draft changes is in the piece, to a pixel.
        let [x0, y0, x1, y1] = piece.place;
        let [a0, b0, a1, b1] = draft.touched.unwrap();
        assert!(x0 <= a0 + 1 && y0 <= b0 + 1 && x1 + 1 >= a1 && y1 + 1 >= b1);
        let mut sum = 0.0;
        for y in y0..y1 {
            for x in x0..x1 {
                let apart = *piece.picture.0.get(x - x0, y - y0) - *draft.picture.0.get(x, y);
                sum += f64::from(apart.abs().element_sum()) / 3.0;
            }
        }
        let mean = sum / ((x1 - x0) * (y1 - y0)) as f64;
        // Two rays to the sun a pixel: edges of shadows and of the boxes are rough.
        assert!(mean < 0.012, "{direction}: {mean}");
        shown.push(piece);
    }
    assert_ne!(shown[0].picture, shown[1].picture);
}

#[test]
fn a_record_that_is_broken_off_says_so() {
    let (_folder, session) = project();
    let (small, arrangement) = SmallScene::load(&session, 300).unwrap();
    let light = sunny(Vec3::Y);
    let normal = arrangement.ground().normal;
    let broken = Relit::record(&small.loaded, normal, &light, || ControlFlow::Break(()));
    assert!(matches!(broken.err(), Some(RenderError::Interrupted)));
}
