use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::*;

#[derive(Debug, Default, Deserialize, PartialEq)]
#[serde(rename_all = "snake_case")]
enum Transfer {
    #[default]
    Srgb,
    Gamma22,
}

#[derive(Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
struct Object {
    path: PathBuf,
    #[serde(default)]
    position: [f32; 3],
}

#[derive(Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
struct Scene {
    background: PathBuf,
    #[serde(default)]
    transfer: Transfer,
    #[serde(default)]
    samples: Option<u32>,
    #[serde(default)]
    objects: Vec<Object>,
}

const TEXT: &str = r#"# a comment
[pipeline]
seed = 7

[scene]
background = "photo.png"
transfer = "gamma22"

[[scene.objects]]
path = "car.glb"
position = [0, 1.5, 0]
"#;

fn parse(text: &str, set: &[&str]) -> Result<Config, ConfigError> {
    let set: Vec<String> = set.iter().map(|s| (*s).into()).collect();
    Config::parse(Path::new("pipeline.toml"), text, &set)
}

fn scene(text: &str, set: &[&str]) -> Result<Scene, ConfigError> {
    parse(text, set)?.table("scene")
}

fn message(text: &str, set: &[&str]) -> String {
    scene(text, set).unwrap_err().to_string()
}

#[test]
fn reads_tables_into_typed_structs() {
    let config = parse(TEXT, &[]).unwrap();
    assert_eq!(config.pipeline().unwrap().seed, 7);
    let scene: Scene = config.table("scene").unwrap();
    assert_eq!(scene.transfer, Transfer::Gamma22);
    assert_eq!(scene.objects[0].position, [0.0, 1.5, 0.0]);
    assert_eq!(scene.samples, None);
}

#[test]
fn overrides_replace_add_and_step_into_lists() {
    let set = [
        "scene.background=other photo.png",
        "scene.samples=16",
        "scene.objects.0.position=[1, 2, 3]",
        "scene.samples = 32",
    ];
    let scene = scene(TEXT, &set).unwrap();
    assert_eq!(scene.background, PathBuf::from("other photo.png"));
    assert_eq!(scene.samples, Some(32));
    assert_eq!(scene.objects[0].position, [1.0, 2.0, 3.0]);
}

#[test]
fn an_override_takes_numbers_as_shells_see_them() {
    let position = |set: &str| scene(TEXT, &[set]).unwrap().objects[0].position[0];
    assert_eq!(position("scene.objects.0.position.0=.004"), 0.004);
    assert_eq!(position("scene.objects.0.position.0 = -5."), -5.0);
    // What only looks like a number stays text.
    for name in [".5.png", "1.2.3", "e"] {
        let scene = scene(TEXT, &[format!("scene.background={name}").as_str()]).unwrap();
        assert_eq!(scene.background, PathBuf::from(name));
    }
}

#[test]
fn an_override_of_text_needs_no_quotes_whatever_it_looks_like() {
    for text in ["2024", "007", "2.10", "5.", "1e3", "true", "0x1F"] {
        let set = format!("scene.background = {text}");
        let scene = scene(TEXT, &[&set]).unwrap();
        assert_eq!(scene.background, PathBuf::from(text));
    }
    let list = message(TEXT, &["scene.objects=[{path = 3}]"]);
    let end = "scene.objects.0.path is the integer 3, accepted: a path in quotes";
    assert!(list.ends_with(end), "{list}");
}

#[test]
fn blanks_around_words_of_an_override_are_no_part_of_them() {
    let scene = scene(TEXT, &["scene.background =  other photo.png "]).unwrap();
    assert_eq!(scene.background, PathBuf::from("other photo.png"));
}

#[test]
fn digits_that_begin_with_0_are_a_word_and_in_messages_as_they_were_written() {
    for digits in ["0001", "-007", "01e3"] {
        assert_eq!(
            message(TEXT, &[&format!("scene.samples={digits}")]),
            format!(
                "--set scene.samples={digits}: scene.samples is the string \"{digits}\", accepted: a whole number, 0 or more"
            )
        );
    }
    let scene = scene(TEXT, &["scene.objects.0.position.0=00.5"]).unwrap();
    assert_eq!(scene.objects[0].position[0], 0.5);
}

