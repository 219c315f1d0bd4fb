//! Pitch and roll of a camera from edges that are upright in the world.
//!
//! Images of upright lines meet in one point of the image plane; pitch and roll determine it. The pair that most edges
//! agree with is looked for on a grid and refined by robust least squares.
use glam::{DVec2, DVec3};

use crate::segments::Segment;

/// How a camera is turned, with one standard deviation, degrees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Turn {
    /// Upwards.
    pub pitch_deg: f64,
    /// Clockwise about the line of sight.
    pub roll_deg: f64,
    /// Of the pitch.
    pub pitch_sigma_deg: f64,
    /// Of the roll.
    pub roll_sigma_deg: f64,
    /// Edges that agree.
    pub edges: usize,
}

/// The grid that is searched, degrees either way.
const MOST_PITCH_DEG: f64 = 40.0;
const MOST_ROLL_DEG: f64 = 10.0;
/// Residual beyond which an edge does not count, degrees: in the search, and when refining.
const SEARCH_DEG: f64 = 2.0;
const REFINE_DEG: f64 = 3.0;
/// Least residual that is believed, degrees: real edges are not straighter.
const LEAST_RESIDUAL_DEG: f64 = 0.3;
/// A result is sure enough with this many edges, this share of their length, and deviations below
/// these.
const LEAST_EDGES: usize = 6;
const LEAST_SHARE: f64 = 0.5;
const MOST_PITCH_SIGMA_DEG: f64 = 2.5;
const MOST_ROLL_SIGMA_DEG: f64 = 1.5;

/// The turn that the edges of a picture of `size` pixels agree on; `None` if they do not. `focal_px`
/// may be wrong by the factor `1 + focal_sigma`.
pub fn turn(segments: &[Segment], size: [f64; 2], focal_px: f64, focal_sigma: f64) -> Option<Turn> {
    if segments.len() < LEAST_EDGES {
        return None;
    }
    let edges: Vec<Edge> = segments
        .iter()
        .map(|s| Edge::of(s, size, focal_px))
        .collect();
    let angles = refine(&edges, search(&edges));
    let (mut information, mut squares, mut weights) = ([0.0; 3], 0.0, 0.0);
    let (mut length, mut agreeing) = (0.0, 0);
    for edge in &edges {
        let residual = edge.residual_deg(angles);
        let weight = tukey(residual, REFINE_DEG);
        if weight > 0.0 {
            agreeing += 1;
            length += edge.length;
        }
        let slope = edge.slope(angles);
        accumulate(&mut information, slope, weight);
        squares += weight * residual * residual;
        weights += weight;
    }
    let all: f64 = edges.iter().map(|e| e.length).sum();
    let variance = (squares / weights.max(1e-9)).max(LEAST_RESIDUAL_DEG * LEAST_RESIDUAL_DEG);
    let [a, b, c] = information;
    let determinant = a * c - b * b;
    if !(determinant > 1e-9 && agreeing >= LEAST_EDGES && length >= LEAST_SHARE * all) {
        return None;
    }
    // The two sides of a post are one observation: half as many as edges.
    let deviation = |cofactor: f64| (2.0 * variance * cofactor / determinant).sqrt();
    // The pitch grows with the focal length that was taken.
    let by_focal = focal_sigma * angles[0];
    let turn = Turn {
        pitch_deg: angles[0],
        roll_deg: angles[1],
        pitch_sigma_deg: deviation(c).hypot(by_focal),
        roll_sigma_deg: deviation(a),
        edges: agreeing,
    };
    let sure = turn.pitch_sigma_deg <= MOST_PITCH_SIGMA_DEG
        && turn.roll_sigma_deg <= MOST_ROLL_SIGMA_DEG
        && turn.pitch_deg.abs() < MOST_PITCH_DEG
        && turn.roll_deg.abs() < MOST_ROLL_DEG;
    sure.then_some(turn)
}

/// An edge in the image plane at distance 1, +y up.
struct Edge {
    middle: DVec2,
    direction: DVec2,
    /// Pixels.
    length: f64,
}

impl Edge {
    fn of(segment: &Segment, size: [f64; 2], focal_px: f64) -> Self {
        let flip = DVec2::new(1.0, -1.0);
        let centre = 0.5 * DVec2::from_array(size);
        Self {
            middle: (segment.middle - centre) * flip / focal_px,
            direction: segment.direction * flip,
            length: segment.length,
        }
    }

