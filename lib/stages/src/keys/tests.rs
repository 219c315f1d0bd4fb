use std::collections::BTreeSet;
use std::path::Path;

use dipir_pipeline::config::{Config, TABLES};
use dipir_pipeline::error::ConfigError;

use super::*;

fn keys() -> impl Iterator<Item = &'static Key> {
    tables().iter().flat_map(|table| &table.keys)
}

/// A file in which every key has its example.
fn every_example() -> String {
    let mut text = String::new();
    for table in tables() {
        text += &format!("{}\n", table.header());
        for key in &table.keys {
            text += &format!("{} = {}\n", key.name(), key.example);
        }
    }
    text
}

fn parse(overrides: &[String]) -> Config {
    Config::parse(Path::new("pipeline.toml"), &every_example(), overrides).unwrap()
}

/// Reads all tables by the types that the stages read them by.
fn read(config: &Config) -> Result<(), ConfigError> {
    config.pipeline()?;
    config.table::<ModelTable>("model")?;
    config.table::<SceneConfig>("scene")?;
    config.table::<ConceptsTable>("concepts")?;
    config.table::<LoraTable>("lora")?;
    config.table::<LightTable>("light")?;
    config.table::<CompositeTable>("composite")?;
    config.table::<ReportTable>("report")?;
    Ok(())
}

#[test]
fn every_table_of_the_file_has_its_keys() {
    let top: Vec<&str> = value::properties(schema()).map(|p| p.0).collect();
    assert_eq!(top, TABLES);
}

#[test]
fn the_keys_of_a_table_are_those_that_its_parser_accepts() {
    for table in tables() {
        let name = table.name.replace(".N", ".0");
        let config = parse(&[format!("{name}.no_such_key=1")]);
        let Err(ConfigError::UnknownKey { accepted, .. }) = read(&config) else {
            panic!("{name} accepts any key");
        };
        let prefix = format!("{}.", table.name);
        let names = keys()
            .map(|k| &k.key)
            .chain(tables().iter().map(|t| &t.name));
        let inside = names.filter_map(|name| name.strip_prefix(&prefix));
        let inside = inside.map(|rest| rest.split('.').next().unwrap_or(rest));
        let listed: BTreeSet<&str> = inside.filter(|name| *name != "N").collect();
        let accepted: BTreeSet<&str> = accepted.iter().map(String::as_str).collect();
        assert_eq!(listed, accepted, "{name}");
    }
}

#[test]
fn every_example_is_accepted_in_the_file_and_on_the_command_line() {
    read(&parse(&[])).unwrap();
    for key in keys() {
        let set = format!("{}={}", key.key.replace(".N.", ".0."), key.example);
        read(&parse(&[set])).unwrap();
    }
}

/// Whether the file's key `a` may stand in the way of the flag `b`: to leave a camera's file takes several keys, and an
/// anchor is no place.
fn may_stay(a: &str, b: &str) -> bool {
    match a.rsplit_once('.').map(|(_, name)| name) {
        Some("file") => !b.ends_with(".transforms"),
        Some("transforms") => !b.ends_with(".file"),
        _ => b.ends_with(".anchor"),
    }
}

/// The two keys of a conflict that `[scene]` is refused for.
fn conflict(text: &str, overrides: &[String]) -> Option<[String; 2]> {
    let config = Config::parse(Path::new("pipeline.toml"), text, overrides).unwrap();
    let scene: SceneConfig = config.table("scene").unwrap();
    match scene.validate() {
        Err(dipir_scene::Error::Conflict { first, second }) => {
            Some([first, second].map(|key| key.replace("[0]", ".N")))
        }
        _ => None,
    }
}

