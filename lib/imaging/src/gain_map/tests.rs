use crate::{
    file::{Photo, read_photo},
    transfer::Transfer,
};
use glam::Vec3;
use image::{Rgb, RgbImage, codecs::jpeg::JpegEncoder};
use proptest::prelude::*;

const XMP: &str = "http://ns.adobe.com/xap/1.0/\0";
const BINARY: &[u8] = b"urn:iso:std:iso:ts:21496:-1\0";

/// A JPEG of flat blocks of 8 x 8 pixels in one row, so that they stay flat, with segments in front.
fn jpeg(blocks: &[[u8; 3]], segments: &[Vec<u8>]) -> Vec<u8> {
    let picture = RgbImage::from_fn(8 * blocks.len() as u32, 8, |x, _| {
        Rgb(blocks[x as usize / 8])
    });
    let mut bytes = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, 100);
    encoder.encode_image(&picture).unwrap();
    [&bytes[..2], &segments.concat(), &bytes[2..]].concat()
}

/// A grey JPEG of two pixels, white and black.
fn falling(segments: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, 100);
    let grey = image::ExtendedColorType::L8;
    encoder.encode(&[255, 0], 2, 1, grey).unwrap();
    [&bytes[..2], &segments.concat(), &bytes[2..]].concat()
}

fn segment(marker: u8, content: &[u8]) -> Vec<u8> {
    let length = (content.len() as u16 + 2).to_be_bytes();
    [&[0xff, marker], &length[..], content].concat()
}

fn xmp(attributes: &str, elements: &str) -> Vec<u8> {
    let text = format!(
        "{XMP}<rdf:Description xmlns:hdrgm=\"http://ns.adobe.com/hdr-gain-map/1.0/\" hdrgm:Version=\"1.0\" {attributes}>\
         {elements}</rdf:Description>"
    );
    segment(0xe1, text.as_bytes())
}

/// Fractions of ISO 21496-1 with their denominators, or with one for all.
fn binary(flags: u8, common: Option<u32>, fractions: &[(i32, u32)]) -> Vec<u8> {
    let mut data = [BINARY, &[0, 0, 0, 0, flags]].concat();
    data.extend(common.into_iter().flat_map(u32::to_be_bytes));
    for (numerator, denominator) in fractions {
        data.extend(numerator.to_be_bytes());
        if common.is_none() {
            data.extend(denominator.to_be_bytes());
        }
    }
    segment(0xe2, &data)
}

fn read(bytes: &[u8]) -> Photo {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("photo.jpg");
    std::fs::write(&path, bytes).unwrap();
    read_photo(&path, Transfer::Srgb).unwrap()
}

const WHITE: [u8; 3] = [255; 3];
const BLACK: [u8; 3] = [0; 3];
const GREY: [u8; 3] = [128; 3];

/// A white and a grey block with a gain of these values behind them.
fn ultra(values: &[[u8; 3]], segments: &[Vec<u8>]) -> Vec<u8> {
    [jpeg(&[WHITE, GREY], &[xmp("", "")]), jpeg(values, segments)].concat()
}

/// Light in the middles of both blocks.
fn both(photo: &Photo) -> [Vec3; 2] {
    let light = photo.radiance();
    [4, 12].map(|x| *light.0.get(x, 4))
}

fn assert_near(found: Vec3, wanted: [f32; 3]) {
    let off = (found - Vec3::from(wanted)).abs();
    assert!(
        (off / Vec3::from(wanted)).max_element() < 2e-3,
        "{found} for {wanted:?}"
    );
}

#[test]
fn light_is_brighter_where_the_map_says_so_and_the_picture_stays() {
    let plain = read(&jpeg(&[WHITE, GREY], &[]));
    let photo = read(&ultra(
        &[WHITE, BLACK],
        &[xmp("hdrgm:GainMapMax=\"3\" hdrgm:GainMapMin='-1.0'", "")],
    ));
    assert!(photo.warnings.is_empty(), "{:?}", photo.warnings);
    assert_eq!((&photo.image, &photo.values), (&plain.image, &plain.values));
    let [white, grey] = both(&photo);
    // 2^3 with offsets of 1/64, and a gain below 1.
    assert_near(white, [8.109_375; 3]);
    assert_eq!(photo.gain.as_ref().unwrap().most(), 8.109_375);
    assert_eq!(grey, *plain.image.0.get(12, 4));
    // Values of the map are interpolated, then gamma is undone: 9/16 and 7/16 of 3 stops, or their square roots.
    let in_the_middle = |gamma: &str| {
        let text =
            format!("hdrgm:GainMapMax=\"3\" hdrgm:OffsetSDR=\"0\" hdrgm:OffsetHDR=\"0\" {gamma}");
        let picture = jpeg(&[WHITE; 2], &[xmp("", "")]);
        let photo = read(&[picture, falling(&[xmp(&text, "")])].concat());
        let light = photo.radiance();
        [7, 8]
            .map(|x| light.0.get(x, 4).x.log2())
            .iter()
            .sum::<f32>()
    };
    assert!((in_the_middle("") - 3.0).abs() < 0.02);
    let roots = 0.75 + (7.0f32 / 16.0).sqrt();
    assert!((in_the_middle("hdrgm:Gamma=\"2.0\"") - 3.0 * roots).abs() < 0.02);
    let square = read(&ultra(&[WHITE], &[xmp("hdrgm:GainMapMax=\"1\"", "")]));
    assert!(square.gain.is_none() && square.warnings[0].contains("another shape"));
}

