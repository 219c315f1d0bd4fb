//! Typed arrays out of a glTF document's buffers: bounds checked once an accessor, then decoded
//! without a branch an element.
use std::borrow::Cow;
use std::cell::OnceCell;

use gltf::json::accessor::{ComponentType, GenericComponentType, IndexComponentType, Type};
use gltf::json::validation::Checked;
use gltf::json::{Accessor, Index, buffer};
use serde::Deserialize;

use super::Limits;
use super::document::{Document, raw_extension};
use super::meshopt;
use crate::error::Error;

const EXPORT: &str = "export the file again";

/// So many zeros are no burden, whatever the file.
const FEW_ZEROS: u64 = 1 << 16;

/// The buffers of a document.
pub(super) struct Buffers<'a> {
    document: &'a Document<'a>,
    /// `None`: not to be had; an error once it is needed.
    bytes: Vec<Option<Cow<'a, [u8]>>>,
    /// The views that are compressed, by index, once they were needed.
    decoded: Vec<OnceCell<Vec<u8>>>,
    /// Most elements that an accessor may have: no honest one has more than three indices or
    /// vertices a triangle.
    max_count: u64,
}

const MESHOPT: &str = "EXT_meshopt_compression";

/// That extension of a buffer view.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Compressed {
    buffer: u32,
    #[serde(default)]
    byte_offset: u64,
    byte_length: u64,
    byte_stride: usize,
    count: u64,
    mode: String,
    filter: Option<String>,
}

/// A checked run of elements: `bytes[i * stride..][..size]` is element `i`.
#[derive(Clone, Copy)]
struct Run<'a> {
    bytes: &'a [u8],
    stride: usize,
    size: usize,
    count: usize,
}

impl<'a> Run<'a> {
    fn elements(self) -> impl Iterator<Item = &'a [u8]> {
        (0..self.count).map(move |i| &self.bytes[i * self.stride..i * self.stride + self.size])
    }
}

impl<'a> Buffers<'a> {
    pub fn new(
        document: &'a Document<'a>,
        bytes: Vec<Option<Cow<'a, [u8]>>>,
        limits: &Limits,
    ) -> Self {
        Self {
            document,
            bytes,
            decoded: vec![OnceCell::new(); document.buffer_views.len()],
            max_count: limits.vertices(),
        }
    }

