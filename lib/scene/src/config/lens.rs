//! What `[scene.camera]` says of another program's file, and of a lens that bends lines.
use dipir_cameras::Distortion;
use dipir_cameras::chan::Turns;
use dipir_cameras::file::is_gltf;

use super::*;
use crate::camera::{FileSettings, Which};

/// The `[scene.camera.distortion]` table as written: the coefficients of a lens as OpenCV names them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DistortionConfig {
    /// Whether the lens is a fisheye, imaged by its angle (Kannala and Brandt's model, `k1` to `k4`);
    /// otherwise radii are stretched and decentred (Brown and Conrady's, `k1` to `k4`, `p1` and `p2`).
    #[schemars(extend("default" = false), example = true)]
    pub fisheye: bool,
    /// Radial, at the radius or angle squared.
    #[schemars(extend("default" = 0.0), example = -0.12)]
    pub k1: f64,
    /// Radial, at its fourth power.
    #[schemars(extend("default" = 0.0), example = 0.03)]
    pub k2: f64,
    /// Radial, at its sixth power.
    #[schemars(extend("default" = 0.0), example = -0.002)]
    pub k3: f64,
    /// Radial, at its eighth power.
    #[schemars(extend("default" = 0.0), example = 0.0001)]
    pub k4: f64,
    /// Tangential, upwards and downwards.
    #[schemars(extend("default" = 0.0), example = 0.0005)]
    pub p1: f64,
    /// Tangential, to the sides.
    #[schemars(extend("default" = 0.0), example = -0.0003)]
    pub p2: f64,
}

impl DistortionConfig {
    pub(super) fn validate(&self) -> Result<Distortion, Error> {
        let k = [self.k1, self.k2, self.k3, self.k4];
        let tangential = [self.p1, self.p2];
        if self.fisheye && tangential != [0.0; 2] {
            return Err(conflict(
                "scene.camera.distortion.fisheye",
                "scene.camera.distortion.p1",
            ));
        }
        let lens = match self.fisheye {
            true => Distortion::kannala_brandt(k),
            false => Distortion::brown_conrady(k, [0.0; 3], tangential),
        };
        lens.ok_or_else(|| {
            wrong(
                "scene.camera.distortion",
                format!("{k:?}, {tangential:?}"),
                "finite numbers, for instance k1 = -0.12",
            )
        })
    }
}

impl CameraConfig {
    /// A camera in a file; `photo` is the photograph.
    pub(super) fn validate_file(
        &self,
        key: &'static str,
        path: &Path,
        photo: &Path,
    ) -> Result<CameraSettings, Error> {
        let of_transforms = key == "transforms";
        let stands = [
            ("position", self.position.is_some()),
            ("look_at", self.look_at.is_some()),
            ("up", self.up.is_some()),
            ("pitch_deg", self.pitch_deg.is_some()),
            ("roll_deg", self.roll_deg.is_some()),
            ("heading_deg", self.heading_deg.is_some()),
        ];
        // Where files may lack it, it is known when they are read.
        let lens = [
            ("fov_deg", self.fov_deg.is_some() && !is_chan(path)),
            ("focal_mm", self.focal_mm.is_some()),
            ("sensor_mm", self.sensor_mm.is_some()),
        ];
        let other = [
            ("file", of_transforms && self.file.is_some()),
            ("file_up", of_transforms && self.file_up.is_some()),
            ("file_scale", of_transforms && self.file_scale.is_some()),
            ("image", of_transforms && self.image.is_some()),
            (
                "transforms_up",
                !of_transforms && self.transforms_up.is_some(),
            ),
        ];
        let stands_by = stands.iter().find(|(_, given)| *given).map(|s| s.0);
        let stands = stands.into_iter().filter(|_| of_transforms);
        let all = stands.chain(lens).chain(other);
        if let Some((name, _)) = all.clone().find(|(_, given)| *given) {
            return Err(conflict(
                &format!("scene.camera.{key}"),
                &format!("scene.camera.{name}"),
            ));
        }
        let which = match (&self.image, self.frame) {
            (Some(name), Some(n)) if is_gltf(path) => Which::Frame(name.clone(), n),
            (Some(_), Some(_)) => {
                return Err(conflict("scene.camera.image", "scene.camera.frame"));
            }
            (Some(name), None) => Which::Name(name.clone()),
            (None, Some(number)) => Which::Number(number),
            (None, None) if of_transforms => Which::Number(0),
            (None, None) => Which::Photo(photo.into()),
        };
        let scale = self.file_scale.unwrap_or(1.0);
        if !(scale.is_finite() && scale > 0.0) {
            let accepted = "metres above 0 of a unit of the file, for instance file_scale = 0.01";
            return Err(wrong("scene.camera.file_scale", scale, accepted));
        }
        if self.fov_deg.is_some() {
            self.field_of_view()?;
        }
        // Of another file it is refused, whether or not a direction is beside it.
        let has_stand = self.position.is_some() && !of_transforms && may_be_a_lens(path);
        Ok(CameraSettings::File(FileSettings {
            key,
            path: path.into(),
            which,
            up: match of_transforms {
                true => world_up("scene.camera.transforms_up", &self.transforms_up)?,
                false => world_up("scene.camera.file_up", &self.file_up)?,
            },
            turns: turns(&self.file_rotation_order, path)?,
            scale,
            stand: match has_stand {
                true => Some(self.stand()?),
                false => None,
            },
            stands_by,
            fov_deg: self.fov_deg,
            principal_px: finite_pixel("scene.camera.principal_px", self.principal_px)?,
            distortion: match &self.distortion {
                None => None,
                Some(table) => Some(table.validate()?),
            },
            orientation: 1,
        }))
    }
}

