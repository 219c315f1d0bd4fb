//! How large a model is put into the picture.
use std::ops::RangeInclusive;
use std::path::Path;

use dipir_scene::plausibility::likely_unit;
use glam::DVec3;

use crate::document::number;
use crate::error::SetupError;

/// What a model's file says of its lengths and of its up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// glTF: metres, +y up [glTF 2.0, 3.4].
    Gltf,
    /// OBJ: lengths without a unit; +y is mostly up.
    Obj,
    /// PLY and STL: lengths without a unit, of parts and scans whose z is often up.
    Bare,
}

impl Kind {
    /// By the extension.
    pub fn of(path: &Path) -> Self {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        match extension.as_deref() {
            Some("obj") => Self::Obj,
            Some("ply" | "stl") => Self::Bare,
            _ => Self::Gltf,
        }
    }
}

/// Largest extents that are believed to be metres where the file says so.
const STATED_M: RangeInclusive<f32> = 0.005..=50.0;
/// Largest extents that are believed to be metres where the file says nothing, and that a guess may
/// lead to.
const BELIEVED_M: RangeInclusive<f32> = 0.05..=5.0;
/// Smaller extents without a unit that are metres, too: rings and screws.
const SMALL_M: RangeInclusive<f32> = 0.005..=0.05;
/// Extents without a unit that are centimetres: mugs and vases.
const CENTIMETRES: RangeInclusive<f32> = 5.0..=50.0;

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
    /// How high it is, metres.
    pub height_m: f64,
}

/// The size of a model whose bounding box goes from `low` to `high` in its file, `asked` metres
/// high if given.
///
/// # Errors
/// On a height that is not above 0.
pub fn size(low: DVec3, high: DVec3, kind: Kind, asked: Option<f64>) -> Result<Size, SetupError> {
    let extent = high - low;
    let largest = extent.max_element();
    // What lies flat has no height to be set.
    let flat = extent.y <= 1e-6 * largest;
    let own_height = if flat { largest } else { extent.y };
    let [x, y, z] = extent.to_array().map(short);
    let own = format!("{x} x {y} x {z} m (width, height, depth)");
    let unit = unit(largest, kind);
    if asked.is_none() && unit.is_some_and(|u| u.1 == 1.0) {
        let small = kind != Kind::Gltf && !BELIEVED_M.contains(&(largest as f32));
        return Ok(Size {
            line: None,
            why: match small {
                true => format!(
                    "the file's own size as metres, {own}, which is small; if it is not meant, write height_m or scale"
                ),
                false => {
                    format!("the file's own size, {own}; for another one write height_m or scale")
                }
            },
            width_m: extent.x.hypot(extent.z),
            height_m: extent.y,
        });
    }
    // A part that may have to be turned keeps its size by a factor only.
    let turnable = kind == Kind::Bare && asked.is_none() && unit.is_some();
    let by_factor = |metres: f64| flat || turnable || metres < LEAST_WRITTEN_M;
    let file = match kind {
        Kind::Gltf => own.clone(),
        Kind::Obj | Kind::Bare => {
            format!("{x} x {y} x {z} (width, height, depth) without a unit")
        }
    };
    let change = |metres: f64| match by_factor(metres) {
        true => "for another size change scale, or write height_m instead",
        false => "for another size change height_m",
    };
    let (metres, why) = match (asked, unit) {
        (Some(h), _) if !(h.is_finite() && h > 0.0) => {
            return Err(SetupError::Value {
                option: "--height-m",
                value: h.to_string(),
                accepted: "metres above 0, for instance --height-m 0.9",
            });
        }
        (Some(h), _) => (h, format!("as --height-m says; the file has {file}")),
        (None, Some((unit, factor))) => {
            let metres = factor * own_height;
            let change = change(metres);
            (
                metres,
                format!("a guess, for the file has {file}, which look like {unit}; {change}"),
            )
        }
        (None, None) => (
            1.0,
            format!(
                "a guess, for the file has {file}, which are hardly metres; {}",
                change(1.0)
            ),
        ),
    };
    let factor = match (asked, unit) {
        (None, Some((_, factor))) => factor,
        _ => metres / own_height,
    };
    let factor = if factor.is_finite() { factor } else { 1.0 };
    Ok(Size {
        line: Some(match by_factor(metres) {
            true => format!("scale = {factor:?}"),
            false => format!("height_m = {}", number(metres, 4)),
        }),
        why,
        width_m: factor * extent.x.hypot(extent.z),
        height_m: factor * extent.y,
    })
}

