//! PNG and JPEG samples as stored, with what the file says about them.
use crate::{
    encoding::Encoding,
    error::ImagingError,
    facts::is_adobe_rgb,
    file::{PhotoLimits, check_size},
    format::Format,
    jpeg_header,
    png_colours::PngColours,
    raster::{LinearImage, Raster},
    unheeded,
};
use glam::Vec3;
use image::{
    ImageDecoder, Limits,
    codecs::{jpeg::JpegDecoder, png::PngDecoder},
    metadata::Orientation,
};
use moxcms::ColorProfile;
use rayon::prelude::*;
use std::{io::Cursor, path::Path};

/// The samples of a display file, in the order in which they are stored.
pub(crate) struct Decoded {
    /// Columns as stored.
    width: usize,
    /// Rows as stored.
    height: usize,
    /// 1 grey, 2 grey and opacity, 3 RGB, 4 RGB and opacity.
    pub channels: usize,
    samples: Samples,
    /// How the stored picture is turned to be upright.
    orientation: Orientation,
    pub icc: Option<Vec<u8>>,
    /// What a PNG says of its colours beside a profile.
    pub png_colours: PngColours,
    /// Exif data from its TIFF header on.
    pub exif: Option<Vec<u8>>,
    /// The turn that XMP names where Exif data name none, 2 to 8; it is not applied.
    pub turn_in_xmp: Option<u8>,
    /// What names densities of pixels across and down that differ, and these.
    pub densities: Option<(&'static str, [u32; 2])>,
}

enum Samples {
    Eight(Vec<u8>),
    Sixteen(Vec<u16>),
}

/// The most pixels that a file may have; checked before anything of that size is allocated.
#[derive(Clone, Copy)]
pub(crate) enum SizeLimit {
    /// Any image's: [`MAX_PIXELS`](crate::error::MAX_PIXELS).
    Any,
    /// A photograph's.
    Photo(PhotoLimits),
}

impl SizeLimit {
    /// Errors on an image with no pixels or too many.
    pub fn check(self, path: &Path, width: usize, height: usize) -> Result<(), ImagingError> {
        match self {
            Self::Any => check_size(path, width, height),
            Self::Photo(limits) => limits.check(path, width, height),
        }
    }
}

/// Memory that the decoder of PNG may take beside the picture: rows and unpacked text and profiles.
const PNG_METADATA_BYTES: u64 = 64 << 20;

/// Bytes at a file's beginning in which it announces a profile.
const MOST_HEAD: usize = 1 << 16;

impl Decoded {
    /// Decodes a PNG or JPEG file.
    pub fn of(
        bytes: &[u8],
        path: &Path,
        expected: &'static str,
        limit: SizeLimit,
    ) -> Result<Self, ImagingError> {
        let format = Format::of(bytes);
        let failed = |error| image_error(path, format, error);
        match format {
            Format::Png => {
                let (width, height) = png_size(bytes).unwrap_or((1, 1));
                limit.check(path, width, height)?;
                let mut limits = Limits::no_limits();
                limits.max_alloc = Some(PNG_METADATA_BYTES + 32 * width as u64);
                let source = Cursor::new(bytes);
                let decoder = PngDecoder::with_limits(source, limits).map_err(failed)?;
                let mut decoded = Self::with(decoder, path, limit, failed)?;
                decoded.png_colours = PngColours::of(bytes);
                decoded.densities = unheeded::densities(bytes, format);
                Ok(decoded.with_profile_of(bytes, b"iCCP"))
            }
            Format::Jpeg => {
                jpeg_header::check(bytes, path)?;
                let decoder = JpegDecoder::new(Cursor::new(bytes)).map_err(failed)?;
                let decoded = Self::with(decoder, path, limit, failed)?;
                let mut decoded = decoded.with_profile_of(bytes, b"ICC_PROFILE\0");
                if decoded.icc.is_none()
                    && decoded.colours() == 3
                    && decoded.exif.as_deref().is_some_and(is_adobe_rgb)
                {
                    decoded.icc = ColorProfile::new_adobe_rgb().encode().ok();
                }
                decoded.densities = unheeded::densities(bytes, format);
                Ok(decoded)
            }
            other => Err(other.refuse(path, expected)),
        }
    }

