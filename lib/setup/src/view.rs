//! The camera of a photograph: what its file says, what the picture shows, and defaults.
use std::path::PathBuf;

use dipir_calibration::{CameraEstimate, CameraEstimator, Evidence, KnownFocal};
use dipir_cameras::WorldUp;
use dipir_imaging::facts::{Facts, FocalSource};
use dipir_imaging::raster::LinearImage;
use dipir_scene::camera::Camera;
use dipir_scene::proxy::Plane;
use glam::{DMat3, DVec2, DVec3, Vec2, Vec3};

use crate::error::SetupError;
use crate::turn::{self, Turn};

/// How a camera is turned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Aim {
    /// From looking along -z.
    Turned {
        /// Upwards.
        pitch_deg: f64,
        /// Clockwise about the line of sight.
        roll_deg: f64,
    },
    /// By what it sees.
    At {
        /// The point in the centre of the image, metres.
        look_at: DVec3,
        /// What is up in the image.
        up: DVec3,
    },
}

/// A camera over a level ground, and why it is this one.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Centre of projection, metres.
    pub position: DVec3,
    /// How it is turned.
    pub aim: Aim,
    /// Vertical field of view, degrees.
    pub fov_deg: f64,
    /// Where the optical axis meets the image, pixels; its middle if absent.
    pub principal_px: Option<DVec2>,
    /// Height of the ground, metres.
    pub ground_y: f64,
    /// The file that says more of the camera than is said here.
    pub file: Option<CameraFile>,
    /// Where the position comes from.
    pub position_why: String,
    /// Where the turn comes from.
    pub aim_why: String,
    /// Where the field of view comes from.
    pub fov_why: String,
}

/// A file that is named in place of what it says.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraFile {
    /// The file.
    pub path: PathBuf,
    /// Which axis of its world points up, if that was asked for.
    pub up: Option<WorldUp>,
    /// Vertical field of view, degrees, if the file has none.
    pub fov_deg: Option<f64>,
    /// Which of its cameras, by name and by number, as far as that was asked for.
    pub image: Option<String>,
    /// See `image`.
    pub frame: Option<u32>,
    /// What of it numbers would not say.
    pub why: &'static str,
}

/// Height of the eyes of somebody who stands, metres.
pub const EYE_HEIGHT_M: f64 = 1.6;
/// Field of view along the longer side where the picture does not state it, degrees.
pub const DEFAULT_FOV_DEG: f64 = 55.0;
/// Half width of the 90% interval, relative, up to which the field of view that the picture shows is used.
const MOST_FOV_HALF: f64 = 0.35;
/// Longer over shorter side above which a picture is not a camera's own frame: the longest, of 65 x 24 mm, has 2.71.
const MOST_ASPECT: f64 = 2.75;
/// Standard deviation of a focal length that Exif data say of a longer picture, relative. A strip of 4:1, cut out of a
/// frame of 4:3, has a diagonal that is 18% shorter than the frame's, by which the focal length for 35 mm counts.
const STRIP_SIGMA: f64 = 0.2;

impl Default for View {
    /// Level, at the height of the eyes, 40 degrees.
    fn default() -> Self {
        Self {
            position: DVec3::new(0.0, EYE_HEIGHT_M, 0.0),
            aim: Aim::Turned {
                pitch_deg: 0.0,
                roll_deg: 0.0,
            },
            fov_deg: 40.0,
            principal_px: None,
            ground_y: 0.0,
            file: None,
            position_why: String::new(),
            aim_why: String::new(),
            fov_why: String::new(),
        }
    }
}

/// Options of the command line for the camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraOptions {
    /// Field of view along the longer side, degrees.
    pub fov_deg: Option<f64>,
    /// Upwards, degrees.
    pub pitch_deg: Option<f64>,
    /// Metres over the ground.
    pub eye_height_m: Option<f64>,
}

