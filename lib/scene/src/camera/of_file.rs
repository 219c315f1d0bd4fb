//! A camera in another program's file.
use std::path::{Path, PathBuf};

use dipir_cameras::chan::Turns;
use dipir_cameras::file::{self, Found, Shown, Wanted};
use dipir_cameras::neighbours::{self, Neighbour};
use dipir_cameras::{CameraError, Distortion, Lens, Pose, orientation};
use glam::{DVec2, DVec3, Vec2, Vec3};

use super::{Camera, FARTHEST_M, FieldOfView, WorldUp, distorted_focal, of_lens};
use crate::error::Error;
use crate::undistortion::Undistortion;

/// Which of a file's cameras is meant.
#[derive(Clone, Debug, PartialEq)]
pub enum Which {
    /// That of the picture with this file's name, else the only one.
    Photo(PathBuf),
    /// By its number.
    Number(u32),
    /// By the name of its picture.
    Name(String),
    /// By its name, at this frame: of a glTF camera that moves.
    Frame(String, u32),
}

/// A camera in another program's file.
#[derive(Clone, Debug, PartialEq)]
pub struct FileSettings {
    /// Name of the key that names the file.
    pub key: &'static str,
    /// The file or, of COLMAP's, the folder of the model or the project.
    pub path: PathBuf,
    /// Which camera.
    pub which: Which,
    /// Which axis of the file's world points up; `None` as the program that wrote it has it.
    pub up: Option<WorldUp>,
    /// How rotations of a `.chan` file turn; `None` as by Nuke.
    pub turns: Option<Turns>,
    /// Metres of a unit of the file's world.
    pub scale: f32,
    /// Position, point looked at and up, for files of a lens alone.
    pub stand: Option<[Vec3; 3]>,
    /// The first key that says where it stands or looks, for files of a lens alone.
    pub stands_by: Option<&'static str>,
    /// Vertical field of view for a file without one, degrees.
    pub fov_deg: Option<f32>,
    /// Where the optical axis meets the image, pixels, for a file that has it in the middle.
    pub principal_px: Option<Vec2>,
    /// How the lens bends lines, for a file without coefficients.
    pub distortion: Option<Distortion>,
    /// Exif orientation by which the photograph was made upright; 1 as long as it is not known.
    pub orientation: u8,
}

fn absolute(base_dir: &Path, path: &Path) -> PathBuf {
    let path = base_dir.join(path);
    std::path::absolute(&path).unwrap_or(path)
}

impl FileSettings {
    /// The files that are read, as the configuration would name them.
    pub fn parts(&self, base_dir: &Path) -> Vec<PathBuf> {
        parts(&self.path, base_dir)
    }

    /// Which of several models is read, or at which frame a camera that moves stands, as a warning.
    pub(crate) fn choice(&self, base_dir: &Path) -> Option<String> {
        let path = base_dir.join(&self.path);
        let doubtful = self.shown(base_dir).filter(|shown| shown.is_doubtful);
        let beyond = |path: &Path, wanted: &Wanted| Ok(neighbours::beyond(path, wanted));
        let assumed = match doubtful {
            Some(shown) => Some(shown.assumed),
            None if matches!(self.which, Which::Photo(_)) => None,
            None => self.found([1000, 1000], base_dir, beyond).ok().flatten(),
        };
        let assumed = assumed.map(|words| format!("\"{}\": {words}", path.display()));
        assumed.or_else(|| file::choice(&path))
    }

    /// Whether every picture has this camera: the file's only one, one of a glTF file that does not move, or one of KITTI's, which
    /// are fixed to a car.
    pub(crate) fn stands_still(&self, base_dir: &Path) -> bool {
        let path = base_dir.join(&self.path);
        let any = [PathBuf::from("1.png")];
        file::has_one(&path)
            || match &self.which {
                Which::Photo(_) => false,
                Which::Number(_) => file::is_kitti(&path),
                Which::Name(name) | Which::Frame(name, _) => {
                    let shown = file::all_shown(&path, Some(name), &any);
                    file::is_gltf(&path) && shown.is_ok_and(|shown| shown == [None])
                }
            }
    }

