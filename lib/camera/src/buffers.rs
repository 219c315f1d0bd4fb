//! Numbers in the buffers of a glTF file.
use std::borrow::Cow;
use std::cell::OnceCell;
use std::path::{Component, Path, PathBuf};

use base64::Engine;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use glam::DVec4;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::error::CameraError;
use crate::gltf::{FORMAT, File};

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    #[serde(rename = "type")]
    kind: String,
    #[serde(default)]
    sparse: Value,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
    #[serde(default)]
    extensions: Value,
}

#[derive(Deserialize)]
struct Buffer {
    uri: Option<String>,
}

/// The buffers of a file, each read when it is needed first.
pub(crate) struct Buffers<'a> {
    file: &'a File<'a>,
    /// Where other files of it are.
    folder: Option<&'a Path>,
    bytes: Vec<OnceCell<Cow<'a, [u8]>>>,
}

impl<'a> Buffers<'a> {
    pub fn new(file: &'a File<'a>, folder: Option<&'a Path>) -> Self {
        Self {
            file,
            folder,
            bytes: vec![OnceCell::new(); file.document.buffers.len()],
        }
    }

    /// How many elements an accessor says it has.
    pub fn count(&self, index: usize) -> Result<usize, CameraError> {
        let accessor: Accessor = item(&self.file.document.accessors, index, "accessor")?;
        Ok(accessor.count)
    }

    /// The elements of an accessor of this kind, `SCALAR`, `VEC3` or `VEC4`; integers become `[0, 1]` or `[-1, 1]`
    /// where it says so.
    pub fn vectors(&self, index: usize, kind: &str) -> Result<Vec<DVec4>, CameraError> {
        let wrong = |what: String| CameraError::new(FORMAT, format!("its accessor {index} {what}"));
        let accessor: Accessor = item(&self.file.document.accessors, index, "accessor")?;
        let own = &accessor.kind;
        if own != kind {
            return Err(wrong(format!("is of {own:?}, where keys have {kind:?}")));
        }
        let Some(view) = accessor.buffer_view.filter(|_| accessor.sparse.is_null()) else {
            return Err(wrong("is sparse, which keys of a camera are not".into()));
        };
        let width = match kind {
            "SCALAR" => 1,
            "VEC3" => 3,
            _ => 4,
        };
        let (bytes, read) =
            component(accessor.component_type, accessor.normalized).ok_or_else(|| {
                wrong(format!(
                    "has components of kind {}",
                    accessor.component_type
                ))
            })?;
        let view: View = item(&self.file.document.buffer_views, view, "buffer view")?;
        let is_packed = |name: &str| view.extensions.get(name).is_some();
        if is_packed("EXT_meshopt_compression") || is_packed("KHR_meshopt_compression") {
            return Err(CameraError::with_remedy(
                FORMAT,
                "the keys of its animation are compressed (meshopt), which is not read",
                "export it without compression",
            ));
        }
        let stride = view.byte_stride.filter(|n| *n > 0).unwrap_or(bytes * width);
        let beyond = || wrong("reads beyond its buffer".into());
        let whole = self.buffer(view.buffer)?.get(view.byte_offset..);
        let own = whole.and_then(|b| b.get(..view.byte_length)?.get(accessor.byte_offset..));
        let own = own.ok_or_else(beyond)?;
        let needed = match accessor.count {
            0 => Some(0),
            n => (n - 1)
                .checked_mul(stride)
                .and_then(|n| n.checked_add(bytes * width)),
        };
        needed.filter(|n| *n <= own.len()).ok_or_else(beyond)?;
        let element = |i: usize| {
            let mut vector = DVec4::ZERO;
            for k in 0..width {
                vector[k] = read(&own[i * stride + k * bytes..]);
            }
            vector
        };
        Ok((0..accessor.count).map(element).collect())
    }

    fn buffer(&self, index: usize) -> Result<&[u8], CameraError> {
        let buffer: Buffer = item(&self.file.document.buffers, index, "buffer")?;
        let cell = &self.bytes[index];
        if cell.get().is_none() {
            // Nobody else can have set it in the meantime.
            let _ = cell.set(self.loaded(index, buffer.uri.as_deref())?);
        }
        Ok(cell.get().map_or(&[][..], |bytes| bytes))
    }

    fn loaded(&self, index: usize, uri: Option<&str>) -> Result<Cow<'a, [u8]>, CameraError> {
        let wrong = |what: &str| {
            let remedy = "export it as one file (.glb; in Blender: Format, glTF Binary)";
            CameraError::with_remedy(FORMAT, format!("its buffer {index} {what}"), remedy)
        };
        let Some(uri) = uri else {
            let own = self.file.binary.filter(|_| index == 0);
            return own.map(Cow::Borrowed).ok_or_else(|| wrong("has no data"));
        };
        if let Some(data) = uri.strip_prefix("data:") {
            let text = data.split_once(";base64,").map_or("", |split| split.1);
            let lenient = GeneralPurposeConfig::new()
                .with_decode_padding_mode(DecodePaddingMode::Indifferent);
            let bytes = GeneralPurpose::new(&STANDARD, lenient).decode(text);
            return bytes
                .map(Cow::Owned)
                .map_err(|_| wrong("is no valid base64"));
        }
        let path = self.folder.and_then(|folder| beside(folder, uri));
        let path = path.ok_or_else(|| {
            let what = "is in a file of another folder: ";
            wrong(&format!("{what}{uri:?}"))
        })?;
        let bytes = dipir_files::read(&path);
        let bytes = bytes.map_err(|source| CameraError::Read { path, source })?;
        Ok(Cow::Owned(bytes))
    }
}

