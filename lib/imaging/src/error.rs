//! What can go wrong with images and their files.
use std::borrow::Cow;
use std::path::{Path, PathBuf};

/// A failure to read, write or combine images. Every message names the file, channel or pixel
/// at fault, what would have been accepted, and one thing to do about it.
#[derive(Debug, thiserror::Error)]
pub enum ImagingError {
    /// No file at that path.
    #[error("`{}` does not exist; check the path", path.display())]
    NotFound {
        /// What was asked for.
        path: PathBuf,
    },
    /// The operating system refused; the cause is its message.
    #[error("cannot {action} `{}`", path.display())]
    Io {
        /// `read`, `write` or `create`.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file of zero bytes.
    #[error("`{}` is empty (0 bytes); expected {expected}: export the file again", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
        /// Accepted formats.
        expected: &'static str,
    },
    /// The first bytes belong to no accepted format.
    #[error("`{}` is {found}; expected {expected}: {remedy}", path.display())]
    WrongFormat {
        /// The file.
        path: PathBuf,
        /// What its first bytes say it is.
        found: &'static str,
        /// Accepted formats.
        expected: &'static str,
        /// What to do, with the command of a converter where there is a usual one.
        remedy: String,
    },
    /// The format is right but the contents cannot be decoded, most often because the end is missing.
    #[error("`{}` is damaged or cut short: {}; expected a complete {format} file: export or copy it again", path.display(), in_words(detail))]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The format that its first bytes announce.
        format: &'static str,
        /// What the decoder met.
        detail: String,
    },
    /// A legal file that uses something not supported here.
    #[error("`{}` {what}, which is not supported; {remedy}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What it uses, as a clause: `is a CMYK JPEG`.
        what: String,
        /// What to do instead.
        remedy: Cow<'static, str>,
    },
    /// NaN or infinity where light or a display value must be.
    #[error("`{}` holds {value} in channel {channel} of the pixel in column {x}, row {y} (from the top left); expected finite values: repair the pixel", path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The channel's name.
        channel: String,
        /// Column.
        x: usize,
        /// Row.
        y: usize,
        /// NaN, inf or -inf.
        value: f32,
    },
    /// A layer was asked for that the file does not have.
    #[error(
        "{} has no channel `{channel}`; it has {}",
        quoted(path),
        listed(present)
    )]
    MissingChannel {
        /// The file, if the layers came from one.
        path: Option<PathBuf>,
        /// The name asked for.
        channel: String,
        /// The names that exist.
        present: Vec<String>,
    },
    /// A channel name that cannot be stored.
    #[error("channel name `{name}` {reason}; use a name such as `R` or `shadow.R`")]
    BadChannelName {
        /// The name.
        name: String,
        /// Why not, as a clause.
        reason: &'static str,
    },
    /// A tone file that does not describe four spline curves.
    #[error("`{}` is not a tone file: {detail}; expected `foreground` and three `shadow` curves of 6 knots each, rising from 0 to 1: write it again with the optimisation", path.display())]
    BadTone {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        detail: String,
    },
    /// Two images that must have the same size do not.
    #[error("{what} is {} x {} pixels; expected {} x {}, the size of {reference}", found.0, found.1, expected.0, expected.1)]
    SizeMismatch {
        /// The image at fault.
        what: String,
        /// Its width and height.
        found: (usize, usize),
        /// The width and height that fit.
        expected: (usize, usize),
        /// The image that sets the size.
        reference: &'static str,
    },
    /// A photograph with more pixels than allowed.
    #[error("`{}` is {width} x {height} pixels ({megapixels:.1} megapixels); the limit is {limit}: scale it down, or raise {key}", path.display())]
    TooManyPixels {
        /// The file.
        path: PathBuf,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Both multiplied, in millions.
        megapixels: f64,
        /// The most, in millions.
        limit: f64,
        /// The key of the configuration that sets the limit.
        key: &'static str,
    },
    /// A file with more bytes than an image of the largest size has.
    #[error("`{}` has {bytes} bytes; expected at most {limit}, the largest image uncompressed: save it compressed", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Its length.
        bytes: u64,
        /// The most.
        limit: u64,
    },
    /// An image with no pixels, or too many of them.
    #[error(
        "{what} is {width} x {height} pixels; expected at least 1 x 1 and at most {} pixels in all",
        MAX_PIXELS
    )]
    BadSize {
        /// The image or file.
        what: String,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
}

/// The most pixels that a file may declare: 16,384 x 16,384. A damaged header must not be able to
/// ask for all memory.
pub const MAX_PIXELS: usize = 1 << 28;

/// What a decoder met, its names of PNG's parts as the format has them.
fn in_words(detail: &str) -> String {
    const BEGIN: &str = "ChunkType { type: ";
    let mut text = String::new();
    let mut rest = detail;
    let mut parts = Vec::new();
    while let Some((before, after)) = rest.split_once(BEGIN) {
        // `IDAT, critical: true, … }`; a type that is no text is quoted.
        let end = after.find(',').unwrap_or(after.len());
        parts.push(&after[..end]);
        text = text + before + &after[..end];
        rest = after.find('}').map_or("", |end| &after[end + 1..]);
    }
    text += rest;
    match parts.as_slice() {
        [part] if detail.contains("CRC error") => {
            format!("a part of it ({part}) has a wrong checksum")
        }
        _ => text,
    }
}

fn quoted(path: &Option<PathBuf>) -> String {
    match path {
        Some(path) => format!("`{}`", path.display()),
        None => "the image".to_string(),
    }
}

pub(crate) fn listed(names: &[String]) -> String {
    if names.is_empty() {
        return "no channels".to_string();
    }
    let quoted: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
    quoted.join(", ")
}

impl ImagingError {
    /// Wraps an operating-system error, telling a missing file from the rest.
    pub(crate) fn io(action: &'static str, path: &Path, source: std::io::Error) -> Self {
        if action == "read" && source.kind() == std::io::ErrorKind::NotFound {
            return Self::NotFound {
                path: path.to_owned(),
            };
        }
        Self::Io {
            action,
            path: path.to_owned(),
            source,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_decoder_met_is_said_in_words() {
        let kind = "ChunkType { type: IDAT, critical: true, private: false, reserved: false, safecopy: false }";
        let crc = format!(
            "Format error decoding Png: CRC error: expected 0x1 have 0x2 while decoding {kind} chunk."
        );
        assert_eq!(in_words(&crc), "a part of it (IDAT) has a wrong checksum");
        let order = format!("Chunk {kind} must appear at most once.");
        assert_eq!(in_words(&order), "Chunk IDAT must appear at most once.");
        assert_eq!(in_words("unexpected end of file"), "unexpected end of file");
    }
}
