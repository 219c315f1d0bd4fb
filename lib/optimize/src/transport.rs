//! How light reaches the picture: linear, recorded once, replayed in every iteration.
use dipir_imaging::raster::Raster;
use dipir_light::environment::EnvironmentMap;
use dipir_render::transport::Transport;
use glam::Vec3;

use crate::error::OptimizeError;

/// Light transport of a fixed scene. `light` is one texel after the other, row by row from +y.
pub trait LinearTransport: Send + Sync {
    /// Width and height of the picture.
    fn size(&self) -> (usize, usize);
    /// Width and height of the environment.
    fn environment_size(&self) -> (usize, usize);
    /// Antialiased coverage of the object, in [0, 1].
    fn coverage(&self) -> &Raster<f32>;
    /// Radiance of the object, premultiplied.
    fn foreground(&self, light: &[Vec3]) -> Raster<Vec3>;
    /// Adjoint of [`foreground`](Self::foreground): the gradient of every texel.
    fn foreground_vjp(&self, gradient: &[Vec3]) -> Vec<Vec3>;
    /// Light on the proxy with the object over light without it.
    fn shadow(&self, light: &[Vec3]) -> Raster<Vec3>;
    /// Adjoint of [`shadow`](Self::shadow), which gave `ratio` under `light`.
    fn shadow_vjp(&self, light: &[Vec3], ratio: &Raster<Vec3>, gradient: &[Vec3]) -> Vec<Vec3>;
    /// The share of the recorded samples that `light` makes use of, in (0, 1]; 1 for an exact
    /// transport. Falls when the light moves to where the record has few samples.
    fn efficiency(&self, _light: &[Vec3]) -> f64 {
        1.0
    }
}

impl LinearTransport for Transport {
    fn size(&self) -> (usize, usize) {
        self.size().into()
    }

    fn environment_size(&self) -> (usize, usize) {
        self.environment_size().into()
    }

    fn coverage(&self) -> &Raster<f32> {
        self.coverage()
    }

    fn foreground(&self, light: &[Vec3]) -> Raster<Vec3> {
        self.foreground(light)
    }

    fn foreground_vjp(&self, gradient: &[Vec3]) -> Vec<Vec3> {
        self.foreground_vjp(gradient)
    }

    fn shadow(&self, light: &[Vec3]) -> Raster<Vec3> {
        self.shadow(light)
    }

    fn shadow_vjp(&self, light: &[Vec3], ratio: &Raster<Vec3>, gradient: &[Vec3]) -> Vec<Vec3> {
        self.shadow_vjp(light, ratio, gradient)
    }

    fn efficiency(&self, light: &[Vec3]) -> f64 {
        self.light_sample_size(light) / f64::from(self.header().samples.max(1))
    }
}

/// Records transport anew when the light has moved away from what the last record was made for.
pub trait Recorder {
    /// Transport recorded with `light` among the sampling densities. The same light gives the
    /// same transport, so that a resumed run can repeat it.
    fn record(&mut self, light: &EnvironmentMap)
    -> Result<Box<dyn LinearTransport>, OptimizeError>;
}
