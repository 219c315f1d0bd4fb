//! Reads a placed TOML tree into any serde type. The error type keeps serde's findings apart
//! (unknown field, wrong type, missing key) and gathers key and place on its way out.
use std::fmt;

use serde::Deserialize;
use serde::de::value::StrDeserializer;
use serde::de::{
    self, DeserializeSeed, EnumAccess, Expected, IntoDeserializer, MapAccess, Unexpected,
    VariantAccess, Visitor,
};

use super::tree::{Entry, Node, Value};
use super::{Place, nearest};
use crate::error::ConfigError;

/// Reads `node`, the table called `name`.
pub(super) fn read<T: for<'de> Deserialize<'de>>(
    node: &Node,
    name: &str,
) -> Result<T, ConfigError> {
    T::deserialize(node).map_err(|mut e| {
        e.steps.push(name.into());
        e.into_config_error(&node.place)
    })
}

#[derive(Debug)]
enum Finding {
    UnknownField {
        accepted: Vec<String>,
    },
    UnknownVariant {
        found: String,
        accepted: Vec<String>,
    },
    Missing {
        key: String,
    },
    Wrong {
        found: String,
        accepted: String,
    },
    Custom(String),
}

/// A finding on its way out: `steps` holds the key from the inside out.
#[derive(Debug)]
pub(super) struct ReadError {
    finding: Finding,
    steps: Vec<String>,
    place: Option<Place>,
}

/// The keys that a single pair of brackets makes a table by mistake.
const LISTS_OF_TABLES: [&str; 2] = ["scene.objects", "scene.views"];

impl ReadError {
    fn new(finding: Finding) -> Self {
        Self {
            finding,
            steps: Vec::new(),
            place: None,
        }
    }

    fn at(mut self, place: &Place) -> Self {
        self.place.get_or_insert_with(|| place.clone());
        self
    }

    fn below(mut self, step: impl Into<String>, place: &Place) -> Self {
        self.steps.push(step.into());
        self.at(place)
    }

    fn into_config_error(self, root: &Place) -> ConfigError {
        let at = self.place.unwrap_or_else(|| root.clone());
        let mut steps = self.steps;
        steps.reverse();
        let key = steps.join(".");
        match self.finding {
            Finding::UnknownField { accepted } => ConfigError::UnknownKey {
                at,
                nearest: steps.last().and_then(|last| nearest(last, &accepted)),
                table: steps[..steps.len().saturating_sub(1)].join("."),
                key,
                accepted,
            },
            Finding::UnknownVariant { found, accepted } => ConfigError::UnknownChoice {
                at,
                key,
                nearest: nearest(&found, &accepted),
                found,
                accepted,
            },
            Finding::Missing { key: missing } => ConfigError::MissingKey {
                at,
                dotted: format!("{key}.{missing}"),
                table: key,
                key: missing,
            },
            Finding::Wrong { found, accepted } => ConfigError::WrongType {
                at,
                accepted: match LISTS_OF_TABLES.contains(&key.as_str()) && found == "a table" {
                    true => format!("{accepted}, each table of which begins with [[{key}]]"),
                    false => accepted,
                },
                key,
                found,
            },
            Finding::Custom(message) => ConfigError::Invalid { at, key, message },
        }
    }
}

impl fmt::Display for ReadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.finding)
    }
}

impl std::error::Error for ReadError {}

impl de::Error for ReadError {
    fn custom<T: fmt::Display>(message: T) -> Self {
        Self::new(Finding::Custom(message.to_string()))
    }

    fn invalid_type(found: Unexpected<'_>, accepted: &dyn Expected) -> Self {
        Self::new(Finding::Wrong {
            found: in_words(found),
            accepted: accepted_in_words(&accepted.to_string()),
        })
    }

    fn invalid_value(found: Unexpected<'_>, accepted: &dyn Expected) -> Self {
        match (found, accepted.to_string().as_str()) {
            // Too large a number is one of 0 or more, too.
            (Unexpected::Signed(0..), "u32") => Self::new(Finding::Wrong {
                found: in_words(found),
                accepted: format!("a whole number from 0 to {}", u32::MAX),
            }),
            _ => Self::invalid_type(found, accepted),
        }
    }

    fn invalid_length(length: usize, accepted: &dyn Expected) -> Self {
        Self::new(Finding::Wrong {
            found: match length {
                1 => "a list of 1 value".into(),
                n => format!("a list of {n} values"),
            },
            accepted: accepted_in_words(&accepted.to_string()),
        })
    }

