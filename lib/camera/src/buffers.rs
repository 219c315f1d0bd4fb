//! Numbers in the buffers of a glTF file.
use std::borrow::Cow;
use std::cell::OnceCell;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use glam::DVec4;
use percent_encoding::percent_decode_str;
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
            let bytes = from_base64(text).map(Cow::Owned);
            return bytes.ok_or_else(|| wrong("is no valid base64"));
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

/// The file that a relative address names, if a document in `folder` may name it: one there or below, or by `..` a buffer.
fn beside(folder: &Path, uri: &str) -> Option<PathBuf> {
    let path = percent_decode_str(uri).decode_utf8().ok()?;
    let path = Path::new(&*path);
    let found = folder.join(path);
    // A path with a root is one of the machine that wrote it.
    if path.has_root() || path.file_name().is_none() {
        return None;
    }
    let whole = [&found, &folder.join(".")].map(|path| path.canonicalize().ok());
    let is_outside = matches!(&whole, [Some(file), Some(folder)] if !file.starts_with(folder));
    // One that is missing is told where it is read.
    (!is_outside || is_buffer(&found)).then_some(found)
}

/// The bytes of base64, of either alphabet, padded or not; `None` of anything else.
pub fn from_base64(text: &str) -> Option<Vec<u8>> {
    let lenient = GeneralPurposeConfig::new()
        .with_decode_padding_mode(DecodePaddingMode::Indifferent)
        .with_decode_allow_trailing_bits(true);
    let text = text.trim_end_matches('=');
    let text = text.replace('-', "+").replace('_', "/");
    GeneralPurpose::new(&STANDARD, lenient).decode(text).ok()
}

/// Whether a file is called as a glTF's buffers are, links followed. It may lie anywhere that a relative path leads to: it can
/// be nothing else, and only its numbers are used.
pub fn is_buffer(file: &Path) -> bool {
    // The name is that of the file itself.
    let found = file.canonicalize();
    let extension = found.as_deref().ok().and_then(Path::extension);
    extension.is_some_and(|e| {
        ["bin", "glbin", "glbuf"]
            .iter()
            .any(|own| e.eq_ignore_ascii_case(own))
    })
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
    fn buffers_lie_in_the_folder_or_below_or_are_called_so_elsewhere() {
        let all = tempfile::tempdir().unwrap();
        let folder = all.path().join("a");
        std::fs::create_dir_all(folder.join("b")).unwrap();
        for name in ["keys.bin", "secret", "a/b/keys"] {
            std::fs::write(all.path().join(name), "").unwrap();
        }
        let of = |uri| beside(&folder, uri);
        for (uri, file) in [
            ("my%20scene.bin", "my scene.bin"),
            ("./100%.bin", "100%.bin"),
            ("b/keys", "b/keys"),
            ("gone/keys.bin", "gone/keys.bin"),
            ("%2e%2e/keys.bin", "../keys.bin"),
            ("../a/b/keys", "../a/b/keys"),
        ] {
            assert_eq!(of(uri), Some(folder.join(file)), "{uri}");
        }
        let absolute = folder.join("b/keys");
        for outside in [
            "../secret",
            "b/../../secret",
            absolute.to_str().unwrap(),
            "%ff",
            "..",
            "",
        ] {
            assert_eq!(of(outside), None, "{outside}");
        }
    }

    #[test]
    fn base64_of_either_alphabet_is_decoded_with_padding_or_without() {
        // RFC 4648, 10; the bits behind the last byte may be anything.
        let whole: [(&str, &[u8]); 8] = [
            ("", b""),
            ("Zg==", b"f"),
            ("Zg", b"f"),
            ("Zh", b"f"),
            ("Zm8=", b"fo"),
            ("Zm9vYmFy", b"foobar"),
            ("+/8=", b"\xfb\xff"),
            ("-_8", b"\xfb\xff"),
        ];
        for (text, bytes) in whole {
            assert_eq!(from_base64(text).as_deref(), Some(bytes), "{text}");
        }
        for text in ["Z", "Zm9v!", "Zm 9v", "Zg==Zg=="] {
            assert_eq!(from_base64(text), None, "{text}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn the_name_of_a_buffer_is_that_of_the_file_and_not_of_a_link() {
        let all = tempfile::tempdir().unwrap();
        let folder = all.path().join("a");
        std::fs::create_dir(&folder).unwrap();
        std::fs::write(all.path().join("secret"), "").unwrap();
        std::os::unix::fs::symlink("../secret", folder.join("keys.bin")).unwrap();
        assert_eq!(beside(&folder, "keys.bin"), None);
        assert_eq!(beside(&folder, "../a/keys.bin"), None);
    }
}
