//! PNG files that say who made them, and replace only those that this program made.
use std::io;
use std::path::Path;

use crate::raster::DisplayImage;
use png::{BitDepth, ColorType, Compression, Encoder};

/// The text of a PNG that this program made.
const MADE_BY: (&str, &str) = ("Software", "dipir");
/// How every PNG begins.
const SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";
/// The mark lies within so many bytes: signature, header, text.
const BEGINNING: usize = 64;

/// `pixels` of `bytes_per_pixel` 1 (grey) or 3 (RGB) as a marked PNG.
pub fn encode(width: usize, height: usize, pixels: &[u8]) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, width as u32, height as u32);
    encoder.set_color(match pixels.len() == width * height {
        true => ColorType::Grayscale,
        false => ColorType::Rgb,
    });
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Fast);
    let (key, text) = MADE_BY;
    let failed = |e: png::EncodingError| io::Error::other(e.to_string());
    encoder
        .add_text_chunk(key.into(), text.into())
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

/// Whether `path` may be written: nothing is there, or a PNG that this program made.
///
/// # Errors
/// Those of the system; what is no regular file is one.
pub fn is_free(path: &Path) -> io::Result<bool> {
    let Some(found) = dipir_files::beginning(path, BEGINNING)? else {
        return Ok(true);
    };
    let mark = [MADE_BY.0.as_bytes(), b"\0", MADE_BY.1.as_bytes()].concat();
    Ok(found.starts_with(SIGNATURE) && found.windows(mark.len()).any(|w| w == mark))
}

/// Writes `picture`, as [`write`].
///
/// # Errors
/// As [`write`].
pub fn write_display(path: &Path, picture: &DisplayImage) -> io::Result<()> {
    let (width, height) = (picture.0.width(), picture.0.height());
    let values = values(picture, [0, 0, width, height]);
    write(path, &encode(width, height, &values)?)
}

/// Writes what [`encode`] made. A file that this program did not make is not touched.
///
/// # Errors
/// Those of the system, and [`io::ErrorKind::AlreadyExists`] if another's file is there.
pub fn write(path: &Path, png: &[u8]) -> io::Result<()> {
    if !is_free(path)? {
        let message = "is there already and dipir did not make it; name another file";
        return Err(io::Error::new(io::ErrorKind::AlreadyExists, message));
    }
    dipir_files::replace(path, png, SIGNATURE)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_pictures_that_were_made_here_are_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("preview.png");
        let png = encode(2, 1, &[0, 255]).unwrap();
        write(&path, &png).unwrap();
        write(&path, &encode(4, 3, &[7; 36]).unwrap()).unwrap();
        let mut other = Vec::new();
        let encoder = Encoder::new(&mut other, 1, 1);
        let mut writer = encoder.write_header().unwrap();
        writer.write_image_data(&[9]).unwrap();
        writer.finish().unwrap();
        std::fs::write(&path, &other).unwrap();
        let error = write(&path, &png).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(std::fs::read(&path).unwrap(), other);
    }
}
