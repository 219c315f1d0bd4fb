//! Photographs, masks, textures and linear images in files.
pub use crate::png_file::{write_picture, write_png, write_png_16, write_png_mask};
use crate::{
    decode::{Decoded, SizeLimit},
    encoding::Encoding,
    error::{ImagingError, MAX_PIXELS, listed},
    exposure::automatic_exposure_ev,
    exr_file,
    facts::Facts,
    format::Format,
    gain_map::{self, GainMap},
    hdr_file,
    layers::Layers,
    primaries::{self, Primaries},
    raster::{LinearImage, Raster},
    transfer::Transfer,
    unheeded,
};
use glam::Vec3;
use image::metadata::Orientation;
use std::{io::Cursor, io::Read, path::Path};

const DISPLAY_FORMATS: &str = "a PNG or JPEG image";
const MASK_FORMATS: &str = "a PNG, JPEG or OpenEXR image";
const LINEAR_FORMATS: &str = "an OpenEXR or Radiance HDR image (linear light)";
const PHOTO_FORMATS: &str = "a PNG, JPEG, OpenEXR or Radiance HDR image";

/// A photograph in linear light, upright: an Exif orientation has been applied.
#[derive(Clone, Debug, PartialEq)]
pub struct Photo {
    /// Linear Rec.709, not premultiplied. Colours of a wide gamut have values below 0.
    pub image: LinearImage,
    /// Opacity in `[0, 1]`, if the file has it.
    pub alpha: Option<Raster<f32>>,
    /// The curve with which results are encoded to look like the photograph, where its own
    /// [`encoding`](Self::encoding) is not used.
    pub transfer: Transfer,
    /// How the file's values were encoded.
    pub encoding: Encoding,
    /// The file's values, of 8 bits, if it is display-referred.
    pub values: Option<Raster<[u8; 3]>>,
    /// What the file says of how it was taken.
    pub facts: Facts,
    /// The file's Exif data from the TIFF header on, with no orientation left to be applied.
    pub exif: Option<Vec<u8>>,
    /// How much brighter than the picture shows it the place was, if a JPEG tells: see [`radiance`](Self::radiance).
    pub gain: Option<GainMap>,
    /// What of the file could not be used, one sentence each.
    pub warnings: Vec<String>,
}

/// The most that a photograph may ask for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotoLimits {
    /// Most pixels, in millions. A pixel takes 18 bytes while it is read.
    pub megapixels: f64,
}

impl PhotoLimits {
    /// The key that changes the limit.
    pub const KEY: &str = "scene.limits.photo_megapixels";
}

impl Default for PhotoLimits {
    /// 200 megapixels, the most that cameras take.
    fn default() -> Self {
        Self { megapixels: 200.0 }
    }
}

impl PhotoLimits {
    /// Errors on an image with no pixels or too many.
    pub(crate) fn check(
        self,
        path: &Path,
        width: usize,
        height: usize,
    ) -> Result<(), ImagingError> {
        let megapixels = width as f64 * height as f64 * 1e-6;
        if megapixels > self.megapixels {
            return Err(ImagingError::TooManyPixels {
                path: path.to_owned(),
                width,
                height,
                megapixels,
                limit: self.megapixels,
                key: Self::KEY,
            });
        }
        if width == 0 || height == 0 {
            return check_size(path, width, height);
        }
        Ok(())
    }
}

/// Reads a photograph of up to 200 megapixels, as [`read_photo_within`].
///
/// # Errors
/// As [`read_photo_within`].
pub fn read_photo(path: impl AsRef<Path>, transfer: Transfer) -> Result<Photo, ImagingError> {
    read_photo_within(path, transfer, PhotoLimits::default())
}

