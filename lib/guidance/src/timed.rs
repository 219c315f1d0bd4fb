//! How long guidance and recorder take.
use std::time::Instant;

use dipir_imaging::raster::Raster;
use dipir_light::environment::EnvironmentMap;
use dipir_optimize::crop::{CropView, Framing};
use dipir_optimize::error::OptimizeError;
use dipir_optimize::guidance::{Guidance, Guided, Step};
use dipir_optimize::transport::{LinearTransport, Recorder};
use glam::Vec3;

/// What is asked many times, and the seconds that its answers took.
pub(crate) struct Timed<T> {
    of: T,
    /// Of all answers so far.
    pub seconds: f64,
}

impl<T> Timed<T> {
    pub fn new(of: T) -> Self {
        Self { of, seconds: 0.0 }
    }

    fn ask<R>(&mut self, ask: impl FnOnce(&mut T) -> R) -> R {
        let clock = Instant::now();
        let answer = ask(&mut self.of);
        self.seconds += clock.elapsed().as_secs_f64();
        answer
    }
}

impl Guidance for Timed<Box<dyn Guidance + '_>> {
    fn framing(&self) -> Framing {
        self.of.framing()
    }

    fn gradient(
        &mut self,
        picture: &Raster<Vec3>,
        view: &CropView,
        step: Step,
    ) -> Result<Guided, OptimizeError> {
        self.ask(|guidance| guidance.gradient(picture, view, step))
    }
}

impl<R: Recorder> Recorder for Timed<R> {
    fn record(
        &mut self,
        light: &EnvironmentMap,
    ) -> Result<Box<dyn LinearTransport>, OptimizeError> {
        self.ask(|recorder| recorder.record(light))
    }
}
