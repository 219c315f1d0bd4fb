//! One scene: a photograph cut out of a panorama, an object in front of the camera, the true light.
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use dipir_imaging::exposure::{MID_GREY, exposure_ev_to};
use dipir_imaging::raster::{DisplayImage, LinearImage};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_places::place::{Place, SMOOTH};
use dipir_pretraining::shapes::Shape;
use dipir_scene::camera::Camera;
use dipir_scene::import::{Imported, load_object};
use dipir_scene::material::Material;
use dipir_scene::placement::{Anchor, Placement, Rest, Size};
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use dipir_stages::scene::background::PanoramaView;
use glam::{DVec3, Vec2, Vec3, Vec4};

/// Columns and rows of photographs.
pub const SIDE: usize = 96;
/// Vertical field of view, degrees.
const FOV_DEG: [f32; 2] = [32.0, 75.0];
/// How far the camera looks down, degrees.
const DOWN_DEG: [f32; 2] = [6.0, 30.0];
/// Longest side of the object in the picture, of the picture's height.
const FILLS: [f32; 2] = [0.3, 0.55];
/// Longest side of objects, metres.
const OBJECT_M: f32 = 1.1;
/// Solids of the generator.
const SHAPES: [Shape; 8] = [
    Shape::Ball,
    Shape::Box,
    Shape::Cylinder,
    Shape::Ring,
    Shape::Car,
    Shape::Table,
    Shape::Rock,
    Shape::Capsule,
];

/// What is inserted: models of files, and solids.
pub struct Objects {
    models: Vec<(String, Imported)>,
}

impl Objects {
    /// Reads the models of a folder; solids alone without one.
    pub fn read(folder: Option<&Path>) -> anyhow::Result<Self> {
        let Some(folder) = folder else {
            return Ok(Self { models: Vec::new() });
        };
        let failed = || format!("cannot read {}", folder.display());
        let mut files: Vec<PathBuf> = Vec::new();
        for entry in std::fs::read_dir(folder).with_context(failed)? {
            let path = entry.with_context(failed)?.path();
            let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
            if matches!(extension.as_deref(), Some("glb" | "gltf" | "obj")) {
                files.push(path);
            }
        }
        files.sort();
        let read = |path: PathBuf| {
            let name = path
                .file_stem()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned();
            Ok((name, load_object(&path)?))
        };
        let models = files.into_iter().map(read).collect::<anyhow::Result<_>>()?;
        Ok(Self { models })
    }

    /// Model or solid number `n`, with materials that `draw` decides.
    fn pick(&self, n: usize, draw: &mut Sampler) -> (String, Imported) {
        let k = n % (self.models.len() + SHAPES.len());
        if let Some(model) = self.models.get(k) {
            return model.clone();
        }
        let shape = SHAPES[k - self.models.len()];
        let mut next = || draw.next_1d();
        let mesh = shape.mesh([next(), next(), next()]);
        let colour = Vec3::new(next(), next(), next()) * 0.7 + Vec3::splat(0.1);
        let metal = next() < 0.2;
        let material = Material {
            base_color: Vec4::from((colour, 1.0)),
            metallic: f32::from(u8::from(metal)),
            roughness: 0.15 + 0.85 * next(),
            ..Material::default()
        };
        let solid = Imported {
            mesh,
            origin: DVec3::ZERO,
            materials: vec![material],
            textures: Vec::new(),
            lights: Vec::new(),
            warnings: Vec::new(),
            dependencies: Vec::new(),
            missing: Vec::new(),
        };
        (shape.word().into(), solid)
    }
}

/// A scene whose true light is known.
pub struct DrawnScene {
    /// Place, view and object.
    pub name: String,
    /// Camera, object and ground.
    pub scene: Scene,
    /// The photograph, decoded.
    pub photo: LinearImage,
    /// What is displayed of it.
    pub shown: DisplayImage,
    /// The panorama before the camera's curve, at the photograph's exposure.
    pub truth: Arc<EnvironmentMap>,
    /// Columns of [`SMOOTH`] by which the view is turned.
    pub heading: usize,
    /// Exposure of the photograph: what a place's radiance is multiplied by.
    pub exposure: f32,
}

