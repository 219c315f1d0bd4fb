//! Random small scenes and lights.
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_light::gaussian::{SgMixture, SphericalGaussian};
use dipir_light::illuminant::Illuminant;
use dipir_light::map_with_lobes::MapWithLobes;
use dipir_numerics::warp::square_to_sphere;
use dipir_render::features::{ALL, PROXY_RADIANCE};
use dipir_render::render::Simulation;
use dipir_render::shadow::LightOnProxy;
use dipir_render::shapes::{append, cuboid, icosphere, quad, torus_knot};
use dipir_scene::camera::Camera;
use dipir_scene::material::{
    AlphaMode, Anisotropy, Clearcoat, Iridescence, Material, Sheen, Specular, TextureRef,
    Transmission, Volume,
};
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use dipir_scene::texture::{Encoding, Filter, ImageSource, Texture, Wrap};
use glam::{Mat3, Vec2, Vec3, Vec4};
use tempfile::TempDir;

use crate::tracer::Rng;

/// A light of any kind.
pub enum Light {
    Map(EnvironmentSampler),
    Lobes(SgMixture),
    Both(MapWithLobes),
}

impl Light {
    /// Radiance from `direction`.
    pub fn eval(&self, direction: Vec3) -> Vec3 {
        let lobes = |l: &SgMixture| l.lobes().iter().map(|g| g.eval(direction)).sum::<Vec3>();
        match self {
            Self::Map(map) => Illuminant::eval(map, direction),
            Self::Lobes(l) => lobes(l),
            Self::Both(both) => Illuminant::eval(both.map(), direction) + lobes(both.lobes()),
        }
    }
}

/// A scene, its light, and what is simulated of it.
pub struct Case {
    pub scene: Scene,
    pub light: Light,
    pub photo: Option<LinearImage>,
    pub simulation: Simulation,
    _textures: TempDir,
}

const COLOUR: u32 = 0;
const NUMBERS: u32 = 1;
const NORMALS: u32 = 2;

impl Case {
    /// The case `seed`, `size` pixels wide and high.
    pub fn new(seed: u64, size: u32) -> Self {
        let mut rng = Rng::new(&[seed, 77]);
        let r = &mut rng;
        let folder = TempDir::new().expect("a folder");
        let materials: Vec<Material> = (0..1 + r.bits() % 3).map(|_| material(r)).collect();
        let mesh = mesh(r, materials.len() as u32);
        let proxy = proxy(r);
        let photo = (r.next() < 0.3 && !matches!(proxy, Proxy::None)).then(|| {
            let n = size as usize;
            let pixels = (0..n * n).map(|_| r.colour() * 2.0).collect();
            LinearImage(Raster::from_pixels(n, n, pixels))
        });
        let sent = LightOnProxy {
            emission: r.next() < 0.7,
            bounce: r.next() < 0.7,
        };
        let simulation = Simulation {
            features: ALL | if photo.is_some() { PROXY_RADIANCE } else { 0 },
            max_depth: 1 + (r.bits() % 6) as u32,
            shadow: !matches!(proxy, Proxy::None),
            proxy_occlusion: r.next() < 0.7,
            light_on_proxy: (r.next() < 0.5 && (sent.emission || sent.bounce)).then_some(sent),
        };
        let scene = Scene {
            mesh,
            materials,
            textures: textures(r, &folder),
            camera: camera(r, size),
            proxy,
        };
        Self {
            scene,
            light: light(r),
            photo,
            simulation,
            _textures: folder,
        }
    }
}

fn chance<T>(r: &mut Rng, p: f32, make: impl FnOnce(&mut Rng) -> T) -> Option<T> {
    (r.next() < p).then(|| make(r))
}

fn between(r: &mut Rng, a: f32, b: f32) -> f32 {
    a + (b - a) * r.next()
}

fn point(r: &mut Rng, from: Vec3, to: Vec3) -> Vec3 {
    from + (to - from) * r.colour()
}

/// 0, 1 or between.
fn share(r: &mut Rng) -> f32 {
    match r.bits() % 3 {
        0 => 0.0,
        1 => 1.0,
        _ => r.next(),
    }
}

fn roughness(r: &mut Rng) -> f32 {
    match r.bits() % 5 {
        0 => 0.0,
        1 => between(r, 0.08, 0.25),
        2 => 1.0,
        _ => r.next(),
    }
}

