//! Grid, horizon, boxes and metre stick of an arrangement.
use dipir_scene::camera::Camera;
use dipir_scene::pixels::horizon_row;
use dipir_scene::proxy::Plane;
use glam::{DQuat, DVec2, DVec3};

use crate::arrangement::{Arrangement, Placed};
use crate::lines::{Kind, Piece, segment};

/// Text beside a place of the picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Label {
    /// The middle of its lower border, pixels of the photograph.
    pub at: DVec2,
    /// What it says.
    pub text: String,
}

/// Lines of the grid closer than this, as a share of the picture's longer side, are not drawn.
const CLOSEST: f64 = 0.004;
/// From this share on they are drawn in full.
const APART: f64 = 0.02;

/// The ground's grid.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// Its lines.
    pub pieces: Vec<Piece>,
    /// Between two lines, metres.
    pub spacing_m: f64,
}

impl Grid {
    /// Lines a metre apart, every fifth one heavier, that fade where they crowd; of .1 or 10 metres
    /// where the `focus` is much nearer or farther than people stand.
    pub fn new(camera: &Camera, ground: &Plane, focus: Option<DVec3>) -> Self {
        let normal = ground.normal.as_dvec3();
        let upright = DQuat::from_rotation_arc(DVec3::Y, normal);
        let (u, v) = (upright * DVec3::X, upright * DVec3::Z);
        let origin = ground.point.as_dvec3();
        let eye = camera.position.as_dvec3();
        let height = normal.dot(eye - origin);
        let reach = focus.map_or(height, |f| f.distance(eye));
        let spacing_m = match reach {
            r if r < 0.8 => 0.1,
            r if r < 60.0 => 1.0,
            _ => 10.0,
        };
        let mut pieces = Vec::new();
        if height > 0.0 {
            let center = [u.dot(eye - origin), v.dot(eye - origin)];
            for (along, across, middle) in [(u, v, center), (v, u, [center[1], center[0]])] {
                for (kind, every) in [(Kind::Grid, 1), (Kind::MainGrid, 5)] {
                    let family = Family {
                        camera,
                        origin,
                        along,
                        across,
                        middle,
                        height,
                        spacing: spacing_m * f64::from(every),
                        kind,
                        skip_fifths: kind == Kind::Grid,
                    };
                    family.draw(&mut pieces);
                }
            }
        }
        Self { pieces, spacing_m }
    }
}

/// Parallel lines of the grid.
struct Family<'a> {
    camera: &'a Camera,
    origin: DVec3,
    /// Direction of the lines.
    along: DVec3,
    /// Direction from one to the next.
    across: DVec3,
    /// The camera's coordinates along and across.
    middle: [f64; 2],
    height: f64,
    spacing: f64,
    kind: Kind,
    /// Whether every fifth line belongs to another family.
    skip_fifths: bool,
}

impl Family<'_> {
    fn draw(&self, pieces: &mut Vec<Piece>) {
        let side = f64::from(self.camera.resolution[0].max(self.camera.resolution[1]));
        let focal = f64::from(self.camera.focal_px.max_element());
        // Lines across the view are focal * spacing * height / distance^2 apart.
        let radius = (focal * self.spacing * self.height / (CLOSEST * side)).sqrt();
        let radius = radius.max(2.0 * self.spacing);
        let whole = |x: f64| (x / self.spacing).round() as i64;
        let count = (radius / self.spacing).ceil().min(200.0) as i64;
        let step = radius / 48.0;
        let middle = whole(self.middle[1]);
        for k in middle - count..=middle + count {
            if self.skip_fifths && k % 5 == 0 {
                continue;
            }
            let line = self.origin + self.across * (k as f64 * self.spacing);
            for n in -48..48 {
                let at = |n: i32| line + self.along * (self.middle[0] + f64::from(n) * step);
                if let Some([from, to]) = segment(self.camera, at(n), at(n + 1)) {
                    let opacity = self.opacity(0.5 * (at(n) + at(n + 1)), to - from, side, radius);
                    if opacity > 0.02 {
                        pieces.push(Piece {
                            kind: self.kind,
                            from,
                            to,
                            opacity,
                        });
                    }
                }
            }
        }
    }

    /// Less where the next line is close, and towards the rim.
    fn opacity(&self, point: DVec3, drawn: DVec2, side: f64, radius: f64) -> f32 {
        let project = |p: DVec3| self.camera.project(p.as_vec3()).map(|p| p.as_dvec2());
        let next = point + self.across * self.spacing;
        let apart = match (project(point), project(next)) {
            (Some(p), Some(q)) => (q - p).perp_dot(drawn.normalize_or_zero()).abs(),
            _ => side,
        };
        let crowded = ((apart / side - CLOSEST) / (APART - CLOSEST)).clamp(0.0, 1.0);
        let foot = self.origin + self.along * self.middle[0] + self.across * self.middle[1];
        let rim = (1.25 - 1.25 * point.distance(foot) / radius).clamp(0.0, 1.0);
        (crowded * rim) as f32
    }
}