impl DrawnScene {
    /// View `n` of place number `place`.
    pub fn draw(
        seed: u64,
        number: usize,
        place: &Place,
        n: usize,
        objects: &Objects,
    ) -> anyhow::Result<Self> {
        let mut draw = Sampler::new(seed, Stream::PILOT, number as u32, n as u32);
        let mut between = |[low, high]: [f32; 2]| low + (high - low) * draw.next_1d();
        let heading = between([0.0, SMOOTH[0] as f32]) as usize % SMOOTH[0];
        let (fov, down, fills) = (between(FOV_DEG), between(DOWN_DEG), between(FILLS));
        let (turn, which) = (between([0.0, std::f32::consts::TAU]), between([0.0, 1e4]));
        let view = PanoramaView {
            fov_rad: fov.to_radians(),
            yaw_rad: heading as f32 / SMOOTH[0] as f32 * std::f32::consts::TAU,
            pitch_rad: -down.to_radians(),
            roll_rad: 0.0,
            width: SIDE,
            height: SIDE,
        };
        let image = view.take(&place.panorama);
        let exposure = exposure_ev_to(&image, MID_GREY / (1.0 - MID_GREY)).exp2() as f32;
        let developed = |p: &Vec3| *p * exposure / (Vec3::ONE + *p * exposure);
        let shown = Transfer::Srgb.encode(&LinearImage(image.0.map(developed)));
        let shown = DisplayImage(shown.0.map(|p| (*p * 255.0).round() / 255.0));
        let photo = Transfer::Srgb.decode(shown.clone());
        let (word, object) = objects.pick(which as usize, &mut draw);
        Ok(Self {
            name: format!("{}-{n}-{word}", place.name),
            scene: scene(&view, fills, turn, object)?,
            photo,
            shown,
            truth: Arc::new(place.panorama.scaled(exposure)),
            heading,
            exposure,
        })
    }
}

/// The object on the ground in the middle of the picture.
fn scene(view: &PanoramaView, fills: f32, turn: f32, object: Imported) -> anyhow::Result<Scene> {
    let rotation = view.rotation();
    let (low, high) = object.mesh.bounds().unwrap_or((Vec3::ZERO, Vec3::ONE));
    let scale = OBJECT_M / (high - low).max_element().max(1e-6);
    let away = OBJECT_M / (fills * 2.0 * (0.5 * view.fov_rad).tan());
    let middle = Vec3::Y * (0.5 * scale * (high - low).y);
    // The camera stays above the ground.
    let mut position = middle + rotation.z_axis * away;
    position.y = position.y.max(0.15);
    let side = SIDE as f32;
    let camera = Camera {
        position,
        rotation,
        focal_px: Vec2::splat(0.5 * side / (0.5 * view.fov_rad).tan()),
        principal_px: Vec2::splat(0.5 * side),
        resolution: [SIDE as u32; 2],
    };
    let proxy = Proxy::Plane(Plane {
        point: Vec3::ZERO,
        normal: Vec3::Y,
    });
    let placement = Placement {
        position: Vec3::ZERO,
        yaw_rad: turn,
        pitch_rad: 0.0,
        roll_rad: 0.0,
        size: Size::Scale(scale),
        rest: Some(Rest::Position),
        anchor: Anchor::Center,
    };
    let Imported {
        mut mesh,
        origin,
        materials,
        textures,
        ..
    } = object;
    let (map, _) = placement.resolve(&mesh, origin, &proxy, "object")?;
    mesh.transform(&map);
    Ok(Scene {
        mesh,
        materials,
        textures,
        camera,
        proxy,
    })
}
