//! From files to the text that names them.
use std::borrow::Cow;
use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use dipir_cameras::{WorldUp, file};
use dipir_imaging::exposure::automatic_exposure_ev;
use dipir_imaging::file::{Photo, read_photo};
use dipir_imaging::raster::LinearImage;
use dipir_imaging::transfer::Transfer;
use dipir_points::Ground;
use dipir_points::file::is_depth;
use dipir_points::ground::Shape;
use dipir_scene::camera::Camera;
use dipir_scene::foreground::{DepthSettings, Depths};
use dipir_scene::ground::{self, PointsSettings};
use dipir_scene::proxy::Plane;

use crate::camera_file;
use crate::document::{Document, Object, Points};
use crate::elsewhere::looking_elsewhere;
use crate::error::SetupError;
use crate::model::Models;
use crate::naming::beside;
use crate::size::Kind;
use crate::spots::{appears, crowded, spots};
use crate::view::{self, CameraOptions, View};

/// The photograph as a camera exposes it: the exposure of linear light, as EXR and HDR hold it, is arbitrary.
fn exposed(photo: &Photo) -> Cow<'_, LinearImage> {
    if photo.values.is_some() {
        return Cow::Borrowed(&photo.image);
    }
    let gain = automatic_exposure_ev(&photo.image).exp2();
    Cow::Owned(LinearImage(photo.image.0.map(|p| *p * gain)))
}

/// What a first configuration is made from.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Request {
    /// The photograph.
    pub photo: PathBuf,
    /// At least one.
    pub models: Vec<PathBuf>,
    /// The file to be written.
    pub out: PathBuf,
    /// Height of every object, metres.
    pub height_m: Option<f64>,
    /// What the object is called.
    pub class: Option<String>,
    /// Another program's camera.
    pub camera: Option<PathBuf>,
    /// Which of several cameras of that file: the name of the picture, or of the camera itself.
    pub camera_image: Option<String>,
    /// The same by number; of a camera that moves the frame.
    pub camera_frame: Option<u32>,
    /// Which axis of that camera's world points up.
    pub camera_up: Option<WorldUp>,
    /// Of the camera.
    pub asked: CameraOptions,
    /// Points of the scene that tell the ground.
    pub points: Option<PathBuf>,
    /// Where their sensor stood.
    pub points_pose: Option<PathBuf>,
    /// Which axis of them points up.
    pub points_up: Option<WorldUp>,
    /// Depths of the photograph that tell what stands in front.
    pub depth: Option<PathBuf>,
    /// Whether objects look for a free place.
    pub place_auto: bool,
}

/// A configuration that is not written yet.
#[derive(Clone, Debug, PartialEq)]
pub struct Draft {
    /// What it says.
    pub document: Document,
    /// Where it goes.
    pub path: PathBuf,
    /// What of the photograph and the models could not be used, one sentence each.
    pub warnings: Vec<String>,
}

