//! Cameras from nerfstudio's `transforms.json`.
//!
//! Its matrices map camera to world coordinates with the camera looking down its own -z, as here;
//! its world has +z up, so (x, y, z) there is (x, z, -y) here. Intrinsics are given in pixels for the
//! whole file or for each frame, or as a horizontal angle of view; they are scaled to the photo's
//! resolution.
use glam::{DMat3, DVec3, Vec2};
use serde::Deserialize;

use crate::camera::{Camera, WorldUp};
use crate::error::Error;

const REMEDY: &str = "export the cameras again";

#[derive(Debug, Deserialize)]
struct File {
    #[serde(flatten)]
    intrinsics: Intrinsics,
    frames: Vec<Frame>,
}

#[derive(Debug, Deserialize)]
struct Frame {
    transform_matrix: Vec<Vec<f64>>,
    #[serde(flatten)]
    intrinsics: Intrinsics,
}

#[derive(Clone, Debug, Default, Deserialize)]
struct Intrinsics {
    camera_model: Option<String>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

impl Intrinsics {
    /// What the frame says, else what the file says.
    fn or(&self, file: &Self) -> Self {
        Self {
            camera_model: self.camera_model.clone().or(file.camera_model.clone()),
            camera_angle_x: self.camera_angle_x.or(file.camera_angle_x),
            camera_angle_y: self.camera_angle_y.or(file.camera_angle_y),
            fl_x: self.fl_x.or(file.fl_x),
            fl_y: self.fl_y.or(file.fl_y),
            cx: self.cx.or(file.cx),
            cy: self.cy.or(file.cy),
            w: self.w.or(file.w),
            h: self.h.or(file.h),
            k1: self.k1.or(file.k1),
            k2: self.k2.or(file.k2),
            k3: self.k3.or(file.k3),
            k4: self.k4.or(file.k4),
            p1: self.p1.or(file.p1),
            p2: self.p2.or(file.p2),
        }
    }
}

/// The camera of frame `index` for a photo of `resolution`, and what was ignored.
pub fn camera(
    json: &[u8],
    index: u32,
    up: WorldUp,
    resolution: [u32; 2],
) -> Result<(Camera, Vec<String>), Error> {
    let file: File = serde_json::from_slice(json)
        .map_err(|e| Error::malformed(format!("the camera file cannot be read: {e}"), REMEDY))?;
    let frame = file
        .frames
        .get(index as usize)
        .ok_or_else(|| Error::Config {
            key: "scene.camera.frame".into(),
            value: index.to_string(),
            accepted: format!("an index below {}, the number of frames", file.frames.len()),
        })?;
    let at = format!("frames[{index}]");
    let (rotation, position) = pose(&frame.transform_matrix, &at, up)?;
    let intrinsics = frame.intrinsics.or(&file.intrinsics);
    let mut warnings = Vec::new();
    let (focal_px, principal_px) = lens(&intrinsics, &at, resolution, &mut warnings)?;
    let camera = Camera {
        position: position.as_vec3(),
        rotation: rotation.as_mat3(),
        focal_px,
        principal_px,
        resolution,
    };
    Ok((camera, warnings))
}

/// Rotation and position in our world.
fn pose(rows: &[Vec<f64>], at: &str, up: WorldUp) -> Result<(DMat3, DVec3), Error> {
    let wrong = |what: &str| {
        Error::malformed(
            format!("{at}.transform_matrix {what}; accepted: a rotation and a position, 4 by 4"),
            REMEDY,
        )
    };
    if !(3..=4).contains(&rows.len()) || rows.iter().any(|r| r.len() != 4) {
        return Err(wrong("is not 4 by 4"));
    }
    let column = |j: usize| DVec3::new(rows[0][j], rows[1][j], rows[2][j]);
    let matrix = DMat3::from_cols(column(0), column(1), column(2));
    let position = column(3);
    if !matrix.is_finite() || !position.is_finite() {
        return Err(wrong("is not finite"));
    }
    // Files carry about six digits and some a common scale, which does not turn rays.
    let scale = matrix.determinant().cbrt();
    let rotation = matrix * scale.recip();
    let error = rotation * rotation.transpose() - DMat3::IDENTITY;
    let rigid = error.to_cols_array().iter().all(|e| e.abs() < 1e-3);
    if scale <= 0.0 || !rigid {
        return Err(wrong("does not rotate"));
    }
    let x = rotation.x_axis.normalize();
    let z = x.cross(rotation.y_axis).normalize();
    let rotation = DMat3::from_cols(x, z.cross(x), z);
    let to_ours = match up {
        WorldUp::Y => DMat3::IDENTITY,
        WorldUp::Z => DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y),
    };
    Ok((to_ours * rotation, to_ours * position))
}

