//! The GLB container, data URIs, and where files that a document names are found.
use std::borrow::Cow;
use std::cell::RefCell;
use std::io;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use crate::error::Error;
use crate::limits::Limits;
use crate::printable::printable;
use crate::texture::ImageSource;

/// Finds the files that a document refers to.
pub trait Resolver {
    /// The contents of the file that the percent-encoded relative `uri` names.
    fn read(&self, uri: &str) -> io::Result<Vec<u8>>;

    /// The image that `uri` names, not decoded; it must exist.
    fn image(&self, uri: &str) -> io::Result<ImageSource> {
        Ok(ImageSource::Bytes {
            name: format!("\"{}\"", printable(uri)),
            bytes: Arc::from(self.read(uri)?),
        })
    }
}

/// Refuses every file: for documents that must stand alone.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoFiles;

impl Resolver for NoFiles {
    fn read(&self, _uri: &str) -> io::Result<Vec<u8>> {
        Err(io::Error::new(
            io::ErrorKind::NotFound,
            "no other files are read here",
        ))
    }
}

/// Finds files relative to a folder and remembers which ones were asked for, there or not.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    limits: Limits,
    used: RefCell<Vec<PathBuf>>,
    missing: RefCell<Vec<PathBuf>>,
}

impl Folder {
    /// Files are found relative to `path`; `limits` says how large they may be and whether they may
    /// lie outside.
    pub fn new(path: impl Into<PathBuf>, limits: &Limits) -> Self {
        Self {
            path: path.into(),
            limits: *limits,
            used: RefCell::default(),
            missing: RefCell::default(),
        }
    }

    /// The files found so far, and the paths at which none could be opened, each once, in the order of first use.
    pub fn into_used_and_missing(self) -> (Vec<PathBuf>, Vec<PathBuf>) {
        (self.used.into_inner(), self.missing.into_inner())
    }

    fn find(&self, uri: &str) -> io::Result<PathBuf> {
        if let Some((scheme, _)) = uri.split_once("://") {
            return Err(io::Error::new(
                io::ErrorKind::Unsupported,
                format!("{scheme} addresses are not followed; download the file beside the object"),
            ));
        }
        // Some exporters forget to encode, and some write the separators of Windows: further guesses.
        let decoded = percent_decoded(uri);
        let slashed = decoded.replace('\\', "/");
        let guesses = [&decoded, uri, &slashed];
        let allow_outside = self.limits.allow_outside;
        if !allow_outside && guesses.iter().any(|guess| leaves_folder(guess)) {
            return Err(outside());
        }
        let paths = guesses.map(|guess| self.path.join(guess));
        let found = paths.iter().find(|path| path.is_file());
        let found = found.unwrap_or(&paths[0]).clone();
        // Opened to refuse now what is no regular file, though it be read later.
        let file = dipir_files::open(&found).inspect_err(|_| match found.is_file() {
            true => note(&self.missing, &found),
            false => paths.iter().for_each(|path| note(&self.missing, path)),
        });
        if !allow_outside && !self.holds(&found)? {
            return Err(outside());
        }
        let bytes = file?.metadata()?.len();
        self.limits
            .check_bytes(bytes)
            .map_err(|e| io::Error::new(io::ErrorKind::FileTooLarge, e.to_string()))?;
        note(&self.used, &found);
        Ok(found)
    }

    /// Whether `file` lies in the folder once links are followed.
    fn holds(&self, file: &Path) -> io::Result<bool> {
        let folder = match self.path.as_os_str().is_empty() {
            true => Path::new("."),
            false => &self.path,
        };
        Ok(file.canonicalize()?.starts_with(folder.canonicalize()?))
    }
}

/// Adds a path once.
fn note(list: &RefCell<Vec<PathBuf>>, path: &Path) {
    let mut list = list.borrow_mut();
    if !list.iter().any(|known| known == path) {
        list.push(path.into());
    }
}

fn outside() -> io::Error {
    io::Error::new(
        io::ErrorKind::PermissionDenied,
        "it lies outside of the object's folder; copy it into that, or set scene.limits.allow_outside = true",
    )
}

/// Whether a relative path climbs out of the folder that it starts from.
fn leaves_folder(path: &str) -> bool {
    let mut depth = 0i64;
    Path::new(path).components().any(|part| {
        match part {
            Component::Prefix(_) | Component::RootDir => depth = i64::MIN,
            Component::ParentDir => depth -= 1,
            Component::Normal(_) => depth += 1,
            Component::CurDir => {}
        }
        depth < 0
    })
}

