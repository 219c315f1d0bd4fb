//! Straight lines of the world as pieces in the picture.
use dipir_scene::camera::Camera;
use glam::{DVec2, DVec3};

/// What a line shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The ground's grid.
    Grid,
    /// Every fifth line of it.
    MainGrid,
    /// Where the ground ends.
    Horizon,
    /// An object's box.
    Box,
    /// Where an object's front is.
    Front,
    /// The metre stick.
    Stick,
}

impl Kind {
    /// All, those below first.
    pub const ALL: [Self; 6] = [
        Self::Grid,
        Self::MainGrid,
        Self::Horizon,
        Self::Box,
        Self::Front,
        Self::Stick,
    ];
}

/// A piece of a line, pixels of the photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Piece {
    /// What it belongs to.
    pub kind: Kind,
    /// One end.
    pub from: DVec2,
    /// The other.
    pub to: DVec2,
    /// From 0 to 1.
    pub opacity: f32,
}

/// Metres before the camera at which lines are cut.
const NEAR_M: f64 = 0.02;

/// The segment from `a` to `b` in the picture, cut at its borders; `None` if nothing of it is seen.
pub fn segment(camera: &Camera, a: DVec3, b: DVec3) -> Option<[DVec2; 2]> {
    let position = camera.position.as_dvec3();
    let backward = camera.rotation.z_axis.as_dvec3();
    let depth = |p: DVec3| backward.dot(position - p);
    let (da, db) = (depth(a), depth(b));
    let cut = |p: DVec3, dp: f64, q: DVec3, dq: f64| match dp < NEAR_M {
        true => p + (q - p) * ((NEAR_M - dp) / (dq - dp)),
        false => p,
    };
    if da < NEAR_M && db < NEAR_M {
        return None;
    }
    let ends = [cut(a, da, b, db), cut(b, db, a, da)];
    let [p, q] = ends.map(|end| camera.project(end.as_vec3()).map(|p| p.as_dvec2()));
    clipped(p?, q?, camera.resolution)
}

/// What of a segment lies in the picture [Liang and Barsky 1984].
fn clipped(p: DVec2, q: DVec2, resolution: [u32; 2]) -> Option<[DVec2; 2]> {
    let d = q - p;
    let (mut first, mut last) = (0.0f64, 1.0f64);
    for axis in 0..2 {
        let size = f64::from(resolution[axis]);
        for (step, room) in [(-d[axis], p[axis]), (d[axis], size - p[axis])] {
            if step == 0.0 {
                if room < 0.0 {
                    return None;
                }
            } else if step < 0.0 {
                first = first.max(room / step);
            } else {
                last = last.min(room / step);
            }
        }
    }
    (first < last).then(|| [p + d * first, p + d * last])
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use dipir_scene::camera::FieldOfView;

    fn camera() -> Camera {
        let view = FieldOfView::Vertical(1.0);
        Camera::look_at(
            Vec3::Y,
            Vec3::new(0.0, 1.0, -1.0),
            Vec3::Y,
            view,
            [300, 200],
        )
    }

    #[test]
    fn a_line_that_begins_behind_the_camera_is_cut() {
        let behind = DVec3::new(0.0, 0.0, 5.0);
        let ahead = DVec3::new(0.0, 0.0, -50.0);
        let [p, q] = segment(&camera(), behind, ahead).unwrap();
        // It runs down the middle column from the lower border towards the horizon.
        assert!((p - DVec2::new(150.0, 200.0)).length() < 1e-3, "{p}");
        assert!(
            (q.x - 150.0).abs() < 1e-3 && q.y > 100.0 && q.y < 105.0,
            "{q}"
        );
        assert!(segment(&camera(), behind, DVec3::new(1.0, 0.0, 3.0)).is_none());
    }

    #[test]
    fn nothing_leaves_the_picture() {
        let inside = clipped(DVec2::new(-10.0, 50.0), DVec2::new(500.0, 50.0), [300, 200]);
        assert_eq!(
            inside,
            Some([DVec2::new(0.0, 50.0), DVec2::new(300.0, 50.0)])
        );
        assert_eq!(
            clipped(DVec2::new(-10.0, 0.0), DVec2::new(-1.0, 90.0), [300, 200]),
            None
        );
    }
}
