//! A draft of the objects in the scaled photograph.
use std::ops::ControlFlow;
use std::sync::Arc;

use dipir_imaging::composite::composite;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_light::environment::EnvironmentSampler;
use dipir_light::map_with_lobes::MapWithLobes;
use dipir_render::adaptive::Stop;
use dipir_render::effects::EffectsPlan;
use dipir_render::error::RenderError;
use dipir_render::gloss;
use dipir_render::light::SceneLight;
use dipir_render::render::{Rendered, Renderer, Settings, Simulation};
use dipir_scene::scene::LoadedScene;
use dipir_stages::composite::shutter::that_blurs;
use dipir_stages::light::at_hand::AtHand;

/// Paths a pixel: the object's shape and shadow are clear, grain stays.
pub const SAMPLES: u32 = 4;
/// Columns and rows of the map that lights a draft: preparing a larger one takes longer than the
/// draft.
const MAP: [usize; 2] = [256, 128];
/// Interactions of a path: one of the object with itself shows in its creases.
const DEPTH: u32 = 2;

/// A rendered draft.
#[derive(Clone, Debug)]
pub struct Draft {
    /// The scaled photograph with objects and shadows.
    pub picture: DisplayImage,
    /// How much of a pixel the objects cover.
    pub alpha: Raster<f32>,
    /// First and one past the last column and row that objects or shadows change visibly; `None`
    /// if they change nothing.
    pub touched: Option<[usize; 4]>,
}

impl Draft {
    /// Renders `loaded` under `light`. `go_on` is asked after each round.
    ///
    /// # Errors
    /// On textures that cannot be read, and if it is broken off.
    pub fn render(
        loaded: &LoadedScene,
        light: &AtHand,
        samples: u32,
        go_on: &mut dyn FnMut() -> ControlFlow<()>,
    ) -> Result<Self, RenderError> {
        let tone = light.tone.as_ref();
        let rendered = match &light.map {
            Some(map) => {
                let [width, height] = MAP;
                let map = match map.width() > width {
                    true => Arc::new(map.resampled(width, height)),
                    false => map.clone(),
                };
                let map = EnvironmentSampler::new(map);
                let lit = MapWithLobes::new(map, light.lobes.clone());
                render(loaded, &lit, light, samples, go_on)
            }
            None => render(loaded, &light.lobes, light, samples, go_on),
        }?;
        let film = rendered.film;
        let (object, shadow) = match tone {
            Some(curves) => (
                curves.apply_object(&LinearImage(film.object), &film.alpha),
                curves.apply_shadow(&LinearImage(film.shadow)),
            ),
            None => (LinearImage(film.object), LinearImage(film.shadow)),
        };
        let mut object = object;
        if let Some(mirrored) = &film.mirrored {
            gloss::add(&mut object.0, mirrored, tone);
        }
        let photo = &loaded.photo;
        let picture = composite(&photo.image, &object, &film.alpha, &shadow)
            .unwrap_or_else(|_| photo.image.clone());
        let before = photo.transfer.encode(&photo.image);
        let picture = photo.transfer.encode(&picture);
        Ok(Self {
            touched: difference(&before, &picture),
            picture,
            alpha: film.alpha,
        })
    }
}

fn render<L: SceneLight>(
    loaded: &LoadedScene,
    light: &L,
    at_hand: &AtHand,
    samples: u32,
    go_on: &mut dyn FnMut() -> ControlFlow<()>,
) -> Result<Rendered, RenderError> {
    let settings = Settings {
        tone: at_hand.tone.as_ref(),
        gloss: at_hand.gloss,
        optics: that_blurs(at_hand.optics, loaded).0,
        ..settings(loaded, samples)
    };
    let renderer = Renderer::new(&loaded.scene);
    let simulation = simulation(&renderer, loaded, &settings);
    renderer.render(light, &simulation, &settings, &mut |_| go_on())
}

/// How a draft is rendered, with this many samples a pixel.
pub(crate) fn settings(loaded: &LoadedScene, samples: u32) -> Settings<'_> {
    Settings {
        stop: Stop::Samples(samples),
        max_samples: samples,
        highlights: false,
        denoise: true,
        blur_caustics: true,
        ..Settings::of_scene(loaded)
    }
}

/// What a draft simulates.
pub(crate) fn simulation(
    renderer: &Renderer,
    loaded: &LoadedScene,
    settings: &Settings,
) -> Simulation {
    let wanted = loaded.description.effects();
    let simulation = EffectsPlan::new(renderer, wanted, settings).simulation();
    Simulation {
        max_depth: simulation.max_depth.min(DEPTH),
        light_on_proxy: None,
        ..simulation
    }
}

/// The box of pixels that differ by more than an 8-bit step.
fn difference(before: &DisplayImage, after: &DisplayImage) -> Option<[usize; 4]> {
    const STEP: f32 = 1.5 / 255.0;
    let mut found: Option<[usize; 4]> = None;
    for y in 0..before.0.height() {
        for (x, (a, b)) in before.0.row(y).iter().zip(after.0.row(y)).enumerate() {
            if (*a - *b).abs().max_element() > STEP {
                let [x0, y0, x1, y1] = found.unwrap_or([x, y, x + 1, y + 1]);
                found = Some([x0.min(x), y0, x1.max(x + 1), y1.max(y + 1)]);
            }
        }
    }
    found
}