/// Reads photograph, models and camera, and decides on everything that is not asked.
///
/// # Errors
/// On files that cannot be used, options that make no sense, a file that is there already, and a
/// camera that sees no ground.
pub fn draft(request: &Request) -> Result<Draft, SetupError> {
    if request.out.symlink_metadata().is_ok() {
        return Err(SetupError::Exists {
            path: request.out.clone(),
        });
    }
    request.asked.check()?;
    let folder = request.out.parent().unwrap_or(Path::new(""));
    let mut models = Models::default();
    let sizes = request.models.iter();
    let sizes = sizes.map(|path| models.size_of(path, request.height_m));
    let sizes = sizes.collect::<Result<Vec<_>, _>>()?;
    let mut warnings = models.warnings;
    let photo = read_photo(&request.photo, Transfer::Srgb)?;
    warnings.extend(photo.warnings.iter().cloned());
    // Of axes that point up.
    let mut doubts: Vec<String> = Vec::new();
    let view = match &request.camera {
        Some(path) => {
            let (view, told, doubt) = camera_file::read(path, request, &photo.facts)?;
            warnings.extend(told);
            doubts.extend(doubt);
            view
        }
        None => {
            let (view, no_ground) = View::of_photo(&exposed(&photo), &photo.facts, &request.asked)?;
            warnings.extend(no_ground.filter(|_| request.points.is_none()));
            warnings.extend(view::strip(&photo.facts, &request.asked));
            view
        }
    };
    for path in [&request.camera, &request.points].into_iter().flatten() {
        warnings.extend(file::choice(path).filter(|c| !warnings.contains(c)));
    }
    let widths: Vec<f64> = sizes.iter().map(|s| s.width_m).collect();
    let camera = view.camera(photo.facts.size);
    let found = points(request, &camera, folder, &mut doubts)?;
    let plane = match &found {
        Some((_, ground)) => Plane {
            point: ground.point.as_vec3(),
            normal: ground.normal.as_vec3(),
        },
        None => view.plane(),
    };
    let alone = request
        .points
        .as_ref()
        .filter(|p| request.camera.is_none() && !is_depth(p));
    warnings.extend(alone.map(|path| {
        format!(
            "\"{}\": points belong to the photograph only with the camera of the same scene: name it with --camera",
            path.display()
        )
    }));
    let spots = spots(&camera, &plane, &widths);
    let spots = spots.map_err(|e| e.of_camera(request.camera.is_some(), &doubts))?;
    warnings.append(&mut doubts);
    let crowded = crowded(&camera, &plane, &spots, &widths);
    warnings.extend(crowded.filter(|_| !request.place_auto));
    let objects = request.models.iter().zip(sizes).zip(spots);
    let objects = objects.map(|((path, size), at_pixel)| {
        Ok(Object {
            path: beside(path, folder)?,
            at_pixel,
            auto: request.place_auto,
            appears_px: appears(&camera, &plane, at_pixel, size.width_m, size.height_m),
            may_lie: Kind::of(path) == Kind::Bare,
            size_line: size.line,
            size_why: size.why,
        })
    });
    let elsewhere = view.file.as_ref().map_or(Vec::new(), |file| {
        looking_elsewhere(&file.path, &request.photo, request.camera_up)
    });
    let depth = request.depth.as_deref();
    if let Some(path) = depth {
        let settings = DepthSettings {
            path: path.into(),
            measure: None,
            scale: None,
            catches: false,
        };
        Depths::read(&settings, Path::new(""), photo.facts.size, None)?;
    }
    let (class, class_why) = class(request);
    Ok(Draft {
        document: Document {
            out: out_folder(&request.out),
            photo: beside(&request.photo, folder)?,
            has_gain: photo.gain.is_some(),
            facts: photo.facts,
            class,
            class_why,
            objects: objects.collect::<Result<_, SetupError>>()?,
            camera_file: match &view.file {
                Some(file) => Some(beside(&file.path, folder)?),
                None => None,
            },
            views: elsewhere
                .iter()
                .map(|picture| beside(picture, folder))
                .collect::<Result<_, _>>()?,
            view,
            points: found.map(|f| f.0),
            depth: depth.map(|path| beside(path, folder)).transpose()?,
            raised: models.raised,
        },
        path: request.out.clone(),
        warnings,
    })
}

/// The points that are asked for, and the ground in them.
fn points(
    request: &Request,
    camera: &Camera,
    folder: &Path,
    doubts: &mut Vec<String>,
) -> Result<Option<(Points, Ground)>, SetupError> {
    let Some(path) = &request.points else {
        return Ok(None);
    };
    let up = points_up(request, path);
    let settings = PointsSettings {
        path: path.clone(),
        up,
        scale: 1.0,
        pose: request.points_pose.clone(),
        shape: Shape::Auto,
    };
    let (here, view) = (Path::new(""), ground::view(camera, None));
    let (cloud, ground) = settings.read(here, &view)?;
    doubts.extend(settings.doubt(here, &view, &cloud));
    let pose = request.points_pose.as_ref();
    let points = Points {
        path: beside(path, folder)?,
        pose: pose.map(|pose| beside(pose, folder)).transpose()?,
        up: up.map(WorldUp::word),
        words: ground.words(),
    };
    Ok(Some((points, ground)))
}

