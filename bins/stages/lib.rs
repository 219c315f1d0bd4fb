//! The stages behind the executables: each a function from a session to a folder of artifacts.
pub mod background;
pub mod children;
pub mod composite;
pub mod concepts;
pub mod distillation;
mod embedded;
mod guide;
pub mod light;
pub mod lora;
pub mod materials;
pub mod model;
pub mod optimize;
pub mod pipeline;
pub mod presets;
pub mod preview;
pub mod reading;
pub mod report;
mod resume;
pub mod scene;
pub mod scene_folder;
pub mod transport;
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
