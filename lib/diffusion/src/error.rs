//! Errors of diffusion models, each with what to do about it.

use std::path::PathBuf;

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file or folder could not be read or written.
    #[error("cannot {action} {path}: {source}")]
    Io {
        /// "read", "write", "create"...
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A JSON file does not hold what is needed.
    #[error("{path}: {message}")]
    Config {
        /// The file.
        path: PathBuf,
        /// What is wrong, the accepted form and a remedy.
        message: String,
    },
    /// A safetensors file is damaged or hostile.
    #[error("{path}: not a usable safetensors file: {message}; fetch or export the file again")]
    Safetensors {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        message: String,
    },
    /// Weights do not fit the model that their configuration describes.
    #[error("{path}: weights do not fit the configuration beside them: {}", list(.problems))]
    Weights {
        /// The file or folder of the weights.
        path: PathBuf,
        /// One sentence for each tensor.
        problems: Vec<String>,
    },
    /// A LoRA file does not fit the model.
    #[error("{path}: not a LoRA for this model: {}", list(.problems))]
    Lora {
        /// The file.
        path: PathBuf,
        /// One sentence for each key.
        problems: Vec<String>,
    },
    /// An argument is outside its range or of a wrong shape.
    #[error("{0}")]
    Argument(String),
    /// A checkpoint does not belong to this run.
    #[error("{path}: cannot resume from this checkpoint: {message}")]
    Checkpoint {
        /// The checkpoint.
        path: PathBuf,
        /// What differs.
        message: String,
    },
    /// A trainable tensor got no gradient, or one that is not finite.
    #[error("parameter {name}: {message}")]
    Gradient {
        /// The parameter's name.
        name: String,
        /// What is wrong with its gradient.
        message: String,
    },
    /// A model gave values that are not finite.
    #[error(
        "the model's output is not finite ({what}); `dipir-model check` shows which part of it is wrong"
    )]
    NotFinite {
        /// Which values.
        what: &'static str,
    },
    /// The tokenizer could not be built or used.
    #[error("{path}: tokenizer: {message}")]
    Tokenizer {
        /// The tokenizer's folder.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// A tensor operation failed.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// Result with this crate's error.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// How many problems an error message spells out before it only counts.
const SPELLED_OUT: usize = 8;

impl Error {
    /// Whether a GPU's memory did not suffice. candle hands the driver's error on as text.
    pub(crate) fn is_out_of_memory(&self) -> bool {
        let told = |e: &candle_core::Error| {
            let text = e.to_string();
            ["CUDA_ERROR_OUT_OF_MEMORY", "CUBLAS_STATUS_ALLOC_FAILED"]
                .iter()
                .any(|name| text.contains(name))
        };
        matches!(self, Self::Tensor(e) if told(e))
    }
}

fn list(problems: &[String]) -> String {
    let mut text = problems
        .iter()
        .take(SPELLED_OUT)
        .cloned()
        .collect::<Vec<_>>()
        .join("; ");
    if problems.len() > SPELLED_OUT {
        text += &format!("; and {} more", problems.len() - SPELLED_OUT);
    }
    text
}

pub(crate) fn io(
    action: &'static str,
    path: impl Into<PathBuf>,
) -> impl FnOnce(std::io::Error) -> Error {
    let path = path.into();
    move |source| Error::Io {
        action,
        path,
        source,
    }
}

pub(crate) fn argument<T>(message: impl Into<String>) -> Result<T> {
    Err(Error::Argument(message.into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_gpu_without_memory_is_told_as_such() {
        let told = |text: &str| Error::Tensor(candle_core::Error::Msg(text.into()));
        let driver = r#"DriverError(CUDA_ERROR_OUT_OF_MEMORY, "out of memory")"#;
        assert!(told(driver).is_out_of_memory());
        assert!(told("CublasError(CUBLAS_STATUS_ALLOC_FAILED)").is_out_of_memory());
        assert!(!told("DriverError(CUDA_ERROR_ILLEGAL_ADDRESS)").is_out_of_memory());
        assert!(!Error::Argument(driver.into()).is_out_of_memory());
    }
}
