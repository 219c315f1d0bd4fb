//! Pictures inside the page: scaled down, encoded as PNG, written as `data:` addresses.
use anyhow::Context;
use base64::prelude::{BASE64_STANDARD, Engine};
use dipir_imaging::raster::DisplayImage;
use dipir_imaging::resize::{Filter, resize};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::html::Html;

/// `<img>` with the picture in it, no side longer than `longest` pixels.
pub fn image(picture: &DisplayImage, longest: usize, alt: &str) -> anyhow::Result<Html> {
    let small = fitted(picture, longest);
    let address = format!(
        "data:image/png;base64,{}",
        BASE64_STANDARD.encode(png(&small)?)
    );
    let (width, height) = (small.0.width().to_string(), small.0.height().to_string());
    let attributes = [
        ("src", address.as_str()),
        ("alt", alt),
        ("width", width.as_str()),
        ("height", height.as_str()),
    ];
    Ok(Html::element("img", &attributes, []))
}

/// The picture under a caption.
pub fn figure(picture: &DisplayImage, longest: usize, caption: &str) -> anyhow::Result<Html> {
    let parts = [
        Html::of("figcaption", caption),
        image(picture, longest, caption)?,
    ];
    Ok(Html::element("figure", &[], parts))
}

/// An 8-bit RGB PNG.
fn png(picture: &DisplayImage) -> anyhow::Result<Vec<u8>> {
    let quantised = |v: f32| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    let pixels = picture.0.pixels().iter();
    let samples: Vec<u8> = pixels.flat_map(|p| p.to_array().map(quantised)).collect();
    let (width, height) = (picture.0.width() as u32, picture.0.height() as u32);
    let mut bytes = Vec::new();
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Default, FilterType::Adaptive)
        .write_image(&samples, width, height, ExtendedColorType::Rgb8)
        .context("cannot encode a picture of the report")?;
    Ok(bytes)
}

fn fitted(picture: &DisplayImage, longest: usize) -> DisplayImage {
    let (width, height) = (picture.0.width(), picture.0.height());
    let side = width.max(height);
    if side <= longest {
        return picture.clone();
    }
    let scaled = |n: usize| (n * longest).div_ceil(side).max(1);
    DisplayImage(resize(
        &picture.0,
        scaled(width),
        scaled(height),
        Filter::Area,
    ))
}

#[cfg(test)]
mod tests {
    use dipir_imaging::raster::Raster;
    use glam::Vec3;

    use super::*;

    #[test]
    fn pictures_are_scaled_down_and_never_up() {
        let picture = DisplayImage(Raster::filled(30, 20, Vec3::splat(0.5)));
        let size = |longest| {
            let small = fitted(&picture, longest);
            (small.0.width(), small.0.height())
        };
        assert_eq!((size(15), size(100)), ((15, 10), (30, 20)));
    }
}
