//! The text of a first `pipeline.toml`.
use dipir_imaging::facts::Facts;
use glam::DVec3;

use crate::light::{comment, light};
use crate::model::Raised;
use crate::view::{Aim, CameraFile, View};

/// An object's table.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// As the file names it.
    pub path: String,
    /// Where it stands, pixels.
    pub at_pixel: [f64; 2],
    /// Whether a free place is looked for instead.
    pub auto: bool,
    /// The line of its size, if it needs one.
    pub size_line: Option<String>,
    /// Where the size comes from.
    pub size_why: String,
    /// How wide and how high it appears at that pixel, pixels.
    pub appears_px: Option<[f64; 2]>,
    /// Whether its file may have it on its back.
    pub may_lie: bool,
}

/// What a first `pipeline.toml` says.
#[derive(Clone, Debug, PartialEq)]
pub struct Document {
    /// The folder of the results.
    pub out: String,
    /// The photograph, as the file names it.
    pub photo: String,
    /// Of the photograph.
    pub facts: Facts,
    /// Whether it has a gain map that can be used.
    pub has_gain: bool,
    /// What the object is called.
    pub class: String,
    /// Where that comes from.
    pub class_why: &'static str,
    /// At least one.
    pub objects: Vec<Object>,
    /// The photograph's camera.
    pub view: View,
    /// Its file, as the configuration names it, where the view has one.
    pub camera_file: Option<String>,
    /// Other photographs of the place with cameras in that file, as the configuration names them.
    pub views: Vec<String>,
    /// Points that tell the ground.
    pub points: Option<Points>,
    /// Depths that tell what stands in front, as the file names them.
    pub depth: Option<String>,
    /// Limits that the models exceed.
    pub raised: Vec<Raised>,
}

/// Points of the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Points {
    /// As the file names them.
    pub path: String,
    /// Where their sensor stood, as the file names it.
    pub pose: Option<String>,
    /// Which axis of them points up: `z`.
    pub up: Option<&'static str>,
    /// The ground in them, and how sure it is.
    pub words: String,
}

impl Document {
    /// As TOML.
    pub fn text(&self) -> String {
        let mut text = String::from(
            "# Written by dipir init: a first guess that runs. Change what is wrong and run it again; what does\n\
             # not depend on it is kept. Relative paths begin at this file. Lengths are in metres, +y is up, and\n\
             # pixels count from the top left corner of the upright photograph.\n\
             #   dipir place          a page in the browser: put objects, camera and light right\n\
             #   dipir preview        the same view as preview.png\n\
             #   dipir run --draft    a quick look; with --watch again after every change\n\
             #   dipir run            the picture\n\n\
             [pipeline]\n",
        );
        text += &format!(
            "out = {}\nquality = \"standard\"            # draft | standard | high\n\n",
            quoted(&self.out)
        );
        text += &self.scene();
        for object in &self.objects {
            text += &object.text(self.facts.size);
        }
        text += &match (&self.camera_file, &self.view.file) {
            (Some(name), Some(file)) => camera_of_file(name, file, &self.view),
            _ => camera(&self.view),
        };
        text += "[scene.proxy]                   # the ground that takes the shadow\n";
        text += &match &self.points {
            Some(points) => points.text(),
            None => format!(
                "plane = {{ point = [0.0, {}, 0.0], normal = [0.0, 1.0, 0.0] }}\n\n",
                number(self.view.ground_y, 6)
            ),
        };
        for (k, view) in self.views.iter().enumerate() {
            text += if k == 0 { ELSEWHERE } else { "" };
            text += &format!("[[scene.views]]\nbackground = {}\n\n", quoted(view));
        }
        if !self.raised.is_empty() {
            text += "[scene.limits]\n";
            for raised in &self.raised {
                text += &comment(&printable(&format!("raised {}", raised.why)));
                text += &format!("{} = {}\n", raised.key, raised.value);
            }
            text.push('\n');
        }
        text += &light(&self.facts);
        text
    }

