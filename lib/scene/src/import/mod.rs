//! Objects from files: glTF, GLB and OBJ.
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::error::Error;
use crate::material::Material;
use crate::mesh::TriangleMesh;
use crate::texture::Texture;

/// An object as its file describes it, node transforms applied and instances expanded.
#[derive(Clone, Debug)]
pub struct Imported {
    /// Positions relative to [`origin`](Self::origin), metres.
    pub mesh: TriangleMesh,
    /// Where the mesh's (0, 0, 0) lies in the file's coordinates, metres. It is zero unless the
    /// file puts its content so far out that single precision would lose detail there.
    pub origin: DVec3,
    /// Indexed by [`TriangleMesh::materials`]; never empty.
    pub materials: Vec<Material>,
    /// Indexed by [`TextureRef::texture`](crate::material::TextureRef::texture).
    pub textures: Vec<Texture>,
    /// What was ignored or repaired, one sentence each.
    pub warnings: Vec<String>,
    /// Further files that the object consists of (buffers, images, material libraries).
    pub dependencies: Vec<PathBuf>,
}

/// Reads a `.gltf`, `.glb` or `.obj` file.
pub fn load_object(path: &Path) -> Result<Imported, Error> {
    Err(Error::malformed(
        format!("\"{}\": no importer", path.display()),
        "use a .glb, .gltf or .obj file",
    ))
}
