//! Lenses that OpenCV, ROS and Kalibr calibrate: `camera_matrix` or `intrinsics`, `distortion_coefficients`, and the
//! image's size, as YAML or JSON. Pixels count from the middle of the first one.
use glam::DVec2;
use serde_json::Value;

use crate::camera::{FIRST_PIXEL, Lens};
use crate::distortion::Distortion;
use crate::error::CameraError;

const FORMAT: &str = "OpenCV calibration";
/// Names under which programs write them, as [`plain`] makes them.
const MATRIX: [&str; 2] = ["cameramatrix", "k"];
/// Kalibr's: focal lengths and optical axis.
const INTRINSICS: [&str; 1] = ["intrinsics"];
const COEFFICIENTS: [&str; 8] = [
    "distortioncoefficients",
    "distortioncoeffs",
    "distcoefficients",
    "distcoeffs",
    "distcoeff",
    "distortion",
    "dist",
    "d",
];
const WIDTH: [&str; 2] = ["imagewidth", "width"];
const HEIGHT: [&str; 2] = ["imageheight", "height"];
/// Both of them, in Kalibr's files.
const SIZE: [&str; 1] = ["resolution"];
/// The first that is there counts: beside the model of the distortion, that of the camera says `pinhole`.
const MODEL: [&str; 2] = ["distortionmodel", "cameramodel"];
/// Whether it is a fisheye, in the files of OpenCV's own calibration.
const FISHEYE: [&str; 1] = ["fisheyemodel"];
/// Models of the coefficients k1 k2 p1 p2 k3 …, and of a fisheye's.
const BROWN: [&str; 6] = [
    "plumb_bob",
    "rational_polynomial",
    "radtan",
    "radial-tangential",
    "pinhole",
    "none",
];
const KANNALA: [&str; 2] = ["fisheye", "equidistant"];
/// More numbers than any matrix of a calibration has.
const MOST_NUMBERS: usize = 1 << 12;

/// Reads the lens. Coefficients are k1 k2 p1 p2 and up to k3, k4 k5 k6, or k1 to k4 of a fisheye where
/// the model is `fisheye` or `equidistant`, or `fisheye_model` is 1. `size` is that of the image, where the file does not say it.
///
/// # Errors
/// If the matrix or the size is missing, a list holds what is no number, the coefficients are of another model, or the
/// file has several cameras.
pub fn read(text: &str, size: Option<[f64; 2]>) -> Result<Lens, CameraError> {
    let found = match text.trim_start().starts_with('{') {
        true => Found::in_json(text)?,
        false => Found::in_yaml(text)?,
    };
    let wrong = |detail: &str| CameraError::new(FORMAT, detail);
    let [fx, skew, cx, below, fy, cy, rest @ ..] = &found.matrix[..] else {
        return Err(no_matrix());
    };
    let (fx, skew, cx, fy, cy) = (*fx, *skew, *cx, *fy, *cy);
    match rest[..] {
        // Up to rounding.
        [a, b, one] if [*below, a, b, one - 1.0].iter().all(|v| v.abs() < 1e-6) => {}
        [_, _, _] => {
            return Err(wrong(
                "its matrix is not fx 0 cx, 0 fy cy, 0 0 1 by rows; others write it by columns",
            ));
        }
        _ => return Err(no_matrix()),
    }
    if skew.abs() > 1e-3 * fx.abs() {
        return Err(wrong("its pixels are skewed"));
    }
    let Some(size) = found.size.or(size) else {
        return Err(wrong("it has no image_width and image_height"));
    };
    let lens = Lens {
        principal_px: DVec2::new(cx, cy) + FIRST_PIXEL,
        distortion: found.distortion()?,
        ..Lens::pinhole(size, DVec2::new(fx, fy))
    };
    lens.check(FORMAT)?;
    Ok(lens)
}

