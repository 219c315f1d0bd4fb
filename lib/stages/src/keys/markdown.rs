//! `docs/keys.md`.
use super::{Key, Table, tables};

const HEAD: &str = "\
# Keys
Every key of `pipeline.toml`: what it accepts, what holds without it, an example, and what it is.
`dipir keys WORD` shows the keys whose name or description contains the word.

On the command line a key is set by its dotted name, as in `--set scene.camera.fov_deg=40.0`; a number stands for
`N`, 0 for the first object. Such a key takes the place of the file's keys that exclude it, as `at_pixel` does of `position`,
and text needs no quotes. Relative paths start from the folder of the file. The
[demo's file](../pipeline.toml) is one to begin with.

An editor that knows Taplo completes and checks the file with the schema that
`dipir keys --schema > pipeline.schema.json` writes, where the first line is `#:schema ./pipeline.schema.json`.

`dipir keys --markdown` writes this page.
";

/// All keys as a page of Markdown.
pub fn markdown() -> String {
    let mut page = HEAD.to_string();
    for (k, table) in tables().iter().enumerate() {
        page += &section(table, &tables()[..k]);
    }
    page
}

/// A table; that it has the keys of an earlier one is said.
fn section(table: &Table, earlier: &[Table]) -> String {
    let mut text = format!("\n## `{}`\n{}\n", table.header(), table.sentence);
    if table.keys.is_empty() {
        return text;
    }
    if let Some(same) = earlier.iter().find(|t| t.is_like(table)) {
        let (name, header) = (&table.name, same.header());
        return text + &format!("\nThe keys of `{header}`, as `{name}.` and their names.\n");
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
