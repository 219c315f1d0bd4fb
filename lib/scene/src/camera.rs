//! A pinhole camera that looks down its own -z.
mod of_file;

use std::path::Path;

use dipir_cameras::{Distortion, Lens, Pose};
use dipir_imaging::facts::Facts;
use glam::{DMat3, DVec3, Mat3, Vec2, Vec3};
use serde::{Deserialize, Serialize};

use crate::error::Error;
use crate::undistortion::Undistortion;

pub use dipir_cameras::WorldUp;
pub(crate) use of_file::named;
pub use of_file::{FileSettings, Which, parts};

/// A ray with a unit direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Start, metres.
    pub origin: Vec3,
    /// Unit vector.
    pub direction: Vec3,
}

/// A pinhole camera. Pixel (0, 0) is top left; pixel centres lie at half-integers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Centre of projection, metres.
    pub position: Vec3,
    /// Columns: the camera's right, up and backward axes in world space (orthonormal).
    pub rotation: Mat3,
    /// Focal length over pixel pitch, horizontally and vertically, pixels.
    pub focal_px: Vec2,
    /// Where the optical axis meets the image, pixels from the top left corner.
    pub principal_px: Vec2,
    /// Image width and height, pixels.
    pub resolution: [u32; 2],
}

impl Camera {
    /// The ray through the continuous image position `pixel` (column, row), in pixels.
    pub fn ray(&self, pixel: Vec2) -> Ray {
        let d = (pixel - self.principal_px) / self.focal_px;
        Ray {
            origin: self.position,
            direction: (self.rotation * Vec3::new(d.x, -d.y, -1.0)).normalize(),
        }
    }

    /// The image position of `point`, or `None` if it does not lie in front of the camera.
    pub fn project(&self, point: Vec3) -> Option<Vec2> {
        let c = self.rotation.transpose() * (point - self.position);
        (c.z < 0.0).then(|| self.principal_px + self.focal_px * Vec2::new(c.x / -c.z, -c.y / -c.z))
    }
}

impl Camera {
    /// Distance of `point` along the optical axis, metres; negative behind the camera.
    pub fn depth(&self, point: Vec3) -> f32 {
        (point - self.position).dot(-self.rotation.z_axis)
    }

    /// The same view with `resolution` pixels, which need not have the same shape: the whole image
    /// is stretched.
    pub fn scaled(&self, resolution: [u32; 2]) -> Self {
        let side = |k: usize| resolution[k] as f32 / self.resolution[k] as f32;
        let scale = Vec2::new(side(0), side(1));
        Self {
            focal_px: self.focal_px * scale,
            principal_px: self.principal_px * scale,
            resolution,
            ..*self
        }
    }
}

/// How wide the camera sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FieldOfView {
    /// Vertical angle, radians, in `(0, pi)`.
    Vertical(f32),
    /// A lens and the width of the sensor behind it, millimetres.
    Lens {
        /// Focal length.
        focal_mm: f32,
        /// Width of the upright picture on the sensor.
        sensor_mm: f32,
    },
    /// A lens before the sensor that the photograph's own data tell of, millimetres; without such
    /// data before one of 36 mm.
    Focal(f32),
    /// What the photograph's own data tell; without such data as a lens of 35 mm before a sensor
    /// of 36 mm.
    Photograph,
}

impl Camera {
    /// A camera at `position` with `look_at` in the middle of its image.
    pub fn look_at(
        position: Vec3,
        look_at: Vec3,
        up: Vec3,
        field_of_view: FieldOfView,
        resolution: [u32; 2],
    ) -> Self {
        let backward = (position - look_at).as_dvec3().normalize();
        let right = up.as_dvec3().cross(backward).normalize();
        let [w, h] = resolution.map(|n| n as f32);
        let focal = match field_of_view {
            FieldOfView::Vertical(angle_rad) => 0.5 * h / (0.5 * angle_rad).tan(),
            FieldOfView::Lens {
                focal_mm,
                sensor_mm,
            } => focal_mm / sensor_mm * w,
            FieldOfView::Focal(focal_mm) => focal_mm / 36.0 * w,
            FieldOfView::Photograph => 35.0 / 36.0 * w,
        };
        Self {
            position,
            rotation: DMat3::from_cols(right, backward.cross(right), backward).as_mat3(),
            focal_px: Vec2::splat(focal),
            principal_px: Vec2::new(0.5 * w, 0.5 * h),
            resolution,
        }
    }
}

