//! TOML values that remember where they were written.
use std::path::Path;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::Place;
use crate::error::ConfigError;

/// A value and its place.
#[derive(Clone, Debug)]
pub(super) struct Node {
    pub value: Value,
    pub place: Place,
}

/// A TOML value.
#[derive(Clone, Debug)]
pub(super) enum Value {
    String(String),
    Integer(i64),
    Float(f64),
    Boolean(bool),
    /// As it is written.
    Datetime(String),
    Array(Vec<Node>),
    Table(Vec<Entry>),
}

/// A key, where it stands, and its value.
#[derive(Clone, Debug)]
pub(super) struct Entry {
    pub name: String,
    pub place: Place,
    pub node: Node,
}

impl Node {
    /// The member `step` of a table, or the element with that index of an array.
    pub fn get(&self, step: &str) -> Option<&Node> {
        match &self.value {
            Value::Table(entries) => entries.iter().find(|e| e.name == step).map(|e| &e.node),
            Value::Array(items) => items.get(step.parse::<usize>().ok()?),
            _ => None,
        }
    }

    /// Adds the texts at and below this node, which is called `key`.
    pub fn collect_texts(&self, key: &str, into: &mut Vec<(String, String)>) {
        let below = |step: &str| match key {
            "" => step.to_string(),
            key => format!("{key}.{step}"),
        };
        match &self.value {
            Value::String(text) => into.push((key.into(), text.clone())),
            Value::Table(entries) => {
                for entry in entries {
                    entry.node.collect_texts(&below(&entry.name), into);
                }
            }
            Value::Array(items) => {
                for (i, item) in items.iter().enumerate() {
                    item.collect_texts(&below(&i.to_string()), into);
                }
            }
            _ => {}
        }
    }

    /// Removes the key at `steps` from its table, if it is there.
    pub fn remove(&mut self, steps: &[&str]) {
        match (&mut self.value, steps) {
            (Value::Table(entries), [step]) => entries.retain(|e| e.name != *step),
            (Value::Table(entries), [step, rest @ ..]) => {
                if let Some(entry) = entries.iter_mut().find(|e| e.name == *step) {
                    entry.node.remove(rest);
                }
            }
            (Value::Array(items), [step, rest @ ..]) => {
                if let Some(item) = step.parse().ok().and_then(|i: usize| items.get_mut(i)) {
                    item.remove(rest);
                }
            }
            _ => {}
        }
    }
}

/// The text of a file in UTF-8, with a byte order mark or without.
pub(super) fn text<'a>(path: &Path, bytes: &'a [u8]) -> Result<&'a str, ConfigError> {
    let wrong = |at: Place, message: &str| ConfigError::Syntax {
        at,
        message: message.into(),
    };
    let line_of = |offset: usize| Place::Line {
        file: path.into(),
        line: 1 + bytes[..offset].iter().filter(|b| **b == b'\n').count(),
    };
    // The byte order mark, or half of the first letter.
    if let [0xff, 0xfe, ..] | [0xfe, 0xff, ..] | [0, _, ..] | [_, 0, ..] = bytes {
        return Err(wrong(
            Place::File { file: path.into() },
            dipir_files::UTF_16,
        ));
    }
    let text = str::from_utf8(bytes).map_err(|e| {
        let message = "a character that is not UTF-8; save the file as UTF-8";
        wrong(line_of(e.valid_up_to()), message)
    })?;
    match text.find('\0') {
        None => Ok(text),
        Some(offset) => Err(wrong(
            line_of(offset),
            "a NUL byte, which no text holds; remove it, or write the file anew",
        )),
    }
}

/// Parses a whole file.
pub(super) fn parse_file(path: &Path, text: &str) -> Result<Node, ConfigError> {
    let line_starts: Vec<usize> = std::iter::once(0)
        .chain(text.match_indices('\n').map(|(i, _)| i + 1))
        .collect();
    let place = |offset: usize| Place::Line {
        file: path.into(),
        line: line_starts.partition_point(|&start| start <= offset),
    };
    let table = DeTable::parse(text).map_err(|e| ConfigError::Syntax {
        at: place(e.span().map_or(0, |s| s.start)),
        message: match e.span().and_then(|span| text.get(span)) {
            Some(key) if e.message() == "duplicate key" => {
                format!("{} is written twice: keep one of them", one_line(key))
            }
            _ => with_remedy(one_line(e.message())),
        },
    })?;
    let table_place = Place::File { file: path.into() };
    Ok(Node {
        value: Value::Table(entries(table.get_ref(), &place)?),
        place: table_place,
    })
}

/// Says what to do where a path of Windows reads as escapes.
fn with_remedy(message: String) -> String {
    let is_escape = ["unicode value", "escape"];
    match is_escape.iter().any(|word| message.contains(word)) {
        true => format!(
            "{message}; in double quotes a backslash begins an escape: write a path in single quotes, or with / for each \\"
        ),
        false => message,
    }
}

fn one_line(message: &str) -> String {
    message.split('\n').collect::<Vec<_>>().join(", ")
}

fn entries(table: &DeTable<'_>, place: &dyn Fn(usize) -> Place) -> Result<Vec<Entry>, ConfigError> {
    table
        .iter()
        .map(|(name, value)| {
            let at = place(name.span().start);
            Ok(Entry {
                name: name.get_ref().to_string(),
                node: node(value, place, name.get_ref())?,
                place: at,
            })
        })
        .collect()
}

