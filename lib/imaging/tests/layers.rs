//! OpenEXR layers: what is written is what is read, and files of other programs are understood.
use dipir_imaging::{
    ImagingError,
    composite::composite,
    layer_rows::{LayerRows, Packing},
    layers::{Layers, Precision},
    raster::{LinearImage, Raster},
};
use exr::{
    meta::attribute::{AttributeValue, Chromaticities},
    prelude::{
        AnyChannel, AnyChannels, Encoding, FlatSamples, Image, ImageAttributes, IntegerBounds,
        Layer, LayerAttributes, SmallVec, SpecificChannels, Text, Vec2, WritableImage,
    },
};
use glam::Vec3;
use proptest::prelude::*;

fn ramp(width: usize, height: usize) -> Raster<f32> {
    Raster::from_pixels(
        width,
        height,
        (0..width * height).map(|i| i as f32).collect(),
    )
}

/// A composite's layers: mixed precision, dotted names.
fn sample() -> Layers {
    let mut layers = Layers::new(5, 3);
    let colour = ramp(5, 3).map(|&v| Vec3::new(v, 0.5 * v, 1.0));
    layers.insert_rgb("", Precision::Half, &colour).unwrap();
    layers
        .insert_rgb("shadow", Precision::Half, &colour)
        .unwrap();
    layers
        .insert_xyz("normal", Precision::Full, &colour)
        .unwrap();
    let mut depth = ramp(5, 3).map(|v| v + 0.1);
    *depth.get_mut(4, 2) = f32::INFINITY;
    layers.insert("depth.Z", Precision::Full, depth).unwrap();
    layers.latlong = true;
    layers
}

#[test]
fn mixed_precision_and_names_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    sample().write_exr(&path).unwrap();
    let back = Layers::read_exr(&path).unwrap();
    assert_eq!(back, sample());
    assert!(back.latlong);
    assert_eq!(back.rgb("shadow").unwrap(), sample().rgb("shadow").unwrap());
    assert_eq!(back.xyz("normal").unwrap(), sample().xyz("normal").unwrap());
}

#[test]
fn texts_that_other_programs_wrote_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let channel = AnyChannel::new("R", FlatSamples::F32(vec![1.0]));
    let channels = AnyChannels::sort(SmallVec::from_vec(vec![channel]));
    let mut attributes = LayerAttributes::named(Text::new_or_panic("beauty"));
    let told = AttributeValue::Text(Text::new_or_panic("0.5"));
    attributes
        .other
        .insert(Text::new_or_panic("exposureEv"), told);
    let number = AttributeValue::F32(2.0);
    attributes.other.insert(Text::new_or_panic("gain"), number);
    let layer = Layer::new((1, 1), attributes, Encoding::SMALL_LOSSLESS, channels);
    Image::from_layer(layer).write().to_file(&path).unwrap();
    let layers = Layers::read_exr(&path).unwrap();
    let found: Vec<_> = layers.attributes().collect();
    assert_eq!(found, [("exposureEv", "0.5")]);
}

#[test]
fn the_file_declares_latlong_zip1_and_each_channels_type() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    sample().write_exr(&path).unwrap();
    let meta = exr::meta::MetaData::read_from_file(&path, true).unwrap();
    let header = &meta.headers[0];
    assert_eq!(header.compression, exr::prelude::Compression::ZIP1);
    assert_eq!(
        header.own_attributes.environment_map,
        Some(exr::meta::attribute::EnvironmentMap::LatitudeLongitude)
    );
    let types: Vec<_> = header
        .channels
        .list
        .iter()
        .map(|c| (c.name.to_string(), c.sample_type))
        .collect();
    assert!(types.contains(&("depth.Z".to_string(), exr::prelude::SampleType::F32)));
    assert!(types.contains(&("shadow.G".to_string(), exr::prelude::SampleType::F16)));
}

