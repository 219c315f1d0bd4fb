//! The surroundings of the demo: a paved square with planters, a tree, bollards and houses around it.
use std::f32::consts::TAU;
use std::path::{Path, PathBuf};

use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_scene::material::{Material, TextureRef};
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::texture::{Encoding, Filter, ImageSource, Texture, Wrap};
use glam::{Mat3, Quat, Vec2, Vec3, Vec4};

use crate::mesher::{Side, mesh};
use crate::noise::{cell, fbm};
use crate::solids::{rounded_box, smoothstep};

/// Metres that one repetition of the paving covers.
const PAVING_M: f32 = 6.0;
/// Metres that one window of a facade takes.
const BAY_M: f32 = 3.2;

/// Everything but camera and sky.
pub struct Square {
    /// All triangles.
    pub mesh: TriangleMesh,
    /// Indexed by the mesh.
    pub materials: Vec<Material>,
    /// Indexed by the materials; files in the folder given to [`Square::new`].
    pub textures: Vec<Texture>,
}

impl Square {
    /// Builds the square; its textures are written to `folder`.
    pub fn new(folder: &Path) -> anyhow::Result<Self> {
        let mut square = Self {
            mesh: TriangleMesh::default(),
            materials: Vec::new(),
            textures: Vec::new(),
        };
        square.paving(folder)?;
        square.houses(folder)?;
        square.planters();
        square.tree(Vec3::new(5.2, 0.0, -6.2), 5.2, 3);
        square.tree(Vec3::new(-8.2, 0.0, -9.5), 6.4, 4);
        square.bollards();
        square.lamp(Vec3::new(3.9, 0.0, -2.6));
        Ok(square)
    }

    fn material(&mut self, name: &str, color: Vec3, roughness: f32) -> u32 {
        self.materials.push(Material {
            name: name.into(),
            base_color: color.extend(1.0),
            metallic: 0.0,
            roughness,
            double_sided: true,
            ..Material::default()
        });
        self.materials.len() as u32 - 1
    }

    fn texture(&mut self, file: PathBuf, encoding: Encoding) -> TextureRef {
        self.textures.push(Texture {
            image: ImageSource::File(file),
            encoding,
            wrap: [Wrap::Repeat; 2],
            filter: Filter::Linear,
        });
        TextureRef {
            texture: self.textures.len() as u32 - 1,
            uv_set: 0,
            transform: Mat3::IDENTITY,
        }
    }

    /// Adds triangles with normals, texture coordinates and colours where `other` lacks them.
    fn add(&mut self, mut other: TriangleMesh, material: u32) {
        let n = other.positions.len();
        if other.normals.is_empty() {
            flatten(&mut other);
        }
        let n = n.max(other.positions.len());
        other.uvs[0].resize(n, Vec2::ZERO);
        other.colors.resize(n, Vec4::ONE);
        let first = self.mesh.positions.len() as u32;
        self.mesh.positions.extend(other.positions);
        self.mesh.normals.extend(other.normals);
        self.mesh.uvs[0].extend(&other.uvs[0]);
        self.mesh.colors.extend(other.colors);
        self.mesh
            .materials
            .extend(vec![material; other.indices.len()]);
        self.mesh
            .indices
            .extend(other.indices.into_iter().map(|t| t.map(|i| i + first)));
    }

    // ---- Ground -------------------------------------------------------------------------------

    fn paving(&mut self, folder: &Path) -> anyhow::Result<()> {
        const SIZE: usize = 2048;
        let albedo = image(SIZE, |u, v| paving_albedo(PAVING_M * u, PAVING_M * v));
        let file = folder.join("paving.png");
        write_png(&file, &Transfer::Srgb.encode(&LinearImage(albedo)))?;
        let texture = self.texture(file, Encoding::Srgb);
        let material = self.material("paving", Vec3::ONE, 0.82);
        self.materials[material as usize].base_color_texture = Some(texture);

        // Worn and stained over metres: vertex colours, which do not repeat.
        const HALF_M: f32 = 160.0;
        const CELLS: usize = 640;
        let mut ground = TriangleMesh::default();
        for k in 0..=CELLS {
            for i in 0..=CELLS {
                let at = |n: usize| (n as f32 / CELLS as f32 * 2.0 - 1.0) * HALF_M;
                let p = Vec3::new(at(i), 0.0, at(k));
                let wear = 0.80 + 0.40 * fbm(0.22 * p, 4, 31);
                let stain = 1.0 - 0.16 * smoothstep(0.56, 0.72, fbm(0.6 * p, 4, 37));
                ground.positions.push(p);
                ground.normals.push(Vec3::Y);
                ground.uvs[0].push(Vec2::new(p.x, p.z) / PAVING_M);
                ground.colors.push(Vec3::splat(wear * stain).extend(1.0));
                if i < CELLS && k < CELLS {
                    let a = (k * (CELLS + 1) + i) as u32;
                    let b = a + CELLS as u32 + 1;
                    ground.indices.extend([[a, b, b + 1], [a, b + 1, a + 1]]);
                }
            }
        }
        self.add(ground, material);
        Ok(())
    }