    fn unknown_variant(found: &str, accepted: &'static [&'static str]) -> Self {
        Self::new(Finding::UnknownVariant {
            found: found.into(),
            accepted: accepted.iter().map(|s| (*s).into()).collect(),
        })
    }

    fn unknown_field(_: &str, accepted: &'static [&'static str]) -> Self {
        Self::new(Finding::UnknownField {
            accepted: accepted.iter().map(|s| (*s).into()).collect(),
        })
    }

    fn missing_field(field: &'static str) -> Self {
        Self::new(Finding::Missing { key: field.into() })
    }
}

fn in_words(found: Unexpected<'_>) -> String {
    match found {
        Unexpected::Str(s) => format!("the string \"{s}\""),
        Unexpected::Signed(i) => format!("the integer {i}"),
        Unexpected::Unsigned(i) => format!("the integer {i}"),
        Unexpected::Float(f) => format!("the number {f:?}"),
        Unexpected::Bool(b) => format!("{b}"),
        Unexpected::Seq => "a list".into(),
        Unexpected::Map => "a table".into(),
        other => other.to_string(),
    }
}

/// Serde's names of Rust types, as a writer of TOML would say them.
fn accepted_in_words(accepted: &str) -> String {
    match accepted {
        "f32" | "f64" => "a number".into(),
        "u8" => "a whole number from 0 to 255".into(),
        "u16" => "a whole number from 0 to 65535".into(),
        "u32" | "u64" | "usize" => "a whole number, 0 or more".into(),
        "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number".into(),
        "a boolean" => "true or false".into(),
        "path string" => "a path in quotes".into(),
        "a sequence" => "a list".into(),
        "an array of length 2" | "a tuple of size 2" | "a sequence of 2 f32 values" => {
            "a list of 2 numbers".into()
        }
        "an array of length 3" | "a tuple of size 3" | "a sequence of 3 f32 values" => {
            "a list of 3 numbers".into()
        }
        "an array of length 4" | "a tuple of size 4" | "a sequence of 4 f32 values" => {
            "a list of 4 numbers".into()
        }
        other if other.starts_with("struct ") => "a table".into(),
        other if other.starts_with("internally tagged enum ") => "a table".into(),
        other => other.into(),
    }
}

impl Node {
    fn unexpected(&self) -> Unexpected<'_> {
        match &self.value {
            Value::String(s) => Unexpected::Str(s),
            Value::Integer(i) => Unexpected::Signed(*i),
            Value::Float(f) => Unexpected::Float(*f),
            Value::Boolean(b) => Unexpected::Bool(*b),
            Value::Datetime(_) => Unexpected::Other("a date"),
            Value::Array(_) => Unexpected::Seq,
            Value::Table(_) => Unexpected::Map,
        }
    }
}

struct Items<'a> {
    nodes: std::slice::Iter<'a, Node>,
    index: usize,
}

impl<'de> de::SeqAccess<'de> for Items<'de> {
    type Error = ReadError;

    fn next_element_seed<T: DeserializeSeed<'de>>(
        &mut self,
        seed: T,
    ) -> Result<Option<T::Value>, ReadError> {
        let Some(node) = self.nodes.next() else {
            return Ok(None);
        };
        let index = self.index;
        self.index += 1;
        seed.deserialize(node)
            .map(Some)
            .map_err(|e| e.below(index.to_string(), &node.place))
    }

    fn size_hint(&self) -> Option<usize> {
        Some(self.nodes.len())
    }
}

struct Entries<'a> {
    entries: std::slice::Iter<'a, Entry>,
    current: Option<&'a Entry>,
}

impl<'de> MapAccess<'de> for Entries<'de> {
    type Error = ReadError;

    fn next_key_seed<K: DeserializeSeed<'de>>(
        &mut self,
        seed: K,
    ) -> Result<Option<K::Value>, ReadError> {
        let Some(entry) = self.entries.next() else {
            return Ok(None);
        };
        self.current = Some(entry);
        let key: StrDeserializer<'_, ReadError> = entry.name.as_str().into_deserializer();
        seed.deserialize(key)
            .map(Some)
            .map_err(|e| e.below(&entry.name, &entry.place))
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, ReadError> {
        let Some(entry) = self.current.take() else {
            return Err(de::Error::custom("a value was asked for before its key"));
        };
        seed.deserialize(&entry.node)
            .map_err(|e| e.below(&entry.name, &entry.node.place))
    }
}

