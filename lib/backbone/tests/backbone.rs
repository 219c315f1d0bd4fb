//! Feature maps against torch's, and properties of any picture.
use dipir_backbone::{Backbone, CHANNELS};
use dipir_imaging::raster::Raster;
use glam::Vec3;
use proptest::prelude::*;

/// The picture of `weights/make.py`.
fn picture(width: usize, height: usize) -> Raster<Vec3> {
    let pixel = |k: usize| {
        let u = ((k % width) as f32 + 0.5) / width as f32;
        let v = ((k / width) as f32 + 0.5) / height as f32;
        let red = 0.5 + 0.5 * (9.0 * u + 4.0 * v * v).sin();
        Vec3::new(red, 0.2 + 0.6 * v, 0.5 + 0.4 * (25.0 * u * v).cos())
    };
    Raster::from_pixels(width, height, (0..width * height).map(pixel).collect())
}

#[test]
fn maps_are_those_of_torch() {
    let backbone = Backbone::embedded();
    let mut lines = include_str!("reference.txt").lines();
    for (width, height) in [(96, 64), (75, 53)] {
        for map in backbone.maps(&picture(width, height)) {
            let numbers = lines.next().unwrap().split(' ').map(|n| n.parse().unwrap());
            let wanted: Vec<f32> = numbers.collect();
            assert_eq!([map.width, map.height].map(|n| n as f32), wanted[..2]);
            let cell = &map.values[(map.width + 2) * map.channels..][..map.channels];
            let found = cell.iter().step_by(8).copied();
            let mean = map.mean();
            let found = found.chain(mean.iter().step_by(8).copied());
            let scale = wanted[2..].iter().fold(0f32, |m, v| m.max(v.abs()));
            let pairs: Vec<(f32, f32)> = found.zip(wanted[2..].iter().copied()).collect();
            assert_eq!(pairs.len(), wanted.len() - 2);
            for (a, b) in pairs {
                // Weights have 11 bits: each of some 30 layers adds a few 1e-4 of its scale.
                assert!((a - b).abs() < 0.01 * scale, "{a} {b}, scale {scale}");
            }
        }
    }
}

#[test]
fn weights_that_do_not_fit_are_refused() {
    let whole = include_bytes!("../weights/lite0.safetensors");
    assert!(Backbone::from_bytes(whole).is_ok());
    assert!(Backbone::from_bytes(&whole[..whole.len() / 2]).is_err());
    let text = String::from_utf8_lossy(whole).find("block.3.project.bias");
    let mut other = whole.to_vec();
    other[text.unwrap()] = b'x';
    let refused = Backbone::from_bytes(&other).err().unwrap().to_string();
    assert!(refused.contains("block.3.project.bias"), "{refused}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn any_picture_has_finite_maps(width in 1usize..90, height in 1usize..90, seed in any::<u32>()) {
        let value = |k: usize| match (k as u32).wrapping_mul(2_654_435_761).wrapping_add(seed) >> 24 {
            0 => f32::NAN,
            1 => f32::INFINITY,
            2 => -3.0,
            n => n as f32 / 255.0,
        };
        let pixel = |k: usize| Vec3::new(value(3 * k), value(3 * k + 1), value(3 * k + 2));
        let picture = Raster::from_pixels(width, height, (0..width * height).map(pixel).collect());
        for ((map, channels), step) in Backbone::embedded().maps(&picture).iter().zip(CHANNELS).zip([16, 32]) {
            prop_assert_eq!(map.channels, channels);
            prop_assert_eq!([map.width, map.height], [width.div_ceil(step), height.div_ceil(step)]);
            prop_assert!(map.values.len() == map.width * map.height * channels);
            prop_assert!(map.values.iter().all(|v| v.is_finite() && v.abs() < 1e3));
        }
    }
}
