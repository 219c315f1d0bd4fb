//! What a run of the stage would read, against what it read.
use std::fs;

use clap::Parser;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_pipeline::fingerprint::{in_words, stale_reasons};
use glam::Vec3;

use super::*;
use crate::command_line::scene::Cli;

#[test]
fn a_part_that_is_gone_keeps_a_scene_from_running_only_where_the_object_needs_it() {
    let here = tempfile::tempdir().unwrap();
    let at = |name: &str| here.path().join(name);
    let photo = DisplayImage(Raster::filled(36, 24, Vec3::splat(0.5)));
    write_png(at("photo.png"), &photo).unwrap();
    // A triangle whose corners are in another file.
    let object = |buffer: &str| {
        let object = json!({
            "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3",
                "min": [0, 0, 0], "max": [1, 1, 0]}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "buffers": [{"uri": buffer, "byteLength": 36}],
            "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
            "textures": [{"source": 0}], "images": [{"uri": "grey.png"}],
        });
        fs::write(at("object.gltf"), object.to_string()).unwrap();
    };
    object("a.bin");
    let corners = [0f32, 0., 0., 1., 0., 0., 0., 1., 0.].map(f32::to_le_bytes);
    fs::write(at("a.bin"), corners.concat()).unwrap();
    write_png(at("grey.png"), &photo).unwrap();
    let text = "[scene]\nbackground = \"photo.png\"\n[[scene.objects]]\npath = \"object.gltf\"\nposition = [0.0, 0.0, 0.0]\n\
                [scene.camera]\nposition = [0.0, 1.6, 5.0]\nlook_at = [0.0, 0.5, 0.0]\nfov_deg = 40.0\n\
                [scene.proxy]\nplane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }\n";
    fs::write(at("pipeline.toml"), text).unwrap();
    let file = at("pipeline.toml").display().to_string();
    let args = ["dipir-scene", "-q", "-p", file.as_str()];
    let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
    run(&session).unwrap();
    let told = || {
        let plan = plan(&session).map_err(|e| dipir_cli::exit::describe(&e))?;
        let reasons = stale_reasons(&plan, &SCENE.folder(&session)).unwrap();
        Ok::<_, String>(in_words(&reasons))
    };
    assert_eq!(told(), Ok(String::new()));
    // The stage runs without a texture.
    fs::remove_file(at("grey.png")).unwrap();
    let lacks = "it no longer reads the part of object 2";
    assert_eq!(told().unwrap(), lacks);
    run(&session).unwrap();
    assert_eq!(told(), Ok(String::new()));
    // It is there again.
    write_png(at("grey.png"), &photo).unwrap();
    assert_eq!(told().unwrap(), "the part of object grey.png is there now");
    let refused = folder::SceneFolder::read(&session).err().unwrap();
    assert_eq!(
        refused.to_string(),
        "the part of object \"grey.png\" is there now and was missing when the scene was set up; run dipir-scene again"
    );
    fs::remove_file(at("grey.png")).unwrap();
    assert_eq!(told(), Ok(String::new()));
    fs::rename(at("a.bin"), at("b.bin")).unwrap();
    let missing = told().unwrap_err();
    assert!(missing.contains("a.bin"), "{missing}");
    assert!(run(&session).is_err());
    // Another object has other files.
    object("b.bin");
    assert_eq!(
        told().unwrap(),
        "the object object.gltf has other content; it no longer reads the part of object"
    );
    run(&session).unwrap();
    assert_eq!(told(), Ok(String::new()));
}

/// A tetrahedron on a grey photograph, on the ground that `proxy` tells; `more` are further keys of `[scene]`.
fn project(folder: &Path, more: &str, proxy: &str) -> String {
    let photo = DisplayImage(Raster::filled(36, 24, Vec3::splat(0.5)));
    write_png(folder.join("photo.png"), &photo).unwrap();
    let object = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    fs::write(folder.join("object.obj"), object).unwrap();
    let text = format!(
        "[scene]\nbackground = \"photo.png\"\n{more}\n[[scene.objects]]\npath = \"object.obj\"\nposition = [0.0, 0.0, 0.0]\n\
         [scene.camera]\nposition = [0.0, 1.6, 5.0]\nlook_at = [0.0, 0.5, 0.0]\nfov_deg = 40.0\n\
         [scene.proxy]\n{proxy}\n"
    );
    fs::write(folder.join("pipeline.toml"), text).unwrap();
    folder.join("pipeline.toml").display().to_string()
}

