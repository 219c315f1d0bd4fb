//! Everything of a scene that a renderer needs, except the light.
use std::borrow::Cow;
use std::path::{Path, PathBuf};

use dipir_cameras::Lens;
use dipir_imaging::file::Photo;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_points::Ground;
use glam::{DMat4, DVec2, Vec2, Vec3};

use crate::assembly::Assembly;
use crate::camera::{Camera, CameraSettings};
use crate::config::{ObjectSettings, SceneConfig};
use crate::description::{ProxyRecord, SceneDescription, repeated};
use crate::error::Error;
use crate::features::SceneFeatures;
use crate::files::Files;
use crate::foreground::{DepthFit, Depths};
use crate::ground::{self, Places};
use crate::import::once;
use crate::light::PunctualLight;
use crate::material::Material;
use crate::mesh::TriangleMesh;
use crate::pixels;
use crate::placement::{Anchor, Rest};
use crate::proxy::Proxy;
use crate::surfaces::SeenSurfaces;
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
    /// The photo's own foreground, 1 in front of the object; of the photo's size. [`LoadedScene::hide`] makes it of the
    /// mask that the configuration names and of the depths.
    pub occluders: Option<Raster<f32>>,
    /// What the depths show beside the proxy, if it catches shadows or carries objects.
    pub surfaces: Option<SeenSurfaces>,
    /// What hides the objects' shadow, if that is not `occluders`.
    pub shadow_mask: Option<Raster<f32>>,
    /// That mask, where there are depths, too.
    pub(crate) masked: Option<Raster<f32>>,
    /// Depths that tell what stands in front of the objects.
    pub depths: Option<Depths>,
    /// What these were taken for.
    pub depth_fit: Option<DepthFit>,
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

    /// Takes `mask` for the configuration's own and finds anew what stands in front of the objects where they stand.
    ///
    /// # Errors
    /// If the depths do not agree with the ground.
    pub fn hide(&mut self, mask: Option<Raster<f32>>) -> Result<(), Error> {
        let Some(depths) = &self.depths else {
            self.occluders = mask;
            return Ok(());
        };
        self.masked = mask;
        let Scene {
            mesh,
            camera,
            proxy,
            ..
        } = &self.scene;
        let found = depths.foreground(Some(mesh), proxy, camera, &self.photo.image)?;
        self.depth_fit = Some(found.fit);
        self.surfaces = found.surfaces;
        let of_shadow = self.catching().map(|s| s.shadow_mask(&found.mask));
        self.shadow_mask = of_shadow.map(|found| joined(self.masked.as_ref(), found));
        self.occluders = Some(joined(self.masked.as_ref(), found.mask));
        Ok(())
    }

    /// What of the photo beside the proxy catches shadows.
    pub fn catching(&self) -> Option<&SeenSurfaces> {
        let depth = self.description.depth.as_ref()?;
        let is_doubted = self.depth_fit.is_some_and(|fit| fit.is_doubted());
        let has_proxy = !matches!(self.scene.proxy, Proxy::None);
        let catches = depth.catches && has_proxy && !is_doubted;
        self.surfaces.as_ref().filter(|_| catches)
    }

    /// The mask that the configuration names.
    pub fn mask(&self) -> Option<&Raster<f32>> {
        match &self.depths {
            None => self.occluders.as_ref(),
            Some(_) => self.masked.as_ref(),
        }
    }

    /// Takes that mask away.
    pub fn take_mask(&mut self) -> Option<Raster<f32>> {
        match &self.depths {
            None => self.occluders.take(),
            Some(_) => self.masked.take(),
        }
    }

    /// With what the configuration's mask and the depths hide.
    pub(crate) fn hidden(
        mut self,
        mask: Option<Raster<f32>>,
        base_dir: &Path,
    ) -> Result<Self, Error> {
        let hidden = self.hide(mask);
        hidden.map_err(|e| match (&self.description.depth, e) {
            (Some(depth), e @ Error::Points(_)) => e.in_file(base_dir.join(&depth.file.path)),
            (_, e) => e,
        })?;
        let doubt = self.depth_fit.and_then(|fit| fit.doubt());
        self.warnings.extend(doubt);
        if let Some(record) = &mut self.description.depth {
            record.found = self.depth_fit.and_then(|fit| Some(fit.fitted?.scale));
        }
        Ok(self)
    }

    /// As [`LoadedScene::hide`], by the mask alone while depths do not agree with the ground; why they do not, as a sentence.
    #[must_use]
    pub fn hide_if_known(&mut self, mask: Option<Raster<f32>>) -> Option<String> {
        let error = self.hide(mask).err()?;
        self.depth_fit = None;
        (self.surfaces, self.shadow_mask) = (None, None);
        self.occluders.clone_from(&self.masked);
        Some(format!("scene.depth is left out: {error}"))
    }

    /// The pixel of the undistorted photo that shows what the photo shows at `pixel`; `None` where there is none, as at the
    /// edge of a fisheye's.
    pub fn undistorted_pixel(&self, pixel: DVec2) -> Option<DVec2> {
        match &self.original {
            Some(original) => original.undistortion.to_working(pixel),
            None => Some(pixel),
        }
    }

    /// The pixel of the camera's picture that shows what the photograph shows at `pixel`; `None` where there is none. A preview's
    /// camera has fewer pixels than the photograph, and an undistorted photograph others.
    pub fn camera_pixel(&self, pixel: DVec2) -> Option<DVec2> {
        let original = self.original.as_ref();
        let working = original.map_or(self.photo.facts.size, |o| o.undistortion.size());
        let scale = DVec2::from_array(self.scene.camera.resolution.map(f64::from))
            / DVec2::from_array(working.map(f64::from));
        self.undistorted_pixel(pixel).map(|p| p * scale)
    }

    /// The point of the ground, or of what the depths show, that is seen at `pixel` of the photograph; `key` names the pixel in
    /// messages.
    ///
    /// # Errors
    /// If the photograph has no such pixel, and where no ground is seen.
    pub fn seen_at(&self, pixel: Vec2, key: &str) -> Result<Vec3, Error> {
        let size = Vec2::from(self.photo.facts.size.map(|n| n as f32));
        let is_inside = pixel.cmpge(Vec2::ZERO).all() && pixel.cmple(size).all();
        let shown = self.camera_pixel(pixel.as_dvec2()).filter(|_| is_inside);
        let pixel = shown.map(|p| p.as_vec2()).ok_or_else(|| Error::Config {
            key: key.into(),
            value: format!("[{:?}, {:?}]", pixel.x, pixel.y),
            accepted: format!(
                "a pixel of the photograph, [0, 0] to [{:?}, {:?}]",
                size.x, size.y
            ),
        })?;
        let camera = &self.scene.camera;
        let surfaces = self.surfaces.as_ref();
        match surfaces.and_then(|s| s.seen_at(camera, pixel)) {
            Some(found) => Ok(found.position),
            None => Ok(pixels::seen(camera, &self.scene.proxy, pixel, key)?.as_vec3()),
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

/// What a mask or depths say is in front.
fn joined(mask: Option<&Raster<f32>>, found: Raster<f32>) -> Raster<f32> {
    let mut both = found;
    if let Some(mask) = mask {
        for (b, m) in both.pixels_mut().iter_mut().zip(mask.pixels()) {
            *b = b.max(*m);
        }
    }
    both
}

impl Scene {
    /// Reads all files that `config` names, relative to `base_dir`, and places the objects.
    pub fn load(config: &SceneConfig, base_dir: &Path) -> Result<LoadedScene, Error> {
        let (loaded, mask) = Self::load_in(config, base_dir, None, false)?;
        loaded.hidden(mask, base_dir)
    }

    /// As [`Scene::load`], for a look: depths that do not agree with the ground are left out, with a warning.
    pub fn load_for_a_look(config: &SceneConfig, base_dir: &Path) -> Result<LoadedScene, Error> {
        let (mut loaded, mask) = Self::load_in(config, base_dir, None, true)?;
        let left_out = loaded.hide_if_known(mask);
        let doubt = loaded.depth_fit.and_then(|fit| fit.doubt());
        loaded.warnings.extend(left_out.into_iter().chain(doubt));
        Ok(loaded)
    }

    /// As [`Scene::load`], of a frame of a shot: objects and proxy are as in its `photo`, and so is a camera that stands
    /// still.
    pub fn load_frame(
        config: &SceneConfig,
        base_dir: &Path,
        photo: &SceneDescription,
    ) -> Result<LoadedScene, Error> {
        let (loaded, mask) = Self::load_in(config, base_dir, Some(photo), false)?;
        loaded.hidden(mask, base_dir)
    }

    /// The scene, and the mask that is still to be applied. For a `look`, depths need not agree with the ground.
    fn load_in(
        config: &SceneConfig,
        base_dir: &Path,
        of_shot: Option<&SceneDescription>,
        look: bool,
    ) -> Result<(LoadedScene, Option<Raster<f32>>), Error> {
        let mut settings = config.validate()?;
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
        if let CameraSettings::File(file) = &mut settings.camera {
            file.orientation = photo.facts.orientation;
            for part in file.parts(base_dir) {
                files.input("camera", &part);
            }
            files.warn(file.choice(base_dir));
            files.warn(file.doubts(resolution, base_dir));
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
        if let Some(way) = &undistortion {
            way.check_size().map_err(|e| match &settings.camera {
                CameraSettings::File(file) => e.in_file(base_dir.join(&file.path)),
                CameraSettings::LookAt { .. } => e,
            })?;
        }
        let (occluders, occluders_record) = occluders.unzip();
        let (photo, masked, original) = undistort(photo, occluders, undistortion);
        let (depths, depth) =
            files.depths(settings.depth.as_ref(), resolution, undistortion.as_ref())?;
        // The depths of a shot are of one kind.
        let of_photo = of_shot.and_then(|photo| photo.depth.as_ref()?.found);
        let rests = |o: &ObjectSettings| o.placement.rest == Some(Rest::Surface);
        let rests = of_shot.is_none() && settings.objects.iter().any(rests);
        let depths = depths.map(|depths| depths.like(of_photo).with_surfaces(rests));
        let view = ground::view(&camera, undistortion.as_ref());
        let (proxy, proxy_record, cloud) = match of_shot {
            Some(of_shot) => (files.recorded(&of_shot.proxy)?, of_shot.proxy.clone(), None),
            None => files.proxy(&settings.proxy, &view)?,
        };
        let doubt = settings.proxy.doubt(base_dir, &view, cloud.as_ref());
        files.warn(doubt.clone());
        let is_looked_for = settings.objects.iter().any(|o| o.auto.is_some());
        let around = depths.as_ref().filter(|_| of_shot.is_none());
        let around = around.filter(|_| is_looked_for || rests);
        let found = around.map(|d| d.foreground(None, &proxy, &camera, &photo.image));
        let found = match found.transpose() {
            Ok(found) => found,
            Err(e) if rests && !look => {
                let depth = settings.depth.map(|d| d.path).unwrap_or_default();
                return Err(e.in_file(base_dir.join(depth)));
            }
            // Refused afterwards.
            Err(_) => None,
        };
        let (hidden, surfaces) = found.map(|f| (f.mask, f.surfaces)).unzip();
        let surfaces = surfaces.flatten();
        if let (Some(depths), true, None) = (around, rests && !look, &surfaces) {
            return Err(depths.too_coarse());
        }
        let hidden = hidden.map(|found| joined(masked.as_ref(), found));
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
                    surfaces.as_ref(),
                    undistortion.as_ref(),
                )?
            }
        };
        let around = around.filter(|_| is_looked_for);
        // Without points of another kind the depths tell what stands around.
        let around = around.filter(|_| cloud.is_none());
        let around = around.and_then(|depths| depths.cloud(&proxy, &camera).ok());
        let (cloud, off_m) = match around {
            Some((cloud, off_m)) => (Some(cloud), off_m),
            None => (cloud, 0.0),
        };
        let mut places = Places {
            view,
            ground: match (&proxy_record, &proxy) {
                (ProxyRecord::Ground(ground), _) => Some(ground.as_ref().clone()),
                (_, Proxy::Plane(plane)) => Some(Ground {
                    residual_m: off_m,
                    ..ground::of_plane(plane)
                }),
                _ => None,
            },
            cloud,
            occluders: hidden.as_ref().or(masked.as_ref()),
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
                let placement =
                    pixels.place(&placement, &camera, &proxy, surfaces.as_ref(), &key)?;
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
            description: SceneDescription {
                schema: SceneDescription::SCHEMA.into(),
                seed: 0,
                background,
                occluders: occluders_record,
                depth,
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
        };
        Ok((loaded, masked))
    }

    /// Which kinds of surface the triangles have.
    pub fn features(&self) -> SceneFeatures {
        SceneFeatures::of(self)
    }
}
