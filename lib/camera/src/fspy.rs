//! fSpy: projects (`.fspy`) and the JSON that it exports.
//!
//! A project begins with `fspy`, then version, length of the state and length of the image as 32-bit
//! numbers (little endian), the state as JSON, and the image.
use glam::DVec2;
use serde::Deserialize;

use crate::camera::{Camera, Lens, Pose, WorldUp};
use crate::error::CameraError;

const FORMAT: &str = "fSpy";
const VERSION: u32 = 1;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct State {
    camera_parameters: Option<Parameters>,
    calibration_settings_base: Option<Settings>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Settings {
    reference_distance_unit: Option<String>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Parameters {
    principal_point: Point,
    camera_transform: Matrix,
    horizontal_field_of_view: f64,
    image_width: f64,
    image_height: f64,
    reference_distance_unit: Option<String>,
}

#[derive(Deserialize)]
struct Point {
    x: f64,
    y: f64,
}

#[derive(Deserialize)]
struct Matrix {
    rows: Vec<Vec<f64>>,
}

/// Reads a project or an exported JSON. `up` is the axis of its world that points up: +z unless the
/// axes were chosen otherwise. Its reference distance is converted to metres where it has a unit.
///
/// # Errors
/// On another version, a project without a solved camera, and files that are cut short.
pub fn read(bytes: &[u8], up: WorldUp) -> Result<Camera, CameraError> {
    let (parameters, unit) = match bytes.strip_prefix(b"fspy") {
        Some(rest) => {
            let json: State = parse(state(rest)?)?;
            let parameters = json.camera_parameters.ok_or_else(|| {
                CameraError::with_remedy(
                    FORMAT,
                    "the project has no camera parameters",
                    "open it in fSpy, place the vanishing lines until it shows a camera, and save it",
                )
            })?;
            let settings = json.calibration_settings_base;
            (parameters, settings.and_then(|s| s.reference_distance_unit))
        }
        None => {
            let mut parameters: Parameters = parse(bytes)?;
            let unit = parameters.reference_distance_unit.take();
            (parameters, unit)
        }
    };
    camera(&parameters, unit.as_deref(), up)
}

/// The JSON of a project, after its magic bytes.
fn state(rest: &[u8]) -> Result<&[u8], CameraError> {
    let word = |i: usize| {
        let bytes = rest.get(4 * i..4 * i + 4).and_then(|b| b.first_chunk());
        bytes.map(|b| u32::from_le_bytes(*b))
    };
    let cut = || CameraError::new(FORMAT, "it is cut short");
    let (version, length) = (word(0).ok_or_else(cut)?, word(1).ok_or_else(cut)?);
    if version != VERSION {
        return Err(CameraError::with_remedy(
            FORMAT,
            format!("it is a project of version {version}, and version {VERSION} is read"),
            "export the camera parameters as JSON from fSpy",
        ));
    }
    rest.get(12..)
        .and_then(|rest| rest.get(..length as usize))
        .ok_or_else(cut)
}

fn parse<'a, T: Deserialize<'a>>(json: &'a [u8]) -> Result<T, CameraError> {
    serde_json::from_slice(json).map_err(|e| CameraError::new(FORMAT, e.to_string()))
}

fn camera(p: &Parameters, unit: Option<&str>, up: WorldUp) -> Result<Camera, CameraError> {
    let (w, h) = (p.image_width, p.image_height);
    let angle = p.horizontal_field_of_view;
    if !(angle > 0.0 && angle < std::f64::consts::PI) {
        let detail = format!("its horizontal field of view is {angle} radians");
        return Err(CameraError::new(FORMAT, detail));
    }
    let focal = 0.5 * w / (0.5 * angle).tan();
    // The longer side goes from -1 to 1, with +y up.
    let half = 0.5 * w.max(h);
    let offset = DVec2::new(p.principal_point.x, -p.principal_point.y) * half;
    let mut lens = Lens::pinhole([w, h], DVec2::splat(focal));
    lens.principal_px += offset;
    lens.check(FORMAT)?;
    let mut pose = Pose::from_rows(&p.camera_transform.rows, up, FORMAT)?;
    pose.position *= metres(unit);
    Ok(Camera { pose, lens })
}

/// Of fSpy's units; without one, the distance is in metres.
fn metres(unit: Option<&str>) -> f64 {
    match unit.unwrap_or_default() {
        "Millimeters" => 1e-3,
        "Centimeters" => 1e-2,
        "Kilometers" => 1e3,
        "Inches" => 0.0254,
        "Feet" => 0.3048,
        "Miles" => 1609.344,
        _ => 1.0,
    }
}