#[test]
fn a_file_of_colour_says_rec709_and_one_of_other_values_says_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let told = |path: &std::path::Path| {
        let meta = exr::meta::MetaData::read_from_file(path, true).unwrap();
        meta.headers[0].shared_attributes.chromaticities
    };
    let rec709 = Chromaticities {
        red: Vec2(0.64, 0.33),
        green: Vec2(0.3, 0.6),
        blue: Vec2(0.15, 0.06),
        white: Vec2(0.3127, 0.329),
    };
    sample().write_exr(&path).unwrap();
    assert_eq!(told(&path), Some(rec709));
    let half = Precision::Half;
    let mut rows = LayerRows::new(2, 1);
    rows.insert_pixels(["sun.R", "sun.G", "sun.B"], half, |_| Vec3::ONE)
        .unwrap();
    rows.write_exr(&path).unwrap();
    assert_eq!(told(&path), Some(rec709));

    let mut rows = LayerRows::new(2, 1);
    let normals = ["normal.X", "normal.Y", "normal.Z"];
    rows.insert_pixels(normals, half, |_| Vec3::ONE).unwrap();
    rows.write_exr(&path).unwrap();
    assert_eq!(told(&path), None);
    // Coordinates under the names of colours.
    let mut map = Layers::new(2, 1);
    for name in ["R", "G", "B"] {
        map.insert(name, Precision::Full, ramp(2, 1)).unwrap();
    }
    map.write_exr(&path).unwrap();
    assert_eq!(told(&path), None);
    // Another program's file, written again.
    let own = Chromaticities {
        red: Vec2(0.713, 0.293),
        ..rec709
    };
    let channels = SpecificChannels::rgb(|_| (1.0f32, 0.5f32, 0.25f32));
    let mut image = Image::from_channels((2, 1), channels);
    image.attributes.chromaticities = Some(own);
    image.write().to_file(&path).unwrap();
    let mut read = Layers::read_exr(&path).unwrap();
    let colour = read.rgb("").unwrap();
    read.insert_rgb("copy", half, &colour).unwrap();
    read.write_exr(&path).unwrap();
    assert_eq!(told(&path), Some(own));
}

#[test]
fn rows_that_are_computed_give_the_bytes_of_layers_in_memory() {
    let folder = tempfile::tempdir().unwrap();
    let (width, height) = (37, 11);
    let colour = |i: usize| Vec3::new(i as f32 * 0.1, 1.0 / (1.0 + i as f32), -3.0);
    // One channel of three is beyond half precision and is stored in full.
    let bright = |i: usize| Vec3::new(1.0, if i == 200 { 1e6 } else { 0.5 }, 2.0);
    let raster = |f: &dyn Fn(usize) -> Vec3| {
        Raster::from_pixels(width, height, (0..width * height).map(f).collect())
    };
    let mut layers = Layers::new(width, height);
    let half = Precision::Half;
    layers.insert_rgb("", half, &raster(&colour)).unwrap();
    layers.insert_rgb("sun", half, &raster(&bright)).unwrap();
    layers
        .insert("A", half, Raster::filled(width, height, 1.0))
        .unwrap();
    layers
        .insert("depth.Z", Precision::Full, ramp(width, height))
        .unwrap();
    let depth = ramp(width, height);
    let mut rows = LayerRows::new(width, height);
    rows.insert_pixels(["R", "G", "B"], half, colour).unwrap();
    rows.insert_pixels(["sun.R", "sun.G", "sun.B"], half, bright)
        .unwrap();
    rows.insert_constant("A", half, 1.0).unwrap();
    rows.insert("depth.Z", Precision::Full, &depth).unwrap();
    let [one, other] = ["one.exr", "other.exr"].map(|name| folder.path().join(name));
    layers.write_exr(&one).unwrap();
    rows.write_exr(&other).unwrap();
    assert!(std::fs::read(&one).unwrap() == std::fs::read(&other).unwrap());
    assert_eq!(
        Layers::read_exr(&other).unwrap().rgb("sun").unwrap(),
        raster(&bright)
    );
}

#[test]
fn quick_files_hold_the_same_samples() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("quick.exr");
    let depth = ramp(37, 11);
    let colour = |i: usize| Vec3::new(0.1, 1.0 / (1.0 + i as f32), 1e6);
    let mut rows = LayerRows::new(37, 11).packed(Packing::Quick);
    rows.insert_pixels(["R", "G", "B"], Precision::Full, colour)
        .unwrap();
    rows.insert("depth.Z", Precision::Full, &depth).unwrap();
    rows.write_exr(&path).unwrap();
    let meta = exr::meta::MetaData::read_from_file(&path, true).unwrap();
    let packed = meta.headers[0].compression;
    assert_eq!(packed, exr::prelude::Compression::RLE);
    let back = Layers::read_exr(&path).unwrap();
    assert_eq!(back.channel("depth.Z").unwrap(), &depth);
    let pixels: Vec<Vec3> = (0..37 * 11).map(colour).collect();
    assert_eq!(back.rgb("").unwrap().pixels(), pixels);
}

