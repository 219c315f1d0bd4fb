//! How a camera would expose linear light.
use crate::metrics::LUMA;
use crate::raster::LinearImage;

/// Linear mid-grey.
pub const MID_GREY: f64 = 0.18;

/// The exposure in stops that brings the log-average luminance of `image` to mid-grey.
pub fn automatic_exposure_ev(image: &LinearImage) -> f32 {
    exposure_ev_to(image, MID_GREY) as f32
}

/// The exposure in stops that brings the log-average luminance of `image` to `level`; 0 for a black one.
pub fn exposure_ev_to(image: &LinearImage, level: f64) -> f64 {
    let logs: Vec<f64> = image
        .0
        .pixels()
        .iter()
        .map(|p| f64::from(p.dot(LUMA)))
        .filter(|l| *l > 0.0)
        .map(f64::ln)
        .collect();
    if logs.is_empty() {
        return 0.0;
    }
    let average = (logs.iter().sum::<f64>() / logs.len() as f64).exp();
    (level / average).log2()
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::raster::Raster;

    #[test]
    fn automatic_exposure_brings_grey_to_mid_grey() {
        let grey = LinearImage(Raster::filled(2, 2, Vec3::splat(0.72)));
        assert!((automatic_exposure_ev(&grey) + 2.0).abs() < 1e-5);
        let black = LinearImage(Raster::filled(2, 2, Vec3::ZERO));
        assert_eq!(automatic_exposure_ev(&black), 0.0);
    }
}
