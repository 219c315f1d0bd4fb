//! Textures: kept as their source file holds them, decoded only for the effects that need them.
use std::collections::HashSet;
use std::collections::hash_map::{Entry, HashMap};
use std::io::{BufRead, BufReader, Cursor, Seek};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use dipir_imaging::raster::Raster;
use dipir_imaging::transfer::Transfer;
use glam::{Vec2, Vec4};
use image::{ImageFormat, ImageReader};

use crate::error::Error;
use crate::limits::Limits;
use crate::printable::printable;

/// What happens to texture coordinates outside `[0, 1)`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Wrap {
    /// The image is tiled.
    #[default]
    Repeat,
    /// The image is tiled, every other tile mirrored.
    MirroredRepeat,
    /// The outermost texels extend for ever.
    ClampToEdge,
}

impl Wrap {
    /// The texel inside `0..size` that stands for texel `i`.
    fn texel(self, i: i64, size: usize) -> usize {
        let n = size as i64;
        let wrapped = match self {
            Self::Repeat => i.rem_euclid(n),
            Self::MirroredRepeat => {
                let k = i.rem_euclid(2 * n);
                k.min(2 * n - 1 - k)
            }
            Self::ClampToEdge => i.clamp(0, n - 1),
        };
        wrapped as usize
    }
}

/// How a value between texel centres is formed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Filter {
    /// The texel that contains the position.
    Nearest,
    /// Bilinear interpolation of the four nearest texels, in linear light.
    #[default]
    Linear,
}

/// How the colour channels are encoded; alpha is always linear.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Encoding {
    /// sRGB curve: base colour and emission.
    Srgb,
    /// Plain numbers: normals, roughness, metalness and weights.
    Linear,
}

/// An image as a file holds it, encoded.
#[derive(Clone, Debug)]
pub enum ImageSource {
    /// A PNG, JPEG, WebP, BMP or Targa file, read when it is decoded.
    File(PathBuf),
    /// The bytes of such a file that is embedded in another.
    Bytes {
        /// What to call the image in messages.
        name: String,
        /// The encoded file.
        bytes: Arc<[u8]>,
    },
}

/// What identifies an image without its pixels.
#[derive(PartialEq, Eq, Hash)]
enum Identity<'a> {
    File(&'a Path),
    Bytes(*const u8),
}

impl ImageSource {
    /// What to call the image in messages.
    pub fn name(&self) -> String {
        match self {
            Self::File(path) => format!("\"{}\"", printable(path.display())),
            Self::Bytes { name, .. } => printable(name),
        }
    }

    fn identity(&self) -> Identity<'_> {
        match self {
            Self::File(path) => Identity::File(path),
            Self::Bytes { bytes, .. } => Identity::Bytes(bytes.as_ptr()),
        }
    }

    fn decode(&self) -> Result<Raster<[u8; 4]>, Error> {
        match self {
            Self::File(path) => {
                let bytes = dipir_files::read(path).map_err(|e| self.unreadable(e))?;
                // The decoder puts it between quotation marks.
                let name = printable(path.display());
                decode(&bytes, other_format(&bytes, is_targa(path)), &name)
            }
            Self::Bytes { bytes, .. } => decode(bytes, other_format(bytes, false), &self.name()),
        }
    }

    /// The number of pixels by the header; `None` if it cannot be read. Decoding will say why.
    pub(crate) fn pixels(&self) -> Result<Option<u64>, Error> {
        let size = match self {
            Self::File(path) => {
                let file = dipir_files::open(path).map_err(|e| self.unreadable(e))?;
                size_in_header(BufReader::new(file), is_targa(path))
            }
            Self::Bytes { bytes, .. } => size_in_header(Cursor::new(bytes), false),
        };
        Ok(size.map(|(width, height)| u64::from(width) * u64::from(height)))
    }

    fn unreadable(&self, source: std::io::Error) -> Error {
        Error::Read {
            role: "the texture".into(),
            path: match self {
                Self::File(path) => path.clone(),
                Self::Bytes { name, .. } => name.into(),
            },
            source,
        }
    }
}

/// Whether a file is a Targa image by its name: nothing at its beginning says so.
fn is_targa(path: &Path) -> bool {
    path.extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("tga"))
}