#[test]
fn a_flag_takes_the_place_of_the_files_keys_that_exclude_it() {
    let mut excluded = 0;
    for table in ["scene.objects.N", "scene.camera", "scene.proxy"] {
        let is_in = |k: &&Key| k.key.rsplit_once('.').is_some_and(|(t, _)| t == table);
        let all: Vec<&Key> = keys().filter(is_in).collect();
        for (a, b) in all.iter().flat_map(|a| all.iter().map(move |b| (a, b))) {
            let text = |given: &[&Key]| {
                let is_given = |name: &str| given.iter().any(|k| k.name() == name);
                let table_of = |name: &str| match name == table {
                    true => given
                        .iter()
                        .map(|k| format!("{} = {}\n", k.name(), k.example))
                        .collect(),
                    false => String::new(),
                };
                let mut text =
                    "[scene]\nbackground = \"photo.jpg\"\n[[scene.objects]]\n".to_owned();
                if !is_given("path") {
                    text += "path = \"car.glb\"\n";
                }
                text += &table_of("scene.objects.N");
                text += "[scene.camera]\n";
                for (key, value) in [
                    ("position", "[0.0, 1.0, 4.0]"),
                    ("look_at", "[0.0, 0.0, 0.0]"),
                ] {
                    if !["file", "transforms", key].iter().any(|k| is_given(k)) {
                        text += &format!("{key} = {value}\n");
                    }
                }
                text + &table_of("scene.camera")
                    + &(match table == "scene.proxy" {
                        true => "[scene.proxy]\n".to_owned() + &table_of("scene.proxy"),
                        false => String::new(),
                    })
            };
            let exclude = |found: Option<[String; 2]>| {
                found.is_some_and(|keys| keys.contains(&a.key) && keys.contains(&b.key))
            };
            if a.key != b.key && exclude(conflict(&text(&[a, b]), &[])) {
                excluded += 1;
                let flag = format!("{}={}", b.key.replace(".N.", ".0."), b.example);
                let stays = exclude(conflict(&text(&[a]), &[flag]));
                assert_eq!(
                    stays,
                    may_stay(&a.key, &b.key),
                    "{} in the file, {} a flag",
                    a.key,
                    b.key
                );
            }
        }
    }
    assert!(excluded > 40, "{excluded}");
}

#[test]
fn every_key_has_a_sentence_and_an_example() {
    for key in keys() {
        let sentence = &key.sentence;
        assert!(sentence.ends_with('.'), "{}: {sentence}", key.key);
        // Links of the source lead nowhere.
        assert!(!sentence.contains("[`"), "{}: {sentence}", key.key);
        assert!(!key.example.is_empty(), "{} has no example", key.key);
    }
    for table in tables() {
        assert!(table.sentence.ends_with('.'), "{}", table.name);
    }
}

#[test]
fn examples_and_defaults_lie_in_their_range() {
    for key in keys() {
        let schema = &key.schema;
        for value in [&schema["examples"][0], &schema["default"]] {
            let bound = |keyword: &str, fallback: f64| schema[keyword].as_f64().unwrap_or(fallback);
            if let Some(number) = value.as_f64() {
                let least = bound("minimum", f64::NEG_INFINITY);
                let most = bound("maximum", f64::INFINITY);
                assert!((least..=most).contains(&number), "{}: {number}", key.key);
                assert!(
                    number > bound("exclusiveMinimum", f64::NEG_INFINITY),
                    "{}",
                    key.key
                );
                assert!(
                    number < bound("exclusiveMaximum", f64::INFINITY),
                    "{}",
                    key.key
                );
            }
            let words = value::words(schema);
            if let Some(word) = value.as_str().filter(|_| !words.is_empty()) {
                assert!(words.contains(&word), "{}: {word}", key.key);
            }
        }
    }
}

#[test]
fn defaults_are_values_words_or_the_qualities() {
    let default = |name: &str| {
        let key = keys().find(|k| k.key == name);
        key.unwrap_or_else(|| panic!("no {name}")).default.clone()
    };
    assert_eq!(default("light.learning_rates.tone"), "`0.003`");
    assert_eq!(default("scene.camera.transforms"), "none");
    assert_eq!(default("light.seed"), "that of `pipeline.seed`");
    assert_eq!(
        default("light.environment"),
        "the quality's: draft `[64, 32]`, standard `[256, 128]`, high `[256, 128]`"
    );
    assert_eq!(default("scene.effects.mode"), "`\"planned\"`");
    assert!(default("composite.target_error").contains("standard `0.004`"));
    for name in ["iterations", "lobes", "samples", "size"] {
        let default = default(&format!("light.{name}"));
        assert!(default.starts_with("the quality's: draft `"), "{default}");
    }
}

#[test]
fn a_word_finds_keys_by_name_and_by_sentence_and_a_slip_the_nearest() {
    let found = |word: &str| -> Vec<String> {
        let tables = about(word);
        let keys = tables.into_iter().flat_map(|table| table.keys);
        keys.map(|key| key.key).collect()
    };
    assert!(found("OCCLUDERS").contains(&"scene.occluders".into()));
    assert!(found("nerfstudio").contains(&"scene.camera.transforms".into()));
    assert!(found("light")[0].starts_with("light."));
    assert!(found("no such thing").is_empty());
    assert_eq!(like("ocluders"), Some("scene.occluders"));
}
