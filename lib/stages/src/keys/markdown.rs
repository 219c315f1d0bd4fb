//! `docs/keys.md`.
use super::{Key, Table, tables};

const HEAD: &str = "\
# Keys
Every key of `pipeline.toml`. `dipir keys WORD` finds those that a word names or describes, and `dipir keys
--schema > pipeline.schema.json` writes a JSON schema with which an editor completes and checks the file: Taplo
takes it where the first line is `#:schema pipeline.schema.json`.

On the command line a key is set by its dotted name, as in `--set scene.camera.fov_deg=40.0`; `N` is the number
of an object, from 0. Relative paths start from the folder of the file. A file of [demo](../pipeline.toml) size
is enough for most photographs.

This page is written by `dipir keys --markdown`.
";

/// All keys as a page of Markdown.
pub fn markdown() -> String {
    let mut page = HEAD.to_string();
    for table in tables() {
        page += &section(table);
    }
    page
}

fn section(table: &Table) -> String {
    let mut text = format!("\n## `{}`\n{}\n", table.header(), table.sentence);
    if table.keys.is_empty() {
        return text;
    }
    text += "\n| key | accepted | default | example | what it is |\n|---|---|---|---|---|\n";
    for key in &table.keys {
        text += &row(key);
    }
    text
}

fn row(key: &Key) -> String {
    let cell = |text: &str| text.replace('|', "\\|");
    format!(
        "| `{}` | {} | {} | `{}` | {} |\n",
        key.key,
        cell(&key.accepted),
        cell(&key.default),
        cell(&key.example),
        cell(&key.sentence)
    )
}
