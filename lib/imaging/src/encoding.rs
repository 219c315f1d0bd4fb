//! What the values of a display file mean: a colour profile, or a curve that the user names.
//!
//! A profile of three curves and a matrix maps stored values to linear Rec.709: each value through
//! its curve, then the matrix. Colours that Rec.709 cannot show come out below 0 or above 1, and go
//! back to the values that they had.
use crate::{primaries::Primaries, raster::LinearImage, transfer::Transfer};
use glam::{DMat3, DVec3, Mat3, Vec3};
use moxcms::{ColorDateTime, ColorProfile, DataColorSpace, ToneReprCurve};
use png::{ScaledFloat, SourceChromaticities};
use rayon::prelude::*;

/// How the values of a photograph were encoded, and how a picture that looks like it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Encoding {
    curves: [Curve; 3],
    to_rec709: Mat3,
    from_rec709: Mat3,
    tag: Tag,
}

/// What a PNG says about its own colours.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Tag {
    Srgb,
    /// Exponent that encodes light, and primaries.
    Chunks(Option<ScaledFloat>, Option<SourceChromaticities>),
    /// An ICC profile for RGB.
    Profile(Vec<u8>),
}

/// One curve from display values to light, both in `[0, 1]`.
#[derive(Clone, Debug, PartialEq)]
enum Curve {
    Named(Transfer),
    /// A pure power.
    Power(f32),
    Profile(ToneReprCurve),
}

/// Steps of an 8-bit value at which a profile's curve is checked and compared.
const STEPS: u16 = 255;
/// A matrix this near to the identity and a curve this near to sRGB's are sRGB, as rounded by the
/// makers of profiles.
const SRGB_TOLERANCE: f64 = 2e-3;
/// How a PNG says sRGB's curve by an exponent, and how near to that one is it [PNG, 11.3.2.4].
const SRGB_GAMMA: f32 = 0.454_55;
const GAMMA_TOLERANCE: f32 = 1e-3;

impl Encoding {
    /// Rec.709 primaries and the curve `transfer`.
    pub fn named(transfer: Transfer) -> Self {
        Self {
            curves: [0; 3].map(|_| Curve::Named(transfer)),
            to_rec709: Mat3::IDENTITY,
            from_rec709: Mat3::IDENTITY,
            tag: match transfer {
                Transfer::Srgb => Tag::Srgb,
                Transfer::Gamma22 => Tag::Chunks(Some(ScaledFloat::new(1.0 / 2.2)), None),
                Transfer::Linear => Tag::Chunks(Some(ScaledFloat::new(1.0)), None),
            },
        }
    }

    /// Rec.709 primaries and a pure power, of which a PNG's `gAMA` is the exponent that encodes
    /// light; `None` for that of sRGB.
    ///
    /// # Errors
    /// Why it cannot be used, as a clause.
    pub(crate) fn of_gamma(gamma: ScaledFloat) -> Result<Option<Self>, String> {
        let exponent = gamma.into_value();
        if !(0.1..=10.0).contains(&exponent) {
            return Err(format!("is {exponent}, not 0.1 to 10"));
        }
        let near = |other: f32| (exponent / other - 1.0).abs() <= GAMMA_TOLERANCE;
        if near(SRGB_GAMMA) {
            return Ok(None);
        }
        let curve = match near(1.0) {
            true => Curve::Named(Transfer::Linear),
            false => Curve::Power(1.0 / exponent),
        };
        Ok(Some(Self {
            curves: [0; 3].map(|_| curve.clone()),
            tag: Tag::Chunks(Some(gamma), None),
            ..Self::named(Transfer::Linear)
        }))
    }

