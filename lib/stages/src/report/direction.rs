//! Where most of the light comes from, drawn onto the photograph: an arrow on the ground and a disc in the sky.
use dipir_estimator::LightEstimate;
use dipir_estimator::grid::{direction, heading, relative};
use dipir_estimator::posterior::words;
use dipir_scene::camera::Camera;
use dipir_scene::description::SceneDescription;
use glam::{Quat, Vec2, Vec3};

use super::html::Html;
use super::picture::image;
use super::{Report, Section};
use crate::names::SCENE;

/// Longest side of the photograph as it is shown.
const SHOWN: usize = 640;
/// Degrees between the corners of the sector of azimuths.
const STEP_DEG: f64 = 5.0;
/// Sizes of the arrow that are tried, each this share of the one before, until it lies in the picture.
const SMALLER: f32 = 0.85;
/// And how many.
const SIZES: i32 = 16;
/// Half the angle of the disc in the sky, degrees. The sun's own would be hard to see.
const DISC_DEG: f32 = 1.2;

/// The photograph with the direction of `towards`, which points from the scene to the light, and with the azimuths
/// that `estimate` leaves open. `truth` is the true direction, where it is known.
pub fn figure(
    report: &Report,
    towards: Vec3,
    estimate: Option<&LightEstimate>,
    truth: Option<Vec3>,
) -> Section {
    let Some((folder, manifest)) = report.stage(SCENE.name)? else {
        return Ok(None);
    };
    let description = SceneDescription::read(&manifest.output(&folder, "scene")?)?;
    let loaded = description.load(&report.session.config.base_dir())?;
    let Some((low, high)) = loaded.scene.mesh.bounds() else {
        return Ok(None);
    };
    let ground = Ground {
        camera: loaded.scene.camera,
        foot: Vec3::new(0.5 * (low.x + high.x), low.y, 0.5 * (low.z + high.z)),
        radius: (0.5 * (high - low).length()).max(0.05),
    };
    let mut drawn = Vec::new();
    if let Some(estimate) = estimate {
        drawn.extend(ground.sector(estimate));
    }
    drawn.extend(ground.arrow(towards, "towards"));
    drawn.extend(ground.disc(towards, "towards"));
    if let Some(truth) = truth {
        drawn.extend(ground.arrow(truth, "truth"));
        drawn.extend(ground.disc(truth, "truth"));
    }
    let mut caption = format!(
        "Most light comes {}",
        words(relative(towards, &ground.camera))
    );
    if estimate.is_some() {
        caption += "; shaded: where it comes from in four photographs of five";
    }
    if truth.is_some() {
        caption += "; dashed: the true light";
    }
    let [width, height] = ground.camera.resolution;
    let frame = format!("0 0 {width} {height}");
    let overlay = [("viewBox", frame.as_str()), ("aria-hidden", "true")];
    let photo = loaded.photo.transfer.encode(&loaded.photo.image);
    let parts = [
        image(&photo, SHOWN, &caption)?,
        Html::element("svg", &overlay, drawn),
    ];
    Ok(Some(Html::element(
        "figure",
        &[("class", "direction")],
        [
            Html::of("figcaption", &caption),
            Html::element("div", &[("class", "map")], parts),
        ],
    )))
}

/// The ground at the object's foot, as the camera sees it.
struct Ground {
    camera: Camera,
    /// The middle of what stands there, at its lowest height, metres.
    foot: Vec3,
    /// Half of its size, metres.
    radius: f32,
}

impl Ground {
    /// The azimuths of the estimate's interval as a sector around the foot.
    fn sector(&self, estimate: &LightEstimate) -> Option<Html> {
        let arc = estimate.azimuth_deg;
        let turn = Quat::from_rotation_y(-heading(&self.camera) as f32);
        let steps = ((arc.high - arc.low) / STEP_DEG).ceil().clamp(1.0, 72.0) as usize;
        let rim = (0..=steps).map(|k| {
            let azimuth = arc.low + (arc.high - arc.low) * k as f64 / steps as f64;
            self.foot + 1.6 * self.radius * (turn * direction(azimuth.to_radians() as f32, 0.0))
        });
        let corners: Option<Vec<Vec2>> = std::iter::once(self.foot)
            .chain(rim)
            .map(|p| self.camera.project(p))
            .collect();
        let list = points(&corners?);
        Some(Html::element(
            "polygon",
            &[("class", "sector"), ("points", &list)],
            [],
        ))
    }

    /// An arrow along the ground that points at the foot and comes from the light: as large as fits into the picture.
    /// None if the light stands so high that its azimuth means nothing, or the foot is not in the picture.
    fn arrow(&self, towards: Vec3, class: &str) -> Option<Html> {
        let level = Vec3::new(towards.x, 0.0, towards.z);
        if level.length() < 0.2 * towards.length() {
            return None;
        }
        let level = level.normalize();
        let side = level.cross(Vec3::Y);
        // Along and aside, in units of the radius.
        const OUTLINE: [[f32; 2]; 7] = [
            [1.0, 0.0],
            [1.35, 0.22],
            [1.35, 0.07],
            [2.2, 0.07],
            [2.2, -0.07],
            [1.35, -0.07],
            [1.35, -0.22],
        ];
        let outline = (0..SIZES).find_map(|k| {
            let radius = self.radius * SMALLER.powi(k);
            let corners = OUTLINE.iter().map(|[along, aside]| {
                let at = self.foot + radius * (along * level + aside * side);
                self.camera.project(at).filter(|p| self.is_seen(*p))
            });
            corners.collect::<Option<Vec<Vec2>>>()
        })?;
        let list = points(&outline);
        Some(Html::element(
            "polygon",
            &[("class", class), ("points", &list)],
            [],
        ))
    }

