//! Changing a file of the user's at the user's own request.
use std::fs;
use std::io::{self, Write};
use std::path::Path;

use tempfile::NamedTempFile;

use crate::own::sync_folder;
use crate::read;

/// Replaces the file at `path`, which holds `before`, by `after`. Its permissions stay, and where `path` is a
/// symbolic link, what it points to is replaced. The new file has a random name until it is whole on
/// the disk.
///
/// # Errors
/// If the file does not hold `before`, or cannot be written; it is untouched then.
pub fn rewrite(path: &Path, before: &[u8], after: &[u8]) -> io::Result<()> {
    let path = fs::canonicalize(path)?;
    let folder = path.parent().unwrap_or(Path::new("."));
    let mut file = NamedTempFile::new_in(folder)?;
    file.as_file()
        .set_permissions(fs::metadata(&path)?.permissions())?;
    file.write_all(after)?;
    file.as_file().sync_all()?;
    if read(&path)? != before {
        return Err(io::Error::other("another program changed it meanwhile"));
    }
    file.persist(&path)?;
    sync_folder(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_another_program_changed_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pipeline.toml");
        fs::write(&path, "changed").unwrap();
        assert!(rewrite(&path, b"as read", b"new").is_err());
        assert_eq!(fs::read(&path).unwrap(), b"changed");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[cfg(unix)]
    #[test]
    fn links_permissions_and_files_beside_it_stay() {
        use std::os::unix::fs::{PermissionsExt, symlink};
        let folder = tempfile::tempdir().unwrap();
        let (file, link) = (folder.path().join("file"), folder.path().join("link"));
        let beside = folder.path().join(".file.partial");
        fs::write(&file, "old").unwrap();
        fs::write(&beside, "mine").unwrap();
        fs::set_permissions(&file, fs::Permissions::from_mode(0o640)).unwrap();
        symlink("file", &link).unwrap();
        rewrite(&link, b"old", b"new").unwrap();
        assert_eq!(fs::read(&file).unwrap(), b"new");
        assert_eq!(fs::read_link(&link).unwrap(), Path::new("file"));
        let mode = fs::metadata(&file).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o640);
        assert_eq!(fs::read(&beside).unwrap(), b"mine");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3);
    }
}
