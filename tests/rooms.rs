//! The tables of crates in docs/architecture.md name every crate of `lib/` and what it imports.
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// What each crate imports of `lib/`.
type Imports = BTreeMap<String, BTreeSet<String>>;

/// Rows "| `crate` | owns | imports |" but for those of executables.
fn documented(page: &str) -> Imports {
    let rows = page.lines().filter_map(|line| {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        let [_, name, _, imports, _] = cells[..] else {
            return None;
        };
        let name = name.strip_prefix('`')?.split('`').next()?;
        let imports = imports.split(", ").filter(|i| *i != "–");
        Some((name.to_string(), imports.map(str::to_string).collect()))
    });
    rows.filter(|(name, _)| !name.starts_with("dipir"))
        .collect()
}

/// A manifest's crate and its `[dependencies]` in `lib/`, without the prefix `dipir-`.
fn declared(manifest: &str) -> (String, BTreeSet<String>) {
    let mut lines = manifest.lines();
    let name = lines.find_map(|l| l.strip_prefix("name = \"dipir-")?.strip_suffix('"'));
    let section = lines.skip_while(|l| *l != "[dependencies]").skip(1);
    let dependencies = section.take_while(|l| !l.starts_with('['));
    let names = dependencies.filter_map(|l| l.strip_prefix("dipir-")?.split(['.', ' ']).next());
    (
        name.unwrap().to_string(),
        names.map(str::to_string).collect(),
    )
}

#[test]
fn the_architecture_page_lists_every_crate_and_its_imports() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folders = fs::read_dir(root.join("lib")).unwrap();
    let manifests = folders.map(|f| fs::read_to_string(f.unwrap().path().join("Cargo.toml")));
    let declared: Imports = manifests.map(|text| declared(&text.unwrap())).collect();
    let page = fs::read_to_string(root.join("docs/architecture.md")).unwrap();
    assert_eq!(documented(&page), declared);
}
