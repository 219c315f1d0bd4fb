//! What can go wrong.
use thiserror::Error;

/// A failure of this crate.
#[derive(Debug, Error)]
pub enum RenderError {
    /// A texture that an effect needs could not be read.
    #[error(transparent)]
    Scene(#[from] dipir_scene::error::Error),
    /// An image that must match the camera does not.
    #[error(
        "the {what} is {width} x {height} pixels, the camera {camera_width} x {camera_height}: \
         give images of the camera's size"
    )]
    SizeMismatch {
        /// Which image.
        what: &'static str,
        /// Its columns.
        width: usize,
        /// Its rows.
        height: usize,
        /// The camera's columns.
        camera_width: usize,
        /// The camera's rows.
        camera_height: usize,
    },
    /// An effect name that does not exist.
    #[error("unknown effect \"{name}\": known effects are {known}; the nearest is \"{nearest}\"")]
    UnknownEffect {
        /// What was given.
        name: String,
        /// All names.
        known: String,
        /// The most similar one.
        nearest: String,
    },
    /// A light that cannot be used.
    #[error(transparent)]
    Light(#[from] dipir_light::error::LightError),
    /// An environment that transport cannot be recorded for.
    #[error(
        "transport cannot be recorded for an environment of {width} x {height} texels: give 1 to \
         {limit} texels, or single precision for more than 65536"
    )]
    EnvironmentSize {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Most texels.
        limit: usize,
    },
    /// More weights than a record can count.
    #[error(
        "the light transport has more than 4294967295 weights: record fewer samples or a smaller \
         picture"
    )]
    TransportTooLarge,
    /// A file of recorded transport that cannot be used.
    #[error("the transport file {} {problem}: record it again with dipir-scene", path.display())]
    Transport {
        /// The file.
        path: std::path::PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// The caller asked to stop.
    #[error("rendering was interrupted")]
    Interrupted,
}
