//! Image files in and out: every kind that is read.
use dipir_imaging::{
    ImagingError,
    encoding::Encoding,
    file::{
        PhotoLimits, check_format, decode_texture, read_linear, read_mask, read_photo,
        read_photo_within, write_png, write_png_16, write_png_mask,
    },
    layers::{Layers, Precision},
    raster::{DisplayImage, LinearImage, Raster},
    transfer::Transfer,
};
use glam::Vec3;
use image::{ExtendedColorType, ImageEncoder, codecs};
use proptest::prelude::*;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

mod damaged;
mod openexr;
mod refused;

fn folder() -> TempDir {
    tempfile::tempdir().unwrap()
}

/// Writes `bytes` under `name` in a folder.
fn put(folder: &TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

fn png(bytes: &[u8], width: u32, height: u32, color: ExtendedColorType) -> Vec<u8> {
    let mut file = Vec::new();
    let encoder = codecs::png::PngEncoder::new(&mut file);
    encoder.write_image(bytes, width, height, color).unwrap();
    file
}

fn jpeg(bytes: &[u8], width: u32, height: u32, color: ExtendedColorType) -> Vec<u8> {
    let mut file = Vec::new();
    let encoder = codecs::jpeg::JpegEncoder::new_with_quality(&mut file, 100);
    encoder.write_image(bytes, width, height, color).unwrap();
    file
}

/// A Radiance file of `width` x `height` pixels without run lengths, all of one RGBE value.
fn flat_hdr(signature: &str, width: usize, height: usize, rgbe: [u8; 4]) -> Vec<u8> {
    let header = format!("{signature}\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n");
    let mut file = header.into_bytes();
    for _ in 0..width * height {
        file.extend(rgbe);
    }
    file
}

fn words(error: ImagingError) -> String {
    error.to_string()
}

fn decode_8(v: u8) -> f32 {
    Transfer::Srgb.decode_scalar(f32::from(v) / 255.0)
}

#[test]
fn grey_grey_alpha_rgb_and_rgba_png_of_8_bits_are_read() {
    let folder = folder();
    let read = |bytes: &[u8], color| {
        let path = put(&folder, "x.png", &png(bytes, 1, 1, color));
        let photo = read_photo(path, Transfer::Srgb).unwrap();
        let alpha = photo.alpha.map(|a| a.pixels()[0]);
        (photo.image.0.pixels()[0], alpha)
    };
    let (a, b, c) = (decode_8(10), decode_8(130), decode_8(250));
    let half = Some(128.0 / 255.0);
    assert_eq!(read(&[130], ExtendedColorType::L8), (Vec3::splat(b), None));
    assert_eq!(
        read(&[130, 128], ExtendedColorType::La8),
        (Vec3::splat(b), half)
    );
    let rgb = Vec3::new(a, b, c);
    assert_eq!(read(&[10, 130, 250], ExtendedColorType::Rgb8), (rgb, None));
    assert_eq!(
        read(&[10, 130, 250, 128], ExtendedColorType::Rgba8),
        (rgb, half)
    );
}

#[test]
fn png_of_16_bits_keeps_them() {
    let folder = folder();
    let samples: [u16; 4] = [1, 30_001, 65_535, 32_768];
    let bytes: Vec<u8> = samples.iter().flat_map(|s| s.to_ne_bytes()).collect();
    let path = put(
        &folder,
        "x.png",
        &png(&bytes, 1, 1, ExtendedColorType::Rgba16),
    );
    let photo = read_photo(path, Transfer::Linear).unwrap();
    let unit = |v: u16| f32::from(v) / 65_535.0;
    let want = Vec3::new(unit(1), unit(30_001), 1.0);
    assert_eq!(photo.image.0.pixels()[0], want);
    assert_eq!(photo.alpha.unwrap().pixels()[0], unit(32_768));

    let path = put(
        &folder,
        "grey.png",
        &png(&bytes[2..4], 1, 1, ExtendedColorType::L16),
    );
    let photo = read_photo(path, Transfer::Linear).unwrap();
    assert_eq!(photo.image.0.pixels()[0], Vec3::splat(unit(30_001)));
}

#[test]
fn the_format_is_told_by_the_contents_not_by_the_name() {
    let folder = folder();
    let path = put(&folder, "x.jpg", &png(&[130], 1, 1, ExtendedColorType::L8));
    assert!(read_photo(path, Transfer::Srgb).is_ok());
}

#[test]
fn colour_and_grey_jpeg_are_read() {
    let folder = folder();
    let flat: Vec<u8> = [200, 100, 50].repeat(17 * 9);
    let path = put(
        &folder,
        "x.jpg",
        &jpeg(&flat, 17, 9, ExtendedColorType::Rgb8),
    );
    let photo = read_photo(path, Transfer::Linear).unwrap();
    assert_eq!((photo.image.0.width(), photo.image.0.height()), (17, 9));
    for p in photo.image.0.pixels() {
        // Quality 100 on a flat colour: conversion to YCbCr and back rounds twice.
        let want = Vec3::new(200.0, 100.0, 50.0) / 255.0;
        assert!(p.abs_diff_eq(want, 2.5 / 255.0), "{p}");
    }
    let grey = put(
        &folder,
        "g.jpg",
        &jpeg(&[90; 6], 3, 2, ExtendedColorType::L8),
    );
    let photo = read_photo(grey, Transfer::Linear).unwrap();
    let p = photo.image.0.pixels()[0];
    assert!(p.x == p.y && p.y == p.z && (p.x * 255.0 - 90.0).abs() < 1.5);
}

#[test]
fn a_photograph_taken_sideways_is_turned_upright_and_a_texture_is_not() {
    let folder = folder();
    let plain = jpeg(
        &[40, 40, 200, 200, 40, 40, 200, 200],
        4,
        2,
        ExtendedColorType::L8,
    );
    // Exif, big endian, one entry: orientation (0x0112), short, 6: turn by 90 degrees clockwise.
    let mut exif = b"\xff\xe1\x00\x22Exif\0\0MM\0\x2a\0\0\0\x08\0\x01".to_vec();
    exif.extend(b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0");
    let turned = [&plain[..2], &exif[..], &plain[2..]].concat();
    let photo = read_photo(put(&folder, "x.jpg", &turned), Transfer::Linear).unwrap();
    let image = &photo.image.0;
    assert_eq!((image.width(), image.height()), (2, 4));
    assert!(image.get(0, 0).x < 0.3 && image.get(0, 3).x > 0.6);
    let texture = decode_texture(&turned, "x.jpg").unwrap();
    assert_eq!((texture.width(), texture.height()), (4, 2));
}

#[test]
fn textures_become_rgba_of_8_bits() {
    let decode = |bytes: &[u8], color| {
        let file = png(bytes, 1, 1, color);
        decode_texture(&file, "wood").unwrap().pixels()[0]
    };
    assert_eq!(decode(&[7], ExtendedColorType::L8), [7, 7, 7, 255]);
    assert_eq!(decode(&[1, 2, 3], ExtendedColorType::Rgb8), [1, 2, 3, 255]);
    assert_eq!(
        decode(&[1, 2, 3, 4], ExtendedColorType::Rgba8),
        [1, 2, 3, 4]
    );
    let wide: Vec<u8> = [0u16, 65_535, 257, 32_896]
        .iter()
        .flat_map(|v| v.to_ne_bytes())
        .collect();
    assert_eq!(decode(&wide, ExtendedColorType::Rgba16), [0, 255, 1, 128]);
}

#[test]
fn masks_are_coverage_and_opacity_multiplies() {
    let folder = folder();
    let path = put(
        &folder,
        "m.png",
        &png(&[255, 51, 128, 255], 2, 1, ExtendedColorType::La8),
    );
    let mask = read_mask(path).unwrap();
    assert!((mask.pixels()[0] - 0.2).abs() < 1e-6);
    assert!((mask.pixels()[1] - 128.0 / 255.0).abs() < 1e-6);

    let written = folder.path().join("w.png");
    let mask = Raster::from_pixels(3, 1, vec![0.0, 0.2, 1.0]);
    write_png_mask(&written, &mask).unwrap();
    for (got, want) in read_mask(&written)
        .unwrap()
        .pixels()
        .iter()
        .zip(mask.pixels())
    {
        assert!((got - want).abs() < 1e-6);
    }
}

#[test]
fn black_saturated_and_one_pixel_images_survive_as_png() {
    let folder = folder();
    let path = folder.path().join("x.png");
    for (width, height) in [(1, 1), (7, 3), (1, 9)] {
        for value in [0.0, 1.0] {
            let image = DisplayImage(Raster::filled(width, height, Vec3::splat(value)));
            write_png(&path, &image).unwrap();
            let back = read_photo(&path, Transfer::Srgb).unwrap();
            assert_eq!(back.image.0, image.0);
        }
    }
    // Saturated light is clipped on its way to the display.
    let bright = LinearImage(Raster::filled(2, 2, Vec3::new(1e6, -1.0, f32::INFINITY)));
    write_png(&path, &Transfer::Srgb.encode(&bright)).unwrap();
    let back = read_photo(&path, Transfer::Srgb).unwrap();
    assert_eq!(back.image.0.pixels()[0], Vec3::new(1.0, 0.0, 1.0));
}

#[test]
fn radiance_hdr_is_read_under_both_signatures() {
    let folder = folder();
    for signature in ["#?RADIANCE", "#?RGBE"] {
        // 0.5 * 2^(129 - 128) = 1 for a mantissa of 128 of 256.
        let file = flat_hdr(signature, 3, 2, [128, 64, 255, 129]);
        let image = read_linear(put(&folder, "x.hdr", &file)).unwrap();
        assert_eq!((image.0.width(), image.0.height()), (3, 2));
        assert_eq!(*image.0.get(2, 1), Vec3::new(1.0, 0.5, 255.0 / 128.0));
    }
}

#[test]
fn radiance_hdr_with_run_lengths_is_read() {
    let folder = folder();
    let values: Vec<image::Rgb<f32>> = (0..64 * 4)
        .map(|i| image::Rgb([(i / 64) as f32, (i % 64) as f32, 1e5]))
        .collect();
    let mut file = Vec::new();
    codecs::hdr::HdrEncoder::new(&mut file)
        .encode(&values, 64, 4)
        .unwrap();
    let image = read_linear(put(&folder, "x.hdr", &file)).unwrap();
    for (got, want) in image.0.pixels().iter().zip(&values) {
        // One exponent for three channels, 8 bits of the largest: 1e5 / 128.
        assert!(
            got.abs_diff_eq(Vec3::from_array(want.0), 1e5 / 128.0),
            "{got}"
        );
    }
}

#[test]
fn an_exr_photograph_keeps_its_light_and_alpha() {
    let folder = folder();
    let path = folder.path().join("x.exr");
    let mut layers = Layers::new(2, 1);
    let colour = Raster::from_pixels(2, 1, vec![Vec3::new(0.5, 2.0, 1e5), Vec3::ZERO]);
    layers.insert_rgb("", Precision::Full, &colour).unwrap();
    let alpha = Raster::from_pixels(2, 1, vec![1.0, 0.25]);
    layers.insert("A", Precision::Half, alpha.clone()).unwrap();
    layers.write_exr(&path).unwrap();
    let photo = read_photo(&path, Transfer::Gamma22).unwrap();
    assert_eq!((photo.image.0, photo.alpha), (colour, Some(alpha)));
    // What is said of display values is none of its.
    assert_eq!(photo.transfer, Transfer::Srgb);
    assert_eq!(photo.encoding, Encoding::named(Transfer::Srgb));
}

#[test]
fn the_exposure_and_colour_correction_of_radiance_hdr_are_taken_out() {
    let folder = folder();
    let lines = "#?RADIANCE\nEXPOSURE=4\nEXPOSURE=0.5\nCOLORCORR=1 2 0.5\nEXPOSURE=1";
    let file = flat_hdr(lines, 2, 1, [128, 128, 128, 129]);
    let image = read_linear(put(&folder, "x.hdr", &file)).unwrap();
    assert_eq!(image.0.pixels()[0], Vec3::new(0.5, 0.25, 1.0));
    let file = flat_hdr("#?RADIANCE\nEXPOSURE=0", 2, 1, [128, 128, 128, 129]);
    assert!(read_linear(put(&folder, "x.hdr", &file)).is_err());
}

#[test]
fn nan_does_not_get_into_a_png() {
    let folder = folder();
    let path = folder.path().join("x.png");
    let mut image = DisplayImage(Raster::filled(3, 2, Vec3::ZERO));
    image.0.get_mut(1, 1).z = f32::NAN;
    let error = write_png(&path, &image).unwrap_err();
    assert!(
        matches!(error, ImagingError::NotFinite { x: 1, y: 1, .. }),
        "{error}"
    );
    assert!(!path.exists());
}

#[test]
fn a_folder_that_does_not_exist_cannot_be_written_to() {
    let path = Path::new("nowhere/x.png");
    let image = DisplayImage(Raster::filled(1, 1, Vec3::ZERO));
    assert_eq!(
        words(write_png(path, &image).unwrap_err()),
        "cannot create `nowhere/x.png`"
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn png_of_8_and_16_bits_round_trips_to_half_a_step(
        width in 1usize..20,
        height in 1usize..20,
        values in proptest::collection::vec(0.0f32..=1.0, 3 * 19 * 19),
    ) {
        let folder = folder();
        let path = folder.path().join("x.png");
        let pixels = (0..width * height).map(|i| Vec3::from_slice(&values[3 * i..])).collect();
        let image = DisplayImage(Raster::from_pixels(width, height, pixels));
        for (max, sixteen) in [(255.0f32, false), (65_535.0, true)] {
            if sixteen {
                write_png_16(&path, &image).unwrap();
            } else {
                write_png(&path, &image).unwrap();
            }
            let back = read_photo(&path, Transfer::Linear).unwrap().image;
            prop_assert_eq!((back.0.width(), back.0.height()), (width, height));
            for (got, want) in back.0.pixels().iter().zip(image.0.pixels()) {
                // Half a step, and the roundings of v * max and of k / max in f32.
                let step = 0.5 / max + 2.0 * f32::EPSILON;
                prop_assert!(got.abs_diff_eq(*want, step), "{} {}", got, want);
            }
            // What was quantised once stays.
            let again = DisplayImage(back.0);
            if sixteen {
                write_png_16(&path, &again).unwrap();
            } else {
                write_png(&path, &again).unwrap();
            }
            prop_assert_eq!(read_photo(&path, Transfer::Linear).unwrap().image.0, again.0);
        }
    }
}