    // ---- Houses -------------------------------------------------------------------------------

    fn houses(&mut self, folder: &Path) -> anyhow::Result<()> {
        let plaster = [
            Vec3::new(0.62, 0.47, 0.31),
            Vec3::new(0.55, 0.50, 0.43),
            Vec3::new(0.50, 0.28, 0.20),
            Vec3::new(0.68, 0.61, 0.48),
            Vec3::new(0.42, 0.46, 0.47),
        ];
        let facades: Vec<u32> = plaster
            .iter()
            .enumerate()
            .map(|(i, &color)| self.facade(folder, i, color))
            .collect::<anyhow::Result<_>>()?;
        let roof = self.material("roof", Vec3::new(0.20, 0.10, 0.07), 0.8);
        // Rows along the four sides of the square: from, direction, facing, number of houses.
        let rows = [
            (Vec3::new(-48.0, 0.0, -30.0), Vec3::X, Vec3::Z, 9),
            (Vec3::new(46.0, 0.0, -27.0), Vec3::Z, Vec3::NEG_X, 7),
            (Vec3::new(48.0, 0.0, 40.0), Vec3::NEG_X, Vec3::NEG_Z, 9),
            (Vec3::new(-44.0, 0.0, 38.0), Vec3::NEG_Z, Vec3::X, 6),
        ];
        for (row, (from, along, facing, count)) in rows.into_iter().enumerate() {
            let mut at = from;
            for i in 0..count {
                let chance = |k: i64| cell(i, row as i64, k, 5);
                let bays = 3.0 + (chance(0) * 3.0).floor();
                let storeys = match row {
                    3 => 2.0,
                    _ => 3.0 + (chance(1) * 2.6).floor(),
                };
                let facade = facades[(chance(2) * facades.len() as f32) as usize];
                let (width, height) = (bays * BAY_M, storeys * BAY_M);
                let set_back = facing * (-1.5 * chance(3)).round();
                self.house(at + set_back, along * width, facing, height, facade, roof);
                at += along * (width + 0.05);
            }
        }
        Ok(())
    }

    fn house(
        &mut self,
        corner: Vec3,
        along: Vec3,
        facing: Vec3,
        height: f32,
        facade: u32,
        roof: u32,
    ) {
        const DEPTH_M: f32 = 9.0;
        let back = -facing * DEPTH_M;
        let up = Vec3::Y * height;
        let uv = |m: f32| m / BAY_M;
        let mut wall = |from: Vec3, edge: Vec3| {
            let mut quad = dipir_render::shapes::quad(from, edge, up);
            let (w, h) = (uv(edge.length()), uv(height));
            quad.uvs[0] = vec![
                Vec2::new(0.0, h),
                Vec2::new(w, h),
                Vec2::new(w, 0.0),
                Vec2::new(0.0, 0.0),
            ];
            self.add(quad, facade);
        };
        wall(corner, along);
        wall(corner + back, along);
        wall(corner, back);
        wall(corner + along, back);
        // A saddle roof with eaves, its ridge along the street.
        let rise = Vec3::Y * 0.42 * DEPTH_M * 0.5;
        let (eaves, slope) = (facing * 0.5 - 0.25 * Vec3::Y * 0.5, 0.5 * back + rise);
        self.add(
            dipir_render::shapes::quad(corner + up + eaves, along, slope - eaves),
            roof,
        );
        self.add(
            dipir_render::shapes::quad(
                corner + up + back - facing * 0.5,
                along,
                slope - 2.0 * slope.dot(facing) * facing,
            ),
            roof,
        );
        for end in [corner + up, corner + up + along] {
            let gable = TriangleMesh {
                positions: vec![end, end + back, end + slope],
                indices: vec![[0, 1, 2]],
                materials: vec![0],
                ..TriangleMesh::default()
            };
            self.add(gable, facade);
        }
    }

