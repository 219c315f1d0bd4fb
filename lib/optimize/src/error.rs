//! What can go wrong while light is recovered.
use std::path::PathBuf;

/// Why an optimisation did not start or did not end.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OptimizeError {
    /// A parameter without a gradient: a chain that was cut, not a gradient of zero.
    #[error(
        "no gradient for the tensor `{tensor}`; every parameter needs one, zeros if it is at rest"
    )]
    MissingGradient {
        /// The parameter.
        tensor: &'static str,
    },
    /// A gradient of another shape than its parameter.
    #[error(
        "the gradient of `{tensor}` has {found} values; expected {expected}, as many as the parameter"
    )]
    GradientSize {
        /// The parameter.
        tensor: &'static str,
        /// Values of the gradient.
        found: usize,
        /// Values of the parameter.
        expected: usize,
    },
    /// Several steps in a row were not finite.
    #[error(
        "`{tensor}` is not finite in iteration {iteration}, and {in_a_row} steps in a row could not be \
         taken; nothing was changed by them: lower light.learning_rates, or look at the inputs of \
         `{tensor}`"
    )]
    NotFinite {
        /// The first tensor, in the order of computation, that went bad in that iteration.
        tensor: String,
        /// The last iteration.
        iteration: usize,
        /// How many.
        in_a_row: usize,
    },
    /// Two pictures that belong together differ in size.
    #[error("{what} has {} x {} pixels; expected {} x {}, the size of {reference}", found.0, found.1, expected.0, expected.1)]
    Size {
        /// Which picture.
        what: &'static str,
        /// Width and height.
        found: (usize, usize),
        /// Width and height.
        expected: (usize, usize),
        /// What it is held against.
        reference: &'static str,
    },
    /// A file could not be read or written.
    #[error("cannot {action} `{}`", path.display())]
    Io {
        /// `read` or `write`.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file that is not what it should be.
    #[error("`{}` {detail}; {remedy}", path.display())]
    BadFile {
        /// The file.
        path: PathBuf,
        /// What is wrong, as a clause: `holds no tensor "first.exposure"`.
        detail: String,
        /// What to do.
        remedy: &'static str,
    },
    /// The light's transport could not be recorded.
    #[error("cannot record how light reaches the picture")]
    Record(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// The object could not be rendered.
    #[error("cannot render the object")]
    Render(#[source] dipir_render::error::RenderError),
    /// The guidance failed.
    #[error("the guidance failed in iteration {iteration}")]
    Guidance {
        /// When.
        iteration: usize,
        /// Why.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The caller asked to stop.
    #[error("interrupted")]
    Interrupted,
}

impl OptimizeError {
    pub(crate) fn io(action: &'static str, path: &std::path::Path, source: std::io::Error) -> Self {
        Self::Io {
            action,
            path: path.into(),
            source,
        }
    }
}