#[test]
fn an_override_may_create_its_table() {
    let config = parse("", &["pipeline.threads=2"]).unwrap();
    assert_eq!(config.pipeline().unwrap().threads, 2);
}

#[test]
fn an_unknown_key_is_an_error_with_its_line_and_the_nearest_name() {
    let text = "[scene]\n\nbackgruond = \"a.png\"\n";
    assert_eq!(
        message(text, &[]),
        "pipeline.toml:3: unknown key \"scene.backgruond\" (did you mean \"background\"?); \
         [scene] accepts: background, transfer, samples, objects"
    );
}

#[test]
fn an_unknown_key_in_a_list_names_its_index() {
    let text = "[scene]\nbackground = \"a\"\n[[scene.objects]]\npath = \"b\"\nxyz = 1\n";
    assert_eq!(
        message(text, &[]),
        "pipeline.toml:5: unknown key \"scene.objects.0.xyz\"; \
         [scene.objects.0] accepts: path, position"
    );
}

#[test]
fn an_unknown_table_is_an_error() {
    assert_eq!(
        parse("[scnee]\n", &[]).unwrap_err().to_string(),
        "pipeline.toml:1: unknown key \"scnee\" (did you mean \"scene\"?); the top level accepts: \
         pipeline, model, scene, concepts, lora, light, composite, report"
    );
}

#[test]
fn a_table_of_the_scene_at_the_top_is_answered_with_where_it_belongs() {
    let told = parse("[[objects]]\npath = \"a.obj\"\n", &[]).unwrap_err();
    let begins = "pipeline.toml:1: unknown key \"objects\" (did you mean \"scene.objects\"?); ";
    assert!(told.to_string().starts_with(begins), "{told}");
}

#[test]
fn a_key_that_is_written_twice_is_named() {
    let told = parse("[scene]\nclass = \"a\"\nclass = \"b\"\n", &[]).unwrap_err();
    assert_eq!(
        told.to_string(),
        "pipeline.toml:3: not valid TOML: class is written twice: keep one of them"
    );
}

#[test]
fn a_wrong_type_says_what_was_found_and_what_is_accepted() {
    let text = "[scene]\nbackground = \"a\"\nsamples = \"many\"\n";
    assert_eq!(
        message(text, &[]),
        "pipeline.toml:3: scene.samples is the string \"many\", accepted: a whole number, 0 or more"
    );
    assert_eq!(
        message("[scene]\nbackground = 3\n", &[]),
        "pipeline.toml:2: scene.background is the integer 3, accepted: a path in quotes"
    );
    assert_eq!(
        message(TEXT, &["scene.samples=-1"]),
        "--set scene.samples=-1: scene.samples is the integer -1, accepted: a whole number, 0 or more"
    );
    assert_eq!(
        message(TEXT, &["scene.samples=4294967296"]),
        "--set scene.samples=4294967296: scene.samples is the integer 4294967296, accepted: a whole number from 0 to 4294967295"
    );
    assert_eq!(
        message("[scene]\nsamples = 2026-06-21\n", &[]),
        "pipeline.toml:2: scene.samples is the string \"2026-06-21\", accepted: a whole number, 0 or more"
    );
    assert_eq!(
        message("scene = 3\n", &[]),
        "pipeline.toml:1: scene is the integer 3, accepted: a table"
    );
}

#[test]
fn a_date_needs_no_quotes() {
    let text = "[pipeline]\nout = 2026-06-21T12:34:56+02:00\n";
    let read = |text, sets: &[String]| {
        let config = Config::parse(Path::new("pipeline.toml"), text, sets).unwrap();
        config.pipeline().unwrap().out
    };
    assert_eq!(read(text, &[]), Path::new("2026-06-21T12:34:56+02:00"));
    let set = ["pipeline.out=2026-06-21".to_string()];
    assert_eq!(read("", &set), Path::new("2026-06-21"));
}

