//! PNG files out.
use crate::{
    encoding::Tag,
    error::{ImagingError, MAX_PIXELS},
    file::{Photo, check_finite},
    raster::{DisplayImage, LinearImage, Raster},
};
use glam::Vec3;
use png::{BitDepth, ColorType, Compression, Filter, Info, SrgbRenderingIntent};
use rayon::prelude::*;
use std::{borrow::Cow, fs::File, io::BufWriter, io::Write, path::Path};

/// Writes a picture as the photograph that it was made from: an 8-bit RGB PNG in the photograph's
/// encoding, with its colour profile or gamma and its Exif data.
///
/// A pixel of `picture` that equals the photograph's keeps the value that the photograph's file has
/// there. What the encoding cannot hold is clipped.
///
/// # Errors
/// If the sizes differ, on NaN and infinity, and when the file cannot be written.
pub fn write_picture(
    path: impl AsRef<Path>,
    picture: &LinearImage,
    photo: &Photo,
) -> Result<(), ImagingError> {
    let path = path.as_ref();
    let size = |image: &LinearImage| (image.0.width(), image.0.height());
    if size(picture) != size(&photo.image) {
        return Err(ImagingError::SizeMismatch {
            what: format!("the picture for `{}`", path.display()),
            found: size(picture),
            expected: size(&photo.image),
            reference: "the photograph",
        });
    }
    check_finite(path, &picture.0)?;
    let mut values = photo.encoding.encode_8(picture);
    if let Some(stored) = &photo.values {
        let unchanged = picture.0.pixels().par_iter().zip(photo.image.0.pixels());
        let stored = unchanged.zip(stored.pixels());
        values
            .par_iter_mut()
            .zip(stored)
            .filter(|(_, ((new, old), _))| new == old)
            .for_each(|(value, (_, stored))| *value = *stored);
    }
    let format = (ColorType::Rgb, BitDepth::Eight);
    let about = About {
        tag: Some(photo.encoding.tag()),
        exif: photo.exif.as_deref(),
    };
    encode_png(path, size(picture), values.as_flattened(), format, about)
}

/// Writes an 8-bit RGB PNG, rounding to nearest. Values outside `[0, 1]` are clipped; NaN and
/// infinity are errors.
pub fn write_png(path: impl AsRef<Path>, image: &DisplayImage) -> Result<(), ImagingError> {
    let path = path.as_ref();
    check_finite(path, &image.0)?;
    let values = image.0.pixels().par_iter();
    let bytes: Vec<[u8; 3]> = values.map(|p| p.to_array().map(quantise_8)).collect();
    let format = (ColorType::Rgb, BitDepth::Eight);
    let bytes = bytes.as_flattened();
    encode_png(path, size_of(&image.0), bytes, format, About::default())
}

/// Writes a 16-bit RGB PNG; otherwise as [`write_png`].
pub fn write_png_16(path: impl AsRef<Path>, image: &DisplayImage) -> Result<(), ImagingError> {
    let path = path.as_ref();
    check_finite(path, &image.0)?;
    // The encoder takes samples as they are stored: the high byte first.
    let bytes: Vec<u8> = image
        .0
        .pixels()
        .iter()
        .flat_map(|p| p.to_array())
        .flat_map(|v| ((v.clamp(0.0, 1.0) * 65535.0 + 0.5) as u16).to_be_bytes())
        .collect();
    let format = (ColorType::Rgb, BitDepth::Sixteen);
    encode_png(path, size_of(&image.0), &bytes, format, About::default())
}

/// Writes a mask in `[0, 1]` as an 8-bit grey PNG; NaN and infinity are errors.
pub fn write_png_mask(path: impl AsRef<Path>, mask: &Raster<f32>) -> Result<(), ImagingError> {
    let path = path.as_ref();
    check_finite(path, &mask.map(|&v| Vec3::splat(v)))?;
    let bytes: Vec<u8> = mask.pixels().iter().map(|&v| quantise_8(v)).collect();
    let format = (ColorType::Grayscale, BitDepth::Eight);
    encode_png(path, size_of(mask), &bytes, format, About::default())
}

fn quantise_8(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

fn size_of<T>(raster: &Raster<T>) -> (usize, usize) {
    (raster.width(), raster.height())
}

/// What a PNG says about itself.
#[derive(Default)]
struct About<'a> {
    tag: Option<&'a Tag>,
    exif: Option<&'a [u8]>,
}

fn encode_png(
    path: &Path,
    (width, height): (usize, usize),
    bytes: &[u8],
    (color, depth): (ColorType, BitDepth),
    about: About,
) -> Result<(), ImagingError> {
    if width == 0 || height == 0 || width.saturating_mul(height) > MAX_PIXELS {
        return Err(ImagingError::BadSize {
            what: format!("the image for `{}`", path.display()),
            width,
            height,
        });
    }
    let mut info = Info::with_size(width as u32, height as u32);
    info.color_type = color;
    info.bit_depth = depth;
    info.exif_metadata = about.exif.map(Cow::Borrowed);
    match about.tag {
        None => {}
        Some(Tag::Srgb) => info.srgb = Some(SrgbRenderingIntent::Perceptual),
        Some(Tag::Chunks(gamma, chromaticities)) => {
            info.source_gamma = *gamma;
            info.source_chromaticities = *chromaticities;
        }
        Some(Tag::Profile(icc)) => info.icc_profile = Some(Cow::Borrowed(icc)),
    }
    let file = File::create(path).map_err(|e| ImagingError::io("create", path, e))?;
    let mut file = BufWriter::new(file);
    let failed = |error: png::EncodingError| ImagingError::io("write", path, error.into());
    let mut encoder = png::Encoder::with_info(&mut file, info).map_err(failed)?;
    encoder.set_compression(Compression::Fast);
    encoder.set_filter(Filter::Adaptive);
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(bytes).map_err(failed)?;
    writer.finish().map_err(failed)?;
    file.flush().map_err(|e| ImagingError::io("write", path, e))
}
