//! Image files in and out: every kind that is read, and the exact words for those that are not.
use dipir_imaging::{
    ImagingError,
    file::{
        PhotoLimits, decode_texture, read_linear, read_mask, read_photo, read_photo_within,
        write_png, write_png_16, write_png_mask,
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
    assert_eq!(photo.transfer, Transfer::Gamma22);
}

// What is refused, in words.

#[test]
fn a_missing_file_is_named() {
    let path = Path::new("nowhere/photo.png");
    let want = "`nowhere/photo.png` does not exist; check the path";
    assert_eq!(words(read_photo(path, Transfer::Srgb).unwrap_err()), want);
    assert_eq!(words(read_linear(path).unwrap_err()), want);
    assert_eq!(words(Layers::read_exr(path).unwrap_err()), want);
}

#[test]
fn a_file_of_zero_bytes_is_called_empty() {
    let folder = folder();
    let path = put(&folder, "x.png", b"");
    let of = |expected: &str| {
        let path = path.display();
        format!("`{path}` is empty (0 bytes); expected {expected}: export the file again")
    };
    assert_eq!(
        words(read_photo(&path, Transfer::Srgb).unwrap_err()),
        of("a PNG, JPEG, OpenEXR or Radiance HDR image")
    );
    assert_eq!(
        words(read_linear(&path).unwrap_err()),
        of("an OpenEXR or Radiance HDR image (linear light)")
    );
    assert_eq!(
        words(Layers::read_exr(&path).unwrap_err()),
        of("an OpenEXR image")
    );
    assert_eq!(
        words(decode_texture(b"", "texture 3").unwrap_err()),
        "`texture 3` is empty (0 bytes); expected a PNG or JPEG image: export the file again"
    );
}

#[test]
fn display_pixels_where_light_is_wanted_are_refused() {
    let folder = folder();
    let path = put(
        &folder,
        "sky.hdr",
        &png(&[1, 2, 3], 1, 1, ExtendedColorType::Rgb8),
    );
    assert_eq!(
        words(read_linear(&path).unwrap_err()),
        format!(
            "`{}` is a PNG image (display-referred); expected an OpenEXR or Radiance HDR image \
             (linear light): convert the file",
            path.display()
        )
    );
}

#[test]
fn files_of_other_formats_are_named_as_what_they_are() {
    let folder = folder();
    for (bytes, found) in [
        (&b"GIF89a......"[..], "a GIF image"),
        (b"RIFF\0\0\0\0WEBPVP8 ", "a WebP image"),
        (b"II*\0\0\0\0\0", "a TIFF image"),
        (b"hello", "not an image of a known format"),
        (b"x", "not an image of a known format"),
    ] {
        let path = put(&folder, "x.png", bytes);
        let want = format!(
            "`{}` is {found}; expected a PNG, JPEG, OpenEXR or Radiance HDR image: convert the file",
            path.display()
        );
        assert_eq!(words(read_photo(&path, Transfer::Srgb).unwrap_err()), want);
    }
}

#[test]
fn files_that_a_converter_reads_are_refused_with_its_command() {
    let folder = folder();
    for (name, bytes, found, tool) in [
        (
            "x.heic",
            &b"\0\0\0\x18ftypheic"[..],
            "a HEIF image",
            "heif-convert -q 95",
        ),
        ("x.avif", b"\0\0\0\x18ftypavif", "an AVIF image", "avifdec"),
        ("x.jxl", b"\xff\x0a\0\0\0\0\0\0", "a JPEG XL image", "djxl"),
        (
            "x.CR2",
            b"II*\0\x10\0\0\0CR\x02\0",
            "a camera's raw file",
            "darktable-cli",
        ),
        (
            "x.NEF",
            b"MM\0*\0\0\0\x08\0\0",
            "a camera's raw file",
            "darktable-cli",
        ),
        (
            "x.dng",
            b"II*\0\x08\0\0\0\0\0",
            "a camera's raw file",
            "darktable-cli",
        ),
    ] {
        let path = put(&folder, name, bytes);
        let (from, to) = (path.display(), path.with_extension("png"));
        let want = format!(
            "`{from}` is {found}; expected a PNG, JPEG, OpenEXR or Radiance HDR image: convert it, \
             for instance with `{tool} \"{from}\" \"{}\"`",
            to.display()
        );
        assert_eq!(words(read_photo(&path, Transfer::Srgb).unwrap_err()), want);
    }
}

#[test]
fn a_small_file_of_many_pixels_is_refused_before_it_is_decoded() {
    let folder = folder();
    // 16,000 x 16,000 grey pixels of one bit, all black: 31 kB.
    let path = folder.path().join("x.png");
    let file = std::fs::File::create(&path).unwrap();
    let mut encoder = png::Encoder::new(file, 16_000, 16_000);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::One);
    let mut writer = encoder.write_header().unwrap();
    writer.write_image_data(&vec![0; 2000 * 16_000]).unwrap();
    writer.finish().unwrap();
    let length = std::fs::metadata(&path).unwrap().len();
    assert!(length < 200_000, "{length}");
    assert_eq!(
        words(read_photo(&path, Transfer::Srgb).unwrap_err()),
        format!(
            "`{}` is 16000 x 16000 pixels (256.0 megapixels); the limit is 200: scale it down, or \
             raise scene.limits.photo_megapixels",
            path.display()
        )
    );
    let small = put(&folder, "y.png", &png(&[9; 6], 3, 2, ExtendedColorType::L8));
    let limits = |megapixels| PhotoLimits { megapixels };
    assert!(read_photo_within(&small, Transfer::Srgb, limits(5e-6)).is_err());
    assert!(read_photo_within(&small, Transfer::Srgb, limits(6e-6)).is_ok());
}