fn reference(r: &mut Rng, texture: u32) -> Option<TextureRef> {
    chance(r, 0.3, |_| TextureRef {
        texture,
        uv_set: 0,
        transform: Mat3::IDENTITY,
    })
}

fn material(r: &mut Rng) -> Material {
    let mut m = Material {
        base_color: (r.colour() * 0.9 + 0.05).extend(between(r, 0.3, 1.0)),
        base_color_texture: reference(r, COLOUR),
        metallic: share(r),
        roughness: roughness(r),
        metallic_roughness_texture: reference(r, NUMBERS),
        normal_texture: reference(r, NORMALS).map(|t| (t, 1.0)),
        emissive: chance(r, 0.2, Rng::colour).unwrap_or_default(),
        emissive_texture: reference(r, COLOUR),
        alpha_mode: match r.bits() % 5 {
            0 => AlphaMode::Mask { cutoff: 0.5 },
            1 => AlphaMode::Blend,
            _ => AlphaMode::Opaque,
        },
        double_sided: r.next() < 0.5,
        ior: if r.next() < 0.5 {
            1.5
        } else {
            between(r, 1.0, 2.5)
        },
        clearcoat: chance(r, 0.3, |r| Clearcoat {
            factor: share(r),
            factor_texture: reference(r, NUMBERS),
            roughness: roughness(r),
            roughness_texture: reference(r, NUMBERS),
            normal_texture: reference(r, NORMALS).map(|t| (t, 0.5)),
        }),
        transmission: chance(r, 0.35, |r| Transmission {
            factor: share(r),
            texture: reference(r, NUMBERS),
        }),
        unlit: r.next() < 0.06,
        ..Material::default()
    };
    let e = &mut m.extensions;
    e.specular = chance(r, 0.25, |r| Specular {
        factor: share(r),
        factor_texture: reference(r, COLOUR),
        color: r.colour() * 2.0,
        color_texture: reference(r, COLOUR),
    });
    e.sheen = chance(r, 0.25, |r| Sheen {
        color: r.colour(),
        color_texture: reference(r, COLOUR),
        roughness: between(r, 0.1, 1.0),
        roughness_texture: None,
    });
    e.anisotropy = chance(r, 0.2, |r| Anisotropy {
        strength: r.next(),
        rotation_rad: between(r, 0.0, 6.0),
        texture: reference(r, NORMALS),
    });
    e.iridescence = chance(r, 0.2, |r| Iridescence {
        factor: share(r),
        factor_texture: reference(r, NUMBERS),
        ior: between(r, 1.0, 2.0),
        thickness_nm: [100.0, between(r, 100.0, 600.0)],
        thickness_texture: reference(r, NUMBERS),
    });
    e.volume = chance(r, 0.5, |r| Volume {
        thickness: r.next(),
        thickness_texture: reference(r, NUMBERS),
        attenuation_color: r.colour() * 0.9 + 0.05,
        attenuation_distance: between(r, 0.2, 3.0),
    });
    m
}

fn mesh(r: &mut Rng, materials: u32) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for part in 0..1 + r.bits() % 3 {
        let center = match part {
            0 => Vec3::new(0.0, 0.9, 0.0),
            _ => point(r, Vec3::new(-1.2, 0.2, -1.2), Vec3::new(1.2, 1.8, 1.2)),
        };
        let extent = r.colour() * 0.5 + 0.2;
        let shape = match r.bits() % 5 {
            0 => icosphere(center, between(r, 0.4, 1.0), 1 + (r.bits() % 2) as u32),
            1 => cuboid(center - extent, center + extent),
            2 => torus_knot(center, between(r, 0.4, 0.7), 0.15, 36, 5),
            3 => {
                let (u, v) = (square_to_sphere(r.pair()), square_to_sphere(r.pair()));
                quad(center - 0.5 * (u + v), u, v)
            }
            _ => soup(r, center),
        };
        append(&mut mesh, shape, r.bits() as u32 % materials);
    }
    // Any coordinates will do.
    let uv = |p: &Vec3| Vec2::new(0.7 * p.x + 0.3 * p.z, 0.9 * p.y - 0.2 * p.z);
    mesh.uvs[0] = mesh.positions.iter().map(uv).collect();
    mesh.tangents = Vec::new();
    if r.next() < 0.5 {
        let colors = mesh.positions.iter();
        mesh.colors = colors
            .map(|_| r.colour().extend(r.next()))
            .collect::<Vec<Vec4>>();
    }
    mesh
}

