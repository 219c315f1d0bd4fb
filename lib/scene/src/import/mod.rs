//! Objects from files: glTF, GLB, OBJ, PLY and STL.
mod accessor;
mod container;
mod document;
mod gltf;
mod gltf_material;
mod gltf_mesh;
mod held;
mod lights;
mod meshopt;
mod mtl;
mod obj;
mod opacity;
mod ply;
mod polygon;
mod stl;
pub mod tangents;

use std::path::{Path, PathBuf};

use glam::DVec3;

pub use self::gltf::load_gltf_bytes;
pub(crate) use container::once;
pub use container::{Folder, NoFiles, Resolver};
pub use obj::load_obj_bytes;
pub use ply::load_ply_bytes;
pub use stl::load_stl_bytes;

pub use crate::limits::Limits;

use crate::error::Error;
use crate::light::PunctualLight;
use crate::material::Material;
use crate::mesh::TriangleMesh;
use crate::printable::printable;
use crate::texture::{ImageSource, Texture, check_sizes};

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
    /// In the file's coordinates. They are not rendered.
    pub lights: Vec<PunctualLight>,
    /// What was ignored or repaired, one sentence each.
    pub warnings: Vec<String>,
    /// Further files that the object consists of (buffers, images, material libraries).
    pub dependencies: Vec<PathBuf>,
    /// Where files of it were looked for and could not be opened: it is as it is without them.
    pub missing: Vec<PathBuf>,
}

/// Extensions of the kinds of file that are read.
pub const EXTENSIONS: [&str; 5] = ["glb", "gltf", "obj", "ply", "stl"];

/// Kinds of file that are not read, and how to convert them.
const CONVERTED: [(&[&str], &str); 5] = [
    (
        &["fbx"],
        "convert it: FBX2glTF -b -i IN.fbx -o OUT.glb, or open it in Blender and export a .glb file",
    ),
    (&["blend"], "open it in Blender and export a .glb file"),
    (
        &["usd", "usda", "usdc", "usdz"],
        "open it in Blender and export a .glb file",
    ),
    (&["3ds", "dae"], "convert it: assimp export IN OUT.glb"),
    (
        &[
            "vrml", "wrl", "x3d", "step", "stp", "iges", "igs", "max", "c4d", "ma", "mb", "3mf",
        ],
        "export it as a .glb file from the program that made it",
    ),
];

/// Reads an object from a file with the default [`Limits`]. See [`load_object_within`].
pub fn load_object(path: &Path) -> Result<Imported, Error> {
    load_object_within(path, &Limits::default())
}

/// Reads a `.gltf`, `.glb`, `.obj`, `.ply` or `.stl` file. Which of them it is follows from the
/// extension.
pub fn load_object_within(path: &Path, limits: &Limits) -> Result<Imported, Error> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    let extension = extension.as_deref().unwrap_or("");
    if !EXTENSIONS.contains(&extension) {
        let known = CONVERTED.iter().find(|(all, _)| all.contains(&extension));
        return Err(Error::malformed(
            format!(
                "\"{}\" is not a kind of object that is read",
                path.display()
            ),
            known.map_or("use a .glb, .gltf, .obj, .ply or .stl file", |(_, how)| how),
        ));
    }
    let bytes = read_whole(path, limits)?;
    let folder = Folder::new(path.parent().unwrap_or(Path::new("")), limits);
    let loaded = match extension {
        "obj" => load_obj_bytes(&bytes, &folder, limits),
        "ply" => load_ply_bytes(&bytes, limits),
        "stl" => load_stl_bytes(&bytes, limits),
        _ => load_gltf_bytes(&bytes, &folder, limits),
    };
    let mut imported = loaded.map_err(|e| match dipir_files::refuse_utf16(&bytes) {
        Ok(()) => e.in_file(path),
        Err(source) => unreadable(path, source),
    })?;
    imported.warnings.extend(folder.take_warnings());
    (imported.dependencies, imported.missing) = folder.into_used_and_missing();
    for texture in &mut imported.textures {
        if let ImageSource::Bytes { name, .. } = &mut texture.image {
            *name = format!("{}: {name}", path.display());
        }
    }
    Ok(imported)
}

fn read_whole(path: &Path, limits: &Limits) -> Result<Vec<u8>, Error> {
    let file = dipir_files::open(path).map_err(|e| unreadable(path, e))?;
    let length = file.metadata().map_err(|e| unreadable(path, e))?.len();
    limits.check_bytes(length).map_err(|e| e.in_file(path))?;
    dipir_files::read(path).map_err(|e| unreadable(path, e))
}

fn unreadable(path: &Path, source: std::io::Error) -> Error {
    Error::Read {
        role: "the object".into(),
        path: path.into(),
        source,
    }
}

impl Imported {
    /// A mesh of one material.
    fn of(mesh: TriangleMesh, material: Material) -> Self {
        Self {
            mesh,
            origin: DVec3::ZERO,
            materials: vec![material],
            textures: Vec::new(),
            lights: Vec::new(),
            warnings: Vec::new(),
            dependencies: Vec::new(),
            missing: Vec::new(),
        }
    }

    /// The object with its textures' sizes checked, and each warning once, the names in it printable.
    fn checked(mut self, limits: &Limits) -> Result<Self, Error> {
        check_sizes(&self.textures, limits)?;
        self.textures
            .iter()
            .try_for_each(|texture| held::check(&texture.image))?;
        self.warnings = once(self.warnings).iter().map(printable).collect();
        Ok(self)
    }
}