impl CameraOptions {
    /// Errors on values that no camera has.
    ///
    /// # Errors
    /// The first option that is wrong, with the accepted form.
    pub fn check(&self) -> Result<(), SetupError> {
        let checks = [
            (
                "--fov",
                self.fov_deg,
                1.0..=170.0,
                "degrees along the longer side from 1 to 170, for instance --fov 65",
            ),
            (
                "--pitch",
                self.pitch_deg,
                -89.0..=89.0,
                "degrees upwards from -89 to 89, for instance --pitch -10",
            ),
            (
                "--eye-height",
                self.eye_height_m,
                0.01..=1e4,
                "metres over the ground from 0.01 to 10000, for instance --eye-height 1.6",
            ),
        ];
        for (option, value, range, accepted) in checks {
            if let Some(value) = value
                && !range.contains(&value)
            {
                return Err(SetupError::Value {
                    option,
                    value: value.to_string(),
                    accepted,
                });
            }
        }
        Ok(())
    }
}

impl View {
    /// The camera of a photograph, from what is asked, its data and what it shows, and a warning if the
    /// picture seems to show no ground.
    ///
    /// # Errors
    /// As [`CameraOptions::check`], and on weights of another version in the program.
    pub fn of_photo(
        image: &LinearImage,
        facts: &Facts,
        asked: &CameraOptions,
    ) -> Result<(Self, Option<String>), SetupError> {
        asked.check()?;
        let size = [image.0.width() as f64, image.0.height() as f64];
        let (lens, turn) = lens_and_turn(image, size, facts, asked)?;
        let (eye, position_why) = match asked.eye_height_m {
            Some(height) => (height, "as --eye-height says"),
            None => (
                EYE_HEIGHT_M,
                "a guess: the eyes of somebody who stands; with twice the height everything on \
                 the ground is twice as large and as far",
            ),
        };
        let view = Self {
            position: DVec3::new(0.0, eye, 0.0),
            aim: turn.aim,
            fov_deg: rounded(2.0 * (0.5 * size[1] / lens.focal_px).atan().to_degrees()),
            aim_why: turn.why,
            position_why: position_why.into(),
            fov_why: lens.why,
            ..Self::default()
        };
        Ok((view, turn.warning))
    }

    /// The camera for a picture of this size.
    pub fn camera(&self, resolution: [u32; 2]) -> Camera {
        let rotation = match self.aim {
            Aim::Turned {
                pitch_deg,
                roll_deg,
            } => {
                DMat3::from_rotation_x(pitch_deg.to_radians())
                    * DMat3::from_rotation_z(-roll_deg.to_radians())
            }
            Aim::At { look_at, up } => {
                let backward = (self.position - look_at).normalize();
                let right = up.cross(backward).normalize();
                DMat3::from_cols(right, backward.cross(right), backward)
            }
        };
        let [w, h] = resolution.map(f64::from);
        let focal = 0.5 * h / (0.5 * self.fov_deg.to_radians()).tan();
        let principal = self.principal_px.unwrap_or(0.5 * DVec2::new(w, h));
        Camera {
            position: self.position.as_vec3(),
            rotation: rotation.as_mat3(),
            focal_px: Vec2::splat(focal as f32),
            principal_px: principal.as_vec2(),
            resolution,
        }
    }

    /// The ground.
    pub fn plane(&self) -> Plane {
        Plane {
            point: Vec3::new(0.0, self.ground_y as f32, 0.0),
            normal: Vec3::Y,
        }
    }
}

/// To a hundredth, which is what a file that is read by people should say.
pub(crate) fn rounded(value: f64) -> f64 {
    (value * 100.0).round() / 100.0
}

/// A focal length and how sure it is.
struct Lens {
    focal_px: f64,
    /// One standard deviation, relative.
    sigma: f64,
    why: String,
}

impl Lens {
    /// As it is asked for, or as the photograph's data say.
    fn known(size: [f64; 2], facts: &Facts, asked_deg: Option<f64>) -> Option<Self> {
        if let Some(deg) = asked_deg {
            return Some(Self {
                focal_px: focal_px(size, deg),
                sigma: 0.02,
                why: format!("--fov says {deg} degrees along the longer side"),
            });
        }
        let known = facts.focal_px.filter(|f| f.is_finite() && *f > 0.0);
        let (focal_px, source) = known.zip(facts.focal_source)?;
        let (sigma, from) = match source {
            FocalSource::Equivalent35mm => (0.02, "the focal length for 35 mm"),
            FocalSource::FocalPlaneResolution => {
                (0.02, "the focal length and the sensor's resolution")
            }
            FocalSource::Table => (0.05, "the focal length and a table of sensors"),
        };
        let (sigma, sure) = match aspect(size) > MOST_ASPECT {
            true => (
                STRIP_SIGMA,
                "which is wrong of a panorama or a strip; or --fov".into(),
            ),
            false => (sigma, format!("sure to about {:.0}%", 100.0 * sigma)),
        };
        let millimetres = match facts.focal_mm {
            Some(mm) => format!(" (the lens has {mm} mm)"),
            None => String::new(),
        };
        Some(Self {
            focal_px,
            sigma,
            why: format!("from {from} in the photograph's Exif data{millimetres}, {sure}"),
        })
    }

