//! The methods: rows of a table that a user can extend.
use std::path::Path;

use anyhow::Context;
use dipir_cli::exit::Usage;
use dipir_stages::names::{self, StageName};
use serde::{Deserialize, Serialize};

use crate::folder::TRUTH;

/// The stages that a method may run before the composite, in their order.
pub const BEFORE_COMPOSITE: [&StageName; 4] =
    [&names::SCENE, &names::CONCEPTS, &names::LORA, &names::LIGHT];

/// The built-in table.
pub const TABLE: &str = include_str!("methods.toml");

/// Where a method's light comes from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Source {
    /// As bright as the photograph from everywhere.
    Neutral,
    /// The photograph itself.
    Projected,
    /// Lobes fitted to the truth.
    Fitted,
    /// The truth.
    Truth,
    /// What the stages recover.
    Recovered,
    /// A map of `--environment-from`.
    Imported,
}

/// A row.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Method {
    /// On the command line, in folders.
    pub name: String,
    /// In reports.
    pub title: String,
    /// What lights the object.
    pub light: Source,
    /// What runs before the composite; `scene` alone by default.
    #[serde(default = "scene_alone")]
    pub stages: Vec<String>,
    /// Keys and values, `table.key=value`.
    #[serde(default)]
    pub set: Vec<String>,
    /// Whether a diffusion model is asked.
    #[serde(default)]
    pub model: bool,
}

/// The key of `set` that gives a row a diffusion model of its own.
pub const MODEL_PATH: &str = "model.path";

/// The dotted key that `key=value` sets.
pub fn key_of(set: &str) -> String {
    let key = set.split_once('=').map_or(set, |(key, _)| key);
    let steps: Vec<&str> = key.split('.').map(str::trim).collect();
    steps.join(".")
}

impl Method {
    /// The row of the picture under the true light.
    pub fn truth() -> Self {
        Self {
            name: TRUTH.into(),
            title: "Truth".into(),
            light: Source::Truth,
            stages: scene_alone(),
            set: Vec::new(),
            model: false,
        }
    }

    /// The text that the row sets a key to, without quotation marks.
    pub fn value(&self, key: &str) -> Option<String> {
        let set = self.set.iter().rev().find(|s| key_of(s) == key)?;
        let (_, value) = set.split_once('=')?;
        let table: Option<toml::Table> = toml::from_str(&format!("value = {value}")).ok();
        let quoted = table.as_ref().and_then(|t| t.get("value")?.as_str());
        Some(quoted.unwrap_or(value.trim()).to_owned())
    }
}

fn scene_alone() -> Vec<String> {
    vec![names::SCENE.name.into()]
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    method: Vec<Method>,
}

/// The built-in methods and those of `more`.
pub fn read(more: Option<&Path>) -> anyhow::Result<Vec<Method>> {
    let mut methods = parse(TABLE).context("the built-in table")?;
    if let Some(path) = more {
        let text = dipir_files::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        let added = parse(&text).map_err(|e| Usage(format!("{}: {e}", path.display())))?;
        for method in added {
            methods.retain(|m| m.name != method.name);
            methods.push(method);
        }
    }
    Ok(methods)
}

fn parse(text: &str) -> anyhow::Result<Vec<Method>> {
    let table: Table = toml::from_str(text)?;
    for method in &table.method {
        let allowed = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
        if method.name.is_empty()
            || !method.name.chars().all(allowed)
            || method.name.starts_with('.')
        {
            anyhow::bail!(
                "the name \"{}\" is no folder's; accepted: letters, digits, - and _",
                method.name
            );
        }
        let accepted = BEFORE_COMPOSITE.map(|s| s.name);
        if let Some(other) = method
            .stages
            .iter()
            .find(|s| !accepted.contains(&s.as_str()))
        {
            anyhow::bail!(
                "method \"{}\": no stage before the composite is called \"{other}\"; accepted: {}",
                method.name,
                accepted.join(", ")
            );
        }
        if method.light == Source::Imported {
            anyhow::bail!(
                "method \"{}\": light = \"imported\" has no maps; name their folder with --environment-from",
                method.name
            );
        }
        if method.value(MODEL_PATH).is_some() && !method.model {
            anyhow::bail!(
                "method \"{}\": {MODEL_PATH} is the model that is asked; add model = true",
                method.name
            );
        }
        let recovers = method.stages.iter().any(|s| s == names::LIGHT.name);
        if recovers != (method.light == Source::Recovered) {
            anyhow::bail!(
                "method \"{}\": light = \"recovered\" and the stage \"light\" go together",
                method.name
            );
        }
    }
    Ok(table.method)
}

/// The method of a folder of imported maps.
pub fn imported(folder: &Path) -> anyhow::Result<Method> {
    let name = folder.canonicalize().ok();
    let name = name.as_deref().and_then(Path::file_name);
    let name = name.with_context(|| format!("there is no folder {}", folder.display()))?;
    let keep = |c: char| {
        if c.is_ascii_alphanumeric() || "-_.".contains(c) {
            c
        } else {
            '-'
        }
    };
    let name: String = name.to_string_lossy().chars().map(keep).collect();
    Ok(Method {
        title: format!("Imported: {name}"),
        name,
        light: Source::Imported,
        stages: scene_alone(),
        set: Vec::new(),
        model: false,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_built_in_table_reads_and_its_names_are_unique() {
        let methods = read(None).unwrap();
        for (n, a) in methods.iter().enumerate() {
            assert!(!methods[..n].iter().any(|b| b.name == a.name), "{}", a.name);
            assert!(a.stages[0] == "scene", "{}", a.name);
            assert!(a.set.iter().all(|s| s.contains('=') && s.contains('.')));
        }
        for name in ["neutral", "projected", "fitted", "ours"] {
            assert!(methods.iter().any(|m| m.name == name), "{name}");
        }
    }

    #[test]
    fn a_table_that_is_no_regular_file_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let message = format!("{:#}", read(Some(folder.path())).unwrap_err());
        assert!(message.ends_with("not a regular file"), "{message}");
    }

    #[test]
    fn rows_that_cannot_work_are_refused_in_words() {
        let message = |text: &str| parse(text).unwrap_err().to_string();
        assert_eq!(
            message("[[method]]\nname = \"a/b\"\ntitle = \"\"\nlight = \"neutral\"\n"),
            "the name \"a/b\" is no folder's; accepted: letters, digits, - and _"
        );
        assert_eq!(
            message("[[method]]\nname = \"a\"\ntitle = \"\"\nlight = \"recovered\"\n"),
            "method \"a\": light = \"recovered\" and the stage \"light\" go together"
        );
        assert!(message("[[method]]\nname = \"a\"\ncolour = 1\n").contains("colour"));
        assert_eq!(
            message(
                "[[method]]\nname = \"a\"\ntitle = \"\"\nlight = \"neutral\"\nset = [\"model.path=sd\"]\n"
            ),
            "method \"a\": model.path is the model that is asked; add model = true"
        );
        assert_eq!(
            message("[[method]]\nname = \"a\"\ntitle = \"\"\nlight = \"imported\"\n"),
            "method \"a\": light = \"imported\" has no maps; name their folder with --environment-from"
        );
        assert_eq!(
            message(
                "[[method]]\nname = \"a\"\ntitle = \"\"\nlight = \"recovered\"\nstages = [\"optimize\"]\n"
            ),
            "method \"a\": no stage before the composite is called \"optimize\"; accepted: scene, concepts, lora, light"
        );
    }
}
