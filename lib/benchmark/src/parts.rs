//! The other files that objects consist of: buffers, images, material libraries.
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use dipir_scene::import::load_object;

/// Those that were looked at; each object is read once.
#[derive(Default)]
pub struct Parts(Mutex<HashMap<PathBuf, Vec<PathBuf>>>);

impl Parts {
    /// Of an object. None if it cannot be read, which its run says.
    pub fn of(&self, object: &Path) -> Vec<PathBuf> {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let read = || load_object(object).map_or_else(|_| Vec::new(), |o| o.dependencies);
        let parts = known.entry(object.to_owned()).or_insert_with(read);
        parts.clone()
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_library_of_materials_is_part_of_its_object() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::write(at("a.mtl"), "newmtl red\nKd 1 0 0\n").unwrap();
        let mesh = "mtllib a.mtl\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
        fs::write(at("a.obj"), mesh).unwrap();
        let parts = Parts::default();
        assert_eq!(parts.of(&at("a.obj")), [at("a.mtl")]);
        assert!(parts.of(&at("missing.obj")).is_empty());
    }
}