    /// As the picture shows it, or a guess.
    fn shown(size: [f64; 2], seen: &CameraEstimate) -> Self {
        let fov = seen.fov_deg;
        let range = format!(
            "{:.0} to {:.0} degrees along the longer side (90%)",
            fov.low, fov.high
        );
        let told = fov.half_width() <= MOST_FOV_HALF * fov.middle;
        let (deg, why) = match told {
            true => (
                fov.middle,
                format!(
                    "from the picture itself, for the photograph's data do not say it: {range}; \
                     or --fov"
                ),
            ),
            false => (
                DEFAULT_FOV_DEG,
                format!(
                    "a guess, for the photograph does not say it: {DEFAULT_FOV_DEG} degrees along \
                     the longer side, where the picture itself tells {range}; telephones have 60 \
                     to 75, a zoom less; or --fov"
                ),
            ),
        };
        Self {
            focal_px: focal_px(size, deg),
            sigma: 0.1,
            why,
        }
    }

    fn relative(&self, size: [f64; 2]) -> KnownFocal {
        KnownFocal {
            relative: self.focal_px / size[0].max(size[1]),
            sigma: self.sigma,
        }
    }
}

/// Longer over shorter side.
fn aspect([width, height]: [f64; 2]) -> f64 {
    width.max(height) / width.min(height)
}

/// A warning if a picture is longer than a camera's own frame, and its field of view is not asked for.
pub(crate) fn strip(facts: &Facts, asked: &CameraOptions) -> Option<String> {
    let size = facts.size.map(f64::from);
    let aspect = aspect(size);
    (aspect > MOST_ASPECT && asked.fov_deg.is_none()).then(|| {
        let sides = if size[0] > size[1] { "wide as high" } else { "high as wide" };
        format!(
            "the photograph is {aspect:.1} times as {sides}, as panoramas are: their Exif data say the field of view of one \
             frame, and their lines are bent, which those of the objects will not be. Take the part around the objects \
             alone, and its angle: --fov 60 for a third of a panorama of 180 degrees"
        )
    })
}

/// The focal length that sees this angle along the longer side.
fn focal_px(size: [f64; 2], fov_deg: f64) -> f64 {
    0.5 * size[0].max(size[1]) / (0.5 * fov_deg.to_radians()).tan()
}

/// Lens and turn, and why.
fn lens_and_turn(
    image: &LinearImage,
    size: [f64; 2],
    facts: &Facts,
    asked: &CameraOptions,
) -> Result<(Lens, Turn), SetupError> {
    let known = Lens::known(size, facts, asked.fov_deg);
    let estimator = CameraEstimator::embedded()?;
    let evidence = Evidence::new(image);
    let lens = known.unwrap_or_else(|| Lens::shown(size, &estimator.weighed(&evidence, None)));
    let turn = match asked.pitch_deg {
        Some(pitch) => Turn {
            aim: turn::turned(pitch, 0.0),
            why: "as --pitch says".into(),
            warning: None,
        },
        // The turn belongs to the focal length that the file will say.
        None => turn::shown(
            size,
            lens.focal_px,
            &estimator.weighed(&evidence, Some(lens.relative(size))),
        ),
    };
    Ok((lens, turn))
}

#[cfg(test)]
mod tests {
    use dipir_imaging::raster::Raster;
    use dipir_scene::pixels::horizon_row;

    use super::*;

    fn grey(w: usize, h: usize) -> LinearImage {
        LinearImage(Raster::filled(w, h, Vec3::splat(0.2)))
    }

