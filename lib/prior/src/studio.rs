//! Training scenes: an object on textured ground among others, seen by a
//! camera that looks along -z.

use dipir_diffusion::noise::NoiseStream;
use dipir_scene::camera::{Camera, FieldOfView};
use dipir_scene::mesh::TriangleMesh;
use glam::{DMat4, DQuat, DVec3, Vec2, Vec3};

use crate::backdrop::Backdrop;
use crate::lights::{Sun, draw_suns};
use crate::shapes::Shape;
use crate::words::{COLORS, Gaze};

/// Suns for which every scene is recorded.
pub const SUNS: usize = 8;

/// What an object is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Paint {
    /// Linear base colour.
    pub color: Vec3,
    /// Linear roughness of the highlight.
    pub roughness: f32,
    /// Whether it reflects like a metal.
    pub metallic: bool,
    /// The word for the colour.
    pub word: &'static str,
}

/// What covers the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ground {
    colors: [Vec3; 2],
    pattern: Pattern,
    scale: f32,
    turn: Vec2,
    seed: u32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Pattern {
    Plain,
    Checkers,
    Stripes,
    Noise,
    Tiles,
}

/// Which solids may be drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kinds {
    /// Those of training.
    Trained,
    /// Main objects that training never showed.
    HeldOut,
}

/// How much of a place is seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum View {
    /// The object and its surroundings, as in training.
    Close,
    /// A photograph of the place: eight metres wide, with more objects.
    Wide,
}

/// Where the objects stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Setting {
    /// On open ground, seen from above.
    Open,
    /// In front of houses, trees and what else a street has, seen at eye level.
    Street,
}

/// What kind of scene is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Brief {
    /// Which solids.
    pub kinds: Kinds,
    /// Where they stand.
    pub setting: Setting,
    /// How much is seen.
    pub view: View,
}

/// A scene without its light.
#[derive(Debug, Clone)]
pub struct Stage {
    /// The object that is inserted.
    pub main: TriangleMesh,
    /// Its material.
    pub main_paint: Paint,
    /// Its kind.
    pub shape: Shape,
    /// What else stands there; triangle materials index `paints`.
    pub others: TriangleMesh,
    /// Materials of the others.
    pub paints: Vec<Paint>,
    /// The plane y = 0.
    pub ground: Ground,
    /// The view.
    pub camera: Camera,
    /// Suns for which it is recorded.
    pub suns: Vec<Sun>,
}

/// Draws of numbers.
pub(crate) struct Draw<'a>(&'a mut NoiseStream);

impl<'a> Draw<'a> {
    pub(crate) fn new(stream: &'a mut NoiseStream) -> Self {
        Self(stream)
    }
}

impl Draw<'_> {
    pub(crate) fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.0.uniform() as f32
    }

    pub(crate) fn below(&mut self, n: usize) -> usize {
        self.0.below(n)
    }

    pub(crate) fn chance(&mut self, share: f64) -> bool {
        self.0.uniform() < share
    }

    fn paint(&mut self) -> Paint {
        let index = self.below(COLORS.len());
        let vivid = self.range(0.45, 0.85);
        let dull = self.range(0.03, 0.16);
        let color = match COLORS[index] {
            "white" => Vec3::splat(self.range(0.62, 0.9)),
            "grey" => Vec3::splat(self.range(0.2, 0.42)),
            "black" => Vec3::splat(self.range(0.025, 0.09)),
            "red" => Vec3::new(vivid, dull, dull),
            "orange" => Vec3::new(vivid, 0.45 * vivid, dull),
            "yellow" => Vec3::new(vivid, 0.85 * vivid, dull),
            "green" => Vec3::new(dull, 0.8 * vivid, 1.2 * dull),
            _ => Vec3::new(dull, 1.5 * dull, vivid),
        };
        Paint {
            color,
            roughness: self.range(0.3, 0.9),
            metallic: self.range(0.0, 1.0) < 0.12,
            word: COLORS[index],
        }
    }

    fn ground(&mut self, setting: Setting) -> Ground {
        let hue = Vec3::new(
            self.range(0.6, 1.0),
            self.range(0.6, 1.0),
            self.range(0.55, 1.0),
        );
        let base = hue * self.range(0.1, 0.62);
        let other = base * self.range(0.45, 1.55)
            + Vec3::new(
                self.range(-0.04, 0.04),
                self.range(-0.04, 0.04),
                self.range(-0.04, 0.04),
            );
        let pattern = match self.range(0.0, 1.0) {
            x if x < 0.4 && setting == Setting::Street => Pattern::Tiles,
            x if x < 0.25 => Pattern::Plain,
            x if x < 0.37 => Pattern::Checkers,
            x if x < 0.49 => Pattern::Stripes,
            _ => Pattern::Noise,
        };
        let scale = if pattern == Pattern::Noise {
            self.range(0.5, 5.0)
        } else {
            self.range(0.5, 2.2)
        };
        let (s, c) = self.range(0.0, std::f32::consts::PI).sin_cos();
        Ground {
            colors: [base, other.clamp(Vec3::splat(0.03), Vec3::splat(0.9))],
            pattern,
            scale,
            turn: Vec2::new(c, s),
            seed: self.below(1 << 20) as u32,
        }
    }

    /// A solid at (x, z), and the radius that it covers.
    fn solid(&mut self, shape: Shape, at: Vec2) -> (TriangleMesh, f32) {
        let p = [
            self.range(0.0, 1.0),
            self.range(0.0, 1.0),
            self.range(0.0, 1.0),
        ];
        let mut mesh = shape.mesh(p);
        let size = self.range(0.7, 1.1) as f64;
        let turn = DQuat::from_rotation_y(self.range(0.0, std::f32::consts::TAU) as f64);
        mesh.transform(&DMat4::from_scale_rotation_translation(
            DVec3::splat(size),
            turn,
            DVec3::new(at.x as f64, 0.0, at.y as f64),
        ));
        let radius = mesh
            .corners()
            .map(|p| Vec2::new(p.x - at.x, p.z - at.y).length())
            .fold(0.0, f32::max);
        (mesh, radius)
    }
}