impl Resolver for Folder {
    fn read(&self, uri: &str) -> io::Result<Vec<u8>> {
        dipir_files::read(self.find(uri)?)
    }

    /// Exporters name a texture by where it lay on their machine: beside the object it is looked for, too.
    fn image(&self, uri: &str) -> io::Result<ImageSource> {
        let bare = uri.rsplit(['/', '\\']).next().unwrap_or_default();
        let found = self.find(uri).or_else(|e| match e.kind() {
            io::ErrorKind::FileTooLarge => Err(e),
            _ if bare.is_empty() => Err(e),
            _ => self.find(bare).map_err(|_| e),
        });
        found.map(ImageSource::File)
    }
}

/// The image of a texture, `what` in messages. `None`, with a warning, if the file is missing or the system keeps it back;
/// what a limit of ours refuses is an error.
pub(super) fn image(
    resolver: &dyn Resolver,
    uri: &str,
    what: String,
    warnings: &mut Vec<String>,
) -> Result<Option<ImageSource>, Error> {
    let path = named(uri);
    match resolver.image(uri) {
        Ok(image) => Ok(Some(image)),
        Err(e) if e.kind() == io::ErrorKind::NotFound || e.raw_os_error().is_some() => {
            warnings.push(format!(
                "{what} \"{}\" cannot be read ({}); the material's factors alone are used",
                path.display(),
                plain_reason(&e)
            ));
            Ok(None)
        }
        Err(source) => Err(Error::Read {
            role: what,
            path,
            source,
        }),
    }
}

/// An error without the number of the operating system, for messages.
pub(super) fn plain_reason(error: &io::Error) -> String {
    let text = error.to_string();
    text.split(" (os error").next().unwrap_or_default().into()
}

/// Where a file that was asked for would have to lie, for messages.
pub(super) fn named(uri: &str) -> PathBuf {
    Path::new(&percent_decoded(uri)).into()
}

/// `%20` and the like replaced by what they stand for; what is no valid escape stays.
fn percent_decoded(uri: &str) -> String {
    String::from_utf8(percent_decoded_bytes(uri)).unwrap_or_else(|_| uri.to_owned())
}

fn percent_decoded_bytes(uri: &str) -> Vec<u8> {
    let bytes = uri.as_bytes();
    let mut out = Vec::with_capacity(bytes.len());
    let mut i = 0;
    while i < bytes.len() {
        let hex = |k: usize| {
            bytes
                .get(i + k)
                .and_then(|b| (*b as char).to_digit(16))
                .map(|d| d as u8)
        };
        match (bytes[i], hex(1), hex(2)) {
            (b'%', Some(high), Some(low)) => {
                out.push(high * 16 + low);
                i += 3;
            }
            (byte, ..) => {
                out.push(byte);
                i += 1;
            }
        }
    }
    out
}

/// The payload of a `data:` URI, or `None` if `uri` is not one.
pub(super) fn data_uri(uri: &str, place: &str) -> Option<Result<Vec<u8>, Error>> {
    let rest = uri.strip_prefix("data:")?;
    let Some((header, payload)) = rest.split_once(',') else {
        return Some(Err(Error::malformed(
            format!("{place} is a data URI without a comma"),
            "export the file again",
        )));
    };
    Some(if header.ends_with(";base64") {
        base64_decoded(payload).ok_or_else(|| {
            Error::malformed(
                format!("{place} is a data URI that is not valid base64"),
                "export the file again",
            )
        })
    } else {
        Ok(percent_decoded_bytes(payload))
    })
}

/// RFC 4648, both alphabets, padding optional; `None` on any other character.
fn base64_decoded(text: &str) -> Option<Vec<u8>> {
    let text = text.trim_end_matches('=').as_bytes();
    if text.len() % 4 == 1 {
        return None;
    }
    let mut out = Vec::with_capacity(text.len() / 4 * 3 + 2);
    let (mut bits, mut held) = (0u32, 0);
    for &c in text {
        let digit = match c {
            b'A'..=b'Z' => c - b'A',
            b'a'..=b'z' => c - b'a' + 26,
            b'0'..=b'9' => c - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            _ => return None,
        };
        bits = (bits << 6) | u32::from(digit);
        held += 6;
        if held >= 8 {
            held -= 8;
            out.push((bits >> held) as u8);
        }
    }
    Some(out)
}