    /// The accessor that `place` refers to.
    pub fn accessor(&self, index: Index<Accessor>, place: &str) -> Result<&'a Accessor, Error> {
        get(&self.document.accessors, index.value(), place, "accessors")
    }

    /// All bytes of a buffer view, and its stride.
    pub fn view(
        &self,
        index: Index<buffer::View>,
        place: &str,
    ) -> Result<(&[u8], Option<usize>), Error> {
        let views = &self.document.buffer_views;
        let view = get(views, index.value(), place, "buffer views")?;
        let at = format!("bufferViews[{index}]");
        // Some exporters write 0 for "one behind the other".
        let stride = view.byte_stride.map(|stride| stride.0);
        let stride = stride.filter(|bytes| *bytes != 0);
        let extension = match &view.extensions {
            Some(e) => raw_extension::<Compressed>(&e.others, MESHOPT, &at)?,
            None => None,
        };
        let Some(compressed) = extension else {
            let owner = view.buffer.value();
            let (offset, length) = (view.byte_offset.unwrap_or_default().0, view.byte_length.0);
            return Ok((self.part(owner, offset, length, &at)?, stride));
        };
        let cell = &self.decoded[index.value()];
        if cell.get().is_none() {
            // Nobody else can have set it in the meantime.
            let _ = cell.set(self.decompress(&compressed, &at)?);
        }
        let bytes = cell.get().map_or(&[][..], Vec::as_slice);
        let attributes = compressed.mode == "ATTRIBUTES";
        Ok((
            bytes,
            stride.or(attributes.then_some(compressed.byte_stride)),
        ))
    }

    /// A range of a buffer; `at` is who wants it.
    fn part(&self, owner: usize, offset: u64, length: u64, at: &str) -> Result<&[u8], Error> {
        let buffers = &self.document.buffers;
        get(buffers, owner, &format!("{at}.buffer"), "buffers")?;
        let buffer = self.bytes[owner].as_deref().ok_or_else(|| {
            Error::malformed(format!("buffers[{owner}] has no data in the file"), EXPORT)
        })?;
        let end = offset.checked_add(length);
        end.and_then(|end| buffer.get(offset as usize..usize::try_from(end).ok()?))
            .ok_or_else(|| {
                Error::malformed(
                    format!(
                        "{at} wants {length} bytes from byte {offset}, but buffers[{owner}] has {}",
                        buffer.len()
                    ),
                    EXPORT,
                )
            })
    }

    fn decompress(&self, view: &Compressed, at: &str) -> Result<Vec<u8>, Error> {
        let at = format!("{at}.extensions.{MESHOPT}");
        self.bounded(view.count, &at)?;
        let stream = meshopt::Stream {
            bytes: self.part(
                view.buffer as usize,
                view.byte_offset,
                view.byte_length,
                &at,
            )?,
            mode: &view.mode,
            filter: view.filter.as_deref().unwrap_or("NONE"),
            count: view.count as usize,
            stride: view.byte_stride,
        };
        meshopt::decode(&stream)
            .map_err(|what| Error::malformed(format!("{at} has {what}"), EXPORT))
    }

    fn run(
        &self,
        view: Index<buffer::View>,
        view_place: &str,
        offset: u64,
        size: usize,
        count: u64,
        what: &str,
    ) -> Result<Run<'_>, Error> {
        let (bytes, stride) = self.view(view, view_place)?;
        let stride = stride.unwrap_or(size);
        if stride < size {
            return Err(Error::malformed(
                format!(
                    "bufferViews[{view}].byteStride is {stride}, but an element of {what} has {size} bytes"
                ),
                EXPORT,
            ));
        }
        let needed = count
            .saturating_sub(1)
            .checked_mul(stride as u64)
            .and_then(|n| n.checked_add(offset))
            .and_then(|n| n.checked_add(if count == 0 { 0 } else { size as u64 }));
        match needed {
            Some(needed) if needed <= bytes.len() as u64 => Ok(Run {
                bytes: &bytes[offset as usize..],
                stride,
                size,
                count: count as usize,
            }),
            _ => Err(Error::malformed(
                format!(
                    "{what} reads {count} elements of {size} bytes every {stride} bytes from byte {offset}, but bufferViews[{view}] has {} bytes",
                    bytes.len()
                ),
                EXPORT,
            )),
        }
    }

    fn component(&self, index: Index<Accessor>) -> Result<ComponentType, Error> {
        match self.document.accessors[index.value()].component_type {
            Checked::Valid(GenericComponentType(component)) => Ok(component),
            Checked::Invalid => Err(Error::malformed(
                format!(
                    "accessors[{index}].componentType is {}; accepted: 5120 to 5123, 5125, 5126",
                    self.document
                        .quoted(&format!("/accessors/{index}/componentType"))
                ),
                EXPORT,
            )),
        }
    }

    /// Components of an element.
    pub fn components(&self, index: Index<Accessor>) -> Result<usize, Error> {
        match self.document.accessors[index.value()].type_ {
            // Columns of smaller matrices are padded, and nothing that is read has such elements.
            Checked::Valid(Type::Mat2 | Type::Mat3) | Checked::Invalid => Err(Error::malformed(
                format!(
                    "accessors[{index}].type is {}; accepted: SCALAR, VEC2, VEC3, VEC4, MAT4",
                    self.document.quoted(&format!("/accessors/{index}/type"))
                ),
                EXPORT,
            )),
            Checked::Valid(kind) => Ok(kind.multiplicity()),
        }
    }

    fn bounded(&self, count: u64, what: &str) -> Result<(), Error> {
        if count > self.max_count {
            return Err(Error::TooLarge {
                what: format!("{what} has {count} elements"),
                key: "scene.limits.triangles, of which a triangle has three",
                limit: self.max_count,
            });
        }
        Ok(())
    }

    /// Refuses zeros without bytes behind them, unless there are no more than a few or than the file
    /// has bytes: a file of a kilobyte shall not take gigabytes.
    fn bounded_zeros(&self, count: u64, what: &str) -> Result<(), Error> {
        let lengths = self.bytes.iter().flatten().map(|b| b.len() as u64);
        let bytes: u64 = lengths.sum();
        if count <= bytes.max(FEW_ZEROS) {
            return Ok(());
        }
        Err(Error::malformed(
            format!(
                "{what} has {count} elements but no bufferView, and the file only {bytes} bytes"
            ),
            EXPORT,
        ))
    }

    /// Every element as `N` floats through `map`. Integers become `[0, 1]` or `[-1, 1]` where the
    /// accessor (or `normalize`) says so, else the float of the same value (`KHR_mesh_quantization`).
    pub fn floats<const N: usize, T>(
        &self,
        index: Index<Accessor>,
        place: &str,
        normalize: bool,
        map: impl Fn([f32; N]) -> T,
    ) -> Result<Vec<T>, Error> {
        let accessor = self.accessor(index, place)?;
        let what = format!("accessors[{index}]");
        let components = self.components(index)?;
        if components != N {
            return Err(Error::malformed(
                format!(
                    "{place} refers to {what}, which has {components} components instead of {N}"
                ),
                EXPORT,
            ));
        }
        self.bounded(accessor.count.0, &what)?;
        let component = self.component(index)?;
        let normalize = normalize || accessor.normalized;
        let size = component.size() * N;
        let mut out = match accessor.buffer_view {
            Some(view) => decode(
                self.run(
                    view,
                    &format!("{what}.bufferView"),
                    accessor.byte_offset.unwrap_or_default().0,
                    size,
                    accessor.count.0,
                    &what,
                )?,
                component,
                normalize,
                &map,
            ),
            None => {
                self.bounded_zeros(accessor.count.0, &what)?;
                (0..accessor.count.0).map(|_| map([0.0; N])).collect()
            }
        };
        if let Some(sparse) = &accessor.sparse {
            let targets = self.sparse_targets(index, accessor)?;
            let values = self.run(
                sparse.values.buffer_view,
                &format!("{what}.sparse.values.bufferView"),
                sparse.values.byte_offset.0,
                size,
                sparse.count.0,
                &format!("{what}.sparse.values"),
            )?;
            for (target, value) in targets
                .into_iter()
                .zip(decode(values, component, normalize, &map))
            {
                out[target as usize] = value;
            }
        }
        Ok(out)
    }

    /// Which elements a sparse accessor replaces, all in range.
    fn sparse_targets(
        &self,
        index: Index<Accessor>,
        accessor: &Accessor,
    ) -> Result<Vec<u32>, Error> {
        let Some(sparse) = &accessor.sparse else {
            return Ok(Vec::new());
        };
        let at = format!("accessors[{index}].sparse.indices");
        self.bounded(sparse.count.0, &at)?;
        let Checked::Valid(IndexComponentType(component)) = sparse.indices.component_type else {
            let pointer = format!("/accessors/{index}/sparse/indices/componentType");
            return Err(Error::malformed(
                format!(
                    "{at}.componentType is {}; accepted: 5121, 5123, 5125",
                    self.document.quoted(&pointer)
                ),
                EXPORT,
            ));
        };
        let run = self.run(
            sparse.indices.buffer_view,
            &format!("{at}.bufferView"),
            sparse.indices.byte_offset.0,
            component.size(),
            sparse.count.0,
            &at,
        )?;
        let targets = decode_unsigned(run, component, &at)?;
        match targets.iter().find(|t| u64::from(**t) >= accessor.count.0) {
            Some(bad) => Err(Error::Dangling {
                place: at,
                index: u64::from(*bad),
                count: accessor.count.0,
                things: "elements to replace",
            }),
            None => Ok(targets),
        }
    }

    /// Unsigned integers, for indices and joints of one component.
    pub fn unsigned(&self, index: Index<Accessor>, place: &str) -> Result<Vec<u32>, Error> {
        let accessor = self.accessor(index, place)?;
        let what = format!("accessors[{index}]");
        if accessor.type_ != Checked::Valid(Type::Scalar) {
            return Err(Error::malformed(
                format!(
                    "{place} refers to {what}, which is {}; accepted: SCALAR",
                    self.document.quoted(&format!("/accessors/{index}/type"))
                ),
                EXPORT,
            ));
        }
        self.bounded(accessor.count.0, &what)?;
        let component = self.component(index)?;
        let mut out = match accessor.buffer_view {
            Some(view) => {
                let run = self.run(
                    view,
                    &format!("{what}.bufferView"),
                    accessor.byte_offset.unwrap_or_default().0,
                    component.size(),
                    accessor.count.0,
                    &what,
                )?;
                decode_unsigned(run, component, &what)?
            }
            None => {
                self.bounded_zeros(accessor.count.0, &what)?;
                vec![0; accessor.count.0 as usize]
            }
        };
        if let Some(sparse) = &accessor.sparse {
            let targets = self.sparse_targets(index, accessor)?;
            let at = format!("{what}.sparse.values");
            let run = self.run(
                sparse.values.buffer_view,
                &format!("{at}.bufferView"),
                sparse.values.byte_offset.0,
                component.size(),
                sparse.count.0,
                &at,
            )?;
            for (target, value) in targets
                .into_iter()
                .zip(decode_unsigned(run, component, &at)?)
            {
                out[target as usize] = value;
            }
        }
        Ok(out)
    }
}

