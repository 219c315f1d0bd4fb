//! `transport.safetensors`: the record as a file that is mapped, not read.
//!
//! Tensors: `base` (H, W, 3) and `coverage` (H, W), f32; `environment.density` (rows, columns),
//! f32, per steradian; and for each of the row sets `object`, `shadow.blocked` and
//! `shadow.arriving` its `offsets` (H W + 1), u32, `order` (H W), u16, `exponents` (H W), i8, `entries`
//! (n, numbers an entry), u16 or u32, and `merged` (n), u8. Rows are in the order that `rows` tells. An entry is one weight per channel of the object, one
//! for all channels of the shadow, and a texel; weights are the bits of halves or floats. A plane
//! has `shadow.cosine` (rows, columns), a proxy mesh `shadow.share` (H, W), both f32. Where the
//! object sends light to the proxy there is a row set `sent` with entries like the object's, and
//! `sent.base` (H, W, 3), f32. Metadata: one entry, [`FORMAT`], whose value is the [`Header`] as JSON.
//!
//! A file is checked when it is opened: shapes against the header, offsets monotone, each pixel once, texels in
//! range, weights finite. After that it is trusted, and must not be changed while it is in use.
use std::borrow::Cow;
use std::collections::HashMap;
use std::fs::File;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use bytemuck::Pod;
use dipir_imaging::raster::Raster;
use glam::Vec3;
use memmap2::Mmap;
use rayon::prelude::*;
use safetensors::tensor::{Dtype, SafeTensors, View};

use super::rows::{BAND, Entry, Rows, Store};
use super::{Header, Precision, RowSet, Sent, Shadow, ShadowKind, Transport, Weights, with_rows};
use crate::error::RenderError;

/// The key of the header, and the version of everything in the file.
const FORMAT: &str = "dipir_transport_3";

/// Pictures and environments may have this many pixels or texels; more is a damaged header.
const MOST_PIXELS: usize = 1 << 30;

struct Tensor<'a> {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Cow<'a, [u8]>,
}

impl<'a> Tensor<'a> {
    fn new<T: Pod>(dtype: Dtype, shape: &[usize], values: &'a [T]) -> Self {
        Self {
            dtype,
            shape: shape.to_vec(),
            bytes: Cow::Borrowed(bytemuck::cast_slice(values)),
        }
    }

    fn vectors(shape: &[usize], values: &[Vec3]) -> Self {
        let numbers: Vec<[f32; 3]> = values.iter().map(Vec3::to_array).collect();
        Self {
            dtype: Dtype::F32,
            shape: shape.to_vec(),
            bytes: Cow::Owned(bytemuck::cast_slice(&numbers).to_vec()),
        }
    }
}

impl View for &Tensor<'_> {
    fn dtype(&self) -> Dtype {
        self.dtype
    }
    fn shape(&self) -> &[usize] {
        &self.shape
    }
    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&self.bytes)
    }
    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}

fn entry_dtype<E: Entry>() -> Dtype {
    if E::SCALED { Dtype::U16 } else { Dtype::U32 }
}

impl Transport {
    /// Writes the record; the same record gives the same bytes. Little-endian machines only, as
    /// the format has it.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<(), RenderError> {
        const { assert!(cfg!(target_endian = "little")) };
        let path = path.as_ref();
        let [width, height] = self.header.size;
        let [columns, rows] = self.header.environment;
        let mut tensors = vec![
            (
                "base".to_owned(),
                Tensor::vectors(&[height, width, 3], self.base.pixels()),
            ),
            (
                "coverage".to_owned(),
                Tensor::new(Dtype::F32, &[height, width], self.coverage.pixels()),
            ),
            (
                "environment.density".to_owned(),
                Tensor::new(Dtype::F32, &[rows, columns], &self.density),
            ),
        ];
        with_rows!(&self.weights, set => {
            push_rows(&mut tensors, "object", &set.object);
            match &set.shadow {
                Shadow::None => {}
                Shadow::Plane { blocked, cosine } => {
                    push_rows(&mut tensors, "shadow.blocked", blocked);
                    let cosine = Tensor::new(Dtype::F32, &[rows, columns], cosine);
                    tensors.push(("shadow.cosine".to_owned(), cosine));
                }
                Shadow::Mesh { blocked, arriving, share } => {
                    push_rows(&mut tensors, "shadow.blocked", blocked);
                    push_rows(&mut tensors, "shadow.arriving", arriving);
                    let share = Tensor::new(Dtype::F32, &[height, width], share);
                    tensors.push(("shadow.share".to_owned(), share));
                }
            }
            if let Some(sent) = &set.sent {
                push_rows(&mut tensors, "sent", &sent.rows);
                let base = Tensor::vectors(&[height, width, 3], &sent.base);
                tensors.push(("sent.base".to_owned(), base));
            }
        });
        let refuse = |problem: String| RenderError::Transport {
            path: path.to_owned(),
            problem,
        };
        let header = serde_json::to_string(&self.header).map_err(|e| refuse(e.to_string()))?;
        let metadata = HashMap::from([(FORMAT.to_owned(), header)]);
        let views = tensors.iter().map(|(name, tensor)| (name, tensor));
        safetensors::serialize_to_file(views, Some(metadata), path)
            .map_err(|e| refuse(format!("cannot be written: {e}")))
    }

    /// Maps and checks a file that [`save`](Self::save) wrote.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, RenderError> {
        let path = path.as_ref();
        let refuse = |problem: String| RenderError::Transport {
            path: path.to_owned(),
            problem,
        };
        let opened = File::open(path).map_err(|e| refuse(format!("cannot be opened: {e}")))?;
        // SAFETY: the caller was told not to change the file while it is in use.
        let file = unsafe { Mmap::map(&opened) }
            .map_err(|e| refuse(format!("cannot be mapped into memory: {e}")))?;
        read(Arc::new(file)).map_err(refuse)
    }
}

