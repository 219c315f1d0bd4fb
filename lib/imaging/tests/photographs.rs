//! Colour profiles and Exif data of photographs: what is read, and what the written picture keeps.
use dipir_imaging::{
    encoding::Encoding,
    facts::{FocalSource, Heading},
    file::{Photo, read_photo, write_picture},
    raster::{LinearImage, Raster},
    transfer::Transfer,
};
use glam::Vec3;
use moxcms::{ColorProfile, ToneReprCurve};
use proptest::prelude::*;
use std::{
    borrow::Cow,
    path::{Path, PathBuf},
};
use tempfile::TempDir;

fn folder() -> TempDir {
    tempfile::tempdir().unwrap()
}

/// An RGB or grey PNG with a profile and Exif data.
fn put_png(
    folder: &TempDir,
    size: (u32, u32),
    values: &[u8],
    icc: Option<&[u8]>,
    exif: Option<&[u8]>,
) -> PathBuf {
    let path = folder.path().join("photo.png");
    let mut info = png::Info::with_size(size.0, size.1);
    let grey = values.len() == (size.0 * size.1) as usize;
    info.color_type = match grey {
        true => png::ColorType::Grayscale,
        false => png::ColorType::Rgb,
    };
    info.icc_profile = icc.map(Cow::Borrowed);
    info.exif_metadata = exif.map(Cow::Borrowed);
    let file = std::fs::File::create(&path).unwrap();
    let mut writer = png::Encoder::with_info(file, info)
        .unwrap()
        .write_header()
        .unwrap();
    writer.write_image_data(values).unwrap();
    writer.finish().unwrap();
    path
}

/// The pixels of a PNG, its profile and its Exif data.
type Stored = (Vec<u8>, Option<Vec<u8>>, Option<Vec<u8>>);

fn stored(path: &Path) -> Stored {
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut values = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut values).unwrap();
    let info = reader.info();
    let kept = |data: &Option<Cow<'_, [u8]>>| data.as_ref().map(|d| d.to_vec());
    (values, kept(&info.icc_profile), kept(&info.exif_metadata))
}

/// Every value in each colour beside black, middle and white in the others.
fn many_colours() -> Vec<u8> {
    let mut values = Vec::new();
    for v in 0..=255u8 {
        for (a, b) in [(0, 0), (0, 255), (255, 0), (255, 255), (128, 64), (v, v)] {
            values.extend([v, a, b, a, v, b, b, a, v]);
        }
    }
    values
}

fn profile(of: &ColorProfile) -> Vec<u8> {
    of.encode().unwrap()
}

fn with_gamma(mut of: ColorProfile, curve: ToneReprCurve) -> ColorProfile {
    of.red_trc = Some(curve.clone());
    of.green_trc = Some(curve.clone());
    of.blue_trc = Some(curve);
    of.cicp = None;
    of
}

/// Profiles whose pictures must come back, and the user's curve.
fn encodings() -> Vec<(&'static str, Option<Vec<u8>>, Transfer)> {
    let p3 = profile(&ColorProfile::new_display_p3());
    let table = (0..1024u64).map(|i| (i * i * 65_535 / (1023 * 1023)) as u16);
    let table = ToneReprCurve::Lut(table.collect());
    vec![
        ("none", None, Transfer::Srgb),
        ("gamma22", None, Transfer::Gamma22),
        ("linear", None, Transfer::Linear),
        (
            "sRGB",
            Some(profile(&ColorProfile::new_srgb())),
            Transfer::Srgb,
        ),
        ("Display P3", Some(p3.clone()), Transfer::Srgb),
        ("Display P3, overruled", Some(p3), Transfer::Gamma22),
        (
            "Adobe RGB",
            Some(profile(&ColorProfile::new_adobe_rgb())),
            Transfer::Srgb,
        ),
        (
            "ProPhoto",
            Some(profile(&ColorProfile::new_pro_photo_rgb())),
            Transfer::Srgb,
        ),
        (
            "a table",
            Some(profile(&with_gamma(ColorProfile::new_bt2020(), table))),
            Transfer::Srgb,
        ),
        (
            "linear P3",
            Some(profile(&with_gamma(
                ColorProfile::new_display_p3(),
                ToneReprCurve::Lut(vec![]),
            ))),
            Transfer::Srgb,
        ),
    ]
}