fn is_chan(path: &Path) -> bool {
    let extension = path.extension();
    extension.is_some_and(|e| e.eq_ignore_ascii_case("chan"))
}

/// Whether it may be a calibration of a lens alone.
fn may_be_a_lens(path: &Path) -> bool {
    let is = |kind: &str| {
        path.extension()
            .is_some_and(|e| e.eq_ignore_ascii_case(kind))
    };
    is("yaml") || is("yml") || is("json")
}

/// An axis by its word.
pub(super) fn world_up(key: &str, word: &Option<String>) -> Result<Option<WorldUp>, Error> {
    Ok(match word.as_deref() {
        None => None,
        Some(word) => match WorldUp::ALL.into_iter().find(|up| up.word() == word) {
            None => return Err(wrong_word(key, word, &["z", "y", "-y", "x", "-x"])),
            found => found,
        },
    })
}

fn turns(word: &Option<String>, file: &Path) -> Result<Option<Turns>, Error> {
    let Some(word) = word else { return Ok(None) };
    let key = "scene.camera.file_rotation_order";
    if !is_chan(file) {
        let accepted = "nothing here: files other than .chan say how they turn";
        return Err(wrong(key, format_args!("\"{word}\""), accepted));
    }
    let all = ["zxy", "xyz", "xzy", "yxz", "yzx", "zyx"];
    match Turns::parse(word) {
        None => Err(wrong_word(key, word, &all)),
        found => Ok(found),
    }
}

#[cfg(test)]
mod tests {
    use dipir_cameras::Lens;
    use glam::DVec2;

    use super::*;

