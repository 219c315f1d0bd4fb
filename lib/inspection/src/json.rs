//! JSON artifacts: known ones as tables, others as an outline.
use std::path::Path;

use anyhow::Context;
use dipir_cli::output::json_path;
use dipir_pipeline::manifest::Manifest;
use serde_json::{Value, json};

use crate::folder::summary;
use crate::report::{Report, Table, number};

/// Members of an outline's list that are shown.
const SHOWN_ITEMS: usize = 3;
/// Depth of an outline.
const SHOWN_DEPTH: usize = 3;

pub(crate) fn inspect(path: &Path) -> anyhow::Result<Report> {
    let text = crate::read_text(path)?;
    let value: Value = serde_json::from_str(&text)
        .with_context(|| format!("{} is not valid JSON; make it anew", path.display()))?;
    let (kind, text) = if let Some(effects) = value["effects"].as_array() {
        ("effects", effects_table(&value, effects))
    } else if value["stage"].is_string() && value["outputs"].is_array() {
        let manifest: Manifest = Manifest::parse(&text, path)?;
        ("stage manifest", summary(&manifest))
    } else {
        let mut text = String::new();
        outline(&value, 1, &mut text);
        ("JSON", text)
    };
    Ok(Report {
        title: format!("{}: {kind}", path.display()),
        text,
        json: json!({"path": json_path(path), "kind": kind, "content": value}),
        problems: Vec::new(),
    })
}

fn effects_table(value: &Value, effects: &[Value]) -> String {
    let shown = |v: &Value| v.as_f64().map(number).unwrap_or_default();
    let mut table = Table::new(&["effect", "", ">contribution", ">+-", ">time", "why"]);
    for effect in effects {
        table.row([
            effect["name"].as_str().unwrap_or("?").into(),
            match effect["enabled"].as_bool() {
                Some(true) => "on".into(),
                Some(false) => "off".into(),
                None => "?".into(),
            },
            shown(&effect["contribution"]),
            shown(&effect["contribution_se"]),
            effect["time_share"]
                .as_f64()
                .map(|s| format!("{:.0}%", s * 100.0))
                .unwrap_or_default(),
            effect["reason"].as_str().unwrap_or("").into(),
        ]);
    }
    let mut text = table.render();
    if let Some(depth) = value["max_depth"].as_u64() {
        text.push_str(&format!("  at most {depth} interactions with the object\n"));
    }
    if let Some(rays) = value["rays"].as_object() {
        let counts: Vec<String> = rays
            .iter()
            .filter(|(_, n)| n.as_u64() != Some(0))
            .map(|(kind, n)| format!("{kind} {n}"))
            .collect();
        if !counts.is_empty() {
            text.push_str(&format!("  rays: {}\n", counts.join(", ")));
        }
    }
    text
}

/// Keys and short values, deep and long ones cut.
fn outline(value: &Value, depth: usize, text: &mut String) {
    let indent = "  ".repeat(depth);
    let line = |key: &str, member: &Value, text: &mut String| match member {
        Value::Object(m) if depth < SHOWN_DEPTH && !m.is_empty() => {
            text.push_str(&format!("{indent}{key}\n"));
            outline(member, depth + 1, text);
        }
        Value::Array(items) if depth < SHOWN_DEPTH && items.iter().any(Value::is_object) => {
            text.push_str(&format!("{indent}{key}: a list of {}\n", items.len()));
            outline(member, depth + 1, text);
        }
        other => text.push_str(&format!("{indent}{key}: {}\n", short(other))),
    };
    match value {
        Value::Object(members) => {
            for (key, member) in members {
                line(key, member, text);
            }
        }
        Value::Array(items) => {
            for (i, item) in items.iter().take(SHOWN_ITEMS).enumerate() {
                line(&i.to_string(), item, text);
            }
            if items.len() > SHOWN_ITEMS {
                text.push_str(&format!(
                    "{indent}… and {} more\n",
                    items.len() - SHOWN_ITEMS
                ));
            }
        }
        other => text.push_str(&format!("{indent}{}\n", short(other))),
    }
}

fn short(value: &Value) -> String {
    const LONGEST: usize = 100;
    let text = value.to_string();
    match text.chars().count() > LONGEST {
        true => text.chars().take(LONGEST).chain(['…']).collect(),
        false => text,
    }
}
