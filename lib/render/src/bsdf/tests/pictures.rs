//! Pictures of the extensions beside their closed forms: mesh, camera, light and kernel together, a
//! ray through the middle of each pixel, against the published formulas in f64.
use std::sync::Arc;

use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_scene::camera::Camera;
use dipir_scene::material::{
    Anisotropy, Iridescence, Material, MaterialExtensions, Sheen, Specular, Transmission, Volume,
};
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use glam::{DVec3, Mat3, Vec2, Vec3, Vec4};

use super::super::features::{EXTENSIONS, PLAIN_GGX, SPECULAR, TRANSMISSION};
use super::super::sheen::tests::textbook;
use super::super::thin_film::tests::specified;
use crate::counters::RayCounts;
use crate::foreground::PathContext;
use crate::light::SceneLight;
use crate::render::Renderer;
use crate::testing::everything;

/// Pixels along a side.
const SIZE: u32 = 24;

/// Metres between the two faces of the slab.
const THICKNESS: f32 = 0.1;

/// A slab from y = -.1 to 0 that fills the picture, seen at cosines from .94 to .04.
fn slab(material: Material) -> Scene {
    let (position, target) = (Vec3::new(0.0, 1.5, 1.5), Vec3::new(0.2, 0.0, -0.5));
    let backward = (position - target).normalize();
    let right = Vec3::Y.cross(backward).normalize();
    let corner = |k: usize, y: f32| {
        let (x, z) = [(-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)][k];
        Vec3::new(40.0 * x, y, 40.0 * z)
    };
    let mut mesh = TriangleMesh {
        indices: vec![[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]],
        materials: vec![0; 4],
        ..Default::default()
    };
    for (y, normal) in [(0.0, Vec3::Y), (-THICKNESS, Vec3::NEG_Y)] {
        mesh.positions.extend((0..4).map(|k| corner(k, y)));
        mesh.normals.extend([normal; 4]);
        mesh.tangents.extend([Vec4::new(1.0, 0.0, 0.0, 1.0); 4]);
    }
    Scene {
        mesh,
        materials: vec![material],
        textures: Vec::new(),
        camera: Camera {
            position,
            rotation: Mat3::from_cols(right, backward.cross(right), backward),
            focal_px: Vec2::splat(0.5 * SIZE as f32 / 35f32.to_radians().tan()),
            principal_px: Vec2::splat(0.5 * SIZE as f32),
            resolution: [SIZE; 2],
        },
        proxy: Proxy::Plane(Plane {
            point: Vec3::new(0.0, -1.0, 0.0),
            normal: Vec3::Y,
        }),
    }
}

fn black(extensions: MaterialExtensions) -> Material {
    Material {
        base_color: Vec4::new(0.0, 0.0, 0.0, 1.0),
        metallic: 0.0,
        roughness: 0.0,
        extensions,
        ..Default::default()
    }
}

/// A white sky.
fn sky() -> EnvironmentMap {
    EnvironmentMap::constant(32, 16, Vec3::ONE)
}

/// One texel, so small that it has one direction, and its radiance times its solid angle.
fn sun() -> (EnvironmentMap, DVec3, f64) {
    let (width, height) = (1024, 512);
    let mut texels = vec![Vec3::ZERO; width * height];
    let (row, column) = EnvironmentMap::constant(width, height, Vec3::ONE)
        .texel_of(Vec3::new(0.4, 0.6, -0.7).normalize());
    texels[row * width + column] = Vec3::splat(1e4);
    let map = EnvironmentMap::new(width, height, texels).unwrap();
    let towards = map.direction_of(row, column).as_dvec3();
    let power = 1e4 * map.solid_angle(row);
    (map, towards, power)
}

/// The largest difference of a picture from `exact`, which takes the direction to the viewer with y up,
/// as a share of the picture's largest value. Every pixel must be covered.
fn difference<const F: u32>(
    scene: &Scene,
    map: EnvironmentMap,
    samples: u32,
    exact: impl Fn(DVec3) -> [f64; 3],
) -> f64 {
    let renderer = Renderer::new(scene);
    let world = renderer.world(F).unwrap();
    let sampler = EnvironmentSampler::new(Arc::new(map));
    let light = sampler.on_object();
    let path = PathContext {
        roulette_depth: u32::MAX,
        ..PathContext::from_camera(&world, &light, &everything(4), None)
    };
    let (mut largest, mut worst) = (0.0f64, 0.0f64);
    for p in 0..SIZE * SIZE {
        let at = Vec2::new((p % SIZE) as f32 + 0.5, (p / SIZE) as f32 + 0.5);
        let mut sum = DVec3::ZERO;
        for s in 0..samples {
            let mut draws = Sampler::new(7, Stream::TEST, p, s);
            let one = path.image_sample::<F>(at, &mut draws, &mut RayCounts::default());
            assert_eq!(one.coverage, 1.0);
            sum += one.radiance.as_dvec3();
        }
        let camera = &scene.camera;
        let offset = (at - camera.principal_px) / camera.focal_px;
        let seen =
            camera.rotation.as_dmat3() * DVec3::new(offset.x.into(), -f64::from(offset.y), -1.0);
        let exact = DVec3::from(exact(-seen.normalize()));
        largest = largest.max(exact.max_element());
        worst = worst.max((sum / f64::from(samples) - exact).abs().max_element());
    }
    assert!(largest > 0.01, "nothing is seen: {largest}");
    worst / largest
}