#[test]
fn a_missing_channel_is_an_error_that_lists_those_in_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let mut layers = Layers::new(1, 1);
    layers
        .insert("depth.Z", Precision::Full, ramp(1, 1))
        .unwrap();
    layers
        .insert("proxy.A", Precision::Half, ramp(1, 1))
        .unwrap();
    layers.write_exr(&path).unwrap();
    let error = Layers::read_exr(&path)
        .unwrap()
        .channel("object.A")
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        format!(
            "`{}` has no channel `object.A`; it has `depth.Z`, `proxy.A`",
            path.display()
        )
    );
    let error = Layers::new(1, 1).channel("R").unwrap_err();
    assert_eq!(
        error.to_string(),
        "the image has no channel `R`; it has no channels"
    );
}

#[test]
fn light_too_bright_for_half_is_stored_in_full() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let mut layers = Layers::new(2, 1);
    let sun = Raster::from_pixels(2, 1, vec![1e6, 0.1]);
    layers.insert("R", Precision::Half, sun.clone()).unwrap();
    layers.insert("G", Precision::Half, ramp(2, 1)).unwrap();
    layers.write_exr(&path).unwrap();
    let back = Layers::read_exr(&path).unwrap();
    assert_eq!(*back.channel("R").unwrap(), sun);
    let precision: Vec<_> = back.channels().map(|(_, c)| c.precision).collect();
    assert_eq!(precision, [Precision::Half, Precision::Full]);
}

proptest! {
    /// The composite formula on what a file holds gives the beauty that it holds.
    #[test]
    fn layers_of_any_brightness_recombine_without_infinity(
        radiance in proptest::collection::vec(-6.0f32..6.0, 8),
        alpha in proptest::collection::vec(0.0f32..=1.0, 8),
        shadow in proptest::collection::vec(0.0f32..=1.0, 8),
    ) {
        let row = |values: &[f32]| {
            Raster::from_pixels(8, 1, values.iter().map(|&v| Vec3::new(v, 0.5 * v, 0.25)).collect())
        };
        let light: Vec<f32> = radiance.iter().map(|&e| 10f32.powf(e)).collect();
        let object = row(&light);
        let of_object = Precision::of_colour(&object);
        let object = object.map(|&v| of_object.round_colour(v));
        let shadow = row(&shadow).map(|&v| Precision::Half.round_colour(v));
        let alpha = Raster::from_pixels(8, 1, alpha).map(|&v| Precision::Half.round(v));
        let background = Raster::filled(8, 1, Vec3::new(0.25, 0.5, 1.0));
        let beauty = composite(
            &LinearImage(background.clone()),
            &LinearImage(object.clone()),
            &alpha,
            &LinearImage(shadow.clone()),
        ).unwrap().0;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.exr");
        let mut layers = Layers::new(8, 1);
        layers.insert_rgb("", Precision::of_colour(&beauty), &beauty).unwrap();
        layers.insert_rgb("object", of_object, &object).unwrap();
        layers.insert("object.A", Precision::Half, alpha).unwrap();
        layers.insert_rgb("shadow", Precision::Half, &shadow).unwrap();
        layers.insert_rgb("background", Precision::Half, &background).unwrap();
        layers.write_exr(&path).unwrap();
        let file = Layers::read_exr(&path).unwrap();
        let part = |name: &str| LinearImage(file.rgb(name).unwrap());
        let again = composite(
            &part("background"),
            &part("object"),
            file.channel("object.A").unwrap(),
            &part("shadow"),
        ).unwrap().0;
        for (got, want) in part("").0.pixels().iter().zip(again.pixels()) {
            for (got, want) in got.to_array().into_iter().zip(want.to_array()) {
                prop_assert!(got.is_finite());
                // Half rounds to 2^-11 of the value, or to 2^-25 near zero.
                let step = want.abs() * 2f32.powi(-11) + 2f32.powi(-25);
                prop_assert!((got - want).abs() <= step, "{} {}", got, want);
            }
        }
    }
}

