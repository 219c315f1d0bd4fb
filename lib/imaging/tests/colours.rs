//! Primaries, gamma and transparency of files: what is read, what is said, what comes back.
use dipir_imaging::{
    encoding::Encoding,
    file::{Photo, read_linear, read_photo, write_picture},
    layers::{Layers, Precision},
    raster::{LinearImage, Raster},
    transfer::Transfer,
};
use exr::{
    math::Vec2,
    meta::attribute::Chromaticities,
    prelude::{Image, SpecificChannels, WritableImage},
};
use glam::Vec3;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

const REC709: [f32; 8] = [0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329];
const ACESCG: [f32; 8] = [0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767];
/// Red of ACEScg in Rec.709, from the matrix that the Academy publishes.
const ACESCG_RED: Vec3 = Vec3::new(1.705_05, -0.130_26, -0.024_00);

fn folder() -> TempDir {
    tempfile::tempdir().unwrap()
}

/// An OpenEXR file of red, white and a dull colour, two rows of it.
fn put_exr(folder: &TempDir, primaries: Option<[f32; 8]>) -> PathBuf {
    let path = folder.path().join("light.exr");
    let colours = [(1.0f32, 0.0f32, 0.0f32), (1.0, 1.0, 1.0), (0.3, 0.2, 0.1)];
    let channels = SpecificChannels::rgb(move |Vec2(x, y)| colours[(x + y) % 3]);
    let mut image = Image::from_channels((4, 2), channels);
    image.attributes.chromaticities = primaries.map(|n| Chromaticities {
        red: Vec2(n[0], n[1]),
        green: Vec2(n[2], n[3]),
        blue: Vec2(n[4], n[5]),
        white: Vec2(n[6], n[7]),
    });
    image.write().to_file(&path).unwrap();
    path
}

/// An OpenEXR file of one pixel of XYZ.
fn put_xyz(folder: &TempDir, xyz: [f32; 3], white: Option<[f32; 2]>) -> PathBuf {
    let path = folder.path().join("xyz.exr");
    let channels = SpecificChannels::build()
        .with_channel("X")
        .with_channel("Y")
        .with_channel("Z")
        .with_pixel_fn(move |_| (xyz[0], xyz[1], xyz[2]));
    let mut image = Image::from_channels((1, 1), channels);
    image.attributes.chromaticities = white.map(|[x, y]| Chromaticities {
        red: Vec2(1.0, 0.0),
        green: Vec2(0.0, 1.0),
        blue: Vec2(0.0, 0.0),
        white: Vec2(x, y),
    });
    image.write().to_file(&path).unwrap();
    path
}

/// A Radiance file of one pixel, red at 1.
fn put_hdr(folder: &TempDir, lines: &str) -> PathBuf {
    let path = folder.path().join("light.hdr");
    let header = format!("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n{lines}\n-Y 1 +X 1\n");
    std::fs::write(&path, [header.as_bytes(), &[128, 0, 0, 129]].concat()).unwrap();
    path
}

fn first(image: &LinearImage) -> Vec3 {
    image.0.pixels()[0]
}

#[test]
fn linear_light_that_a_display_shows_as_white_or_black_is_said() {
    let folder = folder();
    let said = |values: [f32; 4]| {
        let path = folder.path().join("light.exr");
        let mut layers = Layers::new(4, 1);
        let grey = Raster::from_pixels(4, 1, values.map(Vec3::splat).to_vec());
        layers.insert_rgb("", Precision::Full, &grey).unwrap();
        layers.write_exr(&path).unwrap();
        read_photo(&path, Transfer::Srgb).unwrap().warnings
    };
    // A factor of 2^-6 brings 11.52 to mid-grey, .18; and 2^10 brings .18 / 1024 there.
    let [white] = &said([11.52, 11.52, 11.52, 11.52])[..] else {
        panic!("one warning");
    };
    assert!(white.contains("100% of its pixels are above 1.0 and show white"));
    assert!(
        white.ends_with("multiply the photograph's values by 2^-6"),
        "{white}"
    );
    let [black] = &said([0.18 / 1024.0; 4])[..] else {
        panic!("one warning");
    };
    assert!(black.contains("100% of its pixels are below 0.01 and show nearly black"));
    assert!(
        black.ends_with("multiply the photograph's values by 2^10"),
        "{black}"
    );
    let [dark] = &said([0.0; 4])[..] else {
        panic!("one warning");
    };
    assert!(dark.contains("it holds no light"), "{dark}");
    // A sky that is white and a dark room with a window say nothing.
    for values in [[40.0, 40.0, 0.2, 0.3], [0.001, 0.001, 0.001, 3.0]] {
        assert_eq!(said(values), Vec::<String>::new());
    }
}