/// `list[index]`, or an error that says where the index stands.
pub(super) fn get<'a, T>(
    list: &'a [T],
    index: usize,
    place: &str,
    things: &'static str,
) -> Result<&'a T, Error> {
    list.get(index).ok_or_else(|| Error::Dangling {
        place: place.to_owned(),
        index: index as u64,
        count: list.len() as u64,
        things,
    })
}

fn decode<const N: usize, T>(
    run: Run,
    component: ComponentType,
    normalize: bool,
    map: impl Fn([f32; N]) -> T,
) -> Vec<T> {
    fn each<const N: usize, const S: usize, T>(
        run: Run,
        map: impl Fn([f32; N]) -> T,
        float: impl Fn([u8; S]) -> f32,
    ) -> Vec<T> {
        run.elements()
            .map(|element| {
                map(std::array::from_fn(|k| {
                    float(std::array::from_fn(|b| element[k * S + b]))
                }))
            })
            .collect()
    }
    // glTF 2.0, 3.6.2.2: the most negative integers clamp to -1.
    let floor = if normalize { -1.0 } else { f32::NEG_INFINITY };
    match component {
        ComponentType::F32 => each(run, map, f32::from_le_bytes),
        ComponentType::U8 => {
            let k = if normalize { 255.0 } else { 1.0 };
            each(run, map, |[b]: [u8; 1]| f32::from(b) / k)
        }
        ComponentType::U16 => {
            let k = if normalize { 65535.0 } else { 1.0 };
            each(run, map, |b| f32::from(u16::from_le_bytes(b)) / k)
        }
        ComponentType::I8 => {
            let k = if normalize { 127.0 } else { 1.0 };
            each(run, map, |[b]: [u8; 1]| (f32::from(b as i8) / k).max(floor))
        }
        ComponentType::I16 => {
            let k = if normalize { 32767.0 } else { 1.0 };
            each(run, map, |b| {
                (f32::from(i16::from_le_bytes(b)) / k).max(floor)
            })
        }
        ComponentType::U32 => each(run, map, |b| u32::from_le_bytes(b) as f32),
    }
}

fn decode_unsigned(run: Run, component: ComponentType, what: &str) -> Result<Vec<u32>, Error> {
    Ok(match component {
        ComponentType::U8 => run.elements().map(|e| u32::from(e[0])).collect(),
        ComponentType::U16 => run
            .elements()
            .map(|e| u32::from(u16::from_le_bytes([e[0], e[1]])))
            .collect(),
        ComponentType::U32 => run
            .elements()
            .map(|e| u32::from_le_bytes([e[0], e[1], e[2], e[3]]))
            .collect(),
        _ => {
            return Err(Error::malformed(
                format!("{what} holds signed or fractional indices; accepted: unsigned integers"),
                EXPORT,
            ));
        }
    })
}