impl Stage {
    /// The scene number `index` under `seed`, for pictures of `size` pixels.
    pub fn draw(seed: u64, index: u64, size: u32, brief: Brief) -> Self {
        let Brief {
            kinds,
            setting,
            view,
        } = brief;
        let mut stream = NoiseStream::new(seed, index);
        let mut draw = Draw::new(&mut stream);
        let shape = match kinds {
            // Faces tell less of the light than shadows do, so half of the scenes are about them.
            Kinds::Trained => match draw.below(2) {
                0 => Shape::COMMON[draw.below(Shape::COMMON.len())],
                _ => Shape::FACETED[draw.below(Shape::FACETED.len())],
            },
            Kinds::HeldOut => Shape::HELD_OUT[draw.below(Shape::HELD_OUT.len())],
        };
        let (main, radius) = draw.solid(shape, Vec2::ZERO);
        let main_paint = draw.paint();
        let mut others = TriangleMesh::default();
        let mut paints = vec![];
        let mut placed = vec![(Vec2::ZERO, radius)];
        let (wanted, reach, attempts) = match view {
            View::Close => ([0, 1, 1, 2, 2, 2, 3, 3][draw.below(8)], 2.1, 12),
            View::Wide => ([3, 4, 4, 5, 5, 6, 6, 7][draw.below(8)], 3.4, 40),
        };
        let around = match kinds {
            Kinds::Trained => [&Shape::COMMON[..], &Shape::FACETED].concat(),
            Kinds::HeldOut => Shape::COMMON.to_vec(),
        };
        for _ in 0..attempts {
            if paints.len() == wanted {
                break;
            }
            let (angle, distance) = (
                draw.range(0.0, std::f32::consts::TAU),
                draw.range(0.9, reach),
            );
            let at = Vec2::from_angle(angle) * distance;
            let kind = around[draw.below(around.len())];
            let (mesh, r) = draw.solid(kind, at);
            let free = placed.iter().all(|(p, q)| p.distance(at) > r + q + 0.05);
            // Nothing between the camera and the main object.
            let in_front = at.y > -0.2 && at.x.abs() < radius + r;
            if free && !in_front {
                others.append(mesh, paints.len() as u32);
                paints.push(draw.paint());
                placed.push((at, r));
            }
        }
        let ground = draw.ground(setting);
        let (low, high) = match setting {
            Setting::Open => (10.0, 45.0),
            Setting::Street => (3.0, 25.0),
        };
        let pitch = draw.range(low, high).to_radians();
        let (distance, width) = match view {
            View::Close => (draw.range(4.0, 9.0), draw.range(2.8, 4.2)),
            View::Wide => (draw.range(8.0, 14.0), draw.range(7.0, 9.0)),
        };
        let target = Vec3::new(
            draw.range(-0.3, 0.3),
            draw.range(0.15, 0.5),
            draw.range(-0.3, 0.3),
        );
        let back = Vec3::new(0.0, pitch.sin(), pitch.cos());
        let camera = Camera::look_at(
            target + back * distance,
            target,
            Vec3::Y,
            FieldOfView::Vertical(2.0 * (0.5 * width / distance).atan()),
            [size, size],
        );
        let suns = draw_suns(SUNS, draw.0);
        if setting == Setting::Street {
            let near = match view {
                View::Close => 1.6,
                View::Wide => 3.4,
            };
            let behind = Backdrop::draw(&mut Draw::new(&mut stream), near, width);
            others.append(behind.mesh, paints.len() as u32);
            paints.extend(behind.paints);
        }
        Self {
            main,
            main_paint,
            shape,
            others,
            paints,
            ground,
            camera,
            suns,
        }
    }
}

