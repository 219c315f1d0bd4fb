//! The curve between linear light and the values that a display file stores.
use crate::raster::{DisplayImage, LinearImage, Raster};
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// A display transfer function, applied to each channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Transfer {
    /// The piecewise sRGB curve [IEC 61966-2-1]: linear below 0.0031308, a power of 1/2.4 above.
    #[default]
    Srgb,
    /// A pure power of 2.2.
    Gamma22,
    /// Display values are linear light, clipped.
    Linear,
}

/// Where the sRGB curve changes from line to power, in linear light [IEC 61966-2-1].
const SRGB_LINEAR_KNEE: f32 = 0.003_130_8;
/// The same point in display values, as the standard prints it. The two pieces meet there to 1e-8.
const SRGB_DISPLAY_KNEE: f32 = 0.040_45;

impl Transfer {
    /// Display value in `[0, 1]` to linear light in `[0, 1]`. Values outside are clamped first.
    pub fn decode_scalar(self, display: f32) -> f32 {
        let v = display.clamp(0.0, 1.0);
        match self {
            Self::Srgb if v <= SRGB_DISPLAY_KNEE => v / 12.92,
            Self::Srgb => ((v + 0.055) / 1.055).powf(2.4),
            Self::Gamma22 => v.powf(2.2),
            Self::Linear => v,
        }
    }

    /// Linear light to a display value in `[0, 1]`: light outside `[0, 1]` is clipped, NaN stays.
    pub fn encode_scalar(self, linear: f32) -> f32 {
        let v = linear.clamp(0.0, 1.0);
        match self {
            Self::Srgb if v <= SRGB_LINEAR_KNEE => 12.92 * v,
            // 1.055 p - 0.055, arranged so that white is exactly 1 in f32.
            Self::Srgb => 1.055 * (v.powf(1.0 / 2.4) - 1.0) + 1.0,
            Self::Gamma22 => v.powf(1.0 / 2.2),
            Self::Linear => v,
        }
    }

    /// Derivative of [`encode_scalar`](Self::encode_scalar) with respect to the linear value.
    ///
    /// Zero where the value is clipped (below 0, above 1). At exactly 0 and 1 it is the derivative
    /// from inside, so that a pixel resting on the bound can still move. The power of 2.2 has an
    /// infinite slope at 0: there it is bounded by its value at [`GAMMA22_SLOPE_FLOOR`].
    pub fn encode_scalar_vjp(self, linear: f32, gradient: f32) -> f32 {
        if !(0.0..=1.0).contains(&linear) {
            return 0.0;
        }
        let slope = match self {
            Self::Srgb if linear <= SRGB_LINEAR_KNEE => 12.92,
            Self::Srgb => 1.055 / 2.4 * linear.powf(1.0 / 2.4 - 1.0),
            Self::Gamma22 => linear.max(GAMMA22_SLOPE_FLOOR).powf(1.0 / 2.2 - 1.0) / 2.2,
            Self::Linear => 1.0,
        };
        slope * gradient
    }

    /// Display values to linear light.
    pub fn decode(self, display: DisplayImage) -> LinearImage {
        LinearImage(map_channels(display.0, |v| self.decode_scalar(v)))
    }

    /// Linear light to display values, clipped to `[0, 1]`.
    pub fn encode(self, linear: &LinearImage) -> DisplayImage {
        DisplayImage(map_channels(linear.0.clone(), |v| self.encode_scalar(v)))
    }

    /// Gradient with respect to the linear image, given the gradient with respect to the display
    /// image. Panics if the sizes differ.
    pub fn encode_vjp(self, linear: &LinearImage, gradient: &Raster<Vec3>) -> Raster<Vec3> {
        assert_eq!(
            (linear.0.width(), linear.0.height()),
            (gradient.width(), gradient.height()),
            "the gradient has the size of the image"
        );
        let channels = linear.0.pixels().par_iter().zip(gradient.pixels());
        let pixels = channels
            .map(|(v, g)| {
                Vec3::new(
                    self.encode_scalar_vjp(v.x, g.x),
                    self.encode_scalar_vjp(v.y, g.y),
                    self.encode_scalar_vjp(v.z, g.z),
                )
            })
            .collect();
        Raster::from_pixels(linear.0.width(), linear.0.height(), pixels)
    }
}

/// Below this linear value the slope of `gamma22` is held constant: half an 8-bit step of the
/// display value, `(0.5 / 255)^2.2`, so that no displayable difference is lost.
pub const GAMMA22_SLOPE_FLOOR: f32 = 1.1e-6;

