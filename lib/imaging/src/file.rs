//! Photographs, masks, textures and linear images in files.
use crate::{
    error::{ImagingError, MAX_PIXELS},
    exr_file,
    format::Format,
    jpeg_header,
    layers::Layers,
    raster::{DisplayImage, LinearImage, Raster},
    transfer::Transfer,
};
use glam::Vec3;
use image::{
    DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder,
    codecs::{
        hdr::HdrDecoder,
        jpeg::JpegDecoder,
        png::{CompressionType, FilterType, PngDecoder, PngEncoder},
    },
};
use std::{
    fs::File,
    io::{BufWriter, Cursor, Write},
    path::Path,
};

const DISPLAY_FORMATS: &str = "a PNG or JPEG image";
const LINEAR_FORMATS: &str = "an OpenEXR or Radiance HDR image (linear light)";
const PHOTO_FORMATS: &str = "a PNG, JPEG, OpenEXR or Radiance HDR image";

/// A photograph in linear light.
#[derive(Clone, Debug, PartialEq)]
pub struct Photo {
    /// Linear Rec.709, upright (an Exif orientation has been applied). Not premultiplied.
    pub image: LinearImage,
    /// Opacity in `[0, 1]`, if the file has it.
    pub alpha: Option<Raster<f32>>,
    /// The curve with which results are encoded to look like the photograph.
    pub transfer: Transfer,
}

/// Reads a photograph: PNG (8 or 16 bit; grey, RGB, with or without alpha, palette) or JPEG, decoded
/// with `transfer`; OpenEXR and Radiance HDR are linear already. Embedded colour profiles and PNG
/// gamma chunks are ignored: `transfer` says how the pixels were encoded.
///
/// Errors on a missing, empty, truncated or unsupported file, and on NaN or infinite light.
pub fn read_photo(path: impl AsRef<Path>, transfer: Transfer) -> Result<Photo, ImagingError> {
    let path = path.as_ref();
    let bytes = read_bytes(path, PHOTO_FORMATS)?;
    match Format::of(&bytes) {
        Format::Png | Format::Jpeg => {
            let decoded = decode_display(&bytes, path, PHOTO_FORMATS, Orient::Upright)?;
            let (image, alpha) = linearise(decoded, transfer);
            Ok(Photo {
                image,
                alpha,
                transfer,
            })
        }
        Format::Exr => {
            let layers = read_colour(&bytes, path)?;
            Ok(Photo {
                image: linear_of_layers(&layers, path)?,
                alpha: layers.channel("A").ok().cloned(),
                transfer,
            })
        }
        Format::Hdr => Ok(Photo {
            image: decode_hdr(&bytes, path)?,
            alpha: None,
            transfer,
        }),
        other => Err(other.refuse(path, PHOTO_FORMATS)),
    }
}

/// Reads linear light from OpenEXR (bare `R`, `G`, `B`, or grey `Y`) or Radiance HDR. A
/// display-referred file is an error, so is NaN or infinity, with the pixel named.
pub fn read_linear(path: impl AsRef<Path>) -> Result<LinearImage, ImagingError> {
    let path = path.as_ref();
    let bytes = read_bytes(path, LINEAR_FORMATS)?;
    match Format::of(&bytes) {
        Format::Exr => linear_of_layers(&read_colour(&bytes, path)?, path),
        Format::Hdr => decode_hdr(&bytes, path),
        other => Err(other.refuse(path, LINEAR_FORMATS)),
    }
}

/// Reads a mask in `[0, 1]` (white is 1) from PNG or JPEG. Stored values are coverage: no transfer
/// is applied. Colour is weighted as Rec.709 luma, and opacity multiplies.
pub fn read_mask(path: impl AsRef<Path>) -> Result<Raster<f32>, ImagingError> {
    let path = path.as_ref();
    let bytes = read_bytes(path, DISPLAY_FORMATS)?;
    let decoded = decode_display(&bytes, path, DISPLAY_FORMATS, Orient::Upright)?;
    let (image, alpha) = linearise(decoded, Transfer::Linear);
    let mut mask = image.0.map(|c| c.dot(crate::metrics::LUMA).min(1.0));
    if let Some(alpha) = alpha {
        for (m, a) in mask.pixels_mut().iter_mut().zip(alpha.pixels()) {
            *m *= a;
        }
    }
    Ok(mask)
}