/// How a camera looks at a scene: upright, and straight at the middle of its square picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outlook {
    /// Angle below the horizon, radians.
    pub pitch: f32,
    /// Tangent of half the picture's angle.
    pub reach: f32,
}

impl Outlook {
    /// Where a point of the picture lies, from -1 to 1 to the right and down.
    pub fn at(&self, x: f32, y: f32) -> Gaze {
        let (s, c) = self.pitch.sin_cos();
        let (x, y) = (x * self.reach, y * self.reach);
        Gaze::along(Vec3::new(x, -s - y * c, -c + y * s), Vec3::NEG_Z, Vec3::X)
    }
}

impl Stage {
    /// How its camera looks at it.
    pub fn outlook(&self) -> Outlook {
        Outlook {
            pitch: self.camera.rotation.z_axis.y.asin(),
            reach: 0.5 * self.camera.resolution[1] as f32 / self.camera.focal_px.y,
        }
    }
}

impl Ground {
    /// Linear albedo at (x, z), metres.
    pub fn albedo(&self, at: Vec2) -> Vec3 {
        let p = Vec2::new(self.turn.dot(at), self.turn.perp_dot(at)) * self.scale;
        let odd = |x: f32| (x.floor() as i64).rem_euclid(2) as f32;
        let mix = match self.pattern {
            Pattern::Plain => 0.0,
            Pattern::Checkers => (odd(p.x) - odd(p.y)).abs(),
            Pattern::Stripes => odd(p.x),
            Pattern::Tiles => {
                // Every second row is shifted by half a tile; joints are dark.
                let row = (2.0 * p.y).floor();
                let along = p.x + 0.5 * odd(row);
                let (across, within) = (2.0 * p.y - row, along - along.floor());
                if across < 0.1 || within < 0.05 {
                    return self.colors[0].min(self.colors[1]) * 0.4;
                }
                value_noise(Vec2::new(along.floor(), row), self.seed)
            }
            Pattern::Noise => {
                0.6 * value_noise(p, self.seed) + 0.4 * value_noise(p * 2.3, self.seed ^ 0x5bd1)
            }
        };
        self.colors[0].lerp(self.colors[1], mix)
    }
}

/// Smoothly interpolated random values on the integer grid, in [0, 1].
fn value_noise(p: Vec2, seed: u32) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let f = f * f * (3.0 - 2.0 * f);
    let at = |dx: i32, dy: i32| {
        let x = (cell.x as i32 + dx) as u64 & 0xffff_ffff;
        let y = (cell.y as i32 + dy) as u64 & 0xffff_ffff;
        let h = dipir_numerics::hashing::mix64((x << 32 | y) ^ ((seed as u64) << 17));
        (h >> 40) as f32 / (1u64 << 24) as f32
    };
    let (low, high) = (
        at(0, 0) + (at(1, 0) - at(0, 0)) * f.x,
        at(0, 1) + (at(1, 1) - at(0, 1)) * f.x,
    );
    low + (high - low) * f.y
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_of_the_picture_lie_where_the_rays_of_the_camera_go() {
        for (index, setting) in [(0, Setting::Open), (1, Setting::Street)] {
            let brief = Brief {
                kinds: Kinds::HeldOut,
                setting,
                view: View::Wide,
            };
            let stage = Stage::draw(7, index, 40, brief);
            for (x, y) in [(0.0, 0.0), (-1.0, 0.5), (0.7, -1.0), (1.0, 1.0)] {
                let ray = stage
                    .camera
                    .ray(Vec2::new(20.0 + 20.0 * x, 20.0 + 20.0 * y));
                let wanted = Gaze::along(ray.direction, Vec3::NEG_Z, Vec3::X);
                let found = stage.outlook().at(x, y);
                let off = (found.heading - wanted.heading).hypot(found.pitch - wanted.pitch);
                assert!(off < 1e-5, "{found:?} {wanted:?}");
            }
        }
    }

    #[test]
    fn what_lies_to_the_right_and_low_in_the_picture_has_a_heading_and_more_pitch() {
        let outlook = Outlook {
            pitch: 0.3,
            reach: 0.5,
        };
        assert!((outlook.at(0.0, 0.0).pitch - 0.3).abs() < 1e-6);
        // Half the picture's angle further down.
        assert!((outlook.at(0.0, 1.0).pitch - 0.3 - 0.5f32.atan()).abs() < 1e-6);
        assert_eq!(outlook.at(0.0, -1.0).heading, 0.0);
        // Level with the camera's right, half as far as what lies ahead.
        let level = Outlook {
            pitch: 0.0,
            ..outlook
        };
        assert!((level.at(1.0, 0.0).heading - 0.5f32.atan()).abs() < 1e-6);
    }
}