/// Reads a photograph: PNG (8 or 16 bit; grey, RGB, with or without alpha, palette), JPEG, OpenEXR
/// or Radiance HDR.
///
/// PNG and JPEG are decoded with their ICC profile if they have one and `transfer` is
/// [`Transfer::Srgb`]; another curve overrules the file. So it is with a PNG's `gAMA`, where there is
/// no profile. A gain map behind a JPEG is kept; one that cannot be used is a warning. OpenEXR and
/// Radiance HDR are linear light, of Rec.709 unless they name other primaries, from which it is converted. Of OpenEXR the display window is read; pixels of the data window outside it
/// are dropped, with a warning.
///
/// # Errors
/// On a missing, empty, truncated or unsupported file, on more pixels than `limits` allow, on
/// NaN or infinite light, and on an OpenEXR file whose pixels are not square.
pub fn read_photo_within(
    path: impl AsRef<Path>,
    transfer: Transfer,
    limits: PhotoLimits,
) -> Result<Photo, ImagingError> {
    let path = path.as_ref();
    let bytes = read_bytes(path, PHOTO_FORMATS)?;
    let limit = SizeLimit::Photo(limits);
    match Format::of(&bytes) {
        Format::Png | Format::Jpeg => {
            let decoded = Decoded::of(&bytes, path, PHOTO_FORMATS, limit)?;
            let gain = GainMap::of(&bytes, &decoded, limit).transpose();
            drop(bytes);
            let mut photo = display_photo(decoded, path, transfer);
            match gain {
                Ok(gain) => photo.gain = gain,
                Err(why) => photo.warnings.push(gain_map::unusable(&why, path)),
            }
            Ok(photo)
        }
        Format::Exr => {
            let layers = read_colour(&bytes, path, limit)?;
            drop(bytes);
            check_square(&layers, path)?;
            let alpha = layers.channel("A").ok().cloned();
            let light = linear_of_layers(&layers, path)?;
            let mut photo = linear_photo(light, alpha, path)?;
            photo.warnings.extend(overscan(&layers, path));
            Ok(photo)
        }
        Format::Hdr => {
            let light = hdr_file::decode(&bytes, path, limit)?;
            linear_photo(light, None, path)
        }
        other => Err(other.refuse(path, PHOTO_FORMATS)),
    }
}

/// Refuses a file whose first bytes say that [`read_photo`] does not read it: a movie, a raw file. Whether the file is whole
/// it does not tell.
///
/// # Errors
/// On a file of another format, and on one that cannot be opened.
pub fn check_format(path: impl AsRef<Path>) -> Result<(), ImagingError> {
    let path = path.as_ref();
    let mut start = Vec::new();
    let file = dipir_files::open(path);
    file.and_then(|f| f.take(Format::SNIFF_LENGTH as u64).read_to_end(&mut start))
        .map_err(|e| ImagingError::io("read", path, e))?;
    match Format::of(&start) {
        other @ Format::Other(_) if !start.is_empty() => Err(other.refuse(path, PHOTO_FORMATS)),
        _ => Ok(()),
    }
}

/// A photograph of light as stored, and the primaries that it is in, if its file names them.
fn linear_photo(
    (mut image, primaries): (LinearImage, Option<Primaries>),
    alpha: Option<Raster<f32>>,
    path: &Path,
) -> Result<Photo, ImagingError> {
    // `scene.transfer` is about files of display values. Results for linear light are encoded as sRGB.
    let transfer = Transfer::Srgb;
    let mut warnings: Vec<String> = transparency(alpha.as_ref(), path).into_iter().collect();
    match primaries.map_or(Ok(None), Primaries::to_rec709) {
        Ok(None) => {}
        Ok(Some(to_rec709)) => {
            primaries::convert(&mut image, to_rec709);
            check_finite(path, &image.0)?;
        }
        Err(why) => warnings.push(format!(
            "`{}`: its primaries {why}; it is read as linear Rec.709: convert it to Rec.709 if its colours look wrong",
            path.display()
        )),
    }
    warnings.extend(unseen(&image, path));
    Ok(Photo {
        facts: Facts::of_size([image.0.width() as u32, image.0.height() as u32]),
        image,
        alpha,
        transfer,
        encoding: Encoding::named(transfer),
        values: None,
        exif: None,
        gain: None,
        warnings,
    })
}

/// Luminance that shows nearly black: sRGB encodes it as 25 of 255.
const DARK: f32 = 0.01;