/// Decodes a PNG or JPEG texture to 8-bit RGBA as stored: no transfer, no orientation (glTF 2.0,
/// 3.8.3). Grey is spread over the colours, missing alpha is 255, 16 bits are rounded to 8.
/// `name` stands in the error for the path.
pub fn decode_texture(bytes: &[u8], name: &str) -> Result<Raster<[u8; 4]>, ImagingError> {
    let path = Path::new(name);
    if bytes.is_empty() {
        return Err(ImagingError::Empty {
            path: path.to_owned(),
            expected: DISPLAY_FORMATS,
        });
    }
    let decoded = decode_display(bytes, path, DISPLAY_FORMATS, Orient::AsStored)?;
    let rgba = decoded.into_rgba8();
    let (width, height) = (rgba.width() as usize, rgba.height() as usize);
    let pixels = rgba.into_raw().as_chunks::<4>().0.to_vec();
    Ok(Raster::from_pixels(width, height, pixels))
}

/// Writes an 8-bit RGB PNG, rounding to nearest. Values outside `[0, 1]` are clipped; NaN and
/// infinity are errors.
pub fn write_png(path: impl AsRef<Path>, image: &DisplayImage) -> Result<(), ImagingError> {
    let path = path.as_ref();
    check_finite(path, &image.0)?;
    let bytes: Vec<u8> = image
        .0
        .pixels()
        .iter()
        .flat_map(|p| p.to_array().map(quantise_8))
        .collect();
    encode_png(path, &image.0, &bytes, ExtendedColorType::Rgb8)
}

/// Writes a 16-bit RGB PNG; otherwise as [`write_png`].
pub fn write_png_16(path: impl AsRef<Path>, image: &DisplayImage) -> Result<(), ImagingError> {
    let path = path.as_ref();
    check_finite(path, &image.0)?;
    // The encoder takes samples in the machine's byte order.
    let bytes: Vec<u8> = image
        .0
        .pixels()
        .iter()
        .flat_map(|p| p.to_array())
        .flat_map(|v| ((v.clamp(0.0, 1.0) * 65535.0 + 0.5) as u16).to_ne_bytes())
        .collect();
    encode_png(path, &image.0, &bytes, ExtendedColorType::Rgb16)
}

/// Writes a mask in `[0, 1]` as an 8-bit grey PNG; NaN and infinity are errors.
pub fn write_png_mask(path: impl AsRef<Path>, mask: &Raster<f32>) -> Result<(), ImagingError> {
    let path = path.as_ref();
    check_finite(path, &mask.map(|&v| Vec3::splat(v)))?;
    let bytes: Vec<u8> = mask.pixels().iter().map(|&v| quantise_8(v)).collect();
    encode_png(path, mask, &bytes, ExtendedColorType::L8)
}

fn quantise_8(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

fn read_bytes(path: &Path, expected: &'static str) -> Result<Vec<u8>, ImagingError> {
    let bytes = std::fs::read(path).map_err(|e| ImagingError::io("read", path, e))?;
    if bytes.is_empty() {
        return Err(ImagingError::Empty {
            path: path.to_owned(),
            expected,
        });
    }
    Ok(bytes)
}

/// Whether an Exif orientation is applied.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Orient {
    Upright,
    AsStored,
}

fn decode_display(
    bytes: &[u8],
    path: &Path,
    expected: &'static str,
    orient: Orient,
) -> Result<DynamicImage, ImagingError> {
    let format = Format::of(bytes);
    let failed = |error| image_error(path, format, error);
    match format {
        Format::Png => {
            let decoder = PngDecoder::new(Cursor::new(bytes)).map_err(failed)?;
            decode_with(decoder, path, orient).map_err(failed)?
        }
        Format::Jpeg => {
            jpeg_header::check(bytes, path)?;
            let decoder = JpegDecoder::new(Cursor::new(bytes)).map_err(failed)?;
            decode_with(decoder, path, orient).map_err(failed)?
        }
        other => Err(other.refuse(path, expected)),
    }
}

/// The outer result is the decoder's, the inner one ours.
fn decode_with(
    mut decoder: impl ImageDecoder,
    path: &Path,
    orient: Orient,
) -> image::ImageResult<Result<DynamicImage, ImagingError>> {
    let (width, height) = decoder.dimensions();
    let (width, height) = (width as usize, height as usize);
    if let Err(error) = check_size(path, width, height) {
        return Ok(Err(error));
    }
    let orientation = decoder.orientation();
    let mut decoded = DynamicImage::from_decoder(decoder)?;
    if let (Orient::Upright, Ok(orientation)) = (orient, orientation) {
        decoded.apply_orientation(orientation);
    }
    Ok(Ok(decoded))
}

fn image_error(path: &Path, format: Format, error: image::ImageError) -> ImagingError {
    match error {
        image::ImageError::Unsupported(_) => ImagingError::Unsupported {
            path: path.to_owned(),
            what: format!("is a kind of {} file", format.name()),
            remedy: "save it as an 8-bit RGB PNG",
        },
        other => ImagingError::Damaged {
            path: path.to_owned(),
            format: format.name(),
            detail: other.to_string(),
        },
    }
}

