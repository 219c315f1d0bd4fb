//! The `[scene]` table: what is accepted, and the exact words for what is not.
use dipir_scene::config::{EffectSwitch, EffectsMode, ProxySettings, SceneConfig};
use dipir_scene::placement::{Rest, Size};

const OBJECT: &str = "[[objects]]\npath = \"car.glb\"\n";
const CAMERA: &str = "[camera]\nposition = [0, 1.6, 6]\nlook_at = [0, 0.5, 0]\nfov_deg = 40\n";

fn parse(text: &str) -> SceneConfig {
    toml::from_str(text).unwrap()
}

fn message(text: &str) -> String {
    parse(text).validate().unwrap_err().to_string()
}

/// A complete table with `line` first and `rest` last.
fn table(line: &str, rest: &str) -> String {
    format!("background = \"photo.jpg\"\n{line}\n{OBJECT}{CAMERA}{rest}")
}

#[test]
fn the_documented_table_is_accepted() {
    let settings = parse(
        r#"
        background = "data/demo/background.png"
        transfer = "srgb"
        class = "car"
        occluders = "mask.png"
        [[objects]]
        path = "data/demo/car.glb"
        position = [0.0, 0.0, 0.0]
        yaw_deg = 30.0
        height_m = 1.4
        rest = "proxy"
        [camera]
        position = [0.0, 1.6, 6.0]
        look_at = [0.0, 0.5, 0.0]
        fov_deg = 40.0
        [proxy]
        plane = { point = [0.0, 0.0, 0.0], normal = [0.0, 2.0, 0.0] }
        [effects]
        mode = "planned"
        tolerance = 0.002
        shadow = "on"
        clearcoat = "off"
        "#,
    )
    .validate()
    .unwrap();
    assert_eq!(settings.class, "car");
    let placement = settings.objects[0].placement;
    assert_eq!(placement.size, Size::Height(1.4));
    assert_eq!(placement.rest, Some(Rest::Proxy));
    assert!((placement.yaw_rad - std::f32::consts::FRAC_PI_6).abs() < f32::EPSILON);
    let ProxySettings::Plane(plane) = settings.proxy else {
        panic!("a plane");
    };
    assert_eq!(plane.normal, glam::Vec3::Y);
    assert_eq!(settings.effects.mode(), EffectsMode::Planned);
    let switches = settings.effects.switches();
    assert_eq!(switches.len(), 14);
    assert_eq!(switches[0], ("shadow", EffectSwitch::On));
    assert!(switches.contains(&("clearcoat", EffectSwitch::Off)));
    assert!(switches.contains(&("textures", EffectSwitch::Auto)));
}

#[test]
fn unknown_keys_are_refused() {
    for (text, key) in [
        ("backgrund = \"photo.jpg\"", "backgrund"),
        ("[camera]\nfov = 40", "fov"),
        ("[[objects]]\nyaw = 40", "yaw"),
        ("[proxy]\nplane = { up = [0, 1, 0] }", "up"),
        ("[effects]\nshadows = \"on\"", "shadows"),
    ] {
        let error = toml::from_str::<SceneConfig>(text).unwrap_err().to_string();
        assert!(error.contains(&format!("unknown field `{key}`")), "{error}");
    }
}

#[test]
fn missing_tables_say_what_to_write() {
    assert_eq!(
        message(""),
        "scene.background is missing; name the photograph: background = \"photo.jpg\""
    );
    assert_eq!(
        message("background = \"photo.jpg\""),
        "scene.objects is missing; add a table [[scene.objects]] with path = \"object.glb\""
    );
    assert_eq!(
        message(&format!("background = \"photo.jpg\"\n{OBJECT}")),
        "scene.camera is missing; add a table [scene.camera] with position, look_at and fov_deg, or with file"
    );
}

