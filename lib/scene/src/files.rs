//! The files that a scene is read from.
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use dipir_cameras::Camera as LensCamera;
use dipir_imaging::file::{self, Photo};
use dipir_imaging::raster::Raster;
use dipir_imaging::transfer::Transfer;
use dipir_points::Cloud;
use glam::DMat4;

use crate::config::ProxySettings;
use crate::description::{DepthRecord, FileRecord, ObjectRecord, PhotoRecord, ProxyRecord};
use crate::error::Error;
use crate::foreground::{DepthSettings, Depths};
use crate::ground;
use crate::import::{self, Imported};
use crate::limits::Limits;
use crate::mesh::TriangleMesh;
use crate::printable::printable;
use crate::proxy::Proxy;
use crate::scene::Input;
use crate::undistortion::Undistortion;

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
    pub(crate) fn record(&mut self, role: &str, path: &Path) -> Result<FileRecord, Error> {
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

    /// The depths of a photograph, and their record.
    pub(crate) fn depths(
        &mut self,
        settings: Option<&DepthSettings>,
        resolution: [u32; 2],
        undistortion: Option<&Undistortion>,
    ) -> Result<(Option<Depths>, Option<DepthRecord>), Error> {
        let Some(settings) = settings else {
            return Ok((None, None));
        };
        let depths = Depths::read(settings, self.base_dir, resolution, undistortion)?;
        let record = DepthRecord {
            file: self.record("depth", &settings.path)?,
            measure: settings.measure,
            scale: settings.scale,
            found: None,
            catches: settings.catches,
        };
        Ok((Some(depths), Some(record)))
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
    pub(crate) fn proxy(
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
