//! Memory-mapped safetensors: one file or several shards behind one index.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use candle_core::{DType, Device, Tensor};
use memmap2::Mmap;
use safetensors::tensor::{Dtype, SafeTensors};
use serde::Deserialize;

use crate::error::{Error, Result, io};
use crate::extent::Extent;

/// How the text begins that a clone without Git LFS holds instead of a large file.
const GIT_LFS: &[u8] = b"version https://git-lfs.github.com/spec/";

/// Where one tensor lies.
#[derive(Debug, Clone)]
struct Entry {
    file: usize,
    dtype: Dtype,
    shape: Vec<usize>,
    /// Byte range in the file.
    range: std::ops::Range<usize>,
}

/// Named tensors in memory-mapped safetensors files.
///
/// The headers are checked when the files are opened: lengths, offsets and
/// shapes have to agree with each other and with the file, so that reading a
/// tensor afterwards cannot reach outside the mapping.
#[derive(Debug)]
pub struct Weights {
    path: PathBuf,
    files: Vec<Arc<Mmap>>,
    entries: BTreeMap<String, Entry>,
    metadata: BTreeMap<String, String>,
}

#[derive(Deserialize)]
struct ShardIndex {
    weight_map: BTreeMap<String, String>,
}

impl ShardIndex {
    fn read(index: &Path) -> Result<Self> {
        let bytes = dipir_files::read(index).map_err(io("read", index))?;
        serde_json::from_slice(&bytes).map_err(|e| Error::Config {
            path: index.to_owned(),
            message: format!("not a shard index: {e}"),
        })
    }
}

/// What stands for the weights in a folder.
enum Chosen {
    File(PathBuf),
    Index(PathBuf),
}

/// The first that is there of `stem.safetensors`, its index, and both as a half-precision variant.
fn chosen(folder: &Path, stem: &str) -> Option<Chosen> {
    for variant in ["", ".fp16", ".bf16"] {
        let single = folder.join(format!("{stem}{variant}.safetensors"));
        if single.is_file() {
            return Some(Chosen::File(single));
        }
        for index in [
            format!("{stem}.safetensors.index{variant}.json"),
            format!("{stem}{variant}.safetensors.index.json"),
        ] {
            let index = folder.join(index);
            if index.is_file() {
                return Some(Chosen::Index(index));
            }
        }
    }
    None
}

/// The names of the files in `folder` that [`Weights::open`] reads for `stem`: one, or an index and its shards; none
/// where there are none. Of an index that is none the name alone: opening it says what is wrong.
pub fn weight_files(folder: &Path, stem: &str) -> BTreeSet<String> {
    let name = |path: &Path| path.file_name().map(|n| n.to_string_lossy().into_owned());
    match chosen(folder, stem) {
        None => BTreeSet::new(),
        Some(Chosen::File(file)) => name(&file).into_iter().collect(),
        Some(Chosen::Index(index)) => {
            let shards = ShardIndex::read(&index).map(|parsed| parsed.weight_map);
            let shards = shards.unwrap_or_default().into_values();
            shards.chain(name(&index)).collect()
        }
    }
}

impl Weights {
    /// Opens the weights called `stem` in `folder`: `stem.safetensors`, the
    /// shards of `stem.safetensors.index.json`, or the half-precision variants
    /// `stem.fp16.safetensors` and `stem.bf16.safetensors`, in this order.
    pub fn open(folder: &Path, stem: &str) -> Result<Self> {
        match chosen(folder, stem) {
            Some(Chosen::File(file)) => return Self::open_file(&file),
            Some(Chosen::Index(index)) => return Self::open_shards(&index),
            None => {}
        }
        let found = others(folder, stem);
        let is_pickled =
            |name: &String| name.ends_with(".bin") || name.ends_with(".bin.index.json");
        let there = match found.is_empty() {
            true => String::new(),
            false => format!("there is {}: ", found.join(", ")),
        };
        let remedy = match found.first() {
            None => "fetch the model's folder again with its *.safetensors files".into(),
            Some(_) if found.iter().all(is_pickled) => {
                "convert it with diffusers' save_pretrained(..., safe_serialization=True)"
                    .to_owned()
            }
            Some(_) => format!("rename the variant that is wanted to {stem}.safetensors"),
        };
        Err(Error::Weights {
            path: folder.to_owned(),
            problems: vec![format!(
                "no {stem}.safetensors, no {stem}.safetensors.index.json, and neither of them as .fp16 or .bf16; {there}{remedy}"
            )],
        })
    }

    /// Opens a single safetensors file.
    pub fn open_file(path: &Path) -> Result<Self> {
        let mut weights = Self {
            path: path.to_owned(),
            files: vec![],
            entries: BTreeMap::new(),
            metadata: BTreeMap::new(),
        };
        weights.add(path, None)?;
        Ok(weights)
    }

