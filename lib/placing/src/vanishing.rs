//! A camera's turn and field of view from lines that are parallel in the world.
//!
//! Lines along a street meet in the picture in the vanishing point of their direction. Two such
//! points of directions at right angles give the focal length [Caprile and Torre 1990]; both, or
//! one and a known focal length, give where up is.
use anyhow::bail;
use dipir_scene::camera::Camera;
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::edit::Turn;

/// A line in the picture by two of its points, pixels.
pub type Line = [[f64; 2]; 2];

/// What the second pair of lines follows in the world.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Second {
    /// The ground, at right angles to the first pair.
    #[default]
    Level,
    /// What stands upright.
    Upright,
}

/// What is known of the focal length before lines are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Focal {
    /// It stays as it is.
    Known,
    /// Two pairs of lines tell it.
    Unsure,
}

/// Lines that a user drew.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lines {
    /// Two lines along the ground.
    pub first: [Line; 2],
    /// Two more in another direction.
    #[serde(default)]
    pub second: Option<[Line; 2]>,
    /// In which.
    #[serde(default)]
    pub direction: Second,
}

/// A camera that was found.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Solution {
    /// The camera.
    pub turn: Turn,
    /// How far each angle moves, in degrees, if every point is off by [`CLICK_PX`]: root of the sum of
    /// squares.
    pub uncertain_deg: Turn,
    /// Whether the field of view was found; else it is as before.
    pub found_fov: bool,
}

/// How exactly people click, pixels.
pub const CLICK_PX: f64 = 1.5;

/// Fields of view that are believed, degrees.
const BELIEVED: std::ops::Range<f64> = 2.0..150.0;
/// The uncertainty of an angle of which nothing is known, degrees.
const NOTHING_DEG: f64 = 90.0;

/// The camera that sees `lines`; what they do not tell is as in `camera`.
///
/// # Errors
/// If the lines contradict each other.
pub fn solve(lines: &Lines, camera: &Camera, known: Focal) -> anyhow::Result<Solution> {
    let (turn, found_fov) = turn_of(lines, camera, known)?;
    let mut squares = [0.0; 3];
    let pairs = 1 + usize::from(lines.second.is_some());
    for k in 0..pairs * 8 {
        let mut moved = lines.clone();
        let pair = match (k / 8, &mut moved.second) {
            (1, Some(second)) => second,
            _ => &mut moved.first,
        };
        pair[k % 8 / 4][k % 4 / 2][k % 2] += CLICK_PX;
        let Ok((other, _)) = turn_of(&moved, camera, known) else {
            // Lines that contradict each other when they are moved a little say nothing.
            squares = [NOTHING_DEG * NOTHING_DEG; 3];
            break;
        };
        for (sum, (a, b)) in squares.iter_mut().zip([
            (turn.pitch_deg, other.pitch_deg),
            (turn.roll_deg, other.roll_deg),
            (turn.fov_deg, other.fov_deg),
        ]) {
            *sum += (a - b) * (a - b);
        }
    }
    let [pitch_deg, roll_deg, fov_deg] = squares.map(f64::sqrt);
    Ok(Solution {
        turn,
        uncertain_deg: Turn {
            pitch_deg,
            roll_deg,
            fov_deg,
        },
        found_fov,
    })
}

