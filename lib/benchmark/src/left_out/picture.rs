//! Rendering a scene under a light, and laying it over the photograph.
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

use dipir_evaluation::results::write;
use dipir_imaging::composite::composite;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::tone::{ToneCurves, ToneParameters};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_render::adaptive::Stop;
use dipir_render::effects::EffectsPlan;
use dipir_render::render::{Renderer, Settings};
use dipir_scene::texture::ImageSource;
use dipir_stages::names;
use glam::Vec3;

use super::scene::{DrawnScene, SIDE};

/// What is done to the object's light before it is laid over the photograph.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Curve {
    /// Nothing: light is on the photograph's scale.
    None,
    /// `x / (1 + x)`, the photographs' curve.
    Reinhard,
    /// Straight in the shadows, rolled off in the lights.
    RollOff,
}

/// A rendered object and its shadow.
#[derive(Clone)]
pub struct Layers {
    /// Radiance, premultiplied.
    pub object: LinearImage,
    /// Coverage.
    pub alpha: Raster<f32>,
    /// Ratio of light with the object to light without it.
    pub shadow: LinearImage,
}

impl Layers {
    /// Renders `scene` under `light`, or reads what an earlier run rendered into `cache`.
    pub fn render(
        scene: &DrawnScene,
        light: &Arc<EnvironmentMap>,
        target_error: f32,
        cache: &Path,
    ) -> anyhow::Result<Self> {
        let file = cache.join(key(scene, light, target_error));
        if let Some(layers) = std::fs::read(&file).ok().and_then(|b| Self::from_bytes(&b)) {
            return Ok(layers);
        }
        let settings = Settings {
            stop: Stop::TargetError(target_error),
            max_samples: 1024,
            background: Some(&scene.photo),
            highlights: false,
            ..Settings::default()
        };
        let renderer = Renderer::new(&scene.scene);
        let simulation = EffectsPlan::everything(&scene.scene, &settings).simulation();
        let light = EnvironmentSampler::new(light.clone());
        let rendered = renderer.render(&light, &simulation, &settings, &mut |_| {
            ControlFlow::Continue(())
        })?;
        let layers = Self {
            object: LinearImage(rendered.film.object),
            alpha: rendered.film.alpha,
            shadow: LinearImage(rendered.film.shadow),
        };
        write(&file, layers.to_bytes())?;
        Ok(layers)
    }

    fn to_bytes(&self) -> Vec<u8> {
        let colours = self.object.0.pixels().iter().chain(self.shadow.0.pixels());
        let all = colours
            .flat_map(|p| p.to_array())
            .chain(self.alpha.pixels().iter().copied());
        all.flat_map(f32::to_le_bytes).collect()
    }

    fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let count = SIDE * SIDE;
        let values: Vec<f32> = bytes
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
            .collect();
        if values.len() != 7 * count {
            return None;
        }
        let colours = |from: usize| {
            let pixels = values[3 * from..3 * (from + count)]
                .chunks(3)
                .map(Vec3::from_slice);
            LinearImage(Raster::from_pixels(SIDE, SIDE, pixels.collect()))
        };
        Some(Self {
            object: colours(0),
            shadow: colours(count),
            alpha: Raster::from_pixels(SIDE, SIDE, values[6 * count..].to_vec()),
        })
    }

    /// The same under `factor` times the light, where `brighter` is under three times the light: what the
    /// photograph itself reflects onto the object does not grow.
    pub fn exposed(&self, brighter: &Self, factor: f32) -> Self {
        let t = 0.5 * (factor - 1.0);
        let pairs = self
            .object
            .0
            .pixels()
            .iter()
            .zip(brighter.object.0.pixels());
        let pixels = pairs
            .map(|(a, b)| (*a + (*b - *a) * t).max(Vec3::ZERO))
            .collect();
        Self {
            object: LinearImage(Raster::from_pixels(SIDE, SIDE, pixels)),
            ..self.clone()
        }
    }

    /// The composite as it is displayed.
    pub fn over(&self, photo: &LinearImage, curve: Curve) -> anyhow::Result<DisplayImage> {
        let curves = match curve {
            Curve::None => None,
            Curve::Reinhard => Some(ToneCurves::identity()),
            Curve::RollOff => Some(ToneParameters::camera().curves()),
        };
        let object = match curves {
            Some(curves) => curves.apply_object(&self.object, &self.alpha),
            None => self.object.clone(),
        };
        let linear = composite(photo, &object, &self.alpha, &self.shadow)?;
        Ok(Transfer::Srgb.encode(&linear))
    }
}