impl CameraSettings {
    /// The same settings with what the photograph's own data say put in: the field of view, or the
    /// width of the sensor behind a focal length. An error if it is wanted and the photograph does
    /// not say it.
    pub fn with_facts(&self, facts: &Facts) -> Result<Self, Error> {
        let mut settings = self.clone();
        let field_of_view = match &mut settings {
            Self::LookAt { field_of_view, .. } => field_of_view,
            Self::File(file) => {
                file.orientation = facts.orientation;
                return Ok(settings);
            }
        };
        match *field_of_view {
            FieldOfView::Focal(focal_mm) => {
                let Some(sensor_mm) = facts.sensor_width_mm() else {
                    return Err(Error::Missing {
                        key: "scene.camera.sensor_mm".into(),
                        remedy: "the photograph does not say which sensor took it: write how wide the upright picture is on the sensor, for instance sensor_mm = 36.0, or 24.0 for a portrait".into(),
                    });
                };
                *field_of_view = FieldOfView::Lens {
                    focal_mm,
                    sensor_mm: sensor_mm as f32,
                };
            }
            FieldOfView::Photograph => {
                let Some([_, vertical]) = facts.field_of_view_rad() else {
                    return Err(Error::Missing {
                        key: "scene.camera.fov_deg".into(),
                        remedy: "the photograph does not say it: write the vertical field of view, fov_deg = 40.0, or focal_mm with sensor_mm".into(),
                    });
                };
                *field_of_view = FieldOfView::Vertical(vertical as f32);
            }
            FieldOfView::Vertical(_) | FieldOfView::Lens { .. } => {}
        }
        Ok(settings)
    }

    /// The camera of a photo of `resolution`, and what undoes its lens's distortion if it has one; then
    /// the camera is that of the undistorted picture. Files are found relative to `base_dir`.
    pub fn resolve(
        &self,
        resolution: [u32; 2],
        base_dir: &Path,
    ) -> Result<(Camera, Option<Undistortion>), Error> {
        match self {
            Self::LookAt {
                position,
                look_at,
                up,
                field_of_view,
                principal_px,
                distortion,
            } => {
                let mut camera =
                    Camera::look_at(*position, *look_at, *up, *field_of_view, resolution);
                camera.principal_px = principal_px.unwrap_or(camera.principal_px);
                if distortion.is_none() {
                    return Ok((camera, None));
                }
                if let FieldOfView::Vertical(angle_rad) = field_of_view {
                    let height_px = f64::from(resolution[1]);
                    let focal_px = distorted_focal(distortion, *angle_rad, height_px)?;
                    camera.focal_px = focal_px.map_or(camera.focal_px, |f| Vec2::splat(f as f32));
                }
                let pose = Pose {
                    position: camera.position.as_dvec3(),
                    rotation: camera.rotation.as_dmat3(),
                };
                let lens = Lens {
                    principal_px: camera.principal_px.as_dvec2(),
                    distortion: *distortion,
                    ..Lens::pinhole(resolution.map(f64::from), camera.focal_px.as_dvec2())
                };
                Ok(of_lens(&pose, &lens, resolution))
            }
            Self::File(file) => file.resolve(resolution, base_dir),
        }
    }
}

/// The focal length of a fisheye with this vertical field of view, pixels. `None` for other lenses, whose field of view
/// counts without distortion. An error if the fisheye does not see so far.
fn distorted_focal(
    distortion: &Distortion,
    angle_rad: f32,
    height_px: f64,
) -> Result<Option<f64>, Error> {
    if !distortion.is_fisheye() {
        return Ok(None);
    }
    let (sin, cos) = (0.5 * f64::from(angle_rad)).sin_cos();
    let image = distortion.image(DVec3::new(0.0, sin, cos));
    match image.filter(|at| at.y > 0.0) {
        Some(at) => Ok(Some(0.5 * height_px / at.y)),
        None => Err(Error::Config {
            key: "scene.camera.fov_deg".into(),
            value: format!("{:.1}", angle_rad.to_degrees()),
            accepted:
                "a field of view that the fisheye's distortion reaches before its curve turns \
                       back; or the focal length, as in fx = 800"
                    .into(),
        }),
    }
}

fn of_lens(pose: &Pose, lens: &Lens, resolution: [u32; 2]) -> (Camera, Option<Undistortion>) {
    if let Some(undistortion) = Undistortion::of(lens) {
        return (undistortion.camera(pose), Some(undistortion));
    }
    let camera = Camera {
        position: pose.position.as_vec3(),
        rotation: pose.rotation.as_mat3(),
        focal_px: lens.focal_px.as_vec2(),
        principal_px: lens.principal_px.as_vec2(),
        resolution,
    };
    (camera, None)
}

/// Largest coordinate of a camera, metres: half way around the earth.
pub(crate) const FARTHEST_M: f32 = 1e7;