    fn facade(&mut self, folder: &Path, index: usize, color: Vec3) -> anyhow::Result<u32> {
        const SIZE: usize = 256;
        let albedo = image(SIZE, |u, v| facade_albedo(u, v, color, index));
        // Green: roughness, blue: metalness.
        let surface = image(SIZE, |u, v| {
            let glass = window(u, v) == Pane::Glass;
            Vec3::new(0.0, if glass { 0.04 } else { 0.85 }, 0.0)
        });
        let albedo_file = folder.join(format!("facade{index}.png"));
        write_png(&albedo_file, &Transfer::Srgb.encode(&LinearImage(albedo)))?;
        let surface_file = folder.join(format!("facade{index}-surface.png"));
        write_png(&surface_file, &DisplayImage(surface))?;
        let albedo = self.texture(albedo_file, Encoding::Srgb);
        let surface = self.texture(surface_file, Encoding::Linear);
        let material = self.material("facade", Vec3::ONE, 1.0);
        let m = &mut self.materials[material as usize];
        m.base_color_texture = Some(albedo);
        m.metallic_roughness_texture = Some(surface);
        Ok(material)
    }

    // ---- Things -------------------------------------------------------------------------------

    fn planters(&mut self) {
        let concrete = self.material("concrete", Vec3::new(0.46, 0.445, 0.42), 0.8);
        let leaf = self.material("leaf", Vec3::ONE, 0.55);
        let soil = self.material("soil", Vec3::new(0.06, 0.045, 0.03), 0.95);
        for (center, half) in [
            (Vec3::new(-2.9, 0.0, -6.4), Vec3::new(2.6, 0.30, 0.50)),
            (Vec3::new(10.6, 0.0, -7.0), Vec3::new(2.6, 0.30, 0.50)),
        ] {
            let trough = |p: Vec3| {
                let outer = rounded_box(p - half.y * Vec3::Y, half, 0.03);
                let inner = rounded_box(
                    p - 1.3 * half.y * Vec3::Y,
                    half - 0.09 * Vec3::new(1.0, 0.0, 1.0),
                    0.02,
                );
                outer.max(-inner)
            };
            let reach = half + Vec3::new(0.1, 0.1, 0.1);
            let low = Vec3::new(-reach.x, -0.04, -reach.z);
            let high = Vec3::new(reach.x, 2.0 * reach.y, reach.z);
            let mut shape = mesh(&trough, low, high, 0.025, Side::Whole);
            shift(&mut shape, center);
            self.add(shape, concrete);
            let top = center + 1.75 * half.y * Vec3::Y;
            let bed = dipir_render::shapes::quad(
                top - Vec3::new(half.x - 0.09, 0.0, -(half.z - 0.09)),
                2.0 * (half.x - 0.09) * Vec3::X,
                -2.0 * (half.z - 0.09) * Vec3::Z,
            );
            self.add(bed, soil);
            let reach = Vec3::new(half.x - 0.10, 0.36, half.z - 0.06);
            self.leaves(top + 0.33 * Vec3::Y, reach, 16_000, 0.050, leaf, 91, 4.0);
        }
    }

    fn tree(&mut self, foot: Vec3, height: f32, seed: u64) {
        let bark = self.material("bark", Vec3::new(0.13, 0.095, 0.07), 0.9);
        let leaf = self.material("leaf", Vec3::ONE, 0.5);
        let grate = self.material("grate", Vec3::new(0.05, 0.05, 0.05), 0.6);
        let plate = dipir_render::shapes::cuboid(
            foot - Vec3::new(0.7, 0.0, 0.7),
            foot + Vec3::new(0.7, 0.012, 0.7),
        );
        self.add(plate, grate);
        let crown = foot + 0.68 * height * Vec3::Y;
        self.limb(foot, foot + 0.62 * height * Vec3::Y, 0.12, 0.07, bark);
        for i in 0..9 {
            let r = |k: i64| cell(i, k, 0, seed);
            let angle = TAU * (i as f32 + 0.6 * r(0)) / 9.0;
            let out = Vec3::new(angle.cos(), 0.0, angle.sin());
            let start = foot + (0.36 + 0.22 * r(1)) * height * Vec3::Y;
            let end = crown
                + (0.16 + 0.12 * r(2)) * height * out
                + (r(3) - 0.4) * 0.26 * height * Vec3::Y;
            self.limb(start, end, 0.05, 0.015, bark);
            let reach = (0.115 + 0.05 * r(4)) * height * Vec3::new(1.0, 0.8, 1.0);
            self.leaves(end, reach, 3400, 0.075, leaf, seed * 100 + i as u64, 2.0);
        }
        self.leaves(
            crown + 0.16 * height * Vec3::Y,
            0.17 * height * Vec3::new(1.0, 0.85, 1.0),
            5000,
            0.075,
            leaf,
            seed * 100 + 50,
            2.0,
        );
    }

