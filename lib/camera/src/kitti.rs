//! KITTI's `calib` texts.
//!
//! `P2: …` (or `P_rect_02: …`) is a projection of twelve numbers by rows, from the rectified frame of
//! the first camera, in image axes, to pixels, which count from the middle of the first one: the development kit adds 1 to
//! what it projects before it draws it in MATLAB, where the middle of the first pixel is (1, 1).
use glam::{DMat3, DVec2, DVec3};

use crate::camera::{Camera, FIRST_PIXEL, Lens, Pose, WorldUp};
use crate::error::CameraError;

const FORMAT: &str = "KITTI calibration";

/// Reads camera `index` (2 is the left one in colour). Its world is the rectified frame of camera 0
/// with +y up: the ground lies about 1.65 m below its origin. `size` is that of the image.
///
/// # Errors
/// If the file has no such camera, or its matrix is no projection.
pub fn read(text: &str, index: u32, size: [f64; 2]) -> Result<Camera, CameraError> {
    let names = [format!("P{index}"), format!("P_rect_{index:02}")];
    let is_projection = |line: &str| line.starts_with('P') && line.contains(':');
    if !text.lines().any(is_projection) {
        return Err(CameraError::with_remedy(
            FORMAT,
            "it has no line such as P2: …",
            "of .txt KITTI's calib.txt is read, and cameras.txt, images.txt and points3D.txt of COLMAP's models",
        ));
    }
    let p: [f64; 12] = numbers(text, [&names[0], &names[1]])?;
    let wrong = |what: &str| CameraError::new(FORMAT, format!("{} {what}", names[0]));
    // K (I | t) with an upper triangular K that ends in 1.
    let upright = p[4].abs() < 1e-6 && p[8].abs() < 1e-6 && p[9].abs() < 1e-6;
    if !(upright && (p[10] - 1.0).abs() < 1e-6 && p[1].abs() < 1e-3 * p[0].abs()) {
        return Err(wrong("is not a projection of a rectified camera"));
    }
    let lens = Lens {
        principal_px: DVec2::new(p[2], p[6]) + FIRST_PIXEL,
        ..Lens::pinhole(size, DVec2::new(p[0], p[5]))
    };
    lens.check(FORMAT)?;
    let tz = p[11];
    let shift = DVec3::new((p[3] - p[2] * tz) / p[0], (p[7] - p[6] * tz) / p[5], tz);
    let pose = Pose::from_world_to_image(DMat3::IDENTITY, shift)
        .ok_or_else(|| wrong("has no finite shift"))?;
    Ok(Camera {
        pose: pose.in_our_world(WorldUp::MinusY),
        lens,
    })
}

/// Rotation and position of the laser scanner in the world of [`read`], by `Tr_velo_to_cam` (or `Tr`) and
/// `R0_rect` (or `R_rect`, or none for an identity).
///
/// # Errors
/// If the file has no such matrix, or one that does not rotate, or `R0_rect` is not nine numbers.
pub fn read_scanner(text: &str) -> Result<(DMat3, DVec3), CameraError> {
    let [r00, r01, r02, tx, r10, r11, r12, ty, r20, r21, r22, tz] =
        numbers(text, ["Tr_velo_to_cam", "Tr"])?;
    let rotation = DMat3::from_cols_array(&[r00, r10, r20, r01, r11, r21, r02, r12, r22]);
    let names = ["R0_rect", "R_rect"];
    let rectify = match record(text, names) {
        Some(_) => DMat3::from_cols_array(&numbers(text, names)?).transpose(),
        None => DMat3::IDENTITY,
    };
    let turn = WorldUp::MinusY.to_ours() * rectify;
    let pose = Pose::from_axes(turn * rotation, turn * DVec3::new(tx, ty, tz));
    let pose = pose.ok_or_else(|| CameraError::new(FORMAT, "Tr_velo_to_cam does not rotate"))?;
    Ok((pose.rotation, pose.position))
}

/// The first line of one of the names: the name and what is behind it.
fn record<'a>(text: &'a str, names: [&str; 2]) -> Option<(&'a str, &'a str)> {
    let mut lines = text.lines().filter_map(|line| line.split_once(':'));
    lines.find(|(name, _)| names.contains(&name.trim()))
}

/// The numbers behind the first of the names that is there.
fn numbers<const N: usize>(text: &str, names: [&str; 2]) -> Result<[f64; N], CameraError> {
    let Some((name, line)) = record(text, names) else {
        let detail = format!("it has neither {} nor {}", names[0], names[1]);
        return Err(CameraError::new(FORMAT, detail));
    };
    let values: Option<Vec<f64>> = line.split_whitespace().map(|v| v.parse().ok()).collect();
    let values = values.filter(|v| v.iter().all(|v| v.is_finite()));
    let values = values.and_then(|v| <[f64; N]>::try_from(v).ok());
    values.ok_or_else(|| {
        CameraError::new(FORMAT, format!("{} is not {N} finite numbers", name.trim()))
    })
}
