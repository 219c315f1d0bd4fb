//! Depth maps: EXR in metres, PNG of 16 bits in millimetres, along the optical axis.
use std::path::Path;

use dipir_cameras::Camera;
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::Raster;
use glam::{DVec2, DVec3};

use crate::cloud::{Cloud, Collector};
use crate::error::PointsError;

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
    let wrong = |detail: String| {
        let remedy = "write depths as a grey PNG of 16 bits, in millimetres, or as an EXR";
        PointsError::with_remedy("PNG depth", detail, remedy)
    };
    let mut reader = image::ImageReader::new(std::io::Cursor::new(bytes));
    reader.set_format(image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(2 * MOST_PIXELS);
    reader.limits(limits);
    let decoded = reader.decode().map_err(|e| wrong(e.to_string()))?;
    let image::DynamicImage::ImageLuma16(grey) = decoded else {
        return Err(wrong(format!("it is {}", in_words(decoded.color()))));
    };
    let (w, h) = (grey.width() as usize, grey.height() as usize);
    let metres = grey.into_raw().into_iter().map(|mm| f32::from(mm) * 1e-3);
    Ok(Raster::from_pixels(w, h, metres.collect()))
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

/// The points that a camera's depth map shows.
///
/// # Errors
/// If the map has another shape than the camera's picture.
pub fn points(depth: &Raster<f32>, camera: &Camera) -> Result<Cloud, PointsError> {
    let size = [depth.width() as f64, depth.height() as f64];
    let [w, h] = camera.lens.size;
    if !((size[0] / size[1]) / (w / h) - 1.0).abs().lt(&SAME_SHAPE) {
        return Err(PointsError::with_remedy(
            "depth",
            format!(
                "it has {} x {} pixels, and the photograph {w} x {h}",
                size[0], size[1]
            ),
            "use the depth map of this photograph",
        ));
    }
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
    use image::DynamicImage;

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
}
