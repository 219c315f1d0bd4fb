//! What a JPEG file's markers say before it is decoded: the decoder fills in missing data without
//! an error, converts ink to light by a rule of its own, and panics on some layouts.
use crate::error::ImagingError;
use crate::format;
use std::path::Path;

/// The brightness of 8 x 8 pixels takes a bit at least: a file that declares more is cut off or made to waste time.
const MOST_PIXELS_A_BYTE: usize = 8 * 64;

/// Errors on files that end before their end-of-image marker, on CMYK, on other than 8 bits, on codings of
/// specialists, on more pixels than their bytes can hold, and on layouts that cannot be decoded. Returns where the picture
/// ends in the file.
pub(crate) fn check(bytes: &[u8], path: &Path) -> Result<usize, ImagingError> {
    let damaged = |detail: &str| ImagingError::Damaged {
        path: path.to_owned(),
        format: "JPEG",
        detail: detail.to_string(),
    };
    let unsupported = |what: String| ImagingError::Unsupported {
        path: path.to_owned(),
        what,
        remedy: "save it as 8-bit RGB".into(),
    };
    let mut at = 2;
    loop {
        // Between segments there may be entropy-coded data or fill bytes: go to the next marker.
        while at + 1 < bytes.len() && !is_marker(bytes[at], bytes[at + 1]) {
            at += 1;
        }
        let Some(&marker) = bytes.get(at + 1) else {
            return Err(damaged("no end-of-image marker"));
        };
        if marker == 0xd9 {
            return Ok(at + 2);
        }
        let Some(&[high, low]) = bytes.get(at + 2..at + 4).and_then(|s| s.first_chunk()) else {
            return Err(damaged("a segment has no length"));
        };
        // Start of frame, all codings; C4, C8 and CC are other tables.
        if matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc) {
            if let Some(coding) = other_coding(marker) {
                return Err(ImagingError::Unsupported {
                    path: path.to_owned(),
                    what: format!("is a JPEG with {coding}"),
                    remedy: format::conversion("magick", "", path).into(),
                });
            }
            let (Some(&bits), Some(&components)) = (bytes.get(at + 4), bytes.get(at + 9)) else {
                return Err(damaged("the frame header is cut off"));
            };
            match (bits, components) {
                (_, 4) => {
                    return Err(ImagingError::Unsupported {
                        path: path.to_owned(),
                        what: "is a CMYK JPEG".to_string(),
                        remedy: format::conversion("magick", "-colorspace sRGB ", path).into(),
                    });
                }
                (8, _) => {}
                _ => return Err(unsupported(format!("is a {bits}-bit JPEG"))),
            }
            let Some(layout) = bytes.get(at + 10..at + 10 + 3 * usize::from(components)) else {
                return Err(damaged("the frame header is cut off"));
            };
            let size =
                |from: usize| usize::from(u16::from_be_bytes([bytes[from], bytes[from + 1]]));
            let (height, width) = (size(at + 5), size(at + 7));
            if width * height > bytes.len().saturating_mul(MOST_PIXELS_A_BYTE) {
                return Err(damaged(&format!(
                    "it declares {width} x {height} pixels and has {} bytes",
                    bytes.len()
                )));
            }
            if !has_finest_first(layout) {
                let what = "is a JPEG whose colour is sampled more finely than its brightness";
                return Err(unsupported(what.to_string()));
            }
        }
        at += 2 + usize::from(u16::from_be_bytes([high, low])).max(2);
    }
}

/// What the decoder cannot read of a frame with this marker: it reads sequential and progressive frames of Huffman codes
/// [ITU-T T.81, table B.1].
fn other_coding(marker: u8) -> Option<&'static str> {
    match marker {
        0xc0..=0xc2 => None,
        0xc3 => Some("lossless coding"),
        0xc5..=0xc7 => Some("hierarchical coding"),
        _ => Some("arithmetic coding"),
    }
}

/// Whether every component of a frame (identifier, factors of sampling, table) has a whole fraction of the samples of the
/// first: the decoder panics on others.
fn has_finest_first(layout: &[u8]) -> bool {
    let factors = |component: &[u8]| (component[1] >> 4, component[1] & 15);
    let mut all = layout.chunks_exact(3).map(factors);
    let Some((across, down)) = all.next() else {
        return true;
    };
    let divides = |part: u8, whole: u8| part > 0 && whole.is_multiple_of(part);
    divides(across, across)
        && divides(down, down)
        && all.all(|(x, y)| divides(x, across) && divides(y, down))
}

/// Whether two bytes start a segment. 0xff00 is a stuffed data byte, 0xffff fill, and 0xffd0 to
/// 0xffd7 are restart markers inside the data.
fn is_marker(first: u8, second: u8) -> bool {
    first == 0xff && !matches!(second, 0x00 | 0xff | 0xd0..=0xd7)
}