    fn open_shards(index: &Path) -> Result<Self> {
        let parsed = ShardIndex::read(index)?;
        let folder = index.parent().unwrap_or(Path::new("."));
        let mut shards: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
        for (name, file) in &parsed.weight_map {
            if Path::new(file).components().count() != 1 || file.starts_with('.') {
                return Err(Error::Config {
                    path: index.to_owned(),
                    message: format!(
                        "shard {file:?} of tensor {name:?} is not a plain file name beside the index"
                    ),
                });
            }
            shards.entry(file).or_default().push(name);
        }
        let mut weights = Self {
            path: index.to_owned(),
            files: vec![],
            entries: BTreeMap::new(),
            metadata: BTreeMap::new(),
        };
        for (file, names) in shards {
            weights.add(&folder.join(file), Some(&names))?;
        }
        Ok(weights)
    }

    fn add(&mut self, path: &Path, expected: Option<&[&str]>) -> Result<()> {
        let file = dipir_files::open(path).map_err(io("read", path))?;
        // SAFETY: the mapping is read-only. As with every memory-mapped file,
        // another process that truncates it while it is in use breaks the
        // contract; model files are not modified in place.
        let map = unsafe { Mmap::map(&file) }.map_err(io("read", path))?;
        let damaged = |message: String| Error::Safetensors {
            path: path.to_owned(),
            message,
        };
        if map.starts_with(GIT_LFS) {
            return Err(damaged(
                "it is what Git LFS leaves in its place (git lfs pull fetches it)".into(),
            ));
        }
        let (header_len, header) =
            SafeTensors::read_metadata(&map).map_err(|e| damaged(e.to_string()))?;
        let base = 8 + header_len;
        // A header may describe less than the file holds only by being wrong.
        let parsed = SafeTensors::deserialize(&map).map_err(|e| damaged(e.to_string()))?;
        drop(parsed);
        for (name, info) in header.tensors() {
            let (start, end) = info.data_offsets;
            let entry = Entry {
                file: self.files.len(),
                dtype: info.dtype,
                shape: info.shape.clone(),
                range: base + start..base + end,
            };
            if self.entries.insert(name.clone(), entry).is_some() {
                return Err(damaged(format!("tensor {name:?} is in two shards")));
            }
        }
        for name in expected.unwrap_or(&[]) {
            if !self.entries.contains_key(*name) {
                return Err(damaged(format!(
                    "the index places tensor {name:?} here, but it is not in this shard"
                )));
            }
        }
        if let Some(metadata) = header.metadata() {
            self.metadata
                .extend(metadata.iter().map(|(k, v)| (k.clone(), v.clone())));
        }
        self.files.push(Arc::new(map));
        Ok(())
    }

    /// The same tensors under other names. Where `names` gives several for one, it is cut into as many equal parts along
    /// its first dimension; where it gives none, the tensor is left out.
    pub fn renamed(&self, names: impl Fn(&str) -> Vec<String>) -> Result<Self> {
        let mut entries = BTreeMap::new();
        for (name, entry) in &self.entries {
            let new = names(name);
            let rows = entry.shape.first().copied().unwrap_or(1);
            if new.len() > 1 && !rows.is_multiple_of(new.len()) {
                return Err(Error::Weights {
                    path: self.path.clone(),
                    problems: vec![format!(
                        "tensor {name:?} of shape {:?} cannot be cut into {} equal parts",
                        entry.shape,
                        new.len()
                    )],
                });
            }
            let parts = new.len().max(1);
            let bytes = entry.range.len() / parts;
            for (part, new) in new.into_iter().enumerate() {
                let start = entry.range.start + part * bytes;
                let mut shape = entry.shape.clone();
                if let Some(rows) = shape.first_mut() {
                    *rows /= parts;
                }
                let cut = Entry {
                    file: entry.file,
                    dtype: entry.dtype,
                    shape,
                    range: start..start + bytes,
                };
                if entries.insert(new.clone(), cut).is_some() {
                    return Err(Error::Weights {
                        path: self.path.clone(),
                        problems: vec![format!(
                            "two tensors are both {new:?}, one of them {name:?}"
                        )],
                    });
                }
            }
        }
        Ok(Self {
            path: self.path.clone(),
            files: self.files.clone(),
            entries,
            metadata: self.metadata.clone(),
        })
    }

    /// The file or index that was opened.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// How large a network these weights allow.
    pub fn extent(&self) -> Extent {
        // A tensor without numbers may have an axis of any length.
        let held = self.entries.values().filter(|e| !e.range.is_empty());
        let axes = held.flat_map(|entry| &entry.shape);
        Extent {
            tensors: self.entries.len(),
            axis: axes.copied().max().unwrap_or(0),
        }
    }

    /// Precisions of the stored numbers, that of most bytes first; whole numbers are left out.
    pub fn precisions(&self) -> Vec<String> {
        let mut bytes: BTreeMap<String, usize> = BTreeMap::new();
        for entry in self.entries.values() {
            let name = format!("{:?}", entry.dtype);
            if name.contains('F') {
                *bytes.entry(name).or_default() += entry.range.len();
            }
        }
        let mut found: Vec<_> = bytes.into_iter().collect();
        found.sort_by_key(|(_, bytes)| std::cmp::Reverse(*bytes));
        found.into_iter().map(|(name, _)| name).collect()
    }

