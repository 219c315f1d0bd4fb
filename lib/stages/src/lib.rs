//! The stages behind the executables: each a function from a session to a folder of artifacts.
pub mod command_line;
pub mod composite;
pub mod concepts;
pub mod graph;
pub mod keys;
pub mod known_light;
pub mod light;
pub mod lora;
pub mod model;
pub mod names;
pub mod needed_files;
pub mod presets;
pub mod preview;
mod reasons;
pub mod report;
pub mod scene;
pub mod shot;
pub mod truth;
mod upstream;

use std::fmt;
use std::ops::ControlFlow;
use std::path::Path;

use dipir_cli::exit::printable;
use dipir_cli::interrupt::{self, Interrupted};
use dipir_cli::session::duration;
use dipir_pipeline::manifest::Manifest;
use dipir_render::error::RenderError;

/// Whether a long computation goes on.
fn interruption() -> ControlFlow<()> {
    match interrupt::asked() {
        true => ControlFlow::Break(()),
        false => ControlFlow::Continue(()),
    }
}

/// The line that every stage ends with: where it wrote, and how long it took.
fn written(f: &mut fmt::Formatter<'_>, folder: &Path, manifest: &Manifest) -> fmt::Result {
    let elapsed = duration(manifest.elapsed_s);
    write!(f, "wrote {} in {elapsed}", shown(folder))
}

/// A path in what is printed of a result: names of folders come from anywhere.
fn shown(path: &Path) -> String {
    printable(&path.display().to_string())
}

/// A renderer's error; its interruption is the user's.
fn render_error(error: RenderError) -> anyhow::Error {
    match error {
        RenderError::Interrupted => Interrupted.into(),
        other => other.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_pipeline::stage::{StagePlan, StageWriter};

    struct Done(Manifest);

    impl fmt::Display for Done {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            written(f, Path::new("out\u{1b}[2J/scene"), &self.0)
        }
    }

    #[test]
    fn a_terminal_does_not_obey_the_name_of_a_folder_that_was_written() {
        let out = tempfile::tempdir().unwrap();
        let plan = StagePlan::new("scene", 1, serde_json::Value::Null, 0);
        let target = out.path().join("scene");
        let writer = StageWriter::begin(&target, plan, Default::default()).unwrap();
        let text = Done(writer.finish().unwrap()).to_string();
        assert!(text.starts_with("wrote out\\u{1b}[2J/scene in "), "{text}");
    }
}