#[test]
fn pixels_that_nothing_touched_come_back_unchanged_with_their_profile() {
    let folder = folder();
    let values = many_colours();
    let size = (values.len() as u32 / 3, 1);
    for (name, icc, transfer) in encodings() {
        let path = put_png(&folder, size, &values, icc.as_deref(), None);
        let photo = read_photo(&path, transfer).unwrap();
        assert_eq!(photo.warnings, Vec::<String>::new(), "{name}");
        let written = folder.path().join("picture.png");
        write_picture(&written, &photo.image, &photo).unwrap();
        let (back, profile, _) = stored(&written);
        assert_eq!(back, values, "{name}");
        assert_eq!(profile, icc, "{name}");
        // What is encoded anew is the same value, too, so that there is no seam: f32 light keeps an
        // 8-bit value where the curve is not steeper than a pure power near black.
        let again = photo.encoding.encode_8(&photo.image);
        let differing = again.as_flattened().iter().zip(&values);
        let differing = differing.filter(|(a, b)| a != b).count();
        assert!(differing * 500 < values.len(), "{name}: {differing}");
    }
}

#[test]
fn colours_agree_with_a_colour_management_system() {
    use moxcms::{Layout, RenderingIntent, TransformOptions};
    let linear = with_gamma(ColorProfile::new_srgb(), ToneReprCurve::Lut(vec![]));
    let colours: [[u8; 3]; 5] = [
        [200, 90, 40],
        [17, 180, 90],
        [255; 3],
        [90, 90, 200],
        [128; 3],
    ];
    for source in [
        ColorProfile::new_display_p3(),
        ColorProfile::new_adobe_rgb(),
        ColorProfile::new_srgb(),
    ] {
        let options = TransformOptions {
            rendering_intent: RenderingIntent::RelativeColorimetric,
            ..TransformOptions::default()
        };
        let transform = source
            .create_transform_f32(Layout::Rgb, &linear, Layout::Rgb, options)
            .unwrap();
        let folder = folder();
        let icc = profile(&source);
        let path = put_png(&folder, (5, 1), colours.as_flattened(), Some(&icc), None);
        let photo = read_photo(&path, Transfer::Srgb).unwrap();
        for (got, colour) in photo.image.0.pixels().iter().zip(colours) {
            let from = colour.map(|v| f32::from(v) / 255.0);
            let mut to = [0.0f32; 3];
            transform.transform(&from, &mut to).unwrap();
            // Profiles hold 16 bits: 1.5e-5 a number, and the system clips what is outside.
            let got = got.clamp(Vec3::ZERO, Vec3::ONE);
            assert!(got.abs_diff_eq(Vec3::from_array(to), 1e-3), "{got} {to:?}");
        }
    }
    // Display P3's red is beyond Rec.709.
    let folder = folder();
    let icc = profile(&ColorProfile::new_display_p3());
    let path = put_png(&folder, (1, 1), &[255, 0, 0], Some(&icc), None);
    let red = read_photo(&path, Transfer::Srgb).unwrap().image.0.pixels()[0];
    let want = Vec3::new(1.2249, -0.0421, -0.0196);
    assert!(red.abs_diff_eq(want, 1e-3), "{red}");
}

#[test]
fn a_photograph_of_srgb_is_read_as_without_its_profile() {
    let folder = folder();
    let values = many_colours();
    let size = (values.len() as u32 / 3, 1);
    let plain = read_photo(put_png(&folder, size, &values, None, None), Transfer::Srgb).unwrap();
    let icc = profile(&ColorProfile::new_srgb());
    let tagged = put_png(&folder, size, &values, Some(&icc), None);
    let tagged = read_photo(tagged, Transfer::Srgb).unwrap();
    assert_eq!(plain.image, tagged.image);
}

