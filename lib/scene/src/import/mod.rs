//! Objects from files: glTF, GLB and OBJ.
mod accessor;
mod container;
mod document;
mod gltf;
mod gltf_material;
mod gltf_mesh;
mod mtl;
mod obj;
pub mod tangents;

use std::path::{Path, PathBuf};

use glam::DVec3;

pub use self::gltf::load_gltf_bytes;
pub use container::{Folder, NoFiles, Resolver};
pub use obj::load_obj_bytes;

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

/// How large an object may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Most vertices, copies counted.
    pub max_vertices: u64,
    /// Most triangles, copies counted.
    pub max_triangles: u64,
}

impl Default for Limits {
    /// 2^28 of each: some 30 GB, beyond which a file is more likely broken than wanted.
    fn default() -> Self {
        Self {
            max_vertices: 1 << 28,
            max_triangles: 1 << 28,
        }
    }
}

impl Limits {
    pub(crate) fn check(&self, vertices: u64, triangles: u64) -> Result<(), Error> {
        for (count, things, limit) in [
            (vertices, "vertices", self.max_vertices),
            (triangles, "triangles", self.max_triangles),
        ] {
            if count > limit {
                return Err(Error::TooLarge {
                    what: format!("the object has {count} {things}"),
                    limit,
                });
            }
        }
        Ok(())
    }
}

/// Reads a `.gltf`, `.glb` or `.obj` file. Which of them it is follows from the extension.
pub fn load_object(path: &Path) -> Result<Imported, Error> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    let is_obj = match extension.as_deref() {
        Some("glb" | "gltf") => false,
        Some("obj") => true,
        _ => {
            return Err(Error::malformed(
                format!(
                    "\"{}\" is not a kind of object that is read",
                    path.display()
                ),
                "use a .glb, .gltf or .obj file",
            ));
        }
    };
    let bytes = std::fs::read(path).map_err(|source| Error::Read {
        role: "the object".into(),
        path: path.into(),
        source,
    })?;
    let folder = Folder::new(path.parent().unwrap_or(Path::new("")));
    let limits = Limits::default();
    let loaded = if is_obj {
        load_obj_bytes(&bytes, &folder, &limits)
    } else {
        load_gltf_bytes(&bytes, &folder, &limits)
    };
    let mut imported = loaded.map_err(|e| e.in_file(path))?;
    imported.dependencies = folder.into_used();
    Ok(imported)
}
