//! Everything of a scene that a renderer needs, except the light.
use std::borrow::Cow;
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use dipir_cameras::{Camera as LensCamera, Lens};
use dipir_imaging::file::{self, Photo};
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_points::Cloud;
use glam::{DMat4, DVec2};

use crate::assembly::Assembly;
use crate::camera::{Camera, CameraSettings};
use crate::config::{ProxySettings, SceneConfig};
use crate::description::{
    FileRecord, ObjectRecord, PhotoRecord, ProxyRecord, SceneDescription, repeated,
};
use crate::error::Error;
use crate::features::SceneFeatures;
use crate::ground::{self, Places};
use crate::import::{self, Imported, once};
use crate::light::PunctualLight;
use crate::limits::Limits;
use crate::material::Material;
use crate::mesh::TriangleMesh;
use crate::placement::Anchor;
use crate::printable::printable;
use crate::proxy::Proxy;
use crate::taken::taken;
use crate::texture::Texture;
use crate::undistortion::Undistortion;

/// Objects to insert, the camera that took the photo, and the proxy that catches the shadow.
#[derive(Clone, Debug)]
pub struct Scene {
    /// All objects, placed, in world space, instances expanded.
    pub mesh: TriangleMesh,
    /// Indexed by [`TriangleMesh::materials`].
    pub materials: Vec<Material>,
    /// Indexed by [`TextureRef::texture`](crate::material::TextureRef::texture); decoded on demand.
    pub textures: Vec<Texture>,
    /// The photo's camera.
    pub camera: Camera,
    /// What receives the shadow.
    pub proxy: Proxy,
}

/// A file that went into a scene.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Input {
    /// What it is: `background`, `object`, …
    pub role: String,
    /// As written: relative to the folder of the pipeline file, or absolute.
    pub path: PathBuf,
    /// Where it was found.
    pub location: PathBuf,
}

/// A scene with its photo, the record of what it was made of, and what was ignored or repaired.
#[derive(Clone, Debug)]
pub struct LoadedScene {
    /// The scene.
    pub scene: Scene,
    /// The photo, linear; undistorted, if its lens bends lines.
    pub photo: Photo,
    /// The photo as it was taken, if its lens bends lines.
    pub original: Option<Box<Original>>,
    /// The photo's own foreground, 1 in front of the object; of the photo's size.
    pub occluders: Option<Raster<f32>>,
    /// From which the same scene can be rebuilt.
    pub description: SceneDescription,
    /// Lights that the objects' files bring along, as placed. They are not rendered.
    pub lights: Vec<PunctualLight>,
    /// All files that were read.
    pub inputs: Vec<Input>,
    /// Files of objects that could not be opened; the objects are as they are without them.
    pub missing: Vec<Input>,
    /// One sentence each.
    pub warnings: Vec<String>,
}

/// A photo whose lens bends lines.
#[derive(Clone, Debug)]
pub struct Original {
    /// As it was taken.
    pub photo: Photo,
    /// What leads from it to the undistorted one and back.
    pub undistortion: Undistortion,
}

impl LoadedScene {
    /// The photo as it was taken.
    pub fn taken(&self) -> &Photo {
        self.original.as_ref().map_or(&self.photo, |o| &o.photo)
    }

    /// The lens of the photo as it was taken.
    pub fn lens(&self) -> Lens {
        match &self.original {
            Some(original) => *original.undistortion.lens(),
            None => {
                let camera = &self.scene.camera;
                let size = camera.resolution.map(f64::from);
                Lens {
                    principal_px: camera.principal_px.as_dvec2(),
                    ..Lens::pinhole(size, camera.focal_px.as_dvec2())
                }
            }
        }
    }

    /// A picture of the photo's size, undistorted as the photo.
    pub fn undistorted(&self, image: LinearImage) -> LinearImage {
        match &self.original {
            Some(original) => LinearImage(original.undistortion.undistort(&image.0)),
            None => image,
        }
    }

    /// The photo with its gain map, where it has one: light above white ([`Photo::radiance`]).
    pub fn radiance(&self) -> Cow<'_, LinearImage> {
        match self.taken().radiance() {
            Cow::Owned(brighter) => Cow::Owned(self.undistorted(brighter)),
            Cow::Borrowed(_) => Cow::Borrowed(&self.photo.image),
        }
    }

    /// The pixel of the undistorted photo that shows what the photo shows at `pixel`; `None` where there is none, as at the
    /// edge of a fisheye's.
    pub fn undistorted_pixel(&self, pixel: DVec2) -> Option<DVec2> {
        match &self.original {
            Some(original) => original.undistortion.to_working(pixel),
            None => Some(pixel),
        }
    }
}

