//! Blur and grain of the photograph on the object.
use dipir_imaging::file::{read_photo, write_png};
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_imaging::transfer::Transfer;
use glam::Vec3;
use serde_json::Value;

use crate::project::*;

const SIZE: [usize; 2] = [320, 240];
const NEITHER: [&str; 4] = [
    "-s",
    "composite.match_blur=false",
    "-s",
    "composite.match_grain=false",
];

/// Slanted bars on soft gradients, edges of deviation `blur_px`, noise of deviation `noise` on all of it.
fn write_photograph(project: &Project, blur_px: f32, noise: f32) {
    let mut state = 1u32;
    // Nearly normal: four of a uniform distribution, of variance 1/12 each.
    let mut normal = || {
        let draws = (0..4).map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1u32 << 24) as f32 - 0.5
        });
        draws.sum::<f32>() * 3f32.sqrt()
    };
    let pixels = (0..SIZE[0] * SIZE[1]).map(|n| {
        let (x, y) = ((n % SIZE[0]) as f32, (n / SIZE[0]) as f32);
        let along = ((x + 0.4 * y) / 1f32.hypot(0.4)).rem_euclid(160.0) - 80.0;
        let from_edge = (40.0 - along.abs()) / blur_px;
        // The logistic curve that is as steep as the integral of a Gaussian. Light is blurred, not display values.
        let bar = 1.0 / (1.0 + (-1.596 * from_edge).exp());
        let base = Transfer::Srgb.encode_scalar(0.03 + 0.02 * y / 240.0 + 0.6 * bar);
        Vec3::new(
            base + noise * normal(),
            base + noise * normal(),
            base + noise * normal(),
        )
    });
    let pixels: Vec<Vec3> = pixels.map(|p| p.clamp(Vec3::ZERO, Vec3::ONE)).collect();
    let photo = DisplayImage(Raster::from_pixels(SIZE[0], SIZE[1], pixels));
    write_png(project.path("background.png"), &photo).unwrap();
}