/// Decoded samples to linear light and opacity, by table: a file has at most 65,536 sample values.
fn linearise(decoded: DynamicImage, transfer: Transfer) -> (LinearImage, Option<Raster<f32>>) {
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    let color = decoded.color();
    let channels = color.channel_count() as usize;
    let samples: Vec<u16>;
    let max: u16;
    if color.bytes_per_pixel() as usize == channels {
        samples = decoded.into_bytes().into_iter().map(u16::from).collect();
        max = 255;
    } else {
        samples = match channels {
            1 => decoded.into_luma16().into_raw(),
            2 => decoded.into_luma_alpha16().into_raw(),
            3 => decoded.into_rgb16().into_raw(),
            _ => decoded.into_rgba16().into_raw(),
        };
        max = 65535;
    }
    let unit = |v: u16| f32::from(v) / f32::from(max);
    let table: Vec<f32> = (0..=max).map(|v| transfer.decode_scalar(unit(v))).collect();
    let lookup = |v: u16| table[usize::from(v)];
    let pixels = samples
        .chunks_exact(channels)
        .map(|s| match s {
            [r, g, b] | [r, g, b, _] => Vec3::new(lookup(*r), lookup(*g), lookup(*b)),
            _ => Vec3::splat(lookup(s[0])),
        })
        .collect();
    let alpha = color.has_alpha().then(|| {
        let opacity = samples
            .chunks_exact(channels)
            .map(|s| unit(s[channels - 1]));
        Raster::from_pixels(width, height, opacity.collect())
    });
    let image = LinearImage(Raster::from_pixels(width, height, pixels));
    (image, alpha)
}

fn read_colour(bytes: &[u8], path: &Path) -> Result<Layers, ImagingError> {
    exr_file::read(Cursor::new(bytes), path, Some(&["R", "G", "B", "A", "Y"]))
}

fn linear_of_layers(layers: &Layers, path: &Path) -> Result<LinearImage, ImagingError> {
    let colour = if !layers.contains("R") && layers.contains("Y") {
        layers.channel("Y")?.map(|&v| Vec3::splat(v))
    } else {
        layers.rgb("")?
    };
    check_finite(path, &colour)?;
    Ok(LinearImage(colour))
}

pub(crate) fn check_size(path: &Path, width: usize, height: usize) -> Result<(), ImagingError> {
    if (1..=MAX_PIXELS).contains(&width.saturating_mul(height)) {
        return Ok(());
    }
    Err(ImagingError::BadSize {
        what: format!("`{}`", path.display()),
        width,
        height,
    })
}

fn decode_hdr(bytes: &[u8], path: &Path) -> Result<LinearImage, ImagingError> {
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
    check_size(path, width, height)?;
    // Decoded in place: a 4k map is 100 MB, which a conversion would move twice.
    let mut samples = vec![[0.0f32; 3]; width * height];
    let bytes = bytemuck::cast_slice_mut(&mut samples);
    decoder.read_image(bytes).map_err(failed)?;
    let pixels = samples.into_iter().map(Vec3::from_array).collect();
    let image = Raster::from_pixels(width, height, pixels);
    check_finite(path, &image)?;
    Ok(LinearImage(image))
}

/// Errors with the first pixel, row by row, that is NaN or infinite.
fn check_finite(path: &Path, image: &Raster<Vec3>) -> Result<(), ImagingError> {
    let Some(at) = image.pixels().iter().position(|p| !p.is_finite()) else {
        return Ok(());
    };
    let values = image.pixels()[at].to_array();
    let channel = values.iter().position(|v| !v.is_finite()).unwrap_or(0);
    Err(ImagingError::NotFinite {
        path: path.to_owned(),
        channel: ["R", "G", "B"][channel].to_string(),
        x: at % image.width(),
        y: at / image.width(),
        value: values[channel],
    })
}

fn encode_png<T>(
    path: &Path,
    raster: &Raster<T>,
    bytes: &[u8],
    color: ExtendedColorType,
) -> Result<(), ImagingError> {
    let (width, height) = (raster.width(), raster.height());
    if width == 0 || height == 0 || width.saturating_mul(height) > MAX_PIXELS {
        return Err(ImagingError::BadSize {
            what: format!("the image for `{}`", path.display()),
            width,
            height,
        });
    }
    let file = File::create(path).map_err(|e| ImagingError::io("create", path, e))?;
    let mut writer = BufWriter::new(file);
    PngEncoder::new_with_quality(&mut writer, CompressionType::Fast, FilterType::Adaptive)
        .write_image(bytes, width as u32, height as u32, color)
        .map_err(|error| match error {
            image::ImageError::IoError(source) => ImagingError::io("write", path, source),
            other => ImagingError::io("write", path, std::io::Error::other(other.to_string())),
        })?;
    writer
        .flush()
        .map_err(|e| ImagingError::io("write", path, e))
}