    fn scene(&self) -> String {
        let [w, h] = self.facts.size;
        let mut what = format!("{w} x {h} pixels");
        for name in [&self.facts.make, &self.facts.model].into_iter().flatten() {
            what += &format!(", {}", printable(name));
        }
        if self.has_gain {
            what +=
                ", with a gain map: how bright what it shows is beyond white is part of the light";
        }
        let mut text = format!(
            "[scene]\nbackground = {}    # {what}\nclass = {}    # what the object is called: {}\n",
            quoted(&self.photo),
            quoted(&self.class),
            self.class_why
        );
        if let Some(depth) = &self.depth {
            let depth = quoted(depth);
            text += &format!(
                "depth = {depth}    # what is nearer than an object is in front of it, what is beside the ground catches its shadow\n"
            );
        }
        text + "\n"
    }
}

/// Stands before other photographs of the place.
const ELSEWHERE: &str =
    "# other pictures of the camera's file, which look elsewhere: they tell the light, too\n";
/// What appears smaller shows little of itself, pixels.
const SMALL_PX: f64 = 24.0;
/// What is this many times as wide as high is told by its width.
const LOW: f64 = 4.0;

impl Object {
    /// How large it appears: `appears 41 pixels high`, and what to do if that is little or more than the `picture`, pixels.
    pub fn appearance(&self, picture: [u32; 2]) -> Option<String> {
        let [width, height] = self.appears_px?;
        let (pixels, way) = match width > LOW * height {
            true => (width, "wide"),
            false => (height, "high"),
        };
        let count = format!("{pixels:.0}");
        let unit = if count == "1" { "pixel" } else { "pixels" };
        let [across, down] = picture.map(f64::from);
        let advice = if pixels < SMALL_PX {
            ", which is small: for a close-up lower the camera (--eye-height), or move the object down in the picture \
             (at_pixel)"
        } else if width > across || height > down {
            ", which is more than the picture: make it smaller (--height-m), or move it up in the picture (at_pixel)"
        } else {
            ""
        };
        Some(format!("appears {count} {unit} {way}{advice}"))
    }

    fn text(&self, picture: [u32; 2]) -> String {
        let [x, y] = self.at_pixel.map(|v| number(v, 1));
        let place = match self.auto {
            true => format!(
                "place = \"auto\"                  # free ground that is seen; or at_pixel = [{x}, {y}], and place_draw = 1 for another\n"
            ),
            false => format!(
                "at_pixel = [{x}, {y}]    # where it stands on the ground\n\
                 anchor = \"center\"               # the middle of the object stands there\n"
            ),
        };
        let size = format!("# size: {}\n", self.size_why);
        // A comment goes with the key below it when an object is removed or copied, so none stands behind the last key.
        let mut text = "[[scene.objects]]\n".to_owned();
        if let Some(words) = self.appearance(picture) {
            text += &comment(&format!("at pixel {x}, {y} it {words}"));
        }
        if self.size_line.is_none() {
            text += &size;
        }
        text += &format!("path = {}\n{place}", quoted(&self.path));
        if self.may_lie {
            text += "# pitch_deg = -90.0             # if it lies on its back\n";
        }
        text += "yaw_deg = 0.0                   # turn, counter-clockwise from above; or to_pixel = [x, y], which it faces\n";
        if let Some(line) = &self.size_line {
            text += &format!("{size}{line}\n");
        }
        text.push('\n');
        text
    }
}

impl Points {
    fn text(&self) -> String {
        let mut text = format!(
            "# ground: {}; or plane = {{ … }}\npoints = {}\n",
            self.words,
            quoted(&self.path)
        );
        if let Some(pose) = &self.pose {
            text += &format!("points_pose = {}\n", quoted(pose));
        }
        if let Some(up) = self.up {
            text += &format!("points_up = \"{up}\"\n");
        }
        text + "\n"
    }
}

