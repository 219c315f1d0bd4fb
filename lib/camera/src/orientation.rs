//! Cameras of pictures that are stored turned.
//!
//! Telephones store pictures as the sensor lies and say by Exif how they are to be turned. A photograph here is upright. COLMAP leaves
//! pictures as they are stored, so its cameras see them so.
use std::path::Path;

use glam::{DMat3, DVec2};

use crate::camera::{Lens, Pose};
use crate::colmap;
use crate::error::CameraError;
use crate::file::{Found, Wanted, found};

/// By how much the shapes of two pictures may differ, relative.
const SAME_SHAPE: f64 = 0.01;

/// As [`read`](crate::file::read), of a photograph that was made upright by this Exif orientation, and by how many quarter turns, clockwise, its
/// camera was, too: COLMAP's, which sees pictures as they are stored, and others where the shape tells it.
///
/// # Errors
/// As [`read`](crate::file::read).
pub fn read_turned(
    path: &Path,
    wanted: &Wanted,
    orientation: u8,
) -> Result<(Found, u32), CameraError> {
    let mut found = found(path, wanted)?;
    let size = wanted.size;
    let fits = |[w, h]: [f64; 2]| (w / h / (size[0] / size[1]) - 1.0).abs() <= SAME_SHAPE;
    let turned = found.lens.turned(quarters(orientation));
    let sees_stored = colmap::Files::at(path).is_some() || !fits(found.lens.size);
    let quarters = match sees_stored && fits(turned.size) {
        true => quarters(orientation),
        false => 0,
    };
    found.lens = found.lens.turned(quarters);
    found.pose = found.pose.map(|pose| pose.turned(quarters));
    let [w, h] = found.lens.size;
    if !fits([w, h]) {
        return Err(CameraError::with_remedy(
            found.program,
            format!(
                "it is of a picture of {w} x {h} pixels, and the photograph has {} x {}",
                size[0], size[1]
            ),
            "use the picture that it was made for, uncropped, or name that picture's camera",
        ));
    }
    found.lens = found.lens.scaled(size);
    Ok((found, quarters))
}

/// What is assumed where [`read_turned`] turns the camera of a picture of `size` pixels, and no shape tells whether it is right, as a
/// warning.
pub fn doubt_of_turn(path: &Path, size: [f64; 2], orientation: u8) -> Option<String> {
    let quarters = quarters(orientation);
    let fits_both = quarters == 2 || (size[0] / size[1] - 1.0).abs() <= SAME_SHAPE;
    let is_doubtful = quarters != 0 && fits_both && colmap::Files::at(path).is_some();
    is_doubtful.then(|| {
        format!(
            "\"{}\": COLMAP sees pictures as they are stored, and Exif data turn this one by {} degrees: so its camera is turned, \
             too. If the model was made of a picture that was turned before, name that one in place of the photograph",
            path.display(),
            90 * quarters
        )
    })
}

/// By how many quarter turns, clockwise, a stored picture is made upright, by its Exif orientation; none where that mirrors it.
pub(crate) fn quarters(orientation: u8) -> u32 {
    match orientation {
        6 => 1,
        3 => 2,
        8 => 3,
        _ => 0,
    }
}

impl Lens {
    /// Of the same picture after this many quarter turns, clockwise.
    pub(crate) fn turned(&self, quarters: u32) -> Self {
        (0..quarters).fold(*self, |lens, _| Self {
            size: [lens.size[1], lens.size[0]],
            focal_px: DVec2::new(lens.focal_px.y, lens.focal_px.x),
            principal_px: DVec2::new(lens.size[1] - lens.principal_px.y, lens.principal_px.x),
            distortion: lens.distortion.turned_by_a_quarter(),
        })
    }
}

impl Pose {
    /// Of a camera whose picture was turned by this many quarters, clockwise.
    pub(crate) fn turned(&self, quarters: u32) -> Self {
        (0..quarters).fold(*self, |pose, _| {
            let [right, up, back] = [0, 1, 2].map(|k| pose.rotation.col(k));
            Self {
                rotation: DMat3::from_cols(up, -right, back),
                ..pose
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::distortion::Distortion;

    #[test]
    fn a_turned_camera_sees_each_point_where_the_turned_picture_shows_it() {
        let tangential = [0.003, -0.002];
        let lens = Lens {
            size: [640.0, 480.0],
            focal_px: DVec2::new(510.0, 490.0),
            principal_px: DVec2::new(330.0, 220.0),
            distortion: Distortion::brown_conrady([-0.1, 0.02, 0.0, 0.0], [0.0; 3], tangential)
                .unwrap(),
        };
        let pose = Pose {
            position: DVec3::new(1.0, 2.0, 3.0),
            rotation: DMat3::from_rotation_y(0.4) * DMat3::from_rotation_z(0.3),
        };
        let seen = |lens: &Lens, pose: &Pose, point: DVec3| {
            let local = pose.rotation.transpose() * (point - pose.position);
            let image = lens.distortion.image(local * DVec3::new(1.0, -1.0, -1.0));
            lens.principal_px + lens.focal_px * image.expect("is before the camera")
        };
        for (orientation, quarters_of) in [(1, 0), (6, 1), (3, 2), (8, 3)] {
            assert_eq!(quarters(orientation), quarters_of);
            let (turned, stands) = (lens.turned(quarters_of), pose.turned(quarters_of));
            for offset in [[0.3, 0.2, -2.0], [-0.5, 0.4, -1.5], [0.0, -0.6, -3.0]] {
                let point = pose.position + pose.rotation * DVec3::from(offset);
                let stored = seen(&lens, &pose, point);
                let [w, h] = lens.size;
                let want = match quarters_of {
                    0 => stored,
                    1 => DVec2::new(h - stored.y, stored.x),
                    2 => DVec2::new(w - stored.x, h - stored.y),
                    _ => DVec2::new(stored.y, w - stored.x),
                };
                let found = seen(&turned, &stands, point);
                assert!(found.distance(want) < 1e-9, "{orientation}: {found} {want}");
            }
        }
        for mirrored in [2, 4, 5, 7] {
            assert_eq!(quarters(mirrored), 0);
        }
    }
}