/// The unit that a model with this largest extent in its file is in, and its metres; `None` if no unit
/// makes it likely.
fn unit(largest: f64, kind: Kind) -> Option<(&'static str, f64)> {
    // Positions have single precision: .005 is less than .005 otherwise.
    let extent = largest as f32;
    let metres = match kind {
        Kind::Gltf => STATED_M.contains(&extent),
        Kind::Obj | Kind::Bare => BELIEVED_M.contains(&extent) || SMALL_M.contains(&extent),
    };
    if metres {
        return Some(("metres", 1.0));
    }
    let unit = match kind != Kind::Gltf && CENTIMETRES.contains(&extent) {
        true => Some(("centimetres", 0.01)),
        false => likely_unit(largest),
    };
    unit.filter(|(_, metres)| BELIEVED_M.contains(&((metres * largest) as f32)))
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

    /// Of a chair whose height is its longest side.
    const CHAIR: DVec3 = DVec3::new(0.6, 0.9, 0.8);

    fn of(extent: DVec3, kind: Kind, asked: Option<f64>) -> Size {
        size(DVec3::ZERO, extent, kind, asked).unwrap()
    }

    /// A cube of single precision, as positions of a mesh are.
    fn cube(side: f32, kind: Kind) -> Size {
        of(DVec3::splat(side.into()), kind, None)
    }

    #[test]
    fn the_kind_is_that_of_the_extension() {
        let of = |name: &str| Kind::of(name.as_ref());
        assert_eq!(of("a.glb"), Kind::Gltf);
        assert_eq!(of("a.GLTF"), Kind::Gltf);
        assert_eq!(of("a.b.Obj"), Kind::Obj);
        assert_eq!((of("a.STL"), of("a.ply")), (Kind::Bare, Kind::Bare));
    }

    #[test]
    fn a_size_that_can_be_metres_is_kept() {
        for kind in [Kind::Gltf, Kind::Obj, Kind::Bare] {
            let chair = of(CHAIR, kind, None);
            assert_eq!(chair.line, None);
            assert!((chair.width_m - 1.0).abs() < 1e-12 && chair.height_m == 0.9);
            assert!(chair.why.contains("0.6 x 0.9 x 0.8 m"), "{}", chair.why);
            assert!(!chair.why.contains("small"), "{}", chair.why);
        }
    }

    #[test]
    fn metres_that_the_format_states_are_believed_from_5_mm_to_50_m() {
        for side in [0.005, 0.0095, 0.03, 5.5, 12.0, 50.0] {
            let cube = cube(side, Kind::Gltf);
            assert_eq!(cube.line, None, "{side}: {}", cube.why);
            assert!((cube.height_m - f64::from(side)).abs() < 1e-9);
        }
        // Neither a chip of 2 mm nor a hall of 60 m is put into a photograph.
        assert_eq!(
            cube(0.002, Kind::Gltf).line.as_deref(),
            Some("height_m = 2.0")
        );
        assert_eq!(
            cube(60.0, Kind::Gltf).line.as_deref(),
            Some("height_m = 0.6")
        );
    }

    #[test]
    fn five_to_five_hundred_without_a_unit_are_centimetres() {
        for (side, line) in [
            (10.0, "height_m = 0.1"),
            (33.0, "height_m = 0.33"),
            (50.0, "height_m = 0.5"),
            (90.0, "height_m = 0.9"),
            (499.0, "height_m = 4.99"),
            (1800.0, "height_m = 1.8"),
        ] {
            let cube = cube(side, Kind::Obj);
            assert_eq!(cube.line.as_deref(), Some(line), "{}", cube.why);
            for part in ["a guess", "without a unit", "change height_m"] {
                assert!(cube.why.contains(part), "{part}: {}", cube.why);
            }
        }
        // A part that is turned afterwards keeps its scale.
        let part = cube(33.0, Kind::Bare);
        assert_eq!(part.line.as_deref(), Some("scale = 0.01"));
        assert!(part.why.contains("change scale"), "{}", part.why);
        assert!((part.height_m - 0.33).abs() < 1e-9);
    }

    #[test]
    fn a_ring_of_two_centimetres_stays_one() {
        for side in [0.005, 0.02, 0.049] {
            for kind in [Kind::Obj, Kind::Bare] {
                let ring = cube(side, kind);
                assert_eq!(ring.line, None);
                assert!(ring.why.contains("which is small"), "{}", ring.why);
            }
        }
    }

    #[test]
    fn a_size_that_no_unit_makes_likely_becomes_a_metre_high() {
        for (scale, kind) in [(1e5, Kind::Obj), (1e5, Kind::Gltf), (1e-5, Kind::Bare)] {
            let chair = of(CHAIR * scale, kind, None);
            assert_eq!(chair.line.as_deref(), Some("height_m = 1.0"));
            assert!((chair.width_m - 1.0 / 0.9).abs() < 1e-9);
            assert!((chair.height_m - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn a_size_in_another_unit_becomes_metres() {
        for (scale, unit) in [
            (1e-3, "kilometres"),
            (100.0, "centimetres"),
            (1000.0, "millimetres"),
        ] {
            let chair = of(CHAIR * scale, Kind::Gltf, None);
            assert_eq!(chair.line.as_deref(), Some("height_m = 0.9"));
            assert!((chair.width_m - 1.0).abs() < 1e-9);
            let said = format!("which look like {unit}; ");
            assert!(chair.why.contains(&said), "{}", chair.why);
        }
        // What is flat, or nearly so, is scaled by its length.
        for height in [0.0, 2.0] {
            let carpet = of(DVec3::new(3000.0, height, 4000.0), Kind::Obj, None);
            assert_eq!(carpet.line.as_deref(), Some("scale = 0.001"));
        }
    }

    #[test]
    fn a_carpet_is_scaled_by_its_length() {
        let carpet = of(DVec3::new(300.0, 0.0, 400.0), Kind::Obj, Some(2.0));
        assert_eq!(carpet.line.as_deref(), Some("scale = 0.005"));
        assert!((carpet.width_m - 2.5).abs() < 1e-9 && carpet.height_m == 0.0);
    }

    #[test]
    fn a_height_that_is_none_is_refused() {
        for height in [0.0, -1.0, f64::NAN] {
            let error = size(DVec3::ZERO, DVec3::ONE, Kind::Gltf, Some(height)).unwrap_err();
            assert!(error.to_string().starts_with("--height-m is "), "{error}");
        }
    }
}
