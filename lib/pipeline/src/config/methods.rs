//! Settings of published methods, under those that the file and the command line set themselves.
use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::tree::{self, Entry, Node, Value};
use crate::error::ConfigError;

const DIPIR: &str = include_str!("methods/dipir.toml");
/// Section 4.3: about 200 images of the class outdoors, 30 to 40 indoors.
const OUTDOORS: &str = "[concepts]\ncount = 200\n";
const INDOORS: &str = "[concepts]\ncount = 35\n";

/// A method whose settings hold where a key does not say otherwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// What the paper states for photographs from outdoors.
    DipirOutdoors,
    /// What the paper states for indoors.
    DipirIndoors,
}

/// The tables of the method that `root` names, if it names a known one.
fn tables(root: &Node) -> Option<(&'static str, [&'static str; 2])> {
    let Value::String(name) = &root.get("pipeline")?.get("method")?.value else {
        return None;
    };
    match name.as_str() {
        "dipir-outdoors" => Some(("method dipir-outdoors", [DIPIR, OUTDOORS])),
        "dipir-indoors" => Some(("method dipir-indoors", [DIPIR, INDOORS])),
        // Reading the table says what is accepted.
        _ => None,
    }
}

/// Adds to `root` the keys of its method that it does not set.
pub(super) fn fill(root: &mut Node) -> Result<(), ConfigError> {
    if let Some((name, texts)) = tables(root) {
        for text in texts {
            let defaults = tree::parse_file(Path::new(name), text)?;
            add(root, defaults);
        }
    }
    Ok(())
}

fn add(into: &mut Node, from: Node) {
    let (Value::Table(own), Value::Table(entries)) = (&mut into.value, from.value) else {
        return;
    };
    for entry in entries {
        match own.iter_mut().find(|e| e.name == entry.name) {
            Some(Entry { node, .. }) => add(node, entry.node),
            None => own.push(entry),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Config;

    #[test]
    fn a_method_fills_in_what_neither_file_nor_command_line_sets() {
        let text = "[pipeline]\nmethod = \"dipir-indoors\"\n[light]\niterations = 7\n";
        let config = |set: &[&str]| {
            let set: Vec<String> = set.iter().map(|s| s.to_string()).collect();
            Config::parse("pipeline.toml".as_ref(), text, &set).unwrap()
        };
        let number = |config: &Config, table: &str, key: &str| {
            let table: serde_json::Value = config.table(table).unwrap();
            table[key].as_f64()
        };
        let plain = config(&[]);
        assert_eq!(number(&plain, "light", "iterations"), Some(7.0));
        assert_eq!(number(&plain, "light", "consistency"), Some(0.03));
        assert_eq!(number(&plain, "concepts", "count"), Some(35.0));
        let set = config(&["pipeline.method=dipir-outdoors", "concepts.count=3"]);
        assert_eq!(number(&set, "concepts", "count"), Some(3.0));
        let unknown = config(&["pipeline.method=magic"]);
        let message = unknown.pipeline().unwrap_err().to_string();
        assert!(message.contains("dipir-outdoors"), "{message}");
    }
}
