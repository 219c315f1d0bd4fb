//! Parts of a JSON schema in words, and JSON values as TOML.
use serde_json::Value;

/// The fields of a table's schema.
pub fn properties(schema: &Value) -> impl Iterator<Item = (&str, &Value)> {
    let fields = schema["properties"].as_object().into_iter().flatten();
    fields.map(|(name, part)| (name.as_str(), part))
}

/// The schema and its alternatives, null left out.
fn alternatives(schema: &Value) -> Vec<&Value> {
    let of = |keyword: &str| schema[keyword].as_array().into_iter().flatten();
    let inner = of("anyOf").chain(of("oneOf")).chain(of("allOf"));
    let inner: Vec<&Value> = inner.flat_map(alternatives).collect();
    match inner.is_empty() {
        true if is(schema, "null") => Vec::new(),
        true => vec![schema],
        false => inner,
    }
}

/// Whether the schema accepts the type and, null aside, nothing else.
fn is(schema: &Value, name: &str) -> bool {
    match &schema["type"] {
        Value::String(one) => one == name,
        Value::Array(types) => types.iter().all(|t| t == name || t == "null"),
        _ => false,
    }
}

/// The table that the schema of a key accepts, if it accepts one.
pub fn table_in(schema: &Value) -> Option<&Value> {
    let mut all = alternatives(schema).into_iter();
    all.find(|s| s["properties"].is_object())
}

/// The table that the schema of a key accepts a list of, if it does.
pub fn table_in_list(schema: &Value) -> Option<&Value> {
    alternatives(schema)
        .into_iter()
        .find_map(|s| table_in(&s["items"]))
}

/// The words that a key accepts; it may accept more.
pub fn words(schema: &Value) -> Vec<&str> {
    let all = alternatives(schema);
    let listed = all.iter().flat_map(|s| s["enum"].as_array());
    let single = all.iter().filter_map(|s| s["const"].as_str());
    let listed = listed.flatten().filter_map(Value::as_str);
    listed.chain(single).collect()
}

/// Type and range, in words.
pub fn in_words(schema: &Value) -> String {
    let mut all: Vec<String> = words(schema).iter().map(|w| format!("`\"{w}\"`")).collect();
    let others = alternatives(schema).into_iter();
    let others = others.filter(|s| s["enum"].is_null() && s["const"].is_null());
    all.extend(
        others.map(|one| match range(schema).or_else(|| range(one)) {
            Some(range) => format!("{}, {range}", kind(schema, one)),
            None => kind(schema, one),
        }),
    );
    all.join(", ")
}

/// The type of one alternative of the schema.
fn kind(schema: &Value, one: &Value) -> String {
    match () {
        () if is(one, "boolean") => "`true` or `false`".into(),
        () if is(one, "integer") => "whole number".into(),
        () if is(one, "number") => "number".into(),
        () if is(one, "array") => list(one),
        () if one["format"] == "path" || schema["format"] == "path" => "path".into(),
        () => "text".into(),
    }
}

fn list(schema: &Value) -> String {
    let items = match in_words(&schema["items"]) {
        one if one.starts_with("number") => one.replacen("number", "numbers", 1),
        one if one.starts_with("whole number") => one.replacen("number", "numbers", 1),
        one if one.starts_with("text") => one.replacen("text", "texts", 1),
        one => one.replacen("list", "lists", 1),
    };
    match (&schema["minItems"], &schema["maxItems"]) {
        (Value::Number(least), Value::Number(most)) if least == most => {
            format!("list of {least} {items}")
        }
        _ => format!("list of {items}"),
    }
}

fn range(schema: &Value) -> Option<String> {
    let bound = |keyword: &str| schema[keyword].as_f64();
    let (least, most) = (bound("minimum"), bound("maximum"));
    // What an unsigned number refuses goes without saying.
    let least = least.filter(|b| *b != 0.0 || most.is_some() || !is(schema, "integer"));
    if let (Some(least), Some(most)) = (least, most) {
        return Some(format!("from {least} to {most}"));
    }
    let limits = [
        (bound("exclusiveMinimum"), "above"),
        (least, "at least"),
        (bound("exclusiveMaximum"), "below"),
        (most, "at most"),
    ];
    let limits = limits
        .iter()
        .filter_map(|(b, word)| b.map(|b| format!("{word} {b}")));
    let limits: Vec<String> = limits.collect();
    (!limits.is_empty()).then(|| limits.join(", "))
}

/// The value as TOML.
pub fn toml(value: &Value) -> String {
    match value {
        Value::Array(items) => {
            let items: Vec<String> = items.iter().map(toml).collect();
            format!("[{}]", items.join(", "))
        }
        // Strings of JSON are strings of TOML.
        other => other.to_string(),
    }
}
