//! The primaries of light that a file names, and the way to Rec.709.
use crate::raster::LinearImage;
use exr::{math::Vec2, meta::attribute::Chromaticities};
use glam::{DMat3, DVec2, DVec3, Mat3, Vec3};
use png::{ScaledFloat, SourceChromaticities};
use rayon::prelude::*;

/// Chromaticities (CIE x, y) of red, green, blue and white.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Primaries([DVec2; 4]);

/// Rec.709 and sRGB, with the white D65.
pub(crate) const REC709: Primaries = Primaries([
    DVec2::new(0.64, 0.33),
    DVec2::new(0.30, 0.60),
    DVec2::new(0.15, 0.06),
    DVec2::new(0.3127, 0.3290),
]);

/// Primaries this near to Rec.709's are Rec.709's: nothing is converted.
const TOLERANCE: f64 = 1e-4;

impl Primaries {
    /// `x` and `y` of red, green, blue and white. `None` if all are 0: so Photoshop writes that it does not tell them.
    pub fn new(numbers: [f64; 8]) -> Option<Self> {
        let are_told = numbers.iter().any(|&n| n != 0.0);
        are_told.then(|| Self([0, 2, 4, 6].map(|k| DVec2::new(numbers[k], numbers[k + 1]))))
    }

    /// Those of an OpenEXR file.
    pub fn of_exr(attribute: &Chromaticities) -> Option<Self> {
        let Chromaticities {
            red: r,
            green: g,
            blue: b,
            white: w,
        } = attribute;
        Self::new([r.0, r.1, g.0, g.1, b.0, b.1, w.0, w.1].map(f64::from))
    }

    /// As an OpenEXR file names them.
    pub fn to_exr(self) -> Chromaticities {
        let [red, green, blue, white] = self.0.map(|c| Vec2(c.x as f32, c.y as f32));
        Chromaticities {
            red,
            green,
            blue,
            white,
        }
    }

    /// Of a PNG's `cHRM`.
    pub fn of_png(chunk: &SourceChromaticities) -> Self {
        let of = |(x, y): (ScaledFloat, ScaledFloat)| {
            // Hundred thousandths, exactly.
            DVec2::new(x.into_scaled().into(), y.into_scaled().into()) / 1e5
        };
        Self([chunk.red, chunk.green, chunk.blue, chunk.white].map(of))
    }

    /// As [`new`](Self::new), from the first eight words of a text. If they are not numbers, the
    /// primaries are NaN, which [`to_rec709`](Self::to_rec709) refuses.
    pub fn of_text(text: &str) -> Option<Self> {
        let words = text.split_whitespace().take(8);
        let numbers: Option<Vec<f64>> = words.map(|word| word.parse().ok()).collect();
        let eight = numbers.and_then(|n| n.try_into().ok());
        Self::new(eight.unwrap_or([f64::NAN; 8]))
    }

    /// CIE XYZ, and the values of its white, of luminance 1: that which `named` has, or D65 if there is none or it is
    /// the centre of XYZ, by which files name XYZ itself.
    pub fn of_xyz(named: Option<Self>) -> (Self, Vec3) {
        const CENTRE: DVec2 = DVec2::splat(1.0 / 3.0);
        let white = named.map_or(CENTRE, |own| own.0[3]);
        let white = match (white - CENTRE).abs().max_element() > TOLERANCE {
            true => white,
            false => REC709.0[3],
        };
        let values = DVec3::new(white.x, white.y, 1.0 - white.x - white.y) / white.y;
        // Where this is no white, `to_rec709` says so.
        let is_light = values.is_finite() && values.min_element() > 0.0;
        let values = if is_light { values } else { DVec3::ONE };
        let xyz = Self([DVec2::X, DVec2::Y, DVec2::ZERO, white]);
        (xyz, values.as_vec3())
    }

    /// Whether no chromaticity is further than `tolerance` from Rec.709's.
    pub fn are_rec709(&self, tolerance: f64) -> bool {
        let mut pairs = self.0.iter().zip(REC709.0);
        pairs.all(|(own, its)| (*own - its).abs().max_element() <= tolerance)
    }

    /// The matrix to linear Rec.709, with white on white; `None` if these are its primaries.
    ///
    /// # Errors
    /// Why these describe no colours, as a clause.
    pub fn to_rec709(self) -> Result<Option<Mat3>, &'static str> {
        if self.are_rec709(TOLERANCE) {
            return Ok(None);
        }
        let of_rec709 = REC709.to_adapted()?.inverse();
        Ok(Some((of_rec709 * self.to_adapted()?).as_mat3()))
    }

    /// The matrix to the responses of Bradford's cones, as shares of those to white.
    fn to_adapted(self) -> Result<DMat3, &'static str> {
        if !self.0.iter().all(|c| c.is_finite()) {
            return Err("are not eight finite numbers");
        }
        // Not divided by y: 0 is allowed, as for the blue of XYZ.
        let [r, g, b, white] = self.0.map(|c| DVec3::new(c.x, c.y, 1.0 - c.x - c.y));
        let directions = DMat3::from_cols(r, g, b);
        if directions.determinant().abs() < 1e-6 {
            return Err("lie on one line");
        }
        let shares = directions.inverse() * white;
        let cones = BRADFORD * white;
        if shares.min_element() <= 0.0 || cones.min_element() <= 0.0 {
            return Err("do not make their white");
        }
        let to_cones = BRADFORD * directions * DMat3::from_diagonal(shares);
        Ok(DMat3::from_diagonal(cones.recip()) * to_cones)
    }
}

