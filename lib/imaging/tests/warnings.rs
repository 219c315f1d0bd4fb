//! What photographs say of how they are to be shown and what is only told.
use dipir_imaging::file::{Photo, read_photo};
use dipir_imaging::transfer::Transfer;
use std::path::Path;

const SIZE: (u32, u32) = (8, 4);

fn read(path: &Path) -> Photo {
    read_photo(path, Transfer::Srgb).unwrap()
}

/// A grey PNG with densities, XMP and Exif data.
fn png(folder: &Path, densities: Option<[u32; 2]>, xmp: &str, exif: Option<&[u8]>) -> Photo {
    let path = folder.join("photo.png");
    let mut info = png::Info::with_size(SIZE.0, SIZE.1);
    info.color_type = png::ColorType::Grayscale;
    info.exif_metadata = exif.map(Into::into);
    info.pixel_dims = densities.map(|[xppu, yppu]| png::PixelDimensions {
        xppu,
        yppu,
        unit: png::Unit::Unspecified,
    });
    let file = std::fs::File::create(&path).unwrap();
    let mut encoder = png::Encoder::with_info(file, info).unwrap();
    if !xmp.is_empty() {
        let key = "XML:com.adobe.xmp".to_string();
        encoder.add_itxt_chunk(key, xmp.to_string()).unwrap();
    }
    let mut writer = encoder.write_header().unwrap();
    writer.write_image_data(&[90; 32]).unwrap();
    writer.finish().unwrap();
    read(&path)
}

/// A JPEG of the test, with these bytes behind its first two.
fn jpeg(folder: &Path, segment: &[u8]) -> Photo {
    let mut bytes = Vec::new();
    let pixels = image::RgbImage::from_pixel(SIZE.0, SIZE.1, image::Rgb([90; 3]));
    let mut encoder = image::codecs::jpeg::JpegEncoder::new(&mut bytes);
    encoder.encode_image(&pixels).unwrap();
    let path = folder.join("photo.jpg");
    std::fs::write(&path, [&bytes[..2], segment, &bytes[2..]].concat()).unwrap();
    read(&path)
}

#[test]
fn pixels_that_are_not_square_are_told() {
    let folder = tempfile::tempdir().unwrap();
    for square in [None, Some([2835, 2835]), Some([2835, 2834]), Some([0, 7])] {
        let photo = png(folder.path(), square, "", None);
        assert!(photo.warnings.is_empty(), "{:?}", photo.warnings);
    }
    let wide = png(folder.path(), Some([54, 59]), "", None);
    assert_eq!(
        wide.warnings,
        [format!(
            "`{}`: its pHYs says that its pixels are not square (54 a unit across, 59 down); they are taken as square: \
             scale it to square pixels if it looks stretched",
            folder.path().join("photo.png").display()
        )]
    );
    let jfif = |across: u8, down: u8| {
        let segment = b"\xff\xe0\0\x10JFIF\0\x01\x01\0";
        jpeg(
            folder.path(),
            &[&segment[..], &[0, across, 0, down, 0, 0]].concat(),
        )
        .warnings
    };
    assert!(jfif(72, 72).is_empty());
    assert!(
        jfif(16, 15)[0].contains("its JFIF says that its pixels are not square (16 a unit across")
    );
}

#[test]
fn a_turn_that_stands_in_xmp_alone_is_told_and_not_applied() {
    let folder = tempfile::tempdir().unwrap();
    let xmp = "<x:xmpmeta><rdf:Description tiff:Orientation=\"6\"/></x:xmpmeta>";
    let photo = png(folder.path(), None, xmp, None);
    let want = "its XMP says that it is to be turned (tiff:Orientation 6), and its Exif data do not; it is read as it is stored";
    assert!(photo.warnings[0].contains(want), "{:?}", photo.warnings);
    assert_eq!((photo.facts.size, photo.facts.orientation), ([8, 4], 1));
    let packet = [&b"http://ns.adobe.com/xap/1.0/\0"[..], xmp.as_bytes()].concat();
    let length = (packet.len() as u16 + 2).to_be_bytes();
    let photo = jpeg(
        folder.path(),
        &[&b"\xff\xe1"[..], &length, &packet].concat(),
    );
    assert!(photo.warnings[0].contains(want), "{:?}", photo.warnings);
    // Where Exif data name a turn, that one counts: a directory of the tag Orientation, 1.
    let exif = b"MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x01\0\0\0\0\0\0";
    let photo = png(folder.path(), None, xmp, Some(exif));
    assert!(photo.warnings.is_empty(), "{:?}", photo.warnings);
}
