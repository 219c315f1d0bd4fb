//! What a PNG says of its colours beside a profile: its chunks `cICP`, `sRGB`, `gAMA` and `cHRM`.
use crate::{encoding::Encoding, primaries::Primaries};
use png::{ScaledFloat, SourceChromaticities};

/// The chunks of a PNG that tell its colours [PNG, third edition, 11.3.2].
#[derive(Clone, Default)]
pub(crate) struct PngColours {
    code_points: Option<[u8; 4]>,
    srgb: bool,
    gamma: Option<ScaledFloat>,
    chromaticities: Option<SourceChromaticities>,
}

/// sRGB as `cICP` says it: primaries, curve, matrix (none), full range.
const SRGB_CODE_POINTS: [u8; 4] = [1, 13, 0, 1];
/// Chromaticities this near to sRGB's are sRGB's, as rounded by the writers of files.
const SRGB_TOLERANCE: f64 = 1e-3;

impl PngColours {
    /// Of the bytes of a PNG file. A chunk of a wrong length is as good as none.
    pub fn of(bytes: &[u8]) -> Self {
        let mut found = Self::default();
        for (kind, data) in chunks(bytes) {
            match &kind {
                b"cICP" => found.code_points = data.try_into().ok(),
                b"sRGB" => found.srgb = true,
                b"gAMA" => {
                    let scaled = data.try_into().map(u32::from_be_bytes);
                    found.gamma = scaled.ok().map(ScaledFloat::from_scaled);
                }
                b"cHRM" if data.len() == 32 => {
                    let at = |k: usize| {
                        let word = data[4 * k..].first_chunk().copied().unwrap_or_default();
                        ScaledFloat::from_scaled(u32::from_be_bytes(word))
                    };
                    found.chromaticities = Some(SourceChromaticities {
                        white: (at(0), at(1)),
                        red: (at(2), at(3)),
                        green: (at(4), at(5)),
                        blue: (at(6), at(7)),
                    });
                }
                _ => {}
            }
        }
        found
    }

    /// The encoding, if it is not sRGB, for an image of `channels` colours (1 or 3). What cannot be
    /// used goes to `unused`, as a clause; `assumed` is what stands in for it.
    pub fn encoding(
        &self,
        channels: usize,
        assumed: &str,
        unused: &mut Vec<String>,
    ) -> Option<Encoding> {
        if let Some(points) = self.code_points {
            if points != SRGB_CODE_POINTS {
                let [primaries, curve, matrix, range] = points;
                unused.push(format!(
                    "colour space (cICP {primaries}, {curve}, {matrix}, {range}) cannot be used; it is read as {assumed}"
                ));
            }
            return None;
        }
        if self.srgb {
            return None;
        }
        let mut gamma = self.gamma;
        let of_gamma = gamma.map(Encoding::of_gamma).transpose();
        let of_gamma = of_gamma.unwrap_or_else(|why| {
            unused.push(format!("gamma (gAMA) {why}; it is read as {assumed}"));
            gamma = None;
            None
        });
        let of_gamma = of_gamma.flatten();
        // Grey has no primaries.
        let own = self.chromaticities.filter(|_| channels == 3);
        match own.filter(|c| !Primaries::of_png(c).are_rec709(SRGB_TOLERANCE)) {
            None => of_gamma,
            Some(own) => match Encoding::with_primaries(of_gamma.clone(), gamma, own) {
                Ok(encoding) => Some(encoding),
                Err(why) => {
                    unused.push(format!("primaries (cHRM) {why}; it is read with sRGB's"));
                    of_gamma
                }
            },
        }
    }
}

/// The chunks before the pixels: name and contents.
pub(crate) fn chunks(bytes: &[u8]) -> impl Iterator<Item = ([u8; 4], &[u8])> {
    let mut rest = bytes.get(8..).unwrap_or_default();
    let next = move || {
        let (length, tail) = rest.split_first_chunk()?;
        let (kind, tail) = tail.split_first_chunk()?;
        let (data, tail) = tail.split_at_checked(u32::from_be_bytes(*length) as usize)?;
        // A sum follows, which the decoder checks.
        rest = tail.get(4..)?;
        Some((*kind, data))
    };
    std::iter::from_fn(next).take_while(|(kind, _)| kind != b"IDAT")
}
