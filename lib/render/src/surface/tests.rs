use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_numerics::hashing::hash_u64s;
use dipir_scene::camera::Camera;
use dipir_scene::proxy::Proxy;
use dipir_scene::texture::{Encoding, Filter, ImageSource, Texture, Wrap};
use glam::Mat3;

use super::*;
use crate::bsdf::features::ALL;
use crate::shapes;

/// A unit square in the plane z = 0 that faces +z, its texture upright: v points down.
fn square() -> TriangleMesh {
    let mut mesh = shapes::quad(Vec3::ZERO, Vec3::X, Vec3::Y);
    for uv in &mut mesh.uvs[0] {
        uv.y = 1.0 - uv.y;
    }
    mesh
}

/// A texture of one colour (display values), as a file in `folder`.
fn texture(folder: &std::path::Path, name: &str, encoding: Encoding, color: Vec3) -> Texture {
    let path = folder.join(name);
    write_png(&path, &DisplayImage(Raster::filled(2, 2, color))).unwrap();
    Texture {
        image: ImageSource::File(path),
        encoding,
        wrap: [Wrap::Repeat; 2],
        filter: Filter::Linear,
    }
}

fn reference(texture: u32) -> TextureRef {
    TextureRef {
        texture,
        uv_set: 0,
        transform: Mat3::IDENTITY,
    }
}

fn scene(mesh: TriangleMesh, material: Material, textures: Vec<Texture>) -> Scene {
    Scene {
        mesh,
        materials: vec![material],
        textures,
        camera: Camera {
            position: Vec3::Z,
            rotation: Mat3::IDENTITY,
            focal_px: Vec2::ONE,
            principal_px: Vec2::ZERO,
            resolution: [1, 1],
        },
        proxy: Proxy::None,
    }
}

#[test]
fn back_faces_turn_both_normals_to_the_viewer() {
    let mut mesh = square();
    mesh.normals = vec![Vec3::new(0.3, 0.0, 1.0).normalize(); 4];
    let scene = scene(mesh, Material::default(), Vec::new());
    let surfaces = Surfaces::new(&scene, ALL).unwrap();
    let front = surfaces.interact::<ALL>(-Vec3::Z, 0, 0.2, 0.3);
    let back = surfaces.interact::<ALL>(Vec3::Z, 0, 0.2, 0.3);
    assert!(front.front_face && !back.front_face);
    assert_eq!(front.geometric_normal, Vec3::Z);
    assert_eq!(back.geometric_normal, -Vec3::Z);
    assert!(back.normal.abs_diff_eq(-front.normal, 1e-6));
    assert_eq!(front.position, back.position);
    // Weights of vertices 1 and 2 of (0,0), (1,0), (1,1).
    assert!(front.position.abs_diff_eq(Vec3::new(0.5, 0.3, 0.0), 1e-7));
}

#[test]
fn factors_textures_and_vertex_colours_multiply_in_linear_light() {
    let folder = tempfile::tempdir().unwrap();
    let textures = vec![
        texture(
            folder.path(),
            "color.png",
            Encoding::Srgb,
            Vec3::splat(128.0 / 255.0),
        ),
        texture(
            folder.path(),
            "mr.png",
            Encoding::Linear,
            Vec3::new(0.0, 0.2, 0.6),
        ),
    ];
    let mut mesh = square();
    mesh.colors = vec![Vec4::new(0.5, 1.0, 1.0, 1.0); 4];
    let material = Material {
        base_color: Vec4::new(1.0, 0.5, 1.0, 1.0),
        base_color_texture: Some(reference(0)),
        metallic: 0.5,
        roughness: 0.5,
        metallic_roughness_texture: Some(reference(1)),
        ..Material::default()
    };
    let scene = scene(mesh, material, textures);
    let all = Surfaces::new(&scene, ALL).unwrap();
    let p = all.interact::<ALL>(-Vec3::Z, 1, 0.1, 0.1);
    // sRGB 128 is 0.2158605 in linear light.
    let expected = 0.215_860_5 * Vec3::new(0.5, 0.5, 1.0);
    assert!(p.base_color.abs_diff_eq(expected, 1e-5), "{}", p.base_color);
    // Green is roughness and blue metalness.
    assert!((p.roughness - 0.1).abs() < 1e-6 && (p.metallic - 0.3).abs() < 1e-6);
    let mut grey = scene.clone();
    grey.materials[0].metallic_is_textured = false;
    let grey = Surfaces::new(&grey, ALL).unwrap();
    let p = grey.interact::<ALL>(-Vec3::Z, 1, 0.1, 0.1);
    assert!((p.roughness - 0.1).abs() < 1e-6 && p.metallic == 0.5);
    // What the plan leaves out is not there, even for a kernel that could show it.
    let plain = Surfaces::new(&scene, SPECULAR).unwrap();
    assert!(plain.textures.iter().all(Option::is_none));
    let p = plain.interact::<ALL>(-Vec3::Z, 1, 0.1, 0.1);
    assert_eq!(p.base_color, Vec3::new(1.0, 0.5, 1.0));
    assert_eq!((p.roughness, p.metallic), (0.5, 0.5));
}