    /// The angle from what is upright at the edge's middle, if the camera has this pitch and roll,
    /// to the edge, degrees.
    fn residual_deg(&self, [pitch_deg, roll_deg]: [f64; 2]) -> f64 {
        let (sin_p, cos_p) = pitch_deg.to_radians().sin_cos();
        let (sin_r, cos_r) = roll_deg.to_radians().sin_cos();
        // The world's up in the camera's axes; a point that moves along it moves so in the image.
        let up = DVec3::new(-sin_r * cos_p, cos_r * cos_p, -sin_p);
        let moves = DVec2::new(up.x, up.y) + self.middle * up.z;
        let angle = moves
            .perp_dot(self.direction)
            .atan2(moves.dot(self.direction));
        // A line has no front.
        let degrees = angle.to_degrees();
        degrees - 180.0 * (degrees / 180.0).round()
    }

    /// Of the residual, by pitch and roll.
    fn slope(&self, angles: [f64; 2]) -> [f64; 2] {
        const STEP: f64 = 1e-3;
        [0, 1].map(|i| {
            let at = |step: f64| {
                let mut moved = angles;
                moved[i] += step;
                self.residual_deg(moved)
            };
            (at(STEP) - at(-STEP)) / (2.0 * STEP)
        })
    }
}

/// The pair on the grid with the largest total length of edges that agree.
fn search(edges: &[Edge]) -> [f64; 2] {
    let (mut best, mut most) = ([0.0; 2], f64::NEG_INFINITY);
    for pitch in -(MOST_PITCH_DEG as i32)..=MOST_PITCH_DEG as i32 {
        for half_roll in -2 * MOST_ROLL_DEG as i32..=2 * MOST_ROLL_DEG as i32 {
            let angles = [f64::from(pitch), 0.5 * f64::from(half_roll)];
            let score: f64 = edges
                .iter()
                .map(|e| e.length * (1.0 - (e.residual_deg(angles) / SEARCH_DEG).powi(2)).max(0.0))
                .sum();
            if score > most {
                (best, most) = (angles, score);
            }
        }
    }
    best
}

/// Gauss and Newton's steps with Tukey's weights.
fn refine(edges: &[Edge], mut angles: [f64; 2]) -> [f64; 2] {
    for _ in 0..20 {
        let (mut matrix, mut vector) = ([0.0; 3], [0.0; 2]);
        for edge in edges {
            let residual = edge.residual_deg(angles);
            let weight = edge.length * tukey(residual, REFINE_DEG);
            let slope = edge.slope(angles);
            accumulate(&mut matrix, slope, weight);
            for i in 0..2 {
                vector[i] += weight * slope[i] * residual;
            }
        }
        let [a, b, c] = matrix;
        let determinant = a * c - b * b;
        if !(determinant > 1e-12 * a * c) {
            break;
        }
        let step = [
            (c * vector[0] - b * vector[1]) / determinant,
            (a * vector[1] - b * vector[0]) / determinant,
        ];
        for i in 0..2 {
            angles[i] -= step[i].clamp(-2.0, 2.0);
        }
    }
    angles
}

/// Adds `weight` times the outer product of `slope` to a symmetric matrix `[xx, xy, yy]`.
fn accumulate(matrix: &mut [f64; 3], [x, y]: [f64; 2], weight: f64) {
    matrix[0] += weight * x * x;
    matrix[1] += weight * x * y;
    matrix[2] += weight * y * y;
}

