//! nerfstudio's and instant-ngp's `transforms.json`.
//!
//! Its matrices map camera to world, with the camera looking down its own -z, as here. Intrinsics
//! belong to the file or to a frame.
use glam::DVec2;
use serde::Deserialize;
use serde_json::Value;

use crate::camera::{Camera, Lens, Pose, WorldUp};
use crate::distortion::Distortion;
use crate::error::CameraError;

const FORMAT: &str = "transforms.json";

#[derive(Deserialize)]
struct File {
    #[serde(flatten)]
    intrinsics: Intrinsics,
    /// Unchecked, so that one that cannot be read keeps no other from being read.
    frames: Vec<Value>,
}

#[derive(Deserialize)]
struct Frame {
    transform_matrix: Option<Vec<Vec<f64>>>,
    #[serde(flatten)]
    intrinsics: Intrinsics,
}

macro_rules! intrinsics {
    ($($name:ident),*) => {
        #[derive(Clone, Default, Deserialize)]
        struct Intrinsics {
            camera_model: Option<String>,
            is_fisheye: Option<bool>,
            $($name: Option<f64>,)*
        }

        impl Intrinsics {
            /// What the frame says, else what the file says.
            fn or(&self, file: &Self) -> Self {
                Self {
                    camera_model: self.camera_model.clone().or(file.camera_model.clone()),
                    is_fisheye: self.is_fisheye.or(file.is_fisheye),
                    $($name: self.$name.or(file.$name),)*
                }
            }
        }
    };
}

intrinsics!(
    camera_angle_x,
    camera_angle_y,
    fl_x,
    fl_y,
    cx,
    cy,
    w,
    h,
    k1,
    k2,
    k3,
    k4,
    p1,
    p2
);

/// A frame: the name of its image, and its camera.
pub type Named = (String, Camera);

/// A frame's name and camera, or what is wrong with it.
pub(crate) type Found = (String, Result<Camera, CameraError>);

/// Reads all frames. `size` is that of the image, for files that do not say it.
///
/// # Errors
/// On matrices that do not rotate, lenses without a focal length, and camera models that are not
/// known.
pub fn read(json: &[u8], size: Option<[f64; 2]>, up: WorldUp) -> Result<Vec<Named>, CameraError> {
    let frames = frames(json, size, up)?.into_iter();
    frames.map(|(name, own)| Ok((name, own?))).collect()
}

/// As [`read`], with what is wrong with each frame.
pub(crate) fn frames(
    json: &[u8],
    size: Option<[f64; 2]>,
    up: WorldUp,
) -> Result<Vec<Found>, CameraError> {
    let file: File =
        serde_json::from_slice(json).map_err(|e| CameraError::new(FORMAT, e.to_string()))?;
    let camera = |value: &Value| {
        let wrong = |detail: &str| CameraError::new(FORMAT, format!("the frame {detail}"));
        let frame =
            Frame::deserialize(value).map_err(|e| wrong(&format!("cannot be read: {e}")))?;
        let lens = lens(&frame.intrinsics.or(&file.intrinsics), size)?;
        let rows = frame.transform_matrix;
        let rows = rows.ok_or_else(|| wrong("has no transform_matrix"))?;
        let pose = Pose::from_rows(&rows, up, FORMAT)?;
        Ok(Camera { pose, lens })
    };
    let name = |value: &Value| value["file_path"].as_str().unwrap_or_default().to_string();
    let frames = file.frames.iter();
    Ok(frames.map(|f| (name(f), camera(f))).collect())
}

fn lens(i: &Intrinsics, size: Option<[f64; 2]>) -> Result<Lens, CameraError> {
    let wrong = |detail: &str| CameraError::new(FORMAT, detail);
    let (Some(w), Some(h)) = (i.w.or(size.map(|s| s[0])), i.h.or(size.map(|s| s[1]))) else {
        return Err(wrong("it has no image size; accepted: w and h in pixels"));
    };
    let of_angle = |angle: f64, size: f64| 0.5 * size / (0.5 * angle).tan();
    let fx = i.fl_x.or(i.camera_angle_x.map(|a| of_angle(a, w)));
    let fy = i.fl_y.or(i.camera_angle_y.map(|a| of_angle(a, h)));
    let Some((fx, fy)) = fx.or(fy).zip(fy.or(fx)) else {
        return Err(wrong(
            "it has no focal length; accepted: fl_x or camera_angle_x",
        ));
    };
    let lens = Lens {
        principal_px: DVec2::new(i.cx.unwrap_or(0.5 * w), i.cy.unwrap_or(0.5 * h)),
        distortion: distortion(i)?,
        ..Lens::pinhole([w, h], DVec2::new(fx, fy))
    };
    lens.check(FORMAT)?;
    Ok(lens)
}

fn distortion(i: &Intrinsics) -> Result<Distortion, CameraError> {
    let k = [i.k1, i.k2, i.k3, i.k4].map(|k| k.unwrap_or(0.0));
    let p = [i.p1, i.p2].map(|p| p.unwrap_or(0.0));
    let fisheye = match i.camera_model.as_deref() {
        Some("OPENCV_FISHEYE") => true,
        None => i.is_fisheye.unwrap_or(false),
        Some("OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL") => false,
        Some(other) => {
            let known = "OPENCV, OPENCV_FISHEYE, PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL";
            return Err(CameraError::with_remedy(
                FORMAT,
                format!(
                    "camera_model is \"{}\"; accepted: {known}",
                    other.escape_debug()
                ),
                "undistort the images to a pinhole camera",
            ));
        }
    };
    let lens = match fisheye {
        true => Distortion::kannala_brandt(k),
        false => Distortion::brown_conrady(k, [0.0; 3], p),
    };
    lens.ok_or_else(|| CameraError::new(FORMAT, "its distortion is not finite"))
}
