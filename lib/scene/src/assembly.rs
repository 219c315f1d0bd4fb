//! Objects, put together.
use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::DMat4;

use crate::camera::Camera;
use crate::description::ObjectRecord;
use crate::error::Error;
use crate::files::Files;
use crate::import::Imported;
use crate::light::PunctualLight;
use crate::material::Material;
use crate::mesh::TriangleMesh;
use crate::proxy::Proxy;
use crate::scene::Scene;
use crate::texture::Texture;
use crate::visibility;

/// Puts objects together into one mesh. A file that several objects use is read once, and they share
/// its materials.
pub(crate) struct Assembly {
    camera: Camera,
    mesh: TriangleMesh,
    materials: Vec<Material>,
    textures: Vec<Texture>,
    lights: Vec<PunctualLight>,
    /// How many objects of each file are still to come.
    pending: HashMap<PathBuf, usize>,
    kept: HashMap<PathBuf, (Imported, ObjectRecord, u32)>,
}

impl Assembly {
    pub(crate) fn new(camera: Camera, paths: impl Iterator<Item = PathBuf>) -> Self {
        let mut pending = HashMap::new();
        for path in paths {
            *pending.entry(path).or_insert(0) += 1;
        }
        Self {
            camera,
            mesh: TriangleMesh::default(),
            materials: Vec::new(),
            textures: Vec::new(),
            lights: Vec::new(),
            pending,
            kept: HashMap::new(),
        }
    }

    pub(crate) fn into_scene(self, proxy: Proxy) -> (Scene, Vec<PunctualLight>) {
        let scene = Scene {
            mesh: self.mesh,
            materials: self.materials,
            textures: self.textures,
            camera: self.camera,
            proxy,
        };
        (scene, self.lights)
    }

    /// Adds the object in `path`; `place` gives the map from its file's coordinates to the world.
    pub(crate) fn add<W>(
        &mut self,
        files: &mut Files,
        path: &Path,
        place: impl FnOnce(&Imported) -> Result<(DMat4, W), Error>,
    ) -> Result<(ObjectRecord, W), Error> {
        let (mut imported, mut record, first_material) = match self.kept.remove(path) {
            Some(kept) => kept,
            None => {
                let (mut imported, record) = files.import("object", path)?;
                let first_material = self.materials.len() as u32;
                let first_texture = self.textures.len() as u32;
                for mut material in std::mem::take(&mut imported.materials) {
                    material.shift_textures(first_texture);
                    self.materials.push(material);
                }
                self.textures.append(&mut imported.textures);
                (imported, record, first_material)
            }
        };
        let (map, extra) = place(&imported)?;
        let pending = self.pending.entry(path.into()).or_insert(1);
        *pending -= 1;
        self.lights
            .extend(imported.lights.iter().map(|light| light.placed(&map)));
        let origin = imported.origin;
        let mut mesh = if *pending > 0 {
            let mesh = imported.mesh.clone();
            let kept = (imported, record.clone(), first_material);
            self.kept.insert(path.into(), kept);
            mesh
        } else {
            std::mem::take(&mut imported.mesh)
        };
        mesh.transform(&(map * DMat4::from_translation(origin)));
        if let Some(bad) = mesh.first_non_finite() {
            return Err(Error::NotFinite {
                place: format!("\"{}\", as placed", path.display()),
                element: bad as u64,
                value: format!("{:?}", mesh.positions[bad].to_array()),
            });
        }
        let materials = &self.materials[first_material as usize..];
        let hidden = visibility::hidden(&mesh, materials, &self.camera).into_iter();
        files.warn(hidden.map(|why| format!("\"{}\": {why}", path.display())));
        record.transform = ObjectRecord::rows(&map);
        let total = self.mesh.positions.len() as u64 + mesh.positions.len() as u64;
        files
            .limits
            .check_mesh(total, (self.mesh.indices.len() + mesh.indices.len()) as u64)?;
        self.mesh.append(mesh, first_material);
        Ok((record, extra))
    }
}
