//! Objects that stay where they are, under a light that changes, many pictures a second.
//!
//! How wide light reaches the picture is recorded once ([`Transport`]); a picture under another map is
//! a sparse product. A sun is narrower than the texels of a record: it is traced by itself, a few rays
//! a pixel, and added. Both are small, and enlarged onto the photograph.
use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;

use dipir_imaging::composite::composite;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::resize::{Filter, resize};
use dipir_imaging::tone::ToneCurves;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_light::gaussian::{SgMixture, SphericalGaussian};
use dipir_light::plane::PlaneLight;
use dipir_light::rasterize::rasterize;
use dipir_render::error::RenderError;
use dipir_render::light::SceneLight;
use dipir_render::render::Renderer;
use dipir_render::transport::{RecordSettings, Transport};
use dipir_scene::scene::LoadedScene;
use dipir_stages::light::at_hand::AtHand;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::draft::{settings, simulation};

/// Longest side of the replayed picture, pixels.
const LONGEST: f32 = 400.0;
/// Columns and rows of the recorded environment.
const MAP: [usize; 2] = [128, 64];
/// Paths a pixel of the record.
const SAMPLES: u32 = 64;
/// Paths a pixel of the sun.
const SUN_SAMPLES: u32 = 4;
/// Lobes narrower than this, radians, are traced: two texels of the record.
const NARROW: f32 = 2.0 * std::f32::consts::TAU / MAP[0] as f32;
/// A change of the photograph's light by less than this is not shown.
const LEAST: f32 = 2e-3;

/// A part of the photograph with objects in it.
#[derive(Clone, Debug)]
pub struct Piece {
    /// The pixels of the part.
    pub picture: DisplayImage,
    /// First and one past the last column and row.
    pub place: [usize; 4],
}

/// Recorded objects. One thread answers all questions; it ends when this is dropped.
pub struct Relit {
    lights: Sender<Lit>,
    answers: Receiver<Result<Small, RenderError>>,
    photo: Arc<LinearImage>,
    transfer: Transfer,
}

/// What a picture is lit by.
#[derive(Clone)]
struct Lit {
    map: Option<Arc<EnvironmentMap>>,
    lobes: SgMixture,
    /// Factor on both.
    exposure: f32,
}

/// Layers of the small picture.
struct Small {
    object: Raster<Vec3>,
    alpha: Raster<f32>,
    shadow: Raster<Vec3>,
}

impl Relit {
    /// Records the objects of `loaded`, best for `light`. `go_on` is asked again and again.
    ///
    /// # Errors
    /// On textures that cannot be read, and if it is broken off.
    pub fn record(
        loaded: &LoadedScene,
        normal: Vec3,
        light: &AtHand,
        go_on: impl Fn() -> ControlFlow<()> + Send + 'static,
    ) -> Result<Self, RenderError> {
        let (lights, asked) = channel();
        let (answer, answers) = channel();
        let mut small = loaded.clone();
        let [width, height] = small.scene.camera.resolution.map(|n| n as f32);
        let scale = (LONGEST / width.max(height)).min(1.0);
        let size = [width, height].map(|n| ((n * scale).round() as u32).max(1));
        let [w, h] = size.map(|n| n as usize);
        small.scene.camera = small.scene.camera.scaled(size);
        small.photo.image = LinearImage(resize(&small.photo.image.0, w, h, Filter::Area));
        // What is recorded leaves shadows on surfaces out.
        (small.depths, small.surfaces, small.shadow_mask) = (None, None, None);
        let mask = small.occluders.take();
        small.occluders = mask.map(|m| resize(&m, w, h, Filter::Area));
        let first = Lit::of(light, 1.0);
        thread::spawn(move || {
            let done = work(&small, normal, &first, &go_on, &asked, &answer);
            if let Err(e) = done {
                // Nobody listens any more: then nobody misses it.
                let _ = answer.send(Err(e));
            }
        });
        let relit = Self {
            lights,
            answers,
            photo: Arc::new(loaded.photo.image.clone()),
            transfer: loaded.photo.transfer,
        };
        relit.answer()?;
        Ok(relit)
    }

    fn answer(&self) -> Result<Small, RenderError> {
        self.answers.recv().unwrap_or(Err(RenderError::Interrupted))
    }

