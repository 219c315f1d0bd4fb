//! The object's mirror image in polished ground.
use dipir_imaging::layers::Layers;
use glam::Vec3;

use crate::project::*;

const POLISHED: [&str; 4] = [
    "--set",
    "composite.ground_roughness=0.1",
    "--set",
    "composite.ground_reflectance=0.5",
];

#[test]
fn the_mirror_image_is_in_the_layers_and_takes_the_composite_alone() {
    let project = Project::new();
    project.run_both(&[]);
    let layers = |name: &str| {
        let layers = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
        layers.rgb(name).unwrap()
    };
    let matt = layers("");
    let run = project.run(DIPIR, &[&["run"], &POLISHED[..]].concat());
    run.expect_success();
    assert!(run.stdout.contains("ran composite"), "{}", run.stdout);
    assert!(!run.stdout.contains("ran scene"), "{}", run.stdout);
    let file = project.read("out/composite/composite.exr");
    let all = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
    let alpha = all.channel("object.A").unwrap();
    let [object, shadow, background, picture] = ["object", "shadow", "background", ""].map(layers);
    let (mut added, mut changed) = (0, 0);
    for i in 0..36 * 24 {
        let a = alpha.pixels()[i];
        let again = background.pixels()[i] * shadow.pixels()[i] * (1.0 - a) + object.pixels()[i];
        // Half precision has 11 bits, and rounds each layer once.
        let off = (again - picture.pixels()[i]).abs().max_element();
        assert!(
            off <= 2e-3 * picture.pixels()[i].max_element().max(0.01),
            "{i} {off}"
        );
        if a == 0.0 {
            added += usize::from(object.pixels()[i] != Vec3::ZERO);
            changed +=
                usize::from((picture.pixels()[i] - matt.pixels()[i]).abs().max_element() > 0.02);
        }
    }
    assert!(added > 20 && changed > 20, "{added} {changed}");
    // By any number of threads, and again.
    let run = project.run(COMPOSITE, &[&["-j", "1"], &POLISHED[..]].concat());
    run.expect_success();
    assert_eq!(project.read("out/composite/composite.exr"), file);
}

#[test]
fn what_is_no_polished_plane_is_refused_or_told() {
    let project = Project::new();
    for (set, message) in [
        (
            "composite.ground_roughness=1.5",
            "error: --set composite.ground_roughness=1.5: composite.ground_roughness: 1.5 is out of range; accepted: 0, a mirror, to 1, as in 0.15",
        ),
        (
            "composite.ground_reflectance=0.02",
            "error: --set composite.ground_reflectance=0.02: composite.ground_reflectance: is about polished ground; say how rough it is, too: ground_roughness = 0.15",
        ),
    ] {
        let run = project.run(DIPIR, &["run", "--set", set]);
        run.expect_error(2, message);
    }
    let both = [
        "run",
        "--set",
        "composite.ground_roughness=0",
        "--set",
        "composite.ground_reflectance=0",
    ];
    let accepted = "error: --set composite.ground_reflectance=0: composite.ground_reflectance: 0 is out of range; accepted: a share above 0, at most 1, as in 0.04";
    project.run(DIPIR, &both).expect_error(2, accepted);
    project.write("floor.obj", "v -9 0 9\nv 9 0 9\nv 0 0 -9\nf 1 2 3\n");
    let pipeline = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let plane = "plane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }";
    project.write(
        "pipeline.toml",
        pipeline.replace(plane, "mesh = \"floor.obj\""),
    );
    let run = project.run(DIPIR, &[&["run"], &POLISHED[..]].concat());
    run.expect_success();
    let told = "composite.ground_roughness: only a plane mirrors the objects, and [scene.proxy] is not one";
    assert!(run.stderr.contains(told), "{}", run.stderr);
}