/// XYZ to the cones in which light is adapted to another white [Lam 1985], by columns.
const BRADFORD: DMat3 = DMat3::from_cols(
    DVec3::new(0.8951, -0.7502, 0.0389),
    DVec3::new(0.2664, 1.7135, -0.0685),
    DVec3::new(-0.1614, 0.0367, 1.0296),
);

/// Every pixel times `to_rec709`. Colours beyond Rec.709 get values below 0.
pub(crate) fn convert(image: &mut LinearImage, to_rec709: Mat3) {
    let pixels = image.0.pixels_mut().par_iter_mut();
    pixels.for_each(|p| *p = to_rec709 * *p);
}

/// As [`convert`], with 0 for the values below 0 of a pixel that had none.
pub(crate) fn convert_clipped(image: &mut LinearImage, to_rec709: Mat3) {
    image.0.pixels_mut().par_iter_mut().for_each(|p| {
        let converted = to_rec709 * *p;
        *p = match p.min_element() >= 0.0 {
            true => converted.max(Vec3::ZERO),
            false => converted,
        };
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::Raster;

    const ACESCG: [f64; 8] = [0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767];

    fn matrix(numbers: [f64; 8]) -> Mat3 {
        let primaries = Primaries::new(numbers).unwrap();
        primaries.to_rec709().unwrap().unwrap()
    }

    #[test]
    fn acescg_gets_the_published_values_of_rec709() {
        let matrix = matrix(ACESCG);
        // The matrix that the Academy publishes, by columns.
        let want = Mat3::from_cols(
            Vec3::new(1.705_05, -0.130_26, -0.024_00),
            Vec3::new(-0.621_79, 1.140_80, -0.128_97),
            Vec3::new(-0.083_26, -0.010_55, 1.152_97),
        );
        assert!(matrix.abs_diff_eq(want, 1e-4), "{matrix}");
        assert!((matrix * Vec3::ONE).abs_diff_eq(Vec3::ONE, 1e-6));
    }

    #[test]
    fn xyz_and_aces_are_primaries_although_y_is_0_or_less() {
        let xyz = [1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.3127, 0.3290];
        // White is 1 in each value: D65 of XYZ is divided out. Red of Rec.709 comes back.
        let white = Vec3::new(0.950_46, 1.0, 1.089_06);
        let red = Vec3::new(0.412_39, 0.212_64, 0.019_33) / white;
        let got = matrix(xyz) * red;
        assert!(got.abs_diff_eq(Vec3::X, 1e-3), "{got}");
        let aces = [0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767];
        assert!((matrix(aces) * Vec3::ONE).abs_diff_eq(Vec3::ONE, 1e-6));
    }

    #[test]
    fn rec709_is_left_alone_within_its_tolerance() {
        let with_red = |x| Primaries::new([x, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329]).unwrap();
        assert_eq!(with_red(0.640_09).to_rec709(), Ok(None));
        assert!(with_red(0.6402).to_rec709().unwrap().is_some());
        let text = "0.64 0.33 0.30 0.60 0.15 0.06 0.3127 0.3290";
        assert_eq!(Primaries::of_text(text), Some(REC709));
        assert_eq!(
            Primaries::of_exr(&REC709.to_exr()).unwrap().to_rec709(),
            Ok(None)
        );
    }

    #[test]
    fn primaries_of_which_all_are_0_are_not_told() {
        for text in ["0 0 0 0 0 0 0 0", "0.0 0 0 0 -0 0 0 0 1"] {
            assert_eq!(Primaries::of_text(text), None, "{text}");
        }
        assert!(Primaries::of_text("0 0 0 0 0 0 0 0.1").is_some());
    }

    #[test]
    fn primaries_that_describe_no_colours_are_refused() {
        let why = |numbers| Primaries::new(numbers).unwrap().to_rec709().unwrap_err();
        let mut bad = ACESCG;
        bad[3] = f64::INFINITY;
        assert_eq!(why(bad), "are not eight finite numbers");
        assert_eq!(why([0.3; 8]), "lie on one line");
        assert_eq!(
            why([0.6, 0.3, 0.4, 0.3, 0.2, 0.3, 0.31, 0.33]),
            "lie on one line"
        );
        for white in [[0.9, 0.05], [0.3, 0.0]] {
            let mut bad = ACESCG;
            bad[6..].copy_from_slice(&white);
            assert_eq!(why(bad), "do not make their white");
        }
        for text in ["", "0.7 0.3 0.2", "a b c d e f g h"] {
            let primaries = Primaries::of_text(text).unwrap();
            assert!(primaries.to_rec709().is_err(), "{text}");
        }
    }

    #[test]
    fn only_what_the_conversion_brings_below_0_is_clipped() {
        let pixels = vec![Vec3::X, Vec3::new(1.0, -0.5, 0.0)];
        let mut clipped = LinearImage(Raster::from_pixels(2, 1, pixels));
        let mut kept = clipped.clone();
        convert_clipped(&mut clipped, matrix(ACESCG));
        convert(&mut kept, matrix(ACESCG));
        assert!(kept.0.pixels()[0].y < -0.1);
        assert_eq!(clipped.0.pixels()[0].y, 0.0);
        assert_eq!(clipped.0.pixels()[0].x, kept.0.pixels()[0].x);
        assert_eq!(clipped.0.pixels()[1], kept.0.pixels()[1]);
    }
}