#[test]
fn a_grey_profile_is_honoured_and_the_picture_gets_one_of_three_colours() {
    let folder = folder();
    let values: Vec<u8> = (0..=255).collect();
    let icc = profile(&ColorProfile::new_gray_with_gamma(1.8));
    let path = put_png(&folder, (256, 1), &values, Some(&icc), None);
    let photo = read_photo(path, Transfer::Srgb).unwrap();
    let light = photo.image.0.pixels()[128];
    // The profile stores the exponent in steps of 1/256.
    assert!(
        (light.x - (128.0f32 / 255.0).powf(1.8)).abs() < 2e-3,
        "{light}"
    );
    let written = folder.path().join("picture.png");
    write_picture(&written, &photo.image, &photo).unwrap();
    let spread: Vec<u8> = values.iter().flat_map(|&v| [v; 3]).collect();
    assert_eq!(stored(&written).0, spread);
    let again = read_photo(&written, Transfer::Srgb).unwrap();
    let apart = again.image.0.pixels()[128] - light;
    assert!(apart.abs().max_element() < 1e-3, "{apart}");
}

#[test]
fn a_profile_that_cannot_be_used_is_said_and_not_a_failure() {
    let folder = folder();
    let p3 = profile(&ColorProfile::new_display_p3());
    let grey = profile(&ColorProfile::new_gray_with_gamma(2.2));
    for icc in [&p3[..100], b"not a profile", &grey] {
        let path = put_png(&folder, (1, 1), &[10, 20, 30], Some(icc), None);
        let photo = read_photo(&path, Transfer::Srgb).unwrap();
        assert_eq!(photo.warnings.len(), 1);
        assert!(photo.warnings[0].contains("it is read as sRGB"));
        assert_eq!(photo.encoding, Encoding::named(Transfer::Srgb));
    }
}

/// The decoder stops unpacking it at a limit and passes on none.
#[test]
fn a_profile_too_large_to_be_unpacked_is_said() {
    let folder = folder();
    let path = put_png(
        &folder,
        (1, 1),
        &[10, 20, 30],
        Some(&vec![0; 80 << 20]),
        None,
    );
    let photo = read_photo(&path, Transfer::Srgb).unwrap();
    assert_eq!(photo.warnings.len(), 1);
    assert!(photo.warnings[0].contains("it is read as sRGB"));
    let without = put_png(&folder, (1, 1), &[10, 20, 30], None, None);
    assert_eq!(
        read_photo(&without, Transfer::Srgb).unwrap().warnings.len(),
        0
    );
}

#[test]
fn what_changed_is_encoded_and_clipped() {
    let folder = folder();
    let icc = profile(&ColorProfile::new_display_p3());
    let path = put_png(&folder, (3, 1), &[100; 9], Some(&icc), None);
    let photo = read_photo(path, Transfer::Srgb).unwrap();
    let mut picture = photo.image.clone();
    *picture.0.get_mut(0, 0) = Vec3::splat(1e6);
    *picture.0.get_mut(1, 0) = Vec3::splat(-1.0);
    let written = folder.path().join("picture.png");
    write_picture(&written, &picture, &photo).unwrap();
    let values = stored(&written).0;
    assert_eq!(values[..6], [255, 255, 255, 0, 0, 0]);
    assert_eq!(values[6..], [100; 3]);
    *picture.0.get_mut(2, 0) = Vec3::splat(f32::NAN);
    assert!(write_picture(&written, &picture, &photo).is_err());
    let small = LinearImage(Raster::filled(1, 1, Vec3::ONE));
    assert!(write_picture(&written, &small, &photo).is_err());
}

/// An Exif entry: tag, kind, and its values' bytes in big endian.
struct Entry(u16, u16, u32, Vec<u8>);

fn short(tag: u16, value: u16) -> Entry {
    Entry(tag, 3, 1, value.to_be_bytes().to_vec())
}

fn text(tag: u16, value: &str) -> Entry {
    let bytes = [value.as_bytes(), b"\0"].concat();
    Entry(tag, 2, bytes.len() as u32, bytes)
}

fn rationals(tag: u16, values: &[(u32, u32)]) -> Entry {
    let bytes = values
        .iter()
        .flat_map(|(n, d)| [n.to_be_bytes(), d.to_be_bytes()]);
    Entry(tag, 5, values.len() as u32, bytes.flatten().collect())
}

