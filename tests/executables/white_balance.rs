//! Frames whose white balance is not the photograph's.
use dipir_imaging::file::write_png;
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use glam::Vec3;
use serde_json::Value;

use crate::project::{DIPIR, Project};
use crate::shot::{project, shot};

#[test]
fn frames_of_another_white_balance_get_light_of_that_tint() {
    let project = project();
    // Ground and sky of many shades and some colours; `white` are the gains of the channels.
    let frame = |name: &str, white: Vec3, painted: Option<Vec3>| {
        let value = |n: usize| {
            let (x, y) = (n % 96, n / 96);
            let shade = 0.05 + 0.1 * ((x / 6 * 37 + y / 6 * 101) % 17) as f32 / 17.0;
            let colours = [
                Vec3::ONE,
                Vec3::new(1.3, 1.0, 0.7),
                Vec3::new(0.8, 1.0, 1.2),
            ];
            let colour = match painted {
                Some(paint) if x < 30 => paint,
                _ => colours[(x / 12 + y / 12) % 3],
            };
            let light = shade * colour * white;
            light / (Vec3::ONE + light)
        };
        let pixels = (0..96 * 64).map(value).collect();
        let image = LinearImage(Raster::from_pixels(96, 64, pixels));
        write_png(project.path(name), &Transfer::Srgb.encode(&image)).unwrap();
    };
    let white = Vec3::new(1.15, 1.0, 0.85);
    frame("f_0.png", Vec3::ONE, None);
    frame("f_1.png", white, None);
    frame("f_2.png", Vec3::splat(1.4), None);
    // A red car as bright as what it hides.
    frame("f_3.png", Vec3::ONE, Some(Vec3::new(2.0, 0.75, 0.6)));
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("pipeline.toml", text.replace("background.png", "f_0.png"));
    let tint = |k: usize| {
        let manifest = format!("out/frames/f_{k}/composite/stage.json");
        let value: Value = serde_json::from_slice(&project.read(&manifest)).unwrap();
        value["params"]["light"]["tint"].clone()
    };
    let all = ["f_1.png", "f_2.png", "f_3.png"];
    shot(&project, &all);
    let luma = Vec3::new(0.2126, 0.7152, 0.0722);
    let stops = (white / white.dot(luma)).map(f32::log2);
    // Of .05 stops beside the largest the square does not count. Half a step of 8 bits is .02 stops of the darkest channel
    // here, and the mean of all is closer.
    let part = 0.05 / stops.abs().max_element();
    let wanted = (1.0 - part * part) * stops;
    let told = Vec3::from(serde_json::from_value::<[f32; 3]>(tint(1)).unwrap());
    assert!(
        (told - wanted).abs().max_element() < 0.02,
        "{told} {wanted}"
    );
    assert_eq!([2, 3].map(tint), [Value::Null, Value::Null]);
    shot(&project, &["f_1.png", "--same-exposure"]);
    assert_eq!(tint(1), Value::Null);
    // What the configuration says is added to.
    shot(
        &project,
        &["f_1.png", "--set", "composite.tint=[0.5, 0.0, 0.0]"],
    );
    let more = Vec3::from(serde_json::from_value::<[f32; 3]>(tint(1)).unwrap());
    // Rounded to a thousandth.
    assert!((more - told - Vec3::new(0.5, 0.0, 0.0)).abs().max_element() < 2e-3);
}

#[test]
fn a_tint_is_that_of_the_light() {
    for (name, project) in [("map", Project::new()), ("estimate", project())] {
        let lit = |tint: &str| {
            let tint = format!("composite.tint={tint}");
            let mut set = vec!["run", "-q", "--set", &tint, "--set", "composite.tone=none"];
            set.extend(["--set", "composite.target_error=0.005"]);
            project.run(DIPIR, &set).expect_success();
            let layers = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
            let object = layers.rgb("object").unwrap();
            object.pixels().iter().sum::<Vec3>()
        };
        let (white, tinted) = (lit("[0, 0, 0]"), lit("[1, 0, -1]"));
        let stops = (tinted / white).map(f32::log2);
        // Noise of .005 in single pixels, most of which are above .1, is below .1 stops of their sum.
        let off = (stops - Vec3::new(1.0, 0.0, -1.0)).abs().max_element();
        assert!(off < 0.1, "{name}: {stops}");
        let refused = project.run(DIPIR, &["run", "--set", "composite.tint=[0, 9, 0]"]);
        let wanted = "composite.tint: [0.0, 9.0, 0.0] is out of range; accepted: three numbers of stops from -8 to 8";
        assert!(refused.stderr.contains(wanted), "{}", refused.stderr);
    }
}