#[test]
fn acescg_of_openexr_is_converted_and_only_a_map_is_clipped() {
    let folder = folder();
    let path = put_exr(&folder, Some(ACESCG));
    let photo = read_photo(&path, Transfer::Srgb).unwrap();
    assert_eq!(photo.warnings, Vec::<String>::new());
    assert!(first(&photo.image).abs_diff_eq(ACESCG_RED, 1e-4));
    let white = photo.image.0.pixels()[1];
    assert!(white.abs_diff_eq(Vec3::ONE, 1e-6), "{white}");
    let light = read_linear(&path).unwrap();
    let want = ACESCG_RED.max(Vec3::ZERO);
    assert!(first(&light).abs_diff_eq(want, 1e-4));
    assert_eq!(first(&light).min_element(), 0.0);
    assert_eq!(light.0.pixels()[2], photo.image.0.pixels()[2]);
}

#[test]
fn light_of_rec709_is_left_as_it_is() {
    let folder = folder();
    let plain = read_linear(put_exr(&folder, None)).unwrap();
    let tagged = put_exr(&folder, Some(REC709));
    assert_eq!(read_linear(&tagged).unwrap(), plain);
    assert_eq!(read_photo(&tagged, Transfer::Srgb).unwrap().image, plain);
    let lines = "PRIMARIES= 0.64 0.33 0.30 0.60 0.15 0.06 0.3127 0.3290\n";
    let hdr = read_linear(put_hdr(&folder, lines)).unwrap();
    assert_eq!(first(&hdr), Vec3::X);
}

#[test]
fn xyz_of_openexr_is_converted_and_is_not_read_as_grey() {
    let folder = folder();
    // Red of Rec.709 [IEC 61966-2-1]; the centre of XYZ names XYZ itself, and no white.
    let red = [0.4124, 0.2126, 0.0193];
    for white in [None, Some([0.3127, 0.329]), Some([1.0 / 3.0; 2])] {
        let path = put_xyz(&folder, red, white);
        let photo = read_photo(&path, Transfer::Srgb).unwrap();
        assert_eq!(photo.warnings, Vec::<String>::new());
        let got = first(&photo.image);
        // The standard's matrix has four digits.
        assert!(got.abs_diff_eq(Vec3::X, 1e-3), "{white:?}: {got}");
        assert!(first(&read_linear(&path).unwrap()).abs_diff_eq(Vec3::X, 1e-3));
    }
    // White D50 of luminance 2 is white here.
    let path = put_xyz(
        &folder,
        [2.0 * 0.9643, 2.0, 2.0 * 0.8251],
        Some([0.3457, 0.3585]),
    );
    let got = first(&read_linear(&path).unwrap());
    assert!(got.abs_diff_eq(Vec3::splat(2.0), 1e-3), "{got}");
    let path = put_xyz(&folder, red, Some([0.3, 0.0]));
    let photo = read_photo(&path, Transfer::Srgb).unwrap();
    assert!(photo.warnings[0].contains("its primaries do not make their white"));
}

#[test]
fn the_primaries_of_radiance_hdr_are_those_of_its_last_line() {
    let folder = folder();
    let lines = "PRIMARIES=0.64 0.33 0.30 0.60 0.15 0.06 0.3127 0.3290\n\
                 PRIMARIES= .713 .293 .165 .83 .128 .044 .32168 .33767\nEXPOSURE=2\n";
    let photo = read_photo(put_hdr(&folder, lines), Transfer::Srgb).unwrap();
    let red = first(&photo.image);
    assert!(red.abs_diff_eq(0.5 * ACESCG_RED, 1e-4), "{red}");
}

