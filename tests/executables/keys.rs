//! The keys of pipeline.toml: how they are found, and the page that lists them.
use crate::project::*;

#[test]
fn the_page_of_all_keys_is_the_one_that_dipir_writes() {
    let run = Project::new().run(DIPIR, &["keys", "--markdown"]);
    run.expect_success();
    let page = include_str!("../../docs/keys.md");
    // Line by line, so that a difference can be read.
    for (written, expected) in page.lines().zip(run.stdout.lines()) {
        assert_eq!(
            written, expected,
            "run dipir keys --markdown > docs/keys.md"
        );
    }
    assert_eq!(page, run.stdout, "run dipir keys --markdown > docs/keys.md");
    for table in dipir_pipeline::config::TABLES {
        assert!(page.contains(&format!("\n## `[{table}]`\n")), "{table}");
    }
}

#[test]
fn keys_are_found_by_a_word_of_their_name_or_description() {
    let project = Project::new();
    let run = project.run(DIPIR, &["keys", "Occluder"]);
    run.expect_success();
    assert!(
        run.stdout.contains("[scene]  ") && run.stdout.contains("\n  scene.occluders\n"),
        "{}",
        run.stdout
    );
    assert!(!run.stdout.contains("scene.camera"), "{}", run.stdout);
    let run = project.run(DIPIR, &["keys", "--json", "fov_deg"]);
    let value: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    let tables = value["tables"].as_array().unwrap();
    let camera = tables.iter().find(|t| t["name"] == "scene.camera").unwrap();
    let key = &camera["keys"][0];
    assert_eq!(key["key"], "scene.camera.fov_deg");
    assert_eq!(key["accepted"], "number, above 0, below 180");
    assert_eq!(key["example"], "40.0");
}

#[test]
fn a_word_of_no_key_is_answered_with_the_nearest_one() {
    Project::new().run(DIPIR, &["keys", "ocluders"]).expect_error(
        2,
        "error: no key has \"ocluders\" in its name or description; did you mean scene.occluders? \
         dipir keys shows all of them",
    );
}

#[test]
fn editors_get_a_schema_that_refuses_unknown_keys() {
    let run = Project::new().run(DIPIR, &["keys", "--schema"]);
    run.expect_success();
    let schema: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(schema["additionalProperties"], false);
    let scene = &schema["properties"]["scene"];
    assert_eq!(scene["additionalProperties"], false);
    assert_eq!(scene["properties"]["transfer"]["enum"][0], "srgb");
}

#[test]
fn where_no_file_is_dipir_says_how_to_begin() {
    let project = Project::new();
    std::fs::remove_file(project.path("pipeline.toml")).unwrap();
    for command in ["run", "status", "clean"] {
        let run = project.run(DIPIR, &[command]);
        assert_eq!(run.code, Some(2), "{}", run.stderr);
        let start = "error: there is no pipeline.toml; name another file, as in dipir run ";
        assert!(run.stderr.starts_with(start), "{}", run.stderr);
    }
}
