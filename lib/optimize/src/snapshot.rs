//! The files that checkpoints are: tensors in safetensors (f64, so that nothing is rounded),
//! everything else as JSON in its header, replaced in one step.
use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use glam::Vec3;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::error::OptimizeError;
use crate::tensors::Tensors;

/// The metadata entry that holds what is no tensor.
const STATE: &str = "state";

/// A file that is about to be written.
pub struct Snapshot {
    header: Result<String, serde_json::Error>,
    tensors: BTreeMap<String, (Dtype, Vec<usize>, Vec<u8>)>,
}

impl Snapshot {
    /// With everything that is no tensor.
    pub fn new(header: &impl Serialize) -> Self {
        Self {
            header: serde_json::to_string(header),
            tensors: BTreeMap::new(),
        }
    }

    /// Adds tensors under the names `set.NAME`, so that sets stay apart.
    pub fn add_set(&mut self, set: &str, tensors: &Tensors) {
        for t in &tensors.0 {
            let bytes = t.values.iter().flat_map(|v| v.to_le_bytes()).collect();
            let tensor = (Dtype::F64, vec![t.values.len()], bytes);
            self.tensors.insert(format!("{set}.{}", t.name), tensor);
        }
    }

    /// Adds a list of colours.
    pub fn add_colors(&mut self, name: &str, colors: &[Vec3]) {
        let numbers = colors.iter().flat_map(|t| t.to_array());
        let bytes = numbers.flat_map(f32::to_le_bytes).collect();
        let tensor = (Dtype::F32, vec![colors.len(), 3], bytes);
        self.tensors.insert(name.into(), tensor);
    }

    /// Writes beside `path`, flushes and renames into place: a crash leaves the earlier file or
    /// this one. The same content gives the same bytes.
    pub fn write(&self, path: &Path) -> Result<(), OptimizeError> {
        let failed = |e| OptimizeError::io("write", path, e);
        let bytes = self.to_bytes().map_err(failed)?;
        let partial = path.with_extension("partial");
        let mut file = File::create(&partial).map_err(failed)?;
        file.write_all(&bytes).map_err(failed)?;
        file.sync_all().map_err(failed)?;
        fs::rename(&partial, path).map_err(failed)
    }

    fn to_bytes(&self) -> std::io::Result<Vec<u8>> {
        let header = match &self.header {
            Ok(text) => text.clone(),
            Err(e) => return Err(std::io::Error::other(e.to_string())),
        };
        let metadata = HashMap::from([(STATE.to_string(), header)]);
        let views: Result<Vec<_>, _> = self
            .tensors
            .iter()
            .map(|(name, (dtype, shape, bytes))| {
                TensorView::new(*dtype, shape.clone(), bytes).map(|view| (name, view))
            })
            .collect();
        let views = views.map_err(std::io::Error::other)?;
        safetensors::serialize(views, Some(metadata)).map_err(std::io::Error::other)
    }
}

/// A file that was read.
pub struct SnapshotFile {
    path: PathBuf,
    bytes: Vec<u8>,
}

impl SnapshotFile {
    /// Reads `path`; `None` if there is no file.
    pub fn read(path: &Path) -> Result<Option<Self>, OptimizeError> {
        match fs::read(path) {
            Ok(bytes) => Ok(Some(Self {
                path: path.into(),
                bytes,
            })),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(OptimizeError::io("read", path, e)),
        }
    }

    /// The error for a file that cannot be gone on from.
    pub fn refused(&self, detail: String) -> OptimizeError {
        OptimizeError::BadFile {
            path: self.path.clone(),
            detail,
            remedy: "delete it to start from the beginning",
        }
    }

    fn damaged(&self, e: &dyn std::fmt::Display) -> OptimizeError {
        self.refused(format!("is damaged: {e}"))
    }

    /// Everything that is no tensor.
    pub fn header<H: DeserializeOwned>(&self) -> Result<H, OptimizeError> {
        let read = SafeTensors::read_metadata(&self.bytes);
        let (_, metadata) = read.map_err(|e| self.damaged(&e))?;
        let text = metadata.metadata().as_ref().and_then(|m| m.get(STATE));
        let text =
            text.ok_or_else(|| self.refused("is no checkpoint of an optimisation".into()))?;
        serde_json::from_str(text)
            .map_err(|e| self.refused(format!("was written by another version: {e}")))
    }

    /// Refuses another version.
    pub fn check_schema(&self, found: u32, expected: u32) -> Result<(), OptimizeError> {
        match found == expected {
            true => Ok(()),
            false => Err(self.refused(format!("has schema {found}, not {expected}"))),
        }
    }

    fn tensors(&self) -> Result<SafeTensors<'_>, OptimizeError> {
        SafeTensors::deserialize(&self.bytes).map_err(|e| self.damaged(&e))
    }

    /// The tensors of a set, which must have the names and sizes of `shape` and be finite.
    pub fn set(&self, set: &str, shape: &Tensors) -> Result<Tensors, OptimizeError> {
        let file = self.tensors()?;
        let mut loaded = shape.clone();
        for t in &mut loaded.0 {
            let name = format!("{set}.{}", t.name);
            let view = file
                .tensor(&name)
                .map_err(|_| self.refused(format!("holds no tensor \"{name}\"")))?;
            if view.dtype() != Dtype::F64 || view.shape() != [t.values.len()] {
                return Err(self.refused(format!(
                    "holds \"{name}\" as {:?} {:?}; expected F64 [{}]",
                    view.dtype(),
                    view.shape(),
                    t.values.len()
                )));
            }
            let numbers = view.data().as_chunks::<8>().0.iter();
            t.values = numbers.map(|b| f64::from_le_bytes(*b)).collect();
            if t.values.iter().any(|v| !v.is_finite()) {
                let detail = format!("holds a NaN or an infinity in \"{name}\"");
                return Err(self.refused(detail));
            }
        }
        Ok(loaded)
    }

    /// A list of colours; `None` if there is none of that name.
    pub fn colors(&self, name: &str) -> Result<Option<Vec<Vec3>>, OptimizeError> {
        let file = self.tensors()?;
        let Ok(view) = file.tensor(name) else {
            return Ok(None);
        };
        if view.dtype() != Dtype::F32 || view.shape().len() != 2 || view.shape()[1] != 3 {
            let detail = format!("holds a \"{name}\" that is no list of colours");
            return Err(self.refused(detail));
        }
        let texel = |b: &[u8; 12]| {
            let at = |k: usize| f32::from_le_bytes([b[k], b[k + 1], b[k + 2], b[k + 3]]);
            Vec3::new(at(0), at(4), at(8))
        };
        let texels = view.data().as_chunks::<12>().0.iter();
        Ok(Some(texels.map(texel).collect()))
    }
}
