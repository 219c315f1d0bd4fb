//! Pictures of the square: the photograph, and the panorama that is its light.
use std::ops::ControlFlow;

use dipir_imaging::raster::{LinearImage, Raster};
use dipir_light::environment::EnvironmentMap;
use dipir_light::environment::EnvironmentSampler;
use dipir_light::luminance::luminance;
use dipir_render::adaptive::Stop;
use dipir_render::features::{SPECULAR, TEXTURES};
use dipir_render::render::{Renderer, Settings, Simulation};
use dipir_scene::camera::Camera;
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;
use glam::{Mat3, Vec2, Vec3};
use rayon::prelude::*;

use crate::sky::Sky;
use crate::square::Square;

/// The sky as a light: every texel the mean over its cell, the sun's energy exact.
fn sky_map(sky: &Sky, width: usize) -> EnvironmentMap {
    let height = width / 2;
    let black = EnvironmentMap::constant(width, height, Vec3::ZERO);
    let mut texels: Vec<Vec3> = (0..width * height)
        .into_par_iter()
        .map(|n| mean_over_texel(&black, n / width, n % width, |d| sky.without_sun(d)))
        .collect();
    add_sun(sky, &black, &mut texels, |_| 1.0);
    EnvironmentMap::new(width, height, texels).unwrap_or(black)
}

fn mean_over_texel(map: &EnvironmentMap, i: usize, j: usize, f: impl Fn(Vec3) -> Vec3) -> Vec3 {
    const SIDE: usize = 4;
    let (theta, phi) = map.bounds_rad(i, j);
    let mut sum = Vec3::ZERO;
    for k in 0..SIDE * SIDE {
        let t = |b: [f64; 2], n: usize| b[0] + (b[1] - b[0]) * (n as f64 + 0.5) / SIDE as f64;
        let (theta, phi) = (t(theta, k % SIDE), t(phi, k / SIDE));
        let d = [
            phi.sin() * theta.sin(),
            theta.cos(),
            -phi.cos() * theta.sin(),
        ];
        sum += f(Vec3::from_array(d.map(|x| x as f32)));
    }
    sum / (SIDE * SIDE) as f32
}

/// Spreads the sun's irradiance over the texels that its disc covers, by area, times `visible`.
fn add_sun(sky: &Sky, map: &EnvironmentMap, texels: &mut [Vec3], visible: impl Fn(Vec3) -> f32) {
    const POINTS: usize = 4096;
    let (side, up) = (sky.sun.any_orthonormal_vector(), Vec3::ZERO);
    let up = up + sky.sun.cross(side);
    for k in 0..POINTS {
        // Vogel's spiral: equal areas.
        let r = sky.sun_radius_rad * ((k as f32 + 0.5) / POINTS as f32).sqrt();
        let (s, c) = (k as f32 * 2.399_963_2).sin_cos();
        let d = (sky.sun + r * (c * side + s * up)).normalize();
        let (i, j) = map.texel_of(d);
        let share = visible(d) / (POINTS as f32 * map.solid_angle(i) as f32);
        texels[i * map.width() + j] += sky.sun_irradiance * share;
    }
}

/// A camera at `position` whose right, up and backward axes are the columns of `rotation`.
pub fn camera(position: Vec3, rotation: Mat3, fov_deg: f32, size: [u32; 2]) -> Camera {
    let focal = 0.5 * size[1] as f32 / (0.5 * fov_deg.to_radians()).tan();
    Camera {
        position,
        rotation,
        focal_px: Vec2::splat(focal),
        principal_px: Vec2::new(size[0] as f32, size[1] as f32) * 0.5,
        resolution: size,
    }
}

/// Radiance of the square and the share of each pixel that it covers; the rest is sky.
fn render(
    square: &Square,
    sky: &EnvironmentSampler,
    camera: Camera,
    samples: u32,
    seed: u64,
) -> anyhow::Result<(Raster<Vec3>, Raster<f32>)> {
    let scene = Scene {
        mesh: square.mesh.clone(),
        materials: square.materials.clone(),
        textures: square.textures.clone(),
        camera,
        proxy: Proxy::None,
    };
    let simulation = Simulation {
        features: SPECULAR | TEXTURES,
        max_depth: 4,
        shadow: false,
        proxy_occlusion: false,
        light_on_proxy: None,
    };
    let settings = Settings {
        seed,
        stop: Stop::Samples(samples),
        max_samples: samples,
        ..Settings::default()
    };
    let rendered = Renderer::new(&scene).render(sky, &simulation, &settings, &mut |_| {
        ControlFlow::Continue(())
    })?;
    Ok((rendered.film.object, rendered.film.alpha))
}