/// Focal lengths and principal point in the photo's pixels.
fn lens(
    i: &Intrinsics,
    at: &str,
    resolution: [u32; 2],
    warnings: &mut Vec<String>,
) -> Result<(Vec2, Vec2), Error> {
    if let Some(model) = &i.camera_model
        && ![
            "OPENCV",
            "PINHOLE",
            "SIMPLE_PINHOLE",
            "SIMPLE_RADIAL",
            "RADIAL",
        ]
        .contains(&model.as_str())
    {
        return Err(Error::malformed(
            format!(
                "{at}: camera_model is \"{model}\"; accepted: OPENCV, PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL"
            ),
            "undistort the photo to a pinhole camera",
        ));
    }
    if [i.k1, i.k2, i.k3, i.k4, i.p1, i.p2]
        .iter()
        .any(|k| k.unwrap_or(0.0) != 0.0)
    {
        warnings.push(format!(
            "{at}: lens distortion is ignored; undistort the photo if the object seems to slide at the edges"
        ));
    }
    let photo = resolution.map(f64::from);
    let (w, h) = (i.w.unwrap_or(photo[0]), i.h.unwrap_or(photo[1]));
    let (sx, sy) = (photo[0] / w, photo[1] / h);
    let focal_of = |angle: f64, size: f64| 0.5 * size / (0.5 * angle).tan();
    let fx = i.fl_x.or(i.camera_angle_x.map(|a| focal_of(a, w)));
    let fy = i.fl_y.or(i.camera_angle_y.map(|a| focal_of(a, h))).or(fx);
    let Some((fx, fy)) = fx.or(fy).zip(fy) else {
        return Err(Error::malformed(
            format!(
                "{at} has no focal length; accepted: fl_x in pixels or camera_angle_x in radians"
            ),
            REMEDY,
        ));
    };
    let (cx, cy) = (i.cx.unwrap_or(0.5 * w), i.cy.unwrap_or(0.5 * h));
    let sizes = [fx, fy, w, h];
    if sizes.iter().any(|v| !(v.is_finite() && *v > 0.0)) || !cx.is_finite() || !cy.is_finite() {
        return Err(Error::malformed(
            format!(
                "{at}: focal length {fx} x {fy} for an image of {w} x {h}; accepted: numbers above 0"
            ),
            REMEDY,
        ));
    }
    if (sx / sy - 1.0).abs() > 0.01 {
        return Err(Error::malformed(
            format!(
                "{at} was taken at {w} x {h} pixels, the photo has {} x {}, which is another shape",
                resolution[0], resolution[1]
            ),
            "name the frame that belongs to the photo, or do not crop it",
        ));
    }
    Ok((
        Vec2::new((fx * sx) as f32, (fy * sy) as f32),
        Vec2::new((cx * sx) as f32, (cy * sy) as f32),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// A camera 2 m above the ground of a z-up world, at y = -5, that looks along +y.
    const FILE: &str = r#"{
        "camera_model": "OPENCV", "fl_x": 100.0, "fl_y": 110.0, "cx": 50.0, "cy": 40.0,
        "w": 100, "h": 80, "aabb_scale": 16,
        "frames": [{
            "file_path": "images/1.jpg",
            "transform_matrix": [[1, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 2], [0, 0, 0, 1]]
        }]
    }"#;

    fn read(text: &str, index: u32, resolution: [u32; 2]) -> Result<Camera, String> {
        camera(text.as_bytes(), index, WorldUp::Z, resolution)
            .map(|(camera, _)| camera)
            .map_err(|e| e.to_string())
    }

    #[test]
    fn a_z_up_world_becomes_a_y_up_world() {
        let camera = read(FILE, 0, [100, 80]).unwrap();
        assert_eq!(camera.position, Vec3::new(0.0, 2.0, 5.0));
        let forward = camera.ray(camera.principal_px).direction;
        assert!((forward - Vec3::NEG_Z).length() < 4.0 * f32::EPSILON);
        // A point to the right (+x) and above (z there, y here) lies right of and above the centre.
        let p = camera.project(Vec3::new(1.0, 3.0, 0.0)).unwrap();
        assert!((p - Vec2::new(50.0 + 100.0 / 5.0, 40.0 - 110.0 / 5.0)).length() < 1e-4);
    }

    #[test]
    fn intrinsics_follow_the_photos_resolution() {
        let camera = read(FILE, 0, [200, 160]).unwrap();
        assert_eq!(camera.focal_px, Vec2::new(200.0, 220.0));
        assert_eq!(camera.principal_px, Vec2::new(100.0, 80.0));
        assert_eq!(
            read(FILE, 0, [100, 100]).unwrap_err(),
            "frames[0] was taken at 100 x 80 pixels, the photo has 100 x 100, which is another shape; name the frame that belongs to the photo, or do not crop it"
        );
    }

    #[test]
    fn an_angle_of_view_stands_for_the_focal_length() {
        let text = FILE.replace(
            "\"fl_x\": 100.0, \"fl_y\": 110.0",
            &format!("\"camera_angle_x\": {}", std::f64::consts::FRAC_PI_2),
        );
        let camera = read(&text, 0, [100, 80]).unwrap();
        // Half the width at 45 degrees.
        assert!((camera.focal_px - Vec2::splat(50.0)).length() < 1e-4);
    }

    #[test]
    fn wrong_files_are_explained() {
        assert_eq!(
            read(FILE, 3, [100, 80]).unwrap_err(),
            "scene.camera.frame is 3; accepted: an index below 1, the number of frames"
        );
        assert_eq!(
            read(&FILE.replace("[1, 0, 0, 0]", "[9, 0, 0, 0]"), 0, [100, 80]).unwrap_err(),
            "frames[0].transform_matrix does not rotate; accepted: a rotation and a position, 4 by 4; export the cameras again"
        );
        assert_eq!(
            read(&FILE.replace("OPENCV", "OPENCV_FISHEYE"), 0, [100, 80]).unwrap_err(),
            "frames[0]: camera_model is \"OPENCV_FISHEYE\"; accepted: OPENCV, PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL; undistort the photo to a pinhole camera"
        );
        assert_eq!(
            read(
                &FILE
                    .replace("\"fl_x\"", "\"fx\"")
                    .replace("\"fl_y\"", "\"fy\""),
                0,
                [100, 80]
            )
            .unwrap_err(),
            "frames[0] has no focal length; accepted: fl_x in pixels or camera_angle_x in radians; export the cameras again"
        );
    }
}