/// The ground's horizon, in pieces.
pub fn horizon(camera: &Camera, ground: &Plane) -> Vec<Piece> {
    const PIECES: u32 = 32;
    let [width, height] = camera.resolution.map(f64::from);
    let point = |k: u32| {
        let x = width * f64::from(k) / f64::from(PIECES);
        let y = horizon_row(camera, ground, x)?;
        (0.0..height).contains(&y).then(|| DVec2::new(x, y))
    };
    let pieces = (0..PIECES).filter_map(|k| {
        Some(Piece {
            kind: Kind::Horizon,
            from: point(k)?,
            to: point(k + 1)?,
            opacity: 1.0,
        })
    });
    pieces.collect()
}

/// An object's box, its front marked by the lower front edge and an arrow on the ground.
pub fn outline(camera: &Camera, object: &Placed) -> Vec<Piece> {
    let corners = object.corners();
    let mut pieces = Vec::new();
    let mut add = |kind, a: DVec3, b: DVec3| {
        // Short pieces, so that a lens may bend them.
        const PARTS: u32 = 6;
        let at = |k: u32| a.lerp(b, f64::from(k) / f64::from(PARTS));
        for k in 0..PARTS {
            if let Some([from, to]) = segment(camera, at(k), at(k + 1)) {
                pieces.push(Piece {
                    kind,
                    from,
                    to,
                    opacity: 1.0,
                });
            }
        }
    };
    for a in 0..8usize {
        for bit in 0..3 {
            let b = a | 1 << bit;
            if a != b && (a, b) != (4, 5) {
                add(Kind::Box, corners[a], corners[b]);
            }
        }
    }
    add(Kind::Front, corners[4], corners[5]);
    let size = object.size();
    let start = 0.5 * (corners[4] + corners[5]);
    let length = (0.3 * size.x.max(size.z)).max(0.02 * size.y);
    let (front, right) = (object.axes.z_axis, object.axes.x_axis);
    let tip = start + front * length;
    add(Kind::Front, start, tip);
    for side in [-1.0, 1.0] {
        let barb = tip - front * (0.35 * length) + right * (0.22 * length * side);
        add(Kind::Front, tip, barb);
    }
    pieces
}

/// A stick of a metre (or of .1 or 10) that stands at the foot of `object`, with its label. `None`
/// where it is not seen.
pub fn stick(camera: &Camera, object: &Placed) -> Option<(Vec<Piece>, Label)> {
    let project = |p: DVec3| camera.project(p.as_vec3()).map(|p| p.as_dvec2());
    let corners = object.corners();
    // The lower corner that is farthest right in the picture, and a little beyond.
    let feet = [0usize, 1, 4, 5].map(|k| corners[k]);
    let middle = 0.25 * feet.iter().sum::<DVec3>();
    let rightmost = feet
        .iter()
        .filter_map(|&p| Some((project(p)?, p)))
        .max_by(|a, b| a.0.x.total_cmp(&b.0.x))?;
    let foot = rightmost.1 + 0.15 * (rightmost.1 - middle);
    let up = object.axes.y_axis;
    let tall = |m: f64| Some(project(foot + up * m)?.distance(project(foot)?));
    let picture = f64::from(camera.resolution[1]);
    let fits = |m: f64| tall(m).is_some_and(|t| t > 0.02 * picture && t < 0.6 * picture);
    let length = [1.0, 0.1, 10.0].into_iter().find(|&m| fits(m))?;
    let top = foot + up * length;
    let sideways = camera.rotation.x_axis.as_dvec3() * length;
    let mut pieces = Vec::new();
    let mut add = |a: DVec3, b: DVec3| {
        if let Some([from, to]) = segment(camera, a, b) {
            pieces.push(Piece {
                kind: Kind::Stick,
                from,
                to,
                opacity: 1.0,
            });
        }
    };
    add(foot, top);
    // Ticks at every tenth where they stand apart, longer at both ends and the middle.
    let every = if tall(length)? > 0.06 * picture { 1 } else { 5 };
    for k in (0..=10).step_by(every) {
        let half = if k % 5 == 0 { 0.05 } else { 0.025 };
        let at = foot + up * (length * f64::from(k) / 10.0);
        add(at - sideways * half, at + sideways * half);
    }
    let text = match length {
        m if m < 1.0 => "10 cm".into(),
        m => format!("{m:.0} m"),
    };
    let label = Label {
        at: project(top)? - DVec2::new(0.0, 0.008 * picture),
        text,
    };
    Some((pieces, label))
}

/// Everything that is drawn of an arrangement.
#[derive(Clone, Debug, PartialEq)]
pub struct Marks {
    /// Lines.
    pub pieces: Vec<Piece>,
    /// Texts.
    pub labels: Vec<Label>,
    /// Between two lines of the grid, metres.
    pub spacing_m: f64,
}

impl Marks {
    /// Grid, horizon, boxes and, at the first object, a stick.
    pub fn of(arrangement: &Arrangement) -> Self {
        let camera = &arrangement.camera;
        let ground = arrangement.ground();
        let focus = arrangement.objects.first().map(|o| o.contact);
        let grid = Grid::new(camera, &ground, focus);
        let mut marks = Self {
            pieces: grid.pieces,
            labels: Vec::new(),
            spacing_m: grid.spacing_m,
        };
        marks.pieces.extend(horizon(camera, &ground));
        for object in &arrangement.objects {
            marks.pieces.extend(outline(camera, object));
        }
        if let Some((pieces, label)) = arrangement.objects.first().and_then(|o| stick(camera, o)) {
            marks.pieces.extend(pieces);
            marks.labels.push(label);
        }
        marks
    }
}
