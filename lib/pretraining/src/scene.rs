//! Generated scenes without their light: a main object among others on textured ground. The camera looks along -z.

use dipir_diffusion::noise::NoiseStream;
use dipir_prior::caption::COLORS;
use dipir_scene::camera::{Camera, FieldOfView};
use dipir_scene::material::Material;
use dipir_scene::mesh::TriangleMesh;
use glam::{DMat4, DQuat, DVec3, Vec2, Vec3};

use crate::backdrop::Backdrop;
use crate::courtyard::Clearing;
use crate::ground::Ground;
use crate::lighting::{SUN_HEIGHTS, Sun, draw_suns};
use crate::random::Draw;
use crate::shapes::Shape;
use crate::sky::SkyAppearance;

/// Suns under which every scene is recorded.
pub const SUNS: usize = 8;

/// Colour and gloss of an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Paint {
    /// Linear base colour.
    pub color: Vec3,
    /// Linear roughness of the highlight.
    pub roughness: f32,
    /// Whether it is a metal.
    pub metallic: bool,
    /// The word for the colour.
    pub word: &'static str,
}

impl Paint {
    /// The renderer's material.
    pub fn material(&self) -> Material {
        Material {
            base_color: self.color.extend(1.0),
            roughness: self.roughness,
            metallic: f32::from(u8::from(self.metallic)),
            ..Material::default()
        }
    }
}

/// Which kinds of main objects a scene may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ObjectSet {
    /// Those of training.
    Training,
    /// Those that training never shows.
    HeldOut,
}

/// How much of a scene the camera shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Framing {
    /// The object and its surroundings, as in training.
    Close,
    /// About eight metres, with more objects, as a photograph.
    Wide,
}

/// Surroundings of the objects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Setting {
    /// Open ground, seen from above.
    Open,
    /// Houses, trees, hedges and lamp posts behind the objects, seen at eye level.
    Street,
    /// Objects of all sizes around, walls on any side, shadows of objects outside of the picture; seen from near or far.
    Courtyard,
}

/// The kind of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SceneKind {
    /// Main objects.
    pub objects: ObjectSet,
    /// Surroundings.
    pub setting: Setting,
    /// How much the camera shows.
    pub framing: Framing,
}

/// A scene without its light.
#[derive(Debug, Clone)]
pub struct GeneratedScene {
    /// The main object, which is inserted.
    pub main: TriangleMesh,
    /// Its material.
    pub main_paint: Paint,
    /// Its shape.
    pub shape: Shape,
    /// All other objects; materials of triangles index `paints`.
    pub others: TriangleMesh,
    /// Materials of the other objects.
    pub paints: Vec<Paint>,
    /// The plane y = 0.
    pub ground: Ground,
    /// The camera.
    pub camera: Camera,
    /// Suns under which it is recorded.
    pub suns: Vec<Sun>,
    /// The visible sky.
    pub sky: SkyAppearance,
}

impl GeneratedScene {
    /// A close view of scene `index` in `setting`, for tests.
    #[cfg(test)]
    pub(crate) fn close(index: u64, setting: Setting) -> Self {
        let kind = SceneKind {
            objects: ObjectSet::Training,
            setting,
            framing: Framing::Close,
        };
        Self::draw(7, index, 16, kind)
    }

