//! What can go wrong with a light.
use std::path::PathBuf;

/// Why a light was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LightError {
    /// The file could not be read or written as an image.
    #[error(transparent)]
    Image(#[from] dipir_imaging::ImagingError),
    /// The file is an image, but no environment map.
    #[error("cannot light a scene with `{}`", path.display())]
    Map {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: Box<LightError>,
    },
    /// A map without texels.
    #[error(
        "an environment map of {width} x {height} texels holds no light; it needs at least 1 x 1"
    )]
    Empty {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// The number of texels is not width times height.
    #[error("{found} texels were given for an environment map of {width} x {height}")]
    TexelCount {
        /// Texels given.
        found: usize,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// A texel that is no radiance.
    #[error(
        "radiance {value} at column {column}, row {row} of the environment map; every channel must be \
         finite and not negative: repair the pixel in an image editor"
    )]
    Texel {
        /// Column, from the left.
        column: usize,
        /// Row, from the top.
        row: usize,
        /// What stands there.
        value: glam::Vec3,
    },
    /// An image that is no latitude-longitude panorama.
    #[error(
        "{width} x {height} pixels are no latitude-longitude map, which is twice as wide as high; \
         crop or convert it to {} x {}",
        2 * height,
        height
    )]
    Aspect {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// A spherical Gaussian that describes no light.
    #[error("lobe {index}: {field} is {value}; it must be {accepted}")]
    Lobe {
        /// Place in the list, from 0.
        index: usize,
        /// Which parameter.
        field: &'static str,
        /// What it is, as text.
        value: String,
        /// What is accepted.
        accepted: &'static str,
    },
}
