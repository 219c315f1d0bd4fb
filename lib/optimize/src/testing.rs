//! Small scenes as dense matrices: a glossy ball on a plane, whose transport is known in closed
//! form, and whatever was recorded.
use std::f32::consts::PI;
use std::ops::ControlFlow;

use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::cosine::CosineCells;
use dipir_light::environment::EnvironmentMap;
use dipir_render::features::SPECULAR;
use dipir_render::render::{Renderer, Simulation};
use dipir_render::shapes::torus_knot;
use dipir_render::transport::{RecordSettings, Transport};
use dipir_scene::camera::{Camera, FieldOfView};
use dipir_scene::material::Material;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use glam::Vec3;

use crate::objective::{Objective, TermWeights};
use crate::settings::LightPreset;
use crate::transport::LinearTransport;

/// Little work.
pub const PRESET: LightPreset = LightPreset {
    iterations: 200,
    lobes: 16,
    environment: [64, 32],
    samples: 64,
    size: 192,
};

/// Transport as matrices: for every pixel the texels that it sees.
#[derive(Clone, Debug)]
pub struct DenseTransport {
    pub size: (usize, usize),
    pub environment: (usize, usize),
    pub coverage: Raster<f32>,
    /// Weights of the object by pixel, then texel; empty for a pixel without object.
    pub object: Vec<Vec<Vec3>>,
    /// Weights of what the ball blocks, by pixel, then texel; empty for a pixel without plane.
    pub blocked: Vec<Vec<f32>>,
    /// Cosine-weighted solid angle of every texel above the plane.
    pub arriving: Vec<f32>,
    /// What [`LinearTransport::efficiency`] says.
    pub efficiency: f64,
}

const CENTRE: Vec3 = Vec3::new(0.0, 0.5, 0.0);
const RADIUS: f32 = 0.5;
const ALBEDO: Vec3 = Vec3::new(0.6, 0.45, 0.3);
const GLOSS: f32 = 0.25;
const EXPONENT: f32 = 24.0;
/// Rays along each side of a pixel.
const RAYS: usize = 3;
/// Directions along each side of a texel.
const DIRECTIONS: usize = 3;

impl DenseTransport {
    /// The ball seen from the front and above, by `size` pixels, under `environment` texels.
    pub fn ball(size: (usize, usize), environment: (usize, usize)) -> Self {
        let map = EnvironmentMap::constant(environment.0, environment.1, Vec3::ZERO);
        let directions = texel_directions(&map);
        let areas: Vec<f32> = (0..environment.0 * environment.1)
            .map(|t| map.solid_angle(t / environment.0) as f32)
            .collect();
        let mean = |t: usize, f: &dyn Fn(Vec3) -> f32| {
            let sum: f32 = directions[t].iter().map(|d| f(*d)).sum();
            areas[t] * sum / directions[t].len() as f32
        };
        let texels = areas.len();
        let arriving = (0..texels).map(|t| mean(t, &|w| w.y.max(0.0))).collect();
        let (mut coverage, mut object, mut blocked) = (vec![], vec![], vec![]);
        for pixel in 0..size.0 * size.1 {
            let mut covered = 0.0;
            let (mut row, mut shadow) = (vec![], vec![]);
            for ray in 0..RAYS * RAYS {
                let within = |k: usize| (k as f32 + 0.5) / RAYS as f32;
                let x = (pixel % size.0) as f32 + within(ray % RAYS);
                let y = (pixel / size.0) as f32 + within(ray / RAYS);
                let (origin, v) = camera_ray(size, x, y);
                let share = 1.0 / (RAYS * RAYS) as f32;
                if let Some(t) = hit_ball(origin, v) {
                    covered += share;
                    row.resize(texels, Vec3::ZERO);
                    let n = (origin + v * t - CENTRE) / RADIUS;
                    let mirror = v - 2.0 * v.dot(n) * n;
                    for (k, weight) in row.iter_mut().enumerate() {
                        let diffuse = mean(k, &|w| w.dot(n).max(0.0)) / PI;
                        let lobe = (EXPONENT + 1.0) / (2.0 * PI);
                        let gloss = mean(k, &|w| lobe * w.dot(mirror).max(0.0).powf(EXPONENT));
                        *weight += share * (ALBEDO * diffuse + GLOSS * gloss);
                    }
                }
            }
            let (origin, v) = camera_ray(
                size,
                (pixel % size.0) as f32 + 0.5,
                (pixel / size.0) as f32 + 0.5,
            );
            if v.y < -1e-3 {
                let point = origin - v * (origin.y / v.y);
                let hits = |w: Vec3| {
                    if hit_ball(point, w).is_some() {
                        w.y.max(0.0)
                    } else {
                        0.0
                    }
                };
                shadow = (0..texels).map(|t| mean(t, &hits)).collect();
            }
            coverage.push(covered);
            object.push(row);
            blocked.push(shadow);
        }
        Self {
            size,
            environment,
            coverage: Raster::from_pixels(size.0, size.1, coverage),
            object,
            blocked,
            arriving,
            efficiency: 1.0,
        }
    }