/// The working photo and mask, and the original if there is something to undo.
pub(crate) fn undistort(
    photo: Photo,
    occluders: Option<Raster<f32>>,
    undistortion: Option<Undistortion>,
) -> (Photo, Option<Raster<f32>>, Option<Box<Original>>) {
    let Some(undistortion) = undistortion else {
        return (photo, occluders, None);
    };
    let working = Photo {
        image: LinearImage(undistortion.undistort(&photo.image.0)),
        alpha: photo.alpha.as_ref().map(|a| undistortion.undistort(a)),
        transfer: photo.transfer,
        encoding: photo.encoding.clone(),
        values: None,
        facts: photo.facts.clone(),
        exif: photo.exif.clone(),
        gain: None,
        warnings: Vec::new(),
    };
    let occluders = occluders.map(|mask| undistortion.undistort(&mask));
    let original = Original {
        photo,
        undistortion,
    };
    (working, occluders, Some(Box::new(original)))
}

impl Scene {
    /// Reads all files that `config` names, relative to `base_dir`, and places the objects.
    pub fn load(config: &SceneConfig, base_dir: &Path) -> Result<LoadedScene, Error> {
        Self::load_in(config, base_dir, None)
    }

    /// As [`Scene::load`], of a frame of a shot: objects and proxy are as in its `photo`, and so is a camera that stands
    /// still.
    pub fn load_frame(
        config: &SceneConfig,
        base_dir: &Path,
        photo: &SceneDescription,
    ) -> Result<LoadedScene, Error> {
        Self::load_in(config, base_dir, Some(photo))
    }

    fn load_in(
        config: &SceneConfig,
        base_dir: &Path,
        of_shot: Option<&SceneDescription>,
    ) -> Result<LoadedScene, Error> {
        let settings = config.validate()?;
        let mut files = Files::new(base_dir, settings.limits);
        let (photo, background) = files.photo(&settings.background, settings.transfer)?;
        let resolution = [background.width, background.height];
        let occluders = match &settings.occluders {
            None => None,
            Some(path) => Some((
                files.mask(path, resolution)?,
                files.record("occluders", path)?,
            )),
        };
        if let CameraSettings::File(file) = &settings.camera {
            for part in file.parts(base_dir) {
                files.input("camera", &part);
            }
            files.warn(
                file.choice(base_dir)
                    .into_iter()
                    .chain(file.doubt(base_dir)),
            );
        }
        let (camera, undistortion) =
            match of_shot.filter(|_| settings.camera.stands_still(base_dir)) {
                Some(of_shot) => of_shot
                    .seen_in(resolution)
                    .map_err(|e| e.in_file(&settings.background))?,
                None => settings
                    .camera
                    .with_facts(&photo.facts)?
                    .resolve(resolution, base_dir)?,
            };
        let (occluders, occluders_record) = occluders.unzip();
        let (photo, occluders, original) = undistort(photo, occluders, undistortion);
        let view = ground::view(&camera, undistortion.as_ref());
        let (proxy, proxy_record, cloud) = match of_shot {
            Some(of_shot) => (files.recorded(&of_shot.proxy)?, of_shot.proxy.clone(), None),
            None => files.proxy(&settings.proxy, &view)?,
        };
        let doubt = settings.proxy.doubt(base_dir, &view, cloud.as_ref());
        files.warn(doubt.clone());
        let taken = match of_shot {
            Some(_) => Vec::new(),
            None => {
                let (objects, limits) = (&settings.objects, &settings.limits);
                taken(
                    objects,
                    base_dir,
                    limits,
                    &camera,
                    &proxy,
                    undistortion.as_ref(),
                )?
            }
        };
        let mut places = Places {
            view,
            ground: match (&proxy_record, &proxy) {
                (ProxyRecord::Ground(ground), _) => Some(ground.as_ref().clone()),
                (_, Proxy::Plane(plane)) => Some(ground::of_plane(plane)),
                _ => None,
            },
            cloud,
            occluders: occluders.as_ref(),
            undistortion: undistortion.as_ref(),
            taken,
            doubt,
        };
        let recorded = of_shot.map_or(&[][..], |of_shot| &of_shot.objects[..]);
        let to_place = match of_shot {
            Some(_) => &[],
            None => &settings.objects[..],
        };
        let paths = recorded.iter().map(|o| &o.file.path);
        let paths = paths.chain(to_place.iter().map(|o| &o.path)).cloned();
        let mut assembly = Assembly::new(camera, paths);
        let mut objects = Vec::new();
        for record in recorded {
            objects.push(assembly.again(&mut files, record)?);
        }
        for (i, object) in to_place.iter().enumerate() {
            let key = format!("scene.objects[{i}]");
            let pixels = match &undistortion {
                Some(way) => object.pixels.undistorted(way, &key)?,
                None => object.pixels,
            };
            let (placed, warning) = assembly.add(&mut files, &object.path, |imported| {
                let mut placement = object.placement;
                if let Some(draw) = object.auto {
                    let body = placement.body(&imported.mesh, &key)?;
                    placement.position = places.find(body, draw, &key)?.as_vec3();
                    placement.anchor = Anchor::Center;
                }
                let placement = pixels.place(&placement, &camera, &proxy, &key)?;
                let (map, warning) =
                    placement.resolve(&imported.mesh, imported.origin, &proxy, &key)?;
                // The record's map starts from the file's coordinates.
                Ok((map * DMat4::from_translation(-imported.origin), warning))
            })?;
            files.warnings.extend(warning);
            objects.push(placed);
        }
        if of_shot.is_none() {
            files.warnings.extend(repeated(&objects));
        }
        let (scene, lights) = assembly.into_scene(proxy);
        Ok(LoadedScene {
            scene,
            photo,
            original,
            occluders,
            description: SceneDescription {
                schema: SceneDescription::SCHEMA.into(),
                seed: 0,
                background,
                occluders: occluders_record,
                objects,
                camera,
                lens: undistortion.map(|u| *u.lens()),
                proxy: proxy_record,
                effects: settings.effects,
                limits: settings.limits,
            },
            lights,
            inputs: files.inputs.list,
            missing: files.missing.list,
            warnings: once(files.warnings),
        })
    }

