//! Training scenes: an object on textured ground among others, seen by a
//! camera that looks along -z.

use dipir_diffusion::noise::NoiseStream;
use dipir_scene::camera::{Camera, FieldOfView};
use dipir_scene::mesh::TriangleMesh;
use glam::{DMat4, DQuat, DVec3, Vec2, Vec3};

use crate::backdrop::Backdrop;
use crate::lights::{SUN_HEIGHTS, Sun, draw_suns};
use crate::shapes::Shape;
use crate::words::{COLORS, Gaze};
use crate::yard::Clearing;

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
    wear: Wear,
}

/// What use and weather leave on a ground, in shares of its albedo.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Wear {
    /// Fine mottling.
    grain: f32,
    /// Dark patches with clear edges, which are no shadows.
    stains: f32,
    /// How much darker the ground is on one side of a line, 1 for six tenths.
    kerb: f32,
    /// Where that line runs, metres from the origin.
    offset: f32,
}

/// What else the sky shows to who looks at it; what it lights the place with is the light's.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SkyLook {
    /// Radiance next to the sun for an irradiance of 1, per steradian.
    glow: f32,
    /// How fast that falls, per radian.
    fall: f32,
    /// How much clouds add and take away, in shares of the radiance.
    clouds: f32,
    seed: u32,
}

impl SkyLook {
    /// The radiance that the sun adds in `direction`, for an irradiance of 1 on what faces it.
    pub fn around_sun(&self, direction: Vec3, sun: Vec3) -> f32 {
        let angle = direction.dot(sun).clamp(-1.0, 1.0).acos();
        self.glow * (-self.fall * angle).exp()
    }

    /// The factor on the sky's radiance in `direction`.
    pub fn cover(&self, direction: Vec3) -> f32 {
        if self.clouds == 0.0 {
            return 1.0;
        }
        // Clouds are a layer: towards the horizon they lie closer together.
        let at = Vec2::new(direction.x, direction.z) * (3.0 / (direction.y + 0.15));
        let noise = 0.6 * value_noise(at, self.seed) + 0.4 * value_noise(at * 2.7, self.seed ^ 1);
        1.0 + self.clouds * (2.0 * noise - 1.0)
    }
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
    /// Among things of all sizes, walls on any side and the shadows of what is out of sight, seen from near or far.
    Yard,
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
    /// What the sky shows.
    pub sky: SkyLook,
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

