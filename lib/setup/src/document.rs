//! The text of a first `pipeline.toml`.
use dipir_imaging::facts::Facts;
use glam::DVec3;

use crate::view::{Aim, View};

/// An object's table.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// As the file names it.
    pub path: String,
    /// Where it stands, pixels.
    pub at_pixel: [f64; 2],
    /// The line of its size, if it needs one.
    pub size_line: Option<String>,
    /// Where the size comes from.
    pub size_why: String,
}

/// What a first `pipeline.toml` says.
#[derive(Clone, Debug, PartialEq)]
pub struct Document {
    /// The photograph, as the file names it.
    pub photo: String,
    /// Of the photograph.
    pub facts: Facts,
    /// What the object is called.
    pub class: String,
    /// Where that comes from.
    pub class_why: &'static str,
    /// At least one.
    pub objects: Vec<Object>,
    /// The photograph's camera.
    pub view: View,
}

impl Document {
    /// As TOML.
    pub fn text(&self) -> String {
        let mut text = String::from(
            "# Written by dipir init: a first guess that runs. Change what is wrong and run it again; what does\n\
             # not depend on it is kept. Paths are relative to this file. Lengths are in metres, +y is up, and\n\
             # pixels count from the top left corner of the upright photograph.\n\
             #   dipir run --set pipeline.quality=draft    a quick look\n\
             #   dipir run                                 the picture\n\n\
             [pipeline]\nout = \"out\"\nquality = \"standard\"            # draft | standard | high\n\n",
        );
        text += &self.scene();
        for object in &self.objects {
            text += &object.text();
        }
        text += &camera(&self.view);
        text += &format!(
            "[scene.proxy]                   # the ground that takes the shadow\n\
             plane = {{ point = [0.0, {}, 0.0], normal = [0.0, 1.0, 0.0] }}\n\n",
            number(self.view.ground_y, 6)
        );
        text += &light(&self.facts);
        text
    }

    fn scene(&self) -> String {
        let [w, h] = self.facts.size;
        let mut what = format!("{w} x {h} pixels");
        for name in [&self.facts.make, &self.facts.model].into_iter().flatten() {
            what += &format!(", {}", printable(name));
        }
        format!(
            "[scene]\nbackground = {}    # {what}\nclass = {}    # what the object is called: {}\n\n",
            quoted(&self.photo),
            quoted(&self.class),
            self.class_why
        )
    }
}

impl Object {
    fn text(&self) -> String {
        let [x, y] = self.at_pixel.map(|v| number(v, 1));
        let mut text = format!(
            "[[scene.objects]]\npath = {}\n\
             at_pixel = [{x}, {y}]    # where it stands on the ground\n\
             anchor = \"center\"               # the middle of the object stands there\n\
             yaw_deg = 0.0                   # turn, counter-clockwise from above; or to_pixel = [x, y], which it faces\n\
             # size: {}\n",
            quoted(&self.path),
            self.size_why
        );
        if let Some(line) = &self.size_line {
            text += line;
            text.push('\n');
        }
        text.push('\n');
        text
    }
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

/// The `[light]` table. The light is estimated from the photograph and from what its file holds of
/// the sun.
fn light(facts: &Facts) -> String {
    let mut known = Vec::new();
    let mut example = Vec::new();
    if let Some(time) = &facts.time {
        known.push(format!("the time {}", printable(time)));
        example.push(format!("time = {}", quoted(time)));
    }
    if let (Some(latitude), Some(longitude)) = (facts.latitude_deg, facts.longitude_deg) {
        known.push("the place".into());
        example.push(format!(
            "latitude = {}, longitude = {}",
            number(latitude, 5),
            number(longitude, 5)
        ));
    }
    if let Some(heading) = facts.heading {
        let north = if heading.magnetic { "magnetic" } else { "true" };
        known.push(format!(
            "the heading, {:.0} degrees from {north} north",
            heading.deg
        ));
        example.push(format!("heading_deg = {}", number(heading.deg, 1)));
    }
    let mut text = match known.is_empty() {
        true => String::from(
            "# The light is estimated from the photograph, whose file says nothing of time and place. Who knows\n\
             # where the sun was says so:\n",
        ),
        false => format!(
            "# The light is estimated from the photograph. Its file says {}, which are\n\
             # used for the sun; to say otherwise:\n",
            known.join(", ")
        ),
    };
    if example.is_empty() {
        example.push("azimuth_deg = 90.0, elevation_deg = 40.0".into());
    }
    text += &format!("# [light]\n# sun = {{ {} }}\n", example.join(", "));
    text
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
fn printable(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).collect()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use dipir_imaging::facts::Heading;
    use dipir_pipeline::config::Config;
    use dipir_scene::config::SceneConfig;
    use glam::DVec2;
    use proptest::prelude::*;

    use super::*;

    fn document(view: View) -> Document {
        Document {
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
            class: "chair".into(),
            class_why: "as the model's file",
            objects: vec![Object {
                path: "chair.glb".into(),
                at_pixel: [450.0, 400.3],
                size_line: Some("height_m = 1.0".into()),
                size_why: "a guess".into(),
            }],
            view,
        }
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
    fn numbers_are_short_and_always_have_a_point() {
        let written = [1.0, -0.0, 0.123456, 1e-9, -12.5, 1e6].map(|v| number(v, 3));
        assert_eq!(
            written,
            ["1.0", "0.0", "0.123", "0.0", "-12.5", "1000000.0"]
        );
        assert_eq!(number(12.0, 0), "12.0");
    }
}