/// The checked `[scene.camera]` table.
#[derive(Clone, Debug, PartialEq)]
pub enum CameraSettings {
    /// A camera by where it stands and what it looks at.
    LookAt {
        /// Centre of projection, metres.
        position: Vec3,
        /// The point in the centre of the image, metres.
        look_at: Vec3,
        /// What is up in the image; not parallel to the line of sight.
        up: Vec3,
        /// How wide it sees.
        field_of_view: FieldOfView,
        /// Where the optical axis meets the image, pixels; its middle if absent.
        principal_px: Option<Vec2>,
        /// How the lens bends lines.
        distortion: Distortion,
    },
    /// A camera in another program's file.
    File(FileSettings),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_files_of_a_model_are_named_as_the_configuration_would() {
        let folder = tempfile::tempdir().unwrap();
        let model = folder.path().join("shots/sparse/0");
        std::fs::create_dir_all(&model).unwrap();
        std::fs::write(model.join("cameras.txt"), "").unwrap();
        for path in ["shots", "shots/sparse/0", "shots/sparse/0/images.txt"] {
            let want = ["cameras.txt", "images.txt"].map(|n| Path::new("shots/sparse/0").join(n));
            assert_eq!(parts(Path::new(path), folder.path()), want, "{path}");
        }
        assert_eq!(
            parts(Path::new("calib.txt"), folder.path()),
            [Path::new("calib.txt")]
        );
        let points = crate::ground::points_parts(Path::new("shots"), None, folder.path());
        assert_eq!(points, [Path::new("shots/sparse/0/points3D.txt")]);
    }

    #[test]
    fn a_focal_length_alone_is_enough_where_the_photograph_knows_its_sensor() {
        let settings = CameraSettings::LookAt {
            position: Vec3::Z,
            look_at: Vec3::ZERO,
            up: Vec3::Y,
            field_of_view: FieldOfView::Focal(50.0),
            principal_px: None,
            distortion: Distortion::NONE,
        };
        let mut facts = Facts::of_size([600, 400]);
        let error = settings.with_facts(&facts).unwrap_err().to_string();
        assert!(
            error.starts_with("scene.camera.sensor_mm is missing"),
            "{error}"
        );
        facts.sensor_mm = Some([24.0, 16.0]);
        let known = settings.with_facts(&facts).unwrap();
        let (camera, _) = known.resolve([600, 400], Path::new("")).unwrap();
        assert_eq!(camera.focal_px, Vec2::splat(1250.0));
    }

    #[test]
    fn a_photograph_that_knows_its_focal_length_is_enough() {
        let settings = CameraSettings::LookAt {
            position: Vec3::Z,
            look_at: Vec3::ZERO,
            up: Vec3::Y,
            field_of_view: FieldOfView::Photograph,
            principal_px: Some(Vec2::new(310.0, 190.0)),
            distortion: Distortion::NONE,
        };
        let mut facts = Facts::of_size([600, 400]);
        let error = settings.with_facts(&facts).unwrap_err().to_string();
        assert!(
            error.starts_with("scene.camera.fov_deg is missing"),
            "{error}"
        );
        facts.focal_px = Some(500.0);
        let known = settings.with_facts(&facts).unwrap();
        let (camera, _) = known.resolve([600, 400], Path::new("")).unwrap();
        // An angle of single precision and back: a few roundings of 500.
        assert!((camera.focal_px - Vec2::splat(500.0)).abs().max_element() < 1e-3);
        assert_eq!(camera.principal_px, Vec2::new(310.0, 190.0));
    }

    #[test]
    fn a_scaled_camera_sees_the_same_directions_at_scaled_pixels() {
        let mut camera = Camera::look_at(
            Vec3::new(1.0, 2.0, 3.0),
            Vec3::new(-0.4, 0.3, 0.1),
            Vec3::Y,
            FieldOfView::Vertical(0.7),
            [640, 427],
        );
        // An optical axis off the middle and pixels that are not square.
        camera.principal_px += Vec2::new(13.0, -7.0);
        camera.focal_px.x *= 1.25;
        // Smaller, larger, of another shape, a single pixel.
        for resolution in [[320, 214], [1280, 854], [200, 900], [1, 1], [640, 427]] {
            let scaled = camera.scaled(resolution);
            assert_eq!(scaled.resolution, resolution);
            let scale = Vec2::new(resolution[0] as f32 / 640.0, resolution[1] as f32 / 427.0);
            for share in [Vec2::ZERO, Vec2::ONE, Vec2::new(0.3, 0.8)] {
                let pixel = share * Vec2::new(640.0, 427.0);
                let (own, other) = (camera.ray(pixel), scaled.ray(pixel * scale));
                // Roundings of a few pixels' coordinates, over focal lengths of their size.
                assert!(
                    own.direction.distance(other.direction) < 1e-6,
                    "{resolution:?}"
                );
                assert_eq!(own.origin, other.origin);
            }
            let point = Vec3::new(0.2, 0.5, -0.3);
            let (own, other) = (camera.project(point), scaled.project(point));
            let apart = own.expect("in front") * scale - other.expect("in front");
            let size = Vec2::new(resolution[0] as f32, resolution[1] as f32);
            assert!((apart / size).abs().max_element() < 1e-6, "{apart}");
        }
    }
}