    /// Leaves in a superellipsoid, denser towards its surface; `power` 2 is an ellipsoid, 4 nearly
    /// a box.
    fn leaves(
        &mut self,
        center: Vec3,
        reach: Vec3,
        count: usize,
        size: f32,
        material: u32,
        seed: u64,
        power: f32,
    ) {
        let mut crown = TriangleMesh::default();
        let mut tried = 0;
        while crown.positions.len() < 4 * count && tried < 100 * count as i64 {
            tried += 1;
            let r = |k: i64| cell(tried, k, 7, seed);
            let q = 2.0 * Vec3::new(r(0), r(1), r(2)) - 1.0;
            let level = (q.x.abs().powf(power) + q.y.abs().powf(power) + q.z.abs().powf(power))
                .powf(1.0 / power);
            let ragged = 1.0 - 0.22 * fbm(3.0 * q + 9.0, 3, seed);
            if level > ragged || r(3) > 0.15 + 0.85 * (level / ragged).powi(3) {
                continue;
            }
            let turn = Quat::from_euler(
                glam::EulerRot::YXZ,
                TAU * r(4),
                2.2 * (r(5) - 0.5),
                TAU * r(6),
            );
            let (u, v) = (
                turn * Vec3::X * size * (0.7 + 0.6 * r(7)),
                turn * Vec3::Z * size * 0.55,
            );
            let p = center + q * reach;
            let first = crown.positions.len() as u32;
            let normal = turn * Vec3::Y;
            // A pointed leaf: a rhomb.
            crown.positions.extend([p - u, p - v, p + u, p + v]);
            crown.normals.extend([normal; 4]);
            let green = Vec3::new(0.105, 0.185, 0.035).lerp(Vec3::new(0.20, 0.26, 0.05), r(8));
            crown.colors.extend([green.extend(1.0); 4]);
            crown
                .indices
                .extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
        }
        self.add(crown, material);
    }

    fn limb(&mut self, from: Vec3, to: Vec3, r0: f32, r1: f32, material: u32) {
        const AROUND: u32 = 10;
        let axis = (to - from).normalize();
        let side = axis.any_orthonormal_vector();
        let mut tube = TriangleMesh::default();
        for (p, r) in [(from, r0), (to, r1)] {
            for j in 0..AROUND {
                let (s, c) = (j as f32 / AROUND as f32 * TAU).sin_cos();
                let normal = c * side + s * axis.cross(side);
                tube.positions.push(p + r * normal);
                tube.normals.push(normal);
            }
        }
        for j in 0..AROUND {
            let k = (j + 1) % AROUND;
            tube.indices
                .extend([[j, k, k + AROUND], [j, k + AROUND, j + AROUND]]);
        }
        self.add(tube, material);
    }

    fn bollards(&mut self) {
        let stone = self.material("stone", Vec3::new(0.50, 0.47, 0.43), 0.7);
        for (x, z) in [(-4.3, -2.9), (-4.6, -0.6), (-4.9, 1.7)] {
            let ball = dipir_render::shapes::icosphere(Vec3::new(x, 0.30, z), 0.27, 4);
            self.add(ball, stone);
            let foot = dipir_render::shapes::cuboid(
                Vec3::new(x - 0.14, 0.0, z - 0.14),
                Vec3::new(x + 0.14, 0.07, z + 0.14),
            );
            self.add(foot, stone);
        }
    }

    fn lamp(&mut self, foot: Vec3) {
        let iron = self.material("iron", Vec3::new(0.028, 0.036, 0.034), 0.45);
        let globe = self.material("globe", Vec3::new(0.80, 0.79, 0.75), 0.25);
        self.limb(foot, foot + 0.55 * Vec3::Y, 0.085, 0.065, iron);
        self.limb(
            foot + 0.55 * Vec3::Y,
            foot + 3.3 * Vec3::Y,
            0.042,
            0.030,
            iron,
        );
        for height in [0.55, 3.25] {
            let ring = dipir_render::shapes::icosphere(foot + height * Vec3::Y, 0.075, 3);
            self.add(ring, iron);
        }
        let ball = dipir_render::shapes::icosphere(foot + 3.50 * Vec3::Y, 0.20, 4);
        self.add(ball, globe);
        let cap = dipir_render::shapes::icosphere(foot + 3.70 * Vec3::Y, 0.07, 3);
        self.add(cap, iron);
    }
}

