//! Files against the bare libraries under them, and the optimiser's per-iteration image work.
//!
//! `cargo bench -p dipir-imaging`
use dipir_imaging::{
    file,
    layers::{Layers, Precision},
    metrics,
    raster::{LinearImage, Raster},
    resize::{CropResize, Filter, PixelBox},
    tone::{ToneCurves, ToneParameters},
    transfer::Transfer,
};
use divan::{Bencher, black_box};
use exr::prelude::{ReadChannels, ReadLayers};
use glam::Vec3;
use image::{ImageDecoder, codecs::hdr};
use std::io::Cursor;

fn main() {
    divan::main();
}

/// Smooth colour with a little texture, so that compression has something to do.
fn scene(width: usize, height: usize) -> Raster<Vec3> {
    let pixel = |i: usize| {
        let (x, y) = ((i % width) as f32, (i / width) as f32);
        let grain = (i.wrapping_mul(2_654_435_761) >> 20 & 255) as f32 / 2560.0;
        Vec3::new(
            0.5 + 0.4 * (x * 0.01).sin(),
            0.5 + 0.4 * (y * 0.013).cos(),
            0.3 + grain,
        )
    };
    Raster::from_pixels(width, height, (0..width * height).map(pixel).collect())
}

fn hdr_4k() -> Vec<u8> {
    let pixels: Vec<_> = scene(4096, 2048)
        .pixels()
        .iter()
        .map(|c| image::Rgb(c.to_array()))
        .collect();
    let mut bytes = Vec::new();
    hdr::HdrEncoder::new(&mut bytes)
        .encode(&pixels, 4096, 2048)
        .unwrap();
    bytes
}

#[divan::bench(sample_count = 10)]
fn read_4k_hdr(bencher: Bencher) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.hdr");
    std::fs::write(&path, hdr_4k()).unwrap();
    bencher.bench(|| file::read_linear(&path).unwrap());
}

#[divan::bench(sample_count = 10)]
fn read_4k_hdr_library_alone(bencher: Bencher) {
    let bytes = hdr_4k();
    bencher.bench(|| {
        let decoder = hdr::HdrDecoder::new(Cursor::new(&bytes)).unwrap();
        let mut buffer = vec![0; decoder.total_bytes() as usize];
        decoder.read_image(&mut buffer).unwrap();
        buffer
    });
}

/// The layers of a composite: 17 channels of 1920 x 1080.
fn composite_layers() -> Layers {
    let colour = scene(1920, 1080);
    let mut layers = Layers::new(1920, 1080);
    for layer in ["", "object", "shadow", "background", "albedo"] {
        layers.insert_rgb(layer, Precision::Half, &colour).unwrap();
    }
    let alpha = colour.map(|c| c.x);
    layers.insert("A", Precision::Half, alpha.clone()).unwrap();
    layers.insert("depth.Z", Precision::Full, alpha).unwrap();
    layers
}

#[divan::bench(sample_count = 5)]
fn write_1080p_exr(bencher: Bencher) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let layers = composite_layers();
    bencher.bench(|| layers.write_exr(&path).unwrap());
}

#[divan::bench(sample_count = 5)]
fn write_1080p_exr_library_alone(bencher: Bencher) {
    use exr::prelude::WritableImage;
    let folder = tempfile::tempdir().unwrap();
    let (source, path) = (folder.path().join("x.exr"), folder.path().join("y.exr"));
    composite_layers().write_exr(&source).unwrap();
    let image = exr::prelude::read_all_flat_layers_from_file(&source).unwrap();
    bencher.bench(|| image.write().to_file(&path).unwrap());
}

#[divan::bench(sample_count = 5)]
fn read_1080p_exr(bencher: Bencher) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    composite_layers().write_exr(&path).unwrap();
    bencher.bench(|| Layers::read_exr(&path).unwrap());
}

#[divan::bench(sample_count = 5)]
fn read_1080p_exr_library_alone(bencher: Bencher) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    composite_layers().write_exr(&path).unwrap();
    bencher.bench(|| {
        let reader = exr::prelude::read()
            .no_deep_data()
            .largest_resolution_level();
        let image = reader.all_channels().all_layers().all_attributes();
        image.from_file(&path).unwrap()
    });
}