fn key(scene: &DrawnScene, light: &EnvironmentMap, target_error: f32) -> String {
    let mut hash = blake3::Hasher::new();
    hash.update(scene.name.as_bytes());
    // Raised whenever pictures change.
    hash.update(&names::COMPOSITE.version.to_le_bytes());
    hash.update(format!("{:?}", scene.scene.materials).as_bytes());
    let floats = |hash: &mut blake3::Hasher, values: &[f32]| {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        hash.update(&bytes);
    };
    let camera = &scene.scene.camera;
    floats(&mut hash, &camera.position.to_array());
    floats(&mut hash, &camera.rotation.to_cols_array());
    floats(&mut hash, &[camera.focal_px.x, target_error]);
    let flat = |pixels: &[Vec3]| {
        pixels
            .iter()
            .flat_map(|p| p.to_array())
            .collect::<Vec<f32>>()
    };
    let mesh = &scene.scene.mesh;
    floats(&mut hash, &flat(&mesh.positions));
    floats(&mut hash, &flat(&mesh.normals));
    let parts = (
        &mesh.indices,
        &mesh.tangents,
        &mesh.uvs,
        &mesh.colors,
        &mesh.materials,
    );
    hash.update(format!("{parts:?}").as_bytes());
    for texture in &scene.scene.textures {
        hash.update(format!("{:?}", (texture.encoding, texture.wrap, texture.filter)).as_bytes());
        let pixels = match &texture.image {
            ImageSource::File(path) => blake3::hash(&dipir_files::read(path).unwrap_or_default()),
            ImageSource::Bytes { bytes, .. } => blake3::hash(bytes),
        };
        hash.update(pixels.as_bytes());
    }
    floats(&mut hash, &flat(scene.photo.0.pixels()));
    floats(&mut hash, &flat(light.texels()));
    hash.finalize().to_hex()[..32].to_string()
}

#[cfg(test)]
mod tests {
    use dipir_render::shapes::torus_knot;
    use dipir_scene::camera::{Camera, FieldOfView};
    use dipir_scene::material::Material;
    use dipir_scene::proxy::Proxy;
    use dipir_scene::scene::Scene;
    use dipir_scene::texture::{Encoding, Texture};
    use glam::Vec2;

    use super::*;

    #[test]
    fn another_material_is_rendered_anew() {
        let scene = |roughness: f32| DrawnScene {
            name: "a".into(),
            scene: Scene {
                mesh: torus_knot(Vec3::ZERO, 0.4, 0.1, 8, 4),
                materials: vec![Material {
                    roughness,
                    ..Material::default()
                }],
                textures: vec![],
                camera: Camera::look_at(
                    Vec3::Z,
                    Vec3::ZERO,
                    Vec3::Y,
                    FieldOfView::Vertical(1.0),
                    [4, 4],
                ),
                proxy: Proxy::None,
            },
            photo: LinearImage(Raster::filled(4, 4, Vec3::ONE)),
            shown: DisplayImage(Raster::filled(4, 4, Vec3::ONE)),
            truth: Arc::new(EnvironmentMap::constant(8, 4, Vec3::ONE)),
            heading: 0,
            exposure: 1.0,
        };
        let of = |roughness: f32| {
            let scene = scene(roughness);
            key(&scene, &scene.truth, 0.01)
        };
        assert_eq!(of(0.5), of(0.5));
        assert_ne!(of(0.5), of(0.25));
        // So is another picture on the same surface, or the surface with other coordinates on it.
        let textured = |pixels: &[u8], u: f32| {
            let mut scene = scene(0.5);
            scene.scene.textures.push(Texture {
                image: ImageSource::Bytes {
                    name: "paint".into(),
                    bytes: pixels.into(),
                },
                encoding: Encoding::Srgb,
                wrap: Default::default(),
                filter: Default::default(),
            });
            scene.scene.mesh.uvs[0] = vec![Vec2::splat(u)];
            key(&scene, &scene.truth, 0.01)
        };
        assert_eq!(textured(b"red", 0.0), textured(b"red", 0.0));
        assert_ne!(textured(b"red", 0.0), textured(b"blue", 0.0));
        assert_ne!(textured(b"red", 0.0), textured(b"red", 1.0));
    }
}
