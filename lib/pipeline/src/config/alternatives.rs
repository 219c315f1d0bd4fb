//! Keys that exclude each other. One that is set on the command line takes the place of those that the file sets.
use std::path::Path;

use super::tree::Node;

/// Tables, and the keys of each way to say the same: the keys of one way exclude those of the others.
const ALTERNATIVES: &[(&str, &[&str])] = &[
    (OBJECT, &["position", "at_pixel", "place place_draw"]),
    (OBJECT, &["yaw_deg", "to_pixel"]),
    (OBJECT, &["scale", "height_m"]),
    (CAMERA, &["look_at up", "pitch_deg roll_deg heading_deg"]),
    (CAMERA, &["fov_deg", "focal_mm sensor_mm"]),
    (CAMERA, &["image", "frame"]),
    (PROXY, &["plane", "mesh", POINTS, PIXELS]),
    (PROXY, &["lengths_m", "camera_height_m"]),
    ("light.sun", &["time", "azimuth_deg elevation_deg"]),
    ("composite", &["target_error", "time_budget_s"]),
    ("composite", &["focus_m", "focus_at_pixel"]),
    ("composite", &["f_number", "aperture_mm"]),
];

/// Tables, a key, and keys that it replaces and that do not replace it.
const REPLACED: &[(&str, &str, &str)] = &[
    (OBJECT, "place", "anchor"),
    (CAMERA, "file", "transforms transforms_up"),
    (CAMERA, "file", STAND),
    (CAMERA, "file", LENS),
    (CAMERA, "transforms", "file file_up file_scale image"),
    (CAMERA, "transforms", STAND),
    (CAMERA, "transforms", LENS),
];

const OBJECT: &str = "scene.objects.N";
const CAMERA: &str = "scene.camera";
const PROXY: &str = "scene.proxy";
const POINTS: &str = "points points_up points_scale points_pose points_shape";
const PIXELS: &str = "pixels lengths_m rectangle camera_height_m";
/// Where a camera is and looks.
const STAND: &str = "position look_at up pitch_deg roll_deg heading_deg";
const LENS: &str = "principal_px fov_deg focal_mm sensor_mm distortion";

/// Removes from `root` what the file sets and `overrides`, which have been applied, replace.
pub(super) fn drop_replaced(root: &mut Node, overrides: &[String]) {
    let set: Vec<(Vec<&str>, &str)> = overrides
        .iter()
        .filter_map(|text| text.split_once('='))
        .map(|(key, value)| (key.split('.').map(str::trim).collect(), value.trim()))
        .collect();
    // As a whole, in part, or within a table.
    let is_set = |key: &[&str]| {
        let mut steps = set.iter().map(|(steps, _)| steps);
        steps.any(|s| s.starts_with(key) || key.starts_with(s))
    };
    for (steps, value) in &set {
        for (depth, key) in steps.iter().enumerate().skip(1) {
            let table = &steps[..depth];
            for other in replaced_by(&name_of(table), key, value) {
                let other = [table, &[other]].concat();
                if !is_set(&other) {
                    root.remove(&other);
                }
            }
        }
    }
}

/// A table's name in the lists above.
fn name_of(table: &[&str]) -> String {
    let is_index = |step: &str| step.bytes().all(|b| b.is_ascii_digit());
    let steps = table.iter().map(|s| if is_index(s) { "N" } else { s });
    match steps.collect::<Vec<_>>().join(".") {
        name if name == "scene.views.N.camera" => CAMERA.into(),
        name => name,
    }
}

/// The keys of `table` that `key`, set to `value`, replaces.
fn replaced_by(table: &str, key: &str, value: &str) -> Vec<&'static str> {
    let is_of = |way: &str| way.split(' ').any(|k| k == key);
    let ways = ALTERNATIVES
        .iter()
        .filter(|(name, ways)| *name == table && ways.iter().any(|way| is_of(way)))
        .flat_map(|(_, ways)| ways.iter().copied().filter(|way| !is_of(way)));
    let one_sided = REPLACED
        .iter()
        .filter(|(name, by, _)| (*name, *by) == (table, key))
        .map(|(_, _, keys)| *keys);
    let keys = ways.chain(one_sided).flat_map(|keys| keys.split(' '));
    keys.filter(|k| key != "file" || !completes(k, value))
        .collect()
}