/// One directory at `at`; what is longer than four bytes follows it.
fn directory(at: usize, mut entries: Vec<Entry>) -> Vec<u8> {
    entries.sort_by_key(|e| e.0);
    let mut out = (entries.len() as u16).to_be_bytes().to_vec();
    let mut beyond = Vec::new();
    let start = at + 2 + 12 * entries.len() + 4;
    for Entry(tag, kind, count, mut value) in entries {
        out.extend(tag.to_be_bytes());
        out.extend(kind.to_be_bytes());
        out.extend(count.to_be_bytes());
        if value.len() > 4 {
            out.extend(((start + beyond.len()) as u32).to_be_bytes());
            beyond.append(&mut value);
        } else {
            value.resize(4, 0);
            out.append(&mut value);
        }
    }
    out.extend([0; 4]);
    out.append(&mut beyond);
    out
}

/// Exif data with three directories.
fn exif(mut first: Vec<Entry>, photo: Vec<Entry>, gps: Vec<Entry>) -> Vec<u8> {
    let long = |tag, value: usize| Entry(tag, 4, 1, (value as u32).to_be_bytes().to_vec());
    let mut out = b"MM\0\x2a\0\0\0\x08".to_vec();
    // The length of the first one does not depend on where the others are.
    first.extend([long(0x8769, 0), long(0x8825, 0)]);
    let copies = || first.iter().map(|e| Entry(e.0, e.1, e.2, e.3.clone()));
    let photo_at = 8 + directory(8, copies().collect()).len();
    let photo = directory(photo_at, photo);
    let gps_at = photo_at + photo.len();
    let mut entries: Vec<Entry> = copies()
        .filter(|e| e.0 != 0x8769 && e.0 != 0x8825)
        .collect();
    entries.extend([long(0x8769, photo_at), long(0x8825, gps_at)]);
    out.extend(directory(8, entries));
    out.extend(photo);
    out.extend(directory(gps_at, gps));
    out
}

fn with_exif(exif: &[u8], size: (u32, u32)) -> Photo {
    let folder = folder();
    let values = vec![90; (3 * size.0 * size.1) as usize];
    read_photo(
        put_png(&folder, size, &values, None, Some(exif)),
        Transfer::Srgb,
    )
    .unwrap()
}

#[test]
fn all_eight_orientations_give_the_same_upright_photograph() {
    let folder = folder();
    let (width, height) = (3usize, 2usize);
    let upright: Vec<u8> = (0..18).map(|v| 10 * v).collect();
    let at = |x: usize, y: usize| &upright[3 * (y * width + x)..][..3];
    for turn in 1..=8u16 {
        // Stored so that this turn makes it upright again [Exif 2.3, where the 0th row and column are].
        let (w, h) = if turn < 5 {
            (width, height)
        } else {
            (height, width)
        };
        let mut values = Vec::new();
        for row in 0..h {
            for column in 0..w {
                let (right, bottom) = (width - 1, height - 1);
                values.extend(match turn {
                    1 => at(column, row),
                    2 => at(right - column, row),
                    3 => at(right - column, bottom - row),
                    4 => at(column, bottom - row),
                    5 => at(row, column),
                    6 => at(right - row, column),
                    7 => at(right - row, bottom - column),
                    _ => at(row, bottom - column),
                });
            }
        }
        let data = exif(vec![short(0x112, turn)], vec![], vec![]);
        let path = put_png(&folder, (w as u32, h as u32), &values, None, Some(&data));
        let photo = read_photo(path, Transfer::Srgb).unwrap();
        let got = photo.values.as_ref().unwrap();
        assert_eq!(got.pixels().as_flattened(), upright, "{turn}");
        assert_eq!(photo.facts.size, [3, 2]);
        assert_eq!(photo.facts.orientation, turn as u8);
        // The written picture is upright, and says so.
        let written = folder.path().join("picture.png");
        write_picture(&written, &photo.image, &photo).unwrap();
        let again = read_photo(&written, Transfer::Srgb).unwrap();
        assert_eq!(again.image, photo.image);
        assert_eq!(again.facts.orientation, 1);
    }
}