#[test]
fn a_list_of_the_wrong_length_says_both_lengths() {
    for (value, found) in [("[1, 2]", 2), ("[1, 2, 3, 4]", 4)] {
        let set = format!("scene.objects.0.position={value}");
        let text = message(TEXT, &[&set]);
        assert!(
            text.contains(&format!("a list of {found} values")) && text.contains("list of 3"),
            "{text}"
        );
    }
}

#[test]
fn an_unknown_choice_lists_the_accepted_ones() {
    assert_eq!(
        message(TEXT, &["scene.transfer=gama22"]),
        "--set scene.transfer=gama22: scene.transfer is \"gama22\" (did you mean \"gamma22\"?), \
         accepted: \"srgb\", \"gamma22\""
    );
    assert_eq!(
        message(TEXT, &["scene.transfer=2.2"]),
        "--set scene.transfer=2.2: scene.transfer is the number 2.2, accepted: \"srgb\", \"gamma22\""
    );
}

#[test]
fn a_missing_key_says_how_to_give_it() {
    assert_eq!(
        message("[scene]\n", &[]),
        "pipeline.toml:1: [scene] lacks the key \"background\"; \
         add it there or pass --set scene.background=VALUE"
    );
    assert_eq!(
        message("", &[]),
        "pipeline.toml: [scene] lacks the key \"background\"; \
         add it there or pass --set scene.background=VALUE"
    );
}

#[test]
fn broken_toml_names_the_line() {
    let text = parse("[scene]\nbackground = \n", &[])
        .unwrap_err()
        .to_string();
    assert!(
        text.starts_with("pipeline.toml:2: not valid TOML: "),
        "{text}"
    );
}

#[test]
fn a_path_of_windows_in_double_quotes_is_answered_with_how_to_write_it() {
    for path in [r"C:\Users\me\p.png", r"C:\me\p.png", r"D:\x\p.png"] {
        let text = format!("[scene]\nbackground = \"{path}\"\n");
        let told = parse(&text, &[]).unwrap_err().to_string();
        assert!(
            told.starts_with("pipeline.toml:2: not valid TOML: ")
                && told.ends_with("write a path in single quotes, or with / for each \\"),
            "{told}"
        );
    }
    let other = parse("[scene]\nbackground = \n", &[]).unwrap_err();
    assert!(!other.to_string().contains("single quotes"), "{other}");
}

#[test]
fn a_table_in_place_of_a_list_of_tables_is_answered_with_its_brackets() {
    #[derive(Debug, serde::Deserialize)]
    struct Listing {
        #[serde(rename = "objects")]
        _objects: Vec<std::collections::BTreeMap<String, String>>,
    }
    let config = parse("[scene.objects]\npath = \"a.glb\"\n", &[]).unwrap();
    let told = config.table::<Listing>("scene").unwrap_err().to_string();
    assert!(
        told.ends_with("a list, each table of which begins with [[scene.objects]]"),
        "{told}"
    );
}