fn size_in_header(bytes: impl BufRead + Seek, is_targa: bool) -> Option<(u32, u32)> {
    let mut reader = ImageReader::new(bytes).with_guessed_format().ok()?;
    if reader.format().is_none() && is_targa {
        reader.set_format(ImageFormat::Tga);
    }
    reader.into_dimensions().ok()
}

/// The format of a texture that photographs do not have.
fn other_format(bytes: &[u8], is_targa: bool) -> Option<ImageFormat> {
    match image::guess_format(bytes) {
        Ok(format @ (ImageFormat::WebP | ImageFormat::Bmp)) => Some(format),
        Err(_) if is_targa && !bytes.is_empty() => Some(ImageFormat::Tga),
        _ => None,
    }
}

fn decode(bytes: &[u8], other: Option<ImageFormat>, name: &str) -> Result<Raster<[u8; 4]>, Error> {
    let Some(format) = other else {
        return Ok(dipir_imaging::file::decode_texture(bytes, name)?);
    };
    let decoded = image::load_from_memory_with_format(bytes, format).map_err(|e| {
        Error::malformed(
            format!("the {format:?} image {name} cannot be decoded: {e}"),
            "export it as PNG or JPEG",
        )
    })?;
    let rgba = decoded.into_rgba8();
    let (width, height) = (rgba.width() as usize, rgba.height() as usize);
    let texels = rgba.as_raw().as_chunks::<4>().0.to_vec();
    Ok(Raster::from_pixels(width, height, texels))
}

/// Refuses images larger than `limits`, by their headers. What several textures share counts once.
pub fn check_sizes(textures: &[Texture], limits: &Limits) -> Result<(), Error> {
    let mut all = 0u64;
    let mut seen = HashSet::new();
    for Texture { image, .. } in textures {
        if seen.insert(image.identity())
            && let Some(pixels) = image.pixels()?
        {
            all = all.saturating_add(pixels);
            limits.check_pixels(pixels, all, &image.name())?;
        }
    }
    Ok(())
}

/// A texture as the source file holds it: the encoded image and how to look it up.
#[derive(Clone, Debug)]
pub struct Texture {
    /// The image.
    pub image: ImageSource,
    /// What the colour channels mean.
    pub encoding: Encoding,
    /// Behaviour outside `[0, 1)` along u and v.
    pub wrap: [Wrap; 2],
    /// Interpolation.
    pub filter: Filter,
}

impl Texture {
    /// Reads and decodes the image. Fails on anything but a readable PNG, JPEG, WebP, BMP or Targa image.
    pub fn decode(&self) -> Result<DecodedTexture, Error> {
        Ok(self.with_texels(Arc::new(self.image.decode()?)))
    }

    /// Looks `texels` up the way this texture says.
    fn with_texels(&self, texels: Arc<Raster<[u8; 4]>>) -> DecodedTexture {
        let linear =
            |transfer: Transfer| std::array::from_fn(|i| transfer.decode_scalar(i as f32 / 255.0));
        DecodedTexture {
            texels,
            color_linear: Box::new(match self.encoding {
                Encoding::Srgb => linear(Transfer::Srgb),
                Encoding::Linear => linear(Transfer::Linear),
            }),
            wrap: self.wrap,
            filter: self.filter,
        }
    }
}

/// Decodes the textures for which `wanted(index)` holds; an image that several of them share is
/// decoded and stored once.
pub fn decode_textures(
    textures: &[Texture],
    wanted: impl Fn(usize) -> bool,
) -> Result<Vec<Option<DecodedTexture>>, Error> {
    let mut decoded: Vec<Option<DecodedTexture>> = Vec::with_capacity(textures.len());
    let mut known = HashMap::new();
    for (i, texture) in textures.iter().enumerate() {
        if !wanted(i) {
            decoded.push(None);
            continue;
        }
        let texels: &Arc<Raster<[u8; 4]>> = match known.entry(texture.image.identity()) {
            Entry::Occupied(earlier) => earlier.into_mut(),
            Entry::Vacant(new) => new.insert(Arc::new(texture.image.decode()?)),
        };
        decoded.push(Some(texture.with_texels(texels.clone())));
    }
    Ok(decoded)
}

/// A texture that can be sampled.
#[derive(Clone, Debug)]
pub struct DecodedTexture {
    texels: Arc<Raster<[u8; 4]>>,
    /// Linear value of each byte of a colour channel.
    color_linear: Box<[f32; 256]>,
    wrap: [Wrap; 2],
    filter: Filter,
}

