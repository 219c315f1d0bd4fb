//! The painted mask's file.
use std::path::{Path, PathBuf};
use std::{fs, io};

use anyhow::{Context, anyhow, bail};
use dipir_imaging::raster::Raster;
use dipir_pipeline::manifest::plain_reason;
use dipir_preview::png;

/// Its name, beside the project's.
pub(crate) const MASK_FILE: &str = "holdout.png";

/// The file of a mask that is about to be saved.
pub(crate) struct MaskFile {
    pub(crate) path: PathBuf,
    /// What it held before it was written; `None` if there was none.
    earlier: Option<Vec<u8>>,
}

impl MaskFile {
    /// The one beside `project`.
    ///
    /// # Errors
    /// If another program's file is there.
    pub(crate) fn beside(project: &Path) -> anyhow::Result<Self> {
        let path = project.with_file_name(MASK_FILE);
        if !png::is_free(&path, png::Kind::Mask)? {
            bail!("{MASK_FILE} is there already and dipir did not make it; rename it");
        }
        let earlier = None;
        Ok(Self { path, earlier })
    }

    /// Writes `mask`, which has the photograph's pixels.
    ///
    /// # Errors
    /// If it cannot be; what was there stays.
    pub(crate) fn write(&mut self, mask: &Raster<f32>) -> anyhow::Result<()> {
        let path = &self.path;
        self.earlier = match path.exists() {
            true => Some(
                dipir_files::read(path)
                    .with_context(|| format!("cannot read \"{}\"", path.display()))?,
            ),
            false => None,
        };
        let [w, h] = [mask.width(), mask.height()];
        let byte = |v: &f32| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        let values: Vec<u8> = mask.pixels().iter().map(byte).collect();
        let kind = png::Kind::Mask;
        png::write(path, &png::encode(kind, w, h, &values)?, kind).map_err(|e| unwritten(path, &e))
    }

    /// Brings back what was there before it was written, or nothing.
    ///
    /// # Errors
    /// If it cannot be.
    pub(crate) fn restore(&self) -> anyhow::Result<()> {
        let restored = match &self.earlier {
            Some(earlier) => png::write(&self.path, earlier, png::Kind::Mask),
            None => fs::remove_file(&self.path),
        };
        restored.map_err(|e| unwritten(&self.path, &e))
    }
}

/// That a file cannot be written. The name of the one beside it, which becomes it, says nothing to anybody.
pub(crate) fn unwritten(path: &Path, error: &io::Error) -> anyhow::Error {
    let reason = plain_reason(error);
    anyhow!("cannot write \"{}\": {reason}", path.display())
}
