//! Feature maps against torch's, and properties of any picture.
use std::collections::BTreeMap;

use dipir_backbone::{Backbone, CHANNELS, TUNED_FROM, Tuned};
use dipir_imaging::raster::Raster;
use glam::Vec3;
use proptest::prelude::*;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};

/// The file that is built into the program.
const WHOLE: &[u8] = include_bytes!("../weights/lite0.safetensors");

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
    assert!(Backbone::from_bytes(WHOLE).is_ok());
    assert!(Backbone::from_bytes(&WHOLE[..WHOLE.len() / 2]).is_err());
    let text = String::from_utf8_lossy(WHOLE).find("block.3.project.bias");
    let mut other = WHOLE.to_vec();
    other[text.unwrap()] = b'x';
    let refused = Backbone::from_bytes(&other).err().unwrap().to_string();
    assert!(refused.contains("block.3.project.bias"), "{refused}");
}

/// Tensors by name: type, shape, bytes.
type Stored = BTreeMap<String, (Dtype, Vec<usize>, Vec<u8>)>;

fn stored(bytes: &[u8]) -> Stored {
    let file = SafeTensors::deserialize(bytes).unwrap();
    let one = |(name, t): (String, TensorView<'_>)| {
        (name, (t.dtype(), t.shape().to_vec(), t.data().to_vec()))
    };
    file.tensors().into_iter().map(one).collect()
}

fn bytes(tensors: &Stored) -> Vec<u8> {
    let views = tensors.iter().map(|(name, (kind, shape, data))| {
        let view = TensorView::new(*kind, shape.clone(), data).unwrap();
        (name.clone(), view)
    });
    safetensors::serialize(views, None).unwrap()
}

/// A tuning whose scales are powers of two, and the network with the same scales in its weights: exact in half precision.
fn tuned_twice() -> (Stored, Vec<u8>) {
    let (mut tuning, mut network) = (Stored::new(), stored(WHOLE));
    let number = |n: usize| n.wrapping_mul(2_654_435_761) >> 7;
    let names: Vec<String> = network.keys().cloned().collect();
    for name in names.iter().filter_map(|n| n.strip_suffix(".bias")) {
        let block = name.split('.').nth(1).and_then(|n| n.parse::<usize>().ok());
        if block.is_none_or(|n| n < TUNED_FROM) {
            continue;
        }
        let (_, shape, bias) = network[&format!("{name}.bias")].clone();
        let scale: Vec<f32> = (0..shape[0])
            .map(|k| [0.5, 1.0, 2.0][number(k) % 3])
            .collect();
        let moved: Vec<u8> = bias
            .chunks_exact(4)
            .enumerate()
            .map(|(k, b)| f32::from_le_bytes(b.try_into().unwrap()) + 0.1 * (number(k) % 5) as f32)
            .flat_map(f32::to_le_bytes)
            .collect();
        let factors = scale.iter().flat_map(|s| s.to_le_bytes()).collect();
        tuning.insert(
            format!("t.{name}.scale"),
            (Dtype::F32, shape.clone(), factors),
        );
        tuning.insert(format!("t.{name}.bias"), (Dtype::F32, shape, moved.clone()));
        network.get_mut(&format!("{name}.bias")).unwrap().2 = moved;
        let weight = &mut network.get_mut(&format!("{name}.weight")).unwrap().2;
        for (k, w) in weight.chunks_exact_mut(2).enumerate() {
            let value = half::f16::from_le_bytes([w[0], w[1]]).to_f32() * scale[k % scale.len()];
            w.copy_from_slice(&half::f16::from_f32(value).to_le_bytes());
        }
    }
    (tuning, bytes(&network))
}

#[test]
fn a_tuning_is_a_network_with_other_weights() {
    let (tuning, network) = tuned_twice();
    let file = bytes(&tuning);
    let file = SafeTensors::deserialize(&file).unwrap();
    let tuned = Tuned::read(&file, "t").unwrap().unwrap();
    assert!(Tuned::read(&file, "other").unwrap().is_none());
    let names: Vec<String> = tuned.tensors("t").into_iter().map(|t| t.0).collect();
    assert_eq!(names.len(), tuning.len());
    let (base, picture) = (Backbone::embedded(), picture(96, 64));
    let found = base.maps_behind(base.front(&picture), Some(&tuned));
    let wanted = Backbone::from_bytes(&network).unwrap().maps(&picture);
    let plain = base.maps(&picture);
    for ((found, wanted), plain) in found.iter().zip(&wanted).zip(&plain) {
        let largest = |a: &[f32], b: &[f32]| {
            let off = a.iter().zip(b).map(|(a, b)| (a - b).abs());
            off.fold(0f32, f32::max)
        };
        let scale = wanted.values.iter().fold(0f32, |m, v| m.max(v.abs()));
        // Weights below the normal numbers of half precision round when they are halved: 2^-25 in sums of 1,152 terms
        // of up to 6; single precision adds 1e-7 of the scale a layer.
        assert!(largest(&found.values, &wanted.values) < 1e-3 * scale);
        assert!(largest(&found.values, &plain.values) > 0.1 * scale);
    }
}

#[test]
fn tunings_that_do_not_fit_are_refused_by_name() {
    let (tuning, _) = tuned_twice();
    let refused = |change: &dyn Fn(&mut Stored)| {
        let mut other = tuning.clone();
        change(&mut other);
        let file = bytes(&other);
        let file = SafeTensors::deserialize(&file).unwrap();
        Tuned::read(&file, "t").unwrap_err().to_string()
    };
    let name = "t.block.11.project.scale";
    let missing = refused(&|t| drop(t.remove(name)));
    assert!(
        missing.contains(name) && missing.contains("missing"),
        "{missing}"
    );
    let short = refused(&|t| {
        let tensor = t.get_mut(name).unwrap();
        tensor.1 = vec![1];
        tensor.2.truncate(4);
    });
    assert!(short.contains("F32 of [192]"), "{short}");
    let infinite =
        refused(&|t| t.get_mut(name).unwrap().2[..4].copy_from_slice(&f32::INFINITY.to_le_bytes()));
    assert!(
        infinite.contains(name) && infinite.contains("finite"),
        "{infinite}"
    );
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