#[test]
fn an_exr_that_declares_more_than_its_length_can_hold_is_refused() {
    let folder = folder();
    let path = folder.path().join("x.exr");
    let mut layers = Layers::new(64, 64);
    let colour = Raster::filled(64, 64, Vec3::ONE);
    layers.insert_rgb("", Precision::Half, &colour).unwrap();
    layers.write_exr(&path).unwrap();
    let mut file = std::fs::read(&path).unwrap();
    // Both windows are four numbers, the last two the right and bottom edge.
    for name in [&b"dataWindow\0box2i\0"[..], b"displayWindow\0box2i\0"] {
        let at = file.windows(name.len()).position(|w| w == name).unwrap() + name.len() + 12;
        file[at..at + 4].copy_from_slice(&15_999i32.to_le_bytes());
        file[at + 4..at + 8].copy_from_slice(&15_999i32.to_le_bytes());
    }
    let path = put(&folder, "wide.exr", &file);
    assert!(matches!(
        read_linear(&path).unwrap_err(),
        ImagingError::Damaged { .. }
    ));
    assert!(matches!(
        read_photo(&path, Transfer::Srgb).unwrap_err(),
        ImagingError::TooManyPixels { .. } | ImagingError::Damaged { .. }
    ));
}

#[cfg(unix)]
#[test]
fn devices_and_folders_are_not_read() {
    let folder = folder();
    for (path, found) in [
        (Path::new("/dev/zero"), "not a regular file"),
        (folder.path(), "a folder, not a regular file"),
    ] {
        for error in [
            read_photo(path, Transfer::Srgb).unwrap_err(),
            read_linear(path).unwrap_err(),
            read_mask(path).unwrap_err(),
            Layers::read_exr(path).unwrap_err(),
        ] {
            let ImagingError::Io { source, .. } = error else {
                panic!("{error}");
            };
            assert_eq!(source.to_string(), found);
        }
    }
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
fn a_radiance_hdr_of_another_layout_is_told_what_works() {
    let folder = folder();
    let file = flat_hdr("#?RADIANCE", 2, 1, [128; 4]);
    let other = String::from_utf8_lossy(&file).replace("-Y 1 +X 2", "+Y 1 +X 2");
    let path = put(&folder, "x.hdr", other.as_bytes());
    let error = words(read_linear(&path).unwrap_err());
    let remedy = "save it as OpenEXR, or as Radiance HDR in RGBE from the top left";
    assert!(error.ends_with(remedy), "{error}");
}

#[test]
fn a_cmyk_jpeg_is_refused() {
    let folder = folder();
    let mut file = jpeg(&[90; 12], 2, 2, ExtendedColorType::Rgb8);
    let frame = file.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    file[frame + 9] = 4;
    let path = put(&folder, "print.jpg", &file);
    assert_eq!(
        words(read_photo(&path, Transfer::Srgb).unwrap_err()),
        format!(
            "`{}` is a CMYK JPEG, which is not supported; save it as 8-bit RGB",
            path.display()
        )
    );
}

#[test]
fn a_jpeg_cut_short_at_any_byte_is_refused() {
    let folder = folder();
    let noise: Vec<u8> = (0..32 * 32 * 3).map(|i| (i * 7919 % 251) as u8).collect();
    let file = jpeg(&noise, 32, 32, ExtendedColorType::Rgb8);
    for length in (3..file.len()).step_by(97).chain([file.len() - 1]) {
        let path = put(&folder, "x.jpg", &file[..length]);
        let error = read_photo(&path, Transfer::Srgb).unwrap_err();
        assert!(
            matches!(error, ImagingError::Damaged { .. }),
            "{length}: {error}"
        );
    }
    let path = put(&folder, "x.jpg", &file[..file.len() - 1]);
    assert_eq!(
        words(read_photo(&path, Transfer::Srgb).unwrap_err()),
        format!(
            "`{}` is damaged or cut short: no end-of-image marker; expected a complete JPEG file: \
             export or copy it again",
            path.display()
        )
    );
}

#[test]
fn a_png_hdr_or_exr_cut_short_at_any_byte_is_refused() {
    let folder = folder();
    let noise: Vec<u8> = (0..32 * 32 * 3).map(|i| (i * 7919 % 251) as u8).collect();
    let exr = folder.path().join("whole.exr");
    let mut layers = Layers::new(32, 32);
    let colour = Raster::from_pixels(
        32,
        32,
        (0..1024).map(|i| Vec3::splat((i as f32).sin())).collect(),
    );
    layers.insert_rgb("", Precision::Full, &colour).unwrap();
    layers.write_exr(&exr).unwrap();
    let files = [
        // Without its last chunk, IEND, a PNG has all its pixels: cut before it.
        (png(&noise, 32, 32, ExtendedColorType::Rgb8), 12, "PNG"),
        (
            flat_hdr("#?RADIANCE", 9, 9, [1, 2, 3, 128]),
            1,
            "Radiance HDR",
        ),
        (std::fs::read(&exr).unwrap(), 1, "OpenEXR"),
    ];
    for (file, tail, name) in files {
        for length in (12..file.len() - tail)
            .step_by(53)
            .chain([file.len() - tail - 1])
        {
            let path = put(&folder, "x", &file[..length]);
            let error = read_photo(&path, Transfer::Srgb).unwrap_err();
            let ImagingError::Damaged { format, .. } = error else {
                panic!("{name} cut at {length}: {error}");
            };
            assert_eq!(format, name);
        }
    }
}

#[test]
fn garbage_after_a_valid_signature_is_an_error_not_a_panic() {
    let folder = folder();
    let junk: Vec<u8> = (0..4096u32)
        .map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8)
        .collect();
    for magic in [
        &b"\x89PNG\r\n\x1a\n"[..],
        &[0xff, 0xd8, 0xff],
        &[0x76, 0x2f, 0x31, 1],
        b"#?RADIANCE\n",
    ] {
        let path = put(&folder, "x", &[magic, &junk].concat());
        assert!(read_photo(&path, Transfer::Srgb).is_err());
    }
}

