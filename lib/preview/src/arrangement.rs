//! Where the objects of a configuration stand.
use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_imaging::facts::Facts;
use dipir_scene::camera::Camera;
use dipir_scene::config::{ProxySettings, SceneConfig};
use dipir_scene::ground;
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::placement::{Anchor, Placement};
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::LoadedScene;
use dipir_scene::surfaces::SeenSurfaces;
use dipir_scene::undistortion::Undistortion;
use glam::{DMat3, DMat4, DQuat, DVec3, Vec2, Vec3};

/// An object's file, read.
#[derive(Clone, Debug)]
pub struct Model {
    /// As the configuration names it.
    pub path: PathBuf,
    /// Its triangles, metres, before it is placed. Materials are those of the loaded scene.
    pub mesh: TriangleMesh,
    /// Where the mesh's (0, 0, 0) lies in the file.
    origin: DVec3,
}

/// An object as it is placed.
#[derive(Clone, Debug)]
pub struct Placed {
    /// Index of its [`Model`].
    pub model: usize,
    /// From the model's mesh to the world.
    pub map: DMat4,
    /// Unit axes of its box in the world: its right, up, and front.
    pub axes: DMat3,
    /// The box's lowest coordinates along the axes.
    pub low: DVec3,
    /// The box's highest coordinates along the axes.
    pub high: DVec3,
    /// The point of the ground on which it stands.
    pub contact: DVec3,
    /// Turn about the up direction, radians.
    pub yaw_rad: f64,
}

/// Camera, ground and objects of a configuration.
#[derive(Clone, Debug)]
pub struct Arrangement {
    /// The photograph's camera, at the photograph's full size.
    pub camera: Camera,
    /// What receives the shadow.
    pub proxy: Proxy,
    /// In the order of the configuration.
    pub objects: Vec<Placed>,
    /// What looks wrong, one sentence each.
    pub warnings: Vec<String>,
}

impl Model {
    /// The models of a loaded scene, each once.
    pub(crate) fn all(loaded: &LoadedScene) -> Vec<Self> {
        let mut models: Vec<Self> = Vec::new();
        let mut first = 0;
        for object in &loaded.description.objects {
            let triangles = first..first + object.triangles as usize;
            first = triangles.end;
            if models.iter().any(|m| m.path == object.file.path) {
                continue;
            }
            let mut mesh = part(&loaded.scene.mesh, triangles);
            let to_file = object.transform().inverse();
            // Coordinates about a point of the object: a file may lie far from its origin.
            let anchor = mesh.positions.first().copied().unwrap_or(Vec3::ZERO);
            let origin = to_file.transform_point3(anchor.as_dvec3());
            mesh.transform(&(DMat4::from_translation(-origin) * to_file));
            models.push(Self {
                path: object.file.path.clone(),
                mesh,
                origin,
            });
        }
        models
    }
}

/// Some triangles of a mesh, with the vertices between their first and their last.
fn part(mesh: &TriangleMesh, triangles: std::ops::Range<usize>) -> TriangleMesh {
    let indices = &mesh.indices[triangles.clone()];
    let all = || indices.iter().flatten().copied();
    let (Some(low), Some(high)) = (all().min(), all().max()) else {
        return TriangleMesh::default();
    };
    let vertices = low as usize..high as usize + 1;
    fn of<T: Copy>(values: &[T], range: &std::ops::Range<usize>) -> Vec<T> {
        values.get(range.clone()).unwrap_or_default().to_vec()
    }
    TriangleMesh {
        positions: of(&mesh.positions, &vertices),
        indices: indices.iter().map(|t| t.map(|i| i - low)).collect(),
        normals: of(&mesh.normals, &vertices),
        tangents: of(&mesh.tangents, &vertices),
        uvs: [of(&mesh.uvs[0], &vertices), of(&mesh.uvs[1], &vertices)],
        colors: of(&mesh.colors, &vertices),
        materials: of(&mesh.materials, &triangles),
    }
}