/// Which axis points up in the points: of COLMAP's as `dipir run` has it, that of the camera, which is in their world.
fn points_up(request: &Request, path: &Path) -> Option<WorldUp> {
    let of_camera = request
        .camera_up
        .filter(|_| dipir_points::file::is_model(path));
    request.points_up.or(of_camera)
}

impl Draft {
    /// Writes the file, which must not be there.
    ///
    /// # Errors
    /// If it is there, or cannot be written.
    pub fn write(&self) -> Result<(), SetupError> {
        let path = || self.path.clone();
        let file = OpenOptions::new()
            .write(true)
            .create_new(true)
            .open(&self.path);
        let mut file = file.map_err(|source| match source.kind() {
            ErrorKind::AlreadyExists => SetupError::Exists { path: path() },
            _ => SetupError::Write {
                path: path(),
                source,
            },
        })?;
        file.write_all(self.document.text().as_bytes())
            .map_err(|source| {
                // What was just made and is cut short is of no use, and in the way of the next try.
                let _ = std::fs::remove_file(&self.path);
                SetupError::Write {
                    path: path(),
                    source,
                }
            })
    }
}

/// The folder of the results: `out` for `pipeline.toml`, and `out-b` for `b.toml` beside it.
fn out_folder(file: &Path) -> String {
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    match name.strip_suffix(".toml").unwrap_or(&name) {
        "pipeline" if name.ends_with(".toml") => "out".into(),
        stem => format!("out-{stem}"),
    }
}

/// The word for prompts: as asked, else the words of the first model's name.
fn class(request: &Request) -> (String, &'static str) {
    let asked = request.class.as_deref().map(str::trim);
    if let Some(word) = asked.filter(|w| !w.is_empty()) {
        return (word.into(), "as --class says");
    }
    let stem = request.models.first().and_then(|m| m.file_stem());
    let stem = stem.unwrap_or_default().to_string_lossy().to_lowercase();
    let words: Vec<&str> = stem
        .split(|c: char| !c.is_alphabetic())
        .filter(|word| word.chars().count() > 1)
        .collect();
    match words.is_empty() {
        true => ("object".into(), "any word; or --class"),
        false => (words.join(" "), "as the model's file; or --class"),
    }
}

#[cfg(test)]
mod tests {
    use dipir_imaging::layers::{Layers, Precision};

    use super::*;

    /// Exif data that say nothing but an orientation: a TIFF header and one tag [TIFF 6.0].
    fn exif_of(turn: u8) -> Vec<u8> {
        let mut bytes = b"II*\0\x08\0\0\0\x01\0".to_vec();
        bytes.extend([0x12, 0x01, 3, 0, 1, 0, 0, 0, turn, 0, 0, 0, 0, 0, 0, 0]);
        bytes
    }

    /// A PNG that this turn makes upright.
    fn put_turned(path: &Path, [w, h]: [usize; 2], at: &dyn Fn(usize, usize) -> u8, turn: u8) {
        let (right, bottom) = (w - 1, h - 1);
        let stored = if turn < 5 { [w, h] } else { [h, w] };
        let place = |row: usize, column: usize| match turn {
            1 => at(column, row),
            2 => at(right - column, row),
            3 => at(right - column, bottom - row),
            4 => at(column, bottom - row),
            5 => at(row, column),
            6 => at(right - row, column),
            7 => at(right - row, bottom - column),
            _ => at(row, bottom - column),
        };
        let mut info = png::Info::with_size(stored[0] as u32, stored[1] as u32);
        info.exif_metadata = Some(exif_of(turn).into());
        let file = std::fs::File::create(path).unwrap();
        let encoder = png::Encoder::with_info(file, info).unwrap();
        let mut writer = encoder.write_header().unwrap();
        let pixels = (0..w * h).map(|k| place(k / stored[0], k % stored[0]));
        writer
            .write_image_data(&pixels.collect::<Vec<u8>>())
            .unwrap();
        writer.finish().unwrap();
    }