/// As Photoshop writes that it does not tell them.
#[test]
fn primaries_of_which_all_are_0_are_not_told() {
    let folder = folder();
    let plain = read_linear(put_exr(&folder, None)).unwrap();
    let path = put_exr(&folder, Some([0.0; 8]));
    assert_eq!(read_linear(&path).unwrap(), plain);
    let photo = read_photo(&path, Transfer::Srgb).unwrap();
    assert_eq!((photo.image, photo.warnings), (plain, vec![]));

    let path = put_hdr(&folder, "PRIMARIES=0 0 0 0 0 0 0 0\n");
    assert_eq!(first(&read_linear(&path).unwrap()), Vec3::X);
    let photo = read_photo(&path, Transfer::Srgb).unwrap();
    assert_eq!(photo.warnings, Vec::<String>::new());
    assert_eq!(first(&photo.image), Vec3::X);
    // An earlier line that tells them stands.
    let lines = "PRIMARIES=.713 .293 .165 .83 .128 .044 .32168 .33767\nPRIMARIES=0 0 0 0 0 0 0 0\n";
    let red = first(
        &read_photo(put_hdr(&folder, lines), Transfer::Srgb)
            .unwrap()
            .image,
    );
    assert!(red.abs_diff_eq(ACESCG_RED, 1e-4), "{red}");
}

#[test]
fn primaries_that_describe_no_colours_are_said_of_a_photograph_and_refused_of_a_map() {
    let folder = folder();
    let plain = read_linear(put_exr(&folder, None)).unwrap();
    let path = put_exr(&folder, Some([0.3; 8]));
    let photo = read_photo(&path, Transfer::Srgb).unwrap();
    assert_eq!(photo.image, plain);
    let name = path.display();
    assert_eq!(
        photo.warnings,
        [format!(
            "`{name}`: its primaries lie on one line; it is read as linear Rec.709: convert it to \
             Rec.709 if its colours look wrong"
        )]
    );
    assert_eq!(
        read_linear(&path).unwrap_err().to_string(),
        format!(
            "`{name}` has primaries that lie on one line, which is not supported; save it in linear \
             Rec.709"
        )
    );
    let path = put_hdr(&folder, "PRIMARIES=0.64 0.33\n");
    assert!(read_linear(&path).is_err());
    let photo = read_photo(&path, Transfer::Srgb).unwrap();
    assert!(photo.warnings[0].contains("its primaries are not eight finite numbers"));
}

/// A PNG of `values` with `chunks` before its pixels.
fn put_png(
    folder: &TempDir,
    color: png::ColorType,
    values: &[u8],
    chunks: &[(&[u8; 4], &[u8])],
) -> PathBuf {
    let path = folder.path().join("photo.png");
    let width = values.len() / color.samples();
    let mut encoder = png::Encoder::new(std::fs::File::create(&path).unwrap(), width as u32, 1);
    encoder.set_color(color);
    if color == png::ColorType::Indexed {
        encoder.set_palette(vec![9, 90, 190, 20, 30, 40]);
    }
    let mut writer = encoder.write_header().unwrap();
    for (kind, data) in chunks {
        writer
            .write_chunk(png::chunk::ChunkType(**kind), data)
            .unwrap();
    }
    writer.write_image_data(values).unwrap();
    writer.finish().unwrap();
    path
}

fn gamma(scaled: u32) -> Vec<u8> {
    scaled.to_be_bytes().to_vec()
}

/// White, red, green, blue.
fn chromaticities(scaled: [u32; 8]) -> Vec<u8> {
    scaled.into_iter().flat_map(u32::to_be_bytes).collect()
}

const SRGB: [u32; 8] = [31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000];
const P3: [u32; 8] = [31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000];

/// Every value of grey and many beside them.
fn many_colours() -> Vec<u8> {
    (0..=255u8).flat_map(|v| [v, v, v, v, 255 - v, 7]).collect()
}

fn photo_with(folder: &TempDir, chunks: &[(&[u8; 4], &[u8])], transfer: Transfer) -> Photo {
    let path = put_png(folder, png::ColorType::Rgb, &many_colours(), chunks);
    read_photo(path, transfer).unwrap()
}