#[test]
fn a_smaller_map_is_interpolated_and_turned_as_the_picture() {
    // Orientation 6: upright, the first block is on top. The map's own Exif data do not count.
    let exif = |turn: u8| {
        let tiff = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0";
        segment(0xe1, &[&tiff[..], &[turn, 0, 0, 0, 0, 0, 0]].concat())
    };
    let behind = falling(&[exif(3), xmp("hdrgm:GainMapMax=\"2\"", "")]);
    let photo = read(&[jpeg(&[GREY; 2], &[exif(6), xmp("", "")]), behind].concat());
    assert!(photo.warnings.is_empty(), "{:?}", photo.warnings);
    let light = photo.radiance();
    assert_eq!((light.0.width(), light.0.height()), (8, 16));
    let grey = photo.image.0.get(0, 0).x;
    let gains: Vec<f32> = (0..16)
        .map(|y| (light.0.get(4, y).x + 1.0 / 64.0) / (grey + 1.0 / 64.0))
        .collect();
    assert!((gains[0] - 4.0).abs() < 0.02 && (gains[15] - 1.0).abs() < 0.02);
    assert!(gains.windows(2).all(|pair| pair[0] >= pair[1]), "{gains:?}");
    assert!((gains[7] * gains[8] - 4.0).abs() < 0.05, "{gains:?}");
}

#[test]
fn channels_have_their_own_parameters_in_xmp_and_in_binary() {
    let list = |name: &str, [r, g, b]: [&str; 3]| {
        format!(
            "<hdrgm:{name}>\n<rdf:Seq><rdf:li>{r}</rdf:li> <rdf:li> {g} </rdf:li><rdf:li>{b}</rdf:li></rdf:Seq></hdrgm:{name}>"
        )
    };
    let elements = [
        list("GainMapMax", ["1", "2.0", "3e0"]),
        list("OffsetSDR", ["0", "0.5", "0"]),
        "<hdrgm:OffsetHDR>0.25</hdrgm:OffsetHDR>".into(),
    ]
    .concat();
    let wanted = [1.75, 5.75, 7.75];
    let by_xmp = read(&ultra(&[WHITE, WHITE], &[xmp("", &elements)]));
    assert_near(both(&by_xmp)[0], wanted);
    // Headrooms 0 and 3, then least and greatest gain, gamma and both offsets of each channel.
    let channel = |stops: i32, offset: i32| [(0, 1), (2 * stops, 2), (4, 4), (offset, 4), (1, 4)];
    let fractions = [
        &[(0, 1), (3, 1)][..],
        &channel(1, 0),
        &channel(2, 2),
        &channel(3, 0),
    ]
    .concat();
    let by_binary = read(&ultra(&[WHITE, WHITE], &[binary(0x80, None, &fractions)]));
    assert_eq!(by_binary.gain, by_xmp.gain);
    // One denominator for all, one channel for all; where both are there and one is broken the other counts.
    let common = [(0, 0), (12, 0), (-4, 0), (12, 0), (4, 0), (0, 0), (0, 0)];
    let broken = xmp("hdrgm:GainMapMax=\"many\"", "");
    let photo = read(&ultra(
        &[WHITE, WHITE],
        &[broken, binary(8, Some(4), &common)],
    ));
    assert_near(both(&photo)[0], [8.0; 3]);
    let photo = read(&ultra(
        &[WHITE, WHITE],
        &[
            binary(0, None, &[]),
            xmp(
                "hdrgm:GainMapMax=\"1\" hdrgm:OffsetHDR=\"0\" hdrgm:OffsetSDR=\"0\"",
                "",
            ),
        ],
    ));
    assert_near(both(&photo)[0], [2.0; 3]);
}

