//! Maps of opacity in files of their own (`map_d`): they become the alpha of the image of colours.
use dipir_imaging::raster::Raster;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use crate::error::Error;
use crate::texture::{Encoding, ImageSource, Texture};

/// The colours of `base`, or white, with the `opacity` of `map` as alpha, as large as the larger of them, and how many pixels
/// that is. Opacity is the alpha of `map`, or where that is 1 everywhere its red.
///
/// # Errors
/// On a `base` that cannot be decoded.
pub(super) fn combined(
    base: Option<&Texture>,
    map: &Texture,
    opacity: &Raster<[u8; 4]>,
) -> Result<(Texture, u64), Error> {
    let colors = base.map(Texture::decode).transpose()?;
    let colors = colors.as_ref().map(|c| c.texels());
    let is_in_alpha = opacity.pixels().iter().any(|texel| texel[3] < 255);
    let larger = colors.filter(|c| c.pixels().len() > opacity.pixels().len());
    let larger = larger.unwrap_or(opacity);
    let (w, h) = (larger.width(), larger.height());
    let texel = |i: usize| {
        let (x, y) = (2 * (i % w) + 1, 2 * (i / w) + 1);
        // The texel of an image of any size in which the centre of this one lies.
        let at = |image: &Raster<[u8; 4]>| {
            *image.get(x * image.width() / (2 * w), y * image.height() / (2 * h))
        };
        let [r, g, b, _] = colors.map_or([255; 4], at);
        let [grey, _, _, alpha] = at(opacity);
        [r, g, b, if is_in_alpha { alpha } else { grey }]
    };
    let texels: Vec<[u8; 4]> = (0..w * h).map(texel).collect();
    let name = format!("map_Kd with the opacity of {}", map.image.name());
    let mut bytes = Vec::new();
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Sub)
        .write_image(
            texels.as_flattened(),
            w as u32,
            h as u32,
            ExtendedColorType::Rgba8,
        )
        .map_err(|e| Error::malformed(format!("{name}: {e}"), "use smaller textures"))?;
    let texture = Texture {
        image: ImageSource::Bytes {
            name,
            bytes: bytes.into(),
        },
        encoding: Encoding::Srgb,
        ..base.unwrap_or(map).clone()
    };
    Ok((texture, (w * h) as u64))
}
