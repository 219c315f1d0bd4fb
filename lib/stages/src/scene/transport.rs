//! The picture that is optimised, and the record of how light reaches it.
//!
//! Light is optimised on a picture whose longest side is `[light] size`: photograph and mask are
//! scaled down by the mean over each pixel's area, and the camera with them. Light and tone curves
//! have no resolution, so they serve the photograph at its full size.
use std::ops::ControlFlow;

use dipir_cli::session::Session;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::resize::{Filter, resize};
use dipir_imaging::transfer::Transfer;
use dipir_optimize::settings::{LightTable, Settings};
use dipir_render::error::RenderError;
use dipir_render::render::{Renderer, Settings as RenderSettings, Simulation};
use dipir_render::transport::{RecordSettings, Transport};
use dipir_scene::camera::Camera;
use dipir_scene::scene::LoadedScene;

use crate::{interruption, presets};

/// Name of the file.
pub const FILE: &str = "transport.safetensors";
/// Its role among the scene stage's outputs.
pub const ROLE: &str = "transport";

/// The `[light]` table with the quality's values for what it leaves open.
pub fn settings(session: &Session, table: &LightTable) -> anyhow::Result<Settings> {
    let preset = presets::of(session.pipeline.quality).light;
    let settings = table.settings(&preset, session.pipeline.seed);
    settings.map_err(|e| {
        let key = format!("light.{}", e.key);
        session.config.invalid(&key, e.message).into()
    })
}

/// The photograph at the size at which light is optimised, and its camera.
pub struct Frame {
    /// Of the scaled photograph.
    pub camera: Camera,
    /// The scaled photograph, linear.
    pub background: LinearImage,
    /// How the photograph is encoded.
    pub transfer: Transfer,
    /// Scaled, too.
    pub occluders: Option<Raster<f32>>,
}

impl Frame {
    /// Scales what was loaded so that no side is longer than `longest` pixels.
    pub fn new(loaded: &LoadedScene, longest: usize) -> Self {
        let camera = loaded.scene.camera;
        let [width, height] = scaled(camera.resolution, longest);
        Self {
            camera: camera.scaled([width, height]),
            background: Self::image(&loaded.photo.image, [width, height]),
            transfer: loaded.photo.transfer,
            occluders: loaded
                .occluders
                .as_ref()
                .map(|mask| resize(mask, width as usize, height as usize, Filter::Area)),
        }
    }

    /// A picture of the photograph's size, scaled as the photograph.
    pub fn scale(&self, image: &LinearImage) -> LinearImage {
        Self::image(image, self.camera.resolution)
    }

    fn image(image: &LinearImage, [width, height]: [u32; 2]) -> LinearImage {
        let (width, height) = (width as usize, height as usize);
        if (image.0.width(), image.0.height()) == (width, height) {
            return image.clone();
        }
        LinearImage(resize(&image.0, width, height, Filter::Area))
    }

    /// How a picture of this size is rendered.
    pub fn render_settings(&self) -> RenderSettings<'_> {
        RenderSettings::of(&self.background, self.transfer, self.occluders.as_ref())
    }

    /// How transport is recorded for `settings`. `scene_hash` identifies the scene.
    pub fn record_settings(
        &self,
        settings: &Settings,
        simulation: Simulation,
        scene_hash: String,
    ) -> RecordSettings<'_> {
        RecordSettings {
            environment: settings.environment,
            samples: settings.samples,
            shadow_samples: settings.samples,
            precision: settings.precision,
            seed: settings.seed,
            background: Some(&self.background),
            occluders: self.occluders.as_ref(),
            scene_hash,
            ..RecordSettings::new(simulation)
        }
    }
}

fn scaled([width, height]: [u32; 2], longest: usize) -> [u32; 2] {
    let side = width.max(height) as f64;
    let scale = (longest as f64 / side).min(1.0);
    [width, height].map(|n| ((f64::from(n) * scale).round() as u32).max(1))
}

/// Identifies the scene of a record: a hash of its description and of what is simulated.
pub fn scene_hash(loaded: &LoadedScene, simulation: &Simulation) -> anyhow::Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&serde_json::to_vec(&loaded.description)?);
    hasher.update(format!("{simulation:?}").as_bytes());
    Ok(hasher.finalize().to_hex().to_string())
}

/// Records, with a progress bar.
pub fn record(
    session: &Session,
    renderer: &Renderer,
    settings: &RecordSettings,
) -> anyhow::Result<Transport> {
    let progress = session.progress("transport");
    let mut report = |fraction| -> ControlFlow<()> {
        progress.set(fraction);
        interruption()
    };
    let recorded: Result<_, RenderError> = Transport::record(renderer, settings, &mut report);
    let transport = recorded.map_err(crate::render_error)?;
    progress.done();
    Ok(transport)
}

/// Whether `transport` is what recording with `settings` would give.
pub fn is_current(transport: &Transport, settings: &RecordSettings, camera: &Camera) -> bool {
    let h = transport.header();
    let s = &settings.simulation;
    h.size == camera.resolution.map(|n| n as usize)
        && h.environment == settings.environment
        && (h.samples, h.shadow_samples) == (settings.samples, settings.shadow_samples)
        && (h.precision, h.seed) == (settings.precision, settings.seed)
        && (h.max_depth, h.features) == (s.max_depth, s.features)
        && h.scene_hash == settings.scene_hash
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_scaled_down_to_the_longest_side_and_never_up() {
        assert_eq!(scaled([1920, 1080], 384), [384, 216]);
        assert_eq!(scaled([1080, 1920], 384), [216, 384]);
        assert_eq!(scaled([36, 24], 384), [36, 24]);
        assert_eq!(scaled([10_000, 3], 100), [100, 1]);
    }
}
