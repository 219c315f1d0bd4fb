//! A small car, modelled as solids: no brand's, any street's.
//!
//! x is its left, y up, z forward; the wheels stand on y = 0. The body is one half and its mirror
//! image; the four wheels are one mesh.
use dipir_scene::mesh::TriangleMesh;
use glam::{Vec2, Vec3};

use crate::mesher::{Field, Side, mesh};
use crate::seams::ribbon;
use crate::simplify::simplify;
use crate::solids::*;

/// Distance of the axles from the middle, metres.
const FRONT_AXLE: f32 = 1.27;
const REAR_AXLE: f32 = -1.25;
const WHEEL_RADIUS: f32 = 0.325;
/// Radius of the wheel wells.
const WELL_RADIUS: f32 = 0.375;
/// Distance of a wheel's middle plane from the car's.
const TRACK_HALF: f32 = 0.745;

const fn v(x: f32, y: f32) -> Vec2 {
    Vec2::new(x, y)
}

/// Side view (z, y) of the body below the windows, from the front bumper around.
const LOWER: [Vec2; 12] = [
    v(1.93, 0.19),
    v(2.04, 0.30),
    v(2.08, 0.50),
    v(2.02, 0.68),
    v(1.86, 0.775),
    v(1.45, 0.875),
    v(0.98, 0.945),
    v(-1.60, 0.985),
    v(-1.93, 0.93),
    v(-2.03, 0.66),
    v(-2.00, 0.34),
    v(-1.90, 0.21),
];

/// Side view of the cabin.
const CABIN: [Vec2; 7] = [
    v(1.16, 0.86),
    v(0.30, 1.375),
    v(-0.10, 1.455),
    v(-0.95, 1.44),
    v(-1.52, 1.30),
    v(-1.93, 0.90),
    v(-1.80, 0.80),
];

/// Side view of the windows, front and rear.
const FRONT_WINDOW: [Vec2; 4] = [
    v(0.76, 0.99),
    v(0.10, 1.345),
    v(-0.36, 1.375),
    v(-0.36, 0.985),
];
const REAR_WINDOW: [Vec2; 4] = [
    v(-0.44, 0.99),
    v(-0.44, 1.375),
    v(-1.03, 1.355),
    v(-1.42, 1.03),
];

fn half_width(z: f32, y: f32) -> f32 {
    let nose = ((z - 0.9) / 1.2).max(0.0);
    let tail = ((-z - 1.0) / 1.1).max(0.0);
    let plan = 0.885 - 0.20 * nose.powf(2.6) - 0.13 * tail.powf(2.6);
    let tuck = 0.07 * ((0.52 - y) / 0.34).max(0.0).powi(2);
    let shoulder = 0.055 * ((y - 0.70) / 0.26).max(0.0).powi(2);
    // A crease along the flank and lips around the wheels catch the light.
    let crease = 0.012 * (-((y - 0.66 - 0.02 * z) / 0.05).powi(2)).exp();
    let waist = -0.018 * (-((y - 0.47) / 0.13).powi(2)).exp() * (1.0 - nose) * (1.0 - tail);
    let lip = |axle: f32| {
        let r = Vec2::new(z - axle, y - WHEEL_RADIUS).length();
        0.028 * (-((r - WELL_RADIUS) / 0.085).powi(2)).exp()
    };
    plan - tuck - shoulder + crease + waist + lip(FRONT_AXLE).max(lip(REAR_AXLE))
}

fn cabin_half_width(z: f32, y: f32) -> f32 {
    let rise = (y - 0.93) / 0.5;
    let front = ((z - 0.2) / 0.9).max(0.0);
    let rear = ((-z - 0.8) / 1.1).max(0.0);
    0.80 - 0.19 * rise - 0.05 * rise.max(0.0).powi(3) - 0.10 * front.powi(2) - 0.10 * rear.powi(2)
}

/// The body before anything is cut out of it.
fn shell(p: Vec3) -> f32 {
    let side = v(p.z, p.y);
    let x = p.x.abs();
    let lower = smooth_intersection(
        rounded_polygon(side, &LOWER, 0.07),
        x - half_width(p.z, p.y),
        0.10,
    );
    // The windscreen and the roof are arched: seen from above the cabin bulges forward.
    let arched = v(p.z + 0.16 * p.x * p.x, p.y + 0.07 * p.x * p.x);
    let cabin = smooth_intersection(
        rounded_polygon(arched, &CABIN, 0.10),
        x - cabin_half_width(p.z, p.y),
        0.13,
    );
    smooth_union(lower, cabin, 0.05)
}

