//! LPIPS against the package of the paper's authors: reference_lpips.py made the numbers.
use std::collections::HashMap;
use std::path::Path;

use candle_core::{Device, Tensor};
use dipir_evaluation::lpips::Lpips;
use dipir_imaging::file::read_photo;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_imaging::transfer::Transfer;

/// Name, outputs, inputs and side of each convolution.
const LAYERS: [(&str, usize, usize, usize); 5] = [
    ("net.slice1.0", 64, 3, 11),
    ("net.slice2.3", 192, 64, 5),
    ("net.slice3.6", 384, 192, 3),
    ("net.slice4.8", 256, 384, 3),
    ("net.slice5.10", 256, 256, 3),
];

/// Numbers in [-0.5, 0.5), as reference_lpips.py has them.
fn noise(count: usize, seed: u64) -> Vec<f32> {
    (0..count as u64)
        .map(|i| {
            let mut h = ((i + seed * 1_000_003) * 2_654_435_761) & 0xffff_ffff;
            h = ((h ^ (h >> 15)) * 2_246_822_519) & 0xffff_ffff;
            h ^= h >> 13;
            (h as f64 / 4_294_967_296.0 - 0.5) as f32
        })
        .collect()
}

/// What reference_lpips.py prints.
const CHANGED: f64 = 0.740_909_338;
const MIRRORED: f64 = 0.938_643_694;

fn weights(path: &Path) {
    let mut tensors = HashMap::new();
    let mut add = |name: String, shape: &[usize], values: Vec<f32>| {
        let tensor = Tensor::from_vec(values, shape, &Device::Cpu).unwrap();
        tensors.insert(name, tensor);
    };
    for (k, (name, out, inputs, side)) in LAYERS.into_iter().enumerate() {
        let (fan_in, seed) = (inputs * side * side, 3 * k as u64);
        let gain = (24.0 / fan_in as f64).sqrt() as f32;
        let scaled = |v: Vec<f32>, by: f32| v.into_iter().map(|v| v * by).collect();
        add(
            format!("{name}.weight"),
            &[out, inputs, side, side],
            scaled(noise(out * fan_in, seed), gain),
        );
        add(
            format!("{name}.bias"),
            &[out],
            scaled(noise(out, seed + 1), 0.2),
        );
        let positive = noise(out, seed + 2).into_iter().map(|v| v + 0.5).collect();
        add(format!("lin{k}.model.1.weight"), &[1, out, 1, 1], positive);
    }
    candle_core::safetensors::save(&tensors, path).unwrap();
}

fn picture(name: &str) -> DisplayImage {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../imaging/tests/pictures");
    let photo = read_photo(folder.join(name), Transfer::Srgb).unwrap();
    Transfer::Srgb.encode(&photo.image)
}

fn mirrored(image: &DisplayImage) -> DisplayImage {
    let (width, height) = (image.0.width(), image.0.height());
    let rows = image.0.pixels().chunks(width);
    let pixels = rows.flat_map(|row| row.iter().rev().copied()).collect();
    DisplayImage(Raster::from_pixels(width, height, pixels))
}

#[test]
fn distances_are_those_of_the_authors() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("alex.safetensors");
    weights(&path);
    let network = Lpips::load(&path).unwrap();
    let [changed, reference] = ["changed.png", "reference.png"].map(picture);
    let close = |found: f64, expected: f64| {
        assert!(
            (found / expected - 1.0).abs() < 1e-4,
            "{found}, expected {expected}"
        );
    };
    close(network.distance(&changed, &reference).unwrap(), CHANGED);
    close(network.distance(&reference, &changed).unwrap(), CHANGED);
    let mirror = mirrored(&reference);
    close(network.distance(&reference, &mirror).unwrap(), MIRRORED);
}
