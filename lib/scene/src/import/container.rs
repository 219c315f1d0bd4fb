//! The GLB container, data URIs, and where files that a document names are found.
use std::borrow::Cow;
use std::cell::RefCell;
use std::collections::{HashMap, HashSet};
use std::ffi::{OsStr, OsString};
use std::hash::Hash;
use std::io;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use dipir_cameras::file::{from_base64, is_buffer};
use percent_encoding::percent_decode_str;

use crate::error::Error;
use crate::limits::Limits;
use crate::printable::printable;
use crate::texture::ImageSource;

/// Finds the files that a document refers to.
pub trait Resolver {
    /// The contents of the file that the percent-encoded relative `uri` names.
    fn read(&self, uri: &str) -> io::Result<Vec<u8>>;

    /// The bytes of geometry that `uri` names.
    fn buffer(&self, uri: &str) -> io::Result<Vec<u8>> {
        self.read(uri)
    }

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
    warnings: RefCell<Vec<String>>,
    /// Of folders that were searched.
    listings: RefCell<HashMap<PathBuf, Listing>>,
}

/// What a file that a document names is read as.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Text,
    Buffer,
    Image,
}

impl Kind {
    /// Whether a file outside of the object's folder may be read as this, where the document climbs to it by `..`. A document
    /// of strangers may name any file: one is read that can be nothing else, and only its pixels or numbers are used.
    fn is_of(self, file: &Path) -> bool {
        match self {
            Self::Text => false,
            Self::Buffer => is_buffer(file),
            Self::Image => ImageSource::File(file.into())
                .pixels()
                .is_ok_and(|size| size.is_some()),
        }
    }
}

/// Entries of a folder by their names in small letters; `None` where several have the same.
type Listing = HashMap<String, Option<OsString>>;

impl Folder {
    /// Files are found relative to `path`; `limits` says how large they may be and whether they may
    /// lie outside.
    pub fn new(path: impl Into<PathBuf>, limits: &Limits) -> Self {
        Self {
            path: path.into(),
            limits: *limits,
            used: RefCell::default(),
            missing: RefCell::default(),
            warnings: RefCell::default(),
            listings: RefCell::default(),
        }
    }

    /// The files found so far, and the paths at which none could be opened, each once, in the order of first use.
    pub fn into_used_and_missing(self) -> (Vec<PathBuf>, Vec<PathBuf>) {
        (
            once(self.used.into_inner()),
            once(self.missing.into_inner()),
        )
    }

    /// What was found under another name than asked for, one sentence each.
    pub(super) fn take_warnings(&self) -> Vec<String> {
        once(self.warnings.take())
    }