#[test]
fn wrong_values_are_quoted_with_the_accepted_form() {
    assert_eq!(
        message(&table("transfer = \"sgrb\"", "")),
        "scene.transfer is \"sgrb\"; accepted: \"srgb\", \"gamma22\" or \"linear\" (did you mean \"srgb\"?)"
    );
    let object = |line: &str| format!("background = \"photo.jpg\"\n{OBJECT}{line}\n{CAMERA}");
    assert_eq!(
        message(&object("scale = -1")),
        "scene.objects[0].scale is -1; accepted: a factor above 0, for instance scale = 1.0"
    );
    assert_eq!(
        message(&object("scale = 1\nheight_m = 2")),
        "scene.objects[0].scale and scene.objects[0].height_m cannot both be given; keep one of them"
    );
    assert_eq!(
        message(&object("position = [0, nan, 0]")),
        "scene.objects[0].position is [0.0, NaN, 0.0]; accepted: three finite numbers [x, y, z]"
    );
    assert_eq!(
        message(&object("position = [3e38, 0, 0]")),
        "scene.objects[0].position is [3e38, 0.0, 0.0]; accepted: metres, at most ten million from the origin, for instance [0.5, 0.0, -1.0]"
    );
    assert_eq!(
        message(&table("", "[proxy]\nplane = { point = [0, 0, -2e7] }")),
        "scene.proxy.plane.point is [0.0, 0.0, -20000000.0]; accepted: metres, at most ten million from the origin, for instance [0.5, 0.0, -1.0]"
    );
    assert_eq!(
        message(&object("rest = \"floor\"")),
        "scene.objects[0].rest is \"floor\"; accepted: \"proxy\", \"position\" or \"surface\""
    );
    assert_eq!(
        message(&object("rest = \"surface\"")),
        "scene.objects[0].at_pixel is missing; rest = \"surface\" stands the object on what is seen at it"
    );
    assert_eq!(
        message(&object("at_pixel = [3, 4]\nrest = \"surface\"")),
        "scene.depth is missing; rest = \"surface\" stands an object on what these depths show"
    );
    assert_eq!(
        message(&table("", "[proxy]\nplane = { normal = [0, 0, 0] }")),
        "scene.proxy.plane.normal is [0.0, 0.0, 0.0]; accepted: a direction that is not zero, for instance normal = [0.0, 1.0, 0.0]"
    );
    assert_eq!(
        message(&table("", "[effects]\ntolerance = 2")),
        "scene.effects.tolerance is 2; accepted: a display-referred error from 0 to 1, for instance tolerance = 0.002"
    );
    assert_eq!(
        message(&table("", "[effects]\nmax_depth = 9")),
        "scene.effects.max_depth is 9; accepted: interactions from 1 to 8, for instance max_depth = 3"
    );
    assert_eq!(
        message(&table("", "[limits]\nphoto_megapixels = 269")),
        "scene.limits.photo_megapixels is 269; accepted: millions of pixels up to 268, of which the result's files have no \
         more, for instance photo_megapixels = 250"
    );
    let most = table("", "[limits]\nphoto_megapixels = 268");
    parse(&most).validate().unwrap();
}

#[test]
fn an_empty_path_is_refused_by_its_key() {
    for (table, key) in [
        (table("", "[proxy]\nmesh = \"\""), "scene.proxy.mesh"),
        (table("", "[proxy]\npoints = \" \""), "scene.proxy.points"),
        (table("occluders = \"\"", ""), "scene.occluders"),
        (table("depth = \"\"", ""), "scene.depth"),
        (
            format!("background = \"\"\n{OBJECT}{CAMERA}"),
            "scene.background",
        ),
        (
            format!("background = \"photo.jpg\"\n[[objects]]\npath = \"\"\n{CAMERA}"),
            "scene.objects[0].path",
        ),
    ] {
        assert_eq!(
            message(&table),
            format!("{key} is empty; accepted: the name of a file")
        );
    }
}

#[test]
fn a_pixel_and_what_it_stands_for_exclude_each_other() {
    let object = |lines: &str| format!("background = \"photo.jpg\"\n{OBJECT}{lines}\n{CAMERA}");
    assert_eq!(
        message(&object("position = [0, 0, 0]\nat_pixel = [3, 4]")),
        "scene.objects[0].at_pixel and scene.objects[0].position cannot both be given; keep one of them"
    );
    assert_eq!(
        message(&object("yaw_deg = 0\nto_pixel = [3, 4]")),
        "scene.objects[0].to_pixel and scene.objects[0].yaw_deg cannot both be given; keep one of them"
    );
    assert_eq!(
        message(&object("at_pixel = [nan, 4]")),
        "scene.objects[0].at_pixel is [NaN, 4.0]; accepted: two finite numbers [x, y], pixels from the photograph's top left corner"
    );
}

#[test]
fn a_pitch_turns_the_camera_upwards_and_a_roll_clockwise() {
    let text = format!(
        "background = \"photo.jpg\"\n{OBJECT}[camera]\nposition = [3, 1, 5]\npitch_deg = 30\nroll_deg = 90\nfov_deg = 40"
    );
    let settings = parse(&text).validate().unwrap();
    let (camera, _) = settings.camera.resolve([60, 40], "".as_ref()).unwrap();
    let (sin, cos) = 30f32.to_radians().sin_cos();
    let forward = -camera.rotation.z_axis;
    // Roundings of the point that the camera looks at, a few units away.
    assert!(forward.distance(glam::Vec3::new(0.0, sin, -cos)) < 1e-5);
    // Clockwise: what was up in the image points to the right of the scene.
    assert!(camera.rotation.y_axis.distance(glam::Vec3::X) < 1e-5);
}