    #[test]
    fn a_picture_that_tells_nothing_gets_the_defaults_and_is_told_so() {
        for [w, h] in [[900, 600], [600, 900]] {
            let facts = Facts::of_size([w as u32, h as u32]);
            let asked = CameraOptions::default();
            let (view, warning) = View::of_photo(&grey(w, h), &facts, &asked).unwrap();
            assert_eq!(warning, None);
            let camera = view.camera([w as u32, h as u32]);
            // The pitch is rounded to a hundredth of a degree: .08 pixels at a focal length of 900 pixels.
            let row = horizon_row(&camera, &view.plane(), 0.5 * w as f64).unwrap();
            assert!((row - 0.4 * h as f64).abs() < 0.2, "{row}");
            let longer = f64::from(camera.focal_px.x) / w.max(h) as f64;
            let fov = 2.0 * (0.5 / longer).atan().to_degrees();
            assert!((fov - DEFAULT_FOV_DEG).abs() < 0.02, "{fov}");
            assert!(view.fov_why.starts_with("a guess") && view.aim_why.starts_with("a guess"));
            assert_eq!(view.position, DVec3::new(0.0, 1.6, 0.0));
        }
    }

    #[test]
    fn a_picture_longer_than_a_frame_is_warned_of_and_its_focal_length_is_not_called_sure() {
        let facts = |size: [u32; 2]| Facts {
            focal_px: Some(800.0),
            focal_source: Some(FocalSource::Equivalent35mm),
            ..Facts::of_size(size)
        };
        let asked = CameraOptions::default();
        let why = |[w, h]: [u32; 2]| {
            let picture = grey(w as usize, h as usize);
            View::of_photo(&picture, &facts([w, h]), &asked)
                .unwrap()
                .0
                .fov_why
        };
        // Frames of 4:3, 21:9 and 65:24 are cameras' own.
        for size in [[400, 300], [933, 400], [650, 240], [240, 650]] {
            assert_eq!(strip(&facts(size), &asked), None, "{size:?}");
            assert!(why(size).contains("sure to about 2%"));
        }
        for (size, sides) in [
            ([900, 300], "3.0 times as wide as high"),
            ([300, 1200], "4.0 times as high as wide"),
        ] {
            let said = strip(&facts(size), &asked).unwrap();
            assert!(said.contains(sides) && said.contains("--fov"), "{said}");
            assert!(why(size).contains("wrong of a panorama") && !why(size).contains("sure"));
            let told = CameraOptions {
                fov_deg: Some(60.0),
                ..asked
            };
            assert_eq!(strip(&facts(size), &told), None);
        }
    }

    #[test]
    fn the_photograph_s_focal_length_and_what_is_asked_come_first() {
        let facts = Facts {
            focal_px: Some(800.0),
            focal_source: Some(FocalSource::Equivalent35mm),
            ..Facts::of_size([900, 600])
        };
        let mut asked = CameraOptions {
            pitch_deg: Some(-12.5),
            eye_height_m: Some(3.0),
            ..CameraOptions::default()
        };
        let (view, _) = View::of_photo(&grey(900, 600), &facts, &asked).unwrap();
        let focal = view.camera([900, 600]).focal_px.x;
        // A hundredth of a degree of 41.
        assert!((focal - 800.0).abs() < 0.3, "{focal}");
        let pitch_deg = -12.5;
        let roll_deg = 0.0;
        assert_eq!(
            view.aim,
            Aim::Turned {
                pitch_deg,
                roll_deg
            }
        );
        assert_eq!(view.position.y, 3.0);
        asked.fov_deg = Some(90.0);
        let (view, _) = View::of_photo(&grey(900, 600), &facts, &asked).unwrap();
        let focal = view.camera([900, 600]).focal_px.x;
        assert!((focal - 450.0).abs() < 0.2, "{focal}");
    }

    #[test]
    fn options_that_no_camera_has_are_refused_by_name() {
        let refused = |asked: CameraOptions| asked.check().unwrap_err().to_string();
        let fov_deg = Some(180.0);
        let pitch_deg = Some(f64::NAN);
        let eye_height_m = Some(-1.0);
        let default = CameraOptions::default();
        assert!(
            refused(CameraOptions { fov_deg, ..default })
                .starts_with("--fov is 180; accepted: degrees")
        );
        assert!(
            refused(CameraOptions {
                pitch_deg,
                ..default
            })
            .starts_with("--pitch is NaN")
        );
        assert!(
            refused(CameraOptions {
                eye_height_m,
                ..default
            })
            .starts_with("--eye-height is -1")
        );
    }
}
