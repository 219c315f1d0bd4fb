//! Files that the configuration names for later stages, looked for before any stage runs.
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use dipir_cli::session::Session;
use dipir_optimize::settings::{LightTable, Start};
use dipir_pipeline::graph::Node;

use crate::composite::table::CompositeTable;
use crate::light::method::Method;
use crate::light::request::refuse_misspelt;
use crate::model::ModelTable;
use crate::names::{COMPOSITE, CONCEPTS, LIGHT, LORA};

/// Refuses files and folders that `nodes` would read and that are not there. What they hold is read at its turn.
///
/// # Errors
/// The first such key, with what it names.
pub fn check(session: &Session, nodes: &[&Node]) -> anyhow::Result<()> {
    let light: LightTable = session.config.table("light")?;
    let composite: CompositeTable = session.config.table("composite")?;
    let model: ModelTable = session.config.table("model")?;
    let method = Method::of(session)?;
    let runs = |stages: &[&str]| nodes.iter().any(|n| stages.contains(&n.stage));
    let start = match light.start {
        Start::File(path) => Some(path),
        _ => None,
    };
    let recovers_light = !matches!(method, Method::Materials | Method::Given | Method::Taken);
    let reads_reference = matches!(method, Method::Reference | Method::Materials);
    let asks_model = matches!(method, Method::Model { .. });
    let with_model = [CONCEPTS.name, LORA.name, LIGHT.name];
    let recovers = runs(&[LIGHT.name]);
    if let Some(path) = start.as_ref().filter(|_| recovers && recovers_light) {
        refuse_misspelt(session, path)?;
    }
    for (key, path, is_read) in [
        ("light.start", &start, recovers && recovers_light),
        (
            "light.reference",
            &light.reference,
            recovers && reads_reference,
        ),
        ("model.path", &model.path, asks_model && runs(&with_model)),
        (
            "composite.environment",
            &composite.environment,
            session.light.is_none() && runs(&[LIGHT.name, COMPOSITE.name]),
        ),
    ] {
        let path: &Option<PathBuf> = path;
        if let Some(path) = path.as_deref().filter(|_| is_read) {
            check_one(session, key, path)?;
        }
    }
    Ok(())
}

fn check_one(session: &Session, key: &str, path: &Path) -> anyhow::Result<()> {
    if path.as_os_str().is_empty() {
        let message = "is empty; name a file, or remove the key";
        return Err(session.config.invalid(key, message).into());
    }
    let place = session.resolve(path);
    // What cannot be looked at its reader says better.
    match place.try_exists() {
        Ok(false) => {
            let what = format!("cannot use {key} = \"{}\"", path.display());
            let gone = anyhow!("`{}` does not exist; check the path", place.display());
            Err(gone.context(what))
        }
        _ => Ok(()),
    }
}