fn opened(file: &str, more: &[&str]) -> Session {
    let args = [&["dipir-scene", "-q", "-p", file], more].concat();
    Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap()
}

/// Why the stage would run, in words.
fn stale(session: &Session) -> String {
    let plan = plan(session).unwrap();
    in_words(&stale_reasons(&plan, &SCENE.folder(session)).unwrap())
}

#[test]
fn a_plan_refuses_what_a_run_refuses() {
    let here = tempfile::tempdir().unwrap();
    let plane = "plane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }";
    let file = project(here.path(), "", plane);
    for wrong in [
        "scene.objects.0.scale=nan",
        "scene.objects.0.yaw_deg=nan",
        "scene.objects.0.rest=nan",
        "scene.transfer=nan",
        "scene.camera.position=[0.0, 0.5, 0.0]",
    ] {
        let session = opened(&file, &["--set", wrong]);
        let planned = plan(&session).err().unwrap();
        let ran = run(&session).err().unwrap();
        let told = planned.to_string();
        assert_eq!(told, ran.to_string());
        assert!(told.contains("scene."), "{told}");
        let codes = [&planned, &ran].map(dipir_cli::exit::code_of);
        assert_eq!(codes, [dipir_cli::exit::USAGE; 2], "{told}");
    }
}

#[test]
fn mask_and_depths_of_an_effect_that_is_off_are_no_inputs() {
    let here = tempfile::tempdir().unwrap();
    let plane = "plane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }";
    let named =
        "occluders = \"mask.png\"\ndepth = \"depth.png\"\neffects = { occluders = \"off\" }";
    let session = opened(&project(here.path(), named, plane), &[]);
    // Not even made.
    run(&session).unwrap();
    assert_eq!(stale(&session), "");
    for name in ["mask.png", "depth.png"] {
        fs::write(here.path().join(name), "made later").unwrap();
    }
    assert_eq!(stale(&session), "");
}

#[test]
fn a_frame_of_a_shot_on_points_is_made_once() {
    let here = tempfile::tempdir().unwrap();
    let points = (0..3600).map(|k| {
        let (x, z) = (f64::from(k % 60) * 0.1 - 3.0, f64::from(k / 60) * 0.1 - 3.0);
        format!("{x} 0 {z}\n")
    });
    let header = "ply\nformat ascii 1.0\nelement vertex 3600\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    let points = header.to_owned() + &points.collect::<String>();
    fs::write(here.path().join("scan.ply"), points).unwrap();
    let proxy = "points = \"scan.ply\"\npoints_up = \"y\"";
    let file = project(here.path(), "", proxy);
    let photo = opened(&file, &[]);
    run(&photo).unwrap();
    assert_eq!(stale(&photo), "");
    let out = photo.out.join("frames/a").display().to_string();
    let mut frame = opened(&file, &["--out", &out]);
    frame.placed = Some(SCENE.folder(&photo));
    run(&frame).unwrap();
    assert_eq!(stale(&frame), "");
    // The photograph reads the points, the frame what became of them.
    fs::write(here.path().join("scan.ply"), "another").unwrap();
    assert_ne!(stale(&photo), "");
    assert_eq!(stale(&frame), "");
}

#[test]
fn what_earlier_versions_recorded_is_compared_with_defaults_filled_in() {
    // As they were written: keys that were left out are null or absent, limits all or none.
    let left_out = json!({"scene": {
        "background": "a.png", "transfer": null, "class": null, "proxy": null, "effects": {},
        "objects": [{"path": "a.obj", "position": null, "yaw_deg": null}],
    }, "transport": null});
    let written = json!({"scene": {
        "background": "a.png", "transfer": "srgb", "class": "car", "effects": {"shadow": "auto"},
        "objects": [{"path": "a.obj", "position": [0.0, 0.0, 0.0], "yaw_deg": 0.0, "place_draw": 0}],
        "limits": {"triangles": 7, "allow_outside": false},
    }, "transport": null});
    assert_eq!(deciding(left_out), deciding(written.clone()));
    for (key, value) in [
        ("/scene/transfer", json!("linear")),
        ("/scene/objects/0/yaw_deg", json!(1.0)),
        ("/scene/effects/shadow", json!("off")),
        ("/scene/limits/allow_outside", json!(true)),
    ] {
        let mut other = written.clone();
        *other.pointer_mut(key).unwrap() = value;
        assert_ne!(deciding(other), deciding(written.clone()), "{key}");
    }
}
