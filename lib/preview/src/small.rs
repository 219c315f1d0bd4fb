//! A project's scene with its photograph scaled down.
use std::path::PathBuf;
use std::sync::Arc;

use dipir_cli::session::Session;
use dipir_imaging::facts::Facts;
use dipir_imaging::raster::LinearImage;
use dipir_imaging::resize::{Filter, resize};
use dipir_scene::camera::Camera;
use dipir_scene::config::SceneConfig;
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::plausibility::implausible;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::{LoadedScene, Scene};
use dipir_scene::surfaces::SeenSurfaces;
use dipir_scene::undistortion::Undistortion;
use dipir_stages::composite::table::CompositeTable;
use dipir_stages::scene::with_place;
use glam::{DMat4, DVec2};

use crate::arrangement::{Arrangement, Model, plane_of};

/// What was read of a project.
pub struct SmallScene {
    /// Photograph, mask and camera are scaled; objects stand as last arranged.
    pub loaded: LoadedScene,
    /// What stays, however objects are arranged.
    pub props: Arc<Props>,
}

/// What placing objects asks of the files that were read.
pub struct Props {
    /// The objects' files.
    pub models: Vec<Model>,
    facts: Facts,
    proxy: Proxy,
    /// What depths show beside it.
    surfaces: Option<SeenSurfaces>,
    /// From each object's file to the world, as it was read.
    maps: Vec<DMat4>,
    /// The folder that paths of the configuration start from.
    base_dir: PathBuf,
}

impl Props {
    /// The camera of `config`, whatever its objects.
    ///
    /// # Errors
    /// On a configuration that cannot be used.
    pub fn camera(&self, config: &SceneConfig) -> anyhow::Result<Camera> {
        Ok(self.resolved(config)?.0)
    }

    fn resolved(&self, config: &SceneConfig) -> anyhow::Result<(Camera, Option<Undistortion>)> {
        let settings = config.validate()?.camera.with_facts(&self.facts)?;
        Ok(settings.resolve(self.facts.size, &self.base_dir)?)
    }

    /// The plane of `config`'s proxy as its camera sees it, whatever its objects; `None` if the proxy is told otherwise.
    ///
    /// # Errors
    /// On a configuration that cannot be used.
    pub fn plane(&self, config: &SceneConfig) -> anyhow::Result<Option<Plane>> {
        let (camera, undistortion) = self.resolved(config)?;
        plane_of(&config.validate()?.proxy, &camera, undistortion.as_ref())
    }

    /// Whether `camera` sees a surface before the proxy at `pixel`.
    pub fn shows_surface(&self, camera: &Camera, pixel: DVec2) -> bool {
        let seen = |s: &SeenSurfaces| s.seen_at(camera, pixel.as_vec2()).is_some();
        self.surfaces.as_ref().is_some_and(seen)
    }

    /// Where the objects of `config` stand; nothing is read but the camera's file.
    ///
    /// # Errors
    /// On a configuration that cannot be used, or names other models than those that were read.
    pub fn arranged(&self, config: &SceneConfig) -> anyhow::Result<Arrangement> {
        Arrangement::new(
            config,
            &self.base_dir,
            &self.facts,
            &self.models,
            &self.proxy,
            self.surfaces.as_ref(),
            &self.maps,
        )
    }
}

impl SmallScene {
    /// Reads the session's scene and scales it to at most `longest` pixels a side. Returns the
    /// arrangement of its objects, too.
    ///
    /// # Errors
    /// On a configuration or files that cannot be used.
    pub fn load(session: &Session, longest: u32) -> anyhow::Result<(Self, Arrangement)> {
        let config: SceneConfig = session.config.table("scene")?;
        let base_dir = session.config.base_dir();
        let mut loaded = Scene::load_for_a_look(&config, &base_dir)
            .map_err(|e| with_place(e, &session.config))?;
        let composite: CompositeTable = session.config.table("composite")?;
        composite.scale_emission(&mut loaded.scene);
        let mut warnings = std::mem::take(&mut loaded.warnings);
        warnings.extend(implausible(&loaded));
        let models = Model::all(&loaded);
        let full = loaded.scene.camera;
        let [width, height] = scaled(full.resolution, longest);
        loaded.scene.camera = full.scaled([width, height]);
        let (w, h) = (width as usize, height as usize);
        loaded.photo.alpha = None;
        if full.resolution != [width, height] {
            loaded.photo.image = LinearImage(resize(&loaded.photo.image.0, w, h, Filter::Area));
            let mask = loaded.take_mask();
            let mask = mask.map(|mask| resize(&mask, w, h, Filter::Area));
            loaded.depths = loaded.depths.map(|depths| depths.within([width, height]));
            warnings.extend(loaded.hide_if_known(mask).filter(|w| !warnings.contains(w)));
            // A photograph without values is taken for linear light, which has another exposure and no curve.
            if loaded.photo.values.is_some() {
                let shown = loaded.photo.transfer.encode(&loaded.photo.image).0;
                let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
                loaded.photo.values = Some(shown.map(|p| p.to_array().map(byte)));
            }
        }
        let props = Arc::new(Props {
            models,
            facts: loaded.taken().facts.clone(),
            proxy: loaded.scene.proxy.clone(),
            surfaces: loaded.surfaces.clone(),
            maps: (loaded.description.objects.iter())
                .map(|o| o.transform())
                .collect(),
            base_dir,
        });
        let mut arrangement = props.arranged(&config)?;
        // What the scene says of itself holds these already.
        arrangement.warnings = warnings;
        Ok((Self { loaded, props }, arrangement))
    }

    /// The plane of the proxy, if it is one.
    pub fn plane(&self) -> Option<Plane> {
        match &self.loaded.scene.proxy {
            Proxy::Plane(plane) => Some(*plane),
            Proxy::None | Proxy::Mesh(_) => None,
        }
    }

    /// Puts camera and objects where `arrangement` has them.
    pub fn arrange(&mut self, arrangement: &Arrangement) {
        let scene = &mut self.loaded.scene;
        scene.camera = arrangement.camera.scaled(scene.camera.resolution);
        scene.proxy = arrangement.proxy.clone();
        let mut mesh = TriangleMesh::default();
        for object in &arrangement.objects {
            let mut placed = self.props.models[object.model].mesh.clone();
            placed.transform(&object.map);
            mesh.append(placed, 0);
        }
        scene.mesh = mesh;
    }
}

/// The size of a picture with no side above `longest`, of the same shape, never enlarged.
fn scaled([width, height]: [u32; 2], longest: u32) -> [u32; 2] {
    let scale = (f64::from(longest) / f64::from(width.max(height))).min(1.0);
    [width, height].map(|n| ((f64::from(n) * scale).round() as u32).max(1))
}
