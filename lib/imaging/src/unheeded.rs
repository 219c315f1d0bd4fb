//! What a PNG or JPEG says of how it is to be shown and what is only told: pixels that are not square, and a turn that
//! stands in XMP alone.
use crate::{format::Format, png_colours::chunks};
use std::path::Path;

/// Densities differ unless they are the same but for this share: a pixel in a thousand.
const SQUARE_TOLERANCE: f64 = 1e-3;

/// The densities of pixels across and down, and what names them, if they differ.
pub(crate) fn densities(bytes: &[u8], format: Format) -> Option<(&'static str, [u32; 2])> {
    let (name, densities) = match format {
        Format::Png => ("pHYs", physical(bytes)?),
        Format::Jpeg => ("JFIF", jfif(bytes)?),
        _ => return None,
    };
    let [across, down] = densities.map(f64::from);
    let differ = (across - down).abs() > SQUARE_TOLERANCE * across.max(down);
    // 0 is no density.
    (across.min(down) > 0.0 && differ).then_some((name, densities))
}

/// Pixels a unit of a PNG [PNG, third edition, 11.3.4.3].
fn physical(bytes: &[u8]) -> Option<[u32; 2]> {
    let (_, data) = chunks(bytes).find(|(kind, _)| kind == b"pHYs")?;
    let word = |at: usize| Some(u32::from_be_bytes(*data.get(at..)?.first_chunk()?));
    Some([word(0)?, word(4)?])
}

/// Densities of a JPEG, in the segment that comes first [ITU-T T.871, 10.1].
fn jfif(bytes: &[u8]) -> Option<[u32; 2]> {
    let segment = bytes.strip_prefix(&[0xff, 0xd8, 0xff, 0xe0])?;
    let data = segment.get(2..)?.strip_prefix(b"JFIF\0")?;
    let word = |at: usize| Some(u16::from_be_bytes(*data.get(at..)?.first_chunk()?));
    // Version and unit go before.
    Some([word(3)?, word(5)?].map(u32::from))
}

/// The turn that XMP names, 2 to 8.
pub(crate) fn turn_in_xmp(xmp: &[u8]) -> Option<u8> {
    const NAME: &[u8] = b"tiff:Orientation";
    let at = xmp.windows(NAME.len()).position(|w| w == NAME)?;
    // `="6"`, or `>6<`.
    let rest = xmp[at + NAME.len()..].trim_ascii_start();
    let rest = match rest.split_first()? {
        (b'>', rest) => rest.trim_ascii_start(),
        (b'=', rest) => rest.trim_ascii_start().get(1..)?,
        _ => return None,
    };
    let turn = rest.first()?.wrapping_sub(b'0');
    (2..=8).contains(&turn).then_some(turn)
}

/// A warning about pixels that are not square.
pub(crate) fn not_square((name, [across, down]): (&str, [u32; 2]), path: &Path) -> String {
    format!(
        "`{}`: its {name} says that its pixels are not square ({across} a unit across, {down} down); they are taken as square: \
         scale it to square pixels if it looks stretched",
        path.display()
    )
}

/// A warning about a turn that only XMP names.
pub(crate) fn turned(turn: u8, path: &Path) -> String {
    format!(
        "`{}`: its XMP says that it is to be turned (tiff:Orientation {turn}), and its Exif data do not; it is read as it is \
         stored: turn it and save it if it lies on its side",
        path.display()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn xmp_names_a_turn_as_an_attribute_or_an_element() {
        for (text, turn) in [
            ("<rdf:Description tiff:Orientation=\"6\">", Some(6)),
            ("tiff:Orientation = '3'", Some(3)),
            ("<tiff:Orientation>8</tiff:Orientation>", Some(8)),
            ("tiff:Orientation=\"1\"", None),
            ("tiff:Orientation=\"", None),
            ("tiff:Orientation", None),
            ("tiff:Make=\"6\"", None),
        ] {
            assert_eq!(turn_in_xmp(text.as_bytes()), turn, "{text}");
        }
    }
}