impl DecodedTexture {
    /// The linear RGBA value at `uv` (glTF convention: (0, 0) is the top left corner of the
    /// image, v points down). Coordinates that are not finite read texel (0, 0).
    pub fn sample(&self, uv: Vec2) -> Vec4 {
        let (w, h) = (self.texels.width(), self.texels.height());
        let uv = if uv.is_finite() { uv } else { Vec2::ZERO };
        let x = reduce(uv.x, self.wrap[0]) * w as f32;
        let y = reduce(uv.y, self.wrap[1]) * h as f32;
        match self.filter {
            Filter::Nearest => self.texel(x.floor() as i64, y.floor() as i64),
            Filter::Linear => {
                let (x, y) = (x - 0.5, y - 0.5);
                let (x0, y0) = (x.floor(), y.floor());
                let (fx, fy) = (x - x0, y - y0);
                let (x0, y0) = (x0 as i64, y0 as i64);
                let top = self.texel(x0, y0).lerp(self.texel(x0 + 1, y0), fx);
                let bottom = self.texel(x0, y0 + 1).lerp(self.texel(x0 + 1, y0 + 1), fx);
                top.lerp(bottom, fy)
            }
        }
    }

    /// Width and height, texels.
    pub fn size(&self) -> [usize; 2] {
        [self.texels.width(), self.texels.height()]
    }

    /// The texels as decoded, RGBA.
    pub fn texels(&self) -> &Raster<[u8; 4]> {
        &self.texels
    }

    fn texel(&self, x: i64, y: i64) -> Vec4 {
        let [r, g, b, a] = *self.texels.get(
            self.wrap[0].texel(x, self.texels.width()),
            self.wrap[1].texel(y, self.texels.height()),
        );
        let c = &self.color_linear;
        Vec4::new(
            c[r as usize],
            c[g as usize],
            c[b as usize],
            a as f32 / 255.0,
        )
    }
}