/// The files that have the buffers of the glTF file at `path`, if it has animations, which may be a camera's.
pub(crate) fn files(path: &Path) -> Vec<PathBuf> {
    let bytes = dipir_files::read(path).unwrap_or_default();
    let file = File::parse(&bytes).ok();
    let document = file.map(|file| file.document);
    let moving = document.filter(|document| !document.animations.is_empty());
    let folder = path.parent().unwrap_or(Path::new(""));
    let uris = moving
        .iter()
        .flat_map(|d| &d.buffers)
        .filter_map(|b| b["uri"].as_str());
    let uris = uris.filter(|uri| !uri.starts_with("data:"));
    let files = uris.filter_map(|uri| beside(folder, uri));
    // A file that nothing needs may be missing.
    files.filter(|path| path.is_file()).collect()
}

/// The file that a relative address names in `folder` itself.
fn beside(folder: &Path, uri: &str) -> Option<PathBuf> {
    let mut bytes = Vec::new();
    let mut rest = uri.as_bytes();
    while let [first, after @ ..] = rest {
        let code = after.get(..2).and_then(|hex| std::str::from_utf8(hex).ok());
        let code = code.and_then(|hex| u8::from_str_radix(hex, 16).ok());
        let escaped = code.filter(|_| *first == b'%');
        bytes.push(escaped.unwrap_or(*first));
        rest = &after[if escaped.is_some() { 2 } else { 0 }..];
    }
    let path = PathBuf::from(String::from_utf8(bytes).ok()?);
    let mut names = path.components().filter(|c| *c != Component::CurDir);
    match (names.next(), names.next()) {
        (Some(Component::Normal(name)), None) => Some(folder.join(name)),
        _ => None,
    }
}

/// Entry `index` of a list of the document.
fn item<T: DeserializeOwned>(list: &[Value], index: usize, what: &str) -> Result<T, CameraError> {
    let wrong = |why: String| CameraError::new(FORMAT, format!("its {what} {index} {why}"));
    let value = list.get(index).ok_or_else(|| wrong("is missing".into()))?;
    T::deserialize(value).map_err(|e| wrong(format!("cannot be read: {e}")))
}

/// How many bytes a component of this kind has, and its value.
fn component(kind: u32, is_normalized: bool) -> Option<(usize, impl Fn(&[u8]) -> f64)> {
    let size = match kind {
        5120 | 5121 => 1,
        5122 | 5123 => 2,
        5126 => 4,
        _ => return None,
    };
    let read = move |bytes: &[u8]| {
        let (value, most) = match (kind, bytes) {
            (5120, [a, ..]) => (f64::from(*a as i8), 127.0),
            (5121, [a, ..]) => (f64::from(*a), 255.0),
            (5122, [a, b, ..]) => (f64::from(i16::from_le_bytes([*a, *b])), 32767.0),
            (5123, [a, b, ..]) => (f64::from(u16::from_le_bytes([*a, *b])), 65535.0),
            (_, [a, b, c, d, ..]) => return f64::from(f32::from_le_bytes([*a, *b, *c, *d])),
            _ => return f64::NAN,
        };
        match is_normalized {
            true => (value / most).max(-1.0),
            false => value,
        }
    };
    Some((size, read))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers_are_read_as_gltf_normalizes_them() {
        let of =
            |kind, is_normalized, bytes: &[u8]| component(kind, is_normalized).unwrap().1(bytes);
        assert_eq!(of(5120, true, &[0x81]), -1.0);
        assert_eq!(of(5120, true, &[0x80]), -1.0);
        assert_eq!(of(5121, true, &[51]), 0.2);
        assert_eq!(of(5122, true, &32767i16.to_le_bytes()), 1.0);
        assert_eq!(of(5122, false, &(-3i16).to_le_bytes()), -3.0);
        assert_eq!(of(5123, true, &13107u16.to_le_bytes()), 0.2);
        assert_eq!(of(5126, true, &2.5f32.to_le_bytes()), 2.5);
        assert!(component(5125, false).is_none());
    }

    #[test]
    fn buffers_are_files_of_the_same_folder() {
        let of = |uri| beside(Path::new("a"), uri);
        assert_eq!(of("my%20scene.bin"), Some("a/my scene.bin".into()));
        assert_eq!(of("./100%.bin"), Some("a/100%.bin".into()));
        for outside in ["../b.bin", "/b.bin", "b/c.bin", "%2e%2e/b.bin", "%ff", ""] {
            assert_eq!(of(outside), None, "{outside}");
        }
    }
}
