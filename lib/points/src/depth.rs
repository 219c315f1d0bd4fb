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
/// Channels of a grey picture that was stored in colour differ by at most this, of 65,535: three steps of 8 bits.
const SAME_SHADE: u16 = 3 * 257;

/// Metres of an EXR; 0 and what is not finite are pixels without a depth.
pub(crate) fn read_exr(path: &Path) -> Result<Raster<f32>, PointsError> {
    let layers = Layers::read_exr(path)?;
    let names: Vec<&str> = layers.names().collect();
    let known = CHANNELS.into_iter().find(|name| layers.contains(name));
    // The only one, or the only one that a program calls Z in a layer of its own.
    let mut deep = names.iter().filter(|n| n.ends_with(".Z"));
    let only = match (&names[..], deep.next(), deep.next()) {
        ([only], ..) => Some(*only),
        (_, Some(deep), None) => Some(*deep),
        _ => None,
    };
    let name = known.or(only).ok_or_else(|| {
        PointsError::with_remedy(
            "EXR depth",
            match names.is_empty() {
                true => "it has no channels that can be read".into(),
                false => format!("it has the channels {}", names.join(", ")),
            },
            "write the depth as the channel Z",
        )
    })?;
    Ok(layers.channel(name)?.clone())
}

/// Millimetres of a PNG, as metres.
pub(crate) fn read_png(bytes: &[u8]) -> Result<Raster<f32>, PointsError> {
    let remedy = "write depths as a grey PNG of 16 bits, in millimetres, or as an EXR";
    let decoded = decoded(bytes)?;
    let DynamicImage::ImageLuma16(grey) = decoded else {
        return Err(no_depths(decoded.color(), remedy));
    };
    let (w, h) = (grey.width() as usize, grey.height() as usize);
    let metres = grey.into_raw().into_iter().map(|mm| f32::from(mm) * 1e-3);
    Ok(Raster::from_pixels(w, h, metres.collect()))
}

/// Depths or disparities of a file at its own scale: as they are in an EXR, thousandths in a PNG of 16 bits (metres of
/// millimetres), 0 to 1 in a PNG of 8 bits. A PNG may be stored in colour, but has to be grey.
///
/// # Errors
/// If it is no such file.
pub fn read(path: &Path) -> Result<Raster<f32>, PointsError> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match extension.as_deref() {
        Some("exr") => read_exr(path),
        Some("png") => png(&read_bytes(path)?),
        other => Err(PointsError::with_remedy(
            "depth",
            match other {
                Some(other) => format!("its name ends in \".{other}\""),
                None => "its name has no extension".into(),
            },
            match other {
                Some("npy") => OF_NUMPY,
                _ => "use an EXR, or a PNG in shades of grey",
            },
        )),
    }
}

/// What makes a PNG of the arrays that depth networks write.
const OF_NUMPY: &str = "make a PNG of it, which has a scale of its own: python -c \"import numpy as n, PIL.Image as p; \
                        d = n.nan_to_num(n.load('depth.npy').squeeze()); p.fromarray((d / d.max() * 65535)\
                        .clip(0).astype('uint16')).save('depth.png')\"";

/// As [`read`], of the bytes of a PNG.
///
/// # Errors
/// If they are no PNG in shades of grey.
pub fn png(bytes: &[u8]) -> Result<Raster<f32>, PointsError> {
    let decoded = decoded(bytes)?;
    let kind = decoded.color();
    let of_8_bits = kind.bits_per_pixel() / u16::from(kind.channel_count()) == 8;
    let unit = if of_8_bits { 65535.0 } else { 1000.0 };
    let colours = decoded.into_rgb16();
    let (w, h) = (colours.width() as usize, colours.height() as usize);
    if (colours.pixels()).any(|p| p.0.iter().any(|v| v.abs_diff(p.0[1]) > SAME_SHADE)) {
        let remedy = "write depths in shades of grey: the colours of a map cannot be read back";
        return Err(no_depths(kind, remedy));
    }
    let values = colours.pixels().map(|p| f32::from(p.0[1]) / unit);
    Ok(Raster::from_pixels(w, h, values.collect()))
}