fn push_rows<'a, E: Entry>(tensors: &mut Vec<(String, Tensor<'a>)>, name: &str, rows: &'a Rows<E>) {
    let n = rows.entries.len();
    let mut push = |part: &str, tensor| tensors.push((format!("{name}.{part}"), tensor));
    push(
        "offsets",
        Tensor::new(Dtype::U32, &[rows.offsets.len()], &rows.offsets),
    );
    push(
        "order",
        Tensor::new(Dtype::U16, &[rows.pixels()], &rows.order),
    );
    push(
        "exponents",
        Tensor::new(Dtype::I8, &[rows.pixels()], &rows.exponents),
    );
    push(
        "entries",
        Tensor::new(entry_dtype::<E>(), &[n, E::NUMBERS], &rows.entries),
    );
    push("merged", Tensor::new(Dtype::U8, &[n], &rows.merged));
}

/// An open file.
struct Source<'a> {
    file: &'a Arc<Mmap>,
    tensors: SafeTensors<'a>,
    header: Header,
}

fn read(file: Arc<Mmap>) -> Result<Transport, String> {
    let tensors =
        SafeTensors::deserialize(&file).map_err(|e| format!("is not safetensors: {e}"))?;
    let (_, metadata) =
        SafeTensors::read_metadata(&file).map_err(|e| format!("is not safetensors: {e}"))?;
    let metadata = metadata.metadata().as_ref();
    let header = metadata
        .and_then(|m| m.get(FORMAT))
        .ok_or_else(|| format!("has no metadata \"{FORMAT}\": it is of another kind or version"))?;
    let header: Header =
        serde_json::from_str(header).map_err(|e| format!("has a damaged header: {e}"))?;
    for (what, [width, height]) in [("size", header.size), ("environment", header.environment)] {
        if width == 0 || height == 0 || width.saturating_mul(height) > MOST_PIXELS {
            return Err(format!("has the impossible {what} {width} x {height}"));
        }
    }
    let source = Source {
        file: &file,
        tensors,
        header,
    };
    let weights = match source.header.precision {
        Precision::Half => Weights::Half(source.row_set()?),
        Precision::Single => Weights::Single(source.row_set()?),
    };
    source.transport(weights)
}