/// Cuts `region` out of the outer `depth` metres of the shell.
fn inlay(shell: f32, region: f32, depth: f32) -> f32 {
    region.max(-(shell + depth))
}

fn side_windows(p: Vec3) -> f32 {
    let side = v(p.z, p.y);
    let windows =
        rounded_polygon(side, &FRONT_WINDOW, 0.05).min(rounded_polygon(side, &REAR_WINDOW, 0.05));
    windows.max(0.45 - p.x.abs())
}

fn windscreen(p: Vec3) -> f32 {
    let half = 0.66 - 0.30 * (p.y - 0.93);
    let height = (p.y - 1.165).abs() - 0.185;
    smooth_intersection(p.x.abs() - half, height, 0.08).max(0.25 - p.z)
}

fn rear_screen(p: Vec3) -> f32 {
    let half = 0.56 - 0.20 * (p.y - 1.0);
    let height = (p.y - 1.19).abs() - 0.135;
    smooth_intersection(p.x.abs() - half, height, 0.10).max(p.z + 1.35)
}

fn headlamp(p: Vec3) -> f32 {
    let q = v(p.x.abs() - 0.575, p.y - 0.655 - 0.10 * (p.x.abs() - 0.575));
    ((q / v(0.165, 0.075)).length() - 1.0) * 0.075
}

fn headlamps(p: Vec3) -> f32 {
    headlamp(p).max(1.3 - p.z)
}

fn tail_lamps(p: Vec3) -> f32 {
    let q = v(p.x.abs() - 0.60, p.y - 0.78).abs() - v(0.13, 0.085) + 0.04;
    (q.max(Vec2::ZERO).length() - 0.04).max(p.z + 1.5)
}

fn grille(p: Vec3) -> f32 {
    let q = v(p.x, p.y - 0.40).abs() - v(0.50, 0.085) + 0.05;
    let lower = q.max(Vec2::ZERO).length() - 0.05;
    let q = v(p.x, p.y - 0.625).abs() - v(0.30, 0.028) + 0.02;
    let upper = q.max(Vec2::ZERO).length() - 0.02;
    lower.min(upper).max(1.5 - p.z)
}

fn plate_recess(p: Vec3) -> f32 {
    let q = v(p.x, p.y - 0.60).abs() - v(0.30, 0.09) + 0.03;
    (q.max(Vec2::ZERO).length() - 0.03).max(p.z + 1.5)
}

fn wells(p: Vec3) -> f32 {
    let well = |axle: f32| {
        let q = p - Vec3::new(0.0, WHEEL_RADIUS, axle);
        let across = Vec2::new(q.y, q.z).length() - WELL_RADIUS;
        across.max(0.52 - p.x.abs())
    };
    well(FRONT_AXLE).min(well(REAR_AXLE))
}

/// Side windows, windscreen and rear screen.
fn glazing(p: Vec3) -> f32 {
    side_windows(p).min(windscreen(p)).min(rear_screen(p))
}

fn painted(p: Vec3) -> f32 {
    let shell = shell(p);
    // Edges are rounder than a cell of the mesh is wide, .015 m: sharper ones become rows of beads.
    let mut d = smooth_difference(shell, inlay(shell, glazing(p), 0.025), 0.02);
    let lamps = headlamps(p).min(tail_lamps(p)).min(plate_recess(p));
    d = smooth_difference(d, inlay(shell, lamps, 0.025), 0.02);
    d = smooth_difference(d, inlay(shell, grille(p), 0.06), 0.012);
    smooth_difference(d, wells(p), 0.012)
}

/// What is seen through windows, grille and wells, and the sill under the doors.
fn glazed(p: Vec3) -> f32 {
    let deep = shell(p) + 0.012;
    let near = glazing(p) - 0.03;
    deep.max(near).max(-(shell(p) + 0.06))
}

/// Rubber seals along the edges of windows and lamps.
fn seals(p: Vec3) -> f32 {
    let tube = |edge: f32, radius: f32| Vec2::new(edge, shell(p) + 0.006).length() - radius;
    tube(glazing(p), 0.011).min(tube(headlamps(p).min(tail_lamps(p)), 0.006))
}