    /// The curve of `of_gamma`, or sRGB's, with a PNG's `chromaticities` and its `gamma`, if that can be used.
    ///
    /// # Errors
    /// Why they describe no colours, as a clause.
    pub(crate) fn with_primaries(
        of_gamma: Option<Self>,
        gamma: Option<ScaledFloat>,
        chromaticities: SourceChromaticities,
    ) -> Result<Self, &'static str> {
        let to_rec709 = Primaries::of_png(&chromaticities).to_rec709()?;
        let to_rec709 = to_rec709.unwrap_or(Mat3::IDENTITY);
        Ok(Self {
            to_rec709,
            from_rec709: to_rec709.as_dmat3().inverse().as_mat3(),
            tag: Tag::Chunks(gamma, Some(chromaticities)),
            ..of_gamma.unwrap_or_else(|| Self::named(Transfer::Srgb))
        })
    }

    /// The encoding that an ICC profile describes for an image of `channels` colours (1 or 3).
    /// Profiles of RGB with a matrix and curves, and of grey with a curve, are understood.
    ///
    /// # Errors
    /// Why the profile cannot be used, as a clause.
    pub fn of_profile(icc: &[u8], channels: usize) -> Result<Self, String> {
        let profile = ColorProfile::new_from_slice(icc).map_err(|e| format!("is damaged: {e}"))?;
        if profile.pcs != DataColorSpace::Xyz {
            return Err("is a table of colours, not a matrix with curves".into());
        }
        match (profile.color_space, channels) {
            (DataColorSpace::Rgb, 3) => Self::of_rgb(&profile, icc),
            (DataColorSpace::Gray, 1) => Self::of_grey(&profile),
            (space, _) => Err(format!("is for {space:?}, and the image is not")),
        }
    }

    fn of_rgb(profile: &ColorProfile, icc: &[u8]) -> Result<Self, String> {
        let (Some(r), Some(g), Some(b)) = (&profile.red_trc, &profile.green_trc, &profile.blue_trc)
        else {
            return Err("is a table of colours, not a matrix with curves".into());
        };
        let curves = [r, g, b].map(|c| Curve::Profile(c.clone()));
        for curve in &curves {
            curve.check()?;
        }
        let matrix = primaries(&ColorProfile::new_srgb()).inverse() * primaries(profile);
        if !matrix.is_finite() || matrix.determinant().abs() < 1e-6 {
            return Err("has no matrix of its primaries".into());
        }
        // The file's white is white here: profiles round it, and grey must not get a tint.
        let white = matrix * DVec3::ONE;
        if white.min_element() <= 0.0 {
            return Err("has primaries that make no white".into());
        }
        let matrix = DMat3::from_diagonal(white.recip()) * matrix;
        let off = (matrix - DMat3::IDENTITY).to_cols_array();
        let same_primaries = off.iter().all(|v| v.abs() < SRGB_TOLERANCE);
        let mut encoding = Self::named(Transfer::Srgb);
        if !(same_primaries && curves.iter().all(Curve::is_srgb)) {
            encoding.curves = curves;
            encoding.to_rec709 = matrix.as_mat3();
            encoding.from_rec709 = matrix.inverse().as_mat3();
        }
        encoding.tag = Tag::Profile(icc.to_vec());
        Ok(encoding)
    }

    /// Results have colour, and a grey profile is only for grey: they get one of Rec.709 primaries
    /// with its curve.
    fn of_grey(profile: &ColorProfile) -> Result<Self, String> {
        let Some(curve) = &profile.gray_trc else {
            return Err("has no curve".into());
        };
        let own = Curve::Profile(curve.clone());
        own.check()?;
        let mut encoding = Self::named(Transfer::Srgb);
        if own.is_srgb() {
            return Ok(encoding);
        }
        let mut rgb = ColorProfile::new_srgb();
        rgb.red_trc = Some(curve.clone());
        rgb.green_trc = Some(curve.clone());
        rgb.blue_trc = Some(curve.clone());
        rgb.cicp = None;
        rgb.description = None;
        // Not the time of the run: the same inputs give the same bytes.
        rgb.creation_date_time = ColorDateTime {
            year: 2000,
            month: 1,
            day_of_the_month: 1,
            hours: 0,
            minutes: 0,
            seconds: 0,
        };
        let icc = rgb.encode().map_err(|e| format!("cannot be kept: {e}"))?;
        encoding.curves = [0; 3].map(|_| own.clone());
        encoding.tag = Tag::Profile(icc);
        Ok(encoding)
    }

    /// The values of a file with an encoding of its own, read with a curve that the user names: the
    /// result still carries the file's profile or gamma, so that it is shown as the file is.
    pub(crate) fn overruled(transfer: Transfer, of_file: Option<Self>) -> Self {
        let named = Self::named(transfer);
        match of_file {
            Some(of_file) => Self {
                tag: of_file.tag,
                ..named
            },
            None => named,
        }
    }

    pub(crate) fn tag(&self) -> &Tag {
        &self.tag
    }

    /// Light of every sample value `0..=max`, for each colour.
    pub(crate) fn tables(&self, max: u16) -> [Vec<f32>; 3] {
        let [r, g, b] = &self.curves;
        let first = r.table(max);
        let other = |curve: &Curve| match curve == r {
            true => first.clone(),
            false => curve.table(max),
        };
        let (second, third) = (other(g), other(b));
        [first, second, third]
    }

    /// Light behind the curves to linear Rec.709.
    #[inline]
    pub(crate) fn to_rec709(&self, light: Vec3) -> Vec3 {
        self.to_rec709 * light
    }

    /// Linear Rec.709 as 8-bit values, row by row: those nearest on the display scale. What the
    /// encoding cannot hold is clipped; NaN becomes 0.
    pub fn encode_8(&self, image: &LinearImage) -> Vec<[u8; 3]> {
        let coders = self.coders();
        let pixels = image.0.pixels().par_iter();
        pixels
            .map(|&p| {
                let light = (self.from_rec709 * p).to_array();
                std::array::from_fn(|k| coders[k].code(light[k]))
            })
            .collect()
    }

    fn coders(&self) -> [Coder; 3] {
        [0, 1, 2].map(|k| {
            let halves = self.curves[k].table(2 * STEPS);
            let between = halves.windows(3).step_by(2).map(|w| {
                // A curve in 16-bit steps may be flat near black: the middle stays off both ends.
                let margin = 0.125 * (w[2] - w[0]);
                w[1].clamp(w[0] + margin, w[2] - margin)
            });
            Coder {
                middles: between.collect(),
            }
        })
    }
}

