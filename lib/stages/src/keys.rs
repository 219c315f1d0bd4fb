//! Every key of `pipeline.toml`: what it accepts, its default, what it is, an example. All of it is
//! read off the types that read the file, as a JSON schema, so that nothing can be missing.
pub(crate) mod defaults;
mod markdown;
mod value;

use std::sync::OnceLock;

use dipir_optimize::settings::LightTable;
use dipir_pipeline::config::{PipelineTable, Quality, nearest};
use dipir_scene::config::SceneConfig;
use schemars::JsonSchema;
use schemars::generate::SchemaSettings;
use serde::Serialize;
use serde_json::Value;

use crate::composite::table::CompositeTable;
use crate::concepts::table::ConceptsTable;
use crate::lora::table::LoraTable;
use crate::model::ModelTable;
use crate::presets;
use crate::truth::ReportTable;

pub use markdown::markdown;

/// Keyword of the schema for a default that is no value of the file, in words.
const DEFAULT_IN_WORDS: &str = "x-default";

/// All tables of the file.
#[derive(Default, JsonSchema)]
#[schemars(deny_unknown_fields, default, title = "pipeline.toml of dipir")]
#[allow(dead_code, reason = "its schema is what is used")]
struct File {
    /// What all stages share.
    pipeline: PipelineTable,
    /// The diffusion model.
    model: ModelTable,
    /// The photograph, what is put into it, and from where it is seen.
    scene: SceneConfig,
    /// Images of the object's class, which keep the model from forgetting it.
    concepts: ConceptsTable,
    /// The training that adapts the model to the photograph.
    lora: LoraTable,
    /// How the light is recovered.
    light: LightTable,
    /// How the picture is rendered.
    composite: CompositeTable,
    /// What the report compares with.
    report: ReportTable,
}

/// A table of the file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Table {
    /// Its dotted name: `scene.camera`; `scene.objects.N` for those of a list.
    pub name: String,
    /// What it is about.
    pub sentence: String,
    /// Its keys, tables in it not counted.
    pub keys: Vec<Key>,
}

impl Table {
    /// As it stands in the file: `[scene.camera]`, `[[scene.objects]]`, `[scene.views.camera]` for the last view.
    pub fn header(&self) -> String {
        match self.name.strip_suffix(".N") {
            Some(list) => format!("[[{list}]]"),
            None => format!("[{}]", self.name.replace(".N.", ".")),
        }
    }

    /// Whether it has the same keys.
    fn is_like(&self, other: &Self) -> bool {
        let keys = |table: &Self| -> Vec<(String, String)> {
            let all = table.keys.iter();
            all.map(|k| (k.name().into(), k.sentence.clone())).collect()
        };
        !self.keys.is_empty() && keys(self) == keys(other)
    }
}

/// A key of a table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Key {
    /// Its dotted name, as `--set` takes it: `scene.camera.fov_deg`; a number stands for `N`.
    pub key: String,
    /// Type and range in words.
    pub accepted: String,
    /// What holds where the key is not set, in words or as TOML.
    pub default: String,
    /// What it is, with its unit.
    pub sentence: String,
    /// A value, as TOML.
    pub example: String,
    /// Its part of the schema.
    #[serde(skip)]
    schema: Value,
}

impl Key {
    /// Its name in its table.
    pub fn name(&self) -> &str {
        self.key.rsplit('.').next().unwrap_or(&self.key)
    }

    fn is_about(&self, word: &str) -> bool {
        let has = |text: &str| text.to_lowercase().contains(word);
        has(&self.key) || has(&self.sentence)
    }
}

/// The JSON schema of the file, for editors.
pub fn schema() -> &'static Value {
    static SCHEMA: OnceLock<Value> = OnceLock::new();
    SCHEMA.get_or_init(|| {
        // Editors of TOML know this draft.
        let settings = SchemaSettings::draft07().with(|s| s.inline_subschemas = true);
        let schema = settings.into_generator().into_root_schema_for::<File>();
        let mut schema = schema.to_value();
        drop_empty_defaults(&mut schema);
        schema
    })
}