impl Source<'_> {
    fn transport(self, weights: Weights) -> Result<Transport, String> {
        let [width, height] = self.header.size;
        let [columns, rows] = self.header.environment;
        let base = self.vectors("base", &[height, width, 3])?;
        let coverage = self.numbers("coverage", &[height, width])?;
        let density = self
            .numbers("environment.density", &[rows, columns])?
            .to_vec();
        Ok(Transport {
            base: Raster::from_pixels(width, height, base),
            coverage: Raster::from_pixels(width, height, coverage.to_vec()),
            density,
            weights,
            header: self.header,
        })
    }

    fn row_set<C: Entry, G: Entry>(&self) -> Result<RowSet<C, G>, String> {
        let [width, height] = self.header.size;
        let [columns, rows] = self.header.environment;
        let shadow = match self.header.shadow {
            ShadowKind::None => Shadow::None,
            ShadowKind::Plane => Shadow::Plane {
                blocked: self.rows("shadow.blocked")?,
                cosine: self.numbers("shadow.cosine", &[rows, columns])?.to_vec(),
            },
            ShadowKind::Mesh => Shadow::Mesh {
                blocked: self.rows("shadow.blocked")?,
                arriving: self.rows("shadow.arriving")?,
                share: self.numbers("shadow.share", &[height, width])?.to_vec(),
            },
        };
        let sent = match self.header.light_on_proxy {
            None => None,
            Some(_) => Some(Sent {
                rows: self.rows("sent")?,
                base: self.vectors("sent.base", &[height, width, 3])?,
            }),
        };
        Ok(RowSet {
            object: self.rows("object")?,
            shadow,
            sent,
        })
    }

    fn rows<E: Entry>(&self, name: &str) -> Result<Rows<E>, String> {
        let [width, height] = self.header.size;
        let pixels = width * height;
        let offsets = self.store::<u32>(&format!("{name}.offsets"), Dtype::U32, &[pixels + 1])?;
        if offsets[0] != 0 || offsets.windows(2).any(|o| o[0] > o[1]) {
            return Err(format!("has decreasing \"{name}.offsets\""));
        }
        let order = self.store::<u16>(&format!("{name}.order"), Dtype::U16, &[pixels])?;
        if !order.par_chunks(BAND).all(has_each_once) {
            return Err(format!("has pixels twice in \"{name}.order\""));
        }
        let n = offsets[pixels] as usize;
        let shape = [n, E::NUMBERS];
        let entries = self.store::<E>(&format!("{name}.entries"), entry_dtype::<E>(), &shape)?;
        let texels = self.header.environment[0] * self.header.environment[1];
        let bad = entries.par_iter().position_first(|e| {
            let weight = e.weight().truncate();
            e.texel() >= texels || !weight.is_finite()
        });
        if let Some(k) = bad {
            let entry = entries[k];
            return Err(format!(
                "has entry {k} of \"{name}\" with weight {} for texel {} of {texels}",
                entry.weight().truncate(),
                entry.texel()
            ));
        }
        let exponents = self.store::<i8>(&format!("{name}.exponents"), Dtype::I8, &[pixels])?;
        // Beyond that the scale is no longer a normal number.
        if let Some(p) = exponents.iter().position(|e| !(-126..=126).contains(e)) {
            return Err(format!(
                "has exponent {} for row {p} of \"{name}\"",
                exponents[p]
            ));
        }
        Ok(Rows {
            exponents,
            merged: self.store(&format!("{name}.merged"), Dtype::U8, &[n])?,
            offsets,
            order,
            entries,
        })
    }

    /// Finite vectors.
    fn vectors(&self, name: &str, shape: &[usize]) -> Result<Vec<Vec3>, String> {
        let numbers = self.numbers(name, shape)?;
        Ok(numbers.chunks_exact(3).map(Vec3::from_slice).collect())
    }

    /// Finite numbers.
    fn numbers(&self, name: &str, shape: &[usize]) -> Result<Store<f32>, String> {
        let numbers = self.store::<f32>(name, Dtype::F32, shape)?;
        match numbers.iter().position(|x| !x.is_finite()) {
            Some(k) => Err(format!("has {} at index {k} of \"{name}\"", numbers[k])),
            None => Ok(numbers),
        }
    }

    /// The values of a tensor, which must have this type and shape.
    fn store<T: Pod>(&self, name: &str, dtype: Dtype, shape: &[usize]) -> Result<Store<T>, String> {
        let tensor = self
            .tensors
            .tensor(name)
            .map_err(|_| format!("has no tensor \"{name}\""))?;
        if tensor.dtype() != dtype || tensor.shape() != shape {
            return Err(format!(
                "has \"{name}\" as {:?} of shape {:?} instead of {dtype:?} of shape {shape:?}",
                tensor.dtype(),
                tensor.shape()
            ));
        }
        let bytes = tensor.data();
        if bytemuck::try_cast_slice::<u8, T>(bytes).is_err() {
            return Err(format!("has \"{name}\" at an address that is not aligned"));
        }
        Ok(Store::Mapped {
            file: self.file.clone(),
            range: range_within(&self.file[..], bytes),
        })
    }
}

/// Whether the numbers are all of those below their count.
fn has_each_once(order: &[u16]) -> bool {
    let mut found = [false; BAND];
    order.iter().all(|&k| {
        let k = usize::from(k);
        k < order.len() && !std::mem::replace(&mut found[k], true)
    })
}

/// Where `part`, a slice of `whole`, lies in it.
fn range_within(whole: &[u8], part: &[u8]) -> Range<usize> {
    let start = part.as_ptr() as usize - whole.as_ptr() as usize;
    start..start + part.len()
}
