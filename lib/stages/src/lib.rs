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
pub mod presets;
pub mod preview;
pub mod report;
pub mod scene;
pub mod truth;

use std::ops::ControlFlow;

use dipir_cli::interrupt::{self, Interrupted};
use dipir_render::error::RenderError;

/// Whether a long computation goes on.
fn interruption() -> ControlFlow<()> {
    match interrupt::asked() {
        true => ControlFlow::Break(()),
        false => ControlFlow::Continue(()),
    }
}

/// A renderer's error; its interruption is the user's.
fn render_error(error: RenderError) -> anyhow::Error {
    match error {
        RenderError::Interrupted => Interrupted.into(),
        other => other.into(),
    }
}
