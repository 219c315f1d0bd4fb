//! Depth maps along the optical axis: as points EXR in metres, PNG of 16 bits in millimetres; others at their own scale.
use std::path::Path;

use dipir_cameras::Camera;
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::Raster;
use glam::{DVec2, DVec3};
use image::DynamicImage;

use crate::cloud::{Cloud, Collector};
use crate::error::PointsError;
use crate::file::read_bytes;

/// Names of the channel of depths, the first that is there.
const CHANNELS: [&str; 7] = ["Z", "depth.Z", "Depth.Z", "depth.V", "Y", "R", "V"];
/// Most pixels of a map.
const MOST_PIXELS: u64 = 1 << 28;
/// By how much the shapes of map and photograph may differ, relative.
const SAME_SHAPE: f64 = 0.01;

/// Metres of an EXR; 0 and what is not finite are pixels without a depth.
pub(crate) fn read_exr(path: &Path) -> Result<Raster<f32>, PointsError> {
    let layers = Layers::read_exr(path)?;
    let name = CHANNELS.into_iter().find(|name| layers.contains(name));
    let name = name.ok_or_else(|| {
        PointsError::with_remedy(
            "EXR depth",
            format!(
                "it has the channels {}",
                layers.names().collect::<Vec<_>>().join(", ")
            ),
            "write the depth as the channel Z",
        )
    })?;
    Ok(layers.channel(name)?.clone())
}

/// Millimetres of a PNG, as metres.
pub(crate) fn read_png(bytes: &[u8]) -> Result<Raster<f32>, PointsError> {
    let remedy = "write depths as a grey PNG of 16 bits, in millimetres, or as an EXR";
    let decoded = decoded(bytes, remedy)?;
    let DynamicImage::ImageLuma16(grey) = decoded else {
        return Err(no_depths(decoded.color(), remedy));
    };
    let (w, h) = (grey.width() as usize, grey.height() as usize);
    let metres = grey.into_raw().into_iter().map(|mm| f32::from(mm) * 1e-3);
    Ok(Raster::from_pixels(w, h, metres.collect()))
}

/// Depths or disparities of a file at its own scale: as they are in an EXR; metres of a grey PNG of 16 bits in
/// millimetres; 0 to 1 of a PNG of 8 bits, which may be stored in colour. What is not finite is unknown.
///
/// # Errors
/// If it is no such file.
pub fn read(path: &Path) -> Result<Raster<f32>, PointsError> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match extension.as_deref() {
        Some("exr") => read_exr(path),
        Some("png") => png(&read_bytes(path)?),
        _ => Err(PointsError::with_remedy(
            "depth",
            format!(
                "its name ends in \".{}\"",
                extension.as_deref().unwrap_or_default()
            ),
            TO_PNG,
        )),
    }
}

/// What makes a PNG of the arrays that depth networks write.
const TO_PNG: &str = "use an EXR or a PNG; of numpy's .npy make one by python -c \"import numpy as n, PIL.Image as p; \
                      d = n.load('depth.npy').squeeze(); p.fromarray((d / d.max() * 65535).astype('uint16'))\
                      .save('depth.png')\"";

/// As [`read`], of the bytes of a PNG.
///
/// # Errors
/// If they are no PNG in shades of grey.
pub fn png(bytes: &[u8]) -> Result<Raster<f32>, PointsError> {
    let remedy = "write depths in shades of grey: the colours of a map cannot be read back";
    let decoded = decoded(bytes, remedy)?;
    if matches!(decoded, DynamicImage::ImageLuma16(_)) {
        return read_png(bytes);
    }
    let kind = decoded.color();
    let colours = decoded.into_rgb16();
    let (w, h) = (colours.width() as usize, colours.height() as usize);
    if colours.pixels().any(|p| p.0 != [p.0[0]; 3]) {
        return Err(no_depths(kind, remedy));
    }
    let values = colours.pixels().map(|p| f32::from(p.0[0]) / 65535.0);
    Ok(Raster::from_pixels(w, h, values.collect()))
}

