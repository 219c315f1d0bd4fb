//! Random numbers of generated content.

use dipir_diffusion::noise::NoiseStream;

/// Uniform in [low, high).
pub(crate) fn between(stream: &mut NoiseStream, low: f64, high: f64) -> f32 {
    (low + (high - low) * stream.uniform()) as f32
}

/// Draws the random numbers of one scene.
pub(crate) struct Draw<'a>(pub(crate) &'a mut NoiseStream);

impl<'a> Draw<'a> {
    pub(crate) fn new(stream: &'a mut NoiseStream) -> Self {
        Self(stream)
    }

    /// Uniform in [low, high).
    pub(crate) fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.0.uniform() as f32
    }

    /// Uniform integer below `n`.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        self.0.below(n)
    }

    /// True with probability `share`.
    pub(crate) fn chance(&mut self, share: f64) -> bool {
        self.0.uniform() < share
    }
}
