//! Kinds of scene that benches render.
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_render::shapes::{append, icosphere, quad, torus_knot};
use dipir_scene::camera::Camera;
use dipir_scene::material::{AlphaMode, Clearcoat, Material, Transmission};
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use glam::{Mat3, Vec2, Vec3, Vec4};

/// A square picture from above, of `size` pixels a side.
fn camera(size: u32) -> Camera {
    let position = Vec3::new(0.0, 2.0, 4.0);
    let back = (position - Vec3::Y * 0.5).normalize();
    let right = Vec3::Y.cross(back).normalize();
    Camera {
        position,
        rotation: Mat3::from_cols(right, back.cross(right), back),
        focal_px: Vec2::splat(1.4 * size as f32),
        principal_px: Vec2::splat(0.5 * size as f32),
        resolution: [size, size],
    }
}

/// A blue sky with a sun of one texel, over brown ground.
pub fn sky() -> EnvironmentSampler {
    let (width, height) = (1024, 512);
    let mut texels = vec![Vec3::new(0.35, 0.5, 0.8); width * height];
    texels[width * height / 2..].fill(Vec3::new(0.2, 0.18, 0.15));
    texels[130 * width + 400] = Vec3::splat(4e4);
    EnvironmentSampler::new(EnvironmentMap::new(width, height, texels).expect("a valid map"))
}

fn ball() -> TriangleMesh {
    icosphere(Vec3::Y * 0.6, 0.5, 5)
}

fn knot() -> TriangleMesh {
    torus_knot(Vec3::Y * 0.7, 0.4, 0.15, 512, 32)
}

fn ground() -> Proxy {
    Proxy::Plane(Plane {
        point: Vec3::ZERO,
        normal: Vec3::Y,
    })
}

fn matte(grey: f32) -> Material {
    Material {
        base_color: Vec4::new(grey, grey, grey, 1.0),
        metallic: 0.0,
        roughness: 1.0,
        ..Material::default()
    }
}

fn scene(size: u32, mesh: TriangleMesh, material: Material, proxy: Proxy) -> Scene {
    Scene {
        mesh,
        materials: vec![material],
        textures: Vec::new(),
        camera: camera(size),
        proxy,
    }
}

/// A coat of varnish.
fn coat(factor: f32, roughness: f32) -> Option<Clearcoat> {
    Some(Clearcoat {
        factor,
        factor_texture: None,
        roughness,
        roughness_texture: None,
        normal_texture: None,
    })
}

fn gold(roughness: f32) -> Material {
    Material {
        base_color: Vec4::new(0.9, 0.6, 0.2, 1.0),
        metallic: 1.0,
        roughness,
        ..Material::default()
    }
}

/// Name and scene, two more kinds, in which a sun is mirrored in places much smaller than a pixel.
#[allow(dead_code, reason = "not every bench renders them")]
pub fn with_highlights(size: u32) -> Vec<(&'static str, Scene)> {
    let lacquer = Material {
        clearcoat: coat(1.0, 0.03),
        ..matte(0.3)
    };
    let scene = |material| scene(size, knot(), material, ground());
    vec![
        ("polished metal", scene(gold(0.05))),
        ("lacquer", scene(lacquer)),
    ]
}

/// A scene whose light from fold to fold, and onto the ground, is there and does not show.
#[allow(dead_code, reason = "not every bench renders it")]
pub fn black(size: u32) -> (&'static str, Scene) {
    ("black rubber", scene(size, knot(), matte(0.03), ground()))
}

/// Name and scene, ten kinds; square pictures of `size` pixels a side.
pub fn scenes(size: u32) -> Vec<(&'static str, Scene)> {
    let scene = |mesh, material, proxy| scene(size, mesh, material, proxy);
    let mut coloured = ball();
    coloured.colors = coloured
        .normals
        .iter()
        .map(|n| n.abs().extend(1.0))
        .collect();
    let emitter = Material {
        emissive: Vec3::new(0.5, 0.3, 0.1),
        ..matte(0.5)
    };
    let veil = Material {
        base_color: Vec4::new(0.7, 0.7, 0.7, 0.5),
        alpha_mode: AlphaMode::Blend,
        double_sided: true,
        ..matte(0.7)
    };
    let glass = Material {
        roughness: 0.05,
        transmission: Some(Transmission {
            factor: 1.0,
            texture: None,
        }),
        ..matte(0.9)
    };
    let faint = Material {
        emissive: Vec3::splat(1e-3),
        clearcoat: coat(0.01, 0.1),
        ..matte(0.2)
    };
    let sheet = quad(Vec3::new(-0.5, 0.2, 0.0), Vec3::X, Vec3::Y);
    let mut room = quad(
        Vec3::new(-9.0, 0.0, 9.0),
        Vec3::X * 18.0,
        Vec3::NEG_Z * 18.0,
    );
    let wall = quad(Vec3::new(-9.0, 0.0, -1.5), Vec3::X * 18.0, Vec3::Y * 4.0);
    append(&mut room, wall, 0);
    vec![
        ("matte, convex", scene(ball(), matte(0.6), ground())),
        ("matte, concave", scene(knot(), matte(0.8), ground())),
        ("metal", scene(knot(), gold(0.3), ground())),
        ("coloured", scene(coloured, matte(0.9), ground())),
        ("emitter", scene(ball(), emitter, ground())),
        ("half-transparent", scene(sheet, veil, ground())),
        ("glass", scene(ball(), glass, ground())),
        ("no proxy", scene(knot(), matte(0.5), Proxy::None)),
        ("faint coat and glow", scene(knot(), faint, ground())),
        ("proxy mesh", scene(ball(), matte(0.5), Proxy::Mesh(room))),
    ]
}