/// What a camera sees of square and sky.
pub fn photograph(
    square: &Square,
    sky: &Sky,
    camera: Camera,
    samples: u32,
) -> anyhow::Result<LinearImage> {
    let light = EnvironmentSampler::new(sky_map(sky, 1024));
    // Sunlight by way of a window pane is found by few paths and leaves specks: of five pictures
    // the mean of the middle three, pixel by pixel.
    let pictures = (0..5)
        .map(|seed| render(square, &light, camera, samples.div_ceil(5), seed))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let alpha = &pictures[0].1;
    let middle = |n: usize| {
        let mut values: Vec<Vec3> = pictures.iter().map(|p| p.0.pixels()[n]).collect();
        values.sort_by(|a, b| luminance(*a).total_cmp(&luminance(*b)));
        (values[1] + values[2] + values[3]) / 3.0
    };
    let mut image = Raster::from_pixels(
        alpha.width(),
        alpha.height(),
        (0..alpha.pixels().len()).map(middle).collect(),
    );
    let width = image.width();
    image
        .pixels_mut()
        .par_iter_mut()
        .enumerate()
        .for_each(|(n, p)| {
            let left = 1.0 - alpha.pixels()[n];
            if left > 0.0 {
                let corner = Vec2::new((n % width) as f32, (n / width) as f32);
                const SIDE: usize = 3;
                let offset = |k: usize| (k as f32 + 0.5) / SIDE as f32;
                let seen: Vec3 = (0..SIDE * SIDE)
                    .map(|k| camera.ray(corner + Vec2::new(offset(k % SIDE), offset(k / SIDE))))
                    .map(|ray| sky.without_sun(ray.direction))
                    .sum();
                *p += left * seen / (SIDE * SIDE) as f32;
            }
        });
    Ok(LinearImage(image))
}

/// What is seen from `position` in every direction.
pub fn panorama(
    square: &Square,
    sky: &Sky,
    position: Vec3,
    width: usize,
    samples: u32,
) -> anyhow::Result<EnvironmentMap> {
    let face = (width / 3) as u32;
    let light = EnvironmentSampler::new(sky_map(sky, 1024));
    // Right, up and backward axes of the six faces of a cube.
    let axes = [
        (Vec3::X, Vec3::Y),
        (Vec3::NEG_Z, Vec3::Y),
        (Vec3::NEG_X, Vec3::Y),
        (Vec3::Z, Vec3::Y),
        (Vec3::X, Vec3::NEG_Z),
        (Vec3::X, Vec3::Z),
    ];
    let faces = axes
        .iter()
        .map(|&(right, up)| {
            let camera = camera(
                position,
                Mat3::from_cols(right, up, right.cross(up)),
                90.0,
                [face, face],
            );
            let (image, alpha) = render(square, &light, camera, samples, 0)?;
            Ok((camera, image, alpha))
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    let look_up = |d: Vec3| {
        let (camera, image, alpha) = faces
            .iter()
            .max_by(|a, b| {
                let towards = |c: &Camera| -c.rotation.z_axis.dot(d);
                towards(&a.0).total_cmp(&towards(&b.0))
            })
            .unwrap_or(&faces[0]);
        let p = camera.project(position + d).unwrap_or_default();
        let clamp = |x: f32| (x.max(0.0) as usize).min(face as usize - 1);
        let at = (clamp(p.x), clamp(p.y));
        (*image.get(at.0, at.1), *alpha.get(at.0, at.1))
    };
    let black = EnvironmentMap::constant(width, width / 2, Vec3::ZERO);
    let mut texels: Vec<Vec3> = (0..width * width / 2)
        .into_par_iter()
        .map(|n| {
            mean_over_texel(&black, n / width, n % width, |d| {
                let (rgb, alpha) = look_up(d);
                rgb + (1.0 - alpha) * sky.without_sun(d)
            })
        })
        .collect();
    add_sun(sky, &black, &mut texels, |d| 1.0 - look_up(d).1);
    Ok(EnvironmentMap::new(width, width / 2, texels)?)
}
