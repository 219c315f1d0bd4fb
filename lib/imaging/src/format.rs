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
    pub const SNIFF_LENGTH: usize = 16;

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
            Self::Other(GIF)
        } else if starts(b"BM") {
            Self::Other(BMP)
        } else if bytes.get(8..11) == Some(b"CR\x02")
            || starts(b"FUJIFILMCCD-RAW")
            || starts(b"IIU\0")
            || starts(b"IIRO")
            || starts(b"MMOR")
            || bytes.get(4..11) == Some(b"ftypcrx")
        {
            Self::Other(RAW)
        } else if [b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"]
            .iter()
            .any(|m| starts(*m))
        {
            Self::Other(TIFF)
        } else if starts(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
            Self::Other(WEBP)
        } else if let (Some(b"ftyp"), Some(brand)) = (bytes.get(4..8), bytes.get(8..12)) {
            Self::Other(of_brand(brand))
        } else if is_movie(bytes) {
            Self::Other(MOVIE)
        } else if starts(b"\xff\x0a") || starts(b"\0\0\0\x0cJXL ") {
            Self::Other(JPEG_XL)
        } else if starts(b"\0\0\0\x0cjP  ") || starts(b"\xff\x4f\xff\x51") {
            Self::Other(JPEG_2000)
        } else if is_netpbm(bytes) {
            Self::Other(NETPBM)
        } else if starts(b"8BPS") {
            Self::Other(PHOTOSHOP)
        } else if starts(b"qoif") {
            Self::Other(QOI)
        } else if starts(b"\xabKTX") {
            Self::Other("a KTX texture")
        } else if starts(b"DDS ") {
            Self::Other(DDS)
        } else {
            Self::Other(UNKNOWN)
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
        let extension = path.extension().unwrap_or_default().to_string_lossy();
        let raw = RAW_TIFFS.contains(&extension.to_ascii_lowercase().as_str());
        let found = match self {
            Self::Other(TIFF) if raw => RAW,
            // Its first bytes say nothing.
            Self::Other(UNKNOWN) if extension.eq_ignore_ascii_case("tga") => TARGA,
            other => other.described(),
        };
        ImagingError::WrongFormat {
            path: path.to_owned(),
            found,
            expected,
            remedy: remedy(found, path),
        }
    }
}

const GIF: &str = "a GIF image";
const BMP: &str = "a BMP image";
const WEBP: &str = "a WebP image";
const TIFF: &str = "a TIFF image";
const RAW: &str = "a camera's raw file";
const HEIF: &str = "a HEIF image";
const AVIF: &str = "an AVIF image";
const MOVIE: &str = "a movie";
const JPEG_XL: &str = "a JPEG XL image";
const JPEG_2000: &str = "a JPEG 2000 image";
const NETPBM: &str = "a Netpbm image";
const PHOTOSHOP: &str = "a Photoshop document";
const QOI: &str = "a QOI image";
const DDS: &str = "a DDS texture";
const TARGA: &str = "a Targa image";
const UNKNOWN: &str = "not an image of a known format";
/// Extensions of raw files that begin as TIFF files do.
const RAW_TIFFS: [&str; 7] = ["nef", "arw", "dng", "pef", "srw", "3fr", "nrw"];

/// What a file of boxes holds, by its brand. Brands of still pictures are few; those of movies are many, and cameras have
/// their own.
fn of_brand(brand: &[u8]) -> &'static str {
    match brand {
        b"avif" | b"avis" => AVIF,
        b"heic" | b"heix" | b"hevc" | b"hevx" | b"heim" | b"heis" | b"hevm" | b"hevs" | b"mif1"
        | b"mif2" | b"msf1" | b"miaf" | b"avci" | b"avcs" => HEIF,
        _ => MOVIE,
    }
}

/// Whether a file without a brand holds a movie: QuickTime of old cameras, AVI, Matroska and WebM, MXF.
fn is_movie(bytes: &[u8]) -> bool {
    let boxes =
        bytes.first() == Some(&0) && matches!(bytes.get(4..8), Some(b"moov" | b"mdat" | b"wide"));
    let avi = bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"AVI ");
    boxes || avi || bytes.starts_with(b"\x1aE\xdf\xa3") || bytes.starts_with(b"\x06\x0e+4")
}

/// Whether a file begins as PBM, PGM, PPM or PAM: a P, a digit, and a space, a line's end or a comment.
fn is_netpbm(bytes: &[u8]) -> bool {
    matches!(
        bytes,
        [b'P', b'1'..=b'7', b' ' | b'\t' | b'\r' | b'\n' | b'#', ..]
    )
}

/// How to convert, with the command of a usual converter.
fn remedy(found: &str, path: &Path) -> String {
    let tool = match found {
        HEIF => "heif-convert -q 95",
        AVIF => "avifdec",
        JPEG_XL => "djxl",
        RAW => "darktable-cli",
        // The first of its pictures is all layers as one.
        PHOTOSHOP => return conversion_of("magick", "[0]", "", path),
        GIF | BMP | WEBP | TIFF | JPEG_2000 | NETPBM | QOI | DDS | TARGA => "magick",
        MOVIE => {
            return format!(
                "write its frames, for instance with `mkdir frames && ffmpeg -i \"{}\" frames/%04d.png`, and give one of \
                 them, or all to `dipir shot frames/*.png`",
                path.display()
            );
        }
        _ => return "convert the file".into(),
    };
    conversion(tool, "", path)
}

/// How to make a PNG of the file with a command line, whose `options` stand between the two names.
pub(crate) fn conversion(tool: &str, options: &str, path: &Path) -> String {
    conversion_of(tool, "", options, path)
}

/// The same of a `part` of the file, as the converter writes it behind the name.
fn conversion_of(tool: &str, part: &str, options: &str, path: &Path) -> String {
    let mut to = path.with_extension("png");
    // What is there stays.
    if to == path {
        to = path.with_extension("converted.png");
    }
    format!(
        "convert it, for instance with `{tool} \"{}{part}\" {options}\"{}\"`",
        path.display(),
        to.display()
    )
}
