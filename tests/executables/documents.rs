//! What README.md and docs/ tell to type: commands are walked through or at least understood, keys exist.
use std::fs;
use std::path::{Path, PathBuf};

use crate::project::*;

/// Commands of README.md that are not run here, and why.
const NOT_RUN: [(&str, &str); 6] = [
    ("cargo build --release", "builds the project anew"),
    ("cargo test --workspace", "is what runs this"),
    ("dipir place", "serves until it is stopped; see page.rs"),
    (
        "dipir-model fetch",
        "needs the network; see tests/model_fetch.rs",
    ),
    ("dipir run --set model.path=", "needs what is fetched"),
    (
        "dipir run --set light.guidance=reference",
        "takes a minute; see recovery.rs",
    ),
];

/// README.md and the pages of docs/ with their paths.
fn pages() -> Vec<(PathBuf, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let docs = fs::read_dir(root.join("docs"))
        .unwrap()
        .map(|e| e.unwrap().path());
    let mut paths: Vec<PathBuf> = docs
        .filter(|p| p.extension().is_some_and(|e| e == "md"))
        .collect();
    paths.push(root.join("README.md"));
    paths.sort();
    paths
        .into_iter()
        .map(|p| (p.clone(), fs::read_to_string(&p).unwrap()))
        .collect()
}

/// The fenced blocks of a language.
fn fences<'a>(page: &'a str, language: &str) -> Vec<&'a str> {
    let parts = page.split("```").skip(1).step_by(2);
    parts
        .filter_map(|part| part.strip_prefix(language)?.strip_prefix('\n'))
        .collect()
}

/// The commands of the blocks for a shell, without their comments.
fn commands(page: &str) -> Vec<String> {
    let mut found = Vec::new();
    for block in fences(page, "sh") {
        for line in block.replace("\\\n", " ").lines() {
            let line = line.split(" #").next().unwrap().trim();
            found.extend(line.split(" && ").map(|c| c.trim().to_owned()));
        }
    }
    found.retain(|c| !c.is_empty() && !c.starts_with('#'));
    found
}

/// Runs a line as a shell would in the project's folder.
fn shell(project: &Project, line: &str) -> Run {
    let folder = Path::new(DIPIR).parent().unwrap();
    let path = format!("{}:{}", folder.display(), std::env::var("PATH").unwrap());
    let mut command = project.command("sh", &["-c", line]);
    command.env("PATH", path).output().unwrap().into()
}

#[test]
fn the_readme_is_walked_through_as_written() {
    let project = Project::new();
    fs::remove_file(project.path("pipeline.toml")).unwrap();
    let photo = image::open(project.path("background.png")).unwrap();
    photo.to_rgb8().save(project.path("photo.jpg")).unwrap();
    fs::create_dir(project.path("frames")).unwrap();
    fs::copy(project.path("photo.jpg"), project.path("frames/1.jpg")).unwrap();
    let sky = dipir_light::environment::EnvironmentMap::read(project.path("sky.exr")).unwrap();
    sky.write(project.path("sky.hdr")).unwrap();
    let car = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/demo/car.glb");
    fs::copy(car, project.path("chair.glb")).unwrap();
    let page = include_str!("../../README.md");
    let mut unused: Vec<&str> = NOT_RUN.iter().map(|(command, _)| *command).collect();
    let mut count = 0;
    let commands = commands(page);
    // In the text: with arguments, for a program alone is a name.
    let named = page
        .split('`')
        .skip(1)
        .step_by(2)
        .map(|c| c.split_whitespace().collect::<Vec<_>>().join(" "));
    let named = named.filter(|c| c.starts_with("dipir") && c.contains(' '));
    for command in commands.into_iter().chain(named) {
        if command.starts_with("target/release/") {
            continue;
        }
        if let Some((start, _)) = NOT_RUN.iter().find(|(start, _)| command.starts_with(start)) {
            unused.retain(|u| u != start);
            continue;
        }
        let run = shell(&project, &command.replace("WORD", "sun"));
        assert_eq!(run.code, Some(0), "{command}: {}{}", run.stdout, run.stderr);
        count += 1;
    }
    assert!(unused.is_empty(), "not in README.md any more: {unused:?}");
    assert!(count >= 10, "{count} commands");
    assert!(project.path("out/composite/composite.png").is_file());
}

