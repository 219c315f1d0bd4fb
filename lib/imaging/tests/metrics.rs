//! Metrics on pictures of this folder against other implementations; `metrics.py` prints the numbers.
use dipir_imaging::file::read_photo;
use dipir_imaging::metrics::{rmse, si_rmse, ssim};
use dipir_imaging::raster::Raster;
use dipir_imaging::transfer::Transfer;
use glam::Vec3;

/// Display values of a picture: what its bytes say, over 255.
fn picture(name: &str) -> Raster<Vec3> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/pictures");
    let photo = read_photo(format!("{folder}/{name}.png"), Transfer::Linear);
    photo.expect("a committed picture").image.0
}

/// Values in f32 are off by 3e-8 of themselves at most; the references run in f64.
const TOLERANCE: f64 = 1e-6;

#[test]
fn metrics_equal_scikit_image_and_least_squares() {
    let (changed, reference) = (picture("changed"), picture("reference"));
    let found = [
        ("ssim", ssim(&changed, &reference), 0.773_053_598_972_574_5),
        ("rmse", rmse(&changed, &reference), 0.110_811_254_364_006_89),
        (
            "si_rmse",
            si_rmse(&changed, &reference),
            0.063_961_686_123_298_2,
        ),
        (
            "si_rmse, swapped",
            si_rmse(&reference, &changed),
            0.053_220_126_996_876_32,
        ),
    ];
    for (name, got, want) in found {
        assert!((got - want).abs() < TOLERANCE, "{name}: {got}, not {want}");
    }
}