/// A warning if a display shows most of this light as white, or nearly all as black: the exposure of linear files is
/// arbitrary.
fn unseen(image: &LinearImage, path: &Path) -> Option<String> {
    let pixels = image.0.pixels();
    if !pixels.is_empty() && pixels.iter().all(|p| p.max_element() <= 0.0) {
        return Some(format!(
            "`{}`: it holds no light, for none of its values is above 0: it is black in previews and in composite.png; \
             is it the right file?",
            path.display()
        ));
    }
    let (mut white, mut dark) = (0usize, 0usize);
    for luminance in pixels.iter().map(|p| p.dot(crate::metrics::LUMA)) {
        white += usize::from(luminance > 1.0);
        dark += usize::from(luminance < DARK);
    }
    let count = pixels.len();
    let percent = |part: usize| 100 * part / count.max(1);
    let what = if 2 * white > count {
        format!(
            "{}% of its pixels are above 1.0 and show white",
            percent(white)
        )
    } else if 100 * (count - dark) < count {
        format!(
            "{}% of its pixels are below {DARK} and show nearly black",
            percent(dark)
        )
    } else {
        return None;
    };
    let stops = automatic_exposure_ev(image);
    Some(format!(
        "`{}`: {what} in previews and in composite.png, which show its light as it is; composite.exr keeps all of it. \
         To see it, multiply the photograph's values by 2^{stops:.0}",
        path.display()
    ))
}

/// Pixels are square unless their sides differ by more than this share: a pixel in a thousand.
const SQUARE_TOLERANCE: f32 = 1e-3;

/// Errors on pixels that are not square. A ratio that is no size says nothing.
fn check_square(layers: &Layers, path: &Path) -> Result<(), ImagingError> {
    let aspect = layers.pixel_aspect;
    if !aspect.is_normal() || aspect < 0.0 || (aspect - 1.0).abs() <= SQUARE_TOLERANCE {
        return Ok(());
    }
    Err(ImagingError::Unsupported {
        path: path.to_owned(),
        what: format!(
            "has pixels that are {aspect:.3} times as wide as high (pixelAspectRatio of an anamorphic picture)"
        ),
        remedy: "scale it to square pixels first".into(),
    })
}

/// A warning if the file has pixels outside its display window.
fn overscan(layers: &Layers, path: &Path) -> Option<String> {
    let (width, height) = layers.overscan?;
    Some(format!(
        "`{}`: its data window of {width} x {height} pixels reaches beyond its display window of {} x {}; what is \
         outside the display window is dropped",
        path.display(),
        layers.width(),
        layers.height()
    ))
}

/// Opacity that is less only by rounding is full.
const OPAQUE: f32 = 0.999;

/// A warning if some pixel of a photograph is not opaque.
fn transparency(alpha: Option<&Raster<f32>>, path: &Path) -> Option<String> {
    let opaque = |a: &f32| *a >= OPAQUE;
    (!alpha?.pixels().iter().all(opaque)).then(|| {
        format!(
            "`{}`: the photograph's transparency is dropped; its pixels count as opaque",
            path.display()
        )
    })
}

fn display_photo(mut decoded: Decoded, path: &Path, transfer: Transfer) -> Photo {
    let assumed = match transfer {
        Transfer::Srgb => "sRGB",
        Transfer::Gamma22 => "Rec.709 with a gamma of 2.2",
        Transfer::Linear => "linear Rec.709",
    };
    let mut unused = Vec::new();
    // A profile comes before `cICP`: it stands beside it for programs that do not know that chunk.
    let of_file = match &decoded.icc {
        Some(icc) => {
            let profile = Encoding::of_profile(icc, decoded.colours());
            let unusable =
                |why| unused.push(format!("colour profile {why}; it is read as {assumed}"));
            profile.map_err(unusable).ok()
        }
        None => {
            let chunks = &decoded.png_colours;
            chunks.encoding(decoded.colours(), assumed, &mut unused)
        }
    };
    let alpha = decoded.opacity();
    let name = path.display();
    let unused = unused
        .iter()
        .map(|what| format!("`{name}`: its {what}: convert it to sRGB if its colours look wrong"));
    let warnings = unused
        .chain(transparency(alpha.as_ref(), path))
        .chain(decoded.densities.map(|own| unheeded::not_square(own, path)))
        .chain(decoded.turn_in_xmp.map(|turn| unheeded::turned(turn, path)))
        .collect();
    let encoding = match (transfer, of_file) {
        (Transfer::Srgb, Some(of_file)) => of_file,
        (_, of_file) => Encoding::overruled(transfer, of_file),
    };
    let image = decoded.light(&encoding);
    let size = [image.0.width() as u32, image.0.height() as u32];
    let mut exif = decoded.exif.take();
    let facts = match &exif {
        Some(exif) => Facts::of_exif(exif, size),
        None => Facts::of_size(size),
    };
    if let Some(exif) = &mut exif {
        let _turn = Orientation::remove_from_exif_chunk(exif);
    }
    Photo {
        image,
        alpha,
        transfer,
        encoding,
        values: Some(decoded.values_8()),
        facts,
        exif,
        gain: None,
        warnings,
    }
}