impl<'de> de::Deserializer<'de> for &'de Node {
    type Error = ReadError;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ReadError> {
        match &self.value {
            Value::String(s) => visitor.visit_borrowed_str(s),
            Value::Integer(i) => visitor.visit_i64(*i),
            Value::Float(f) => visitor.visit_f64(*f),
            Value::Boolean(b) => visitor.visit_bool(*b),
            // A date needs no quotes where its text is wanted.
            Value::Datetime(text) => visitor.visit_borrowed_str(text),
            Value::Array(items) => {
                let mut access = Items {
                    nodes: items.iter(),
                    index: 0,
                };
                let value = visitor.visit_seq(&mut access)?;
                if access.nodes.len() > 0 {
                    return Err(de::Error::invalid_length(
                        items.len(),
                        &format!("a list of {} values", access.index).as_str(),
                    ));
                }
                Ok(value)
            }
            Value::Table(entries) => visitor.visit_map(Entries {
                entries: entries.iter(),
                current: None,
            }),
        }
        .map_err(|e: ReadError| e.at(&self.place))
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ReadError> {
        visitor.visit_some(self)
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(
        self,
        _: &'static str,
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _: &'static str,
        variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        match &self.value {
            Value::String(name) => visitor.visit_enum(Choice {
                name,
                content: None,
            }),
            Value::Table(entries) if entries.len() == 1 => visitor.visit_enum(Choice {
                name: &entries[0].name,
                content: Some(&entries[0].node),
            }),
            _ => Err(de::Error::invalid_type(
                self.unexpected(),
                &one_of(variants).as_str(),
            )),
        }
        .map_err(|e: ReadError| e.at(&self.place))
    }

    fn deserialize_str<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ReadError> {
        self.deserialize_string(visitor)
    }

    /// Text needs no quotes on a command line, whatever it looks like.
    fn deserialize_string<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ReadError> {
        match (&self.value, &self.place) {
            (Value::Integer(_) | Value::Float(_) | Value::Boolean(_), Place::Flag(flag)) => {
                match flag.split_once('=') {
                    // Not within a list or a table.
                    Some((_, text)) if !text.trim().starts_with(['[', '{']) => visitor
                        .visit_str(text.trim())
                        .map_err(|e: ReadError| e.at(&self.place)),
                    _ => self.deserialize_any(visitor),
                }
            }
            _ => self.deserialize_any(visitor),
        }
    }

    serde::forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char bytes byte_buf
        unit unit_struct seq tuple tuple_struct map struct identifier ignored_any
    }
}

fn one_of(variants: &[&str]) -> String {
    let quoted: Vec<_> = variants.iter().map(|v| format!("\"{v}\"")).collect();
    quoted.join(", ")
}

struct Choice<'a> {
    name: &'a str,
    content: Option<&'a Node>,
}

impl<'de> EnumAccess<'de> for Choice<'de> {
    type Error = ReadError;
    type Variant = Content<'de>;

    fn variant_seed<V: DeserializeSeed<'de>>(
        self,
        seed: V,
    ) -> Result<(V::Value, Content<'de>), ReadError> {
        let name: StrDeserializer<'_, ReadError> = self.name.into_deserializer();
        Ok((seed.deserialize(name)?, Content(self.content)))
    }
}

struct Content<'a>(Option<&'a Node>);

impl<'a> Content<'a> {
    fn node(&self, expected: &str) -> Result<&'a Node, ReadError> {
        self.0
            .ok_or_else(|| de::Error::invalid_type(Unexpected::UnitVariant, &expected))
    }
}

impl<'de> VariantAccess<'de> for Content<'de> {
    type Error = ReadError;

    fn unit_variant(self) -> Result<(), ReadError> {
        match self.0 {
            None => Ok(()),
            Some(node) => Err(de::Error::invalid_type(
                node.unexpected(),
                &"its name alone",
            )),
        }
    }

    fn newtype_variant_seed<T: DeserializeSeed<'de>>(self, seed: T) -> Result<T::Value, ReadError> {
        seed.deserialize(self.node("a table with its value")?)
    }

    fn tuple_variant<V: Visitor<'de>>(self, _: usize, visitor: V) -> Result<V::Value, ReadError> {
        de::Deserializer::deserialize_any(self.node("a table with a list")?, visitor)
    }

    fn struct_variant<V: Visitor<'de>>(
        self,
        _: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        de::Deserializer::deserialize_any(self.node("a table with its fields")?, visitor)
    }
}
