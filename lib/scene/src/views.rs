//! Other photographs of the scene's place.
use std::borrow::Cow;
use std::path::{Path, PathBuf};

use dipir_cameras::Lens;
use dipir_imaging::file::{Photo, read_photo_within};
use dipir_imaging::raster::LinearImage;
use dipir_imaging::transfer::Transfer;
use glam::DVec2;

use crate::camera::{Camera, CameraSettings, FieldOfView};
use crate::config::ViewConfig;
use crate::error::Error;
use crate::limits::Limits;
use crate::undistortion::Undistortion;

/// A checked `[[scene.views]]` table.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewSettings {
    /// The key of its photograph: `scene.views[0].background`.
    pub key: String,
    /// As written, with what it takes from `[scene.camera]`.
    pub config: ViewConfig,
    /// The photograph, as written.
    pub background: PathBuf,
    /// Its exposure over that of the scene's photograph, stops, if that is written.
    pub exposure_stops: Option<f64>,
    /// Whether it is known where the camera stands, beside where it looks.
    pub is_placed: bool,
    pub(crate) camera: CameraSettings,
    pub(crate) transfer: Transfer,
    pub(crate) limits: Limits,
}

/// A photograph with its camera.
#[derive(Clone, Debug)]
pub struct View {
    /// As it was taken.
    pub taken: Photo,
    /// In linear light; undistorted, if its lens bends lines.
    pub image: LinearImage,
    /// The camera of `image`.
    pub camera: Camera,
    undistortion: Option<Undistortion>,
}

impl View {
    /// `image` with the photograph's gain map, where it has one: light above white ([`Photo::radiance`]).
    pub fn radiance(&self) -> Cow<'_, LinearImage> {
        match (self.taken.radiance(), &self.undistortion) {
            (Cow::Borrowed(_), _) => Cow::Borrowed(&self.image),
            (Cow::Owned(brighter), None) => Cow::Owned(brighter),
            (Cow::Owned(brighter), Some(way)) => {
                Cow::Owned(LinearImage(way.undistort(&brighter.0)))
            }
        }
    }
}

impl ViewSettings {
    /// The files of its camera, as the configuration would name them.
    pub fn camera_files(&self, base_dir: &Path) -> Vec<PathBuf> {
        match &self.camera {
            CameraSettings::File(file) => file.parts(base_dir),
            CameraSettings::LookAt { .. } => Vec::new(),
        }
    }

    /// Looks for its camera without reading the photograph, relative to `base_dir`.
    ///
    /// # Errors
    /// If the camera's file has none for the photograph.
    pub fn check_camera(&self, base_dir: &Path) -> Result<(), Error> {
        match &self.camera {
            CameraSettings::File(file) => file.check(base_dir),
            CameraSettings::LookAt { .. } => Ok(()),
        }
    }

    /// Reads the photograph and its camera, relative to `base_dir`. `scene_lens` is that of the scene's
    /// photograph as it was taken.
    ///
    /// # Errors
    /// On files that cannot be used, and a focal length without a sensor.
    pub fn load(&self, base_dir: &Path, scene_lens: &Lens) -> Result<View, Error> {
        let path = base_dir.join(&self.background);
        let taken = read_photo_within(path, self.transfer, self.limits.photo())?;
        let resolution = [taken.image.0.width() as u32, taken.image.0.height() as u32];
        let (camera, undistortion) = self
            .with_lens(&taken, scene_lens)
            .with_facts(&taken.facts)
            .and_then(|c| c.resolve(resolution, base_dir))
            .map_err(|e| e.moved("scene.camera", &self.key.replace("background", "camera")))?;
        let image = match &undistortion {
            Some(undistortion) => LinearImage(undistortion.undistort(&taken.image.0)),
            None => taken.image.clone(),
        };
        Ok(View {
            taken,
            image,
            camera,
            undistortion,
        })
    }

    /// The camera with the scene's field of view, if neither the table nor the photograph tells one.
    fn with_lens(&self, photo: &Photo, scene_lens: &Lens) -> CameraSettings {
        let mut camera = self.camera.clone();
        if let CameraSettings::LookAt {
            field_of_view,
            distortion,
            ..
        } = &mut camera
            && *field_of_view == FieldOfView::Photograph
            && photo.facts.field_of_view_rad().is_none()
        {
            let image = &photo.image.0;
            let (own, scene) = (
                image.width() as f64 - image.height() as f64,
                scene_lens.size,
            );
            // The same camera, held upright for one of the two: its width sees what is the other's height.
            let side = usize::from(own * (scene[0] - scene[1]) >= 0.0);
            let angle_rad = field_of_view_rad(scene_lens, side, distortion.is_fisheye());
            *field_of_view = FieldOfView::Vertical(angle_rad as f32);
        }
        camera
    }
}

/// The field of view of a lens along its width (side 0) or height (1), radians: what counts as that of a fisheye, or of a
/// lens that is none.
fn field_of_view_rad(lens: &Lens, side: usize, fisheye: bool) -> f64 {
    let half = 0.5 * lens.size[side] / lens.focal_px[side];
    let bent = lens.distortion.direction(DVec2::AXES[side] * half);
    let half_rad = match bent.filter(|_| fisheye) {
        Some(direction) => direction[side].atan2(direction.z),
        None => half.atan(),
    };
    2.0 * half_rad
}
