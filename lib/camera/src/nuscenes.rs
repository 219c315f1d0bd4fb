//! Records as nuScenes' `calibrated_sensor.json` and `ego_pose.json` have them.
//!
//! A sensor has `translation` (metres) and `rotation` (quaternion w x y z) into the vehicle, whose
//! frame has +x forward, +y to the left, +z up and its origin on the ground; a camera has
//! `camera_intrinsic`, three rows of three, in pixels from the middle of the first one: the development kit takes the colour
//! of a point from the pixel to whose number its projection rounds. A record may bring the vehicle's own `ego_pose` along.
use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::Deserialize;
use serde_json::Value;

use crate::camera::{Camera, FIRST_PIXEL, Lens, Pose, WorldUp};
use crate::error::CameraError;

const FORMAT: &str = "nuScenes";

#[derive(Deserialize)]
struct Record {
    #[serde(flatten)]
    sensor: Stand,
    #[serde(default)]
    camera_intrinsic: Vec<[f64; 3]>,
    ego_pose: Option<Stand>,
    width: Option<f64>,
    height: Option<f64>,
}

#[derive(Deserialize)]
struct Stand {
    translation: [f64; 3],
    rotation: [f64; 4],
}

impl Stand {
    /// Into the frame around it.
    fn rotation(&self) -> Option<DMat3> {
        let [w, x, y, z] = self.rotation;
        let q = DQuat::from_xyzw(x, y, z, w);
        let length = q.length();
        (length > 1e-6 && length.is_finite()).then(|| DMat3::from_quat(q / length))
    }
}

/// A sensor's rotation and position in the vehicle, or in the world where its record has the
/// vehicle's pose.
fn stand(record: &Record) -> Result<(DMat3, DVec3), CameraError> {
    let wrong = || CameraError::new(FORMAT, "a record has no rotation and translation");
    let mut rotation = record.sensor.rotation().ok_or_else(wrong)?;
    let mut position = DVec3::from_array(record.sensor.translation);
    if let Some(ego) = &record.ego_pose {
        let turn = ego.rotation().ok_or_else(wrong)?;
        rotation = turn * rotation;
        position = turn * position + DVec3::from_array(ego.translation);
    }
    match position.is_finite() {
        true => Ok((rotation, position)),
        false => Err(wrong()),
    }
}

/// Unchecked, so that one that cannot be read keeps no other from being read.
fn records(json: &[u8]) -> Result<Vec<Value>, CameraError> {
    match serde_json::from_slice(json).map_err(wrong)? {
        Value::Array(records) => Ok(records),
        one => Ok(vec![one]),
    }
}

fn wrong(error: serde_json::Error) -> CameraError {
    CameraError::new(FORMAT, error.to_string())
}

/// Reads all cameras by the first of their names; records of other sensors are passed over. `size` is that of the image,
/// for records without `width` and `height`.
///
/// # Errors
/// On records without a rotation, and intrinsics that are no pinhole's.
pub fn read(
    json: &[u8],
    size: [f64; 2],
    up: WorldUp,
) -> Result<Vec<(String, Camera)>, CameraError> {
    let cameras = read_named(json, size, up)?.into_iter();
    let first = |(names, own): Found| {
        let name = names.into_iter().flatten().next();
        Ok((name.unwrap_or_default(), own?))
    };
    cameras.map(first).collect()
}

/// What a record may be called by: its channel, the file of its picture and its token.
pub(crate) type Names = [Option<String>; 3];

const NAMES: [&str; 3] = ["channel", "filename", "token"];

/// A camera by its names, or what is wrong with it.
pub(crate) type Found = (Names, Result<Camera, CameraError>);

/// As [`read`], with all names and what is wrong with each record.
pub(crate) fn read_named(
    json: &[u8],
    size: [f64; 2],
    up: WorldUp,
) -> Result<Vec<Found>, CameraError> {
    let records = records(json)?;
    // Other sensors have an empty list.
    let is_camera = |value: &&Value| {
        let matrix = value.get("camera_intrinsic");
        matrix.is_some_and(|m| m.as_array().is_none_or(|rows| !rows.is_empty()))
    };
    let cameras = records.iter().filter(is_camera);
    let named = |value: &Value| {
        let word = |key: &str| value[key].as_str().map(Into::into);
        (NAMES.map(word), camera(value, size, up))
    };
    Ok(cameras.map(named).collect())
}

fn camera(value: &Value, size: [f64; 2], up: WorldUp) -> Result<Camera, CameraError> {
    let record = Record::deserialize(value).map_err(wrong)?;
    let [[fx, skew, cx], [_, fy, cy], [_, _, one]] = record.camera_intrinsic[..] else {
        return Err(CameraError::new(FORMAT, "camera_intrinsic is not 3 by 3"));
    };
    if !(skew.abs() < 1e-3 * fx.abs() && (one - 1.0).abs() < 1e-6) {
        return Err(CameraError::new(FORMAT, "camera_intrinsic is no pinhole's"));
    }
    let own = record.width.zip(record.height).map(|(w, h)| [w, h]);
    let lens = Lens {
        principal_px: DVec2::new(cx, cy) + FIRST_PIXEL,
        ..Lens::pinhole(own.unwrap_or(size), DVec2::new(fx, fy))
    };
    lens.check(FORMAT)?;
    let (r, position) = stand(&record)?;
    // From image axes: y down, z forward.
    let axes = DMat3::from_cols(r.x_axis, -r.y_axis, -r.z_axis);
    let pose = Pose::from_axes(axes, position)
        .ok_or_else(|| CameraError::new(FORMAT, "a record does not rotate"))?;
    let pose = pose.in_our_world(up);
    Ok(Camera { pose, lens })
}

/// Where the sensor of the only record stands: rotation and position into our world.
///
/// # Errors
/// On files of more records than one, and as [`read`].
pub fn sensor(json: &[u8], up: WorldUp) -> Result<(DMat3, DVec3), CameraError> {
    match &records(json)?[..] {
        [record] => {
            let record = Record::deserialize(record).map_err(wrong)?;
            let (rotation, position) = stand(&record)?;
            Ok((up.to_ours() * rotation, up.to_ours() * position))
        }
        more => Err(CameraError::with_remedy(
            FORMAT,
            format!("it has {} records", more.len()),
            "write the record of the sensor that took the points into a file of its own",
        )),
    }
}