fn map_channels(mut raster: Raster<Vec3>, f: impl Fn(f32) -> f32 + Sync) -> Raster<Vec3> {
    raster
        .pixels_mut()
        .par_iter_mut()
        .for_each(|p| *p = Vec3::new(f(p.x), f(p.y), f(p.z)));
    raster
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_numerics::gradcheck::{central_difference, relative_error};

    const ALL: [Transfer; 3] = [Transfer::Srgb, Transfer::Gamma22, Transfer::Linear];

    fn encode_f64(transfer: Transfer, v: f64) -> f64 {
        match transfer {
            Transfer::Srgb if v <= 0.003_130_8 => 12.92 * v,
            Transfer::Srgb => 1.055 * v.powf(1.0 / 2.4) - 0.055,
            Transfer::Gamma22 => v.powf(1.0 / 2.2),
            Transfer::Linear => v,
        }
    }

    #[test]
    fn every_8_and_16_bit_value_survives_the_round_trip() {
        for transfer in ALL {
            for max in [255u32, 65535] {
                for i in 0..=max {
                    let display = i as f32 / max as f32;
                    let back = transfer.encode_scalar(transfer.decode_scalar(display));
                    let rounded = (back * max as f32 + 0.5) as u32;
                    assert_eq!(rounded, i, "{transfer:?} of {max}");
                }
            }
        }
    }

    #[test]
    fn srgb_agrees_with_the_standard_in_f64() {
        // The f32 power and the argument's rounding give a few ulp of a value up to 1.
        for i in 0..=1000 {
            let v = i as f32 / 1000.0;
            for transfer in ALL {
                let want = encode_f64(transfer, f64::from(v));
                let got = f64::from(transfer.encode_scalar(v));
                assert!(
                    (got - want).abs() < 4.0 * f64::from(f32::EPSILON),
                    "{transfer:?} {v}"
                );
            }
        }
        assert_eq!(Transfer::Srgb.encode_scalar(1.0), 1.0);
        assert_eq!(Transfer::Srgb.decode_scalar(1.0), 1.0);
    }

    #[test]
    fn light_outside_the_display_is_clipped_and_has_no_gradient() {
        for transfer in ALL {
            assert_eq!(transfer.encode_scalar(-0.5), 0.0);
            assert_eq!(transfer.encode_scalar(1e6), 1.0);
            assert_eq!(transfer.encode_scalar(f32::INFINITY), 1.0);
            assert!(transfer.encode_scalar(f32::NAN).is_nan());
            for v in [-0.5, -1e-9, 1.000_001, 1e6, f32::NAN] {
                assert_eq!(transfer.encode_scalar_vjp(v, 3.0), 0.0, "{transfer:?} {v}");
            }
            for v in [0.0, 1.0] {
                let slope = transfer.encode_scalar_vjp(v, 1.0);
                assert!(slope.is_finite() && slope > 0.0, "{transfer:?} {v}");
            }
        }
    }

    #[test]
    fn the_display_gradient_follows_central_differences() {
        // f64 differences with h = 1e-6 v: error 1e-12 + 2e-16 / (h slope) < 1e-7; f32 adds 1e-6.
        for transfer in ALL {
            for v in [1e-5f32, 0.002, 0.0032, 0.05, 0.3, 0.999] {
                let at = f64::from(v);
                let want = central_difference(|v| encode_f64(transfer, v), at, 1e-6 * at);
                let got = f64::from(transfer.encode_scalar_vjp(v, 1.0));
                assert!(
                    relative_error(got, want, 1e-3) < 1e-5,
                    "{transfer:?} {v}: {got} {want}"
                );
            }
        }
        let image = LinearImage(Raster::from_pixels(1, 1, vec![Vec3::new(0.2, -1.0, 0.001)]));
        let gradient = Raster::filled(1, 1, Vec3::new(2.0, 3.0, 4.0));
        let got = Transfer::Srgb.encode_vjp(&image, &gradient).pixels()[0];
        let red = Transfer::Srgb.encode_scalar_vjp(0.2, 2.0);
        assert_eq!(got, Vec3::new(red, 0.0, 12.92 * 4.0));
    }

    #[test]
    fn images_are_transferred_channel_by_channel() {
        let display = DisplayImage(Raster::from_pixels(1, 1, vec![Vec3::new(0.0, 0.5, 1.0)]));
        let linear = Transfer::Srgb.decode(display.clone());
        let half = Transfer::Srgb.decode_scalar(0.5);
        assert_eq!(linear.0.pixels()[0], Vec3::new(0.0, half, 1.0));
        let back = Transfer::Srgb.encode(&linear).0.pixels()[0];
        assert!(back.abs_diff_eq(display.0.pixels()[0], 2.0 * f32::EPSILON));
    }
}
