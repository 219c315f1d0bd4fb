//! PNG files that say who made them, and replace only those that this program made.
use std::io;
use std::path::Path;

use crate::raster::DisplayImage;
use png::{BitDepth, ColorType, Compression, Encoder};

/// What a PNG is for. One kind does not replace another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A preview of a project.
    Preview,
    /// A picture of something that was inspected.
    View,
    /// A photograph that was cut out of a panorama.
    Photograph,
    /// A mask that was painted.
    Mask,
    /// Spheres under two lights, side by side.
    Comparison,
}

impl Kind {
    const ALL: [Self; 5] = [
        Self::Preview,
        Self::View,
        Self::Photograph,
        Self::Mask,
        Self::Comparison,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Preview => "preview",
            Self::View => "view",
            Self::Photograph => "photograph",
            Self::Mask => "mask",
            Self::Comparison => "comparison",
        }
    }
}

/// Keyword of the text of a PNG that this program made.
const KEYWORD: &str = "Software";
/// The text, before the kind. Earlier versions wrote it alone, whatever the kind.
const MADE_BY: &str = "dipir";

/// The text with its kind, or that of an earlier version.
fn made_by(kind: Option<Kind>) -> String {
    match kind {
        Some(kind) => format!("{MADE_BY} {}", kind.name()),
        None => MADE_BY.into(),
    }
}

/// How every PNG begins.
const SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";
/// The mark lies within so many bytes: signature, header, text.
const BEGINNING: usize = 80;

/// `pixels` of `bytes_per_pixel` 1 (grey) or 3 (RGB) as a PNG that is marked as of this kind.
pub fn encode(kind: Kind, width: usize, height: usize, pixels: &[u8]) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, width as u32, height as u32);
    encoder.set_color(match pixels.len() == width * height {
        true => ColorType::Grayscale,
        false => ColorType::Rgb,
    });
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Fast);
    let failed = |e: png::EncodingError| io::Error::other(e.to_string());
    encoder
        .add_text_chunk(KEYWORD.into(), made_by(Some(kind)))
        .map_err(failed)?;
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(pixels).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(bytes)
}

/// The columns `x0..x1` and rows `y0..y1` of `picture` with 8 bits a channel, row by row.
pub fn values(picture: &DisplayImage, [x0, y0, x1, y1]: [usize; 4]) -> Vec<u8> {
    let rows = (y0..y1).flat_map(|y| &picture.0.row(y)[x0..x1]);
    rows.flat_map(|p| {
        p.to_array()
            .map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8)
    })
    .collect()
}

/// What the name of a file is taken by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Taken {
    /// Nothing, or a PNG of the kind that is asked for.
    Free,
    /// A PNG of another kind.
    ByKind(Kind),
    /// A file of somebody else.
    ByOther,
}

fn taken(path: &Path, kind: Kind) -> io::Result<Taken> {
    let Some(found) = dipir_files::beginning(path, BEGINNING)? else {
        return Ok(Taken::Free);
    };
    // With its length, so that no text is the beginning of another.
    let holds = |kind: Option<Kind>| {
        let text = [KEYWORD, "\0", &made_by(kind)].concat();
        let chunk = [
            &(text.len() as u32).to_be_bytes(),
            &b"tEXt"[..],
            text.as_bytes(),
        ]
        .concat();
        found.starts_with(SIGNATURE) && found.windows(chunk.len()).any(|w| w == chunk)
    };
    if holds(Some(kind)) || holds(None) {
        return Ok(Taken::Free);
    }
    let other = Kind::ALL.into_iter().find(|kind| holds(Some(*kind)));
    Ok(other.map_or(Taken::ByOther, Taken::ByKind))
}

/// Whether `path` may be written: nothing is there, or a PNG of this kind that this program made, or that an earlier version
/// made, which did not tell kinds apart.
///
/// # Errors
/// Those of the system; what is no regular file is one.
pub fn is_free(path: &Path, kind: Kind) -> io::Result<bool> {
    Ok(taken(path, kind)? == Taken::Free)
}

/// Writes `picture`, as [`write`].
///
/// # Errors
/// As [`write`].
pub fn write_display(path: &Path, picture: &DisplayImage, kind: Kind) -> io::Result<()> {
    let (width, height) = (picture.0.width(), picture.0.height());
    let values = values(picture, [0, 0, width, height]);
    write(path, &encode(kind, width, height, &values)?, kind)
}

/// Writes what [`encode`] made of this kind. A file that this program did not make, or made for something else, is not
/// touched.
///
/// # Errors
/// Those of the system, and [`io::ErrorKind::AlreadyExists`] if such a file is there.
pub fn write(path: &Path, png: &[u8], kind: Kind) -> io::Result<()> {
    let message = match taken(path, kind)? {
        Taken::Free => return dipir_files::replace(path, png, SIGNATURE),
        Taken::ByKind(other) => format!(
            "is there already, a {} that dipir made; name another file",
            other.name()
        ),
        Taken::ByOther => "is there already and dipir did not make it; name another file".into(),
    };
    Err(io::Error::new(io::ErrorKind::AlreadyExists, message))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Row of grey pixels.
    fn grey(kind: Kind, pixels: &[u8]) -> Vec<u8> {
        encode(kind, pixels.len(), 1, pixels).unwrap()
    }

    #[test]
    fn only_pictures_of_the_same_kind_that_were_made_here_are_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("preview.png");
        let png = grey(Kind::Preview, &[0, 255]);
        write(&path, &png, Kind::Preview).unwrap();
        write(
            &path,
            &encode(Kind::Preview, 4, 3, &[7; 36]).unwrap(),
            Kind::Preview,
        )
        .unwrap();
        let unmarked = |text: Option<&str>| {
            let mut other = Vec::new();
            let mut encoder = Encoder::new(&mut other, 1, 1);
            if let Some(text) = text {
                encoder.add_text_chunk(KEYWORD.into(), text.into()).unwrap();
            }
            let mut writer = encoder.write_header().unwrap();
            writer.write_image_data(&[9]).unwrap();
            writer.finish().unwrap();
            other
        };
        for (other, told) in [
            (unmarked(None), "dipir did not make it"),
            (unmarked(Some("dipirate")), "dipir did not make it"),
            (grey(Kind::Photograph, &[9]), "a photograph that dipir made"),
        ] {
            std::fs::write(&path, &other).unwrap();
            let error = write(&path, &png, Kind::Preview).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::AlreadyExists);
            assert!(error.to_string().contains(told), "{error}");
            assert_eq!(std::fs::read(&path).unwrap(), other);
        }
        // Earlier versions did not tell kinds apart.
        std::fs::write(&path, unmarked(Some("dipir"))).unwrap();
        for kind in Kind::ALL {
            assert!(is_free(&path, kind).unwrap(), "{kind:?}");
        }
    }
}