    #[test]
    fn linear_light_gives_the_same_camera_at_any_exposure() {
        let folder = tempfile::tempdir().unwrap();
        let model = folder.path().join("a.obj");
        std::fs::write(
            &model,
            "v 0 0 0\nv 1 0 0\nv 0 0 1\nv 0 1 0\nf 1 2 3\nf 1 2 4\n",
        )
        .unwrap();
        let pose = dipir_calibration::Pose::new(-8.0, 2.0, 60.0);
        let room = dipir_calibration::generated::Built::Room;
        let room = dipir_calibration::generated::picture(room, 1, &pose, [192, 128]);
        // Powers of two, which floats multiply by exactly.
        let texts = [1.0, 65536.0, 1.0 / 4096.0].map(|exposure| {
            let photo = folder.path().join("photo.exr");
            let mut layers = Layers::new(192, 128);
            let colour = room.0.map(|p| *p * exposure);
            layers.insert_rgb("", Precision::Full, &colour).unwrap();
            layers.write_exr(&photo).unwrap();
            let request = Request {
                photo,
                models: vec![model.clone()],
                out: folder.path().join("pipeline.toml"),
                ..Request::default()
            };
            draft(&request).unwrap().document.text()
        });
        assert_eq!(texts[0], texts[1]);
        assert_eq!(texts[0], texts[2]);
    }

    #[test]
    fn each_of_the_eight_orientations_gives_the_same_scene() {
        let folder = tempfile::tempdir().unwrap();
        let (photo, model) = (folder.path().join("photo.png"), folder.path().join("a.obj"));
        let corners = "v 0 0 0\nv 1 0 0\nv 0 0 1\nv 0 1 0\n";
        std::fs::write(
            &model,
            format!("{corners}f 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"),
        )
        .unwrap();
        let pose = dipir_calibration::Pose::new(-8.0, 2.0, 60.0);
        let size = [192, 128];
        let room = dipir_calibration::generated::Built::Room;
        let room = dipir_calibration::generated::picture(room, 1, &pose, size);
        let at = |x: usize, y: usize| (room.0.get(x, y).x.sqrt() * 255.0) as u8;
        let texts = (1..=8).map(|turn| {
            put_turned(&photo, size, &at, turn);
            let request = Request {
                photo: photo.clone(),
                models: vec![model.clone()],
                out: folder.path().join("pipeline.toml"),
                ..Request::default()
            };
            draft(&request).unwrap().document.text()
        });
        let texts: Vec<String> = texts.collect();
        assert!(texts[0].contains("192 x 128 pixels"), "{}", texts[0]);
        assert!(texts.iter().all(|text| *text == texts[0]), "{texts:?}");
    }

    #[test]
    fn models_without_a_unit_and_a_second_file_are_written_as_such() {
        let folder = tempfile::tempdir().unwrap();
        let (photo, model) = (folder.path().join("photo.png"), folder.path().join("a.ply"));
        put_turned(&photo, [192, 128], &|_, y| y as u8, 1);
        let head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
        let body = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n10 0 0\n0 10 0\n3 0 1 2\n";
        std::fs::write(&model, format!("{head}{body}")).unwrap();
        let request = Request {
            photo,
            models: vec![model],
            out: folder.path().join("b.toml"),
            asked: CameraOptions {
                pitch_deg: Some(-10.0),
                ..CameraOptions::default()
            },
            ..Request::default()
        };
        let document = draft(&request).unwrap().document;
        let object = &document.objects[0];
        assert!(object.may_lie && object.size_line.as_deref() == Some("scale = 0.01"));
        // A tenth of a metre, some metres away.
        let [_, height] = object.appears_px.unwrap();
        assert!((1.0..10.0).contains(&height), "{height}");
        let text = document.text();
        for part in ["out = \"out-b\"", "which is small", "# pitch_deg = -90.0"] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }

    #[test]
    fn depths_are_read_before_their_key_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        put_turned(&at("photo.png"), [192, 128], &|_, y| y as u8, 1);
        put_turned(&at("depth.png"), [48, 32], &|_, y| y as u8, 1);
        put_turned(&at("other.png"), [48, 48], &|_, y| y as u8, 1);
        std::fs::write(at("a.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
        let of = |depth: &str| {
            let request = Request {
                photo: at("photo.png"),
                models: vec![at("a.obj")],
                out: at("pipeline.toml"),
                depth: Some(at(depth)),
                ..Request::default()
            };
            draft(&request).map(|draft| draft.document.text())
        };
        let text = of("depth.png").unwrap();
        assert!(text.contains("\ndepth = \"depth.png\"    # "), "{text}");
        let error = of("other.png").unwrap_err().to_string();
        assert!(error.contains("48 x 48"), "{error}");
    }

    #[test]
    fn colmap_s_points_are_turned_as_its_camera_is() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        put_turned(&at("photo.png"), [30, 20], &|x, _| x as u8, 1);
        std::fs::write(at("a.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
        // A level camera at the origin of a world with +y up, and the ground 2 m below it.
        std::fs::create_dir(at("v1.2")).unwrap();
        std::fs::write(at("v1.2/cameras.txt"), "1 PINHOLE 30 20 25 25 15 10\n").unwrap();
        std::fs::write(at("v1.2/images.txt"), "1 0 1 0 0 0 0 0 1 photo.png\n\n").unwrap();
        let point = |i: u32| format!("{i} {} -2 {} 9 9 9 0\n", i % 9, -f64::from(i / 9 + 6));
        let points: String = (0..90).map(point).collect();
        std::fs::write(at("v1.2/points3D.txt"), points).unwrap();
        let of = |points_up| {
            let request = Request {
                photo: at("photo.png"),
                models: vec![at("a.obj")],
                out: at("pipeline.toml"),
                camera: Some(at("v1.2")),
                camera_up: Some(WorldUp::Y),
                points: Some(at("v1.2")),
                points_up,
                ..Request::default()
            };
            draft(&request).map(|draft| draft.document.text())
        };
        let text = of(None).unwrap();
        assert!(
            text.contains("points = \"v1.2\"\npoints_up = \"y\"\n"),
            "{text}"
        );
        // Upside down the points are above the camera.
        assert!(of(Some(WorldUp::MinusY)).is_err());
    }

    #[test]
    fn which_of_several_models_of_a_project_is_read_is_a_warning() {
        let folder = tempfile::tempdir().unwrap();
        let (photo, model) = (folder.path().join("photo.png"), folder.path().join("a.obj"));
        std::fs::write(&model, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
        put_turned(&photo, [30, 20], &|x, _| x as u8, 1);
        for name in ["0", "1"] {
            let sparse = folder.path().join("sparse").join(name);
            std::fs::create_dir_all(&sparse).unwrap();
            let camera = "1 PINHOLE 30 20 25 25 15 10\n";
            std::fs::write(sparse.join("cameras.txt"), camera).unwrap();
            let image = "1 1 0 0 0 0 0 0 1 photo.png\n\n";
            std::fs::write(sparse.join("images.txt"), image).unwrap();
        }
        let request = Request {
            photo,
            models: vec![model],
            out: folder.path().join("pipeline.toml"),
            camera: Some(folder.path().into()),
            ..Request::default()
        };
        let warnings = draft(&request).unwrap().warnings;
        let said = |w: &&String| w.starts_with("COLMAP's project has 2 models");
        assert_eq!(warnings.iter().filter(said).count(), 1, "{warnings:?}");
    }

    #[test]
    fn a_panorama_and_objects_without_room_are_warnings() {
        let folder = tempfile::tempdir().unwrap();
        let (photo, model) = (folder.path().join("photo.png"), folder.path().join("a.obj"));
        std::fs::write(&model, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
        put_turned(&photo, [90, 30], &|x, _| x as u8, 1);
        let mut request = Request {
            photo,
            models: vec![model; 9],
            out: folder.path().join("pipeline.toml"),
            height_m: Some(4.0),
            ..Request::default()
        };
        request.asked.pitch_deg = Some(-20.0);
        let said = |request: &Request| draft(request).unwrap().warnings.join("\n");
        let both = ["3.0 times as wide as high", "the 9 objects take 36.0 m"];
        let text = said(&request);
        assert!(both.iter().all(|part| text.contains(part)), "{text}");
        request.place_auto = true;
        request.asked.fov_deg = Some(60.0);
        let text = said(&request);
        assert!(!both.iter().any(|part| text.contains(part)), "{text}");
    }

    #[test]
    fn the_class_is_the_words_of_the_model_s_name() {
        let of = |name: &str| {
            class(&Request {
                models: vec![name.into()],
                ..Request::default()
            })
            .0
        };
        assert_eq!(of("models/Garden_Chair-2b.glb"), "garden chair");
        assert_eq!(of("0001.obj"), "object");
    }

    #[test]
    fn paths_are_named_from_the_folder_of_the_file() {
        let named = |path: &str, folder: &str| beside(path.as_ref(), folder.as_ref()).unwrap();
        assert_eq!(named("photo.jpg", ""), "photo.jpg");
        assert_eq!(named("in/photo.jpg", "in"), "photo.jpg");
        assert_eq!(named("in/photo.jpg", ""), "in/photo.jpg");
        assert_eq!(named("photo.jpg", "."), "photo.jpg");
        assert_eq!(named("./in/photo.jpg", "in"), "photo.jpg");
        let elsewhere = named("photo.jpg", "projects");
        assert!(Path::new(&elsewhere).is_absolute() && elsewhere.ends_with("photo.jpg"));
    }

    #[test]
    fn files_elsewhere_are_named_by_the_way_to_them() {
        let root = tempfile::tempdir().unwrap();
        let folder = |name: &str| {
            let path = root.path().join(name);
            std::fs::create_dir_all(&path).unwrap();
            path
        };
        let [photos, other, deep] = ["x", "other", "other/deep"].map(folder);
        let named = |path: PathBuf, folder: &Path| beside(&path, folder).unwrap();
        assert_eq!(named(photos.join("photo.png"), &other), "../x/photo.png");
        assert_eq!(named(photos.join("photo.png"), &deep), "../../x/photo.png");
        assert_eq!(named(other.join("a.glb"), &deep), "../a.glb");
        // A file that is found there is the same file.
        std::fs::write(photos.join("photo.png"), "p").unwrap();
        #[cfg(unix)]
        {
            let link = root.path().join("link");
            std::os::unix::fs::symlink(&deep, &link).unwrap();
            let way = named(photos.join("photo.png"), &link);
            assert_eq!(std::fs::read(link.join(way)).unwrap(), b"p");
        }
        // The root alone is nothing that moves together.
        #[cfg(unix)]
        assert_eq!(named("/etc/photo.png".into(), &other), "/etc/photo.png");
    }

    #[test]
    fn each_file_has_its_own_folder_of_results() {
        let of = |path: &str| out_folder(path.as_ref());
        assert_eq!(of("pipeline.toml"), "out");
        assert_eq!(of("elsewhere/pipeline.toml"), "out");
        assert_eq!(of("b.toml"), "out-b");
        assert_eq!(of("in/my b.v2.toml"), "out-my b.v2");
        assert_eq!(of("pipeline"), "out-pipeline");
    }
}