/// Reads linear light from OpenEXR (bare `R`, `G`, `B`, or `X`, `Y`, `Z`, or grey `Y`) or Radiance HDR. A
/// display-referred file is an error, so is NaN or infinity, with the pixel named.
///
/// Light of other primaries is converted to Rec.709. Where that gives a pixel without values below
/// 0 such a value, it becomes 0.
pub fn read_linear(path: impl AsRef<Path>) -> Result<LinearImage, ImagingError> {
    let path = path.as_ref();
    let bytes = read_bytes(path, LINEAR_FORMATS)?;
    let limit = SizeLimit::Any;
    let (mut image, primaries) = match Format::of(&bytes) {
        Format::Exr => linear_of_layers(&read_colour(&bytes, path, limit)?, path)?,
        Format::Hdr => hdr_file::decode(&bytes, path, limit)?,
        other => return Err(other.refuse(path, LINEAR_FORMATS)),
    };
    let to_rec709 = primaries.map_or(Ok(None), Primaries::to_rec709);
    let to_rec709 = to_rec709.map_err(|why| ImagingError::Unsupported {
        path: path.to_owned(),
        what: format!("has primaries that {why}"),
        remedy: "save it in linear Rec.709".into(),
    })?;
    if let Some(to_rec709) = to_rec709 {
        primaries::convert_clipped(&mut image, to_rec709);
        check_finite(path, &image.0)?;
    }
    Ok(image)
}

/// Reads a mask in `[0, 1]` (white is 1) from PNG, JPEG or OpenEXR. Stored values are coverage: no transfer and no
/// profile is applied.
///
/// PNG and JPEG are read upright as people see them. Colour is weighted as Rec.709 luma, and opacity multiplies.
///
/// Of OpenEXR the mask is the grey `Y`, else `R`, else `A`, else the only channel, on the display window as of a
/// photograph. Values are limited to `[0, 1]`.
///
/// # Errors
/// On a missing, empty, truncated or unsupported file, on OpenEXR with several channels of other names, and on NaN, with
/// the pixel named.
pub fn read_mask(path: impl AsRef<Path>) -> Result<Raster<f32>, ImagingError> {
    let path = path.as_ref();
    let bytes = read_bytes(path, MASK_FORMATS)?;
    if Format::of(&bytes) == Format::Exr {
        return exr_mask(&bytes, path);
    }
    let decoded = Decoded::of(&bytes, path, MASK_FORMATS, SizeLimit::Any)?;
    let image = decoded.light(&Encoding::named(Transfer::Linear));
    let mut mask = image.0.map(|c| c.dot(crate::metrics::LUMA).min(1.0));
    if let Some(alpha) = decoded.opacity() {
        for (m, a) in mask.pixels_mut().iter_mut().zip(alpha.pixels()) {
            *m *= a;
        }
    }
    Ok(mask)
}

/// Channels that a mask may be, the first that is there.
const MASK_CHANNELS: [&str; 3] = ["Y", "R", "A"];