    /// Names in byte order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.entries.keys().map(String::as_str)
    }

    /// The free-form strings of the header.
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// Whether a tensor of this name exists.
    pub fn contains(&self, name: &str) -> bool {
        self.entries.contains_key(name)
    }

    /// Shape of a tensor, if it exists.
    pub fn shape(&self, name: &str) -> Option<&[usize]> {
        self.entries.get(name).map(|entry| entry.shape.as_slice())
    }

    /// Reads a tensor and converts it to `dtype` on `device`; `None` if no
    /// tensor has this name.
    pub fn tensor(&self, name: &str, dtype: DType, device: &Device) -> Result<Option<Tensor>> {
        let Some(entry) = self.entries.get(name) else {
            return Ok(None);
        };
        let stored = match entry.dtype {
            Dtype::F32 => DType::F32,
            Dtype::F16 => DType::F16,
            Dtype::BF16 => DType::BF16,
            Dtype::F64 => DType::F64,
            Dtype::I64 => DType::I64,
            Dtype::I32 => DType::I32,
            Dtype::U8 => DType::U8,
            other => {
                return Err(Error::Weights {
                    path: self.path.clone(),
                    problems: vec![format!(
                        "tensor {name:?} is stored as {other:?}, accepted are F32, F16 and BF16; convert the model"
                    )],
                });
            }
        };
        let bytes = &self.files[entry.file][entry.range.clone()];
        let tensor = Tensor::from_raw_buffer(bytes, stored, &entry.shape, &Device::Cpu)?;
        Ok(Some(tensor.to_dtype(dtype)?.to_device(device)?))
    }
}

/// Names of the files in `folder` that are called `stem` with something behind, in order.
fn others(folder: &Path, stem: &str) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let names = entries.map(|e| e.file_name().to_string_lossy().into_owned());
    let is_variant = |name: &String| {
        let rest = name.strip_prefix(stem);
        rest.is_some_and(|r| r.starts_with(['.', '-']))
    };
    let mut names: Vec<String> = names.filter(is_variant).collect();
    names.sort();
    names
}

/// Writes tensors and header strings to `path`, through a temporary file
/// beside it, so that a reader never sees half a file. Names are written in
/// byte order: the same tensors give the same bytes. Where it fails, the
/// temporary file is removed.
pub fn write_safetensors(
    path: &Path,
    tensors: &BTreeMap<String, Tensor>,
    metadata: &BTreeMap<String, String>,
) -> Result<()> {
    let bytes = serialize_safetensors(tensors, metadata)?;
    let temporary = path.with_extension("partial");
    let written = std::fs::write(&temporary, bytes)
        .map_err(io("write", &temporary))
        .and_then(|()| std::fs::rename(&temporary, path).map_err(io("write", path)));
    if written.is_err() {
        let _ = std::fs::remove_file(&temporary);
    }
    written
}

/// The bytes that [`write_safetensors`] writes: header keys in sorted order.
fn serialize_safetensors(
    tensors: &BTreeMap<String, Tensor>,
    metadata: &BTreeMap<String, String>,
) -> Result<Vec<u8>> {
    let mut header = serde_json::Map::new();
    if !metadata.is_empty() {
        header.insert("__metadata__".into(), serde_json::json!(metadata));
    }
    let mut data: Vec<u8> = vec![];
    for (name, tensor) in tensors {
        let start = data.len();
        let tensor = tensor
            .to_device(&Device::Cpu)?
            .contiguous()?
            .flatten_all()?;
        let dtype = match tensor.dtype() {
            DType::F32 => {
                tensor
                    .to_vec1::<f32>()?
                    .iter()
                    .for_each(|v| data.extend(v.to_le_bytes()));
                "F32"
            }
            DType::F16 => {
                tensor
                    .to_vec1::<half::f16>()?
                    .iter()
                    .for_each(|v| data.extend(v.to_le_bytes()));
                "F16"
            }
            DType::BF16 => {
                tensor
                    .to_vec1::<half::bf16>()?
                    .iter()
                    .for_each(|v| data.extend(v.to_le_bytes()));
                "BF16"
            }
            DType::I64 => {
                tensor
                    .to_vec1::<i64>()?
                    .iter()
                    .for_each(|v| data.extend(v.to_le_bytes()));
                "I64"
            }
            other => {
                return crate::error::argument(format!("tensor {name:?}: cannot write {other:?}"));
            }
        };
        let shape = tensors[name].dims();
        header.insert(
            name.clone(),
            serde_json::json!({"dtype": dtype, "shape": shape, "data_offsets": [start, data.len()]}),
        );
    }
    let mut head = serde_json::Value::Object(header).to_string().into_bytes();
    // The format wants the data aligned to 8 bytes; spaces are allowed padding.
    head.resize(head.len().next_multiple_of(8), b' ');
    let mut bytes = (head.len() as u64).to_le_bytes().to_vec();
    bytes.append(&mut head);
    bytes.append(&mut data);
    Ok(bytes)
}
