//! What can keep a first configuration from being written.
use std::borrow::Cow;
use std::path::PathBuf;

use dipir_cameras::CameraError;
use dipir_imaging::ImagingError;

/// Every message names the file or option that is wrong and what to do.
#[derive(Debug, thiserror::Error)]
pub enum SetupError {
    /// The photograph cannot be read.
    #[error(transparent)]
    Photo(#[from] ImagingError),
    /// A model cannot be read.
    #[error(transparent)]
    Model(#[from] dipir_scene::Error),
    /// A model has nothing to show.
    #[error("\"{}\" holds no triangles; export it with its meshes", path.display())]
    Empty {
        /// The model.
        path: PathBuf,
    },
    /// A model's textures are larger than any limit allows.
    #[error(
        "\"{}\": {what}, and at most {limit} are read; scale them down: gltf-transform resize --width 8192 --height 8192 IN.glb OUT.glb",
        path.display()
    )]
    Textures {
        /// The model.
        path: PathBuf,
        /// Which, and how large.
        what: String,
        /// The limit, pixels.
        limit: u64,
    },
    /// A camera's file is damaged.
    #[error("\"{}\": {source}", path.display())]
    CameraFile {
        /// The file.
        path: PathBuf,
        /// What is wrong there.
        source: CameraError,
    },
    /// A camera's file says what `[scene.camera]` cannot.
    #[error("the camera of \"{}\" cannot be used: {detail}; {remedy}", path.display())]
    Camera {
        /// The file.
        path: PathBuf,
        /// What of it.
        detail: String,
        /// What to do.
        remedy: &'static str,
    },
    /// An option has a value that makes no sense.
    #[error("{option} is {value}; accepted: {accepted}")]
    Value {
        /// As it is typed, `--fov`.
        option: &'static str,
        /// The value.
        value: String,
        /// The accepted form, with an example.
        accepted: &'static str,
    },
    /// The weights that tell a photograph's camera are of another version.
    #[error(transparent)]
    Calibration(#[from] dipir_calibration::CalibrationError),
    /// The camera sees no ground to put anything on.
    #[error("the camera sees no ground: {detail}; {remedy}")]
    NoGround {
        /// Why not.
        detail: String,
        /// What to do.
        remedy: Cow<'static, str>,
    },
    /// The file to write is there already.
    #[error("\"{}\" is there already and stays as it is; name another file with --out", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// A path cannot stand in a TOML file.
    #[error("the path \"{}\" is not UTF-8, as TOML files are; rename the file", path.display())]
    NotUtf8 {
        /// The path.
        path: PathBuf,
    },
    /// A file cannot be read.
    #[error("cannot read \"{}\": {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// The file cannot be written.
    #[error("cannot write \"{}\": {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
}

impl SetupError {
    /// With what to do about a camera that sees no ground, if it is from a file or there are doubts about axes that point up.
    pub(crate) fn of_camera(self, is_from_file: bool, doubts: &[String]) -> Self {
        match self {
            Self::NoGround { detail, remedy } => Self::NoGround {
                detail,
                remedy: match (doubts, is_from_file) {
                    ([], false) => remedy,
                    ([], true) => "see whether --camera and --camera-up are right".into(),
                    _ => doubts.join("; ").into(),
                },
            },
            other => other,
        }
    }
}