fn exr_mask(bytes: &[u8], path: &Path) -> Result<Raster<f32>, ImagingError> {
    let length = bytes.len() as u64;
    let read = |names: &[&str]| {
        exr_file::read(
            Cursor::new(bytes),
            length,
            path,
            Some(names),
            SizeLimit::Any,
        )
    };
    let found = |layers: &Layers| {
        let named = MASK_CHANNELS.into_iter().find(|name| layers.contains(name));
        named.map(str::to_owned)
    };
    let mut layers = read(&MASK_CHANNELS)?;
    let mut name = found(&layers);
    if let (None, [only]) = (&name, layers.skipped()) {
        let only = only.clone();
        layers = read(&[&only])?;
        name = layers.contains(&only).then_some(only);
    }
    let Some(name) = name else {
        return Err(ImagingError::Unsupported {
            path: path.to_owned(),
            what: format!(
                "has the channels {}, and none of `Y`, `R`, `A` for a mask",
                listed(layers.skipped())
            ),
            remedy: "save the mask as the channel `Y`".into(),
        });
    };
    let mut mask = layers.channel(&name)?.clone();
    if let Some(at) = mask.pixels().iter().position(|v| v.is_nan()) {
        return Err(ImagingError::NotFinite {
            path: path.to_owned(),
            channel: name,
            x: at % mask.width(),
            y: at / mask.width(),
            value: f32::NAN,
        });
    }
    for value in mask.pixels_mut() {
        *value = value.clamp(0.0, 1.0);
    }
    Ok(mask)
}

/// Decodes a PNG or JPEG texture to 8-bit RGBA as stored: no transfer, no profile, no orientation
/// (glTF 2.0, 3.8.3). Grey is spread over the colours, missing alpha is 255, 16 bits are rounded to
/// 8. `name` stands in the error for the path.
pub fn decode_texture(bytes: &[u8], name: &str) -> Result<Raster<[u8; 4]>, ImagingError> {
    let path = Path::new(name);
    if bytes.is_empty() {
        return Err(ImagingError::Empty {
            path: path.to_owned(),
            expected: DISPLAY_FORMATS,
        });
    }
    Ok(Decoded::of(bytes, path, DISPLAY_FORMATS, SizeLimit::Any)?.rgba_8())
}

fn read_bytes(path: &Path, expected: &'static str) -> Result<Vec<u8>, ImagingError> {
    let failed = |e| ImagingError::io("read", path, e);
    let mut file = dipir_files::open(path).map_err(failed)?;
    let length = file.metadata().map_err(failed)?.len();
    if length == 0 {
        return Err(ImagingError::Empty {
            path: path.to_owned(),
            expected,
        });
    }
    if length > MAX_FILE_BYTES {
        return Err(ImagingError::TooLarge {
            path: path.to_owned(),
            bytes: length,
            limit: MAX_FILE_BYTES,
        });
    }
    let mut bytes = Vec::with_capacity(length as usize);
    file.read_to_end(&mut bytes).map_err(failed)?;
    Ok(bytes)
}

/// The largest image file that is read: 16,384 x 16,384 pixels of four 32-bit floats.
const MAX_FILE_BYTES: u64 = 1 << 32;

fn read_colour(bytes: &[u8], path: &Path, limit: SizeLimit) -> Result<Layers, ImagingError> {
    let length = bytes.len() as u64;
    let names = ["R", "G", "B", "A", "X", "Y", "Z"];
    exr_file::read(Cursor::new(bytes), length, path, Some(&names), limit)
}

/// Light as stored, and the primaries that it is in, if they are named. Grey has none, and `X`, `Y`, `Z` are CIE XYZ.
fn linear_of_layers(
    layers: &Layers,
    path: &Path,
) -> Result<(LinearImage, Option<Primaries>), ImagingError> {
    let (colour, primaries) = if layers.contains("R") || !layers.contains("Y") {
        (layers.rgb("")?, layers.primaries)
    } else if layers.contains("X") && layers.contains("Z") {
        let (xyz, white) = Primaries::of_xyz(layers.primaries);
        (layers.xyz("")?.map(|&v| v / white), Some(xyz))
    } else {
        if layers.skipped().iter().any(|c| c == "RY" || c == "BY") {
            return Err(ImagingError::Unsupported {
                path: path.to_owned(),
                what: "stores its colours as luminance and chroma (`Y`, `RY`, `BY`)".into(),
                remedy: "save it with the channels `R`, `G`, `B`".into(),
            });
        }
        (layers.channel("Y")?.map(|&v| Vec3::splat(v)), None)
    };
    check_finite(path, &colour)?;
    Ok((LinearImage(colour), primaries))
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

/// Errors with the first pixel, row by row, that is NaN or infinite.
pub(crate) fn check_finite(path: &Path, image: &Raster<Vec3>) -> Result<(), ImagingError> {
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