#[test]
fn a_header_that_asks_for_all_memory_is_refused() {
    let folder = folder();
    let file = flat_hdr("#?RADIANCE", 1, 1, [1, 2, 3, 128]);
    let text = String::from_utf8_lossy(&file[..]).replace("-Y 1 +X 1", "-Y 999999 +X 999999");
    let path = put(&folder, "x.hdr", text.as_bytes());
    assert_eq!(
        words(read_linear(&path).unwrap_err()),
        format!(
            "`{}` is 999999 x 999999 pixels; expected at least 1 x 1 and at most 268435456 pixels \
             in all",
            path.display()
        )
    );
}

#[test]
fn nan_and_infinity_in_imported_light_are_refused_with_the_pixel_named() {
    let folder = folder();
    let path = folder.path().join("sky.exr");
    for (value, name) in [
        (f32::NAN, "NaN"),
        (f32::INFINITY, "inf"),
        (f32::NEG_INFINITY, "-inf"),
    ] {
        for precision in [Precision::Half, Precision::Full] {
            let mut colour = Raster::filled(5, 4, Vec3::ONE);
            colour.get_mut(3, 2).y = value;
            let mut layers = Layers::new(5, 4);
            layers.insert_rgb("", precision, &colour).unwrap();
            layers.write_exr(&path).unwrap();
            let want = format!(
                "`{}` holds {name} in channel G of the pixel in column 3, row 2 (from the top \
                 left); expected finite values: repair the pixel",
                path.display()
            );
            assert_eq!(words(read_linear(&path).unwrap_err()), want);
            assert_eq!(words(read_photo(&path, Transfer::Srgb).unwrap_err()), want);
        }
    }
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

/// One small file of each kind that is read.
fn one_of_each() -> Vec<Vec<u8>> {
    let noise: Vec<u8> = (0..16 * 16 * 3).map(|i| (i * 7919 % 251) as u8).collect();
    let light: Vec<image::Rgb<f32>> = noise
        .as_chunks::<3>()
        .0
        .iter()
        .map(|&c| image::Rgb(c.map(f32::from)))
        .collect();
    let mut hdr = Vec::new();
    codecs::hdr::HdrEncoder::new(&mut hdr)
        .encode(&light, 16, 16)
        .unwrap();
    let folder = folder();
    let path = folder.path().join("x.exr");
    let colour = light.iter().map(|c| Vec3::from_array(c.0)).collect();
    let mut layers = Layers::new(16, 16);
    layers
        .insert_rgb("", Precision::Half, &Raster::from_pixels(16, 16, colour))
        .unwrap();
    layers.write_exr(&path).unwrap();
    vec![
        png(&noise, 16, 16, ExtendedColorType::Rgb8),
        jpeg(&noise, 16, 16, ExtendedColorType::Rgb8),
        hdr,
        std::fs::read(&path).unwrap(),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    /// An error or a picture, never a panic.
    #[test]
    fn files_with_damaged_bytes_never_panic(
        kind in 0usize..4,
        damage in proptest::collection::vec((0usize..400, any::<u8>()), 1..6),
    ) {
        let folder = folder();
        let mut file = one_of_each().swap_remove(kind);
        for (at, value) in damage {
            let at = at % file.len();
            file[at] = value;
        }
        let path = put(&folder, "x", &file);
        if let Ok(photo) = read_photo(&path, Transfer::Srgb) {
            prop_assert!(photo.image.0.pixels().iter().all(|p| p.is_finite()));
        }
        let _ = Layers::read_exr(&path);
    }
}
