//! Radiance HDR files.
use crate::{
    decode::{SizeLimit, image_error},
    error::ImagingError,
    file::check_finite,
    format::Format,
    primaries::Primaries,
    raster::{LinearImage, Raster},
};
use glam::Vec3;
use image::{ImageDecoder, codecs::hdr::HdrDecoder};
use std::{io::Cursor, path::Path};

/// Pixels that a byte of a file can stand for. In the older run-length coding a row of one colour takes 12 bytes up to a
/// length of 65,536: a square of the 16,384 pixels a side that are accepted has 1,366 a byte.
const MOST_PIXELS_A_BYTE: usize = 2048;

/// Decodes a file in RGBE. Its `EXPOSURE` and `COLORCORR` say by what the stored values were
/// multiplied, over all of its lines; they are divided by it [Radiance file formats, "pictures"].
/// With the light come the `PRIMARIES` that it is in, if they are named.
pub(crate) fn decode(
    bytes: &[u8],
    path: &Path,
    limit: SizeLimit,
) -> Result<(LinearImage, Option<Primaries>), ImagingError> {
    let failed = |error| image_error(path, Format::Hdr, error);
    // Some programs sign with `#?RGBE`, which the strict decoder does not know.
    let decoder = if bytes.starts_with(b"#?RADIANCE") {
        HdrDecoder::new(Cursor::new(bytes))
    } else {
        HdrDecoder::new_nonstrict(Cursor::new(bytes))
    };
    let decoder = decoder.map_err(failed)?;
    let (width, height) = decoder.dimensions();
    let (width, height) = (width as usize, height as usize);
    limit.check(path, width, height)?;
    let damaged = |detail| ImagingError::Damaged {
        path: path.to_owned(),
        format: Format::Hdr.name(),
        detail,
    };
    if width * height > bytes.len().saturating_mul(MOST_PIXELS_A_BYTE) {
        let detail = format!(
            "it declares {width} x {height} pixels and has {} bytes",
            bytes.len()
        );
        return Err(damaged(detail));
    }
    let header = decoder.metadata();
    let (r, g, b) = header.color_correction.unwrap_or((1.0, 1.0, 1.0));
    let stored_over_light = Vec3::new(r, g, b) * header.exposure.unwrap_or(1.0);
    if !(stored_over_light.min_element() > 0.0 && stored_over_light.is_finite()) {
        return Err(damaged(format!(
            "its EXPOSURE and COLORCORR are {stored_over_light}, not above 0"
        )));
    }
    let lines = header.custom_attributes.iter().rev();
    let mut primaries = lines.filter(|(key, _)| key == "PRIMARIES");
    let primaries = primaries.find_map(|(_, numbers)| Primaries::of_text(numbers));
    let mut samples = vec![[0.0f32; 3]; width * height];
    let bytes = bytemuck::cast_slice_mut(&mut samples);
    decoder.read_image(bytes).map_err(failed)?;
    // Collected in place: a 4k map is 100 MB.
    let light = |v: [f32; 3]| Vec3::from_array(v) / stored_over_light;
    let pixels = samples.into_iter().map(light).collect();
    let image = Raster::from_pixels(width, height, pixels);
    check_finite(path, &image)?;
    Ok((LinearImage(image), primaries))
}