    /// What a record holds, read off its pictures under single texels. Its plane is y = 0.
    pub fn of(record: &Transport) -> Self {
        let ([width, height], [columns, rows]) = (record.size(), record.environment_size());
        let cells = CosineCells::new(columns, rows, Vec3::Y);
        let arriving: Vec<f32> = (0..rows)
            .flat_map(|i| cells.row(i).map(|e| e as f32).collect::<Vec<_>>())
            .collect();
        let (pixels, texels) = (width * height, columns * rows);
        let mut object = vec![vec![Vec3::ZERO; texels]; pixels];
        let mut blocked = vec![vec![0.0; texels]; pixels];
        let white = vec![Vec3::ONE; texels];
        let all: f64 = arriving.iter().map(|&e| f64::from(e)).sum();
        let shaded = record.shadow(&white);
        for t in 0..texels {
            let mut light = vec![Vec3::ZERO; texels];
            light[t] = Vec3::ONE;
            let picture = record.foreground(&light);
            // A texel more beside white light, whose ratio does not touch 0.
            let e = f64::from(arriving[t]);
            let more = 0.1 * all / e.max(1e-3 * all);
            light = white.clone();
            light[t] += more as f32;
            let more = f64::from(light[t].x) - 1.0;
            let ratio = record.shadow(&light);
            for p in 0..pixels {
                object[p][t] = picture.pixels()[p];
                let lost = |r: &Raster<Vec3>| 1.0 - f64::from(r.pixels()[p].x);
                let both = lost(&ratio) * (all + more * e);
                blocked[p][t] = ((both - lost(&shaded) * all) / more) as f32;
            }
        }
        Self {
            size: (width, height),
            environment: (columns, rows),
            coverage: record.coverage().clone(),
            object,
            blocked,
            arriving,
            efficiency: 1.0,
        }
    }

    fn arriving(&self, light: &[Vec3]) -> Vec3 {
        light.iter().zip(&self.arriving).map(|(l, e)| *l * *e).sum()
    }

    fn raster(&self, pixels: Vec<Vec3>) -> Raster<Vec3> {
        Raster::from_pixels(self.size.0, self.size.1, pixels)
    }
}

/// A knot of a material above y = 0, recorded.
pub fn recorded(
    (width, height): (usize, usize),
    (columns, rows): (usize, usize),
    roughness: f32,
    metallic: f32,
) -> Transport {
    let scene = Scene {
        mesh: torus_knot(Vec3::Y * 0.9, 0.45, 0.17, 64, 10),
        materials: vec![Material {
            base_color: Vec3::new(0.8, 0.6, 0.4).extend(1.0),
            roughness,
            metallic,
            ..Material::default()
        }],
        textures: Vec::new(),
        camera: Camera::look_at(
            Vec3::new(0.0, 2.0, 4.0),
            Vec3::Y * 0.5,
            Vec3::Y,
            FieldOfView::Vertical(0.6),
            [width as u32, height as u32],
        ),
        proxy: Proxy::Plane(Plane {
            point: Vec3::ZERO,
            normal: Vec3::Y,
        }),
    };
    let settings = RecordSettings {
        environment: [columns, rows],
        samples: 64,
        shadow_samples: 64,
        ..RecordSettings::new(Simulation {
            features: SPECULAR,
            max_depth: 3,
            shadow: true,
            proxy_occlusion: false,
            light_on_proxy: None,
        })
    };
    Transport::record(&Renderer::new(&scene), &settings, &mut |_| {
        ControlFlow::Continue(())
    })
    .unwrap()
}

fn texel_directions(map: &EnvironmentMap) -> Vec<Vec<Vec3>> {
    let (width, height) = (map.width(), map.height());
    let within = |k: usize| (k as f32 + 0.5) / DIRECTIONS as f32;
    let direction = |t: usize, k: usize| {
        let phi = 2.0 * PI * ((t % width) as f32 + within(k % DIRECTIONS)) / width as f32;
        let theta = PI * ((t / width) as f32 + within(k / DIRECTIONS)) / height as f32;
        Vec3::new(
            phi.sin() * theta.sin(),
            theta.cos(),
            -phi.cos() * theta.sin(),
        )
    };
    let of = |t: usize| {
        (0..DIRECTIONS * DIRECTIONS)
            .map(|k| direction(t, k))
            .collect()
    };
    (0..width * height).map(of).collect()
}

