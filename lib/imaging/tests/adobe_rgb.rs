//! Photographs of cameras that are set to Adobe RGB and write no profile.
use dipir_imaging::file::{Photo, read_photo};
use dipir_imaging::transfer::Transfer;
use image::ExtendedColorType::{L8, Rgb8};
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};
use moxcms::ColorProfile;

/// Exif data of three directories of one entry or two: the interoperability index, beside a colour space.
fn exif(index: &[u8; 4], colour_space: u8) -> Vec<u8> {
    let entry = |tag: u16, kind: u16, count: u32, value: [u8; 4]| {
        let [tag, kind] = [tag, kind].map(u16::to_be_bytes);
        [&tag[..], &kind, &count.to_be_bytes(), &value].concat()
    };
    let directory = |entries: &[Vec<u8>]| {
        let count = (entries.len() as u16).to_be_bytes();
        [&count[..], &entries.concat(), &[0; 4]].concat()
    };
    // A directory of n entries has 12 n + 6 bytes; the header has 8.
    let first = directory(&[entry(0x8769, 4, 1, [0, 0, 0, 26])]);
    let photo = directory(&[
        entry(0xa001, 3, 1, [0, colour_space, 0, 0]),
        entry(0xa005, 4, 1, [0, 0, 0, 56]),
    ]);
    let between = directory(&[entry(1, 2, 4, *index)]);
    [b"MM\0\x2a\0\0\0\x08", &first[..], &photo, &between].concat()
}

fn read(color: ExtendedColorType, exif: Vec<u8>, icc: Option<Vec<u8>>) -> Photo {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.jpg");
    let mut file = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut file, 100);
    encoder.set_exif_metadata(exif).unwrap();
    if let Some(icc) = icc {
        encoder.set_icc_profile(icc).unwrap();
    }
    let channels = if color == L8 { 1 } else { 3 };
    let values: Vec<u8> = [40, 200, 60]
        .into_iter()
        .cycle()
        .take(64 * channels)
        .collect();
    encoder.write_image(&values, 8, 8, color).unwrap();
    std::fs::write(&path, file).unwrap();
    read_photo(&path, Transfer::Srgb).unwrap()
}

#[test]
fn a_jpeg_whose_exif_data_say_adobe_rgb_is_read_as_with_its_profile() {
    let adobe = ColorProfile::new_adobe_rgb().encode().unwrap();
    let said = read(Rgb8, exif(b"R03\0", 255), None);
    let with_profile = read(Rgb8, exif(b"R98\0", 255), Some(adobe));
    assert_eq!(said.image, with_profile.image);
    assert_eq!(said.encoding, with_profile.encoding);
    assert!(said.warnings.is_empty(), "{:?}", said.warnings);
    let srgb = read(Rgb8, exif(b"R98\0", 1), None);
    assert_ne!(said.image, srgb.image);
}

#[test]
fn a_profile_the_colour_space_srgb_and_grey_overrule_the_index() {
    let p3 = ColorProfile::new_display_p3().encode().unwrap();
    for (color, space, icc) in [(Rgb8, 255, Some(p3)), (Rgb8, 1, None), (L8, 255, None)] {
        let said = read(color, exif(b"R03\0", space), icc.clone());
        let plain = read(color, exif(b"R98\0", space), icc);
        assert_eq!(said.image, plain.image);
        assert_eq!(said.encoding, plain.encoding);
    }
}
