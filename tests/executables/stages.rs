//! What the stages write, and how they hand over to each other.
use dipir_imaging::layers::Layers;
use dipir_pipeline::manifest::Manifest;
use glam::{DVec3, Vec3};
use serde_json::Value;

use crate::project::*;

fn json(project: &Project, name: &str) -> Value {
    serde_json::from_slice(&project.read(name)).unwrap()
}

#[test]
fn layers_rebuild_the_beauty_to_half_precision() {
    let project = Project::new();
    project.run_both(&[]);
    let layers = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
    let get = |layer: &str| layers.rgb(layer).unwrap();
    let (beauty, object) = (get(""), get("object"));
    let (shadow, background) = (get("shadow"), get("background"));
    let alpha = layers.channel("object.A").unwrap();
    let mut touched = 0;
    for n in 0..36 * 24 {
        let a = alpha.pixels()[n];
        let rebuilt = background.pixels()[n] * shadow.pixels()[n] * (1.0 - a) + object.pixels()[n];
        // Half precision rounds the background and the beauty by at most 2^-11 each; values
        // below 2^-14 are stored in steps of 2^-24.
        let bound = 2.0 * rebuilt.abs() / 2048.0 + 2f32.powi(-24);
        let difference = (rebuilt - beauty.pixels()[n]).abs();
        assert!(
            difference.cmple(bound).all(),
            "pixel {n}: {difference} above {bound}"
        );
        touched += usize::from(a > 0.0);
    }
    assert!(touched > 20, "the object is in the picture");
    for name in [
        "A", "depth.Z", "normal.X", "normal.Z", "albedo.R", "shadow.B",
    ] {
        assert!(layers.contains(name), "{name}");
    }
    let depth = layers.channel("depth.Z").unwrap().get(18, 12);
    assert!(
        (2.0..5.0).contains(depth),
        "the object is about 4 m away, not {depth}"
    );
}

#[test]
fn the_scene_stage_writes_what_the_others_read() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    let effects = json(&project, "out/scene/effects.json");
    let names: Vec<&str> = effects["effects"]
        .as_array()
        .unwrap()
        .iter()
        .map(|e| e["name"].as_str().unwrap())
        .collect();
    assert_eq!(names.len(), 14);
    assert!(effects["max_depth"].is_u64() && effects["rays"]["camera"].is_u64());
    let gbuffer = Layers::read_exr(project.path("out/scene/gbuffer.exr")).unwrap();
    for name in ["depth.Z", "normal.Y", "albedo.G", "object.A", "proxy.A"] {
        assert!(gbuffer.contains(name), "{name}");
    }
    let manifest = Manifest::read(&project.path("out/scene"), "").unwrap();
    let roles: Vec<&str> = manifest.inputs.iter().map(|a| a.role.as_str()).collect();
    assert!(
        roles.contains(&"background") && roles.contains(&"object"),
        "{roles:?}"
    );
    // Which effects show is found by the composite, under the light that it has.
    assert!(!roles.contains(&"environment"), "{roles:?}");
    assert!(manifest.elapsed_s > 0.0);
    assert_eq!(manifest.damages(&project.path("out/scene")).unwrap(), []);
}

#[test]
fn an_effect_that_is_switched_off_costs_no_ray() {
    let project = Project::new();
    project
        .run(SCENE, &["--set", "scene.effects.shadow=off"])
        .expect_success();
    project.run(COMPOSITE, &[]).expect_success();
    let effects = json(&project, "out/composite/effects.json");
    assert_eq!(effects["rays"]["shadow"], 0);
    assert!(effects["rays"]["camera"].as_u64() > Some(0));
    let layers = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
    assert!(
        layers
            .channel("shadow.G")
            .unwrap()
            .pixels()
            .iter()
            .all(|&s| s == 1.0)
    );
}

#[test]
fn the_composite_says_what_effects_contribute_unless_everything_is_simulated() {
    let project = Project::new();
    let effects = |more: &[&str]| {
        project.run(SCENE, more).expect_success();
        project.run(COMPOSITE, more).expect_success();
        json(&project, "out/composite/effects.json")
    };
    let contribution = |effects: &serde_json::Value, name: &str| {
        let mut all = effects["effects"].as_array().unwrap().iter();
        all.find(|e| e["name"] == name).unwrap()["contribution"].as_f64()
    };
    let planned = effects(&[]);
    assert!(contribution(&planned, "shadow") > Some(0.01), "{planned}");
    let bound = planned["left_out_upper_95"].as_f64().unwrap();
    assert!(bound <= planned["tolerance"].as_f64().unwrap(), "{planned}");
    let all = effects(&["--set", "scene.effects.mode=all"]);
    assert_eq!(contribution(&all, "shadow"), None);
    assert_eq!(all["left_out"].as_f64(), None);
}