fn camera_of_file(name: &str, file: &CameraFile, view: &View) -> String {
    let mut text = format!(
        "[scene.camera]\n# {}\n# {}\nfile = {}\n",
        view.position_why,
        file.why,
        quoted(name)
    );
    if let Some(image) = &file.image {
        text += &format!("image = {}\n", quoted(image));
    }
    if let Some(frame) = file.frame {
        text += &format!("frame = {frame}\n");
    }
    if let Some(up) = file.up {
        text += &format!("file_up = \"{}\"\n", up.word());
    }
    if let Some(fov_deg) = file.fov_deg {
        let fov_deg = number(fov_deg, 5);
        text += &format!("fov_deg = {fov_deg}    # vertical, which the file does not say\n");
    }
    if name.to_ascii_lowercase().ends_with(".chan") {
        text += "# file_rotation_order = \"xyz\"    # of Blender's export, unless its rotation order was set to ZXY\n";
    }
    text + "\n"
}

fn camera(view: &View) -> String {
    let mut text = format!(
        "[scene.camera]\n# position: {}\nposition = {}\n",
        view.position_why,
        triple(view.position)
    );
    match view.aim {
        Aim::Turned {
            pitch_deg,
            roll_deg,
        } => {
            text += &format!(
                "# pitch and roll: {}\n\
                 pitch_deg = {}    # upwards\n\
                 roll_deg = {}    # clockwise\n",
                view.aim_why,
                number(pitch_deg, 2),
                number(roll_deg, 2)
            );
        }
        Aim::At { look_at, up } => {
            text += &format!(
                "# where it looks: {}\nlook_at = {}\nup = {}\n",
                view.aim_why,
                triple(look_at),
                triple(up)
            );
        }
    }
    if let Some(p) = view.principal_px {
        let [x, y] = [p.x, p.y].map(|v| number(v, 3));
        text += &format!("principal_px = [{x}, {y}]\n");
    }
    text + &format!(
        "# field of view: {}\nfov_deg = {}    # vertical\n\n",
        view.fov_why,
        number(view.fov_deg, 5)
    )
}

/// A number as TOML, with at most `digits` behind the point and at least one.
pub(crate) fn number(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    let text = match text.contains('.') {
        true => text.trim_end_matches('0'),
        false => &text,
    };
    let text = match text.ends_with('.') || !text.contains('.') {
        true => format!("{}.0", text.trim_end_matches('.')),
        false => text.into(),
    };
    match text.as_str() {
        "-0.0" => "0.0".into(),
        _ => text,
    }
}

fn triple(v: DVec3) -> String {
    let [x, y, z] = v.to_array().map(|x| number(x, 6));
    format!("[{x}, {y}, {z}]")
}

/// A basic string of TOML.
pub(crate) fn quoted(text: &str) -> String {
    let mut quoted = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c.is_control() => quoted += &format!("\\u{:04X}", u32::from(c)),
            c => quoted.push(c),
        }
    }
    quoted.push('"');
    quoted
}