fn decoded(bytes: &[u8], remedy: &'static str) -> Result<DynamicImage, PointsError> {
    let mut reader = image::ImageReader::new(std::io::Cursor::new(bytes));
    reader.set_format(image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(2 * MOST_PIXELS);
    reader.limits(limits);
    let decoded = reader.decode();
    decoded.map_err(|e| PointsError::with_remedy("PNG depth", e.to_string(), remedy))
}

fn no_depths(kind: image::ColorType, remedy: &'static str) -> PointsError {
    PointsError::with_remedy("PNG depth", format!("it is {}", in_words(kind)), remedy)
}

/// `a picture in colour with alpha, of 8 bits`.
fn in_words(kind: image::ColorType) -> String {
    let colours = if kind.has_color() {
        "in colour"
    } else {
        "in grey"
    };
    let alpha = if kind.has_alpha() { " with alpha" } else { "" };
    let bits = kind.bits_per_pixel() / u16::from(kind.channel_count());
    format!("a picture {colours}{alpha}, of {bits} bits")
}

/// Whether a map has the shape of a photograph of `photo` pixels.
///
/// # Errors
/// If it has another one.
pub fn check_shape(depth: &Raster<f32>, [w, h]: [f64; 2]) -> Result<(), PointsError> {
    let size = [depth.width() as f64, depth.height() as f64];
    if ((size[0] / size[1]) / (w / h) - 1.0).abs() < SAME_SHAPE {
        return Ok(());
    }
    Err(PointsError::with_remedy(
        "depth",
        format!(
            "it has {} x {} pixels, and the photograph {w} x {h}",
            size[0], size[1]
        ),
        "use the depth map of this photograph",
    ))
}

/// The points that a camera's depth map shows.
///
/// # Errors
/// If the map has another shape than the camera's picture.
pub fn points(depth: &Raster<f32>, camera: &Camera) -> Result<Cloud, PointsError> {
    check_shape(depth, camera.lens.size)?;
    let size = [depth.width() as f64, depth.height() as f64];
    let camera = Camera {
        lens: camera.lens.scaled(size),
        ..*camera
    };
    let forward = -camera.pose.rotation.z_axis;
    let mut found = Collector::new(depth.pixels().len());
    for (i, &z) in depth.pixels().iter().enumerate() {
        let pixel = DVec2::new((i % depth.width()) as f64, (i / depth.width()) as f64) + 0.5;
        let ray = match z > 0.0 {
            true => camera.ray(pixel),
            false => None,
        };
        let ahead = ray
            .map(|ray| (ray, ray.dot(forward)))
            .filter(|r| r.1 > 1e-6);
        found.add(ahead.map_or(DVec3::NAN, |(ray, ahead)| {
            camera.pose.position + ray * (f64::from(z) / ahead)
        }));
    }
    Ok(Cloud {
        points: found.points(),
        viewpoint: Some(camera.pose.position),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_png_that_is_no_depth_map_is_described_in_words() {
        for (picture, said) in [
            (DynamicImage::new_rgb8(2, 2), "in colour, of 8 bits"),
            (
                DynamicImage::new_rgba16(2, 2),
                "in colour with alpha, of 16 bits",
            ),
            (DynamicImage::new_luma8(2, 2), "in grey, of 8 bits"),
        ] {
            let mut bytes = std::io::Cursor::new(Vec::new());
            picture
                .write_to(&mut bytes, image::ImageFormat::Png)
                .unwrap();
            let error = read_png(bytes.get_ref()).unwrap_err().to_string();
            let said = format!("it is a picture {said}");
            assert!(error.contains(&said), "{error}");
        }
    }

    #[test]
    fn shades_of_8_bits_are_depths_at_a_scale_of_their_own_and_colours_are_none() {
        let of = |picture: DynamicImage| {
            let mut bytes = std::io::Cursor::new(Vec::new());
            let format = image::ImageFormat::Png;
            picture.write_to(&mut bytes, format).unwrap();
            png(bytes.get_ref())
        };
        let shades = |x: u32| (51 * x) as u8;
        let grey = image::GrayImage::from_fn(6, 1, |x, _| image::Luma([shades(x)]));
        let stored = image::RgbImage::from_fn(6, 1, |x, _| image::Rgb([shades(x); 3]));
        for picture in [DynamicImage::from(grey), stored.into()] {
            let read = of(picture).unwrap();
            for (x, v) in read.pixels().iter().enumerate() {
                assert!((v - x as f32 / 5.0).abs() < 1e-6, "{v} at {x}");
            }
        }
        let millimetres = image::ImageBuffer::from_pixel(1, 1, image::Luma([2500u16]));
        assert_eq!(of(millimetres.into()).unwrap().pixels(), &[2.5]);
        let colours = image::RgbImage::from_pixel(1, 1, image::Rgb([9, 8, 9]));
        let error = of(colours.into()).unwrap_err().to_string();
        assert!(error.contains("shades of grey"), "{error}");
    }

    #[test]
    fn an_array_of_numpy_is_told_how_it_becomes_a_png() {
        let error = read(Path::new("depth.npy")).unwrap_err().to_string();
        assert!(
            error.contains(".npy\"") && error.contains("depth.png"),
            "{error}"
        );
    }
}