#[test]
fn a_file_that_is_not_utf8_text_is_answered_with_how_to_save_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pipeline.toml");
    let read = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        Config::read(&path, &[]).map_err(|e| {
            let told = e.to_string();
            told.replace(&path.display().to_string(), "p.toml")
        })
    };
    let of_units = |units: &[u16], to_bytes: fn(u16) -> [u8; 2]| -> Vec<u8> {
        units.iter().flat_map(|u| to_bytes(*u)).collect()
    };
    let units: Vec<u16> = TEXT.encode_utf16().collect();
    let marked: Vec<u16> = std::iter::once(0xfeff).chain(units.clone()).collect();
    for units in [&units, &marked] {
        for to_bytes in [u16::to_le_bytes, u16::to_be_bytes] {
            assert_eq!(
                read(&of_units(units, to_bytes)).unwrap_err(),
                "p.toml: not valid TOML: it is UTF-16 text; save it as UTF-8 (Notepad: Save as, Encoding UTF-8; \
                 PowerShell: Out-File -Encoding utf8)"
            );
        }
    }
    assert_eq!(
        read(b"[scene]\nclass = \"B\xe4r\"\n").unwrap_err(),
        "p.toml:2: not valid TOML: a character that is not UTF-8; save the file as UTF-8"
    );
    assert_eq!(
        read(b"[scene]\n\n# a\0b\n").unwrap_err(),
        "p.toml:3: not valid TOML: a NUL byte, which no text holds; remove it, or write the file anew"
    );
    for text in [
        format!("\u{feff}{TEXT}"),
        TEXT.replace('\n', "\r\n"),
        format!("\u{feff}{}", TEXT.replace('\n', "\r\n")),
    ] {
        let config = read(text.as_bytes()).unwrap();
        let scene: Scene = config.table("scene").unwrap();
        assert_eq!(scene.background, Path::new("photo.png"));
        let place = config.place("scene.background").unwrap().to_string();
        assert!(place.ends_with(":6"), "{place}");
    }
}

#[test]
fn an_item_of_a_list_that_is_not_there_is_answered_with_how_to_add_it() {
    for (text, set, list) in [
        ("[scene]\n", "scene.objects.0.path=x", "scene.objects"),
        ("", "scene.objects.0.path=x", "scene.objects"),
        ("[light]\n", "light.environment.1=64", "light.environment"),
    ] {
        let item = set.split('.').nth(2).unwrap()[..1].to_string();
        assert_eq!(
            parse(text, &[set]).unwrap_err().to_string(),
            format!(
                "--set {set}: {list} is not in the file, so it has no item {item}; add it there, or set all of it, as in \
                 --set {list}=[…]"
            )
        );
    }
    let set = [
        "scene.objects=[{ path = \"a.glb\" }]",
        "scene.objects.0.path=b.glb",
    ];
    let scene = scene("[scene]\nbackground = \"a.png\"\n", &set).unwrap();
    assert_eq!(scene.objects[0].path, Path::new("b.glb"));
}

#[test]
fn a_malformed_override_shows_the_form() {
    let tail = "; write --set table.key=value, as in --set scene.class=car";
    for (set, finding) in [
        ("scene.background", "has no \"=\""),
        ("seed=3", "\"seed\" names no table"),
        ("scene..x=3", "\"scene..x\" is not a dotted key"),
        (
            "scene.objects.4.path=x",
            "\"4\" is no index of a list of 1; accepted: 0 to 0",
        ),
        (
            "scene.transfer.x=1",
            "\"x\" is below a key that is not a table",
        ),
    ] {
        assert_eq!(
            message(TEXT, &[set]),
            format!("--set {set}: {finding}{tail}")
        );
    }
}

#[test]
fn a_missing_file_points_at_the_option() {
    let error = Config::read(Path::new("no/such.toml"), &[]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "cannot read no/such.toml: no such file or directory; name another file with --pipeline"
    );
}

#[test]
fn paths_are_relative_to_the_file() {
    let config = Config::parse(Path::new("a/b/pipeline.toml"), "", &[]).unwrap();
    assert_eq!(config.resolve(Path::new("x.png")), Path::new("a/b/x.png"));
    assert_eq!(config.resolve(Path::new("/x.png")), Path::new("/x.png"));
    let here = Config::parse(Path::new("pipeline.toml"), "", &[]).unwrap();
    assert_eq!(here.resolve(Path::new("x.png")), Path::new("x.png"));
    assert_eq!(here.base_dir(), Path::new(""));
}

#[test]
fn unrelated_names_are_not_suggested() {
    assert_eq!(nearest("zzz", TABLES), None);
    assert_eq!(nearest("rnu", ["run", "report"]), Some("run".into()));
    assert_eq!(nearest("compsite", TABLES), Some("composite".into()));
}