fn camera_ray(size: (usize, usize), x: f32, y: f32) -> (Vec3, Vec3) {
    let origin = Vec3::new(0.0, 1.7, 3.2);
    let back = (origin - Vec3::new(0.0, 0.35, 0.0)).normalize();
    let right = Vec3::Y.cross(back).normalize();
    let up = back.cross(right);
    let scale = 2.0 * 0.42 / size.1 as f32;
    let (px, py) = (
        (x - 0.5 * size.0 as f32) * scale,
        (0.5 * size.1 as f32 - y) * scale,
    );
    (origin, (right * px + up * py - back).normalize())
}

fn hit_ball(origin: Vec3, v: Vec3) -> Option<f32> {
    let o = origin - CENTRE;
    let b = o.dot(v);
    let root = b * b - (o.length_squared() - RADIUS * RADIUS);
    (root > 0.0 && b < 0.0).then(|| -b - root.sqrt())
}

impl LinearTransport for DenseTransport {
    fn size(&self) -> (usize, usize) {
        self.size
    }

    fn environment_size(&self) -> (usize, usize) {
        self.environment
    }

    fn coverage(&self) -> &Raster<f32> {
        &self.coverage
    }

    fn foreground(&self, light: &[Vec3]) -> Raster<Vec3> {
        let pixel = |row: &Vec<Vec3>| row.iter().zip(light).map(|(w, l)| *w * *l).sum();
        self.raster(self.object.iter().map(pixel).collect())
    }

    fn foreground_vjp(&self, gradient: &[Vec3]) -> Vec<Vec3> {
        let mut sums = vec![Vec3::ZERO; self.arriving.len()];
        for (row, g) in self.object.iter().zip(gradient) {
            sums.iter_mut()
                .zip(row)
                .for_each(|(sum, w)| *sum += *w * *g);
        }
        sums
    }

    fn shadow(&self, light: &[Vec3]) -> Raster<Vec3> {
        let arriving = self.arriving(light).max(Vec3::splat(1e-30));
        let pixel = |row: &Vec<f32>| {
            let sum: Vec3 = row.iter().zip(light).map(|(w, l)| *l * *w).sum();
            (Vec3::ONE - sum / arriving).max(Vec3::ZERO)
        };
        self.raster(self.blocked.iter().map(pixel).collect())
    }

    fn shadow_vjp(&self, light: &[Vec3], ratio: &Raster<Vec3>, gradient: &[Vec3]) -> Vec<Vec3> {
        let arriving = self.arriving(light).max(Vec3::splat(1e-30));
        let mut sums = vec![Vec3::ZERO; light.len()];
        let mut by_arriving = Vec3::ZERO;
        for ((row, r), g) in self.blocked.iter().zip(ratio.pixels()).zip(gradient) {
            let free = Vec3::select(r.cmpgt(Vec3::ZERO), *g, Vec3::ZERO);
            let slope = free / arriving;
            sums.iter_mut()
                .zip(row)
                .for_each(|(sum, w)| *sum -= slope * *w);
            by_arriving += slope * (Vec3::ONE - *r);
        }
        sums.iter_mut()
            .zip(&self.arriving)
            .for_each(|(sum, e)| *sum += by_arriving * *e);
        sums
    }

    fn efficiency(&self, _: &[Vec3]) -> f64 {
        self.efficiency
    }
}

/// A background whose brightness varies, dark enough that nothing clips.
pub fn background(size: (usize, usize)) -> LinearImage {
    let pixel = |k: usize| {
        let (x, y) = ((k % size.0) as f32, (k / size.0) as f32);
        Vec3::new(
            0.35 + 0.1 * (0.7 * x).sin(),
            0.3 + 0.1 * (0.9 * y).cos(),
            0.25,
        )
    };
    LinearImage(Raster::from_pixels(
        size.0,
        size.1,
        (0..size.0 * size.1).map(pixel).collect(),
    ))
}

/// The paper's weights.
pub const WEIGHTS: TermWeights = TermWeights {
    consistency: 0.03,
    regularizer: 0.01,
};

/// The ball over [`background`], displayed through sRGB.
pub fn objective(transport: impl LinearTransport + 'static, weights: TermWeights) -> Objective {
    let background = background(transport.size());
    Objective::new(Box::new(transport), background, Transfer::Srgb, weights).unwrap()
}