    /// The frame that the photograph shows of a camera that moves, where its name tells which, and those of pictures beside it.
    pub(crate) fn shown(&self, base_dir: &Path) -> Option<Shown> {
        let Which::Photo(photo) = &self.which else {
            return None;
        };
        // What is wrong with it is told where it is read.
        let shown = file::shown(&base_dir.join(&self.path), None, &absolute(base_dir, photo));
        shown.ok().flatten()
    }

    /// What may be wrong with the camera of a photograph of `resolution`, as warnings: that it was turned, and, where nobody says
    /// which axis of the file's world points up, that it seems to be another one.
    pub(crate) fn doubts(&self, resolution: [u32; 2], base_dir: &Path) -> Vec<String> {
        let path = base_dir.join(&self.path);
        let size = resolution.map(f64::from);
        let turn = orientation::doubt_of_turn(&path, size, self.orientation);
        let up = || {
            let quarters = self.read_turned(resolution, base_dir).ok()?.1;
            file::doubt(&path, quarters)
        };
        let up = self.up.is_none().then(up).flatten();
        turn.into_iter().chain(up).collect()
    }

    /// Errors if the file has no camera for the photograph, whatever the shape of that.
    pub(crate) fn check(&self, base_dir: &Path) -> Result<(), Error> {
        self.found([1000, 1000], base_dir, file::found).map(|_| ())
    }

    pub(super) fn resolve(
        &self,
        resolution: [u32; 2],
        base_dir: &Path,
    ) -> Result<(Camera, Option<Undistortion>), Error> {
        let found = self.read_turned(resolution, base_dir)?.0;
        let pose = self.pose(found.pose, resolution)?;
        Ok(of_lens(&pose, &self.lens(&found)?, resolution))
    }

    /// The camera, and by how many quarters it was turned as the photograph was.
    fn read_turned(&self, resolution: [u32; 2], base_dir: &Path) -> Result<(Found, u32), Error> {
        let read =
            |path: &Path, wanted: &Wanted| orientation::read_turned(path, wanted, self.orientation);
        self.found(resolution, base_dir, read)
    }

    /// Where the camera stands in the frames of a shot before and after the photograph, turned as that is where its resolution is
    /// known.
    pub(crate) fn neighbours(
        &self,
        resolution: Option<[u32; 2]>,
        base_dir: &Path,
    ) -> Result<[Option<Neighbour>; 2], Error> {
        let quarters = match resolution {
            Some(resolution) => self.read_turned(resolution, base_dir)?.1,
            None => 0,
        };
        let any = resolution.unwrap_or([1000, 1000]);
        let found = self.found(any, base_dir, neighbours::neighbours)?;
        Ok(found.map(|beside| {
            let mut beside = beside?.turned(quarters);
            beside.pose.position *= f64::from(self.scale);
            Some(beside)
        }))
    }

    /// What `read` reads of the camera for a picture of `resolution`.
    fn found<T>(
        &self,
        resolution: [u32; 2],
        base_dir: &Path,
        read: impl Fn(&Path, &Wanted) -> Result<T, CameraError>,
    ) -> Result<T, Error> {
        let path = base_dir.join(&self.path);
        // Its folders tell pictures of the same name apart.
        let photo = match &self.which {
            Which::Photo(path) => absolute(base_dir, path),
            _ => PathBuf::new(),
        };
        let wanted = Wanted {
            size: resolution.map(f64::from),
            which: match &self.which {
                Which::Photo(_) => file::Which::Photo(&photo),
                Which::Number(n) => file::Which::Number(*n),
                Which::Name(name) => file::Which::Name(name),
                Which::Frame(name, n) => file::Which::Frame(name, *n),
            },
            up: self.up,
            fov_deg: self.fov_deg.map(f64::from),
            turns: self.turns,
        };
        read(&path, &wanted).map_err(|e| match e {
            CameraError::Read { path, source } => Error::Read {
                role: "the camera file".into(),
                path,
                source,
            },
            other => Error::Camera(other).in_file(&path),
        })
    }