    fn with(
        mut decoder: impl ImageDecoder,
        path: &Path,
        limit: SizeLimit,
        failed: impl Fn(image::ImageError) -> ImagingError,
    ) -> Result<Self, ImagingError> {
        let (width, height) = decoder.dimensions();
        let (width, height) = (width as usize, height as usize);
        limit.check(path, width, height)?;
        let color = decoder.color_type();
        let channels = usize::from(color.channel_count());
        let wide = usize::from(color.bytes_per_pixel()) > channels;
        // Metadata that cannot be read are as good as none.
        let icc = decoder.icc_profile().ok().flatten();
        let exif = decoder.exif_metadata().ok().flatten();
        let orientation = exif.as_deref().and_then(Orientation::from_exif_chunk);
        let xmp = decoder.xmp_metadata().ok().flatten();
        let xmp = xmp.filter(|_| orientation.is_none());
        let count = width * height * channels;
        let samples = if wide {
            let mut samples = vec![0u16; count];
            let bytes = bytemuck::cast_slice_mut(&mut samples);
            decoder.read_image(bytes).map_err(failed)?;
            Samples::Sixteen(samples)
        } else {
            let mut samples = vec![0u8; count];
            decoder.read_image(&mut samples).map_err(failed)?;
            Samples::Eight(samples)
        };
        Ok(Self {
            width,
            height,
            channels,
            samples,
            orientation: orientation.unwrap_or(Orientation::NoTransforms),
            icc,
            png_colours: PngColours::default(),
            exif,
            turn_in_xmp: xmp.as_deref().and_then(unheeded::turn_in_xmp),
            densities: None,
        })
    }

    /// With an empty profile, which nobody can use, if `bytes` announce one that could not be read.
    fn with_profile_of(mut self, bytes: &[u8], mark: &[u8]) -> Self {
        let head = &bytes[..bytes.len().min(MOST_HEAD)];
        // A PNG's pixels could hold the mark by chance.
        let pixels = head.windows(4).position(|w| w == b"IDAT");
        let head = &head[..pixels.unwrap_or(head.len())];
        if self.icc.is_none() && head.windows(mark.len()).any(|w| w == mark) {
            self.icc = Some(Vec::new());
        }
        self
    }

    /// Colours beside opacity: 1 or 3.
    pub fn colours(&self) -> usize {
        if self.channels < 3 { 1 } else { 3 }
    }

    fn has_alpha(&self) -> bool {
        self.channels.is_multiple_of(2)
    }

    /// The largest sample value.
    fn max(&self) -> u16 {
        match self.samples {
            Samples::Eight(_) => 255,
            Samples::Sixteen(_) => 65535,
        }
    }

    #[inline]
    fn sample(&self, pixel: usize, channel: usize) -> u16 {
        match &self.samples {
            Samples::Eight(s) => u16::from(s[pixel * self.channels + channel]),
            Samples::Sixteen(s) => s[pixel * self.channels + channel],
        }
    }

    /// The three colours of a stored pixel; grey is spread.
    #[inline]
    fn rgb(&self, pixel: usize) -> [u16; 3] {
        match self.channels {
            1 | 2 => [self.sample(pixel, 0); 3],
            _ => [0, 1, 2].map(|k| self.sample(pixel, k)),
        }
    }

    #[inline]
    fn alpha(&self, pixel: usize) -> u16 {
        self.sample(pixel, self.channels - 1)
    }

    /// An upright raster of `f` of every stored pixel's index.
    fn upright<T: Send>(&self, f: impl Fn(usize) -> T + Sync) -> Raster<T> {
        let turn = self.orientation;
        let (width, height) = self.upright_size();
        let pixels = (0..width * height).into_par_iter().map(|i| {
            let (x, y) = stored_at(turn, i % width, i / width, self.width, self.height);
            f(y * self.width + x)
        });
        Raster::from_pixels(width, height, pixels.collect())
    }

    /// The same, turned as another picture is.
    pub fn turned_as(self, other: &Self) -> Self {
        Self {
            orientation: other.orientation,
            ..self
        }
    }