#[test]
fn a_normal_map_tilts_to_the_right_and_up_of_its_image_with_and_without_tangents() {
    let folder = tempfile::tempdir().unwrap();
    // +X by 0.6, +Y by 0: red above the middle; then the same for green.
    for (color, tilt) in [
        (Vec3::new(0.8, 0.5, 0.9), Vec3::new(0.6, 0.0, 0.8)),
        (Vec3::new(0.5, 0.8, 0.9), Vec3::new(0.0, 0.6, 0.8)),
    ] {
        let material = Material {
            normal_texture: Some((reference(0), 1.0)),
            ..Material::default()
        };
        let normals = texture(folder.path(), "n.png", Encoding::Linear, color);
        let mut with = square();
        with.normals = vec![Vec3::Z; 4];
        with.tangents = vec![Vec4::new(1.0, 0.0, 0.0, 1.0); 4];
        let mut mirrored = square();
        for uv in &mut mirrored.uvs[0] {
            uv.x = 1.0 - uv.x;
        }
        let mut mirrored_with = mirrored.clone();
        mirrored_with.tangents = vec![Vec4::new(-1.0, 0.0, 0.0, -1.0); 4];
        let flip = Vec3::new(-1.0, 1.0, 1.0);
        for (mesh, expected) in [
            (square(), tilt),
            (with, tilt),
            (mirrored, tilt * flip),
            (mirrored_with, tilt * flip),
        ] {
            let scene = scene(mesh, material.clone(), vec![normals.clone()]);
            let surfaces = Surfaces::new(&scene, ALL).unwrap();
            let p = surfaces.interact::<ALL>(-Vec3::Z, 0, 0.3, 0.3);
            // 8 bits a channel: half a step is 0.004.
            assert!(
                p.normal.abs_diff_eq(expected, 6e-3),
                "{} {expected}",
                p.normal
            );
        }
    }
}

#[test]
fn alpha_masks_cut_and_blends_are_a_chance() {
    let mut material = Material {
        base_color: Vec4::new(1.0, 1.0, 1.0, 0.5),
        ..Material::default()
    };
    let mut mesh = square();
    mesh.colors = vec![Vec4::new(1.0, 1.0, 1.0, 0.5); 4];
    for (mode, expected) in [
        (AlphaMode::Opaque, 1.0),
        (AlphaMode::Blend, 0.25),
        (AlphaMode::Mask { cutoff: 0.25 }, 1.0),
        (AlphaMode::Mask { cutoff: 0.26 }, 0.0),
    ] {
        material.alpha_mode = mode;
        let scene = scene(mesh.clone(), material.clone(), Vec::new());
        let all = Surfaces::new(&scene, ALL).unwrap();
        assert_eq!(all.coverage::<ALL>(0, 0.3, 0.3), expected, "{mode:?}");
        assert_eq!(all.has_alpha(0), mode != AlphaMode::Opaque);
        let without = Surfaces::new(&scene, ALL & !ALPHA).unwrap();
        assert_eq!(without.coverage::<ALL>(0, 0.3, 0.3), 1.0);
    }
}

#[test]
fn zero_area_triangles_and_zero_normals_still_give_unit_vectors() {
    let mut mesh = square();
    mesh.positions = vec![Vec3::ONE; 4];
    mesh.normals = vec![Vec3::ZERO; 4];
    let scene = scene(mesh, Material::default(), Vec::new());
    let surfaces = Surfaces::new(&scene, ALL).unwrap();
    let p = surfaces.interact::<ALL>(Vec3::X, 0, 0.5, 0.5);
    assert!(p.normal.is_normalized() && p.geometric_normal.is_normalized());
    assert!(p.normal.dot(-Vec3::X) > 0.0);
}

#[test]
fn visible_normals_face_the_viewer_and_mirror_above_the_surface() {
    let random = |i: u64| {
        let u = |d: u64| (hash_u64s(&[i, d]) >> 40) as f32 / 16_777_216.0;
        let z = 2.0 * u(0) - 1.0;
        let r = (1.0 - z * z).sqrt();
        let (s, c) = (std::f32::consts::TAU * u(1)).sin_cos();
        Vec3::new(r * c, r * s, z)
    };
    for i in 0..20_000 {
        let (geometric, mut wo) = (random(3 * i), random(3 * i + 1));
        wo *= 1f32.copysign(wo.dot(geometric));
        let normal = (geometric + random(3 * i + 2)).normalize();
        let bent = visible_normal(normal, geometric, wo);
        assert!(bent.is_normalized(), "{bent}");
        assert!(bent.dot(wo) >= 0.0, "{bent} {wo}");
        // The mirror direction's height, up to the rounding of a few unit vectors.
        let mirrored = 2.0 * bent.dot(wo) * bent - wo;
        assert!(mirrored.dot(geometric) > -1e-6, "{geometric} {wo} {normal}");
        assert_eq!(visible_normal(geometric, geometric, wo), geometric);
        // Continuous: a thousandth of a radian moves the result by no more than a few.
        let near = (normal + 1e-3 * random(3 * i + 5)).normalize();
        let moved = (visible_normal(near, geometric, wo) - bent).length();
        assert!(
            moved < 0.05 || wo.dot(geometric) < 0.05,
            "{moved}: {geometric} {wo} {normal}"
        );
    }
}