#[test]
fn names_that_compositing_programs_refuse_are_refused() {
    let mut layers = Layers::new(1, 1);
    for (name, reason) in [
        ("", "is empty"),
        ("0", "is only digits"),
        ("a b", "has characters other than printable ASCII"),
        ("shadow.", "has an empty part"),
    ] {
        let error = layers
            .insert(name, Precision::Half, ramp(1, 1))
            .unwrap_err();
        assert_eq!(
            error.to_string(),
            format!("channel name `{name}` {reason}; use a name such as `R` or `shadow.R`")
        );
    }
}

#[test]
fn channels_of_another_size_are_refused() {
    let mut layers = Layers::new(2, 2);
    let error = layers.insert("R", Precision::Half, ramp(2, 1)).unwrap_err();
    assert_eq!(
        error.to_string(),
        "channel `R` is 2 x 1 pixels; expected 2 x 2, the size of the other layers"
    );
    let empty = Layers::new(0, 4);
    let error = empty.write_exr("x.exr").unwrap_err();
    assert!(matches!(
        error,
        ImagingError::BadSize {
            width: 0,
            height: 4,
            ..
        }
    ));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_small_reading_holds_the_means_of_the_finite_values_of_its_blocks(
        width in 1usize..40,
        height in 1usize..40,
        longest in 1usize..50,
        values in proptest::collection::vec(prop_oneof![4 => -9.0f32..9.0, 1 => Just(f32::INFINITY)], 40 * 40),
    ) {
        let full = Raster::from_pixels(width, height, values[..width * height].to_vec());
        let mut layers = Layers::new(width, height);
        layers.insert("depth.Z", Precision::Full, full.clone()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.exr");
        layers.write_exr(&path).unwrap();
        let small = Layers::read_exr_small(&path, longest).unwrap();
        let block = (width.max(height) / longest).max(1);
        prop_assert_eq!((small.width(), small.height()), (width.div_ceil(block), height.div_ceil(block)));
        let found = small.channel("depth.Z").unwrap();
        for (y, x) in (0..small.height()).flat_map(|y| (0..small.width()).map(move |x| (y, x))) {
            let inside = (y * block..height.min((y + 1) * block))
                .flat_map(|v| (x * block..width.min((x + 1) * block)).map(move |u| (u, v)));
            let finite: Vec<f64> = inside.map(|(u, v)| f64::from(*full.get(u, v))).filter(|v| v.is_finite()).collect();
            let found = f64::from(*found.get(x, y));
            match finite.is_empty() {
                true => prop_assert_eq!(found, f64::INFINITY),
                // A mean below 9 is rounded to f32 by at most 2^-21, a tie by just that, and sums
                // of f64 in another order differ by far less than a hundredth of it.
                false => prop_assert!(
                    (found - finite.iter().sum::<f64>() / finite.len() as f64).abs() <= 1.01 * 2f64.powi(-21)
                ),
            }
        }
    }
}

#[test]
fn one_pixel_and_odd_sizes_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    for (width, height) in [(1, 1), (1, 7), (13, 1), (17, 33)] {
        let mut layers = Layers::new(width, height);
        layers
            .insert("Y", Precision::Half, ramp(width, height))
            .unwrap();
        layers.write_exr(&path).unwrap();
        assert_eq!(Layers::read_exr(&path).unwrap(), layers);
    }
}

/// Writes a file as another program would: `size` pixels at `position`, in a display window.
fn write_windowed(
    path: &std::path::Path,
    display: IntegerBounds,
    parts: &[(&str, Vec2<i32>, Vec2<usize>)],
) {
    let layers = parts.iter().map(|&(name, position, size)| {
        let values = (0..size.0 * size.1).map(|i| 1.0 + i as f32).collect();
        let channel = AnyChannel::new("R", FlatSamples::F32(values));
        let attributes = LayerAttributes {
            layer_position: position,
            ..LayerAttributes::named(Text::new_or_panic(name))
        };
        let channels = AnyChannels::sort(SmallVec::from_vec(vec![channel]));
        Layer::new(size, attributes, Encoding::SMALL_LOSSLESS, channels)
    });
    let attributes = ImageAttributes::new(display);
    let image = Image::from_layers(attributes, layers.collect::<SmallVec<[_; 2]>>());
    image.write().to_file(path).unwrap();
}