    fn find(&self, uri: &str, kind: Kind) -> io::Result<PathBuf> {
        let uri = without_file_scheme(uri);
        if uri.trim().is_empty() {
            return Err(io::Error::new(io::ErrorKind::NotFound, "no file is named"));
        }
        if let Some((scheme, _)) = uri.split_once("://") {
            return Err(io::Error::new(
                io::ErrorKind::NotFound,
                format!("{scheme} addresses are not followed; download the file beside the object"),
            ));
        }
        // Some exporters forget to encode, and some write the separators of Windows: further guesses.
        let decoded = percent_decoded(uri);
        let slashed = decoded.replace('\\', "/");
        let guesses = [&*decoded, uri, &slashed];
        let allow_outside = self.limits.allow_outside;
        let climbs = guesses.iter().any(|guess| leaves_folder(guess));
        // An absolute path is one of the machine that wrote it. Whether it is there is not looked up.
        let is_absolute = guesses.iter().any(|guess| is_absolute(guess));
        if !allow_outside && (is_absolute || climbs && kind == Kind::Text) {
            return Err(outside(match is_absolute {
                true => io::ErrorKind::NotFound,
                false => io::ErrorKind::PermissionDenied,
            }));
        }
        let paths = guesses.map(|guess| self.path.join(guess));
        let found = paths.iter().find(|path| path.is_file()).cloned();
        let found = found.or_else(|| {
            let found = guesses.iter().find_map(|guess| self.but_for_case(guess))?;
            // As soon as one of these is there, it is the one.
            paths.iter().for_each(|path| note(&self.missing, path));
            Some(found)
        });
        let found = found.unwrap_or_else(|| paths[0].clone());
        // Opened to refuse now what is no regular file, though it be read later.
        let file = dipir_files::open(&found).inspect_err(|_| match found.is_file() {
            true => note(&self.missing, &found),
            false => paths.iter().for_each(|path| note(&self.missing, path)),
        });
        let file = file.map_err(|e| match found.is_dir() {
            true => io::Error::new(io::ErrorKind::NotFound, e.to_string()),
            false => e,
        });
        let may_be_read = || climbs && file.is_ok() && kind.is_of(&found);
        if !(allow_outside || self.holds(&found)? || may_be_read()) {
            return Err(file.err().unwrap_or_else(|| match (climbs, kind) {
                (true, Kind::Image) => io::Error::new(
                    io::ErrorKind::NotFound,
                    "it lies outside of the object's folder and is no PNG, JPEG, WebP, BMP or Targa image",
                ),
                _ => outside(io::ErrorKind::PermissionDenied),
            }));
        }
        let bytes = file?.metadata()?.len();
        self.limits
            .check_bytes(bytes)
            .map_err(|e| io::Error::new(io::ErrorKind::FileTooLarge, e.to_string()))?;
        note(&self.used, &found);
        Ok(found)
    }

    /// The only file of a name that differs in nothing but the case of letters, with a warning. Systems differ in whether that
    /// counts.
    fn but_for_case(&self, guess: &str) -> Option<PathBuf> {
        let mut found = self.path.clone();
        for part in Path::new(guess).components() {
            let exact = found.join(part);
            found = match (exact.exists(), part) {
                (true, _) => exact,
                (false, Component::Normal(name)) => self.only_match(&found, name)?,
                (false, _) => return None,
            };
        }
        if !found.is_file() {
            return None;
        }
        let own = found.strip_prefix(&self.path).unwrap_or(&found);
        let warning = format!(
            "there is no \"{guess}\"; \"{}\" is used, whose name differs in the case of letters",
            own.display()
        );
        self.warnings.borrow_mut().push(printable(warning));
        Some(found)
    }

    /// The only entry of a folder that is called `name` but for the case of letters.
    fn only_match(&self, folder: &Path, name: &OsStr) -> Option<PathBuf> {
        let mut listings = self.listings.borrow_mut();
        // Listed once, for an object may name many files that are not there.
        let listing = (listings.entry(folder.into())).or_insert_with(|| listing(folder));
        let found = listing.get(&small_letters(name))?.as_ref()?;
        Some(folder.join(found))
    }

    /// Whether `file` lies in the folder once links are followed.
    fn holds(&self, file: &Path) -> io::Result<bool> {
        let folder = or_here(&self.path);
        Ok(file.canonicalize()?.starts_with(folder.canonicalize()?))
    }
}

/// A path that lists: the empty one stands for the folder of the process.
fn or_here(folder: &Path) -> &Path {
    match folder.as_os_str().is_empty() {
        true => Path::new("."),
        false => folder,
    }
}

fn small_letters(name: &OsStr) -> String {
    name.to_string_lossy().to_lowercase()
}

/// Of a folder that cannot be listed it is empty.
fn listing(folder: &Path) -> Listing {
    let mut all = Listing::new();
    let entries = or_here(folder).read_dir().into_iter().flatten();
    for name in entries.flatten().map(|entry| entry.file_name()) {
        all.entry(small_letters(&name))
            .and_modify(|only| *only = None)
            .or_insert(Some(name));
    }
    all
}

fn note(list: &RefCell<Vec<PathBuf>>, path: &Path) {
    list.borrow_mut().push(path.into());
}

/// Each value once, where it is first.
pub(crate) fn once<T: Clone + Eq + Hash>(mut all: Vec<T>) -> Vec<T> {
    let mut seen = HashSet::new();
    all.retain(|value| seen.insert(value.clone()));
    all
}

