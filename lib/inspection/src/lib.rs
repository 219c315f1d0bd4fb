//! What any artifact holds, and whether it is whole. Nothing of the pipeline imports this.
pub mod command_line;
mod folder;
mod json;
mod object;
mod picture;
mod range;
pub mod report;
mod tensors;
mod view;

use std::fs::File;
use std::io::Read;
use std::path::Path;

use anyhow::{Context, bail};
use command_line::ViewArgs;
use dipir_scene::import::EXTENSIONS;
use report::Report;

/// The kind of a file, by its first bytes and its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Png,
    Jpeg,
    Hdr,
    Exr,
    Object,
    Json,
    Safetensors,
}

/// What the file or stage folder `path` holds. Writes the picture that `view` asks for.
///
/// # Errors
/// If the file cannot be read, is of no known kind, or has no picture though `view` asks for one.
/// A stage's folder with damaged files is no error: [`Report::problems`] names them.
pub fn inspect(path: &Path, view: &ViewArgs) -> anyhow::Result<Report> {
    let metadata = std::fs::metadata(path)
        .map_err(|e| anyhow::anyhow!("cannot read {}: {}", path.display(), reason(&e)))?;
    view.check(path)?;
    if metadata.is_dir() {
        view.refuse("a folder")?;
        return folder::inspect(path);
    }
    if !metadata.is_file() {
        bail!(
            "{} is a pipe or a device; name a file or a folder",
            path.display()
        );
    }
    let kind = kind_of(path, metadata.len())?;
    match kind {
        Kind::Png | Kind::Jpeg | Kind::Hdr | Kind::Exr => picture::inspect(path, kind, view),
        Kind::Object => {
            view.refuse("a 3D object")?;
            object::inspect(path)
        }
        Kind::Json => {
            view.refuse("JSON")?;
            json::inspect(path)
        }
        Kind::Safetensors => {
            view.refuse("tensors")?;
            tensors::inspect(path)
        }
    }
}
fn kind_of(path: &Path, length: u64) -> anyhow::Result<Kind> {
    if length == 0 {
        bail!("{} is empty (0 bytes); make it anew", path.display());
    }
    let mut head = Vec::new();
    File::open(path)
        .and_then(|file| file.take(16).read_to_end(&mut head))
        .map_err(|e| anyhow::anyhow!("cannot read {}: {}", path.display(), reason(&e)))?;
    let extension = path
        .extension()
        .map(|e| e.to_string_lossy().to_ascii_lowercase())
        .unwrap_or_default();
    Ok(match (head.as_slice(), extension.as_str()) {
        ([0x89, b'P', b'N', b'G', ..], _) => Kind::Png,
        ([0xff, 0xd8, 0xff, ..], _) => Kind::Jpeg,
        ([b'#', b'?', ..], _) => Kind::Hdr,
        ([0x76, 0x2f, 0x31, 0x01, ..], _) => Kind::Exr,
        ([b'g', b'l', b'T', b'F', ..], _) => Kind::Object,
        (_, extension) if EXTENSIONS.contains(&extension) => Kind::Object,
        (_, "png") => Kind::Png,
        (_, "jpg" | "jpeg") => Kind::Jpeg,
        (_, "hdr") => Kind::Hdr,
        (_, "exr") => Kind::Exr,
        (_, "safetensors") => Kind::Safetensors,
        (_, "json") => Kind::Json,
        _ => bail!(
            "{} is of no kind known here; accepted: PNG, JPEG, HDR, EXR, GLB, glTF, OBJ, PLY, STL, JSON, \
             safetensors, or a stage's folder",
            path.display()
        ),
    })
}

/// The operating system's reason without its number.
fn reason(error: &std::io::Error) -> String {
    dipir_pipeline::manifest::plain_reason(error)
}

/// The whole text of a file.
fn read_text(path: &Path) -> anyhow::Result<String> {
    let bytes = std::fs::read(path)
        .map_err(|e| anyhow::anyhow!("cannot read {}: {}", path.display(), reason(&e)))?;
    String::from_utf8(bytes).with_context(|| format!("{} is not UTF-8 text", path.display()))
}