    pub(crate) fn paint(&mut self) -> Paint {
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
            x if x < 0.4 && setting != Setting::Open => Pattern::Tiles,
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
            wear: match setting {
                Setting::Open | Setting::Street => Wear::default(),
                Setting::Yard => self.wear(),
            },
        }
    }

    fn wear(&mut self) -> Wear {
        let mut one_in_two = |high: f32| match self.chance(0.5) {
            true => self.range(0.0, high),
            false => 0.0,
        };
        Wear {
            grain: one_in_two(0.7),
            stains: one_in_two(0.6),
            kerb: one_in_two(1.0),
            offset: self.range(-3.0, 3.0),
        }
    }

    fn sky_look(&mut self) -> SkyLook {
        SkyLook {
            glow: self.range(0.0, 0.4),
            fall: self.range(1.5, 4.0),
            clouds: self.range(0.0, 0.6),
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
        let (low, high) = match (setting, view) {
            (Setting::Open, _) => (10.0, 45.0),
            (Setting::Street, _) | (Setting::Yard, View::Wide) => (3.0, 25.0),
            (Setting::Yard, View::Close) => (1.0, 45.0),
        };
        let pitch = draw.range(low, high).to_radians();
        let (distance, width) = match (setting, view) {
            (_, View::Wide) => (draw.range(8.0, 14.0), draw.range(7.0, 9.0)),
            (Setting::Yard, View::Close) => {
                let distance = draw.range(2.5f32.ln(), 18f32.ln()).exp();
                (distance, (distance * draw.range(0.15, 0.7)).clamp(1.2, 9.0))
            }
            (_, View::Close) => (draw.range(4.0, 9.0), draw.range(2.8, 4.2)),
        };
        // What is looked at need not be the object.
        let aside = match (setting, view) {
            (Setting::Yard, View::Close) => 0.25 * width,
            _ => 0.3,
        };
        let target = Vec3::new(
            draw.range(-aside, aside),
            draw.range(0.15, 0.5),
            draw.range(-aside, aside),
        );
        let back = Vec3::new(0.0, pitch.sin(), pitch.cos());
        let camera = Camera::look_at(
            target + back * distance,
            target,
            Vec3::Y,
            FieldOfView::Vertical(2.0 * (0.5 * width / distance).atan()),
            [size, size],
        );
        let suns = match setting {
            Setting::Open | Setting::Street => draw_suns(SUNS, SUN_HEIGHTS, draw.0),
            Setting::Yard => draw_suns(SUNS, [5.0, 75.0], draw.0),
        };
        let mut draw = Draw::new(&mut stream);
        let near = match view {
            View::Close => 1.6,
            View::Wide => 3.4,
        };
        let (behind, sky) = match setting {
            Setting::Open => (Backdrop::default(), SkyLook::default()),
            Setting::Street => {
                let street = Backdrop::draw(&mut draw, near, width);
                (street, SkyLook::default())
            }
            Setting::Yard => {
                let clearing = Clearing {
                    radius: placed
                        .iter()
                        .fold(radius, |r, (at, q)| r.max(at.length() + q)),
                    camera: Vec2::new(camera.position.x, camera.position.z),
                    width,
                };
                let yard = Backdrop::yard(&mut draw, &around, &clearing);
                (yard, draw.sky_look())
            }
        };
        others.append(behind.mesh, paints.len() as u32);
        paints.extend(behind.paints);
        Self {
            main,
            main_paint,
            shape,
            others,
            paints,
            ground,
            camera,
            suns,
            sky,
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
        (self.pattern_at(at) * self.wear_at(at)).min(Vec3::splat(0.9))
    }

    fn wear_at(&self, at: Vec2) -> f32 {
        let wear = &self.wear;
        if *wear == Wear::default() {
            return 1.0;
        }
        let fine = value_noise(at * 9.0, self.seed ^ 7) + value_noise(at * 23.0, self.seed ^ 8);
        let mut factor = 1.0 + wear.grain * 0.5 * (fine - 1.0);
        let blot = 0.7 * value_noise(at * 0.9, self.seed ^ 9)
            + 0.3 * value_noise(at * 4.0, self.seed ^ 10);
        if blot > 0.62 {
            factor *= 1.0 - wear.stains;
        }
        if self.turn.perp_dot(at) > wear.offset {
            factor *= 1.0 - 0.6 * wear.kerb;
        }
        factor
    }

    fn pattern_at(&self, at: Vec2) -> Vec3 {
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

    fn yard(index: u64) -> Stage {
        let brief = Brief {
            kinds: Kinds::Trained,
            setting: Setting::Yard,
            view: View::Close,
        };
        Stage::draw(7, index, 16, brief)
    }

    #[test]
    fn a_yards_sky_is_brightest_around_the_sun_and_clouds_leave_it_as_bright_on_the_whole() {
        let mut clouded = 0;
        for index in 0..20 {
            let look = yard(index).sky;
            let sun = Vec3::new(0.6, 0.8, 0.0);
            let at = |degrees: f32| {
                let (s, c) = degrees.to_radians().sin_cos();
                look.around_sun(sun * c + Vec3::Z * s, sun)
            };
            assert!(at(0.0) > at(20.0) && at(20.0) > at(90.0) && at(90.0) >= 0.0);
            let cover = (0..4000).map(|i| {
                let (s, c) = (i as f32 * 2.4).sin_cos();
                let y = (i as f32 + 0.5) / 4000.0;
                let r = (1.0 - y * y).sqrt();
                look.cover(Vec3::new(r * c, y, r * s))
            });
            let mean = cover.sum::<f32>() / 4000.0;
            assert!((mean - 1.0).abs() < 0.15, "{index}: {mean}");
            clouded += usize::from(look.clouds > 0.2);
        }
        assert!(clouded > 8);
        let clear = Stage::draw(7, 0, 16, OPEN).sky;
        assert_eq!(
            (clear.around_sun(Vec3::Y, Vec3::Y), clear.cover(Vec3::Y)),
            (0.0, 1.0)
        );
    }

    const OPEN: Brief = Brief {
        kinds: Kinds::Trained,
        setting: Setting::Open,
        view: View::Close,
    };

    #[test]
    fn worn_ground_stays_a_ground_and_new_ground_is_its_pattern() {
        let mut mottled = 0;
        for index in 0..20 {
            let (worn, new) = (yard(index).ground, Stage::draw(7, index, 16, OPEN).ground);
            let mut factors = vec![];
            for i in 0..400 {
                let at = Vec2::new((i % 20) as f32, (i / 20) as f32) * 0.37 - 3.0;
                assert_eq!(new.albedo(at), new.pattern_at(at));
                let albedo = worn.albedo(at);
                assert!(
                    albedo.min_element() > 0.0 && albedo.max_element() <= 0.9,
                    "{albedo}"
                );
                factors.push(worn.wear_at(at));
            }
            mottled += usize::from(factors.iter().any(|f| *f != 1.0));
        }
        // Each kind of wear is there half of the time.
        assert!((10..20).contains(&mottled), "{mottled}");
    }
}
