//! What a model is measured by.
use std::path::Path;

use dipir_imaging::error::MAX_PIXELS;
use dipir_scene::Error;
use dipir_scene::import::{Imported, Limits, load_object_within};

use crate::error::SetupError;
use crate::size::{Kind, Size, size};

/// A limit of `[scene.limits]` that a model needs raised.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Raised {
    /// `texture_pixels`.
    pub key: &'static str,
    /// To what.
    pub value: u64,
    /// Which model needs it, and what in it.
    pub why: String,
}

/// Most pixels of all textures of a file: 4 GiB once decoded.
const ALL_TEXTURES: u64 = 4 * MAX_PIXELS as u64;

/// Measures models. Their textures are not decoded, so large ones take no memory here.
#[derive(Default)]
pub(crate) struct Models {
    limits: Limits,
    /// What `[scene.limits]` has to say.
    pub(crate) raised: Vec<Raised>,
    /// What of the models could not be used, one sentence each.
    pub(crate) warnings: Vec<String>,
}

impl Models {
    /// The size of the model in `path`, `asked` metres high if given.
    ///
    /// # Errors
    /// On a file that cannot be used, and a height that is not above 0.
    pub(crate) fn size_of(&mut self, path: &Path, asked: Option<f64>) -> Result<Size, SetupError> {
        let imported = self.load(path)?;
        let named = |w: &String| format!("\"{}\": {w}", path.display());
        self.warnings.extend(imported.warnings.iter().map(named));
        let bounds = imported.mesh.bounds();
        let (low, high) = bounds.ok_or_else(|| SetupError::Empty { path: path.into() })?;
        size(low.as_dvec3(), high.as_dvec3(), Kind::of(path), asked)
    }

    /// Reads a model, under higher limits for textures if it needs them.
    fn load(&mut self, path: &Path) -> Result<Imported, SetupError> {
        loop {
            let error = match load_object_within(path, &self.limits) {
                Ok(imported) => return Ok(imported),
                Err(error) => error,
            };
            let Some((what, key)) = too_large(&error) else {
                return Err(error.into());
            };
            let (key, limit, most) = match key.strip_prefix("scene.limits.") {
                Some("texture_pixels") => (
                    "texture_pixels",
                    &mut self.limits.texture_pixels,
                    MAX_PIXELS as u64,
                ),
                Some("all_texture_pixels") => (
                    "all_texture_pixels",
                    &mut self.limits.all_texture_pixels,
                    ALL_TEXTURES,
                ),
                _ => return Err(error.into()),
            };
            if *limit >= most {
                return Err(SetupError::Textures {
                    path: path.into(),
                    what: what.into(),
                    limit: *limit,
                });
            }
            let why = format!(
                "for \"{}\": {what}, and {limit} are the usual limit",
                path.display()
            );
            self.warnings.push(format!(
                "[scene.limits] {key} is raised {why}; decoded, a pixel takes four bytes"
            ));
            *limit = most;
            self.raised.push(Raised {
                key,
                value: most,
                why,
            });
        }
    }
}

/// What exceeds a limit, and the limit's key.
fn too_large(error: &Error) -> Option<(&str, &'static str)> {
    match error {
        Error::TooLarge { what, key, .. } => Some((what, key)),
        Error::InFile { source, .. } => too_large(source),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    /// A model whose texture has a header alone, of this many pixels.
    fn textured(folder: &Path, width: u32, height: u32) -> PathBuf {
        let file = std::fs::File::create(folder.join("t.png")).unwrap();
        let writer = png::Encoder::new(file, width, height).write_header();
        writer.unwrap().write_chunk(png::chunk::IDAT, &[]).unwrap();
        std::fs::write(folder.join("m.mtl"), "newmtl m\nmap_Kd t.png\n").unwrap();
        let text = "mtllib m.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 2 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n";
        let path = folder.join("m.obj");
        std::fs::write(&path, text).unwrap();
        path
    }

    #[test]
    fn a_large_texture_raises_its_limit_and_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = textured(folder.path(), 10_000, 10_000);
        let mut models = Models::default();
        // A second copy needs nothing more.
        for _ in 0..2 {
            assert_eq!(models.size_of(&path, None).unwrap().height_m, 2.0);
        }
        let [raised] = &models.raised[..] else {
            panic!("{:?}", models.raised);
        };
        assert_eq!((raised.key, raised.value), ("texture_pixels", 1 << 28));
        assert!(
            raised.why.contains("has 100000000 pixels, and 67108864"),
            "{}",
            raised.why
        );
        let said = |w: &&String| w.starts_with("[scene.limits] texture_pixels is raised for ");
        assert_eq!(models.warnings.iter().filter(said).count(), 1);
    }

    #[test]
    fn a_texture_that_no_limit_allows_is_refused_with_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let path = textured(folder.path(), 20_000, 20_000);
        let error = Models::default().size_of(&path, None).unwrap_err();
        let error = error.to_string();
        assert!(
            error.contains("has 400000000 pixels, and at most 268435456 are read; scale"),
            "{error}"
        );
    }

    #[test]
    fn a_usual_texture_raises_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = textured(folder.path(), 100, 100);
        let mut models = Models::default();
        models.size_of(&path, None).unwrap();
        assert_eq!(models.raised, []);
    }
}
