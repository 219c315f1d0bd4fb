//! OpenEXR files of other programs, as photographs and as masks.
use crate::*;
use exr::prelude::{
    AnyChannel, AnyChannels, Encoding, FlatSamples, Image, ImageAttributes, IntegerBounds, Layer,
    LayerAttributes, SmallVec, Vec2, WritableImage,
};

/// A file of the channels `channels`, each with its values row by row, in a data window of `size` at `position` and a
/// display window of 3 x 2 pixels.
fn put_exr(
    folder: &TempDir,
    aspect: f32,
    position: (i32, i32),
    size: (usize, usize),
    channels: &[(&str, &[f32])],
) -> PathBuf {
    let path = folder.path().join("x.exr");
    let channels = channels
        .iter()
        .map(|&(name, values)| AnyChannel::new(name, FlatSamples::F32(values.to_vec())));
    let channels = AnyChannels::sort(channels.collect::<SmallVec<_>>());
    let attributes = LayerAttributes {
        layer_position: Vec2(position.0, position.1),
        ..LayerAttributes::default()
    };
    let layer = Layer::new(size, attributes, Encoding::SMALL_LOSSLESS, channels);
    let display = IntegerBounds::new((0, 0), (3, 2));
    let mut image = Image::empty(ImageAttributes::new(display)).with_layer(layer);
    image.attributes.pixel_aspect = aspect;
    image.write().to_file(&path).unwrap();
    path
}

const RAMP: [f32; 6] = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0];
const GREY: [(&str, &[f32]); 1] = [("Y", &RAMP)];

#[test]
fn a_photograph_of_pixels_that_are_not_square_is_refused() {
    let folder = folder();
    for (aspect, shown) in [(2.0, "2.000"), (1.333_333_4, "1.333"), (0.5, "0.500")] {
        let path = put_exr(&folder, aspect, (0, 0), (3, 2), &GREY);
        assert_eq!(
            words(read_photo(&path, Transfer::Srgb).unwrap_err()),
            format!(
                "`{}` has pixels that are {shown} times as wide as high (pixelAspectRatio of an anamorphic \
                 picture), which is not supported; scale it to square pixels first",
                path.display()
            )
        );
    }
    for aspect in [1.0, 1.000_9, 0.999_1] {
        let path = put_exr(&folder, aspect, (0, 0), (3, 2), &GREY);
        let photo = read_photo(&path, Transfer::Srgb).unwrap();
        assert_eq!(photo.warnings, Vec::<String>::new());
    }
}

/// Some writers leave the ratio at 0.
#[test]
fn a_ratio_of_0_says_nothing_of_the_pixels() {
    let folder = folder();
    let path = put_exr(&folder, 1.0, (0, 0), (3, 2), &GREY);
    let mut file = std::fs::read(path).unwrap();
    let name = b"pixelAspectRatio\0float\0";
    let at = file.windows(name.len()).position(|w| w == name).unwrap() + name.len() + 4;
    file[at..at + 4].copy_from_slice(&0f32.to_le_bytes());
    let path = put(&folder, "zero.exr", &file);
    assert!(read_photo(path, Transfer::Srgb).is_ok());
}

#[test]
fn pixels_of_a_photograph_outside_its_display_window_are_dropped_and_that_is_said() {
    let folder = folder();
    // Below 1: a picture that shows white would be said, too.
    let values: Vec<f32> = (0..20).map(|i| i as f32 / 32.0).collect();
    let path = put_exr(&folder, 1.0, (-1, -1), (5, 4), &[("Y", &values)]);
    let photo = read_photo(&path, Transfer::Srgb).unwrap();
    let grey: Vec<f32> = photo.image.0.pixels().iter().map(|p| p.x).collect();
    assert_eq!(grey, [6.0, 7.0, 8.0, 11.0, 12.0, 13.0].map(|v| v / 32.0));
    assert_eq!(
        photo.warnings,
        [format!(
            "`{}`: its data window of 5 x 4 pixels reaches beyond its display window of 3 x 2; what is outside \
             the display window is dropped",
            path.display()
        )]
    );
    for (position, size, is_said) in [
        ((0, 0), (3, 2), false),
        ((1, 0), (2, 2), false),
        ((1, 0), (3, 2), true),
        ((0, -1), (3, 2), true),
    ] {
        let values = &values[..size.0 * size.1];
        let path = put_exr(&folder, 1.0, position, size, &[("Y", values)]);
        let photo = read_photo(path, Transfer::Srgb).unwrap();
        assert_eq!(photo.warnings.len(), usize::from(is_said), "{position:?}");
    }
}

#[test]
fn a_mask_is_the_grey_else_the_red_else_the_opacity_else_the_only_channel() {
    let folder = folder();
    let read = |channels: &[(&str, &[f32])]| {
        read_mask(put_exr(&folder, 1.0, (0, 0), (3, 2), channels))
            .unwrap()
            .pixels()
            .to_vec()
    };
    let other: [f32; 6] = [0.5; 6];
    assert_eq!(read(&[("A", &RAMP)]), RAMP);
    assert_eq!(read(&GREY), RAMP);
    assert_eq!(read(&[("A", &other), ("Y", &RAMP)]), RAMP);
    let colour = [
        ("A", &other[..]),
        ("B", &other),
        ("G", &other),
        ("R", &RAMP),
    ];
    assert_eq!(read(&colour), RAMP);
    assert_eq!(read(&[("Z", &other), ("A", &RAMP)]), RAMP);
    assert_eq!(read(&[("roto.mask", &RAMP)]), RAMP);
    // Values are limited.
    let wild = [-1.0, 0.25, 7.0, f32::INFINITY, f32::NEG_INFINITY, 1.0];
    assert_eq!(read(&[("A", &wild)]), [0.0, 0.25, 1.0, 1.0, 0.0, 1.0]);
}

#[test]
fn a_mask_lies_on_the_display_window() {
    let folder = folder();
    let path = put_exr(&folder, 1.0, (1, 1), (3, 1), &[("A", &[0.5, 1.0, 0.25])]);
    let mask = read_mask(path).unwrap();
    assert_eq!((mask.width(), mask.height()), (3, 2));
    assert_eq!(mask.pixels(), [0.0, 0.0, 0.0, 0.0, 0.5, 1.0]);
}

#[test]
fn a_mask_of_several_unknown_channels_or_with_nan_is_refused() {
    let folder = folder();
    let path = put_exr(
        &folder,
        1.0,
        (0, 0),
        (3, 2),
        &[("left.m", &RAMP), ("right.m", &RAMP)],
    );
    assert_eq!(
        words(read_mask(&path).unwrap_err()),
        format!(
            "`{}` has the channels `left.m`, `right.m`, and none of `Y`, `R`, `A` for a mask, which is not \
             supported; save the mask as the channel `Y`",
            path.display()
        )
    );
    let mut values = RAMP;
    values[4] = f32::NAN;
    let path = put_exr(&folder, 1.0, (0, 0), (3, 2), &[("A", &values)]);
    assert_eq!(
        words(read_mask(&path).unwrap_err()),
        format!(
            "`{}` holds NaN in channel A of the pixel in column 1, row 1 (from the top left); expected finite \
             values: repair the pixel",
            path.display()
        )
    );
    let path = put(&folder, "x.hdr", &flat_hdr("#?RADIANCE", 1, 1, [128; 4]));
    let error = words(read_mask(path).unwrap_err());
    assert!(
        error.contains("expected a PNG, JPEG or OpenEXR image"),
        "{error}"
    );
}