/// The pixels of a PNG, its gamma, and whether it says that it is sRGB.
fn stored(path: &Path) -> (Vec<u8>, Option<u32>, bool) {
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut values = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut values).unwrap();
    let info = reader.info();
    let gamma = info.gama_chunk.map(png::ScaledFloat::into_scaled);
    (values, gamma, info.srgb.is_some())
}

#[test]
fn the_gamma_of_a_png_is_read_and_the_picture_has_it() {
    let folder = folder();
    for (scaled, exponent) in [(100_000, 1.0), (55_556, 1.8), (38_462, 2.6)] {
        let chunk = gamma(scaled);
        let photo = photo_with(&folder, &[(b"gAMA", &chunk)], Transfer::Srgb);
        assert_eq!(photo.warnings, Vec::<String>::new());
        for (v, light) in photo.image.0.pixels().iter().step_by(2).enumerate() {
            let want = (v as f64 / 255.0).powf(exponent);
            assert!((f64::from(light.x) - want).abs() < 1e-4, "{scaled} {v}");
        }
        let written = folder.path().join("picture.png");
        write_picture(&written, &photo.image, &photo).unwrap();
        let (values, written_gamma, srgb) = stored(&written);
        assert_eq!(values, many_colours());
        assert_eq!((written_gamma, srgb), (Some(scaled), false));
        // What is encoded anew has the same values: there is no seam.
        let again = photo.encoding.encode_8(&photo.image);
        assert_eq!(again.as_flattened(), many_colours(), "{scaled}");
    }
}

#[test]
fn the_primaries_of_a_png_are_read_and_the_picture_has_them() {
    let folder = folder();
    let (p3, gamma18, gamma22, gamma20) = (
        chromaticities(P3),
        gamma(55_556),
        gamma(45_455),
        gamma(2_000_000),
    );
    let cases: [(&[u8], Option<u32>, f64); 4] = [
        (&[], None, 2.2),
        (&gamma18, Some(55_556), 1.8),
        (&gamma22, Some(45_455), 2.2),
        (&gamma20, None, 2.2),
    ];
    for (chunk, scaled, exponent) in cases {
        let mut chunks: Vec<(&[u8; 4], &[u8])> = vec![(b"cHRM", &p3)];
        if !chunk.is_empty() {
            chunks.push((b"gAMA", chunk));
        }
        let photo = photo_with(&folder, &chunks, Transfer::Srgb);
        // Only an exponent of 20 is said.
        assert_eq!(photo.warnings.len(), usize::from(chunk == gamma20));
        // White and grey stay as they are; the last colour is (255, 0, 7).
        let pixels = photo.image.0.pixels();
        assert!(pixels[510].abs_diff_eq(Vec3::ONE, 1e-6));
        let grey = (128.0f64 / 255.0).powf(exponent);
        assert!(
            (f64::from(pixels[256].y) - grey).abs() < 0.01,
            "{}",
            pixels[256]
        );
        // Red of Display P3 in Rec.709 [SMPTE EG 432-1, to four digits].
        let red = Vec3::new(1.2249, -0.0420, -0.0196);
        assert!(pixels[511].abs_diff_eq(red, 0.01), "{}", pixels[511]);
        let written = folder.path().join("picture.png");
        write_picture(&written, &photo.image, &photo).unwrap();
        let (values, written_gamma, srgb) = stored(&written);
        assert_eq!(values, many_colours());
        assert_eq!((written_gamma, srgb), (scaled, false));
        let bytes = std::fs::read(&written).unwrap();
        let at = bytes.windows(4).position(|w| w == b"cHRM").unwrap();
        assert_eq!(bytes[at + 4..at + 36], p3);
        // What is encoded anew has the same values: there is no seam.
        let again = photo.encoding.encode_8(&photo.image);
        assert_eq!(again.as_flattened(), many_colours(), "{scaled:?}");
        assert_eq!(
            read_photo(&written, Transfer::Srgb).unwrap().image,
            photo.image
        );
    }
}

#[test]
fn a_named_curve_overrules_the_gamma_of_a_png_and_the_picture_keeps_it() {
    let folder = folder();
    let chunk = gamma(55_556);
    let photo = photo_with(&folder, &[(b"gAMA", &chunk)], Transfer::Linear);
    let want = Vec3::splat(128.0 / 255.0);
    assert!(photo.image.0.pixels()[256].abs_diff_eq(want, 1e-6));
    let written = folder.path().join("picture.png");
    write_picture(&written, &photo.image, &photo).unwrap();
    assert_eq!(stored(&written).1, Some(55_556));
}

