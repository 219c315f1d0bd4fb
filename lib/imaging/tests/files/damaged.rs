//! Files that were cut short or have wrong bytes: an error, never a panic.
use crate::*;

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

#[test]
fn a_small_hdr_file_of_many_pixels_is_refused_before_memory_is_taken() {
    let folder = folder();
    let file = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 91000595\n\x01\x02\x03\x80";
    let error = words(read_linear(put(&folder, "x.hdr", file)).unwrap_err());
    let wanted = format!("91000595 x 2 pixels and has {} bytes", file.len());
    assert!(error.contains(&wanted), "{error}");
}