    /// An error about a key of the camera that the file, as far as `what` of it goes, excludes.
    fn conflict(&self, what: &str, name: &str) -> Error {
        Error::Conflict {
            first: format!("{what}scene.camera.{}", self.key),
            second: format!("scene.camera.{name}"),
        }
    }

    /// The lens that the file describes, with what the table says of it.
    fn lens(&self, found: &Found) -> Result<Lens, Error> {
        let mut lens = found.lens;
        if self.fov_deg.is_some() && found.states_fov {
            return Err(self.conflict("a field of view in ", "fov_deg"));
        }
        if let Some(principal_px) = self.principal_px {
            let size = DVec2::from_array(lens.size);
            // Up to rounding of a picture that is scaled.
            let off = (lens.principal_px / size - 0.5).abs().max_element();
            if off > 1e-9 {
                return Err(self.conflict("an optical axis in ", "principal_px"));
            }
            lens.principal_px = principal_px.as_dvec2();
        }
        if let Some(distortion) = self.distortion {
            if !lens.distortion.is_none() {
                return Err(self.conflict("coefficients of a lens in ", "distortion"));
            }
            lens.distortion = distortion;
            if let Some(fov_deg) = self.fov_deg {
                let height_px = lens.size[1];
                let focal_px = distorted_focal(&distortion, fov_deg.to_radians(), height_px)?;
                lens.focal_px = focal_px.map_or(lens.focal_px, DVec2::splat);
            }
        }
        Ok(lens)
    }

    /// Where the camera stands: in `found` of the file, or as the table says.
    fn pose(&self, found: Option<Pose>, resolution: [u32; 2]) -> Result<Pose, Error> {
        let pose = match (found, self.stand) {
            (Some(pose), _) => match self.stands_by {
                Some(name) => return Err(self.conflict("", name)),
                None => Pose {
                    position: pose.position * f64::from(self.scale),
                    ..pose
                },
            },
            (None, Some(_)) if self.scale != 1.0 => {
                return Err(self.conflict("a lens alone in ", "file_scale"));
            }
            (None, Some([position, look_at, up])) => {
                let fov = FieldOfView::Photograph;
                let camera = Camera::look_at(position, look_at, up, fov, resolution);
                Pose {
                    position: position.as_dvec3(),
                    rotation: camera.rotation.as_dmat3(),
                }
            }
            (None, None) => {
                return Err(Error::Missing {
                    key: "scene.camera.position".into(),
                    remedy: format!(
                        "\"{}\" describes a lens alone: write position and look_at, or pitch_deg, too",
                        self.path.display()
                    ),
                });
            }
        };
        // Comparisons of NaN, of a scale that overflows, fail.
        if !pose
            .position
            .abs()
            .cmple(DVec3::splat(FARTHEST_M.into()))
            .all()
        {
            return Err(Error::Config {
                key: format!("scene.camera.{}", self.key),
                value: format!("a camera at {} metres", pose.position),
                accepted: "one at most ten million metres from the origin; file_scale is metres of a unit of the file"
                    .into(),
            });
        }
        Ok(pose)
    }
}

/// The files that a camera's `path` stands for, as the configuration would name them: itself, or those
/// of COLMAP's model.
pub fn parts(path: &Path, base_dir: &Path) -> Vec<PathBuf> {
    let parts = file::parts(&base_dir.join(path));
    parts
        .iter()
        .map(|part| named(part, path, base_dir))
        .collect()
}

/// `part`, a file that `path` of the configuration stands for, as the configuration would name it.
pub(crate) fn named(part: &Path, path: &Path, base_dir: &Path) -> PathBuf {
    let whole = base_dir.join(path);
    match part.strip_prefix(&whole) {
        _ if part == whole => path.into(),
        Ok(inside) => path.join(inside),
        // A file beside the named one, or one that is found from its folder.
        Err(_) => match whole.parent().map(|folder| part.strip_prefix(folder)) {
            Some(Ok(beside)) => path.with_file_name(beside),
            _ => part.into(),
        },
    }
}
