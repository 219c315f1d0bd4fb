//! Which image format a file holds, by its first bytes: names lie, contents do not.
use crate::error::ImagingError;
use std::path::Path;

/// What the first bytes of a file say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    Png,
    Jpeg,
    Exr,
    Hdr,
    /// Recognised or not, but not read here; as an error message names it.
    Other(&'static str),
}

impl Format {
    /// Bytes that suffice to tell.
    pub const SNIFF_LENGTH: usize = 12;

    pub fn of(bytes: &[u8]) -> Self {
        let starts = |magic: &[u8]| bytes.starts_with(magic);
        if starts(b"\x89PNG\r\n\x1a\n") {
            Self::Png
        } else if starts(&[0xff, 0xd8, 0xff]) {
            Self::Jpeg
        } else if starts(&[0x76, 0x2f, 0x31, 0x01]) {
            Self::Exr
        } else if starts(b"#?") {
            Self::Hdr
        } else if starts(b"GIF8") {
            Self::Other("a GIF image")
        } else if starts(b"BM") {
            Self::Other("a BMP image")
        } else if starts(b"II*\0") || starts(b"MM\0*") {
            Self::Other("a TIFF image")
        } else if starts(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
            Self::Other("a WebP image")
        } else if bytes.get(4..8) == Some(b"ftyp") {
            Self::Other("a HEIF or AVIF image")
        } else if starts(b"\xabKTX") {
            Self::Other("a KTX texture")
        } else if starts(b"DDS ") {
            Self::Other("a DDS texture")
        } else {
            Self::Other("not an image of a known format")
        }
    }

    /// The bare name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Png => "PNG",
            Self::Jpeg => "JPEG",
            Self::Exr => "OpenEXR",
            Self::Hdr => "Radiance HDR",
            Self::Other(name) => name,
        }
    }

    /// As the sentence "`x` is ..." goes on.
    fn described(self) -> &'static str {
        match self {
            Self::Png => "a PNG image (display-referred)",
            Self::Jpeg => "a JPEG image (display-referred)",
            Self::Exr => "an OpenEXR image",
            Self::Hdr => "a Radiance HDR image",
            Self::Other(name) => name,
        }
    }

    /// The error for a file of this format where `expected` is wanted.
    pub fn refuse(self, path: &Path, expected: &'static str) -> ImagingError {
        ImagingError::WrongFormat {
            path: path.to_owned(),
            found: self.described(),
            expected,
        }
    }
}