fn turn_of(lines: &Lines, camera: &Camera, known: Focal) -> anyhow::Result<(Turn, bool)> {
    let focal = camera.focal_px.as_dvec2();
    let [scale, height] = camera.resolution.map(f64::from);
    let fov = |focal: f64| 2.0 * (0.5 * height / focal).atan().to_degrees();
    let first = vanishing_point(&lines.first, camera)?;
    let Some(second) = &lines.second else {
        let (_, roll) = angles(camera.rotation.as_dmat3().transpose().y_axis);
        let d = direction(first, focal.y / scale);
        // The turn for which up is at right angles to the street.
        let pitch = ((d.y * roll.cos() - d.x * roll.sin()) / d.z).atan();
        if !pitch.is_finite() {
            bail!("the lines run along the horizon and do not tell where it is");
        }
        let turn = Turn {
            pitch_deg: pitch.to_degrees(),
            roll_deg: roll.to_degrees(),
            fov_deg: fov(focal.y),
        };
        return Ok((turn, false));
    };
    let second = vanishing_point(second, camera)?;
    // Directions at right angles: x x' + y y' + f^2 w w' = 0.
    let square = -first.truncate().dot(second.truncate()) / (first.z * second.z);
    // Both points must be near enough to tell: a few picture widths.
    const FAR: f64 = 1.0 / 8.0;
    let tells = known == Focal::Unsure
        && first.z.abs() > FAR * first.truncate().length()
        && second.z.abs() > FAR * second.truncate().length();
    let found = square.sqrt() * scale;
    if tells && !(square > 0.0 && BELIEVED.contains(&fov(found))) {
        bail!(
            "the two pairs do not run at right angles in the world: no camera sees both vanishing \
             points where they are"
        );
    }
    let focal = if tells { found } else { focal.y };
    let [a, b] = [first, second].map(|v| direction(v, focal / scale));
    let up = match lines.direction {
        Second::Level => a.cross(b),
        // As near to the drawn one as the street's direction allows.
        Second::Upright => b - a * a.dot(b),
    };
    let up = up.normalize_or_zero();
    if up == DVec3::ZERO {
        bail!("both pairs run in the same direction");
    }
    let up = if up.y < 0.0 { -up } else { up };
    let (pitch, roll) = angles(up);
    let turn = Turn {
        pitch_deg: pitch.to_degrees(),
        roll_deg: roll.to_degrees(),
        fov_deg: fov(focal),
    };
    Ok((turn, tells))
}

/// Pitch and roll, radians, of a camera that sees up in the direction `up` of its own axes.
fn angles(up: DVec3) -> (f64, f64) {
    ((-up.z).clamp(-1.0, 1.0).asin(), (-up.x).atan2(up.y))
}

/// Pitch, roll and vertical field of view of `camera`, degrees.
pub fn turn_of_camera(camera: &Camera) -> Turn {
    let (pitch, roll) = angles(camera.rotation.as_dmat3().transpose().y_axis);
    let half = 0.5 * f64::from(camera.resolution[1]) / f64::from(camera.focal_px.y);
    Turn {
        pitch_deg: pitch.to_degrees(),
        roll_deg: roll.to_degrees(),
        fov_deg: 2.0 * half.atan().to_degrees(),
    }
}

/// Where two lines meet, homogeneous: about the principal point, y upwards, in picture widths.
fn vanishing_point(pair: &[Line; 2], camera: &Camera) -> anyhow::Result<DVec3> {
    let scale = f64::from(camera.resolution[0]);
    let principal = camera.principal_px.as_dvec2();
    let focal = camera.focal_px.as_dvec2();
    let line = |[p, q]: Line| {
        let [p, q] = [p, q].map(|p| {
            let p = (DVec2::from_array(p) - principal) / scale;
            // Pixels that are not square are made so.
            DVec3::new(p.x * focal.y / focal.x, -p.y, 1.0)
        });
        p.cross(q).normalize_or_zero()
    };
    let [a, b] = pair.map(line);
    let meet = a.cross(b);
    if a == DVec3::ZERO || b == DVec3::ZERO || meet.length() < 1e-9 {
        bail!("a pair needs two lines of some length that do not lie on each other");
    }
    Ok(meet.normalize())
}

/// The unit direction, in the camera's axes, of what is seen at `point`.
fn direction(point: DVec3, focal: f64) -> DVec3 {
    // The camera looks down its -z; both are in picture widths.
    DVec3::new(point.x, point.y, -point.z * focal).normalize()
}

#[cfg(test)]
mod tests {
    use dipir_scene::camera::FieldOfView;
    use glam::Vec3;

    use super::*;

    /// A camera that is turned as `turn` says, at the height of the eyes.
    fn camera(turn: &Turn) -> Camera {
        let rotation = DMat3::from_rotation_x(turn.pitch_deg.to_radians())
            * DMat3::from_rotation_z(-turn.roll_deg.to_radians());
        let position = Vec3::new(0.0, 1.6, 0.0);
        let ahead = position - rotation.z_axis.as_vec3();
        let view = FieldOfView::Vertical(turn.fov_deg.to_radians() as f32);
        let up = rotation.y_axis.as_vec3();
        Camera::look_at(position, ahead, up, view, [1200, 800])
    }

    /// Two lines of the world in `direction` through two points before the camera.
    fn pair(camera: &Camera, direction: DVec3) -> [Line; 2] {
        [DVec3::new(-1.0, 0.0, -6.0), DVec3::new(1.5, 0.0, -6.0)].map(|start| {
            [start, start + direction].map(|p| {
                let p = camera.project(p.as_vec3()).expect("in front");
                p.as_dvec2().to_array()
            })
        })
    }