#[test]
fn wrong_cameras_are_explained() {
    let camera = |lines: &str| format!("background = \"photo.jpg\"\n{OBJECT}[camera]\n{lines}");
    let stands = "position = [0, 1, 5]\nlook_at = [0, 1, 0]\n";
    assert_eq!(
        message(&camera(&format!("{stands}fov_deg = 190"))),
        "scene.camera.fov_deg is 190; accepted: a vertical field of view between 0 and 180 degrees, for instance fov_deg = 40.0"
    );
    // Whether the photograph knows its lens and its sensor is seen when it is read.
    for lines in [stands.to_string(), format!("{stands}focal_mm = 35")] {
        assert!(parse(&camera(&lines)).validate().is_ok());
    }
    assert_eq!(
        message(&camera(&format!("{stands}pitch_deg = -5"))),
        "scene.camera.pitch_deg and scene.camera.look_at cannot both be given; keep one of them"
    );
    assert_eq!(
        message(&camera("position = [0, 1, 5]\npitch_deg = -95")),
        "scene.camera.pitch_deg is -95; accepted: degrees from -90 to 90, for instance pitch_deg = -5.0"
    );
    assert_eq!(
        message(&camera(&format!("{stands}fov_deg = 40\nfocal_mm = 35"))),
        "scene.camera.fov_deg and scene.camera.focal_mm cannot both be given; keep one of them"
    );
    assert_eq!(
        message(&camera(
            "position = [0, 1, 5]\nlook_at = [0, 1, 5]\nfov_deg = 40"
        )),
        "scene.camera.look_at is [0.0, 1.0, 5.0]; accepted: a point away from scene.camera.position"
    );
    assert_eq!(
        message(&camera(
            "position = [0, 5, 0]\nlook_at = [0, 0, 0]\nfov_deg = 40"
        )),
        "scene.camera.up is [0.0, 1.0, 0.0]; accepted: a direction across the line of sight; looking straight down or up, write up = [0.0, 0.0, -1.0]"
    );
    assert_eq!(
        message(&camera("transforms = \"transforms.json\"\nfov_deg = 40")),
        "scene.camera.transforms and scene.camera.fov_deg cannot both be given; keep one of them"
    );
    assert_eq!(
        message(&camera(&format!("{stands}fov_deg = 40\nframe = 1"))),
        "scene.camera.file is missing; name the camera's file that scene.camera.frame is about"
    );
}

#[test]
fn keys_of_depths_are_checked_and_switched_off_with_the_effect() {
    for (lines, said) in [
        (
            "depth_kind = \"depth\"",
            "scene.depth is missing; name the file of depths, or remove scene.depth_kind",
        ),
        (
            "depth_scale = 1.0",
            "scene.depth is missing; name the file of depths, or remove scene.depth_scale",
        ),
        (
            "depth_surfaces = false",
            "scene.depth is missing; name the file of depths, or remove scene.depth_surfaces",
        ),
        (
            "depth = \"d.png\"\ndepth_scale = 0.0",
            "scene.depth_scale is 0",
        ),
        (
            "depth = \"d.png\"\ndepth_kind = \"disprity\"",
            "did you mean \"disparity\"?",
        ),
        (
            "depth = \"d.png\"\ndepth_kind = \"disparity\"\ndepth_scale = 1.0",
            "cannot both be given",
        ),
    ] {
        let found = message(&table(lines, ""));
        assert!(found.contains(said), "{found}");
    }
    let both =
        "depth = \"d.png\"\ndepth_kind = \"depth\"\ndepth_scale = 0.5\noccluders = \"m.png\"";
    let settings = parse(&table(both, "")).validate().unwrap();
    assert_eq!(settings.depth.unwrap().scale, Some(0.5));
    let rests = format!(
        "background = \"photo.jpg\"\ndepth = \"d.png\"\n{OBJECT}at_pixel = [3, 4]\nrest = \"surface\"\n{CAMERA}"
    );
    parse(&rests).validate().unwrap();
    assert_eq!(
        message(&format!("{rests}\n[effects]\noccluders = \"off\"")),
        "scene.effects.occluders is \"off\"; accepted: \"auto\", for rest = \"surface\" stands an object on what these depths show"
    );
    let off = parse(&table(both, "[effects]\noccluders = \"off\""));
    let settings = off.validate().unwrap();
    assert!(settings.depth.is_none() && settings.occluders.is_none());
}

#[test]
fn a_mask_of_occluders_that_is_switched_off_is_not_used() {
    let of = |effects: &str| {
        let settings = parse(&table("occluders = \"mask.png\"", effects)).validate();
        settings.unwrap().occluders
    };
    assert_eq!(of(""), Some("mask.png".into()));
    assert_eq!(
        of("[effects]\noccluders = \"on\"\n"),
        Some("mask.png".into())
    );
    assert_eq!(of("[effects]\noccluders = \"off\"\n"), None);
}