/// 4.7 GB were taken for 427 bytes.
#[test]
fn a_display_window_of_nothing_is_refused_before_memory_is_taken() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let display = IntegerBounds::new((0, 0), (4, 1 << 24));
    write_windowed(&path, display, &[("beauty", Vec2(0, 0), Vec2(4, 2))]);
    let error = Layers::read_exr(&path).unwrap_err().to_string();
    assert!(
        error.contains("its display window is 4 x 16777216 pixels"),
        "{error}"
    );
}

#[test]
fn a_data_window_is_placed_on_the_display_window_and_cut_by_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let display = IntegerBounds::new((10, 20), (4, 3));
    // Two columns right and one row down of the corner, reaching one column beyond the window.
    write_windowed(&path, display, &[("beauty", Vec2(12, 21), Vec2(3, 2))]);
    let layers = Layers::read_exr(&path).unwrap();
    assert_eq!((layers.width(), layers.height()), (4, 3));
    let want = vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 0.0, 0.0, 4.0, 5.0];
    assert_eq!(layers.channel("R").unwrap().pixels(), want);
    // Read as it is, it may be small; blocks of it have no place.
    assert_eq!(Layers::read_exr_small(&path, 4).unwrap(), layers);
    let error = Layers::read_exr_small(&path, 2).unwrap_err().to_string();
    assert!(error.contains("data window"), "{error}");
}

#[test]
fn a_second_part_with_a_taken_name_is_told_apart_by_the_parts_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let display = IntegerBounds::new((0, 0), (2, 2));
    let parts = [
        ("beauty", Vec2(0, 0), Vec2(2, 2)),
        ("mist", Vec2(0, 0), Vec2(2, 2)),
    ];
    write_windowed(&path, display, &parts);
    let layers = Layers::read_exr(&path).unwrap();
    assert_eq!(layers.names().collect::<Vec<_>>(), ["R", "mist.R"]);
}

#[test]
fn a_file_of_another_format_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    std::fs::write(&path, b"#?RADIANCE\n").unwrap();
    assert_eq!(
        Layers::read_exr(&path).unwrap_err().to_string(),
        format!(
            "`{}` is a Radiance HDR image; expected an OpenEXR image: convert the file",
            path.display()
        )
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn exr_in_full_is_exact_and_in_half_rounds_to_nearest(
        width in 1usize..24,
        height in 1usize..24,
        values in proptest::collection::vec(-6e4f32..6e4, 23 * 23),
        small in -1e-7f32..1e-7,
    ) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.exr");
        let mut values = values[..width * height].to_vec();
        values[0] = small;
        let samples = Raster::from_pixels(width, height, values);
        let mut layers = Layers::new(width, height);
        layers.insert("full", Precision::Full, samples.clone()).unwrap();
        layers.insert("half", Precision::Half, samples.clone()).unwrap();
        layers.write_exr(&path).unwrap();
        let back = Layers::read_exr(&path).unwrap();
        prop_assert_eq!(back.channel("full").unwrap(), &samples);
        for (got, want) in back.channel("half").unwrap().pixels().iter().zip(samples.pixels()) {
            // Half an ulp of 11 bits, or of the subnormal step 2^-24.
            let step = (want.abs() / 2048.0).max(2f32.powi(-25));
            prop_assert!((got - want).abs() <= step, "{} {}", got, want);
        }
    }
}

/// As Blender names its passes.
#[test]
fn channels_with_names_that_are_not_written_here_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let channel = |name| AnyChannel::new(name, FlatSamples::F32(vec![2.5; 4]));
    let channels = ["ViewLayer.Denoising Depth.Z", "Z"].map(channel);
    let channels = AnyChannels::sort(SmallVec::from_vec(channels.into()));
    let image = Image::from_channels((2, 2), channels);
    image.write().to_file(&path).unwrap();
    let layers = Layers::read_exr(&path).unwrap();
    assert_eq!(layers.names().collect::<Vec<_>>(), ["Z"]);
    assert_eq!(layers.channel("Z").unwrap().pixels(), [2.5; 4]);
    let error = layers.channel("Y").unwrap_err().to_string();
    assert!(error.contains("Denoising Depth"), "{error}");
}