    /// The objects under `light`, `exposure` times as bright; `None` if they change nothing.
    ///
    /// # Errors
    /// As [`record`](Self::record).
    pub fn under(&self, light: &AtHand, exposure: f32) -> Result<Option<Piece>, RenderError> {
        if self.lights.send(Lit::of(light, exposure)).is_err() {
            return Err(RenderError::Interrupted);
        }
        let mut small = self.answer()?;
        if let Some(tone) = &light.tone {
            small = small.toned(tone);
        }
        Ok(small.piece(&self.photo, self.transfer))
    }
}

impl Lit {
    fn of(light: &AtHand, exposure: f32) -> Self {
        Self {
            map: light.map.clone(),
            lobes: light.lobes.clone(),
            exposure,
        }
    }

    /// What is recorded, and the lobes that are too narrow for that.
    fn parts(&self) -> (EnvironmentMap, Option<SgMixture>) {
        let (narrow, wide): (Vec<SphericalGaussian>, Vec<_>) =
            self.lobes.lobes().iter().partition(|l| l.sigma < NARROW);
        let [width, height] = MAP;
        let wide = rasterize(&wide, width, height);
        let map = match &self.map {
            Some(map) => {
                let map = map.resampled(width, height);
                let sums = map.texels().iter().zip(wide.texels());
                let sums = sums.map(|(&a, &b)| a + b).collect();
                EnvironmentMap::new(width, height, sums).unwrap_or(map)
            }
            None => wide,
        };
        (
            map,
            (!narrow.is_empty())
                .then(|| SgMixture::new(narrow).ok())
                .flatten(),
        )
    }
}

/// Records, then answers what is asked until nobody asks any more. The first answer says that the
/// record is there.
fn work(
    loaded: &LoadedScene,
    normal: Vec3,
    first: &Lit,
    go_on: &dyn Fn() -> ControlFlow<()>,
    asked: &Receiver<Lit>,
    answers: &Sender<Result<Small, RenderError>>,
) -> Result<(), RenderError> {
    let settings = settings(loaded, SUN_SAMPLES);
    let renderer = Renderer::new(&loaded.scene);
    let simulation = simulation(&renderer, loaded, &settings);
    let (map, _) = first.parts();
    let record = RecordSettings {
        environment: MAP,
        samples: SAMPLES,
        shadow_samples: SAMPLES,
        light: Some(&map),
        background: Some(&loaded.photo.image),
        occluders: loaded.occluders.as_ref(),
        ..RecordSettings::new(simulation)
    };
    let transport = Transport::record(&renderer, &record, &mut |_| go_on())?;
    let mut world = renderer.world(simulation.features)?;
    let mut next = first.clone();
    loop {
        let (map, sun) = next.parts();
        let mut small = Small {
            object: transport.foreground(map.texels()),
            alpha: transport.coverage().clone(),
            shadow: transport.shadow(map.texels()),
        };
        let has_sun = sun.is_some();
        if let Some(sun) = sun {
            let mut go_on = |_: &_| ControlFlow::Continue(());
            let film = sun
                .render(&renderer, &mut world, &simulation, &settings, &mut go_on)?
                .film;
            let wide = irradiance(&EnvironmentSampler::new(map), normal);
            let narrow = irradiance(&sun, normal);
            small.add(&film.object, &film.shadow, wide, narrow);
        }
        // What the object emits, and how it shows the photograph, is part of both pictures, and stays.
        let own = transport.base().pixels().iter();
        let twice = if has_sun { 2.0 } else { 1.0 };
        for (lit, own) in small.object.pixels_mut().iter_mut().zip(own) {
            *lit = (*own + (*lit - *own * twice) * next.exposure).max(Vec3::ZERO);
        }
        if answers.send(Ok(small)).is_err() {
            return Ok(());
        }
        let Ok(lit) = asked.recv() else {
            return Ok(());
        };
        next = lit;
    }
}

fn irradiance<L: SceneLight>(light: &L, normal: Vec3) -> Vec3 {
    let parts = light.on_plane(normal);
    let sum: DVec3 = parts.iter().map(PlaneLight::irradiance).sum();
    sum.as_vec3()
}