    /// Which kinds of surface the triangles have.
    pub fn features(&self) -> SceneFeatures {
        SceneFeatures::of(self)
    }
}

/// Files, each once, in the order in which they were added.
#[derive(Default)]
pub(crate) struct Inputs {
    pub(crate) list: Vec<Input>,
    /// Role and path of each.
    known: HashSet<(String, PathBuf)>,
}

impl Inputs {
    fn add(&mut self, role: &str, path: &Path, base_dir: &Path) {
        if self.known.insert((role.into(), path.into())) {
            self.list.push(Input {
                role: role.into(),
                path: path.into(),
                location: base_dir.join(path),
            });
        }
    }
}

/// Reads files relative to a folder and keeps the list.
pub(crate) struct Files<'a> {
    base_dir: &'a Path,
    pub(crate) limits: Limits,
    pub(crate) inputs: Inputs,
    pub(crate) missing: Inputs,
    pub(crate) warnings: Vec<String>,
    hashes: HashMap<PathBuf, String>,
}

impl<'a> Files<'a> {
    pub(crate) fn new(base_dir: &'a Path, limits: Limits) -> Self {
        Self {
            base_dir,
            limits,
            inputs: Inputs::default(),
            missing: Inputs::default(),
            warnings: Vec::new(),
            hashes: HashMap::new(),
        }
    }

    /// Adds warnings, with the names in them made printable.
    pub(crate) fn warn(&mut self, warnings: impl IntoIterator<Item = String>) {
        self.warnings.extend(warnings.into_iter().map(printable));
    }

    pub(crate) fn input(&mut self, role: &str, path: &Path) {
        self.inputs.add(role, path, self.base_dir);
    }

    /// Notes a file with its hash.
    fn record(&mut self, role: &str, path: &Path) -> Result<FileRecord, Error> {
        self.input(role, path);
        Ok(FileRecord {
            path: path.into(),
            blake3: self.hash(role, path)?,
        })
    }

    fn hash(&mut self, role: &str, path: &Path) -> Result<String, Error> {
        let location = self.base_dir.join(path);
        if let Some(known) = self.hashes.get(&location) {
            return Ok(known.clone());
        }
        let mut hasher = blake3::Hasher::new();
        dipir_files::open(&location)
            .and_then(|file| hasher.update_reader(file).map(|_| ()))
            .map_err(|source| Error::Read {
                role: role.into(),
                path: location.clone(),
                source,
            })?;
        let hash = hasher.finalize().to_hex().to_string();
        self.hashes.insert(location, hash.clone());
        Ok(hash)
    }