#[test]
fn a_scene_set_up_with_other_settings_is_warned_of() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    let run = project.run(COMPOSITE, &["--set", "scene.camera.fov_deg=50"]);
    run.expect_success();
    assert_eq!(
        run.stderr.trim_end(),
        "warning: the scene was set up with other settings (scene.camera.fov_deg changed from 40.0 \
         to 50.0); run dipir-scene again to use the new ones"
    );
}

#[test]
fn an_input_that_changed_since_the_scene_was_set_up_is_refused() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    project.write("object.obj", OBJECT.replace("1.1", "1.3"));
    let run = project.run(COMPOSITE, &[]);
    assert_eq!(run.code, Some(1));
    assert!(
        run.stderr
            .contains("object.obj\" changed since the scene was set up"),
        "{}",
        run.stderr
    );
    assert!(
        run.stderr.contains("run dipir-scene again"),
        "{}",
        run.stderr
    );
}

#[test]
fn a_damaged_artifact_is_named_before_it_is_used() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    let mut bytes = project.read("out/scene/gbuffer.exr");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    project.write("out/scene/gbuffer.exr", bytes);
    let run = project.run(COMPOSITE, &[]);
    assert_eq!(run.code, Some(1));
    let start = "error: out/scene/gbuffer.exr: damaged: its BLAKE3 hash is ";
    assert!(run.stderr.starts_with(start), "{}", run.stderr);
    assert!(
        run.stderr.contains("run the stage \"scene\" again"),
        "{}",
        run.stderr
    );
}

#[test]
fn reinhards_curve_darkens_the_object_and_leaves_the_photo() {
    let project = Project::new();
    project.run_both(&[]);
    let plain = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
    project
        .run(COMPOSITE, &["--set", "composite.tone=reinhard"])
        .expect_success();
    let toned = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
    let sum = |layers: &Layers, name: &str| -> f32 {
        layers.channel(name).unwrap().pixels().iter().sum()
    };
    assert!(sum(&toned, "object.G") < 0.9 * sum(&plain, "object.G"));
    assert_eq!(sum(&toned, "shadow.G"), sum(&plain, "shadow.G"));
}

#[test]
fn a_mask_of_the_photos_foreground_hides_the_object() {
    let project = Project::new();
    let white = dipir_imaging::raster::Raster::filled(36, 24, 1.0);
    dipir_imaging::file::write_png_mask(project.path("mask.png"), &white).unwrap();
    project.run_both(&["--set", "scene.occluders=mask.png"]);
    let layers = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
    assert_eq!(layers.rgb("").unwrap(), layers.rgb("background").unwrap());
}

/// Depths that the project's camera sees, as a network gives them: brightest where it is nearest, in shades. A fence
/// stands in the left half, 2 m away, before the object.
fn shades(fence_m: f64) -> image::GrayImage {
    let (eye, to) = (DVec3::new(0.0, 1.2, 4.0), DVec3::new(0.0, 0.4, 0.0));
    let ahead = (to - eye).normalize();
    let right = ahead.cross(DVec3::Y).normalize();
    let up = right.cross(ahead);
    let pixel_m = 20f64.to_radians().tan() / 12.0;
    image::GrayImage::from_fn(36, 24, |x, y| {
        let at = |i: u32, n: f64| (f64::from(i) + 0.5 - 0.5 * n) * pixel_m;
        let direction = ahead + right * at(x, 36.0) - up * at(y, 24.0);
        // One over the depth of the ground; above the horizon nothing is near.
        let ground = (-direction.y / eye.y).max(0.0);
        let fence = if x < 18 { 1.0 / fence_m } else { 0.0 };
        image::Luma([(400.0 * ground.max(fence) + 20.0).round() as u8])
    })
}