/// Triangles anywhere.
fn soup(r: &mut Rng, center: Vec3) -> TriangleMesh {
    let n = 6 + r.bits() as u32 % 20;
    let mut corners = Vec::new();
    for _ in 0..n {
        let at = center + square_to_sphere(r.pair()) * 0.5 * r.next();
        corners.extend((0..3).map(|_| at + square_to_sphere(r.pair()) * 0.5));
    }
    TriangleMesh {
        positions: corners,
        indices: (0..n).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
        materials: vec![0; n as usize],
        ..TriangleMesh::default()
    }
}

fn proxy(r: &mut Rng) -> Proxy {
    match r.bits() % 5 {
        0 => Proxy::None,
        1 => {
            // A floor and a wall.
            let mut mesh = TriangleMesh::default();
            let corner = Vec3::new(-4.0, between(r, -0.3, 0.2), 4.0);
            append(&mut mesh, quad(corner, Vec3::X * 8.0, Vec3::Z * -8.0), 0);
            let corner = Vec3::new(-3.0, -0.3, -1.5);
            append(&mut mesh, quad(corner, Vec3::X * 4.0, Vec3::Y * 3.0), 0);
            append(&mut mesh, icosphere(Vec3::new(1.5, 0.1, 0.8), 0.5, 1), 0);
            mesh.normals = Vec::new();
            Proxy::Mesh(mesh)
        }
        _ => Proxy::Plane(Plane {
            point: Vec3::new(0.0, between(r, -0.3, 0.4), 0.0),
            normal: (Vec3::Y + square_to_sphere(r.pair()) * 0.2).normalize(),
        }),
    }
}

fn camera(r: &mut Rng, size: u32) -> Camera {
    let target = Vec3::new(0.0, 0.7, 0.0);
    let towards = point(r, Vec3::new(-1.0, 0.05, -1.0), Vec3::new(1.0, 1.0, 1.0));
    let back = (towards + Vec3::Z * 1e-3).normalize();
    let right = Vec3::Y.cross(back).normalize();
    let half = 0.5 * size as f32;
    Camera {
        position: target + back * between(r, 2.5, 6.0),
        rotation: Mat3::from_cols(right, back.cross(right), back),
        focal_px: Vec2::splat(half / between(r, 0.3, 0.5)),
        principal_px: Vec2::splat(half),
        resolution: [size; 2],
    }
}

fn light(r: &mut Rng) -> Light {
    let map = {
        let (width, height) = (32, 16);
        let level = r.next();
        let mut texels: Vec<Vec3> = (0..width * height)
            .map(|_| (r.colour() * 0.5 + 0.5) * level)
            .collect();
        if r.next() < 0.6 {
            let sun = width * (2 + r.bits() as usize % 5) + r.bits() as usize % width;
            texels[sun] = (r.colour() * 0.5 + 0.5) * between(r, 10.0, 60.0);
        }
        EnvironmentSampler::new(EnvironmentMap::new(width, height, texels).expect("a map"))
    };
    let lobes = (0..1 + r.bits() % 3).map(|_| SphericalGaussian {
        direction: (square_to_sphere(r.pair()) + Vec3::Y * 0.7).normalize(),
        radiance: r.colour() * 2.0,
        sigma: between(r, 0.1, 0.9),
    });
    let lobes = SgMixture::new(lobes.collect()).expect("lobes");
    match r.bits() % 3 {
        0 => Light::Map(map),
        1 => Light::Lobes(lobes),
        _ => Light::Both(MapWithLobes::new(map, lobes)),
    }
}

/// A coloured one, one of numbers, one of normals.
fn textures(r: &mut Rng, folder: &TempDir) -> Vec<Texture> {
    let texture = |number: u32, encoding, texel: &mut dyn FnMut() -> Vec3| {
        let path = folder.path().join(format!("{number}.png"));
        let texels = (0..16).map(|_| texel()).collect();
        write_png(&path, &DisplayImage(Raster::from_pixels(4, 4, texels))).expect("written");
        Texture {
            image: ImageSource::File(path),
            encoding,
            wrap: [Wrap::Repeat; 2],
            filter: Filter::Linear,
        }
    };
    vec![
        texture(COLOUR, Encoding::Srgb, &mut || r.colour()),
        texture(NUMBERS, Encoding::Linear, &mut || r.colour()),
        texture(NORMALS, Encoding::Linear, &mut || {
            let n = Vec3::Z + square_to_sphere(r.pair()) * 0.5;
            n.normalize() * 0.5 + 0.5
        }),
    ]
}