    /// Whether a pixel lies in the picture.
    fn is_seen(&self, pixel: Vec2) -> bool {
        let [width, height] = self.camera.resolution.map(|n| n as f32);
        (0.0..width).contains(&pixel.x) && (0.0..height).contains(&pixel.y)
    }

    /// A disc where the light itself is seen. None if it is not in the picture.
    fn disc(&self, towards: Vec3, class: &str) -> Option<Html> {
        let camera = &self.camera;
        let at = camera.project(camera.position + towards)?;
        if !self.is_seen(at) {
            return None;
        }
        let radius = DISC_DEG.to_radians().tan() * camera.focal_px.max_element();
        let values = [at.x, at.y, radius].map(|v| format!("{v:.1}"));
        let names = ["cx", "cy", "r"];
        let mut attributes = vec![("class", class)];
        attributes.extend(names.into_iter().zip(values.iter().map(String::as_str)));
        Some(Html::element("circle", &attributes, []))
    }
}

fn points(corners: &[Vec2]) -> String {
    let each = corners.iter().map(|p| format!("{:.1},{:.1}", p.x, p.y));
    each.collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use dipir_cli::session::Session;
    use dipir_imaging::file::write_png;
    use dipir_imaging::raster::{DisplayImage, Raster};
    use glam::Mat3;

    use super::*;
    use crate::command_line::scene::Cli;

    /// A camera 1.6 m above the ground that looks along -z, at a thing 4 m away.
    fn ground() -> Ground {
        Ground {
            camera: Camera {
                position: Vec3::new(0.0, 1.6, 0.0),
                rotation: Mat3::IDENTITY,
                focal_px: Vec2::splat(100.0),
                principal_px: Vec2::new(80.0, 60.0),
                resolution: [160, 120],
            },
            foot: Vec3::new(0.0, 0.0, -4.0),
            radius: 0.5,
        }
    }

    #[test]
    fn the_photograph_is_shown_as_it_is_encoded() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let photo = DisplayImage(Raster::filled(36, 24, Vec3::splat(0.2)));
        write_png(at("photo.png"), &photo).unwrap();
        let object = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
        std::fs::write(at("object.obj"), object).unwrap();
        let shown = |transfer: &str| {
            let text = format!(
                "[scene]\nbackground = \"photo.png\"\ntransfer = \"{transfer}\"\n\
                 [[scene.objects]]\npath = \"object.obj\"\nposition = [0.0, 0.0, 0.0]\n\
                 [scene.camera]\nposition = [0.0, 1.6, 5.0]\nlook_at = [0.0, 0.5, 0.0]\nfov_deg = 40.0\n"
            );
            std::fs::write(at("pipeline.toml"), text).unwrap();
            let args = [
                "dipir-scene",
                "-q",
                "-p",
                &at("pipeline.toml").display().to_string(),
            ];
            let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
            crate::scene::run(&session).unwrap();
            let report = Report {
                session: &session,
                status: &[],
                options: &[],
                truth: None,
                failed: &[],
            };
            let html = figure(&report, Vec3::X, None, None).unwrap();
            html.expect("a figure").into_string()
        };
        let srgb = shown("srgb");
        assert!(srgb.contains("data:image/"), "{srgb}");
        for transfer in ["gamma22", "linear"] {
            assert!(shown(transfer) == srgb, "{transfer}");
        }
    }

    #[test]
    fn the_arrow_comes_from_the_side_of_the_light() {
        let list = |towards| {
            let html = ground().arrow(towards, "towards").unwrap().into_string();
            let list = html.split("points=\"").nth(1).unwrap();
            let first = list.split(',').next().unwrap();
            first.parse::<f32>().unwrap()
        };
        // The tip lies half a metre to the light's side of the foot, 4 m away: 12.5 pixels from the middle.
        assert_eq!(list(Vec3::new(1.0, 1.0, 0.0)), 92.5);
        assert_eq!(list(Vec3::new(-1.0, 0.3, 0.0)), 67.5);
        assert!(ground().arrow(Vec3::Y, "towards").is_none());
    }

    #[test]
    fn an_arrow_that_would_leave_the_picture_is_smaller() {
        let mut ground = ground();
        // 5 m to the right of a foot 4 m away is 125 pixels, of which there are 80.
        ground.radius = 2.3;
        let html = ground.arrow(Vec3::X, "towards").unwrap().into_string();
        let list = html.split('"').find(|part| part.contains(',')).unwrap();
        let corners: Vec<Vec<f32>> = list
            .split(' ')
            .map(|c| c.split(',').map(|n| n.parse().unwrap()).collect())
            .collect();
        let right = corners.iter().map(|c| c[0]).fold(0.0, f32::max);
        assert!((135.0..160.0).contains(&right), "{right}");
        ground.foot = Vec3::new(9.0, 0.0, -4.0);
        assert!(ground.arrow(Vec3::X, "towards").is_none());
    }

    #[test]
    fn the_disc_is_drawn_only_where_the_light_is_in_the_picture() {
        let html = ground().disc(Vec3::new(0.2, 0.4, -1.0), "towards").unwrap();
        let html = html.into_string();
        assert!(
            html.contains("cx=\"100.0\"") && html.contains("cy=\"20.0\""),
            "{html}"
        );
        for outside in [Vec3::new(0.2, 0.9, -1.0), Vec3::Z] {
            assert!(ground().disc(outside, "towards").is_none());
        }
    }
}