#[test]
fn every_command_of_the_documents_is_understood() {
    let project = Project::new();
    let mut count = 0;
    for (path, page) in pages() {
        for command in commands(&page) {
            let end = command.find([';', '|', '>']).unwrap_or(command.len());
            let command = command[..end].trim_start_matches("target/release/");
            if command.starts_with("dipir") {
                let run = shell(&project, &format!("{command} --help"));
                assert_eq!(
                    run.code,
                    Some(0),
                    "{}: {command}: {}",
                    path.display(),
                    run.stderr
                );
                count += 1;
            }
        }
    }
    assert!(count >= 30, "{count} commands");
}

/// The dotted names of what a table sets, with `N` for numbers; `is_key` ends the descent.
fn names(value: &toml::Value, name: &str, is_key: &dyn Fn(&str) -> bool, found: &mut Vec<String>) {
    let join = |part: &str| match name {
        "" => part.to_owned(),
        _ => format!("{name}.{part}"),
    };
    match value {
        _ if is_key(name) => found.push(name.to_owned()),
        toml::Value::Table(table) => {
            table
                .iter()
                .for_each(|(part, value)| names(value, &join(part), is_key, found));
        }
        toml::Value::Array(array) if array.iter().any(toml::Value::is_table) => {
            array
                .iter()
                .for_each(|value| names(value, &join("N"), is_key, found));
        }
        _ => found.push(name.to_owned()),
    }
}

#[test]
fn every_key_of_the_documents_exists() {
    let (table_of_keys, mut count) = (include_str!("../../docs/keys.md"), 0);
    let is_key = |name: &str| {
        // A view's camera has the keys of the scene's.
        let name = name.replace("scene.views.N.camera", "scene.camera");
        table_of_keys.contains(&format!("\n| `{name}` |"))
    };
    let check = |text: &str, path: &Path| {
        let value: toml::Value =
            toml::from_str(text).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let mut found = Vec::new();
        names(&value, "", &is_key, &mut found);
        for name in &found {
            assert!(is_key(name), "{}: no key is called {name}", path.display());
        }
        found.len()
    };
    for (path, page) in pages() {
        for block in fences(&page, "toml") {
            count += check(block, &path);
            // What else may be written, as a comment.
            let mut header = "";
            for line in block.lines() {
                if line.starts_with('[') {
                    header = line;
                } else if let Some(other) = line.strip_prefix("# ")
                    && toml::from_str::<toml::Table>(other).is_ok()
                {
                    count += check(&format!("{header}\n{other}"), &path);
                }
            }
        }
        for command in commands(&page) {
            let words: Vec<&str> = command.split_whitespace().collect();
            let pairs = words
                .windows(2)
                .filter(|pair| ["-s", "--set"].contains(&pair[0]));
            for pair in pairs {
                let (name, _) = pair[1]
                    .trim_start_matches(['\'', '"'])
                    .split_once('=')
                    .unwrap();
                let parts = name.split('.').map(|part| match part.parse::<u32>() {
                    Ok(_) => "N",
                    Err(_) => part,
                });
                let name = parts.collect::<Vec<_>>().join(".");
                assert!(is_key(&name), "{}: {command}", path.display());
                count += 1;
            }
        }
    }
    assert!(count >= 60, "{count} keys");
}

/// The text of every Rust file below `folder`, appended to `text`.
fn sources(folder: &Path, text: &mut String) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, text);
        } else if path.extension().is_some_and(|e| e == "rs") {
            text.push_str(&fs::read_to_string(&path).unwrap());
        }
    }
}

#[test]
fn every_test_and_seed_of_the_page_on_hostile_input_exists() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut text = String::new();
    for folder in ["bins", "lib", "tests"] {
        sources(&root.join(folder), &mut text);
    }
    let page = fs::read_to_string(root.join("docs/hostile-input.md")).unwrap();
    let mut count = 0;
    for row in page.lines().filter(|l| l.starts_with("| ")) {
        let held_by = row.trim_end_matches(" |").rsplit(" | ").next().unwrap();
        for name in held_by.split('`').skip(1).step_by(2) {
            let exists = match name.contains('/') {
                true => root.join("fuzz/seeds").join(name).is_file(),
                false => text.contains(&format!("fn {name}(")),
            };
            assert!(exists, "{name}");
            count += 1;
        }
    }
    assert!(count > 70, "{count} names");
}