/// Light to an 8-bit value.
struct Coder {
    /// Light half-way, on the display scale, between each value and the next; rising.
    middles: Vec<f32>,
}

impl Coder {
    fn code(&self, light: f32) -> u8 {
        self.middles.partition_point(|&middle| middle <= light) as u8
    }
}

impl Curve {
    /// Light of every value `0..=max`.
    fn table(&self, max: u16) -> Vec<f32> {
        let unit = (0..=max).map(|v| f32::from(v) / f32::from(max));
        match self {
            Self::Named(transfer) => unit.map(|v| transfer.decode_scalar(v)).collect(),
            Self::Power(exponent) => unit.map(|v| v.powf(*exponent)).collect(),
            Self::Profile(curve) => match curve.make_linear_evaluator() {
                Ok(curve) => unit
                    .map(|v| curve.evaluate_value(v).clamp(0.0, 1.0))
                    .collect(),
                // `check` has refused such a curve.
                Err(_) => unit.collect(),
            },
        }
    }

    /// Errors on a curve that does not rise from dark to bright.
    fn check(&self) -> Result<(), String> {
        if let Self::Profile(curve) = self {
            curve
                .make_linear_evaluator()
                .map_err(|e| format!("has a curve that cannot be used: {e}"))?;
        }
        let table = self.table(STEPS);
        let rises = table.windows(2).all(|w| w[0] <= w[1]);
        if rises && table[usize::from(STEPS)] > table[0] {
            return Ok(());
        }
        Err("has a curve that does not rise".into())
    }

    fn is_srgb(&self) -> bool {
        let srgb = Self::Named(Transfer::Srgb).table(STEPS);
        let own = self.table(STEPS);
        let mut pairs = own.iter().zip(&srgb);
        pairs.all(|(a, b)| f64::from((a - b).abs()) < 0.5 * SRGB_TOLERANCE)
    }
}

/// Columns: the primaries in the profile connection space.
fn primaries(profile: &ColorProfile) -> DMat3 {
    let colorants = [
        profile.red_colorant,
        profile.green_colorant,
        profile.blue_colorant,
    ];
    let [r, g, b] = colorants.map(|c| DVec3::new(c.x, c.y, c.z));
    DMat3::from_cols(r, g, b)
}