#[test]
fn a_gain_map_that_cannot_be_used_is_told_and_the_picture_is_read() {
    let plain = read(&jpeg(&[WHITE, GREY], &[]));
    let by_xmp = |attributes: &str| ultra(&[WHITE, WHITE], &[xmp(attributes, "")]);
    let by_binary = |flags: u8, fractions: &[(i32, u32)]| {
        ultra(&[WHITE, WHITE], &[binary(flags, None, fractions)])
    };
    let one = [(0, 1), (3, 1), (0, 1), (3, 1), (1, 1), (0, 1), (0, 1)];
    let changed = |k: usize, fraction: (i32, u32)| {
        let mut all = one;
        all[k] = fraction;
        all
    };
    let announced = jpeg(&[WHITE, GREY], &[xmp("", "")]);
    let whole = by_xmp("hdrgm:GainMapMax=\"1\"");
    for (bytes, why) in [
        (announced, "announces it and does not hold it"),
        (whole[..whole.len() - 9].to_vec(), "no end-of-image marker"),
        (by_xmp("hdrgm:GainMapMax=\"\""), "GainMapMax is ``"),
        (
            by_xmp("hdrgm:GainMapMax=\"NaN\""),
            "greatest gain in stops is NaN",
        ),
        (by_xmp("hdrgm:GainMapMax=\"1e30\""), "beyond 16"),
        (
            by_xmp("hdrgm:GainMapMax=\"1\" hdrgm:GainMapMin=\"2\""),
            "2 stops, is above",
        ),
        (
            by_xmp("hdrgm:GainMapMax=\"1\" hdrgm:Gamma=\"0\""),
            "gamma is 0",
        ),
        (
            by_xmp("hdrgm:GainMapMax=\"1\" hdrgm:Gamma=\"inf\""),
            "gamma is inf",
        ),
        (
            by_xmp("hdrgm:GainMapMax=\"1\" hdrgm:OffsetSDR=\"-inf\""),
            "offset is -inf",
        ),
        (
            by_xmp("hdrgm:GainMapMax=\"1\" hdrgm:BaseRenditionIsHDR=\"True\""),
            "to a darker one",
        ),
        (by_binary(0, &changed(0, (4, 1))), "to a darker one"),
        (by_binary(0, &changed(4, (1, 0))), "denominator 0"),
        (by_binary(0, &changed(4, (0, 1))), "gamma is 0"),
        (by_binary(0, &changed(3, (i32::MIN, 1))), "beyond 16"),
        (by_binary(0x80, &one), "cut off"),
    ] {
        let photo = read(&bytes);
        let [warning] = &photo.warnings[..] else {
            panic!("{why}: {:?}", photo.warnings);
        };
        assert!(
            warning.contains("its gain map cannot be used (") && warning.contains(why),
            "{warning}"
        );
        assert_eq!(photo.image, plain.image);
        assert_eq!(*photo.radiance(), plain.image);
    }
    // A picture behind another that nothing announces is none of it.
    let pair = [
        jpeg(&[WHITE, GREY], &[]),
        jpeg(&[WHITE, WHITE], &[xmp("hdrgm:GainMapMax=\"1\"", "")]),
    ];
    assert_eq!(read(&pair.concat()), plain);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]
    #[test]
    fn whatever_comes_behind_the_picture_the_picture_is_read_and_its_light_is_finite(
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        payload in prop::collection::vec(any::<u8>(), 0..120),
        number in "[-+0-9.eNafin]{0,6}",
        cut in 0..40usize,
    ) {
        let picture = jpeg(&[WHITE, GREY], &[xmp("", "")]);
        let plain = read(&jpeg(&[WHITE, GREY], &[]));
        let attributes = format!("hdrgm:GainMapMax=\"{number}\" hdrgm:Gamma=\"{number}\"");
        let random = segment(0xe2, &[BINARY, &[0, 0, 0, 0], &payload].concat());
        for segments in [[random, Vec::new()], [xmp(&attributes, ""), Vec::new()]] {
            let mut behind = jpeg(&[WHITE, GREY], &segments);
            for (at, value) in &changes {
                let at = at.index(behind.len());
                behind[at] = *value;
            }
            behind.truncate(behind.len() - cut);
            let photo = read(&[&picture[..], &behind].concat());
            prop_assert_eq!(&photo.image, &plain.image);
            prop_assert_eq!(photo.gain.is_none(), !photo.warnings.is_empty());
            for (light, dark) in photo.radiance().0.pixels().iter().zip(plain.image.0.pixels()) {
                prop_assert!(light.is_finite() && light.cmpge(*dark).all());
            }
        }
    }
}