/// Brings a coordinate into the first period, or near the edge: its product with the image's size
/// then fits an integer and keeps its digits.
fn reduce(u: f32, wrap: Wrap) -> f32 {
    match wrap {
        Wrap::Repeat => u - u.floor(),
        Wrap::MirroredRepeat => u - 2.0 * (u * 0.5).floor(),
        Wrap::ClampToEdge => u.clamp(-1.0, 2.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Texels of these red bytes in one row.
    fn row(reds: &[u8], wrap: Wrap, filter: Filter) -> DecodedTexture {
        let texture = Texture {
            image: ImageSource::File("unused".into()),
            encoding: Encoding::Linear,
            wrap: [wrap; 2],
            filter,
        };
        let texels = reds.iter().map(|r| [*r, 0, 0, 255]).collect();
        texture.with_texels(Arc::new(Raster::from_pixels(reds.len(), 1, texels)))
    }

    fn red(texture: &DecodedTexture, u: f32) -> f32 {
        texture.sample(Vec2::new(u, 0.5)).x * 255.0
    }

    /// Bytes of order 255 after a few roundings.
    const ROUNDING: f32 = 255.0 * 4.0 * f32::EPSILON;

    /// Red, green over blue, white.
    const FOUR: [[u8; 4]; 4] = [
        [255, 0, 0, 255],
        [0, 255, 0, 255],
        [0, 0, 255, 255],
        [255, 255, 255, 255],
    ];

    /// Rows of blue, green, red from the bottom up, each filled up to a multiple of `align` bytes.
    fn rows_from_the_bottom(align: usize) -> Vec<u8> {
        let row = |texels: &[[u8; 4]]| {
            let mut row: Vec<u8> = texels.iter().flat_map(|t| [t[2], t[1], t[0]]).collect();
            row.resize(row.len().next_multiple_of(align), 0);
            row
        };
        [row(&FOUR[2..]), row(&FOUR[..2])].concat()
    }

    #[test]
    fn bmp_and_targa_textures_are_read_upright() {
        let mut bmp =
            b"BM\x46\0\0\0\0\0\0\0\x36\0\0\0\x28\0\0\0\x02\0\0\0\x02\0\0\0\x01\0\x18\0".to_vec();
        bmp.resize(0x36, 0);
        bmp.extend(rows_from_the_bottom(4));
        let mut targa = vec![0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0, 2, 0, 24, 0];
        targa.extend(rows_from_the_bottom(1));
        let folder = tempfile::tempdir().unwrap();
        for (name, bytes) in [("paint.bmp", bmp), ("PAINT.TGA", targa)] {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            let image = ImageSource::File(path);
            assert_eq!(image.pixels().unwrap(), Some(4), "{name}");
            assert_eq!(image.decode().unwrap().pixels(), FOUR, "{name}");
        }
    }

    #[test]
    fn a_targa_texture_that_is_none_is_told_by_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notes.tga");
        std::fs::write(&path, "these are notes").unwrap();
        let told = ImageSource::File(path).decode().unwrap_err().to_string();
        assert!(told.contains("notes.tga"), "{told}");
        assert!(told.contains("export it as PNG or JPEG"), "{told}");
    }

    #[test]
    fn linear_filtering_meets_texel_centres_and_halves_between_them() {
        let texture = row(&[0, 200, 100, 40], Wrap::ClampToEdge, Filter::Linear);
        for (u, expected) in [
            (0.125, 0.0),
            (0.375, 200.0),
            (0.25, 100.0),
            (0.5, 150.0),
            (0.875, 40.0),
            // Beyond the outermost centres the edge extends.
            (0.0, 0.0),
            (1.0, 40.0),
            (-7.0, 0.0),
        ] {
            assert!((red(&texture, u) - expected).abs() < ROUNDING, "u = {u}");
        }
    }

    #[test]
    fn wrap_modes_agree_with_their_tilings() {
        let reds = [10, 20, 30];
        for (wrap, tiled) in [
            (Wrap::Repeat, [10, 20, 30, 10, 20, 30, 10, 20, 30]),
            (Wrap::MirroredRepeat, [30, 20, 10, 10, 20, 30, 30, 20, 10]),
            (Wrap::ClampToEdge, [10, 10, 10, 10, 20, 30, 30, 30, 30]),
        ] {
            let texture = row(&reds, wrap, Filter::Nearest);
            for (i, expected) in tiled.iter().enumerate() {
                // Texel centres of the tiles from -1 to 2.
                let u = (i as f32 + 0.5) / 3.0 - 1.0;
                let found = red(&texture, u);
                assert!(
                    (found - *expected as f32).abs() < ROUNDING,
                    "{wrap:?} at {u}: {found}"
                );
            }
        }
    }

    #[test]
    fn repeat_interpolates_across_the_seam() {
        let texture = row(&[0, 100], Wrap::Repeat, Filter::Linear);
        assert!((red(&texture, 0.0) - 50.0).abs() < ROUNDING);
        assert!((red(&texture, 1.0) - 50.0).abs() < ROUNDING);
        assert!((red(&texture, -3.25) - 100.0).abs() < ROUNDING);
    }

    #[test]
    fn any_coordinate_reads_a_texel() {
        for wrap in [Wrap::Repeat, Wrap::MirroredRepeat, Wrap::ClampToEdge] {
            for filter in [Filter::Nearest, Filter::Linear] {
                let texture = row(&[10, 20, 30], wrap, filter);
                for u in [
                    f32::NAN,
                    f32::INFINITY,
                    -f32::INFINITY,
                    f32::MAX,
                    -f32::MAX,
                    1e9,
                    -1e-9,
                ] {
                    let found = red(&texture, u);
                    assert!((9.99..=30.01).contains(&found), "{wrap:?} at {u}: {found}");
                }
            }
        }
    }

    #[test]
    fn srgb_is_decoded_before_it_is_interpolated() {
        let mut texture = row(&[0, 255], Wrap::ClampToEdge, Filter::Linear);
        let curve = Texture {
            image: ImageSource::File("unused".into()),
            encoding: Encoding::Srgb,
            wrap: [Wrap::ClampToEdge; 2],
            filter: Filter::Linear,
        };
        texture = curve.with_texels(texture.texels.clone());
        // Halfway between black and white in light, not in bytes.
        assert!((texture.sample(Vec2::new(0.5, 0.5)).x - 0.5).abs() < 4.0 * f32::EPSILON);
        assert_eq!(texture.sample(Vec2::new(0.5, 0.5)).w, 1.0);
    }

    #[test]
    fn one_texel_is_constant() {
        let texture = row(&[77], Wrap::Repeat, Filter::Linear);
        for u in [-3.3, 0.0, 0.49, 12.7] {
            assert!((red(&texture, u) - 77.0).abs() < ROUNDING);
        }
    }
}