/// Drops the defaults of tables, which stand with their keys, and those that TOML cannot write.
fn drop_empty_defaults(schema: &mut Value) {
    if let Some(fields) = schema.as_object_mut() {
        let is_null = fields.get("default").is_some_and(Value::is_null);
        if is_null || fields.contains_key("properties") {
            fields.shift_remove("default");
        }
        fields.values_mut().for_each(drop_empty_defaults);
    } else if let Some(items) = schema.as_array_mut() {
        items.iter_mut().for_each(drop_empty_defaults);
    }
}

/// All tables, in the order of the file.
pub fn tables() -> &'static [Table] {
    static TABLES: OnceLock<Vec<Table>> = OnceLock::new();
    TABLES.get_or_init(|| {
        let mut tables = Vec::new();
        for (name, part) in value::properties(schema()) {
            add(&mut tables, name, part, part);
        }
        tables
    })
}

/// Adds the table `name` and those in it. `field` is what the table around it says of it.
fn add(tables: &mut Vec<Table>, name: &str, field: &Value, table: &Value) {
    let at = tables.len();
    tables.push(Table {
        name: name.into(),
        sentence: sentence(field),
        keys: Vec::new(),
    });
    for (key, part) in value::properties(table) {
        let dotted = format!("{name}.{key}");
        if let Some(inner) = value::table_in(part) {
            add(tables, &dotted, part, inner);
        } else if let Some(inner) = value::table_in_list(part) {
            add(tables, &format!("{dotted}.N"), part, inner);
        } else {
            tables[at].keys.push(key_of(dotted, part));
        }
    }
}

fn key_of(key: String, schema: &Value) -> Key {
    let example = schema["examples"].get(0);
    Key {
        accepted: value::in_words(schema),
        default: default_of(&key, schema),
        sentence: sentence(schema),
        example: example.map_or(String::new(), value::toml),
        schema: schema.clone(),
        key,
    }
}

fn sentence(schema: &Value) -> String {
    let text = schema["description"].as_str().unwrap_or_default();
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

fn default_of(key: &str, schema: &Value) -> String {
    if let Some(words) = schema[DEFAULT_IN_WORDS].as_str() {
        return words.into();
    }
    if let Some(words) = of_qualities(key) {
        return words;
    }
    match &schema["default"] {
        Value::Null => "none".into(),
        value => format!("`{}`", value::toml(value)),
    }
}

/// For keys that `pipeline.quality` sets: the values of all qualities.
fn of_qualities(key: &str) -> Option<String> {
    let of = |quality| {
        let preset = presets::of(quality);
        let light = &preset.light;
        Some(match key {
            "composite.target_error" => preset.composite.target_error.to_string(),
            "light.iterations" => light.iterations.to_string(),
            "light.lobes" => light.lobes.to_string(),
            "light.environment" => format!("{:?}", light.environment),
            "light.samples" => light.samples.to_string(),
            "light.size" => light.size.to_string(),
            _ => return None,
        })
    };
    Some(format!(
        "the quality's: draft `{}`, standard `{}`, high `{}`",
        of(Quality::Draft)?,
        of(Quality::Standard)?,
        of(Quality::High)?
    ))
}

/// The tables with the keys whose name or sentence contains `word`, whatever its case.
pub fn about(word: &str) -> Vec<Table> {
    let word = word.to_lowercase();
    let keys = |table: &Table| {
        let all = table.keys.iter();
        all.filter(|key| key.is_about(&word)).cloned().collect()
    };
    let tables = tables().iter().map(|table| Table {
        keys: keys(table),
        ..table.clone()
    });
    let mut found: Vec<Table> = tables.filter(|table| !table.keys.is_empty()).collect();
    // Whoever names a table means its keys first.
    found.sort_by_key(|table| !table.name.starts_with(&word));
    found
}

/// The key whose name is most like `word`, if one is.
pub fn like(word: &str) -> Option<&'static str> {
    let keys = || tables().iter().flat_map(|table| &table.keys);
    let names = keys().flat_map(|key| [key.name(), &key.key]);
    let name = nearest(&word.to_lowercase(), names)?;
    let meant = keys().find(|key| key.name() == name || key.key == name)?;
    Some(&meant.key)
}

#[cfg(test)]
mod tests;
