//! Typed arrays out of a glTF document's buffers: bounds checked once an accessor, then decoded
//! without a branch an element.
use std::borrow::Cow;

use super::document::{Accessor, Document};
use crate::error::Error;

const EXPORT: &str = "export the file again";

/// The buffers of a document.
pub(super) struct Buffers<'a> {
    document: &'a Document,
    /// `None`: not to be had; an error once it is needed.
    bytes: Vec<Option<Cow<'a, [u8]>>>,
    /// Most elements that an accessor may have.
    max_count: u64,
}

/// What the components of an accessor are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Component {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

impl Component {
    fn of(code: u32) -> Option<Self> {
        Some(match code {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5125 => Self::U32,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::U32 | Self::F32 => 4,
        }
    }
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
    pub fn new(document: &'a Document, bytes: Vec<Option<Cow<'a, [u8]>>>, max_count: u64) -> Self {
        Self {
            document,
            bytes,
            max_count,
        }
    }

    /// The accessor that `place` refers to.
    pub fn accessor(&self, index: usize, place: &str) -> Result<&'a Accessor, Error> {
        get(&self.document.accessors, index, place, "accessors")
    }

    /// All bytes of a buffer view, and its stride.
    pub fn view(&self, index: usize, place: &str) -> Result<(&[u8], Option<u64>), Error> {
        let view = get(&self.document.buffer_views, index, place, "buffer views")?;
        let at = format!("bufferViews[{index}]");
        get(
            &self.document.buffers,
            view.buffer,
            &format!("{at}.buffer"),
            "buffers",
        )?;
        let buffer = self.bytes[view.buffer].as_deref().ok_or_else(|| {
            Error::malformed(
                format!("buffers[{}] has no data in the file", view.buffer),
                EXPORT,
            )
        })?;
        let end = view.byte_offset.checked_add(view.byte_length);
        end.and_then(|end| buffer.get(view.byte_offset as usize..usize::try_from(end).ok()?))
            .map(|bytes| (bytes, view.byte_stride))
            .ok_or_else(|| {
                Error::malformed(
                    format!(
                        "{at} wants {} bytes from byte {}, but buffers[{}] has {}",
                        view.byte_length,
                        view.byte_offset,
                        view.buffer,
                        buffer.len()
                    ),
                    EXPORT,
                )
            })
    }

