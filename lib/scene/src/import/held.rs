//! BMP and Targa images whose headers state more pixels than the files hold: memory is taken by the header.
use std::io::Read;

use image::ImageFormat;

use crate::error::Error;
use crate::texture::ImageSource;

/// Most pixels in a byte of runs: BMP has up to 255 in two bytes, Targa 128. A BMP may skip pixels by fewer, but one that
/// does so throughout is empty.
const OF_RUNS: u64 = 128;
/// Bytes at the beginning that say how pixels are stored.
const HEAD: usize = 34;

/// Refuses a BMP or Targa image that cannot hold the pixels that its header states.
pub(super) fn check(image: &ImageSource) -> Result<(), Error> {
    let (head, bytes, is_targa) = match image {
        ImageSource::Bytes { bytes, .. } => (head(&bytes[..]), bytes.len() as u64, false),
        ImageSource::File(path) => {
            let opened =
                dipir_files::open(path).and_then(|file| Ok((file.metadata()?.len(), file)));
            // What cannot be opened is told where it is read.
            let Ok((bytes, file)) = opened else {
                return Ok(());
            };
            let extension = path.extension();
            let is_targa = extension.is_some_and(|e| e.eq_ignore_ascii_case("tga"));
            (head(file), bytes, is_targa)
        }
    };
    let word = |at: usize| u16::from_le_bytes([head[at], head[at + 1]]);
    let (bits, has_runs) = match image::guess_format(&head) {
        // The first version has a header of 12 bytes.
        Ok(ImageFormat::Bmp) if word(14) == 12 => (word(24), false),
        Ok(ImageFormat::Bmp) => (word(28), matches!(word(30), 1 | 2)),
        Err(_) if is_targa => (head[16].into(), head[2] & 8 != 0),
        _ => return Ok(()),
    };
    let most = match has_runs {
        true => bytes.saturating_mul(OF_RUNS),
        false => bytes.saturating_mul(8) / u64::from(bits.max(1)),
    };
    let pixels = image.pixels()?.unwrap_or(0);
    if pixels <= most {
        return Ok(());
    }
    let name = image.name();
    Err(Error::malformed(
        format!(
            "the texture {name} has {pixels} pixels by its header, and {bytes} bytes, which hold {most} at most"
        ),
        "copy it again, or export it as PNG or JPEG",
    ))
}

/// The beginning of a file, zeros behind its end.
fn head(file: impl Read) -> [u8; HEAD] {
    let mut head = Vec::new();
    // What cannot be read is told where all of it is.
    let _ = file.take(HEAD as u64).read_to_end(&mut head);
    std::array::from_fn(|k| head.get(k).copied().unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The beginning of a BMP, in its present or its first version.
    fn bmp(size: [u16; 2], bits: u8, compression: u8, is_first: bool) -> Vec<u8> {
        let [[w, v], [h, g]] = size.map(u16::to_le_bytes);
        let mut head = b"BM\0\0\0\0\0\0\0\0\x36\0\0\0".to_vec();
        match is_first {
            true => head.extend([12, 0, 0, 0, w, v, h, g, 1, 0, bits, 0]),
            false => head.extend([
                40,
                0,
                0,
                0,
                w,
                v,
                0,
                0,
                h,
                g,
                0,
                0,
                1,
                0,
                bits,
                0,
                compression,
            ]),
        }
        head
    }

    fn targa(size: [u16; 2], bits: u8, kind: u8) -> Vec<u8> {
        let [[w, v], [h, g]] = size.map(u16::to_le_bytes);
        vec![0, 0, kind, 0, 0, 0, 0, 0, 0, 0, 0, 0, w, v, h, g, bits, 0]
    }

    #[test]
    fn bmp_and_targa_images_hold_the_pixels_of_their_headers() {
        let folder = tempfile::tempdir().unwrap();
        let size = [800, 600];
        let pixels = 800 * 600;
        for (name, head, least) in [
            ("a.bmp", bmp(size, 24, 0, false), 3 * pixels),
            ("a.bmp", bmp(size, 24, 0, true), 3 * pixels),
            ("a.bmp", bmp(size, 1, 0, false), pixels / 8),
            ("a.bmp", bmp(size, 8, 1, false), pixels / 128),
            ("A.TGA", targa(size, 32, 2), 4 * pixels),
            ("A.TGA", targa(size, 32, 10), pixels / 128),
        ] {
            let path = folder.path().join(name);
            let mut bytes = head;
            bytes.resize(least, 0);
            std::fs::write(&path, &bytes).unwrap();
            let image = ImageSource::File(path.clone());
            assert_eq!(image.pixels().unwrap(), Some(pixels as u64), "{name}");
            assert!(check(&image).is_ok(), "{name} {least}");
            bytes.pop();
            std::fs::write(&path, &bytes).unwrap();
            let told = check(&image).unwrap_err().to_string();
            let want = format!("has 480000 pixels by its header, and {} bytes", least - 1);
            assert!(told.contains(&want) && told.contains(name), "{told}");
            let inside = ImageSource::Bytes {
                name: "inside".into(),
                bytes: bytes.into(),
            };
            // Without a name nothing says that it is a Targa image.
            assert_eq!(check(&inside).is_err(), name == "a.bmp");
        }
    }

    #[test]
    fn an_image_of_another_format_by_the_name_of_a_targa_holds_what_it_says() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("blank.tga");
        let blank = image::GrayImage::new(2000, 2000);
        blank.save_with_format(&path, ImageFormat::Png).unwrap();
        let bytes = std::fs::metadata(&path).unwrap().len();
        assert!(2000 * 2000 > bytes * OF_RUNS, "{bytes}");
        check(&ImageSource::File(path)).unwrap();
    }
}
