//! Files of results. A file is there whole or not at all.
use std::fs;
use std::path::Path;

use anyhow::Context;
use serde::{Deserialize, Serialize};

/// Reads a JSON file.
///
/// # Errors
/// If the file cannot be read, or does not hold a `T`.
pub fn read_json<T: for<'de> Deserialize<'de>>(path: &Path) -> anyhow::Result<T> {
    let text = dipir_files::read_to_string(path)
        .with_context(|| format!("cannot read {}", path.display()))?;
    let text = dipir_files::without_byte_order_mark(text.as_bytes());
    serde_json::from_slice(text)
        .with_context(|| format!("{} is damaged or of another version", path.display()))
}

/// Writes a file beside its place, under a name of this process's own, and renames it: of several processes that write it at
/// once, the last one to end wins. Missing folders are created.
///
/// # Errors
/// If the file or its folder cannot be written.
pub fn write(path: &Path, content: impl AsRef<[u8]>) -> anyhow::Result<()> {
    let failed = || format!("cannot write {}", path.display());
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).with_context(failed)?;
    }
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.partial", std::process::id()));
    let beside = path.with_file_name(name);
    let written = fs::write(&beside, content).and_then(|()| fs::rename(&beside, path));
    if written.is_err() {
        let _ = fs::remove_file(&beside);
    }
    written.with_context(failed)
}

/// Writes indented JSON. Errors as [`write`].
pub fn write_json(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_vec_pretty(value)?;
    text.push(b'\n');
    write(path, text)
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;

    #[test]
    fn a_file_that_cannot_take_its_place_leaves_nothing_beside() {
        let folder = tempfile::tempdir().unwrap();
        let of = |name: &str| folder.path().join(name);
        // A file of the user's, of a name that writers of other programs use.
        fs::write(of("report.json.partial"), "mine").unwrap();
        write_json(&of("report.json"), &1).unwrap();
        assert_eq!(fs::read(of("report.json.partial")).unwrap(), b"mine");
        assert_eq!(read_json::<Value>(&of("report.json")).unwrap(), 1);
        fs::create_dir(of("study.html")).unwrap();
        write(&of("study.html"), "x").unwrap_err();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3);
    }

    #[test]
    fn what_editors_on_windows_save_is_read_or_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("answers.json");
        fs::write(&path, b"\xef\xbb\xbf[1]").unwrap();
        assert_eq!(read_json::<Vec<u8>>(&path).unwrap(), [1]);
        fs::write(&path, b"\xff\xfe[\0").unwrap();
        let error = read_json::<Value>(&path).unwrap_err();
        assert!(
            format!("{error:#}").contains(dipir_files::UTF_16),
            "{error:#}"
        );
        let error = read_json::<Value>(folder.path()).unwrap_err();
        assert!(format!("{error:#}").contains("a folder"), "{error:#}");
    }
}