fn trim(p: Vec3) -> f32 {
    let shell = shell(p);
    let grille_bars = {
        let bars = ((p.y / 0.034).fract() - 0.5).abs() * 0.034 - 0.007;
        inlay(shell + 0.02, (grille(p) - 0.02).max(bars), 0.05).max(shell + 0.015)
    };
    let grille_back = (shell + 0.05).max(grille(p) - 0.03).max(-(shell + 0.09));
    let sill = {
        let side = rounded_box(
            v3(p.x.abs() - 0.80, p.y - 0.215, p.z),
            Vec3::new(0.055, 0.045, 0.86),
            0.03,
        );
        side.min(rounded_box(
            v3(p.x.abs(), p.y - 0.24, p.z),
            Vec3::new(0.74, 0.06, 1.75),
            0.05,
        ))
    };
    let splitter = rounded_box(
        v3(p.x.abs(), p.y - 0.205, p.z - 1.88),
        v3(0.60, 0.03, 0.12),
        0.03,
    );
    let plate = rounded_box(v3(p.x, p.y - 0.60, p.z + 2.0), v3(0.27, 0.06, 0.02), 0.01);
    grille_bars
        .min(grille_back)
        .min(smooth_difference(sill, wells(p), 0.01))
        .min(splitter)
        .max(-plate)
}

const fn v3(x: f32, y: f32, z: f32) -> Vec3 {
    Vec3::new(x, y, z)
}

fn mirror(p: Vec3) -> f32 {
    let q = p - v3(0.955, 1.02, 0.62);
    let housing = ellipsoid(q, v3(0.10, 0.075, 0.065)).max(-q.z - 0.035);
    let arm = rounded_box(p - v3(0.83, 0.985, 0.64), v3(0.07, 0.014, 0.03), 0.012);
    smooth_union(housing, arm, 0.03)
}

fn handle(p: Vec3) -> f32 {
    let bar = |z: f32| {
        let x = half_width(z, 0.82) - 0.004;
        rounded_box(p - v3(x, 0.82, z), v3(0.014, 0.013, 0.085), 0.011)
    };
    bar(-0.20).min(bar(-1.18))
}

fn tyre(p: Vec3) -> f32 {
    let body = wheel_disc(p, WHEEL_RADIUS, 0.105, 0.045);
    let opening = Vec2::new(p.y, p.z).length() - 0.232;
    smooth_difference(body, opening, 0.02)
}

/// Spokes point towards +x, the outer face.
fn rim(p: Vec3) -> f32 {
    let r = Vec2::new(p.y, p.z).length();
    let barrel = ((r - 0.226).abs() - 0.012).max(p.x.abs() - 0.098);
    let dish = 0.070 - 0.035 * smoothstep(0.05, 0.20, r);
    // Five pairs of spokes: fold the angle into one of five sectors.
    let sector = std::f32::consts::TAU / 5.0;
    let angle = p.z.atan2(p.y);
    let folded = (angle + 10.0 * sector + 0.5 * sector).rem_euclid(sector) - 0.5 * sector;
    let (s, c) = folded.sin_cos();
    let q = v(r * s, r * c);
    let offset = q.x.abs() - 0.014 - 0.20 * q.y;
    let spoke = (offset.abs() - 0.017)
        .max(r - 0.23)
        .max((p.x - dish).abs() - 0.018);
    let hub = (r - 0.062).max((p.x - 0.060).abs() - 0.024);
    let cap = ellipsoid(p - v3(0.082, 0.0, 0.0), v3(0.018, 0.032, 0.032));
    let brake = (r - 0.165).max((p.x + 0.01).abs() - 0.012).max(0.07 - r);
    smooth_union(smooth_union(spoke, hub, 0.02), barrel, 0.02)
        .min(cap)
        .min(brake)
}

/// One mesh of the car with one material.
pub struct Part {
    /// Its material.
    pub material: CarMaterial,
    /// A wheel's around its own centre; the body's half with `x >= 0`.
    pub mesh: TriangleMesh,
}

/// What a part is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CarMaterial {
    /// Lacquered sheet metal.
    Paint,
    /// Tinted glass.
    Glass,
    /// Rough plastic.
    Trim,
    /// Chrome behind clear plastic.
    Lamp,
    /// Red plastic.
    TailLamp,
    /// White enamel.
    Plate,
    /// Rubber.
    Tyre,
    /// Brushed alloy.
    Rim,
}

impl CarMaterial {
    /// All of them, in the order of the file.
    pub const ALL: [Self; 8] = [
        Self::Paint,
        Self::Glass,
        Self::Trim,
        Self::Lamp,
        Self::TailLamp,
        Self::Plate,
        Self::Tyre,
        Self::Rim,
    ];
}

fn part_mesh(field: Field, low: Vec3, high: Vec3, step: f32, side: Side) -> TriangleMesh {
    simplify(mesh(field, low, high, step, side), field, step)
}