#[test]
fn a_missing_key_is_placed_at_the_table_that_lacks_it() {
    let config = parse(TEXT, &[]).unwrap();
    let at = |key: &str| config.nearest_place(key).to_string();
    assert_eq!(at("scene.objects.0.path"), "pipeline.toml:10");
    assert_eq!(at("scene.objects.0.scale"), "pipeline.toml:9");
    assert_eq!(at("scene.camera.fov_deg"), "pipeline.toml:5");
    assert_eq!(at("composite.tone"), "pipeline.toml");
}

#[test]
fn an_earlier_name_is_answered_with_the_present_one() {
    let message = |text: &str, set: &[&str]| parse(text, set).unwrap_err().to_string();
    assert_eq!(
        message("[optimize]\niterations = 3\n", &[]),
        "pipeline.toml:1: [optimize] is called [light] now"
    );
    assert_eq!(
        message("\n[optimize]\nlight = false\n", &[]),
        "pipeline.toml:3: optimize.light is called light.recover_light now"
    );
    assert_eq!(
        message("[light]\n", &["light.tone=false"]),
        "--set light.tone=false: light.tone is called light.recover_tone now"
    );
    assert_eq!(
        message("", &["optimize.iterations=3"]),
        "--set optimize.iterations=3: [optimize] is called [light] now"
    );
    assert_eq!(renamed("optimize"), Some("light"));
}

#[cfg(unix)]
#[test]
fn a_configuration_that_is_a_device_or_a_folder_is_refused_at_once() {
    for (path, cause) in [
        ("/dev/zero", "not a regular file"),
        ("/", "a folder, not a regular file"),
    ] {
        let error = Config::read(Path::new(path), &[]).unwrap_err();
        assert_eq!(
            error.to_string(),
            format!("cannot read {path}: {cause}; name another file with --pipeline")
        );
    }
}

#[test]
fn a_message_about_a_key_of_a_table_is_placed_at_that_key_and_names_it_once() {
    let text = "[light]\n[light.shadow]\nheight_m = 1\ntip = [1, 2]\n";
    let set = ["light.shadow.height_m=-1".to_string()];
    let config = Config::parse(Path::new("p.toml"), text, &set).unwrap();
    let told = |message: &str| config.invalid("light.shadow", message).to_string();
    assert_eq!(
        told("light.shadow.height_m is -1"),
        "--set light.shadow.height_m=-1: light.shadow.height_m is -1"
    );
    assert_eq!(
        told("light.shadow.tip is odd"),
        "p.toml:4: light.shadow.tip is odd"
    );
    assert_eq!(
        told("needs a plane"),
        "p.toml:2: light.shadow: needs a plane"
    );
}

#[test]
fn a_device_is_one_of_those_that_are_accepted_whether_it_is_used_or_not() {
    let of = |device: &str| {
        let set = [format!("pipeline.device={device}")];
        let config = Config::parse(Path::new("p.toml"), "", &set).unwrap();
        config
            .pipeline()
            .map(|t| t.device)
            .map_err(|e| e.to_string())
    };
    for device in ["cpu", "auto", "cuda:0", "metal:1"] {
        assert_eq!(of(device).unwrap(), device);
    }
    for device in ["foo", "cuda", "cuda:x", "cpu:0", ""] {
        let told = of(device).unwrap_err();
        let end = format!("\"{device}\" is no device; accepted: cpu, cuda:N, metal:N, auto");
        assert!(told.ends_with(&end), "{told}");
    }
}

#[test]
fn texts_have_their_keys() {
    let text = "[scene]\nbackground = \"a.png\"\nobjects = [{ path = \"b.glb\", scale = 2 }]\n";
    let set = ["composite.environment=sky.hdr".to_string()];
    let config = Config::parse(Path::new("p.toml"), text, &set).unwrap();
    let named = |key: &str, text: &str| (key.to_string(), text.to_string());
    assert_eq!(
        config.texts(),
        [
            named("scene.background", "a.png"),
            named("scene.objects.0.path", "b.glb"),
            named("composite.environment", "sky.hdr"),
        ]
    );
}