#[test]
fn what_is_nearer_by_the_depths_hides_object_and_shadow() {
    let project = Project::new();
    let depth = project.path("depth.png");
    shades(2.0).save(&depth).unwrap();
    let set = ["--set", "scene.depth=depth.png"];
    let scene = project.run(SCENE, &set);
    scene.expect_success();
    let said = "  depth: disparities; ";
    assert!(scene.stdout.contains(said), "{}", scene.stdout);
    let found = &json(&project, "out/scene/scene.json")["depth"]["found"];
    assert_eq!(found["measure"], "disparity");
    project.run(COMPOSITE, &set).expect_success();
    // Where the two halves meet, the mask is soft.
    let differs = |columns: std::ops::Range<usize>| {
        let layers = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
        let [made, photo] = ["", "background"].map(|name| layers.rgb(name).unwrap());
        let pixels = (0..24).flat_map(|y| columns.clone().map(move |x| (x, y)));
        pixels
            .filter(|&(x, y)| (*made.get(x, y) - *photo.get(x, y)).abs().max_element() > 0.005)
            .count()
    };
    // The fence catches what little light the object sends there.
    assert_eq!(differs(0..14), 0);
    let seen = differs(22..36);
    assert!(seen > 20, "{seen}");
    // A fence behind the object hides only what is of the ground beyond it.
    shades(5.5).save(&depth).unwrap();
    project
        .run(DIPIR, &[&["run"][..], &set].concat())
        .expect_success();
    assert!(differs(0..18) > 20, "{}", differs(0..18));
    assert!(differs(22..36) >= seen);
    // The fence catches the object's shadow.
    let shaded = || {
        let layers = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
        let [shadow, alpha] = [layers.rgb("shadow").unwrap(), layers.rgb("object").unwrap()];
        let pixels = (0..24).flat_map(|y| (0..17).map(move |x| (x, y)));
        let shaded = pixels.filter(|&(x, y)| {
            *alpha.get(x, y) == Vec3::ZERO && shadow.get(x, y).max_element() < 0.99
        });
        shaded.count()
    };
    let on_fence = shaded();
    let none = [&["run"][..], &set, &["--set", "scene.depth_surfaces=false"]].concat();
    project.run(DIPIR, &none).expect_success();
    assert!(on_fence > shaded() + 10, "{on_fence} {}", shaded());
    project
        .run(DIPIR, &[&["run"][..], &set].concat())
        .expect_success();
    // Of another picture: refused, with what was made before untouched.
    let before = project.artifacts("out/scene");
    let noise = image::GrayImage::from_fn(36, 24, |x, y| image::Luma([(x * 97 + y * 57) as u8]));
    noise.save(&depth).unwrap();
    let refused = project.run(SCENE, &set);
    assert_eq!(refused.code, Some(1), "{}", refused.stderr);
    for part in [
        "depth.png",
        "of its values follow the ground",
        "depth_scale",
    ] {
        assert!(refused.stderr.contains(part), "{}", refused.stderr);
    }
    assert_eq!(project.artifacts("out/scene"), before);
}

#[test]
fn what_a_stage_or_a_later_one_writes_is_no_input_of_it() {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let text = text.replace("environment = \"sky.exr\"\n", "");
    project.write("pipeline.toml", text);
    project.run(DIPIR, &["run", "-q"]).expect_success();
    let own = ["--set", "light.start=out/light/lighting.json"];
    let refused = "error: the start \"out/light/lighting.json\" is written by the stage light, and a run would replace \
                   it: copy it elsewhere and name the copy";
    project.run(OPTIMIZE, &own).expect_error(2, refused);
    for command in ["run", "status"] {
        let run = project.run(DIPIR, &[&[command][..], &own].concat());
        run.expect_error(2, refused);
    }
    let later = ["--set", "scene.background=./out/composite/composite.png"];
    let run = project.run(SCENE, &later);
    assert_eq!(run.code, Some(2));
    assert!(
        run.stderr.contains("is written by the stage composite"),
        "{}",
        run.stderr
    );
    // What an earlier stage writes may be named, and what is a copy.
    let earlier = [
        "status",
        "--set",
        "composite.environment=out/light/environment.exr",
    ];
    project.run(DIPIR, &earlier).expect_success();
    project.write("lighting.json", project.read("out/light/lighting.json"));
    project
        .run(OPTIMIZE, &["--set", "light.start=lighting.json"])
        .expect_success();
}