    /// Columns and rows when upright.
    pub fn upright_size(&self) -> (usize, usize) {
        upright_size(self.orientation, self.width, self.height)
    }

    /// Upright linear light.
    pub fn light(&self, encoding: &Encoding) -> LinearImage {
        let tables = encoding.tables(self.max());
        LinearImage(self.upright(|pixel| {
            let rgb = self.rgb(pixel);
            let at = |k: usize| tables[k][usize::from(rgb[k])];
            encoding.to_rec709(Vec3::new(at(0), at(1), at(2)))
        }))
    }

    /// Upright opacity in `[0, 1]`, if the file has it.
    pub fn opacity(&self) -> Option<Raster<f32>> {
        let max = f32::from(self.max());
        self.has_alpha()
            .then(|| self.upright(|pixel| f32::from(self.alpha(pixel)) / max))
    }

    /// Upright values as stored, of 8 bits; 16 bits are rounded.
    pub fn values_8(&self) -> Raster<[u8; 3]> {
        let wide = self.max() > 255;
        self.upright(|pixel| self.rgb(pixel).map(|v| to_8(v, wide)))
    }

    /// RGBA of 8 bits as stored, not turned; missing opacity is 255.
    pub fn rgba_8(&self) -> Raster<[u8; 4]> {
        let wide = self.max() > 255;
        let pixels = (0..self.width * self.height).into_par_iter().map(|pixel| {
            let [r, g, b] = self.rgb(pixel).map(|v| to_8(v, wide));
            let a = match self.has_alpha() {
                true => to_8(self.alpha(pixel), wide),
                false => 255,
            };
            [r, g, b, a]
        });
        Raster::from_pixels(self.width, self.height, pixels.collect())
    }
}

/// The nearest of 256 values.
fn to_8(value: u16, wide: bool) -> u8 {
    match wide {
        true => ((u32::from(value) + 128) / 257) as u8,
        false => value as u8,
    }
}

/// Width and height in a PNG's header, which comes first.
fn png_size(bytes: &[u8]) -> Option<(usize, usize)> {
    let word = |at: usize| {
        let bytes = bytes.get(at..at + 4)?.first_chunk()?;
        Some(u32::from_be_bytes(*bytes) as usize)
    };
    (bytes.get(12..16)? == b"IHDR").then_some(())?;
    Some((word(16)?, word(20)?))
}

/// The size of an image of `width` x `height` when upright.
pub(crate) fn upright_size(turn: Orientation, width: usize, height: usize) -> (usize, usize) {
    match turn.to_exif() {
        5..=8 => (height, width),
        _ => (width, height),
    }
}

/// The stored column and row of the pixel that is seen in column `x` of row `y`, in an image that
/// is stored with `width` x `height` pixels [Exif 2.3, tag Orientation].
fn stored_at(turn: Orientation, x: usize, y: usize, width: usize, height: usize) -> (usize, usize) {
    let (right, bottom) = (width - 1, height - 1);
    match turn {
        Orientation::NoTransforms => (x, y),
        Orientation::FlipHorizontal => (right - x, y),
        Orientation::Rotate180 => (right - x, bottom - y),
        Orientation::FlipVertical => (x, bottom - y),
        Orientation::Rotate90FlipH => (y, x),
        Orientation::Rotate90 => (y, bottom - x),
        Orientation::Rotate270FlipH => (right - y, bottom - x),
        Orientation::Rotate270 => (right - y, x),
    }
}

/// What a decoder of the `image` crate complains of.
pub(crate) fn image_error(path: &Path, format: Format, error: image::ImageError) -> ImagingError {
    match error {
        image::ImageError::Unsupported(what) => ImagingError::Unsupported {
            path: path.to_owned(),
            what: format!("is a kind of {} file ({what})", format.name()),
            remedy: match format {
                Format::Hdr => "save it as OpenEXR, or as Radiance HDR in RGBE from the top left",
                _ => "save it as an 8-bit RGB PNG",
            }
            .into(),
        },
        other => ImagingError::Damaged {
            path: path.to_owned(),
            format: format.name(),
            detail: other.to_string(),
        },
    }
}