    pub(crate) fn check(&mut self, role: &str, record: &FileRecord) -> Result<(), Error> {
        let found = self.hash(role, &record.path)?;
        if found == record.blake3 {
            return Ok(());
        }
        Err(Error::Changed {
            role: role.into(),
            path: record.path.clone(),
            found,
            expected: record.blake3.clone(),
        })
    }

    pub(crate) fn check_object(&mut self, role: &str, record: &ObjectRecord) -> Result<(), Error> {
        self.check(role, &record.file)?;
        for dependency in &record.dependencies {
            self.check(&format!("a part of {role}"), dependency)?;
        }
        Ok(())
    }

    pub(crate) fn photo(
        &mut self,
        path: &Path,
        transfer: Transfer,
    ) -> Result<(Photo, PhotoRecord), Error> {
        let photo =
            file::read_photo_within(self.base_dir.join(path), transfer, self.limits.photo())?;
        self.warnings.extend(photo.warnings.iter().cloned());
        let record = PhotoRecord {
            file: self.record("background", path)?,
            width: photo.image.0.width() as u32,
            height: photo.image.0.height() as u32,
            transfer,
        };
        Ok((photo, record))
    }

    pub(crate) fn mask(
        &self,
        path: &Path,
        [width, height]: [u32; 2],
    ) -> Result<Raster<f32>, Error> {
        let mask = file::read_mask(self.base_dir.join(path))?;
        if (mask.width(), mask.height()) == (width as usize, height as usize) {
            return Ok(mask);
        }
        Err(Error::Config {
            key: "scene.occluders".into(),
            value: format!(
                "an image of {} x {} pixels (\"{}\")",
                mask.width(),
                mask.height(),
                path.display()
            ),
            accepted: format!("one of the background's size, {width} x {height}"),
        })
    }

    /// Imports an object and notes all files that it consists of.
    pub(crate) fn import(
        &mut self,
        role: &str,
        path: &Path,
    ) -> Result<(Imported, ObjectRecord), Error> {
        let imported = import::load_object_within(&self.base_dir.join(path), &self.limits)?;
        let shown = printable(path.display());
        self.warnings.extend(
            imported
                .warnings
                .iter()
                .map(|w| format!("\"{shown}\": {w}")),
        );
        let file = self.record(role, path)?;
        let mut dependencies = Vec::new();
        let (part, base_dir) = (format!("part of {role}"), self.base_dir);
        let relative = |path| Path::strip_prefix(path, base_dir).unwrap_or(path);
        for found in &imported.dependencies {
            dependencies.push(self.record(&part, relative(found))?);
        }
        for missing in &imported.missing {
            self.missing.add(&part, relative(missing), base_dir);
        }
        let record = ObjectRecord {
            file,
            dependencies,
            transform: ObjectRecord::rows(&DMat4::IDENTITY),
            vertices: imported.mesh.positions.len() as u64,
            triangles: imported.mesh.indices.len() as u64,
        };
        Ok((imported, record))
    }

    /// The proxy, its record, and the points that it was made from.
    fn proxy(
        &mut self,
        settings: &ProxySettings,
        view: &LensCamera,
    ) -> Result<(Proxy, ProxyRecord, Option<Cloud>), Error> {
        let of_plane = |plane| (Proxy::Plane(plane), ProxyRecord::Plane(plane), None);
        Ok(match settings {
            ProxySettings::None => (Proxy::None, ProxyRecord::None, None),
            ProxySettings::Plane(plane) => of_plane(*plane),
            ProxySettings::Mesh(path) => {
                let (mesh, record) = self.proxy_mesh(path)?;
                (Proxy::Mesh(mesh), ProxyRecord::Mesh(record), None)
            }
            ProxySettings::Pixels(pixels) => {
                let (plane, warning) = ground::plane_of(pixels, view)?;
                self.warnings.extend(warning);
                of_plane(plane)
            }
            ProxySettings::Points(points) => {
                for part in points.parts(self.base_dir) {
                    self.input("points", &part);
                }
                self.warn(points.choice(self.base_dir));
                let (cloud, ground) = points.read(self.base_dir, view)?;
                let proxy = ground::proxy(&ground);
                (proxy, ProxyRecord::Ground(Box::new(ground)), Some(cloud))
            }
        })
    }

    pub(crate) fn proxy_mesh(
        &mut self,
        path: &Path,
    ) -> Result<(TriangleMesh, ObjectRecord), Error> {
        let (mut imported, record) = self.import("proxy", path)?;
        imported
            .mesh
            .transform(&DMat4::from_translation(imported.origin));
        Ok((imported.mesh, record))
    }
}