#[test]
fn time_place_heading_and_camera_are_read_and_kept() {
    let data = exif(
        vec![
            text(0x10f, "Maker"),
            text(0x110, "Camera 3"),
            short(0x112, 6),
        ],
        vec![
            text(0x9003, "2024:06:21 12:34:56"),
            text(0x9011, "+02:00"),
            rationals(0x920a, &[(43, 10)]),
            short(0xa405, 26),
            rationals(0x829a, &[(1, 50)]),
            rationals(0x829d, &[(2, 1)]),
            short(0x8827, 800),
        ],
        vec![
            text(1, "S"),
            rationals(2, &[(33, 1), (30, 1), (36, 1)]),
            text(3, "W"),
            rationals(4, &[(70, 1), (1530, 100), (0, 0)]),
            Entry(5, 1, 1, vec![0]),
            rationals(6, &[(5235, 10)]),
            text(0x10, "T"),
            rationals(0x11, &[(2705, 10)]),
        ],
    );
    let photo = with_exif(&data, (40, 30));
    let facts = &photo.facts;
    assert_eq!(facts.size, [30, 40]);
    assert_eq!(facts.make.as_deref(), Some("Maker"));
    assert_eq!(facts.model.as_deref(), Some("Camera 3"));
    assert_eq!(facts.time.as_deref(), Some("2024-06-21T12:34:56+02:00"));
    assert!((facts.latitude_deg.unwrap() + 33.51).abs() < 1e-9);
    assert!((facts.longitude_deg.unwrap() + 70.255).abs() < 1e-9);
    assert_eq!(facts.altitude_m, Some(523.5));
    let want = Heading {
        deg: 270.5,
        magnetic: false,
    };
    assert_eq!(facts.heading, Some(want));
    // 1/50 s at ISO 800 and f/2: 4, two stops.
    assert!((facts.exposure_stops.unwrap() - 2.0).abs() < 1e-9);
    // 26 mm on a diagonal of 43.27 mm, on one of 50 pixels.
    let focal_px = 26.0 / 43.266_615_305 * 50.0;
    assert!((facts.focal_px.unwrap() - focal_px).abs() < 1e-6);
    let [horizontal, vertical] = facts.field_of_view_rad().unwrap();
    assert!((horizontal - 2.0 * (15.0 / focal_px).atan()).abs() < 1e-9);
    assert!(vertical > horizontal);
    assert_eq!(facts.focal_source, Some(FocalSource::Equivalent35mm));
    let width = facts.sensor_width_mm().unwrap();
    assert!((width - 4.3 / focal_px * 30.0).abs() < 1e-9);
    let kept = photo.exif.unwrap();
    assert_eq!(kept.len(), data.len());
    let differing = kept.iter().zip(&data).filter(|(a, b)| a != b);
    assert_eq!(differing.count(), 1, "the orientation alone");
}

#[test]
fn the_field_of_view_comes_from_the_focal_plane_else_from_a_table_else_is_unknown() {
    let focal = || rationals(0x920a, &[(50, 1)]);
    // 100 pixels a centimetre: 400 of them are 40 mm, of which 40 are left.
    let plane = vec![
        focal(),
        rationals(0xa20e, &[(100, 1)]),
        short(0xa210, 3),
        short(0xa002, 400),
    ];
    let facts = with_exif(&exif(vec![], plane, vec![]), (40, 30)).facts;
    assert_eq!(facts.focal_source, Some(FocalSource::FocalPlaneResolution));
    assert_eq!(facts.sensor_mm, Some([40.0, 30.0]));
    assert_eq!(facts.focal_px, Some(50.0));

    let camera = || vec![text(0x10f, "NIKON CORPORATION"), text(0x110, "NIKON D750")];
    let facts = with_exif(&exif(camera(), vec![focal()], vec![]), (36, 24)).facts;
    assert_eq!(facts.focal_source, Some(FocalSource::Table));
    assert_eq!(facts.focal_px, Some(50.0));
    let unknown = with_exif(
        &exif(vec![text(0x10f, "NN")], vec![focal()], vec![]),
        (36, 24),
    )
    .facts;
    assert_eq!((unknown.focal_px, unknown.sensor_mm), (None, None));
    assert_eq!(unknown.focal_mm, Some(50.0));
    assert_eq!(unknown.field_of_view_rad(), None);
}