/// The path in an address of the `file` scheme [RFC 8089]; anything else as it is.
fn without_file_scheme(uri: &str) -> &str {
    let scheme = uri.get(..5);
    if !scheme.is_some_and(|s| s.eq_ignore_ascii_case("file:")) {
        return uri;
    }
    let rest = uri[5..].strip_prefix("//").unwrap_or(&uri[5..]);
    let local = rest.strip_prefix("localhost");
    local.filter(|path| path.starts_with('/')).unwrap_or(rest)
}

fn outside(kind: io::ErrorKind) -> io::Error {
    io::Error::new(
        kind,
        "it lies outside of the object's folder; copy it into that, or set scene.limits.allow_outside = true",
    )
}

/// Whether a path starts from no folder that it is joined to.
fn is_absolute(path: &str) -> bool {
    let first = Path::new(path).components().next();
    matches!(first, Some(Component::Prefix(_) | Component::RootDir))
}

/// Whether a relative path climbs out of the folder that it starts from.
fn leaves_folder(path: &str) -> bool {
    let mut depth = 0i64;
    Path::new(path).components().any(|part| {
        depth += match part {
            Component::ParentDir => -1,
            Component::Normal(_) => 1,
            _ => 0,
        };
        depth < 0
    })
}

impl Resolver for Folder {
    fn read(&self, uri: &str) -> io::Result<Vec<u8>> {
        dipir_files::read(self.find(uri, Kind::Text)?)
    }

    fn buffer(&self, uri: &str) -> io::Result<Vec<u8>> {
        dipir_files::read(self.find(uri, Kind::Buffer)?)
    }

    /// Exporters name a texture by where it lay on their machine: beside the object it is looked for, too.
    fn image(&self, uri: &str) -> io::Result<ImageSource> {
        let bare = uri.rsplit(['/', '\\']).next().unwrap_or_default();
        let found = self.find(uri, Kind::Image).or_else(|e| match e.kind() {
            io::ErrorKind::FileTooLarge => Err(e),
            _ if bare.is_empty() => Err(e),
            _ => self
                .find(bare, Kind::Image)
                .map_err(|of_bare| match of_bare.kind() {
                    io::ErrorKind::NotFound => e,
                    _ => of_bare,
                }),
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
    Path::new(&*percent_decoded(uri)).into()
}

/// `%20` and the like replaced by what they stand for; what is no valid escape stays.
fn percent_decoded(uri: &str) -> Cow<'_, str> {
    percent_decode_str(uri)
        .decode_utf8()
        .unwrap_or(Cow::Borrowed(uri))
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
        from_base64(payload).ok_or_else(|| {
            Error::malformed(
                format!("{place} is a data URI that is not valid base64"),
                "export the file again",
            )
        })
    } else {
        Ok(percent_decode_str(payload).collect())
    })
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_listed_once_however_many_files_are_not_there() {
        let files = tempfile::tempdir().unwrap();
        std::fs::write(files.path().join("Paint.PNG"), "").unwrap();
        let folder = Folder::new(files.path(), &Limits::default());
        assert!(folder.image("gone.png").is_err());
        // Not in the listing.
        std::fs::write(files.path().join("WOOD.png"), "").unwrap();
        if files.path().join("wood.PNG").exists() {
            return;
        }
        assert!(folder.image("wood.png").is_err());
        assert!(folder.image("paint.png").is_ok());
        assert_eq!(folder.listings.borrow().len(), 1);
    }

    #[test]
    fn paths_are_taken_out_of_addresses_of_the_file_scheme() {
        for (uri, path) in [
            ("file:///a/b.png", "/a/b.png"),
            ("file:/a/b.png", "/a/b.png"),
            ("File://localhost/a.png", "/a.png"),
            ("file://localhost.png", "localhost.png"),
            ("files/a.png", "files/a.png"),
            ("fil\u{e9}:a", "fil\u{e9}:a"),
            ("file:", ""),
        ] {
            assert_eq!(without_file_scheme(uri), path);
        }
    }
}
