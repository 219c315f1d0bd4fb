//! Records transport from a scene, as often as the light moves away from what was recorded.
use std::ops::ControlFlow;

use dipir_light::environment::EnvironmentMap;
use dipir_render::error::RenderError;
use dipir_render::render::Renderer;
use dipir_render::transport::{RecordSettings, Transport};

use crate::error::OptimizeError;
use crate::transport::{LinearTransport, Recorder};

/// Traces the paths of `renderer`'s picture anew.
pub struct SceneRecorder<'a> {
    /// The scene, seen by the camera of the optimisation.
    pub renderer: &'a Renderer<'a>,
    /// As for the first record; the light is set by each record.
    pub settings: RecordSettings<'a>,
    /// Gets the share that is done; may break off.
    pub progress: &'a mut dyn FnMut(f64) -> ControlFlow<()>,
}

impl Recorder for SceneRecorder<'_> {
    fn record(
        &mut self,
        light: &EnvironmentMap,
    ) -> Result<Box<dyn LinearTransport>, OptimizeError> {
        let settings = RecordSettings {
            light: Some(light),
            ..self.settings.clone()
        };
        match Transport::record(self.renderer, &settings, self.progress) {
            Ok(transport) => Ok(Box::new(transport)),
            Err(RenderError::Interrupted) => Err(OptimizeError::Interrupted),
            Err(e) => Err(OptimizeError::Record(e.into())),
        }
    }
}
