//! A photograph of a lens that bends lines.
use dipir_imaging::file::read_photo;
use dipir_imaging::layers::Layers;
use dipir_imaging::transfer::Transfer;

use crate::project::*;

const BENT: [&str; 2] = ["-s", "scene.camera.distortion.k1=-0.15"];

#[test]
fn layers_lie_on_the_photograph_as_it_was_taken() {
    let project = Project::new();
    project.run_both(&BENT);
    let layers = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
    assert_eq!((layers.width(), layers.height()), (36, 24));
    let photo = |name: &str| {
        read_photo(project.path(name), Transfer::Srgb)
            .unwrap()
            .values
            .unwrap()
    };
    let (before, after) = (
        photo("background.png"),
        photo("out/composite/composite.png"),
    );
    let alpha = layers.channel("object.A").unwrap();
    let shadow = layers.rgb("shadow").unwrap();
    let (mut kept, mut covered) = (0, 0);
    for n in 0..36 * 24 {
        let untouched = alpha.pixels()[n] == 0.0 && shadow.pixels()[n] == glam::Vec3::ONE;
        if untouched {
            assert_eq!(after.pixels()[n], before.pixels()[n], "pixel {n}");
            kept += 1;
        }
        covered += usize::from(alpha.pixels()[n] > 0.5);
    }
    assert!(kept > 100 && covered > 20, "{kept} {covered}");
    let working = Layers::read_exr(project.path("out/scene/gbuffer.exr")).unwrap();
    let size = |name: &str| {
        let map = Layers::read_exr(project.path(name)).unwrap();
        (map.width(), map.height())
    };
    assert_eq!(size("out/composite/st_distort.exr"), (36, 24));
    assert_eq!(
        size("out/composite/st_undistort.exr"),
        (working.width(), working.height())
    );
    assert!(working.width() > 36);
}

#[test]
fn a_lens_without_distortion_changes_nothing() {
    let [plain, named] = [&[][..], &["-s", "scene.camera.distortion.k1=0.0"][..]].map(|args| {
        let project = Project::new();
        project.run_both(args);
        project.artifacts("out/composite")
    });
    assert_eq!(plain, named);
}