/// Whether a camera's `file` may lack what `key` says: OpenCV's files describe the lens alone, `.chan` and glTF no lens,
/// `.chan` files may lack the field of view.
fn completes(key: &str, file: &str) -> bool {
    let extension = Path::new(file.trim_matches(['"', '\''])).extension();
    match extension.and_then(|e| e.to_str()) {
        Some("yaml" | "yml" | "json") => STAND.split(' ').any(|k| k == key),
        Some("chan") => ["fov_deg", "distortion", "principal_px"].contains(&key),
        Some("glb" | "gltf") => ["distortion", "principal_px"].contains(&key),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::super::Config;

    fn config(text: &str, set: &[&str]) -> Config {
        let set: Vec<String> = set.iter().map(|s| (*s).into()).collect();
        Config::parse("pipeline.toml".as_ref(), text, &set).unwrap()
    }

    const TEXT: &str = r#"
[scene.camera]
position = [0.0, 1.0, 4.0]
look_at = [0.0, 0.0, 0.0]
focal_mm = 35.0
sensor_mm = 36.0
distortion = { k1 = -0.1 }
[scene.proxy]
points = "scan.bin"
points_up = "z"
[[scene.objects]]
place = "auto"
place_draw = 2
yaw_deg = 30.0
[[scene.objects]]
position = [0.0, 0.0, 0.0]
anchor = "center"
[light]
sun = { time = "2026-06-21T12:34:56+02:00", latitude = 48.1, longitude = 11.6 }
"#;

    #[test]
    fn a_flag_takes_the_place_of_the_files_alternatives() {
        for (set, gone, left) in [
            (
                "scene.objects.0.at_pixel=[10, 20]",
                "scene.objects.0.place scene.objects.0.place_draw",
                "scene.objects.0.at_pixel scene.objects.0.yaw_deg scene.objects.1.position",
            ),
            (
                "scene.objects.0.to_pixel=[10, 20]",
                "scene.objects.0.yaw_deg",
                "scene.objects.0.place",
            ),
            (
                "scene.objects.1.place=auto",
                "scene.objects.1.position scene.objects.1.anchor",
                "scene.objects.0.place",
            ),
            (
                "scene.objects.0.anchor=center",
                "",
                "scene.objects.0.place scene.objects.0.anchor",
            ),
            (
                "scene.camera.fov_deg=40",
                "scene.camera.focal_mm scene.camera.sensor_mm",
                "scene.camera.look_at",
            ),
            (
                "scene.camera.heading_deg=40",
                "scene.camera.look_at",
                "scene.camera.position scene.camera.focal_mm",
            ),
            (
                "scene.camera.file=shot.fspy",
                "scene.camera.position scene.camera.look_at scene.camera.focal_mm scene.camera.distortion",
                "scene.camera.file",
            ),
            (
                "scene.camera.file=shot.chan",
                "scene.camera.position scene.camera.focal_mm",
                "scene.camera.distortion",
            ),
            (
                "scene.camera.file=lens.yaml",
                "scene.camera.focal_mm",
                "scene.camera.position scene.camera.look_at",
            ),
            (
                "scene.proxy.plane.normal=[0, 1, 0]",
                "scene.proxy.points scene.proxy.points_up",
                "scene.proxy.plane.normal",
            ),
            (
                "light.sun.azimuth_deg=60",
                "light.sun.time",
                "light.sun.latitude light.sun.longitude",
            ),
        ] {
            let config = config(TEXT, &[set]);
            let has = |key: &&str| config.has(key);
            assert_eq!(gone.split_whitespace().find(has), None, "{set}");
            assert!(left.split(' ').all(|k| has(&k)), "{set}");
        }
    }

    #[test]
    fn alternatives_that_are_both_flags_or_both_of_the_file_stay() {
        let both = |set: &[&str]| {
            let config = config(TEXT, set);
            let keys = ["position", "at_pixel"].map(|k| format!("scene.objects.1.{k}"));
            keys.iter().all(|key| config.has(key))
        };
        let [position, pixel] = ["position=[1, 0, 0]", "at_pixel=[10, 20]"];
        assert!(both(&[
            &format!("scene.objects.1.{position}"),
            &format!("scene.objects.1.{pixel}")
        ]));
        assert!(both(&[
            "scene.objects.1={position = [1, 0, 0]}",
            &format!("scene.objects.1.{pixel}")
        ]));
        let text = TEXT.replace("anchor", "at_pixel = [1.0, 2.0]\nanchor");
        let config = config(&text, &["scene.objects.1.scale=2"]);
        assert!(config.has("scene.objects.1.position") && config.has("scene.objects.1.at_pixel"));
    }

    #[test]
    fn a_view_has_the_alternatives_of_a_camera() {
        let text = "[[scene.views]]\ncamera = { fov_deg = 40.0, heading_deg = 90.0 }\n";
        let config = config(text, &["scene.views.0.camera.focal_mm=35"]);
        assert!(!config.has("scene.views.0.camera.fov_deg"));
        assert!(config.has("scene.views.0.camera.heading_deg"));
    }
}