impl Arrangement {
    /// Places the objects of `config`. Photograph, models and surfaces are those that were read; a plane
    /// may be another one, also because the camera is that sees its pixels. An object with `place = "auto"` stays where `loaded_maps`, from its file to
    /// the world, have it.
    pub fn new(
        config: &SceneConfig,
        base_dir: &Path,
        facts: &Facts,
        models: &[Model],
        loaded_proxy: &Proxy,
        surfaces: Option<&SeenSurfaces>,
        loaded_maps: &[DMat4],
    ) -> anyhow::Result<Self> {
        let settings = config.validate()?;
        let lens = settings.camera.with_facts(facts)?;
        // Of a lens that distorts, the camera of the undistorted picture, which is what is shown.
        let (camera, undistortion) = lens.resolve(facts.size, base_dir)?;
        let mut warnings = Vec::new();
        let plane = plane_of(&settings.proxy, &camera, undistortion.as_ref())?;
        let proxy = plane.map_or(loaded_proxy.clone(), Proxy::Plane);
        let mut objects = Vec::new();
        for (i, object) in settings.objects.iter().enumerate() {
            let key = format!("scene.objects[{i}]");
            let pixels = match &undistortion {
                Some(way) => object.pixels.undistorted(way, &key)?,
                None => object.pixels,
            };
            let placement = pixels.place(&object.placement, &camera, &proxy, surfaces, &key)?;
            let found = models.iter().position(|m| m.path == object.path);
            let model = found.with_context(|| {
                format!("{key}.path: \"{}\" was not read", object.path.display())
            })?;
            let mesh = &models[model];
            let map = match (object.auto, loaded_maps.get(i)) {
                (Some(_), Some(map)) => *map * DMat4::from_translation(mesh.origin),
                _ => {
                    let (map, warning) =
                        placement.resolve(&mesh.mesh, mesh.origin, &proxy, &key)?;
                    warnings.extend(warning);
                    map
                }
            };
            objects.push(Placed::new(model, mesh, map, &placement, &proxy));
        }
        Ok(Self {
            camera,
            proxy,
            objects,
            warnings,
        })
    }

    /// The plane on which objects are moved: the proxy's, else a level one under the first object.
    pub fn ground(&self) -> Plane {
        match &self.proxy {
            Proxy::Plane(plane) => *plane,
            _ => Plane {
                point: self
                    .objects
                    .first()
                    .map_or(Vec3::ZERO, |o| o.contact.as_vec3()),
                normal: Vec3::Y,
            },
        }
    }
}

/// The plane that is written, or that lies where `camera` sees its pixels, which are those of the photograph as it was
/// taken; `None` if the proxy is told otherwise.
pub(crate) fn plane_of(
    proxy: &ProxySettings,
    camera: &Camera,
    undistortion: Option<&Undistortion>,
) -> anyhow::Result<Option<Plane>> {
    let pixels = match proxy {
        ProxySettings::Plane(plane) => return Ok(Some(*plane)),
        ProxySettings::Pixels(pixels) => pixels,
        _ => return Ok(None),
    };
    if undistortion.is_some() {
        let (plane, _) = ground::plane_of(pixels, &ground::view(camera, undistortion))?;
        return Ok(Some(plane));
    }
    let ray = |pixel: &Vec2| camera.ray(*pixel).direction.as_dvec3();
    let rays: Vec<DVec3> = pixels.pixels.iter().map(ray).collect();
    let found = pixels.found(&rays)?;
    let point = camera.position.as_dvec3() - found.height_m * found.normal;
    Ok(Some(Plane {
        point: point.as_vec3(),
        normal: found.normal.as_vec3(),
    }))
}

impl Placed {
    fn new(index: usize, model: &Model, map: DMat4, placement: &Placement, proxy: &Proxy) -> Self {
        let up = match proxy {
            Proxy::Plane(plane) => plane.normal.as_dvec3().normalize(),
            _ => DVec3::Y,
        };
        let upright = DMat3::from_quat(DQuat::from_rotation_arc(DVec3::Y, up));
        let yaw_rad = f64::from(placement.yaw_rad);
        let axes = upright * DMat3::from_rotation_y(yaw_rad);
        let (low, high) = bounds(&model.mesh, &map, &axes);
        let foot = match placement.anchor {
            Anchor::Origin => map.transform_point3(-model.origin),
            // The middle of the box along the world's axes, as placement has it.
            Anchor::Center => {
                let (low, high) = bounds(&model.mesh, &map, &upright);
                upright * (0.5 * (low + high))
            }
        };
        let contact = foot + up * (low.y - up.dot(foot));
        Self {
            model: index,
            map,
            axes,
            low,
            high,
            contact,
            yaw_rad,
        }
    }

    /// The box's corners; bit 0 of the index is right, bit 1 up, bit 2 front.
    pub fn corners(&self) -> [DVec3; 8] {
        std::array::from_fn(|k| {
            let side = |bit: usize, low: f64, high: f64| match k >> bit & 1 {
                0 => low,
                _ => high,
            };
            self.axes
                * DVec3::new(
                    side(0, self.low.x, self.high.x),
                    side(1, self.low.y, self.high.y),
                    side(2, self.low.z, self.high.z),
                )
        })
    }

    /// Width, height and depth, metres.
    pub fn size(&self) -> DVec3 {
        self.high - self.low
    }
}

/// The smallest and largest coordinates of the placed mesh along `axes`.
fn bounds(mesh: &TriangleMesh, map: &DMat4, axes: &DMat3) -> (DVec3, DVec3) {
    let map = DMat4::from_mat3(axes.transpose()) * *map;
    let start = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    mesh.positions.iter().fold(start, |(low, high), p| {
        let p = map.transform_point3(p.as_dvec3());
        (low.min(p), high.max(p))
    })
}