#[test]
fn without_an_offset_the_satellites_time_is_taken_and_nonsense_is_left_out() {
    let local = || text(0x9003, "2024:06:21 12:34:56");
    let gps = vec![
        text(0x1d, "2024:06:21"),
        rationals(7, &[(10, 1), (34, 1), (5590, 100)]),
    ];
    let facts = with_exif(&exif(vec![], vec![local()], gps), (2, 2)).facts;
    assert_eq!(facts.time.as_deref(), Some("2024-06-21T10:34:55Z"));
    let facts = with_exif(&exif(vec![], vec![local()], vec![]), (2, 2)).facts;
    assert_eq!(facts.time.as_deref(), Some("2024-06-21T12:34:56"));
    let unknown = vec![text(0x1d, "2024:06:21"), rationals(7, &[(0, 0); 3])];
    let facts = with_exif(&exif(vec![], vec![local()], unknown), (2, 2)).facts;
    assert_eq!(facts.time.as_deref(), Some("2024-06-21T12:34:56"));
    let nonsense = exif(
        vec![],
        vec![
            text(0x9003, "0000:00:00 00:00:00"),
            rationals(0x920a, &[(0, 0)]),
        ],
        vec![
            rationals(2, &[(300, 1)]),
            text(1, "N"),
            rationals(0x11, &[(999, 1)]),
        ],
    );
    let facts = with_exif(&nonsense, (2, 2)).facts;
    assert_eq!(facts, dipir_imaging::facts::Facts::of_size([2, 2]));
}

#[test]
fn a_place_that_the_device_did_not_know_is_none() {
    let place_of = |latitude: [(u32, u32); 3], longitude: [(u32, u32); 3]| {
        let gps = vec![
            text(1, "N"),
            rationals(2, &latitude),
            text(3, "E"),
            rationals(4, &longitude),
        ];
        let facts = with_exif(&exif(vec![], vec![], gps), (2, 2)).facts;
        facts.latitude_deg.zip(facts.longitude_deg)
    };
    let [unknown, zero, nine] = [[(0, 0); 3], [(0, 1); 3], [(9, 1), (30, 1), (0, 0)]];
    assert_eq!(place_of(unknown, unknown), None);
    assert_eq!(place_of(nine, unknown), None);
    assert_eq!(place_of(zero, zero), None);
    assert_eq!(place_of(zero, nine), Some((0.0, 9.5)));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    /// Facts or none, never a panic; angles stay in their ranges.
    #[test]
    fn damaged_exif_data_never_panic(
        damage in proptest::collection::vec((0usize..400, any::<u8>()), 0..8),
        length in 0usize..400,
    ) {
        let mut data = exif(
            vec![text(0x10f, "Maker"), short(0x112, 6)],
            vec![text(0x9003, "2024:06:21 12:34:56"), rationals(0x920a, &[(43, 10)])],
            vec![text(1, "S"), rationals(2, &[(33, 1), (30, 1), (36, 1)]), text(3, "W"),
                rationals(4, &[(70, 1), (15, 1), (0, 1)]), rationals(0x11, &[(2705, 10)])],
        );
        for (at, value) in damage {
            let at = at % data.len();
            data[at] = value;
        }
        data.truncate(length);
        let facts = dipir_imaging::facts::Facts::of_exif(&data, [40, 30]);
        prop_assert!(facts.latitude_deg.is_none_or(|v| v.abs() <= 90.0));
        prop_assert!(facts.longitude_deg.is_none_or(|v| v.abs() <= 180.0));
        prop_assert!(facts.focal_px.is_none_or(|v| v > 0.0 && v.is_finite()));
    }

    /// An encoding or a reason, never a panic; what is decoded is finite.
    #[test]
    fn damaged_profiles_never_panic(
        damage in proptest::collection::vec((0usize..600, any::<u8>()), 0..8),
        length in 0usize..800,
        grey in any::<bool>(),
    ) {
        let mut icc = match grey {
            true => profile(&ColorProfile::new_gray_with_gamma(2.2)),
            false => profile(&ColorProfile::new_adobe_rgb()),
        };
        for (at, value) in damage {
            let at = at % icc.len();
            icc[at] = value;
        }
        icc.truncate(length);
        if let Ok(encoding) = Encoding::of_profile(&icc, if grey { 1 } else { 3 }) {
            let image = LinearImage(Raster::filled(2, 1, Vec3::splat(0.5)));
            prop_assert_eq!(encoding.encode_8(&image).len(), 2);
        }
    }
}