fn node(
    spanned: &Spanned<DeValue<'_>>,
    place: &dyn Fn(usize) -> Place,
    key: &str,
) -> Result<Node, ConfigError> {
    let at = place(spanned.span().start);
    let value = match spanned.get_ref() {
        DeValue::String(s) => Value::String(s.to_string()),
        DeValue::Integer(i) => match i64::from_str_radix(i.as_str(), i.radix()) {
            Ok(i) => Value::Integer(i),
            Err(_) => {
                return Err(ConfigError::WrongType {
                    at,
                    key: key.into(),
                    found: format!("the integer {}", i.as_str()),
                    accepted: "a whole number from -2^63 to 2^63 - 1".into(),
                });
            }
        },
        DeValue::Float(f) => match f.as_str().parse() {
            Ok(f) => Value::Float(f),
            Err(_) => {
                return Err(ConfigError::WrongType {
                    at,
                    key: key.into(),
                    found: format!("the number {}", f.as_str()),
                    accepted: "a number".into(),
                });
            }
        },
        DeValue::Boolean(b) => Value::Boolean(*b),
        DeValue::Datetime(date) => Value::Datetime(date.to_string()),
        DeValue::Array(items) => Value::Array(
            items
                .iter()
                .map(|item| node(item, place, key))
                .collect::<Result<_, _>>()?,
        ),
        DeValue::Table(table) => Value::Table(entries(table, place)?),
    };
    Ok(Node { value, place: at })
}

/// Applies one `table.key=value`. Numbers step into arrays: `scene.objects.0.yaw_deg=10`.
pub(super) fn apply_override(root: &mut Node, text: &str) -> Result<(), ConfigError> {
    let wrong = |message: String| ConfigError::Override {
        text: text.into(),
        message,
    };
    let (key, value) = text
        .split_once('=')
        .ok_or_else(|| wrong("has no \"=\"".into()))?;
    let steps: Vec<&str> = key.split('.').map(str::trim).collect();
    if steps.iter().any(|s| s.is_empty()) {
        return Err(wrong(format!("\"{key}\" is not a dotted key")));
    }
    if steps.len() < 2 {
        return Err(wrong(format!("\"{key}\" names no table")));
    }
    let place = Place::Flag(format!("--set {text}"));
    let at = |_: usize| place.clone();
    let value = value.trim();
    let node = match DeValue::parse(value) {
        Ok(parsed) => node(&parsed, &at, key)?,
        Err(_) => Node {
            value: shell_number(value).unwrap_or_else(|| Value::String(value.to_string())),
            place: place.clone(),
        },
    };
    if let Some((list, index)) = absent_list(root, &steps) {
        let message = format!(
            "{list} is not in the file, so it has no item {index}; add it there, or set all of it, as in --set {list}=[…]"
        );
        return Err(ConfigError::Invalid {
            at: place,
            key: list,
            message,
        });
    }
    insert(root, &steps, node, &place).map_err(wrong)
}

/// The dotted key of the list that is not there and that `steps` step into, and the index. No table has a number for a key.
fn absent_list<'a>(root: &Node, steps: &[&'a str]) -> Option<(String, &'a str)> {
    let is_index = |step: &&str| step.bytes().all(|b| b.is_ascii_digit());
    let at = steps.iter().position(is_index).filter(|at| *at > 0)?;
    let list = &steps[..at];
    let there = list.iter().try_fold(root, |node, step| node.get(step));
    there.is_none().then(|| (list.join("."), steps[at]))
}

/// A number as people write it on a command line and TOML does not: `.004`, `5.`. Digits that begin with 0, without a point,
/// are the name of something: `0042`.
fn shell_number(text: &str) -> Option<Value> {
    let numeric = |b: u8| b.is_ascii_digit() || b"+-.eE".contains(&b);
    let is_name = text.trim_start_matches(['+', '-']).starts_with('0') && !text.contains('.');
    match text.bytes().all(numeric) && !is_name {
        true => text.parse().ok().map(Value::Float),
        false => None,
    }
}

fn insert(target: &mut Node, steps: &[&str], node: Node, place: &Place) -> Result<(), String> {
    let Some((step, rest)) = steps.split_first() else {
        *target = node;
        return Ok(());
    };
    match &mut target.value {
        Value::Table(entries) => {
            let index = entries.iter().position(|e| e.name == *step);
            let index = index.unwrap_or_else(|| {
                entries.push(Entry {
                    name: (*step).into(),
                    place: place.clone(),
                    node: Node {
                        value: Value::Table(Vec::new()),
                        place: place.clone(),
                    },
                });
                entries.len() - 1
            });
            insert(&mut entries[index].node, rest, node, place)
        }
        Value::Array(items) => {
            let count = items.len();
            let item = step
                .parse::<usize>()
                .ok()
                .and_then(|i| items.get_mut(i))
                .ok_or_else(|| match count {
                    0 => format!("\"{step}\" steps into an empty list"),
                    _ => format!(
                        "\"{step}\" is no index of a list of {count}; accepted: 0 to {}",
                        count - 1
                    ),
                })?;
            insert(item, rest, node, place)
        }
        _ => Err(format!("\"{step}\" is below a key that is not a table")),
    }
}