    fn run(
        &self,
        view: usize,
        view_place: &str,
        offset: u64,
        size: usize,
        count: u64,
        what: &str,
    ) -> Result<Run<'_>, Error> {
        let (bytes, stride) = self.view(view, view_place)?;
        let stride = stride.unwrap_or(size as u64);
        if stride < size as u64 {
            return Err(Error::malformed(
                format!(
                    "bufferViews[{view}].byteStride is {stride}, but an element of {what} has {size} bytes"
                ),
                EXPORT,
            ));
        }
        let needed = count
            .saturating_sub(1)
            .checked_mul(stride)
            .and_then(|n| n.checked_add(offset))
            .and_then(|n| n.checked_add(if count == 0 { 0 } else { size as u64 }));
        match needed {
            Some(needed) if needed <= bytes.len() as u64 => Ok(Run {
                bytes: &bytes[offset as usize..],
                stride: stride as usize,
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

    fn component(code: u32, what: &str) -> Result<Component, Error> {
        Component::of(code).ok_or_else(|| {
            Error::malformed(
                format!("{what}.componentType is {code}; accepted: 5120 to 5123, 5125, 5126"),
                EXPORT,
            )
        })
    }

    fn bounded(&self, count: u64, what: &str) -> Result<(), Error> {
        if count > self.max_count {
            return Err(Error::TooLarge {
                what: format!("{what} has {count} elements"),
                limit: self.max_count,
            });
        }
        Ok(())
    }

    /// Every element as `N` floats through `map`. Integers become `[0, 1]` or `[-1, 1]` where the
    /// accessor (or `normalize`) says so, else the float of the same value (`KHR_mesh_quantization`).
    pub fn floats<const N: usize, T>(
        &self,
        index: usize,
        place: &str,
        normalize: bool,
        map: impl Fn([f32; N]) -> T,
    ) -> Result<Vec<T>, Error> {
        let accessor = self.accessor(index, place)?;
        let what = format!("accessors[{index}]");
        let components = components_of(&accessor.kind, &what)?;
        if components != N {
            return Err(Error::malformed(
                format!(
                    "{place} refers to {what}, which has {components} components instead of {N}"
                ),
                EXPORT,
            ));
        }
        self.bounded(accessor.count, &what)?;
        let component = Self::component(accessor.component_type, &what)?;
        let normalize = normalize || accessor.normalized;
        let size = component.size() * N;
        let mut out = match accessor.buffer_view {
            Some(view) => decode(
                self.run(
                    view,
                    &format!("{what}.bufferView"),
                    accessor.byte_offset,
                    size,
                    accessor.count,
                    &what,
                )?,
                component,
                normalize,
                &map,
            ),
            None => (0..accessor.count).map(|_| map([0.0; N])).collect(),
        };
        if let Some(sparse) = &accessor.sparse {
            let targets = self.sparse_targets(accessor, &what)?;
            let values = self.run(
                sparse.values.buffer_view,
                &format!("{what}.sparse.values.bufferView"),
                sparse.values.byte_offset,
                size,
                sparse.count,
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
    fn sparse_targets(&self, accessor: &Accessor, what: &str) -> Result<Vec<u32>, Error> {
        let Some(sparse) = &accessor.sparse else {
            return Ok(Vec::new());
        };
        let at = format!("{what}.sparse.indices");
        self.bounded(sparse.count, &at)?;
        let component = Self::component(sparse.indices.component_type, &at)?;
        let run = self.run(
            sparse.indices.buffer_view,
            &format!("{at}.bufferView"),
            sparse.indices.byte_offset,
            component.size(),
            sparse.count,
            &at,
        )?;
        let targets = decode_unsigned(run, component, &at)?;
        match targets.iter().find(|t| u64::from(**t) >= accessor.count) {
            Some(bad) => Err(Error::Dangling {
                place: at,
                index: u64::from(*bad),
                count: accessor.count,
                things: "elements to replace",
            }),
            None => Ok(targets),
        }
    }

    /// Unsigned integers, for indices and joints of one component.
    pub fn unsigned(&self, index: usize, place: &str) -> Result<Vec<u32>, Error> {
        let accessor = self.accessor(index, place)?;
        let what = format!("accessors[{index}]");
        if accessor.kind != "SCALAR" {
            return Err(Error::malformed(
                format!(
                    "{place} refers to {what}, which is {}; accepted: SCALAR",
                    accessor.kind
                ),
                EXPORT,
            ));
        }
        self.bounded(accessor.count, &what)?;
        let component = Self::component(accessor.component_type, &what)?;
        let mut out = match accessor.buffer_view {
            Some(view) => {
                let run = self.run(
                    view,
                    &format!("{what}.bufferView"),
                    accessor.byte_offset,
                    component.size(),
                    accessor.count,
                    &what,
                )?;
                decode_unsigned(run, component, &what)?
            }
            None => vec![0; accessor.count as usize],
        };
        if let Some(sparse) = &accessor.sparse {
            let targets = self.sparse_targets(accessor, &what)?;
            let at = format!("{what}.sparse.values");
            let run = self.run(
                sparse.values.buffer_view,
                &format!("{at}.bufferView"),
                sparse.values.byte_offset,
                component.size(),
                sparse.count,
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

/// Components of an element.
pub(super) fn components_of(kind: &str, what: &str) -> Result<usize, Error> {
    Ok(match kind {
        "SCALAR" => 1,
        "VEC2" => 2,
        "VEC3" => 3,
        "VEC4" => 4,
        "MAT4" => 16,
        other => {
            return Err(Error::malformed(
                format!("{what}.type is \"{other}\"; accepted: SCALAR, VEC2, VEC3, VEC4, MAT4"),
                EXPORT,
            ));
        }
    })
}

fn decode<const N: usize, T>(
    run: Run,
    component: Component,
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
        Component::F32 => each(run, map, f32::from_le_bytes),
        Component::U8 => {
            let k = if normalize { 255.0 } else { 1.0 };
            each(run, map, |[b]: [u8; 1]| f32::from(b) / k)
        }
        Component::U16 => {
            let k = if normalize { 65535.0 } else { 1.0 };
            each(run, map, |b| f32::from(u16::from_le_bytes(b)) / k)
        }
        Component::I8 => {
            let k = if normalize { 127.0 } else { 1.0 };
            each(run, map, |[b]: [u8; 1]| (f32::from(b as i8) / k).max(floor))
        }
        Component::I16 => {
            let k = if normalize { 32767.0 } else { 1.0 };
            each(run, map, |b| {
                (f32::from(i16::from_le_bytes(b)) / k).max(floor)
            })
        }
        Component::U32 => each(run, map, |b| u32::from_le_bytes(b) as f32),
    }
}

fn decode_unsigned(run: Run, component: Component, what: &str) -> Result<Vec<u32>, Error> {
    Ok(match component {
        Component::U8 => run.elements().map(|e| u32::from(e[0])).collect(),
        Component::U16 => run
            .elements()
            .map(|e| u32::from(u16::from_le_bytes([e[0], e[1]])))
            .collect(),
        Component::U32 => run
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
