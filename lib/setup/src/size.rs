//! How large a model is put into the picture.
use dipir_scene::plausibility::likely_unit;
use glam::DVec3;

use crate::document::number;
use crate::error::SetupError;

/// Largest extents that are believed to be metres.
const BELIEVED_M: std::ops::RangeInclusive<f64> = 0.05..=5.0;

/// A height below this is rounded too much when it is written.
const LEAST_WRITTEN_M: f64 = 0.01;

/// The size of an object.
#[derive(Clone, Debug, PartialEq)]
pub struct Size {
    /// The line of its table, if it needs one: `height_m = 1.0`.
    pub line: Option<String>,
    /// Where the size comes from.
    pub why: String,
    /// How wide it is on the ground at most, metres, however it is turned upright.
    pub width_m: f64,
}

/// The size of a model whose bounding box goes from `low` to `high` in its file, `asked` metres
/// high if given.
///
/// # Errors
/// On a height that is not above 0.
pub fn size(low: DVec3, high: DVec3, asked: Option<f64>) -> Result<Size, SetupError> {
    let extent = high - low;
    let largest = extent.max_element();
    // What lies flat has no height to be set.
    let flat = extent.y <= 1e-6 * largest;
    let own_height = if flat { largest } else { extent.y };
    let own = format!(
        "{} x {} x {} m (width, height, depth)",
        short(extent.x),
        short(extent.y),
        short(extent.z)
    );
    let height = match asked {
        Some(h) if !(h.is_finite() && h > 0.0) => {
            return Err(SetupError::Value {
                option: "--height-m",
                value: h.to_string(),
                accepted: "metres above 0, for instance --height-m 0.9",
            });
        }
        Some(h) => (h, format!("as --height-m says; the file has {own}")),
        None if BELIEVED_M.contains(&largest) => {
            return Ok(Size {
                line: None,
                why: format!("the file's own size, {own}; for another one write height_m or scale"),
                width_m: extent.x.hypot(extent.z),
            });
        }
        None => match likely_unit(largest) {
            Some((unit, metres)) if BELIEVED_M.contains(&(metres * largest)) => (
                metres * own_height,
                format!("a guess, for the file has {own}, which look like {unit}"),
            ),
            _ => (
                1.0,
                format!("a guess, for the file has {own}, which are hardly metres"),
            ),
        },
    };
    let (metres, why) = height;
    let factor = metres / own_height;
    let factor = if factor.is_finite() { factor } else { 1.0 };
    Ok(Size {
        line: Some(match flat || metres < LEAST_WRITTEN_M {
            true => format!("scale = {factor:?}"),
            false => format!("height_m = {}", number(metres, 4)),
        }),
        why,
        width_m: factor * extent.x.hypot(extent.z),
    })
}

/// With three digits or more.
fn short(metres: f64) -> String {
    match metres.abs() {
        m if m >= 100.0 => format!("{metres:.0}"),
        m if m >= 1.0 || m == 0.0 => number(metres, 2),
        m if m >= 1e-3 => number(metres, 5),
        _ => format!("{metres:.2e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(extent: DVec3, asked: Option<f64>) -> Size {
        size(DVec3::ZERO, extent, asked).unwrap()
    }

    #[test]
    fn a_size_that_can_be_metres_is_kept() {
        let chair = of(DVec3::new(0.6, 0.9, 0.8), None);
        assert_eq!(chair.line, None);
        assert!((chair.width_m - 1.0).abs() < 1e-12);
        assert!(chair.why.contains("0.6 x 0.9 x 0.8 m"), "{}", chair.why);
    }

    #[test]
    fn a_size_that_cannot_becomes_a_metre_high() {
        for scale in [0.04, 10.0] {
            let chair = of(DVec3::new(0.6, 0.9, 0.8) * scale, None);
            assert_eq!(chair.line.as_deref(), Some("height_m = 1.0"));
            assert!((chair.width_m - 1.0 / 0.9).abs() < 1e-9);
        }
    }

    #[test]
    fn a_size_in_another_unit_becomes_metres() {
        for (scale, unit) in [
            (1e-3, "kilometres"),
            (100.0, "centimetres"),
            (1000.0, "millimetres"),
        ] {
            let chair = of(DVec3::new(0.6, 0.9, 0.8) * scale, None);
            assert_eq!(chair.line.as_deref(), Some("height_m = 0.9"));
            assert!((chair.width_m - 1.0).abs() < 1e-9);
            assert!(chair.why.ends_with(unit), "{}", chair.why);
        }
        // What is flat, or nearly so, is scaled by its length.
        for height in [0.0, 2.0] {
            let carpet = of(DVec3::new(3000.0, height, 4000.0), None);
            assert_eq!(carpet.line.as_deref(), Some("scale = 0.001"));
        }
    }

    #[test]
    fn a_carpet_is_scaled_by_its_length() {
        let carpet = of(DVec3::new(300.0, 0.0, 400.0), Some(2.0));
        assert_eq!(carpet.line.as_deref(), Some("scale = 0.005"));
        assert!((carpet.width_m - 2.5).abs() < 1e-9);
    }

    #[test]
    fn a_height_that_is_none_is_refused() {
        for height in [0.0, -1.0, f64::NAN] {
            let error = size(DVec3::ZERO, DVec3::ONE, Some(height)).unwrap_err();
            assert!(error.to_string().starts_with("--height-m is "), "{error}");
        }
    }
}