    use glam::DMat3;

    #[test]
    fn two_pairs_give_the_camera_back() {
        for (pitch_deg, roll_deg, fov_deg) in [(-12.0, 2.0, 45.0), (5.0, -3.0, 60.0)] {
            let truth = Turn {
                pitch_deg,
                roll_deg,
                fov_deg,
            };
            let camera = camera(&truth);
            let street = DVec3::new(0.5, 0.0, -1.0);
            for (across, direction) in [
                (DVec3::new(1.0, 0.0, 0.5), Second::Level),
                (DVec3::Y, Second::Upright),
            ] {
                let lines = Lines {
                    first: pair(&camera, street),
                    second: Some(pair(&camera, across)),
                    direction,
                };
                // Another camera stands for what is not known yet.
                let guess = Camera {
                    focal_px: camera.focal_px * if direction == Second::Level { 1.7 } else { 1.0 },
                    ..camera
                };
                let found = solve(&lines, &guess, Focal::Unsure).unwrap().turn;
                // Pixels of single precision: 6e-5 px over lines of 100 px, extrapolated tenfold.
                assert!((found.pitch_deg - pitch_deg).abs() < 0.02, "{found:?}");
                assert!((found.roll_deg - roll_deg).abs() < 0.02, "{found:?}");
                assert!((found.fov_deg - fov_deg).abs() < 0.1, "{found:?}");
            }
        }
    }

    #[test]
    fn one_pair_gives_the_pitch_of_a_known_lens() {
        let truth = Turn {
            pitch_deg: -9.0,
            roll_deg: 0.0,
            fov_deg: 50.0,
        };
        let lines = Lines {
            first: pair(&camera(&truth), DVec3::new(-0.3, 0.0, -1.0)),
            second: None,
            direction: Second::Level,
        };
        let level = Turn {
            pitch_deg: 0.0,
            ..truth
        };
        let found = solve(&lines, &camera(&level), Focal::Unsure).unwrap();
        assert!((found.turn.pitch_deg + 9.0).abs() < 0.02, "{found:?}");
        assert!(!found.found_fov && found.uncertain_deg.pitch_deg > 0.0);
    }

    #[test]
    fn pairs_at_any_angle_give_the_turn_of_a_known_lens() {
        let truth = Turn {
            pitch_deg: -12.0,
            roll_deg: 2.0,
            fov_deg: 45.0,
        };
        let camera = camera(&truth);
        let lines = Lines {
            first: pair(&camera, DVec3::new(0.5, 0.0, -1.0)),
            second: Some(pair(&camera, DVec3::new(1.0, 0.0, -0.2))),
            direction: Second::Level,
        };
        let found = solve(&lines, &camera, Focal::Known).unwrap();
        // As above.
        assert!((found.turn.pitch_deg + 12.0).abs() < 0.02, "{found:?}");
        assert!((found.turn.roll_deg - 2.0).abs() < 0.02, "{found:?}");
        assert!(!found.found_fov && (found.turn.fov_deg - 45.0).abs() < 1e-3);
    }

    #[test]
    fn two_lines_along_the_horizon_do_not_tell_where_it_is() {
        let level = Turn {
            pitch_deg: 0.0,
            roll_deg: 0.0,
            fov_deg: 50.0,
        };
        let lines = Lines {
            first: [
                [[100.0, 600.0], [900.0, 600.0]],
                [[100.0, 700.0], [900.0, 700.0]],
            ],
            second: None,
            direction: Second::Level,
        };
        let error = solve(&lines, &camera(&level), Focal::Unsure)
            .unwrap_err()
            .to_string();
        assert!(error.contains("along the horizon"), "{error}");
    }

    #[test]
    fn lines_that_lie_on_each_other_are_refused() {
        let line = [[0.0, 0.0], [100.0, 50.0]];
        let lines = Lines {
            first: [line, line],
            second: None,
            direction: Second::Level,
        };
        let camera = camera(&turn_of_camera(&Camera::look_at(
            Vec3::Y,
            Vec3::ZERO - Vec3::Z,
            Vec3::Y,
            FieldOfView::Vertical(0.7),
            [1200, 800],
        )));
        solve(&lines, &camera, Focal::Unsure).unwrap_err();
    }
}