fn decoded(bytes: &[u8]) -> Result<DynamicImage, PointsError> {
    let mut reader = image::ImageReader::new(std::io::Cursor::new(bytes));
    reader.set_format(image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(2 * MOST_PIXELS);
    reader.limits(limits);
    let remedy = "it is damaged or no PNG: write it once more, in grey";
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

/// Whether a map has the shape of a photograph of `photo` pixels, with sides off by `tolerance`, relative.
///
/// # Errors
/// If it has another one.
pub fn check_shape(
    depth: &Raster<f32>,
    [w, h]: [f64; 2],
    tolerance: f64,
) -> Result<(), PointsError> {
    let size = [depth.width() as f64, depth.height() as f64];
    if ((size[0] / size[1]) / (w / h) - 1.0).abs() < tolerance {
        return Ok(());
    }
    if ((size[1] / size[0]) / (w / h) - 1.0).abs() < tolerance {
        return Err(PointsError::with_remedy(
            "depth",
            format!(
                "it has {} x {} pixels, and the photograph, upright, {w} x {h}",
                size[0], size[1]
            ),
            "turn it as the photograph is seen",
        ));
    }
    Err(PointsError::with_remedy(
        "depth",
        format!(
            "it has {} x {} pixels, and the photograph {w} x {h}",
            size[0], size[1]
        ),
        "use the depth map of this photograph, stretched to its shape if it was cut or squeezed",
    ))
}

/// The points that a camera's depth map shows.
///
/// # Errors
/// If the map has another shape than the camera's picture.
pub fn points(depth: &Raster<f32>, camera: &Camera) -> Result<Cloud, PointsError> {
    check_shape(depth, camera.lens.size, SAME_SHAPE)?;
    Ok(seen_points(depth, camera))
}

/// As [`points`], of a map whose shape may be another: it is stretched.
pub fn seen_points(depth: &Raster<f32>, camera: &Camera) -> Cloud {
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
    Cloud {
        points: found.points(),
        viewpoint: Some(camera.pose.position),
    }
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
        let colours = image::RgbImage::from_pixel(1, 1, image::Rgb([9, 4, 9]));
        let error = of(colours.into()).unwrap_err().to_string();
        assert!(error.contains("shades of grey"), "{error}");
    }

    #[test]
    fn an_exr_has_its_depths_in_the_only_channel_that_can_be_meant() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth.exr");
        let read_of = |names: &[&str]| {
            let mut layers = Layers::new(2, 1);
            for (k, name) in names.iter().enumerate() {
                let values = Raster::filled(2, 1, k as f32 + 0.5);
                let precision = dipir_imaging::layers::Precision::Full;
                layers.insert(*name, precision, values).unwrap();
            }
            layers.write_exr(&path).unwrap();
            read(&path).map(|depth| depth.pixels()[0])
        };
        assert_eq!(read_of(&["distance"]).unwrap(), 0.5);
        assert_eq!(read_of(&["A", "View.Z"]).unwrap(), 1.5);
        assert_eq!(read_of(&["A", "View.Z", "Z"]).unwrap(), 2.5);
        let error = read_of(&["Left.Z", "Right.Z"]).unwrap_err().to_string();
        assert!(error.contains("Left.Z, Right.Z"), "{error}");
    }

    #[test]
    fn a_map_that_lies_on_its_side_is_told_to_be_turned() {
        let map = Raster::filled(60, 40, 1.0);
        assert!(check_shape(&map, [900.0, 600.0], 0.05).is_ok());
        assert!(check_shape(&map, [900.0, 620.0], 0.05).is_ok());
        let error = check_shape(&map, [600.0, 900.0], 0.05).unwrap_err();
        assert!(error.to_string().contains("turn it"), "{error}");
        assert!(check_shape(&map, [900.0, 900.0], 0.05).is_err());
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
