//! How a configuration names files.
use std::path::{Component, Path, PathBuf};

use crate::error::SetupError;

/// A path relative to the current folder, as a file in `folder` names it.
pub(crate) fn beside(path: &Path, folder: &Path) -> Result<String, SetupError> {
    let [path, folder] = [path, folder].map(|p| p.strip_prefix(".").unwrap_or(p));
    let named = match path.strip_prefix(folder) {
        Ok(rest) if rest.is_relative() => rest.to_owned(),
        _ => match way(path, folder) {
            Some(way) => way,
            None => std::path::absolute(path).map_err(|source| SetupError::Read {
                path: path.into(),
                source,
            })?,
        },
    };
    let is_portable = named.is_relative();
    let text = named.into_os_string().into_string();
    let text = text.map_err(|_| SetupError::NotUtf8 { path: path.into() })?;
    Ok(match is_portable {
        // So that the project is read on other systems, too.
        true => text.replace(std::path::MAIN_SEPARATOR, "/"),
        false => text,
    })
}

/// The way from `folder` to `path` by `..`; `None` if they share no folder but the root.
fn way(path: &Path, folder: &Path) -> Option<PathBuf> {
    let here = |p: &Path| match p.as_os_str().is_empty() {
        true => Path::new(".").canonicalize().ok(),
        false => p.canonicalize().ok(),
    };
    // Links of folders are followed, for `..` leads out of what they point to; a link of the file stays.
    let path = match (path.parent(), path.file_name()) {
        (Some(parent), Some(name)) => here(parent)?.join(name),
        _ => here(path)?,
    };
    let folder = here(folder)?;
    let common = path.components().zip(folder.components());
    let common = common.take_while(|(a, b)| a == b).count();
    let is_folder = |c: Component| matches!(c, Component::Normal(_));
    if !path.components().take(common).any(is_folder) {
        return None;
    }
    let up = folder
        .components()
        .skip(common)
        .map(|_| Component::ParentDir);
    Some(up.chain(path.components().skip(common)).collect())
}