/// Text that ends no comment.
pub(crate) fn printable(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).collect()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use dipir_cameras::WorldUp;
    use dipir_imaging::facts::Heading;
    use dipir_pipeline::config::Config;
    use dipir_scene::config::SceneConfig;
    use glam::DVec2;
    use proptest::prelude::*;

    use super::*;

    fn document(view: View) -> Document {
        Document {
            out: "out".into(),
            photo: "my \"best\"\\photo\n.jpg".into(),
            facts: Facts {
                make: Some("Maker\nof = 1".into()),
                time: Some("2026-06-21T12:34:56+02:00".into()),
                latitude_deg: Some(48.1),
                longitude_deg: Some(-11.5),
                heading: Some(Heading {
                    deg: 213.4,
                    magnetic: true,
                }),
                ..Facts::of_size([900, 600])
            },
            has_gain: false,
            class: "chair".into(),
            class_why: "as the model's file",
            objects: vec![Object {
                path: "chair.glb".into(),
                at_pixel: [450.0, 400.3],
                auto: false,
                size_line: Some("height_m = 1.0".into()),
                size_why: "a guess".into(),
                appears_px: Some([80.0, 120.0]),
                may_lie: false,
            }],
            view,
            camera_file: None,
            views: Vec::new(),
            points: None,
            depth: None,
            raised: vec![],
        }
    }

    #[test]
    fn points_a_file_and_a_free_place_are_keys_that_are_read() {
        let mut document = document(View {
            file: Some(CameraFile {
                path: "rig.json".into(),
                up: Some(WorldUp::Z),
                fov_deg: None,
                image: None,
                frame: None,
                why: "it has several cameras",
            }),
            ..View::default()
        });
        document.camera_file = Some("rig.json".into());
        assert!(!document.text().contains("with a gain map"));
        document.has_gain = true;
        assert!(document.text().contains(", with a gain map: how bright"));
        document.objects[0].auto = true;
        document.points = Some(Points {
            path: "scan.bin".into(),
            pose: Some("calib.txt".into()),
            up: Some(WorldUp::Z.word()),
            words: "a plane".into(),
        });
        let config = scene(&document.text());
        config.validate().unwrap();
        assert_eq!(config.objects[0].place.as_deref(), Some("auto"));
        assert_eq!(config.camera.unwrap().file_up.as_deref(), Some("z"));
        assert_eq!(config.proxy.unwrap().points_up.as_deref(), Some("z"));
    }

    /// The `[scene]` table, read as the stages read it.
    fn scene(text: &str) -> SceneConfig {
        let config = Config::parse(Path::new("pipeline.toml"), text, &[]).unwrap();
        config.pipeline().unwrap();
        config.table("scene").unwrap()
    }

    proptest! {
        #[test]
        fn the_text_is_a_configuration_of_the_same_camera(
            pitch_deg in -80.0f64..80.0, roll_deg in -10.0f64..10.0, fov_deg in 5.0f64..120.0,
            eye in 0.1f64..50.0, by_point in any::<bool>(), shifted in any::<bool>(),
        ) {
            let turned = View {
                aim: Aim::Turned { pitch_deg, roll_deg },
                ..View::default()
            };
            let rotation = turned.camera([900, 600]).rotation.as_dmat3();
            let position = DVec3::new(1.25, eye, -3.5);
            let aim = match by_point {
                true => Aim::At {
                    look_at: position - 5.0 * rotation.z_axis,
                    up: rotation.y_axis,
                },
                false => turned.aim,
            };
            let principal_px = shifted.then_some(DVec2::new(431.5, 307.25));
            let view = View { position, aim, fov_deg, principal_px, ..turned };
            let document = document(view.clone());
            let config = scene(&document.text());
            prop_assert_eq!(config.background.as_ref().unwrap().to_str(), Some(&*document.photo));
            let settings = config.validate().unwrap();
            let (camera, _) = settings.camera.resolve([900, 600], Path::new("")).unwrap();
            let want = view.camera([900, 600]);
            // Angles are written to a hundredth of a degree, half of which is 9e-5.
            let apart = camera.rotation - want.rotation;
            prop_assert!(apart.to_cols_array().iter().all(|e| e.abs() < 3e-4), "{}", apart);
            prop_assert!(camera.position.distance(want.position) < 1e-5);
            prop_assert!((camera.focal_px / want.focal_px - 1.0).abs().max_element() < 1e-5);
            prop_assert_eq!(camera.principal_px, want.principal_px);
            let at = settings.objects[0].pixels.at.unwrap();
            prop_assert_eq!(at, glam::Vec2::new(450.0, 400.3));
        }
    }

    #[test]
    fn the_sun_in_the_comment_is_a_table_that_is_read() {
        let text = document(View::default()).text();
        let (before, after) = text.split_once("# [light]\n# sun").unwrap();
        let uncommented = format!("{before}[light]\nsun{after}");
        let config = Config::parse(Path::new("pipeline.toml"), &uncommented, &[]).unwrap();
        assert!(config.has("light.sun.heading_deg") && config.has("light.sun.latitude"));
    }

    #[test]
    fn raised_limits_and_the_folder_of_the_results_are_keys_that_are_read() {
        let mut document = document(View::default());
        document.out = "out-b \"2\"".into();
        document.raised = vec![Raised {
            key: "texture_pixels",
            value: 1 << 28,
            why: "for \"a\nb.glb\": it has many".into(),
        }];
        let text = document.text();
        assert_eq!(scene(&text).limits.texture_pixels, 1 << 28);
        let config = Config::parse(Path::new("pipeline.toml"), &text, &[]).unwrap();
        assert_eq!(config.pipeline().unwrap().out, Path::new("out-b \"2\""));
    }

    #[test]
    fn other_photographs_are_tables_that_are_read() {
        let mut document = document(View::default());
        document.views = vec!["b \"1\".jpg".into(), "c.jpg".into()];
        let views = scene(&document.text()).views;
        let read: Vec<_> = views
            .iter()
            .map(|v| v.background.clone().unwrap())
            .collect();
        assert_eq!(read, [Path::new("b \"1\".jpg"), Path::new("c.jpg")]);
    }

    #[test]
    fn what_may_lie_on_its_back_gets_the_line_that_turns_it() {
        let mut document = document(View::default());
        assert!(!document.text().contains("on its back"));
        document.objects[0].may_lie = true;
        let text = document.text();
        assert_eq!(scene(&text).objects[0].pitch_deg, None);
        let turned = text.replace("# pitch_deg = -90.0 ", "pitch_deg = -90.0 ");
        assert_eq!(scene(&turned).objects[0].pitch_deg, Some(-90.0));
    }

    #[test]
    fn how_large_an_object_appears_is_said_and_a_small_one_told() {
        let mut document = document(View::default());
        assert!(
            document
                .text()
                .contains("\n# at pixel 450.0, 400.3 it appears 120 pixels high\n")
        );
        let object = &mut document.objects[0];
        let mut of = |size| {
            object.appears_px = Some(size);
            object.appearance([900, 600]).unwrap()
        };
        assert_eq!(of([30.0, 41.3]), "appears 41 pixels high");
        assert_eq!(of([300.0, 2.0]), "appears 300 pixels wide");
        let small = of([20.0, 23.0]);
        for part in ["23 pixels high, which is small", "--eye-height", "at_pixel"] {
            assert!(small.contains(part), "{part}: {small}");
        }
        let large = of([500.0, 601.0]);
        assert!(
            large.contains("601 pixels high, which is more than the picture"),
            "{large}"
        );
        object.appears_px = None;
        assert_eq!(object.appearance([900, 600]), None);
    }

    #[test]
    fn comments_of_an_object_stand_above_one_of_its_keys() {
        let mut document = document(View::default());
        document.objects[0].may_lie = true;
        for size_line in [None, Some("height_m = 1.0".to_owned())] {
            document.objects[0].size_line = size_line;
            let text = document.objects[0].text([900, 600]);
            let last = text.trim_end().lines().last().unwrap();
            assert!(!last.starts_with('#'), "{text}");
            assert!(text.contains("# size: "), "{text}");
        }
    }

    #[test]
    fn numbers_are_short_and_always_have_a_point() {
        let written = [1.0, -0.0, 0.123456, 1e-9, -12.5, 1e6].map(|v| number(v, 3));
        assert_eq!(
            written,
            ["1.0", "0.0", "0.123", "0.0", "-12.5", "1000000.0"]
        );
        assert_eq!(number(12.0, 0), "12.0");
    }
}