/// Gives every triangle its own vertices and normal.
fn flatten(mesh: &mut TriangleMesh) {
    let mut flat = TriangleMesh::default();
    for t in &mesh.indices {
        let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
        let normal = (b - a).cross(c - a).normalize_or(Vec3::Y);
        let first = flat.positions.len() as u32;
        flat.positions.extend([a, b, c]);
        flat.normals.extend([normal; 3]);
        if !mesh.uvs[0].is_empty() {
            flat.uvs[0].extend(t.map(|i| mesh.uvs[0][i as usize]));
        }
        flat.indices.push([first, first + 1, first + 2]);
    }
    *mesh = flat;
}

fn shift(mesh: &mut TriangleMesh, by: Vec3) {
    mesh.positions.iter_mut().for_each(|p| *p += by);
}

/// A square picture of a function of (u, v) in `[0, 1)`, v down.
fn image(size: usize, f: impl Fn(f32, f32) -> Vec3) -> Raster<Vec3> {
    let at = |n: usize| (n as f32 + 0.5) / size as f32;
    let pixels = (0..size * size).map(|n| f(at(n % size), at(n / size)));
    Raster::from_pixels(size, size, pixels.collect())
}

/// Slabs in running bond: `x` and `y` in metres, periodic in [`PAVING_M`].
fn paving_albedo(x: f32, y: f32) -> Vec3 {
    const SLAB: Vec2 = Vec2::new(0.75, 0.50);
    const JOINT_M: f32 = 0.007;
    let row = (y / SLAB.y).floor();
    let shifted = x + if row as i64 % 2 == 0 {
        0.0
    } else {
        0.5 * SLAB.x
    };
    let columns = (PAVING_M / SLAB.x) as i64;
    let rows = (PAVING_M / SLAB.y) as i64;
    let column = (shifted / SLAB.x).floor() as i64;
    let inside = Vec2::new(shifted - column as f32 * SLAB.x, y - row * SLAB.y);
    let id = (column.rem_euclid(columns), (row as i64).rem_euclid(rows));
    let chance = |k: i64| cell(id.0, id.1, k, 21);
    let edge = inside.min(SLAB - inside).min_element();
    // Periodic noise on a torus, so that the tile repeats without a seam.
    let torus = |scale: f32, seed: u64, octaves: u32| {
        let (a, b) = (TAU * x / PAVING_M, TAU * y / PAVING_M);
        let p = Vec3::new(
            a.cos() * 1.3 + b.sin(),
            a.sin() * 1.3 + 0.7 * b.cos(),
            b.cos() - 0.4 * a.sin(),
        );
        fbm(scale * p, octaves, seed)
    };
    let tone = 0.37 * (0.86 + 0.28 * chance(0));
    let tint = Vec3::new(1.03, 1.0, 0.95).lerp(Vec3::new(0.97, 1.0, 1.02), chance(1));
    let grain = 0.88 + 0.24 * torus(38.0, 23, 3);
    let blotch = 0.90 + 0.20 * torus(4.0, 22, 4);
    let slab = tone * tint * grain * blotch;
    let joint = Vec3::new(0.085, 0.080, 0.070) * (0.7 + 0.6 * torus(30.0, 24, 2));
    joint.lerp(slab, smoothstep(JOINT_M * 0.6, JOINT_M * 1.6, edge))
}

#[derive(Clone, Copy, PartialEq)]
enum Pane {
    Wall,
    Frame,
    Glass,
    Sill,
}

fn window(u: f32, v: f32) -> Pane {
    let (x, y) = ((u - 0.5).abs(), v - 0.46);
    let (half_x, half_y) = (0.19, 0.29);
    if x < half_x && y.abs() < half_y {
        let bar = x < 0.012 || x > half_x - 0.022;
        let rail = (y + 0.10).abs() < 0.012 || y.abs() > half_y - 0.022;
        if bar || rail {
            Pane::Frame
        } else {
            Pane::Glass
        }
    } else if x < half_x + 0.03 && y > 0.0 && y < half_y + 0.035 && y >= half_y {
        Pane::Sill
    } else {
        Pane::Wall
    }
}

fn facade_albedo(u: f32, v: f32, color: Vec3, index: usize) -> Vec3 {
    match window(u, v) {
        Pane::Glass => Vec3::new(0.025, 0.030, 0.035),
        Pane::Frame => Vec3::splat(0.62),
        Pane::Sill => Vec3::splat(0.45),
        Pane::Wall => {
            let string_course = v > 0.955;
            let p = Vec3::new(
                (TAU * u).cos(),
                (TAU * u).sin() + 0.7 * (TAU * v).cos(),
                (TAU * v).sin(),
            );
            let rough = 0.88 + 0.24 * fbm(6.0 * p, 4, 41 + index as u64);
            if string_course {
                Vec3::splat(0.55) * rough
            } else {
                color * rough
            }
        }
    }
}
