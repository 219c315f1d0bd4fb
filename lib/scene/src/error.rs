//! What can go wrong between a `[scene]` table and a scene.
use std::path::PathBuf;

use dipir_cameras::CameraError;
use dipir_imaging::ImagingError;
use dipir_points::PointsError;

use crate::printable::printable;

/// Every message names the key, file or element that is wrong, what is accepted, and one remedy.
/// Control characters in names and values are printed as escapes.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A key of the `[scene]` table holds a value that makes no sense.
    #[error("{key} is {}; accepted: {accepted}", printable(value))]
    Config {
        /// Dotted path of the key, `scene.camera.fov_deg`.
        key: String,
        /// The value as written.
        value: String,
        /// The accepted form, with an example.
        accepted: String,
    },
    /// A key of the `[scene]` table is missing.
    #[error("{key} is missing; {remedy}")]
    Missing {
        /// Dotted path of the key.
        key: String,
        /// What to write.
        remedy: String,
    },
    /// Two keys exclude each other.
    #[error("{first} and {second} cannot both be given; keep one of them")]
    Conflict {
        /// Dotted path of the one key.
        first: String,
        /// Dotted path of the other key.
        second: String,
    },
    /// A file cannot be read.
    #[error("cannot read {} \"{}\": {source}", printable(role), printable(path.display()))]
    Read {
        /// What the file was wanted for.
        role: String,
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write \"{}\": {source}", printable(path.display()))]
    Write {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// Something is wrong inside a file.
    #[error("\"{}\": {source}", printable(path.display()))]
    InFile {
        /// The file.
        path: PathBuf,
        /// What is wrong there.
        source: Box<Error>,
    },
    /// An image cannot be decoded.
    #[error(transparent)]
    Image(#[from] ImagingError),
    /// A camera's file cannot be used.
    #[error("{}", printable(_0))]
    Camera(CameraError),
    /// Points cannot be used.
    #[error("{}", printable(_0))]
    Points(PointsError),
    /// The contents of a file do not make sense.
    #[error("{}; {remedy}", printable(detail))]
    Malformed {
        /// What is wrong and where.
        detail: String,
        /// What to do.
        remedy: &'static str,
    },
    /// The file needs an extension that cannot be ignored.
    #[error(
        "the file requires the glTF extension {}, which is not supported; {remedy}",
        printable(extension)
    )]
    UnsupportedExtension {
        /// Name of the extension.
        extension: String,
        /// What to do.
        remedy: &'static str,
    },
    /// A reference points past the end of what it refers to.
    #[error(
        "{} is {index}, but the file has {count} {things}; export the file again",
        printable(place)
    )]
    Dangling {
        /// Where the reference stands, `nodes[3].mesh`.
        place: String,
        /// The reference.
        index: u64,
        /// How many there are.
        count: u64,
        /// Of what, in the plural.
        things: &'static str,
    },
    /// A value is NaN or infinite.
    #[error(
        "{}, element {element} is ({value}), which is not finite; repair the mesh and export it again",
        printable(place)
    )]
    NotFinite {
        /// Which attribute.
        place: String,
        /// Index of the vertex.
        element: u64,
        /// The value.
        value: String,
    },
    /// The file asks for more than is allowed.
    #[error(
        "{}: more than the limit of {limit}; simplify the object, or raise {key}",
        printable(what)
    )]
    TooLarge {
        /// What is too large and how large.
        what: String,
        /// The key of the configuration that raises the limit.
        key: &'static str,
        /// The limit.
        limit: u64,
    },
    /// There is nothing to render in the file.
    #[error("the file holds no triangles; {remedy}")]
    Empty {
        /// What to do.
        remedy: &'static str,
    },
    /// An input is not what it was when the scene description was written.
    #[error(
        "{role} \"{}\" changed since the scene was set up: its BLAKE3 hash is {found}, the scene description has {expected}; run dipir-scene again",
        printable(path.display())
    )]
    Changed {
        /// What the file was wanted for.
        role: String,
        /// The file.
        path: PathBuf,
        /// The hash now.
        found: String,
        /// The hash then.
        expected: String,
    },
}

impl Error {
    /// Says in which file this went wrong.
    pub fn in_file(self, path: impl Into<PathBuf>) -> Self {
        Self::InFile {
            path: path.into(),
            source: Box::new(self),
        }
    }

    /// The same error about a table that has another's keys: `scene.views[0].camera` for `scene.camera`.
    pub(crate) fn moved(self, from: &str, to: &str) -> Self {
        let moved = |text: String| text.replace(from, to);
        match self {
            Self::Config {
                key,
                value,
                accepted,
            } => Self::Config {
                key: moved(key),
                value,
                accepted: moved(accepted),
            },
            Self::Missing { key, remedy } => Self::Missing {
                key: moved(key),
                remedy: moved(remedy),
            },
            Self::Conflict { first, second } => Self::Conflict {
                first: moved(first),
                second: moved(second),
            },
            other => other,
        }
    }

    pub(crate) fn malformed(detail: impl Into<String>, remedy: &'static str) -> Self {
        Self::Malformed {
            detail: detail.into(),
            remedy,
        }
    }
}
