//! `dipir-inspect`: shows any artifact, and whether it is whole.
mod cli;
mod folder;
mod json;
mod model;
mod picture;
mod report;
mod tensors;
mod view;

use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context, bail};
use clap::Parser;
use cli::{Cli, ViewArgs};
use dipir_cli::exit::{self, Usage};
use dipir_cli::style::{bold, color_on_stdout};
use report::Report;

fn main() -> ExitCode {
    exit::run(|| run(&Cli::parse()))
}

fn run(args: &Cli) -> anyhow::Result<()> {
    if args.view.png.is_some() && args.paths.len() != 1 {
        return Err(Usage("--png shows one image: give one PATH".into()).into());
    }
    let mut reports = Vec::new();
    for path in &args.paths {
        reports.push(inspect(path, &args.view)?);
    }
    print(args, &reports);
    let damaged: Vec<_> = reports.iter().flat_map(|r| &r.problems).collect();
    match damaged.as_slice() {
        [] => Ok(()),
        [one] => bail!("{one}"),
        [first, rest @ ..] => bail!("{first} (and {} more)", rest.len()),
    }
}

fn print(args: &Cli, reports: &[Report]) {
    let text = || {
        let color = color_on_stdout();
        let shown: Vec<String> = reports
            .iter()
            .map(|r| format!("{}\n{}", bold(&r.title, color), r.text.trim_end()))
            .collect();
        shown.join("\n\n")
    };
    let json = || match reports {
        [one] => one.json.clone(),
        many => many.iter().map(|r| r.json.clone()).collect(),
    };
    args.output.result(text, json);
}

/// What the first bytes and the name of a file say.
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

fn inspect(path: &Path, view: &ViewArgs) -> anyhow::Result<Report> {
    let metadata = std::fs::metadata(path)
        .map_err(|e| anyhow::anyhow!("cannot read {}: {}", path.display(), reason(&e)))?;
    if metadata.is_dir() {
        view.refuse("a folder")?;
        return folder::inspect(path);
    }
    let kind = kind_of(path, metadata.len())?;
    match kind {
        Kind::Png | Kind::Jpeg | Kind::Hdr | Kind::Exr => picture::inspect(path, kind, view),
        Kind::Object => {
            view.refuse("a 3D object")?;
            model::inspect(path)
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
        ([b'g', b'l', b'T', b'F', ..], _) | (_, "glb" | "gltf" | "obj") => Kind::Object,
        (_, "png") => Kind::Png,
        (_, "jpg" | "jpeg") => Kind::Jpeg,
        (_, "hdr") => Kind::Hdr,
        (_, "exr") => Kind::Exr,
        (_, "safetensors") => Kind::Safetensors,
        (_, "json") => Kind::Json,
        _ => bail!(
            "{} is of no kind known here; accepted: PNG, JPEG, HDR, EXR, GLB, glTF, OBJ, JSON, \
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