fn look(project: &Project) -> Value {
    serde_json::from_slice(&project.read("out/composite/look.json")).unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

#[test]
fn the_object_gets_the_photographs_blur_and_grain() {
    let project = Project::new();
    write_photograph(&project, 1.5, 0.03);
    project.run_both(&NEITHER);
    let values = |name: &str| {
        let photo = read_photo(project.path(name), Transfer::Srgb).unwrap();
        photo.values.unwrap()
    };
    let plain = values("out/composite/composite.png");
    project.run(COMPOSITE, &NEITHER[..2]).expect_success();
    let grainy = values("out/composite/composite.png");
    project.run(COMPOSITE, &[]).expect_success();
    let (photo, matched) = (
        values("background.png"),
        values("out/composite/composite.png"),
    );
    let found = look(&project);
    // Noise makes edges look sharper, never softer.
    let edges = number(&found["edge_blur_px"]);
    assert!(edges > 0.8 && edges < 1.6, "{found}");
    for c in 0..3 {
        // The median of white noise in some hundred patches, each known to 3%.
        let grain = number(&found["grain"][c]);
        assert!((grain / 0.03 - 1.0).abs() < 0.1, "{found}");
    }
    let layers = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
    let alpha = layers.channel("object.A").unwrap();
    let [object, shadow, background, picture] =
        ["object", "shadow", "background", ""].map(|name| layers.rgb(name).unwrap());
    let (mut kept, mut squares, mut covered) = (0, 0.0, 0);
    for n in 0..SIZE[0] * SIZE[1] {
        let a = alpha.pixels()[n];
        let (o, s) = (object.pixels()[n], shadow.pixels()[n]);
        let again = background.pixels()[n] * s * (1.0 - a) + o;
        // Half precision has 11 bits, and rounds each layer once.
        let off = (again - picture.pixels()[n]).abs().max_element();
        assert!(
            off <= 2e-3 * picture.pixels()[n].max_element().max(0.01),
            "{n} {off}"
        );
        if a == 0.0 && s == Vec3::ONE {
            assert_eq!(matched.pixels()[n], photo.pixels()[n], "pixel {n}");
            kept += 1;
        }
        if a == 1.0 {
            let off = f64::from(grainy.pixels()[n][1]) - f64::from(plain.pixels()[n][1]);
            squares += off * off / 255.0 / 255.0;
            covered += 1;
        }
    }
    assert!(kept > 10_000 && covered > 1_000, "{kept} {covered}");
    // As measured to a tenth, of a field of as little as 1,000 pixels, known to 2%; rounding adds a thousandth.
    let deviation = (squares / f64::from(covered)).sqrt();
    assert!((deviation / 0.03 - 1.0).abs() < 0.15, "{deviation}");
}

#[test]
fn a_soft_photograph_without_noise_blurs_the_object_alone_and_takes_fewer_pixels() {
    let project = Project::new();
    write_photograph(&project, 1.5, 0.0);
    project.run(SCENE, &[]).expect_success();
    let error = "composite.target_error=0.004";
    let picture = |args: &[&str]| {
        let run = project.run(COMPOSITE, &[&["-s", error], args].concat());
        run.expect_success();
        let picture = read_photo(project.path("out/composite/composite.png"), Transfer::Srgb);
        (picture.unwrap().values.unwrap(), run.stdout, look(&project))
    };
    let (half, said, found) = picture(&[]);
    assert!(
        said.contains("1/2 of the photograph's resolution, enlarged: no softer"),
        "{said}"
    );
    // With the area of a pixel; the logistic curve is not quite the integral of a Gaussian.
    let expected = 1.5f64.hypot((1.0f64 / 12.0).sqrt());
    assert!(
        (number(&found["edge_blur_px"]) / expected - 1.0).abs() < 0.1,
        "{found}"
    );
    assert!(
        number(&found["blur_px"]) > 1.0 && found["grain"].is_null(),
        "{found}"
    );
    let (whole, said, found) = picture(&["-s", "composite.most_pixels=1000000"]);
    assert!(
        !said.contains("resolution") && number(&found["blur_px"]) > 1.3,
        "{said}"
    );
    let (high, said, _) = picture(&["-s", "pipeline.quality=high"]);
    assert!(!said.contains("resolution"), "{said}");
    // Each has noise of .004 and is rounded by .001, which makes .006; and the same blur in another shape at edges.
    for other in [&whole, &high] {
        let pairs = half.pixels().iter().zip(other.pixels());
        let (mut squares, mut touched) = (0.0, 0);
        for (a, b) in pairs.filter(|(a, b)| a != b) {
            squares += (0..3)
                .map(|c| (f64::from(a[c]) - f64::from(b[c])).powi(2))
                .sum::<f64>();
            touched += 3;
        }
        let off = (squares / f64::from(touched)).sqrt() / 255.0;
        assert!(off < 0.012, "{off}");
    }
}

#[test]
fn a_sharp_photograph_without_noise_changes_nothing() {
    let project = Project::new();
    write_photograph(&project, 0.3, 0.0);
    project.run_both(&[]);
    let [own, neither] = [&[][..], &NEITHER[..]].map(|args| {
        project.run(COMPOSITE, args).expect_success();
        assert!(look(&project)["blur_px"].is_null() && look(&project)["grain"].is_null());
        ["composite.png", "composite.exr"].map(|f| project.read(&format!("out/composite/{f}")))
    });
    assert_eq!(own, neither);
}

#[test]
fn a_very_soft_photograph_is_matched_and_one_that_tells_nothing_is_named() {
    let project = Project::new();
    write_photograph(&project, 4.0, 0.0);
    project.run_both(&[]);
    let found = look(&project);
    // A tenth as of steps blurred by a Gaussian, and the logistic curve is not quite its integral.
    assert!(
        (number(&found["edge_blur_px"]) / 4.0 - 1.0).abs() < 0.15,
        "{found}"
    );
    assert!(number(&found["blur_px"]) > 2.0, "{found}");
    write_photograph(&project, 100.0, 0.0);
    project.run(SCENE, &[]).expect_success();
    let run = project.run(COMPOSITE, &[]);
    run.expect_success();
    let unknown = "too few clear edges to tell how soft it is";
    assert!(run.stdout.contains(unknown), "{}", run.stdout);
    assert!(look(&project)["edge_blur_px"].is_null());
    let run = project.run(COMPOSITE, &NEITHER[..2]);
    run.expect_success();
    assert!(!run.stdout.contains(unknown), "{}", run.stdout);
}