    /// The scene number `index` under `seed`, for pictures of `size` pixels.
    pub fn draw(seed: u64, index: u64, size: u32, kind: SceneKind) -> Self {
        let mut stream = NoiseStream::new(seed, index);
        let mut draw = Draw::new(&mut stream);
        let shape = draw.shape(kind.objects);
        let (main, radius) = draw.solid(shape, Vec2::ZERO);
        let main_paint = draw.paint();
        let nearby = kind.objects.nearby();
        let mut objects = Objects::around(radius);
        objects.place(&mut draw, &nearby, kind.framing);
        let ground = draw.ground(kind.setting);
        let (camera, width) = draw.camera(kind, size);
        let suns = match kind.setting {
            Setting::Open | Setting::Street => draw_suns(SUNS, SUN_HEIGHTS, draw.0),
            Setting::Courtyard => draw_suns(SUNS, [5.0, 75.0], draw.0),
        };
        let (backdrop, sky) = match kind.setting {
            Setting::Open => (Backdrop::default(), SkyAppearance::default()),
            Setting::Street => {
                let near = match kind.framing {
                    Framing::Close => 1.6,
                    Framing::Wide => 3.4,
                };
                let street = Backdrop::street(&mut draw, near, width);
                (street, SkyAppearance::default())
            }
            Setting::Courtyard => {
                let clearing = Clearing {
                    radius: objects.reach(),
                    camera: Vec2::new(camera.position.x, camera.position.z),
                    width,
                };
                let courtyard = Backdrop::courtyard(&mut draw, &nearby, &clearing);
                (courtyard, draw.sky_appearance())
            }
        };
        let Objects {
            mesh: mut others,
            mut paints,
            ..
        } = objects;
        others.append(backdrop.mesh, paints.len() as u32);
        paints.extend(backdrop.paints);
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

/// Objects around the main one.
struct Objects {
    mesh: TriangleMesh,
    paints: Vec<Paint>,
    /// Middle and radius on the ground, the main object first.
    footprints: Vec<(Vec2, f32)>,
}

impl Objects {
    /// None yet, around a main object of this radius.
    fn around(radius: f32) -> Self {
        Self {
            mesh: TriangleMesh::default(),
            paints: vec![],
            footprints: vec![(Vec2::ZERO, radius)],
        }
    }

    /// Radius around the origin that they cover.
    fn reach(&self) -> f32 {
        let main = self.footprints[0].1;
        let ends = self.footprints.iter().map(|(at, r)| at.length() + r);
        ends.fold(main, f32::max)
    }

    /// Places solids of `shapes` apart from each other.
    fn place(&mut self, draw: &mut Draw<'_>, shapes: &[Shape], framing: Framing) {
        let (wanted, reach, attempts) = match framing {
            Framing::Close => ([0, 1, 1, 2, 2, 2, 3, 3][draw.below(8)], 2.1, 12),
            Framing::Wide => ([3, 4, 4, 5, 5, 6, 6, 7][draw.below(8)], 3.4, 40),
        };
        let main_radius = self.footprints[0].1;
        for _ in 0..attempts {
            if self.paints.len() == wanted {
                break;
            }
            let angle = draw.range(0.0, std::f32::consts::TAU);
            let at = Vec2::from_angle(angle) * draw.range(0.9, reach);
            let shape = shapes[draw.below(shapes.len())];
            let (mesh, r) = draw.solid(shape, at);
            let mut others = self.footprints.iter();
            let free = others.all(|(p, q)| p.distance(at) > r + q + 0.05);
            // The view of the main object stays free.
            let in_front = at.y > -0.2 && at.x.abs() < main_radius + r;
            if free && !in_front {
                self.mesh.append(mesh, self.paints.len() as u32);
                self.paints.push(draw.paint());
                self.footprints.push((at, r));
            }
        }
    }
}

impl ObjectSet {
    /// Kinds of the solids around the main object.
    fn nearby(self) -> Vec<Shape> {
        match self {
            Self::Training => [&Shape::COMMON[..], &Shape::FACETED].concat(),
            Self::HeldOut => Shape::COMMON.to_vec(),
        }
    }
}

impl Draw<'_> {
    /// The kind of the main object.
    fn shape(&mut self, objects: ObjectSet) -> Shape {
        match objects {
            // Half of the objects have flat faces, which are harder: they show less of the light than shadows do.
            ObjectSet::Training => match self.below(2) {
                0 => Shape::COMMON[self.below(Shape::COMMON.len())],
                _ => Shape::FACETED[self.below(Shape::FACETED.len())],
            },
            ObjectSet::HeldOut => Shape::HELD_OUT[self.below(Shape::HELD_OUT.len())],
        }
    }

    /// The camera, and the width of its view at the object, metres.
    fn camera(&mut self, kind: SceneKind, size: u32) -> (Camera, f32) {
        let (low, high) = match (kind.setting, kind.framing) {
            (Setting::Open, _) => (10.0, 45.0),
            (Setting::Street, _) | (Setting::Courtyard, Framing::Wide) => (3.0, 25.0),
            (Setting::Courtyard, Framing::Close) => (1.0, 45.0),
        };
        let pitch = self.range(low, high).to_radians();
        let (distance, width) = match (kind.setting, kind.framing) {
            (_, Framing::Wide) => (self.range(8.0, 14.0), self.range(7.0, 9.0)),
            (Setting::Courtyard, Framing::Close) => {
                let distance = self.range(2.5f32.ln(), 18f32.ln()).exp();
                (distance, (distance * self.range(0.15, 0.7)).clamp(1.2, 9.0))
            }
            (_, Framing::Close) => (self.range(4.0, 9.0), self.range(2.8, 4.2)),
        };
        // In courtyards the object may be far from the picture's middle.
        let aside = match (kind.setting, kind.framing) {
            (Setting::Courtyard, Framing::Close) => 0.25 * width,
            _ => 0.3,
        };
        let target = Vec3::new(
            self.range(-aside, aside),
            self.range(0.15, 0.5),
            self.range(-aside, aside),
        );
        let back = Vec3::new(0.0, pitch.sin(), pitch.cos());
        let camera = Camera::look_at(
            target + back * distance,
            target,
            Vec3::Y,
            FieldOfView::Vertical(2.0 * (0.5 * width / distance).atan()),
            [size, size],
        );
        (camera, width)
    }

    /// The colour and gloss of an object.
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