/// z up, as the textbooks have it.
fn up(w: DVec3) -> DVec3 {
    DVec3::new(w.x, -w.z, w.y)
}

#[track_caller]
fn within(what: &str, difference: f64, bound: f64) {
    println!("{what}: {difference:.1e} of the largest value");
    assert!(difference < bound, "{what}: {difference}");
}

#[test]
fn a_picture_of_a_tinted_reflection_is_schlicks_formula() {
    let scene = slab(black(MaterialExtensions {
        specular: Some(Specular {
            factor: 0.7,
            factor_texture: None,
            color: Vec3::new(4.0, 1.0, 0.25),
            color_texture: None,
        }),
        ..Default::default()
    }));
    let exact = |wo: DVec3| {
        let grazing = (1.0 - wo.y).powi(5);
        [4.0, 1.0, 0.25].map(|tint| {
            let f0 = 0.04 * tint * 0.7;
            f0 + (0.7 - f0) * grazing
        })
    };
    let d = difference::<{ SPECULAR | EXTENSIONS }>(&scene, sky(), 1, exact);
    within("specular", d, 1e-6);
}

#[test]
fn a_picture_of_a_film_is_the_specifications_formula() {
    let scene = slab(Material {
        base_color: Vec4::new(0.9, 0.6, 0.3, 1.0),
        metallic: 1.0,
        ..black(MaterialExtensions {
            iridescence: Some(Iridescence {
                factor: 1.0,
                factor_texture: None,
                ior: 1.3,
                thickness_nm: [100.0, 400.0],
                thickness_texture: None,
            }),
            ..Default::default()
        })
    });
    let exact = |wo: DVec3| {
        let base = [0.9, 0.6, 0.3];
        std::array::from_fn(|c| specified(1.3, 400.0, base[c], wo.y)[c])
    };
    let d = difference::<{ SPECULAR | EXTENSIONS }>(&scene, sky(), 1, exact);
    within("iridescence", d, 1e-5);
}

#[test]
fn a_picture_of_sheen_under_a_sun_is_the_textbooks_formula() {
    let color = [1.0, 0.6, 0.2];
    let scene = slab(black(MaterialExtensions {
        specular: Some(Specular {
            factor: 0.0,
            factor_texture: None,
            color: Vec3::ONE,
            color_texture: None,
        }),
        sheen: Some(Sheen {
            color: Vec3::new(1.0, 0.6, 0.2),
            color_texture: None,
            roughness: 0.5,
            roughness_texture: None,
        }),
        ..Default::default()
    }));
    let (map, towards, power) = sun();
    let exact = |wo: DVec3| {
        let value = textbook(0.5, up(wo), up(towards)) * towards.y * power;
        color.map(|c| c * value)
    };
    let d = difference::<{ SPECULAR | EXTENSIONS }>(&scene, map, 64, exact);
    within("sheen", d, 5e-4);
}

/// Without compensation for further bounces, and with separable masking, as Mitsuba's
/// `roughconductor` has it where its Fresnel factor is one.
#[test]
fn a_picture_of_an_anisotropic_highlight_is_the_stretched_lobe() {
    let (roughness, strength) = (0.5f64, 0.8f64);
    let scene = slab(Material {
        base_color: Vec4::ONE,
        metallic: 1.0,
        roughness: roughness as f32,
        ..black(MaterialExtensions {
            anisotropy: Some(Anisotropy {
                strength: strength as f32,
                rotation_rad: 0.0,
                texture: None,
            }),
            ..Default::default()
        })
    });
    let across = roughness * roughness;
    let along = across + (1.0 - across) * strength * strength;
    let (map, towards, power) = sun();
    let exact = |wo: DVec3| {
        let (o, i) = (up(wo), up(towards));
        let h = (o + i).normalize();
        let e = (h.x / along).powi(2) + (h.y / across).powi(2) + h.z.powi(2);
        let d = 1.0 / (std::f64::consts::PI * along * across * e * e);
        let masking = |w: DVec3| {
            let slope = ((along * w.x).powi(2) + (across * w.y).powi(2)) / (w.z * w.z);
            2.0 / (1.0 + (1.0 + slope).sqrt())
        };
        [d * masking(o) * masking(i) / (4.0 * o.z) * power; 3]
    };
    let d = difference::<{ SPECULAR | EXTENSIONS | PLAIN_GGX }>(&scene, map, 64, exact);
    within("anisotropy", d, 1e-3);
}

#[test]
fn a_picture_through_a_coloured_slab_is_beers_law() {
    let color = [0.8f32, 0.4, 0.1];
    let scene = slab(Material {
        base_color: Vec4::ONE,
        transmission: Some(Transmission {
            factor: 1.0,
            texture: None,
        }),
        ..black(MaterialExtensions {
            specular: Some(Specular {
                factor: 0.0,
                factor_texture: None,
                color: Vec3::ONE,
                color_texture: None,
            }),
            volume: Some(Volume {
                thickness: 1.0,
                thickness_texture: None,
                attenuation_color: Vec3::from(color),
                attenuation_distance: 0.2,
            }),
            ..Default::default()
        })
    });
    let exact = |wo: DVec3| {
        let way = f64::from(THICKNESS) / wo.y;
        color.map(|c| f64::from(c).powf(way / 0.2))
    };
    // One path in a thousand draws the reflection at either face, which is black: a standard error of
    // .001 that is left of 2,048.
    let d = difference::<{ SPECULAR | TRANSMISSION | EXTENSIONS }>(&scene, sky(), 2048, exact);
    within("volume", d, 5e-3);
}
