//! Training pictures have a tracer of their own, for direct light only. They must agree with the renderer.
use std::ops::ControlFlow;

use dipir_imaging::raster::{LinearImage, Raster};
use dipir_pretraining::direct_light::{
    DirectLightImages, FIRST_SHADOW_PLANE, Layer, shadow_weights,
};
use dipir_pretraining::lighting::{Sun, SunSkyLight};
use dipir_pretraining::scene::{Framing, GeneratedScene, ObjectSet, Paint, SceneKind, Setting};
use dipir_render::features::SPECULAR;
use dipir_render::render::{Renderer, Simulation};
use dipir_render::transport::{RecordSettings, Transport};
use dipir_scene::camera::Camera;
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use glam::Vec3;

const SIZE: u32 = 40;

/// The renderer's record of a mesh on the ground.
fn transport(mesh: &TriangleMesh, paints: &[Paint], camera: Camera) -> Transport {
    let scene = Scene {
        mesh: mesh.clone(),
        materials: paints.iter().map(Paint::material).collect(),
        textures: vec![],
        camera,
        proxy: Proxy::Plane(Plane {
            point: Vec3::ZERO,
            normal: Vec3::Y,
        }),
    };
    let background = LinearImage(Raster::filled(SIZE as usize, SIZE as usize, Vec3::ZERO));
    let settings = RecordSettings {
        environment: [128, 64],
        samples: 128,
        shadow_samples: 128,
        background: Some(&background),
        ..RecordSettings::new(Simulation {
            features: SPECULAR,
            max_depth: 2,
            shadow: true,
            proxy_occlusion: false,
            light_on_proxy: None,
        })
    };
    let renderer = Renderer::new(&scene);
    Transport::record(&renderer, &settings, &mut |_| ControlFlow::Continue(())).unwrap()
}

/// The square of 8 x 8 pixels that a pixel is in; sums over squares have less noise.
fn square(pixel: usize) -> usize {
    (pixel / SIZE as usize / 8) * 5 + pixel % SIZE as usize / 8
}

/// Summed differences of the sums over squares, and their total.
fn apart(squares: &[[f32; 2]]) -> (f32, f32) {
    let apart = squares.iter().map(|s| (s[0] - s[1]).abs()).sum();
    (apart, squares.iter().map(|s| s[1]).sum())
}

/// A scene without metal under one sun.
fn scene(index: u64, setting: Setting) -> (GeneratedScene, SunSkyLight) {
    let kind = SceneKind {
        objects: ObjectSet::Training,
        setting,
        framing: Framing::Close,
    };
    let mut scene = GeneratedScene::draw(11, index, SIZE, kind);
    for paint in scene.paints.iter_mut().chain([&mut scene.main_paint]) {
        (paint.metallic, paint.roughness) = (false, 0.8);
    }
    let sun = Sun {
        azimuth: 1.0 + 2.0 * index as f32,
        elevation: 0.7,
        sharpness: 150.0,
    };
    scene.suns = vec![sun; scene.suns.len()];
    let light = SunSkyLight::new(0, sun.elevation, (3.0, 0.7), (0.3, 0.1), 1.0);
    (scene, light)
}

#[test]
fn objects_and_shadows_agree_with_the_renderer() {
    for index in 0..3 {
        let (scene, light) = scene(index, Setting::Open);
        let images = DirectLightImages::trace(&scene, 11, index);
        let transport = transport(&scene.main, &[scene.main_paint], scene.camera);
        let map = light.environment(&scene.suns, 128, 64).unwrap();
        let traced = images.layer(Layer::Object, &light);
        let (object, shadow) = (
            transport.foreground(map.texels()),
            transport.shadow(map.texels()),
        );
        let n = (SIZE * SIZE) as usize;
        let mut squares = [[[0f32; 2]; 25]; 2];
        let shares = shadow_weights(&light, &scene.suns);
        for p in 0..n {
            let open = 1.0 - transport.coverage().pixels()[p];
            let seen: Vec3 = shares
                .iter()
                .enumerate()
                .map(|(b, w)| *w * images.planes[(FIRST_SHADOW_PLANE + b) * n + p])
                .sum();
            let pairs = [
                [traced[p], object.pixels()[p]],
                [
                    (Vec3::ONE - seen) * open,
                    (Vec3::ONE - shadow.pixels()[p]) * open,
                ],
            ];
            for (sums, pair) in squares.iter_mut().zip(pairs) {
                for (sum, value) in sums[square(p)].iter_mut().zip(pair) {
                    *sum += value.element_sum();
                }
            }
        }
        for (layer, sums) in ["object", "shadow"].iter().zip(squares) {
            let (apart, total) = apart(&sums);
            // The tracer adds highlights to the diffuse light, which the renderer takes from it: 4 to 8%. A thousandth of
            // every pixel is noise where there is little shadow.
            let allowed = 0.12 * total + 0.001 * 3.0 * n as f32;
            assert!(apart < allowed, "{layer} of {index}: {apart} of {total}");
        }
    }
}

#[test]
fn houses_and_trees_agree_with_the_renderer() {
    for index in 0..3 {
        let (scene, light) = scene(index, Setting::Street);
        let images = DirectLightImages::trace(&scene, 11, index);
        let transport = transport(&scene.others, &scene.paints, scene.camera);
        let map = light.environment(&scene.suns, 128, 64).unwrap();
        let lit = transport.foreground(map.texels());
        let traced = images.layer(Layer::Background, &light);
        let mut squares = [[0f32; 2]; 25];
        let mut covered = 0;
        for p in (0..(SIZE * SIZE) as usize).filter(|p| transport.coverage().pixels()[*p] > 0.999) {
            squares[square(p)][0] += traced[p].element_sum();
            squares[square(p)][1] += lit.pixels()[p].element_sum();
            covered += 1;
        }
        let (apart, total) = apart(&squares);
        assert!(covered > 50, "{covered} pixels of {index} show something");
        // Highlights differ as above.
        assert!(apart < 0.12 * total, "{index}: {apart} of {total}");
    }
}