/// Gaps around doors and bonnet, on the half with `x >= 0`.
fn seams() -> TriangleMesh {
    let side = |corners: &[(f32, f32)]| {
        let corners: Vec<Vec3> = corners.iter().map(|&(z, y)| v3(0.0, y, z)).collect();
        ribbon(&shell, &corners, Vec3::X)
    };
    let top = |corners: &[(f32, f32)]| {
        let corners: Vec<Vec3> = corners.iter().map(|&(x, z)| v3(x, 0.0, z)).collect();
        ribbon(&shell, &corners, Vec3::Y)
    };
    let lines = [
        // Front edge of the front door, sill, rear edge of the rear door.
        side(&[
            (0.82, 0.955),
            (0.84, 0.80),
            (0.80, 0.55),
            (0.74, 0.34),
            (0.66, 0.295),
        ]),
        side(&[
            (0.66, 0.295),
            (-0.40, 0.285),
            (-0.78, 0.295),
            (-0.84, 0.36),
            (-0.90, 0.56),
        ]),
        side(&[(-0.90, 0.56), (-1.04, 0.72), (-1.28, 0.84), (-1.42, 0.97)]),
        // Between the doors.
        side(&[(-0.40, 0.975), (-0.40, 0.60), (-0.39, 0.285)]),
        // Bonnet.
        top(&[(0.67, 1.02), (0.70, 1.30), (0.66, 1.62), (0.52, 1.86)]),
        top(&[(0.52, 1.86), (0.30, 1.935), (0.0, 1.955)]),
    ];
    let mut seams = TriangleMesh::default();
    for line in lines {
        dipir_render::shapes::append(&mut seams, line, 0);
    }
    seams
}

/// The parts that make the body; `step` is the size of their details, metres.
pub fn body(step: f32) -> Vec<Part> {
    let low = v3(0.0, 0.10, -2.20);
    let high = v3(1.10, 1.55, 2.20);
    let half = |material, field: &(dyn Fn(Vec3) -> f32 + Sync), step| Part {
        material,
        mesh: part_mesh(field, low, high, step, Side::PositiveX),
    };
    let lamps = |p: Vec3| {
        let s = shell(p);
        (s + 0.010).max(headlamps(p) - 0.03).max(-(s + 0.05))
    };
    let tail = |p: Vec3| {
        let s = shell(p);
        (s + 0.010).max(tail_lamps(p) - 0.03).max(-(s + 0.05))
    };
    let plate = |p: Vec3| {
        let s = shell(p);
        let front = rounded_box(v3(p.x, p.y - 0.50, p.z - 2.05), v3(0.26, 0.055, 0.20), 0.01);
        let rear = rounded_box(v3(p.x, p.y - 0.60, p.z + 2.05), v3(0.26, 0.055, 0.20), 0.01);
        let front = front.max(s - 0.008).max(-(s + 0.012));
        let rear = rear.max(s + 0.012).max(-(s + 0.035));
        front.min(rear)
    };
    let fittings = |p: Vec3| mirror(p).min(handle(p));
    vec![
        half(CarMaterial::Paint, &painted, step),
        half(CarMaterial::Paint, &fittings, 0.7 * step),
        half(CarMaterial::Glass, &glazed, 1.3 * step),
        half(CarMaterial::Trim, &trim, step),
        half(CarMaterial::Trim, &seals, 0.4 * step),
        half(CarMaterial::Lamp, &lamps, step),
        half(CarMaterial::TailLamp, &tail, step),
        half(CarMaterial::Plate, &plate, step),
        Part {
            material: CarMaterial::Trim,
            mesh: seams(),
        },
    ]
}

/// The parts of one wheel, around its own centre.
pub fn wheel(step: f32) -> Vec<Part> {
    let reach = v3(0.13, 0.36, 0.36);
    let part = |material, field: &(dyn Fn(Vec3) -> f32 + Sync)| Part {
        material,
        mesh: part_mesh(field, -reach, reach, step, Side::Whole),
    };
    vec![part(CarMaterial::Tyre, &tyre), part(CarMaterial::Rim, &rim)]
}

/// Where the wheels' centres are, and whether a wheel is turned half around to face outwards.
pub fn wheel_places() -> [(Vec3, bool); 4] {
    [
        (v3(TRACK_HALF, WHEEL_RADIUS, FRONT_AXLE), false),
        (v3(-TRACK_HALF, WHEEL_RADIUS, FRONT_AXLE), true),
        (v3(TRACK_HALF, WHEEL_RADIUS, REAR_AXLE), false),
        (v3(-TRACK_HALF, WHEEL_RADIUS, REAR_AXLE), true),
    ]
}
