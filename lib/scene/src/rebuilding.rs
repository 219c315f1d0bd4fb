//! A scene again, from what `scene.json` says of it.
use std::path::Path;

use dipir_cameras::Pose;

use crate::assembly::Assembly;
use crate::camera::{Camera, CameraSettings};
use crate::config::EffectsConfig;
use crate::description::{DepthRecord, ObjectRecord, ProxyRecord, SceneDescription};
use crate::error::Error;
use crate::files::Files;
use crate::foreground::DepthSettings;
use crate::ground;
use crate::import::once;
use crate::proxy::Proxy;
use crate::scene::{LoadedScene, undistort};
use crate::undistortion::Undistortion;

/// By how much the shapes of a shot's photograph and a frame may differ, relative.
const SAME_SHAPE: f64 = 0.01;

impl SceneDescription {
    /// Rebuilds the scene from the files it was made of; an error if one of them changed.
    pub fn load(&self, base_dir: &Path) -> Result<LoadedScene, Error> {
        let mut files = Files::new(base_dir, self.limits);
        files.check("the background", &self.background.file)?;
        let (photo, background) =
            files.photo(&self.background.file.path, self.background.transfer)?;
        let resolution = [background.width, background.height];
        let occluders = match &self.occluders {
            None => None,
            Some(record) => {
                files.check("the occluders' mask", record)?;
                files.input("occluders", &record.path);
                Some(files.mask(&record.path, resolution)?)
            }
        };
        let undistortion = self.lens.as_ref().and_then(Undistortion::of);
        let (photo, masked, original) = undistort(photo, occluders, undistortion);
        let depth = self.depth.as_ref().map(DepthRecord::settings);
        if let Some(record) = &self.depth {
            files.check("the depths", &record.file)?;
        }
        let depths = files
            .depths(depth.as_ref(), resolution, undistortion.as_ref())?
            .0;
        let found = self.depth.as_ref().and_then(|depth| depth.found);
        let depths = depths.map(|depths| depths.like(found));
        let proxy = files.recorded(&self.proxy)?;
        let mut assembly = Assembly::new(
            self.camera,
            self.objects.iter().map(|o| o.file.path.clone()),
        );
        for object in &self.objects {
            assembly.again(&mut files, object)?;
        }
        let (scene, lights) = assembly.into_scene(proxy);
        let loaded = LoadedScene {
            scene,
            photo,
            original,
            occluders: None,
            surfaces: None,
            shadow_mask: None,
            masked: None,
            depths,
            depth_fit: None,
            description: self.clone(),
            lights,
            inputs: files.inputs.list,
            missing: files.missing.list,
            warnings: once(files.warnings),
        };
        loaded.hidden(masked, base_dir)
    }

    /// What the user says about effects.
    pub fn effects(&self) -> &EffectsConfig {
        &self.effects
    }

    /// The camera, and what undoes its lens's distortion, for a picture of `resolution` from the same place.
    ///
    /// # Errors
    /// If that picture has another shape.
    pub(crate) fn seen_in(
        &self,
        resolution: [u32; 2],
    ) -> Result<(Camera, Option<Undistortion>), Error> {
        let [w, h] = resolution.map(f64::from);
        let photo = [self.background.width, self.background.height];
        let shape = f64::from(photo[0]) / f64::from(photo[1]);
        if (w / h / shape - 1.0).abs() > SAME_SHAPE {
            let detail = format!(
                "it has {w} x {h} pixels, and the photograph of the shot, whose camera stands still, {} x {}",
                photo[0], photo[1]
            );
            return Err(Error::malformed(detail, "give it that shape"));
        }
        let lens = self.lens.as_ref().map(|lens| lens.scaled([w, h]));
        Ok(match lens.as_ref().and_then(Undistortion::of) {
            Some(way) => {
                let pose = Pose {
                    position: self.camera.position.as_dvec3(),
                    rotation: self.camera.rotation.as_dmat3(),
                };
                (way.camera(&pose), Some(way))
            }
            None => (self.camera.scaled(resolution), None),
        })
    }
}

impl CameraSettings {
    /// Whether every picture has the same camera.
    pub(crate) fn stands_still(&self, base_dir: &Path) -> bool {
        match self {
            Self::LookAt { .. } => true,
            Self::File(file) => file.stands_still(base_dir),
        }
    }
}

impl DepthRecord {
    fn settings(&self) -> DepthSettings {
        DepthSettings {
            path: self.file.path.clone(),
            measure: self.measure,
            scale: self.scale,
            catches: self.catches,
        }
    }
}

impl Files<'_> {
    /// A proxy as it is written down.
    pub(crate) fn recorded(&mut self, record: &ProxyRecord) -> Result<Proxy, Error> {
        Ok(match record {
            ProxyRecord::None => Proxy::None,
            ProxyRecord::Plane(plane) => Proxy::Plane(*plane),
            ProxyRecord::Mesh(record) => {
                self.check_object("the proxy mesh", record)?;
                Proxy::Mesh(self.proxy_mesh(&record.file.path)?.0)
            }
            ProxyRecord::Ground(ground) => ground::proxy(ground),
        })
    }
}

impl Assembly {
    /// Adds an object where it is written down to be; an error if its files changed.
    pub(crate) fn again(
        &mut self,
        files: &mut Files,
        object: &ObjectRecord,
    ) -> Result<ObjectRecord, Error> {
        files.check_object("the object", object)?;
        let map = object.transform();
        Ok(self.add(files, &object.file.path, |_| Ok((map, ())))?.0)
    }
}
