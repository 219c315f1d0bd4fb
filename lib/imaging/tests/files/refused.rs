//! Files that are refused, and the exact words.
use crate::*;

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
    for (name, bytes, found, to) in [
        ("x.gif", &b"GIF89a......"[..], "a GIF image", Some("x.png")),
        (
            "x.webp",
            b"RIFF\0\0\0\0WEBPVP8 ",
            "a WebP image",
            Some("x.png"),
        ),
        // Its own name says something else: it is not written over.
        (
            "x.png",
            b"II*\0\0\0\0\0",
            "a TIFF image",
            Some("x.converted.png"),
        ),
        ("x.png", b"hello", "not an image of a known format", None),
        ("x.png", b"x", "not an image of a known format", None),
    ] {
        let path = put(&folder, name, bytes);
        let convert = match to {
            Some(to) => format!(
                "convert it, for instance with `magick \"{}\" \"{}\"`",
                path.display(),
                path.with_file_name(to).display()
            ),
            None => "convert the file".into(),
        };
        let want = format!(
            "`{}` is {found}; expected a PNG, JPEG, OpenEXR or Radiance HDR image: {convert}",
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
        (
            "x.heif",
            b"\0\0\0\x18ftypmif1",
            "a HEIF image",
            "heif-convert -q 95",
        ),
        ("x.jxl", b"\xff\x0a\0\0\0\0\0\0", "a JPEG XL image", "djxl"),
        (
            "x.jp2",
            b"\0\0\0\x0cjP  \r\n\x87\n",
            "a JPEG 2000 image",
            "magick",
        ),
        (
            "x.j2k",
            b"\xff\x4f\xff\x51\0\x2f",
            "a JPEG 2000 image",
            "magick",
        ),
        ("x.ppm", b"P6\n2 2\n255\n", "a Netpbm image", "magick"),
        ("x.pgm", b"P5 2 2 255 ", "a Netpbm image", "magick"),
        ("x.qoi", b"qoif\0\0\0\x02", "a QOI image", "magick"),
        ("x.dds", b"DDS \x7c\0\0\0", "a DDS texture", "magick"),
        ("x.TGA", b"\0\0\x02\0\0\0", "a Targa image", "magick"),
        ("x.tif", b"II+\0\x08\0\0\0", "a TIFF image", "magick"),
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
    let layers = put(&folder, "x.psd", b"8BPS\0\x01\0\0");
    let error = words(read_photo(&layers, Transfer::Srgb).unwrap_err());
    let command = format!("`magick \"{}[0]\" \"", layers.display());
    assert!(error.contains(&command), "{error}");
    // A word that begins with P and a digit is no picture.
    let text = put(&folder, "x.txt", b"P6x 2 2");
    let error = words(read_photo(text, Transfer::Srgb).unwrap_err());
    assert!(error.contains("not an image of a known format"), "{error}");
}

#[test]
fn movies_are_refused_with_the_command_that_writes_their_frames() {
    let folder = folder();
    for (name, bytes) in [
        ("x.mov", &b"\0\0\0\x14ftypqt  \0\0\0\0"[..]),
        ("x.mp4", b"\0\0\0\x18ftypisom"),
        ("x.mp4", b"\0\0\0\x18ftypmp42"),
        ("x.m4v", b"\0\0\0\x18ftypM4V "),
        ("x.mp4", b"\0\0\0\x18ftypavc1"),
        ("x.3gp", b"\0\0\0\x18ftyp3gp5"),
        ("x.mov", b"\0\0\0\x08wide\0\0\0\0mdat"),
        ("x.avi", b"RIFF\0\0\0\0AVI LIST"),
        ("x.webm", b"\x1aE\xdf\xa3\x9fB\x86\x81"),
    ] {
        let path = put(&folder, name, bytes);
        let from = path.display();
        let want = format!(
            "`{from}` is a movie; expected a PNG, JPEG, OpenEXR or Radiance HDR image: write its frames, \
             for instance with `mkdir frames && ffmpeg -i \"{from}\" frames/%04d.png`, and give one of \
             them, or all to `dipir shot frames/*.png`"
        );
        assert_eq!(words(read_photo(&path, Transfer::Srgb).unwrap_err()), want);
        assert_eq!(words(check_format(&path).unwrap_err()), want);
    }
    // Of files that may be read the format alone is looked at.
    let begun = put(&folder, "x.jpg", &[0xff, 0xd8, 0xff, 0xe0]);
    check_format(&begun).unwrap();
    read_photo(&begun, Transfer::Srgb).unwrap_err();
    // Words are no box.
    let text = put(&folder, "x.txt", b"The wide world");
    let error = words(read_photo(text, Transfer::Srgb).unwrap_err());
    assert!(error.contains("not an image of a known format"), "{error}");
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
fn a_cmyk_jpeg_is_refused_with_the_command_of_a_converter() {
    let folder = folder();
    let mut file = jpeg(&[90; 12], 2, 2, ExtendedColorType::Rgb8);
    let frame = file.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    file[frame + 9] = 4;
    let path = put(&folder, "print.jpg", &file);
    assert_eq!(
        words(read_photo(&path, Transfer::Srgb).unwrap_err()),
        format!(
            "`{}` is a CMYK JPEG, which is not supported; convert it, for instance with \
             `magick \"{}\" -colorspace sRGB \"{}\"`",
            path.display(),
            path.display(),
            path.with_extension("png").display()
        )
    );
}

/// Brightness is sampled once where colour is sampled four times. The decoder panics on such a file.
#[test]
fn a_jpeg_whose_colour_is_finer_than_its_brightness_is_refused() {
    let folder = folder();
    let path = put(&folder, "x.jpg", include_bytes!("fine_colour.jpg"));
    assert_eq!(
        words(read_photo(&path, Transfer::Srgb).unwrap_err()),
        format!(
            "`{}` is a JPEG whose colour is sampled more finely than its brightness, which is not supported; \
             save it as 8-bit RGB",
            path.display()
        )
    );
}

#[test]
fn a_small_jpeg_of_many_pixels_is_refused_before_it_is_decoded() {
    let folder = folder();
    let mut file = Vec::new();
    let grey = image::GrayImage::from_pixel(64, 64, image::Luma([90]));
    image::codecs::jpeg::JpegEncoder::new(&mut file)
        .encode_image(&grey)
        .unwrap();
    let size = file.windows(2).position(|w| w == [0xff, 0xc0]).unwrap() + 5;
    let read = |height: u16, width: u16| {
        let mut file = file.clone();
        file[size..size + 2].copy_from_slice(&height.to_be_bytes());
        file[size + 2..size + 4].copy_from_slice(&width.to_be_bytes());
        let path = put(&folder, "x.jpg", &file);
        read_photo(&path, Transfer::Srgb).map_err(words)
    };
    let path = folder.path().join("x.jpg");
    assert!(read(64, 64).is_ok());
    assert_eq!(
        read(65024, 2056).unwrap_err(),
        format!(
            "`{}` is damaged or cut short: it declares 2056 x 65024 pixels and has {} bytes; \
             expected a complete JPEG file: export or copy it again",
            path.display(),
            file.len()
        )
    );
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
fn a_jpeg_of_another_coding_is_not_called_damaged() {
    let folder = folder();
    let mut file = jpeg(&[90; 12], 2, 2, ExtendedColorType::Rgb8);
    let frame = file.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    for (marker, coding) in [
        (0xc3, "lossless"),
        (0xc6, "hierarchical"),
        (0xc9, "arithmetic"),
        (0xca, "arithmetic"),
    ] {
        file[frame + 1] = marker;
        let path = put(&folder, "x.jpg", &file);
        let error = words(read_photo(&path, Transfer::Srgb).unwrap_err());
        let says = format!("is a JPEG with {coding} coding, which is not supported; convert it");
        assert!(error.contains(&says), "{error}");
    }
}

#[test]
fn luminance_with_chroma_is_not_read_as_grey() {
    let folder = folder();
    let path = folder.path().join("x.exr");
    let mut layers = Layers::new(2, 1);
    for name in ["Y", "RY", "BY"] {
        let samples = Raster::filled(2, 1, 0.5);
        layers.insert(name, Precision::Half, samples).unwrap();
    }
    layers.write_exr(&path).unwrap();
    for error in [
        words(read_photo(&path, Transfer::Srgb).unwrap_err()),
        words(read_linear(&path).unwrap_err()),
    ] {
        assert!(error.contains("luminance and chroma"), "{error}");
    }
    // A mask is the luminance.
    assert_eq!(read_mask(&path).unwrap().pixels(), [0.5; 2]);
}