impl Small {
    /// Adds a second light. Of the ground's light, `here` was in the first one, `there` is in the second.
    fn add(&mut self, object: &Raster<Vec3>, shadow: &Raster<Vec3>, here: Vec3, there: Vec3) {
        let sums = self.object.pixels_mut().iter_mut().zip(object.pixels());
        sums.for_each(|(a, b)| *a += *b);
        let sum = here + there;
        let share = Vec3::select(sum.cmpgt(Vec3::ZERO), there / sum, Vec3::ZERO);
        let sums = self.shadow.pixels_mut().iter_mut().zip(shadow.pixels());
        sums.for_each(|(a, b)| *a += share * (*b - *a));
    }

    fn toned(self, tone: &ToneCurves) -> Self {
        Self {
            object: tone.apply_object(&LinearImage(self.object), &self.alpha).0,
            shadow: tone.apply_shadow(&LinearImage(self.shadow)).0,
            alpha: self.alpha,
        }
    }

    /// The first and one past the last column and row that are changed.
    fn changed(&self) -> Option<[usize; 4]> {
        let width = self.alpha.width();
        let layers = self.alpha.pixels().iter().zip(self.shadow.pixels());
        let mut found: Option<[usize; 4]> = None;
        for (k, (alpha, shadow)) in layers.enumerate() {
            if *alpha > LEAST || (*shadow - Vec3::ONE).abs().max_element() > LEAST {
                let (x, y) = (k % width, k / width);
                let [x0, y0, x1, y1] = found.unwrap_or([x, y, x + 1, y + 1]);
                found = Some([x0.min(x), y0.min(y), x1.max(x + 1), y1.max(y + 1)]);
            }
        }
        found
    }

    /// What the layers change of `photo`, which is larger.
    fn piece(&self, photo: &LinearImage, transfer: Transfer) -> Option<Piece> {
        let [x0, y0, x1, y1] = self.changed()?;
        let (w, h) = (photo.0.width(), photo.0.height());
        let scale = [
            w as f32 / self.alpha.width() as f32,
            h as f32 / self.alpha.height() as f32,
        ];
        // A pixel more on each side: between pixels the layers fade.
        let low = |n: usize, s: f32| ((n as f32 - 1.0) * s).floor().max(0.0) as usize;
        let high =
            |n: usize, s: f32, most: usize| (((n as f32 + 1.0) * s).ceil() as usize).min(most);
        let place = [
            low(x0, scale[0]),
            low(y0, scale[1]),
            high(x1, scale[0], w),
            high(y1, scale[1], h),
        ];
        let cut = LinearImage(crop(place, |x, y| *photo.0.get(x, y)));
        let at = |x: usize, y: usize| [(x as f32 + 0.5) / scale[0], (y as f32 + 0.5) / scale[1]];
        let object = crop(place, |x, y| between(&self.object, at(x, y)));
        let alpha = crop(place, |x, y| between(&self.alpha, at(x, y)));
        let shadow = crop(place, |x, y| between(&self.shadow, at(x, y)));
        let picture = composite(&cut, &LinearImage(object), &alpha, &LinearImage(shadow));
        let picture = transfer.encode(&picture.unwrap_or(cut));
        Some(Piece { picture, place })
    }
}

fn crop<T: Send>(
    [x0, y0, x1, y1]: [usize; 4],
    value: impl Fn(usize, usize) -> T + Sync,
) -> Raster<T> {
    let width = x1 - x0;
    let pixels = (0..width * (y1 - y0)).into_par_iter().with_min_len(4096);
    let pixels = pixels.map(|k| value(x0 + k % width, y0 + k / width));
    Raster::from_pixels(width, y1 - y0, pixels.collect())
}

/// The value at a place of `image`, whose pixels have their middles at .5, linear between them.
fn between<T>(image: &Raster<T>, at: [f32; 2]) -> T
where
    T: Copy + std::ops::Add<Output = T> + std::ops::Mul<f32, Output = T>,
{
    let axis = |x: f32, n: usize| {
        let x = (x - 0.5).clamp(0.0, n as f32 - 1.0);
        let low = x as usize;
        (low, (low + 1).min(n - 1), x - low as f32)
    };
    let (x0, x1, u) = axis(at[0], image.width());
    let (y0, y1, v) = axis(at[1], image.height());
    let row = |y: usize| *image.get(x0, y) * (1.0 - u) + *image.get(x1, y) * u;
    row(y0) * (1.0 - v) + row(y1) * v
}