#[divan::bench(sample_count = 5)]
fn read_1080p_png(bencher: Bencher) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.png");
    let image = Transfer::Srgb.encode(&LinearImage(scene(1920, 1080)));
    file::write_png(&path, &image).unwrap();
    bencher.bench(|| file::read_photo(&path, Transfer::Srgb).unwrap());
}

#[divan::bench(sample_count = 5)]
fn read_1080p_png_library_alone(bencher: Bencher) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.png");
    let image = Transfer::Srgb.encode(&LinearImage(scene(1920, 1080)));
    file::write_png(&path, &image).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    bencher.bench(|| image::load_from_memory(&bytes).unwrap());
}

#[divan::bench(sample_count = 5)]
fn write_1080p_png(bencher: Bencher) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.png");
    let image = Transfer::Srgb.encode(&LinearImage(scene(1920, 1080)));
    bencher.bench(|| file::write_png(&path, &image).unwrap());
}

/// The size at which the light is optimised.
const WIDTH: usize = 384;
const HEIGHT: usize = 256;

fn curves() -> ToneCurves {
    let mut parameters = ToneParameters::default();
    parameters.foreground.heights[1] = 0.5;
    parameters.shadow[2].widths[3] = -0.5;
    parameters.curves()
}

#[divan::bench]
fn tone_object(bencher: Bencher) {
    let (curves, object) = (curves(), LinearImage(scene(WIDTH, HEIGHT)));
    let alpha = Raster::filled(WIDTH, HEIGHT, 0.9);
    bencher.bench(|| curves.apply_object(black_box(&object), &alpha));
}

#[divan::bench]
fn tone_object_vjp(bencher: Bencher) {
    let (curves, object) = (curves(), LinearImage(scene(WIDTH, HEIGHT)));
    let alpha = Raster::filled(WIDTH, HEIGHT, 0.9);
    bencher.bench(|| curves.apply_object_vjp(black_box(&object), &alpha, &object.0));
}

#[divan::bench]
fn tone_shadow_vjp(bencher: Bencher) {
    let (curves, shadow) = (curves(), LinearImage(scene(WIDTH, HEIGHT)));
    bencher.bench(|| curves.apply_shadow_vjp(black_box(&shadow), &shadow.0));
}

#[divan::bench]
fn display_transfer(bencher: Bencher) {
    let image = LinearImage(scene(WIDTH, HEIGHT));
    bencher.bench(|| Transfer::Srgb.encode(black_box(&image)));
}

#[divan::bench]
fn display_transfer_vjp(bencher: Bencher) {
    let image = LinearImage(scene(WIDTH, HEIGHT));
    bencher.bench(|| Transfer::Srgb.encode_vjp(black_box(&image), &image.0));
}

#[divan::bench]
fn crop_and_resize_to_512(bencher: Bencher) {
    let crop = PixelBox {
        x: 60,
        y: 30,
        width: 200,
        height: 200,
    };
    let image = scene(WIDTH, HEIGHT);
    let crop = CropResize::new((WIDTH, HEIGHT), crop, (512, 512), Filter::Tent);
    bencher.bench(|| crop.apply(black_box(&image)));
}

#[divan::bench]
fn crop_and_resize_to_512_vjp(bencher: Bencher) {
    let crop = PixelBox {
        x: 60,
        y: 30,
        width: 200,
        height: 200,
    };
    let gradient = scene(512, 512);
    let crop = CropResize::new((WIDTH, HEIGHT), crop, (512, 512), Filter::Tent);
    bencher.bench(|| crop.apply_vjp(black_box(&gradient)));
}

#[divan::bench]
fn ssim_of_512(bencher: Bencher) {
    let (a, b) = (scene(512, 512), scene(512, 512).map(|&c| c * 0.9));
    bencher.bench(|| metrics::ssim(black_box(&a), &b));
}