fn no_matrix() -> CameraError {
    CameraError::with_remedy(
        FORMAT,
        "it has neither a camera_matrix of nine numbers nor intrinsics of four",
        "export the lens again, or use a file that is read, as transforms.json or fSpy's",
    )
}

#[derive(Default)]
struct Found {
    matrix: Vec<f64>,
    coefficients: Vec<f64>,
    size: Option<[f64; 2]>,
    model: String,
}

impl Found {
    fn in_json(text: &str) -> Result<Self, CameraError> {
        let json: Value =
            serde_json::from_str(text).map_err(|e| CameraError::new(FORMAT, e.to_string()))?;
        let fields = json.as_object().into_iter().flatten();
        let get = |names: &[&str]| {
            let named = |name: &&str| fields.clone().find(|(own, _)| plain(own) == **name);
            names.iter().find_map(named).map(|(_, value)| value)
        };
        let numbers = |names: &[&str]| {
            let mut out = Vec::new();
            if let Some(value) = get(names) {
                flatten(value.get("data").unwrap_or(value), &mut out)?;
            }
            Ok::<_, CameraError>(out)
        };
        let number = |names: &[&str]| get(names).and_then(Value::as_f64);
        let is_fisheye = |v: &Value| v.as_bool().unwrap_or(v.as_f64().is_some_and(|v| v != 0.0));
        let size = number(&WIDTH).zip(number(&HEIGHT)).map(|(w, h)| [w, h]);
        Ok(Self {
            matrix: matrix(numbers(&MATRIX)?, || numbers(&INTRINSICS))?,
            coefficients: numbers(&COEFFICIENTS)?,
            size: size.or_else(|| numbers(&SIZE).ok()?.try_into().ok()),
            model: match get(&FISHEYE).is_some_and(is_fisheye) {
                true => KANNALA[0].into(),
                false => get(&MODEL).and_then(Value::as_str).unwrap_or("").into(),
            },
        })
    }

    /// The few forms of YAML that calibrations are written in: `key: value`, lists, and matrices with their numbers as
    /// `data` below their key.
    fn in_yaml(text: &str) -> Result<Self, CameraError> {
        let value = |names: &[&str]| {
            let mut lines = text.lines().map(without_comment);
            lines.find_map(|line| {
                let (name, value) = line.split_once(':')?;
                names.contains(&&*plain(name)).then(|| value.trim())
            })
        };
        let number = |names: &[&str]| value(names)?.parse().ok();
        let size = number(&WIDTH).zip(number(&HEIGHT)).map(|(w, h)| [w, h]);
        let model = MODEL.iter().find_map(|name| value(&[name])).unwrap_or("");
        let is_fisheye = |v: &str| v == "true" || v.parse().is_ok_and(|v: f64| v != 0.0);
        let names = text.lines().filter_map(|line| line.split_once(':'));
        let cameras = names.filter(|(name, _)| plain(name) == INTRINSICS[0]);
        match cameras.count() {
            0 | 1 => {}
            n => {
                return Err(CameraError::with_remedy(
                    FORMAT,
                    format!("it has {n} cameras"),
                    "write that of the photograph into a file of its own",
                ));
            }
        }
        Ok(Self {
            matrix: matrix(yaml_list(text, &MATRIX)?, || yaml_list(text, &INTRINSICS))?,
            coefficients: yaml_list(text, &COEFFICIENTS)?,
            size: size.or_else(|| yaml_list(text, &SIZE).ok()?.try_into().ok()),
            model: match value(&FISHEYE).is_some_and(is_fisheye) {
                true => KANNALA[0].into(),
                false => model.trim_matches(['"', '\'']).into(),
            },
        })
    }

