//! Small scenes and lights that tests share.
use std::ops::ControlFlow;

use dipir_imaging::transfer::Transfer;
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::warp::square_to_sphere;
use dipir_scene::camera::Camera;
use dipir_scene::material::Material;
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use glam::{Mat3, Vec2, Vec3};

use crate::adaptive::{Progress, Stop};
use crate::features::ALL;
use crate::light::PathLight;
use crate::render::{Rendered, Renderer, Settings, Simulation};

/// A rough dielectric.
pub fn matte(colour: Vec3) -> Material {
    Material {
        base_color: colour.extend(1.0),
        metallic: 0.0,
        ..Material::default()
    }
}

/// A square picture of `n` x `n` pixels, `fov_deg` high.
pub fn camera(position: Vec3, target: Vec3, fov_deg: f32, n: u32) -> Camera {
    let back = (position - target).normalize();
    let up = if back.y.abs() > 0.99 {
        Vec3::Z
    } else {
        Vec3::Y
    };
    let right = up.cross(back).normalize();
    let half = 0.5 * n as f32;
    Camera {
        position,
        rotation: Mat3::from_cols(right, back.cross(right), back),
        focal_px: Vec2::splat(half / (0.5 * fov_deg.to_radians()).tan()),
        principal_px: Vec2::splat(half),
        resolution: [n, n],
    }
}

/// Down a street, four metres before a thing on it; `n` pixels square.
pub fn street(n: u32) -> Camera {
    camera(Vec3::new(0.0, 1.0, 4.0), Vec3::new(0.0, 0.4, 0.0), 40.0, n)
}

/// Sends light of 1, and reflects none.
pub fn glowing() -> Material {
    Material {
        emissive: Vec3::ONE,
        ..matte(Vec3::ZERO)
    }
}

/// The ground: y = 0, seen from above.
pub fn ground() -> Proxy {
    Proxy::Plane(Plane {
        point: Vec3::ZERO,
        normal: Vec3::Y,
    })
}

/// A scene of one material.
pub fn scene(mesh: TriangleMesh, material: Material, camera: Camera, proxy: Proxy) -> Scene {
    Scene {
        mesh,
        materials: vec![material],
        textures: Vec::new(),
        camera,
        proxy,
    }
}

/// The same radiance from everywhere.
pub fn sky(radiance: f32) -> EnvironmentSampler {
    EnvironmentSampler::new(EnvironmentMap::constant(128, 64, Vec3::splat(radiance)))
}

/// A map that is `background` but for the texel that holds `direction`, which is `radiance`.
pub fn sun(direction: Vec3, radiance: f32, background: f32, height: usize) -> EnvironmentMap {
    let mut map = EnvironmentMap::constant(2 * height, height, Vec3::splat(background));
    let (i, j) = map.texel_of(direction);
    let mut texels = map.texels().to_vec();
    texels[i * map.width() + j] = Vec3::splat(radiance);
    map = EnvironmentMap::new(map.width(), height, texels).expect("valid");
    map
}

/// Everything but light of the object on the proxy.
pub fn everything(max_depth: u32) -> Simulation {
    Simulation {
        features: ALL,
        max_depth,
        shadow: true,
        proxy_occlusion: true,
        light_on_proxy: None,
    }
}

/// Lambertian surfaces alone.
pub fn lambertian(max_depth: u32) -> Simulation {
    Simulation {
        features: 0,
        ..everything(max_depth)
    }
}

/// `samples` samples a pixel, errors in linear values.
pub fn settings(samples: u32, seed: u64) -> Settings<'static> {
    Settings {
        seed,
        stop: Stop::Samples(samples),
        transfer: Transfer::Linear,
        shadow_tolerance: 0.0,
        ..Settings::default()
    }
}

/// Renders and forgets the progress.
pub fn render(
    scene: &Scene,
    light: &EnvironmentSampler,
    simulation: &Simulation,
    settings: &Settings,
) -> Rendered {
    Renderer::new(scene)
        .render(light, simulation, settings, &mut carry_on)
        .expect("renders")
}

/// Progress that never breaks off.
pub fn carry_on(_: &Progress) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// The integral of a light's density over the sphere by `n` samples, which must agree with it in radiance and density.
pub fn integral_of_density(light: &impl PathLight, n: u32) -> f64 {
    let mut sum = 0.0f64;
    for s in 0..n {
        let mut r = Sampler::new(0, Stream::TEST, 0, s);
        let drawn = light.sample(r.next_2d());
        let (radiance, pdf) = light.eval_with_pdf(drawn.direction);
        // Splitting a map and joining it again round by an ulp of the luminance, 1/1000 of the excess.
        assert!((pdf / drawn.pdf - 1.0).abs() < 1e-3);
        assert!(radiance.abs_diff_eq(drawn.radiance, 1e-3 * radiance.max_element()));
        sum += f64::from(light.eval_with_pdf(square_to_sphere(r.next_2d())).1);
    }
    sum / f64::from(n) * 4.0 * std::f64::consts::PI
}