    /// A camera at (0, 2, 0) that looks along -z, in one frame or more of each kind of file.
    const CHAN: &str = "1001 0 2 0 0 0 0 40\n1002 1 2 0 0 0 0 40\n";
    const WITHOUT_FOV: &str = "1 0 2 0 0 0 0\n";
    const GLTF: &str = r#"{ "nodes": [{ "camera": 0, "translation": [0, 2, 0] }],
        "cameras": [{ "perspective": { "yfov": 0.6981317007977318 } }] }"#;
    const FRAME: &str =
        r#""transform_matrix": [[1,0,0,0],[0,0,-1,0],[0,1,0,2],[0,0,0,1]], "fl_x": 549.4954838892"#;
    const OPENCV: &str = "camera_matrix: [500, 0, 300, 0, 500, 200, 0, 0, 1]\n";

    fn transforms(more: &str) -> String {
        format!(r#"{{ "w": 600, "h": 400, "frames": [{{ "file_path": "a", {FRAME} {more} }}] }}"#)
    }

    /// The camera of `in/plate.1001.png`, of 600 x 400 pixels, with its lens if that bends lines. Of `lines` those of
    /// `[scene.camera]` but for the name of its file.
    fn resolved(
        (name, text): (&str, impl AsRef<[u8]>),
        lines: &str,
    ) -> Result<(crate::camera::Camera, Option<Lens>), String> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(name), text).unwrap();
        let config: CameraConfig = toml::from_str(&format!("file = \"{name}\"\n{lines}")).unwrap();
        let settings = config.validate(Path::new("in/plate.1001.png"));
        let found = settings.and_then(|s| s.resolve([600, 400], folder.path()));
        let (camera, undistortion) = found.map_err(|e| e.to_string())?;
        Ok((camera, undistortion.map(|u| *u.lens())))
    }

    const LENS: &str = "principal_px = [310.0, 190.0]\ndistortion = { k1 = -0.1 }\n";

    #[test]
    fn a_file_without_a_lens_takes_that_of_the_table() {
        let plain = transforms("");
        for file in [
            ("shot.chan", CHAN),
            ("shot.gltf", GLTF),
            ("transforms.json", &plain),
        ] {
            let (camera, lens) = resolved(file, LENS).unwrap();
            let lens = lens.unwrap();
            let k1 = Distortion::brown_conrady([-0.1, 0.0, 0.0, 0.0], [0.0; 3], [0.0; 2]);
            assert_eq!(Some(lens.distortion), k1, "{}", file.0);
            assert_eq!(lens.principal_px, DVec2::new(310.0, 190.0));
            assert!((lens.focal_px - 549.4954838892).abs().max_element() < 1e-6);
            // The camera is that of the undistorted picture, which shows more.
            assert!(camera.resolution > [600, 400] && camera.position == Vec3::new(0.0, 2.0, 0.0));
            let (straight, none) = resolved(file, "principal_px = [310.0, 190.0]").unwrap();
            assert_eq!(straight.principal_px, Vec2::new(310.0, 190.0));
            assert!(none.is_none());
        }
    }

    #[test]
    fn a_lens_in_a_file_excludes_that_of_the_table() {
        let bent = transforms(r#", "k1": 0.02"#);
        let shifted = transforms(r#", "cx": 310"#);
        let stands = "position = [0.0, 1.0, 0.0]\npitch_deg = 0.0\n";
        for (file, lines, want) in [
            (
                ("transforms.json", &*bent),
                "distortion = { k1 = 0.0 }",
                "coefficients of a lens in scene.camera.file and scene.camera.distortion cannot both",
            ),
            (
                ("transforms.json", &*shifted),
                "principal_px = [310.0, 190.0]",
                "an optical axis in scene.camera.file and scene.camera.principal_px cannot both",
            ),
            (
                (
                    "lens.yaml",
                    &*format!("{OPENCV}distortion_coefficients: [0.1, 0, 0, 0]"),
                ),
                &*format!("{stands}distortion = {{ k1 = -0.1 }}"),
                "coefficients of a lens in scene.camera.file and scene.camera.distortion cannot both",
            ),
        ] {
            assert!(resolved(file, if file.0 == "lens.yaml" { stands } else { "" }).is_ok());
            let error = resolved(file, lines).unwrap_err();
            assert!(error.starts_with(want), "{error}");
        }
        assert!(
            resolved(
                ("lens.yaml", OPENCV),
                &format!("{stands}distortion = {{ k1 = -0.1 }}")
            )
            .is_ok()
        );
    }

    #[test]
    fn a_chan_turns_in_the_order_that_is_written() {
        let turned = "1 0 2 0 90 0 90 40\n";
        let backward = |key: &str| {
            let (camera, _) = resolved(("shot.chan", turned), key).unwrap();
            camera.rotation.z_axis
        };
        // About z: +z stays; about x: to -y. In the other order: to -y, then about z to +x.
        assert!(backward("").abs_diff_eq(-Vec3::Y, 1e-6));
        let other = backward("file_rotation_order = \"xyz\"");
        assert!(other.abs_diff_eq(Vec3::X, 1e-6), "{other}");
        let error = resolved(("shot.chan", turned), "file_rotation_order = \"xy\"").unwrap_err();
        let want = "scene.camera.file_rotation_order is \"xy\"; accepted: \"zxy\", \"xyz\"";
        assert!(error.starts_with(want), "{error}");
        let error = resolved(("shot.gltf", GLTF), "file_rotation_order = \"xyz\"").unwrap_err();
        assert!(error.contains("files other than .chan say"), "{error}");
    }

    #[test]
    fn a_gltf_camera_that_moves_is_named_with_its_frame() {
        // x is 0.5, 0.25 and -0.5 at 1/24, 2/24 and 3/24 s.
        let moving = r#"{ "nodes": [{ "camera": 0, "name": "A" }, { "camera": 0, "name": "B" }],
            "cameras": [{ "perspective": { "yfov": 0.7 } }],
            "buffers": [{ "uri": "data:;base64,q6oqPauqqj0AAAA+AAAAPwAAAEAAAAAAAACAPgAAAEAAAAAAAAAAvwAAAEAAAAAA" }],
            "bufferViews": [{ "buffer": 0, "byteLength": 12 },
                { "buffer": 0, "byteOffset": 12, "byteLength": 36 }],
            "accessors": [{ "bufferView": 0, "componentType": 5126, "type": "SCALAR", "count": 3 },
                { "bufferView": 1, "componentType": 5126, "type": "VEC3", "count": 3 }],
            "animations": [{ "samplers": [{ "input": 0, "output": 1 }],
                "channels": [{ "sampler": 0, "target": { "node": 1, "path": "translation" } }] }] }"#;
        let x = |keys: &str| resolved(("shot.gltf", moving), keys).map(|(c, _)| c.position.x);
        assert_eq!(x("image = \"B\"\nframe = 3"), Ok(-0.5));
        assert_eq!(x("image = \"B\"\nframe = 2"), Ok(0.25));
        assert_eq!(x("image = \"A\""), Ok(0.0));
        let error = x("image = \"B\"").unwrap_err();
        let want = "the camera moves, with frames 1 to 3 at 24 a second; say which";
        assert!(error.contains(want), "{error}");
        let both = resolved(("shot.chan", CHAN), "image = \"B\"\nframe = 3").unwrap_err();
        let want = "scene.camera.image and scene.camera.frame cannot both be given";
        assert!(both.starts_with(want), "{both}");
        // Counted from the first picture, which is told.
        let one = moving.replace(r#"{ "camera": 0, "name": "A" }"#, "{}");
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("shot.gltf"), one).unwrap();
        let config: CameraConfig = toml::from_str("file = \"shot.gltf\"").unwrap();
        let settings = config.validate(Path::new("plate.1001.png")).unwrap();
        let (camera, _) = settings.resolve([600, 400], folder.path()).unwrap();
        assert_eq!(camera.position.x, 0.5);
        let CameraSettings::File(file) = settings else {
            panic!("a file")
        };
        let told = file.choice(folder.path()).unwrap();
        assert!(
            told.contains("picture 1001 is taken to be frame 1"),
            "{told}"
        );
    }

    #[test]
    fn a_camera_of_kitti_that_is_named_is_that_of_every_picture() {
        let folder = tempfile::tempdir().unwrap();
        let line = |n: u32| format!("P{n}: 700 0 300 0 0 700 200 0 0 0 1 0\n");
        std::fs::write(folder.path().join("calib.txt"), line(0) + &line(1)).unwrap();
        let stands_still = |more: &str| {
            let config = format!("file = \"calib.txt\"\n{more}");
            let config: CameraConfig = toml::from_str(&config).unwrap();
            match config.validate(Path::new("a.png")).unwrap() {
                CameraSettings::File(file) => file.stands_still(folder.path()),
                CameraSettings::LookAt { .. } => panic!("a file"),
            }
        };
        assert!(stands_still("frame = 0") && !stands_still(""));
    }

    #[test]
    fn a_key_that_the_file_has_is_refused() {
        for key in [
            "position = [0.0, 1.0, 0.0]",
            "pitch_deg = 1.0",
            "roll_deg = 1.0",
            "heading_deg = 1.0",
            "look_at = [0.0, 0.0, 0.0]",
            "up = [0.0, 1.0, 0.0]",
        ] {
            let name = key.split(' ').next().unwrap();
            let error = resolved(("shot.chan", CHAN), key).unwrap_err();
            let want = format!("scene.camera.file and scene.camera.{name} cannot both be given");
            assert!(error.starts_with(&want), "{error}");
        }
        for (file, want) in [
            (
                ("shot.chan", CHAN),
                "a field of view in scene.camera.file and scene.camera.fov_deg cannot both",
            ),
            (
                ("shot.gltf", GLTF),
                "scene.camera.file and scene.camera.fov_deg cannot both",
            ),
        ] {
            let error = resolved(file, "fov_deg = 40.0").unwrap_err();
            assert!(error.starts_with(want), "{error}");
        }
        let error = resolved(("shot.chan", WITHOUT_FOV), "fov_deg = 190.0").unwrap_err();
        assert!(error.starts_with("scene.camera.fov_deg is 190"), "{error}");
        let stands = "position = [0.0, 1.0, 0.0]\npitch_deg = 0.0\nfile_scale = 2.0";
        let error = resolved(("lens.yaml", OPENCV), stands).unwrap_err();
        let want = "a lens alone in scene.camera.file and scene.camera.file_scale cannot both";
        assert!(error.starts_with(want), "{error}");
    }

    #[test]
    fn a_fisheye_beside_a_chan_has_the_field_of_view_that_is_written() {
        let file = ("shot.chan", WITHOUT_FOV);
        let (pinhole, none) = resolved(file, "fov_deg = 120.0").unwrap();
        assert!(none.is_none() && (pinhole.focal_px.y - 200.0 / 3f32.sqrt()).abs() < 1e-3);
        let fisheye = "fov_deg = 120.0\ndistortion = { fisheye = true }";
        let lens = resolved(file, fisheye).unwrap().1.unwrap();
        // 60 degrees are seen at 200 pixels, and the image's radius is the angle.
        assert!((lens.focal_px.y - 200.0 / 60f64.to_radians()).abs() < 1e-3);
        // The radius a - a^3 / 2 grows no more from 47 degrees on, and is 0 at 81.
        let turned_back = "fov_deg = 170.0\ndistortion = { fisheye = true, k1 = -0.5 }";
        let error = resolved(file, turned_back).unwrap_err();
        assert!(error.starts_with("scene.camera.fov_deg is 170"), "{error}");
    }

    #[test]
    fn a_file_that_is_utf_16_is_refused_with_how_to_save_it() {
        let text: Vec<u8> = "\u{feff}fx 800"
            .encode_utf16()
            .flat_map(u16::to_le_bytes)
            .collect();
        for name in ["shot.chan", "lens.yaml", "transforms.json", "calib.txt"] {
            let error = resolved((name, &text), "").unwrap_err();
            assert!(error.contains("UTF-16"), "{name}: {error}");
        }
    }

    #[test]
    fn folders_tell_photographs_of_the_same_name_apart() {
        let frame = |name: &str, x: f64| {
            format!(
                r#"{{ "file_path": "{name}", "fl_x": 500,
                "transform_matrix": [[1,0,0,{x}],[0,1,0,0],[0,0,1,0],[0,0,0,1]] }}"#
            )
        };
        let frames = [frame("left/1.png", 1.0), frame("right/1.png", 2.0)].join(",");
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("transforms.json");
        std::fs::write(&file, format!(r#"{{ "frames": [{frames}] }}"#)).unwrap();
        let config = CameraConfig {
            file: Some(file),
            ..CameraConfig::default()
        };
        let x = |base_dir: &str, photo: &str| {
            let settings = config.validate(Path::new(photo)).unwrap();
            let found = settings.resolve([600, 400], &folder.path().join(base_dir));
            found
                .map(|(camera, _)| camera.position.x)
                .map_err(|e| e.to_string())
        };
        assert_eq!(x("", "right/1.png"), Ok(2.0));
        assert_eq!(x("", "left/1.png"), Ok(1.0));
        // From a configuration in the folder itself.
        assert_eq!(x("right", "1.png"), Ok(2.0));
        assert!(
            x("", "1.png")
                .unwrap_err()
                .contains("image = \"right/1.png\"")
        );
    }
}