    fn distortion(&self) -> Result<Distortion, CameraError> {
        let c = &self.coefficients[..];
        let at = |i: usize| c.get(i).copied().unwrap_or(0.0);
        let model = self.model.as_str();
        let fisheye = KANNALA.contains(&model);
        if !(fisheye || model.is_empty() || BROWN.contains(&model)) {
            let detail = format!(
                "its distortion model is \"{}\"; accepted: {}, {}",
                model.escape_debug(),
                BROWN.join(", "),
                KANNALA.join(", ")
            );
            return Err(CameraError::new(FORMAT, detail));
        }
        let rest = if fisheye { 4 } else { 8 };
        if c.iter().skip(rest).any(|&v| v != 0.0) {
            let detail = "it has coefficients of a thin prism or a tilted sensor";
            return Err(CameraError::new(FORMAT, detail));
        }
        let lens = match fisheye {
            true => Distortion::kannala_brandt([at(0), at(1), at(2), at(3)]),
            false => Distortion::brown_conrady(
                [at(0), at(1), at(4), 0.0],
                [at(5), at(6), at(7)],
                [at(2), at(3)],
            ),
        };
        lens.ok_or_else(|| CameraError::new(FORMAT, "its distortion is not finite"))
    }
}

/// A name as it is compared: programs write `distortion_coefficients`, `Distortion_Coefficients` and `distCoeffs`.
fn plain(name: &str) -> String {
    name.trim().to_lowercase().replace('_', "")
}

/// The matrix or, if a file has none, that of fx fy cx cy.
fn matrix(
    own: Vec<f64>,
    intrinsics: impl FnOnce() -> Result<Vec<f64>, CameraError>,
) -> Result<Vec<f64>, CameraError> {
    if !own.is_empty() {
        return Ok(own);
    }
    Ok(match intrinsics()?[..] {
        [fx, fy, cx, cy] => vec![fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        _ => vec![],
    })
}

/// All numbers of nested lists; `null` has none.
fn flatten(value: &Value, out: &mut Vec<f64>) -> Result<(), CameraError> {
    match value {
        Value::Array(items) => items.iter().try_for_each(|item| flatten(item, out)),
        Value::Null => Ok(()),
        _ if out.len() >= MOST_NUMBERS => Ok(()),
        other => {
            out.push(
                other
                    .as_f64()
                    .ok_or_else(|| no_number(&other.to_string()))?,
            );
            Ok(())
        }
    }
}

fn without_comment(line: &str) -> &str {
    line.split('#').next().unwrap_or_default()
}

/// The numbers of a list, in brackets or a line each, at a key or in `data` below it; none if the key is missing.
fn yaml_list(text: &str, names: &[&str]) -> Result<Vec<f64>, CameraError> {
    let indent = |line: &str| line.len() - line.trim_start().len();
    let mut lines = text.lines().map(without_comment);
    let found = lines.by_ref().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        names
            .contains(&&*plain(name))
            .then(|| (indent(line), value))
    });
    let Some((level, own)) = found else {
        return Ok(vec![]);
    };
    let below = lines.take_while(|line| {
        let start = line.trim_start();
        start.is_empty() || indent(line) > level || start.starts_with(['-', ']'])
    });
    let (mut list, mut in_data) = (vec![own], false);
    for line in below {
        match line.split_once(':') {
            None => list.push(line),
            Some(_) if in_data => break,
            Some((name, value)) => {
                in_data = name.trim() == "data";
                if in_data {
                    list = vec![value];
                }
            }
        }
    }
    let words = list.iter().flat_map(|line| line.split([',', '[', ']']));
    words
        .flat_map(str::split_whitespace)
        // The dash of a list's line, no value, and a type such as !!opencv-matrix.
        .filter(|word| !["-", "null", "~"].contains(word) && !word.starts_with('!'))
        .take(MOST_NUMBERS)
        .map(|word| word.parse().map_err(|_| no_number(word)))
        .collect()
}

fn no_number(word: &str) -> CameraError {
    let word: String = word.chars().take(60).collect();
    let detail = format!("\"{}\" is no number", word.escape_debug());
    CameraError::new(FORMAT, detail)
}