#[test]
fn a_gamma_for_srgb_or_beside_srgb_changes_nothing() {
    let folder = folder();
    let plain = photo_with(&folder, &[], Transfer::Srgb);
    let (gamma22, gamma1, srgb) = (gamma(45_455), gamma(100_000), chromaticities(SRGB));
    let p3 = chromaticities(P3);
    for chunks in [
        &[(b"gAMA", &gamma22[..])][..],
        &[(b"gAMA", &gamma22), (b"cHRM", &srgb)],
        &[(b"sRGB", &[0]), (b"gAMA", &gamma1), (b"cHRM", &p3)],
        &[(b"cICP", &[1, 13, 0, 1]), (b"gAMA", &gamma1)],
    ] {
        let photo = photo_with(&folder, chunks, Transfer::Srgb);
        assert_eq!(photo, plain, "{chunks:?}");
        assert_eq!(photo.encoding, Encoding::named(Transfer::Srgb));
    }
}

#[test]
fn chunks_of_colour_that_cannot_be_used_are_said() {
    let folder = folder();
    let plain = photo_with(&folder, &[], Transfer::Srgb);
    let (p3, line, gamma0) = (chromaticities(P3), chromaticities([30_000; 8]), gamma(0));
    let cases: [(&[u8; 4], &[u8], &str); 4] = [
        (
            b"cHRM",
            &line,
            "primaries (cHRM) lie on one line; it is read with sRGB's",
        ),
        (
            b"cICP",
            &[12, 13, 0, 1],
            "colour space (cICP 12, 13, 0, 1) cannot be used; it is read as sRGB",
        ),
        (
            b"cICP",
            &[9, 16, 0, 1],
            "colour space (cICP 9, 16, 0, 1) cannot be used; it is read as sRGB",
        ),
        (
            b"gAMA",
            &gamma0,
            "gamma (gAMA) is 0, not 0.1 to 10; it is read as sRGB",
        ),
    ];
    for (kind, data, what) in cases {
        let photo = photo_with(&folder, &[(kind, data)], Transfer::Srgb);
        let name = folder.path().join("photo.png");
        let want = format!(
            "`{}`: its {what}: convert it to sRGB if its colours look wrong",
            name.display()
        );
        assert_eq!(photo.warnings, [want]);
        assert_eq!(photo.image, plain.image);
        let named = photo_with(&folder, &[(kind, data)], Transfer::Linear);
        assert_eq!(named.encoding, Encoding::named(Transfer::Linear));
        assert!(!named.warnings[0].contains("read as sRGB"));
    }
    // Grey has no primaries.
    let path = put_png(&folder, png::ColorType::Grayscale, &[9], &[(b"cHRM", &p3)]);
    let grey = read_photo(path, Transfer::Srgb).unwrap();
    assert_eq!(grey.warnings, Vec::<String>::new());
}

#[test]
fn transparency_is_said_to_be_dropped_once() {
    use png::ColorType::{GrayscaleAlpha, Indexed, Rgba};
    let folder = folder();
    let warnings = |color, values: &[u8], chunks: &[(&[u8; 4], &[u8])]| {
        let path = put_png(&folder, color, values, chunks);
        read_photo(path, Transfer::Srgb).unwrap().warnings
    };
    let name = folder.path().join("photo.png");
    let want = format!(
        "`{}`: the photograph's transparency is dropped; its pixels count as opaque",
        name.display()
    );
    let want = std::slice::from_ref(&want);
    assert_eq!(warnings(Rgba, &[1, 2, 3, 0, 4, 5, 6, 254], &[]), want);
    assert_eq!(warnings(GrayscaleAlpha, &[1, 255, 4, 128], &[]), want);
    let half: (&[u8; 4], &[u8]) = (b"tRNS", &[255, 100]);
    assert_eq!(warnings(Indexed, &[0, 1], &[half]), want);
    assert!(warnings(Rgba, &[1, 2, 3, 255, 4, 5, 6, 255], &[]).is_empty());
    assert!(warnings(Indexed, &[0, 0], &[half]).is_empty());
}