const COPY: &str = "export or copy the file again";

/// The JSON text of a glTF file and the binary chunk behind it, if it is a GLB.
pub(super) fn split(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), Error> {
    if !bytes.starts_with(b"glTF") {
        let text = dipir_files::without_byte_order_mark(bytes);
        return match text.iter().find(|b| !b.is_ascii_whitespace()) {
            Some(b'{') => Ok((text, None)),
            None => Err(Error::malformed("the file is empty", COPY)),
            _ => Err(Error::malformed(
                "neither a GLB header nor a JSON object stands at the start",
                "use a .glb or .gltf file",
            )),
        };
    }
    match gltf::Glb::from_slice(whole(bytes)?) {
        Ok(glb) => Ok((borrowed(glb.json), glb.bin.map(borrowed))),
        Err(gltf::Error::Binary(error)) => split_failed(bytes, error),
        Err(error) => Err(Error::malformed(format!("the GLB file: {error}"), COPY)),
    }
}

/// Whether a JSON document is glTF 1.0, in which what are lists now were maps.
pub(super) fn is_gltf_1(json: &[u8]) -> bool {
    let document: serde_json::Value = serde_json::from_slice(json).unwrap_or_default();
    let version = document.pointer("/asset/version");
    match version.and_then(|v| v.as_str().map(str::to_owned).or(Some(v.to_string()))) {
        Some(version) => version.starts_with('1'),
        None => document["meshes"].is_object() || document["buffers"].is_object(),
    }
}

/// The refusal of glTF 1.
pub(super) fn old_version(version: &str) -> Error {
    Error::malformed(
        format!("the file is glTF {version}, which is not read"),
        "convert it to glTF 2.0: gltf-pipeline -i OLD.gltf -o NEW.glb",
    )
}

/// The bytes that a GLB header announces; the reader takes more for chunks and subtracts the
/// header's size unchecked.
fn whole(bytes: &[u8]) -> Result<&[u8], Error> {
    let (Some(version), Some(length)) = (word(bytes, 4), word(bytes, 8)) else {
        return Err(Error::malformed(
            format!("the GLB header has 12 bytes, the file only {}", bytes.len()),
            COPY,
        ));
    };
    if version == 1 {
        return Err(old_version("1.0"));
    }
    if version != 2 {
        return Err(Error::malformed(
            format!("the GLB header says version {version}; accepted: 2"),
            "export the file as glTF 2.0",
        ));
    }
    if length < 12 {
        return Err(Error::malformed("the GLB file has no JSON chunk", COPY));
    }
    bytes.get(..length as usize).ok_or_else(|| {
        Error::malformed(
            format!(
                "the GLB header announces {length} bytes, the file has {}: it is cut short",
                bytes.len()
            ),
            COPY,
        )
    })
}

fn split_failed(bytes: &[u8], error: gltf::binary::Error) -> Result<(&[u8], Option<&[u8]>), Error> {
    use gltf::binary::{ChunkType, Error as Glb};
    let json_size = word(bytes, 12).unwrap_or(0) as usize;
    if let Glb::ChunkLength {
        ty,
        length,
        length_read,
    } = error
    {
        let at = match ty {
            ChunkType::Json => 12,
            ChunkType::Bin => 20 + json_size,
        };
        return Err(Error::malformed(
            format!("the GLB chunk at byte {at} announces {length} bytes, {length_read} are left"),
            COPY,
        ));
    }
    // Chunks of unknown kinds and stray bytes behind the JSON are to be passed over (glTF 2.0,
    // 4.4.3.1); the reader stops there.
    match bytes.get(20..20 + json_size) {
        Some(json) if bytes[16..20] == *b"JSON" => Ok((json, None)),
        _ => Err(Error::malformed("the GLB file has no JSON chunk", COPY)),
    }
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    let word = bytes.get(at..at + 4)?;
    Some(u32::from_le_bytes(word.try_into().ok()?))
}

/// A part of a slice, which the reader does not copy.
fn borrowed(part: Cow<'_, [u8]>) -> &[u8] {
    match part {
        Cow::Borrowed(slice) => slice,
        Cow::Owned(_) => &[],
    }
}