fn tukey(residual: f64, most: f64) -> f64 {
    match residual.abs() < most {
        true => (1.0 - (residual / most).powi(2)).powi(2),
        false => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;
    use proptest::prelude::*;

    use super::*;
    use crate::segments::{tests::picture, upright};

    const SIZE: [f64; 2] = [640.0, 480.0];
    const FOCAL: f64 = 600.0;

    /// Where a camera at eye's height with this turn sees a point of the world.
    fn seen(pitch_deg: f64, roll_deg: f64, point: DVec3) -> DVec2 {
        let rotation = DMat3::from_rotation_x(pitch_deg.to_radians())
            * DMat3::from_rotation_z(-roll_deg.to_radians());
        let own = rotation.transpose() * point;
        DVec2::new(320.0, 240.0) + FOCAL * DVec2::new(own.x, -own.y) / -own.z
    }

    /// The segments that posts across the view are seen as.
    fn posts(pitch_deg: f64, roll_deg: f64) -> Vec<Segment> {
        (-4..=4)
            .map(|i| {
                let foot = DVec3::new(0.9 * f64::from(i), -1.0, -9.0 - 0.3 * f64::from(i));
                let [low, high] =
                    [0.0, 2.5].map(|y| seen(pitch_deg, roll_deg, foot + DVec3::Y * y));
                Segment {
                    middle: 0.5 * (low + high),
                    direction: (low - high).normalize(),
                    length: low.distance(high),
                }
            })
            .collect()
    }

    proptest! {
        #[test]
        fn posts_give_the_camera_s_turn(pitch in -25.0f64..25.0, roll in -6.0f64..6.0) {
            let found = turn(&posts(pitch, roll), SIZE, FOCAL, 0.0).unwrap();
            // Exact lines: what is left are the refinement's steps.
            prop_assert!((found.pitch_deg - pitch).abs() < 1e-3, "{:?}", found);
            prop_assert!((found.roll_deg - roll).abs() < 1e-3, "{:?}", found);
        }
    }

    #[test]
    fn leaning_things_among_posts_do_not_turn_the_camera() {
        let mut segments = posts(-8.0, 1.5);
        for i in 0..4 {
            let lean = (12.0 + 5.0 * f64::from(i)).to_radians();
            segments.push(Segment {
                middle: DVec2::new(100.0 + 90.0 * f64::from(i), 200.0),
                direction: DVec2::new(lean.sin(), lean.cos()),
                length: 60.0,
            });
        }
        let found = turn(&segments, SIZE, FOCAL, 0.0).unwrap();
        assert!((found.pitch_deg + 8.0).abs() < 0.1, "{found:?}");
        assert!((found.roll_deg - 1.5).abs() < 0.1, "{found:?}");
    }

    #[test]
    fn edges_in_all_directions_and_few_edges_say_nothing() {
        let scattered: Vec<Segment> = (0..40)
            .map(|i| {
                let lean = f64::from(i * 37 % 60 - 30).to_radians();
                let (x, y) = (f64::from(i * 131 % 640), f64::from(i * 71 % 480));
                Segment {
                    middle: DVec2::new(x, y),
                    direction: DVec2::new(lean.sin(), lean.cos()),
                    length: 50.0,
                }
            })
            .collect();
        assert_eq!(turn(&scattered, SIZE, FOCAL, 0.0), None);
        assert_eq!(turn(&posts(0.0, 0.0)[..5], SIZE, FOCAL, 0.0), None);
    }

    #[test]
    fn an_unknown_focal_length_makes_a_steep_pitch_unsure() {
        let level = turn(&posts(-2.0, 0.0), SIZE, FOCAL, 0.2).unwrap();
        assert!(level.pitch_sigma_deg > 0.4, "{level:?}");
        assert_eq!(turn(&posts(-20.0, 0.0), SIZE, FOCAL, 0.2), None);
    }

    #[test]
    fn a_picture_of_posts_gives_the_camera_s_turn() {
        let (pitch, roll) = (-12.0, 2.0);
        let edges: Vec<[DVec2; 2]> = (-4..=4)
            .map(|i| {
                let foot = DVec3::new(0.9 * f64::from(i), -1.6, -7.0);
                [0.0, 2.2].map(|y| seen(pitch, roll, foot + DVec3::Y * y))
            })
            .collect();
        // Strips of 14 pixels beside each line.
        let bars = picture(640, 480, |p| {
            edges.iter().any(|[low, high]| {
                let share = (p.y - high.y) / (low.y - high.y);
                let x = high.x + share * (low.x - high.x);
                (0.0..=1.0).contains(&share) && (0.0..14.0).contains(&(p.x - x))
            })
        });
        let found = turn(&upright(&bars), SIZE, FOCAL, 0.0).unwrap();
        // The far sides of the strips are off their line by 14 pixels: less than a degree.
        assert!((found.pitch_deg - pitch).abs() < 2.0, "{found:?}");
        assert!((found.roll_deg - roll).abs() < 0.5, "{found:?}");
    }
}
