//! Defaults of keys, where a table leaves them out.
use serde_json::Value;

use super::{schema, value};

/// Fills the JSON of the table `name` in as if it named every key: the default of one that is left out, or null where it
/// has none. A table in it that is left out stays so.
pub(crate) fn fill(name: &str, table: &mut Value) {
    fill_in(&schema()["properties"][name], table);
}

fn fill_in(schema: &Value, written: &mut Value) {
    match written {
        Value::Object(fields) => {
            let table = value::table_in(schema).unwrap_or(&Value::Null);
            for (key, part) in value::properties(table) {
                let field = fields.entry(key).or_insert(Value::Null);
                match field.is_null() {
                    true => *field = part["default"].clone(),
                    false => fill_in(part, field),
                }
            }
        }
        Value::Array(items) => {
            let table = value::table_in_list(schema).unwrap_or(&Value::Null);
            items.iter_mut().for_each(|item| fill_in(table, item));
        }
        _ => {}
    }
}
