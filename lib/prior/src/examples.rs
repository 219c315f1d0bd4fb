//! Training examples: a recorded scene under a drawn light, cropped, with
//! what the model is shown of it.

use std::f32::consts::PI;

use dipir_diffusion::noise::NoiseStream;
use glam::Vec3;
use half::f16;

use crate::dataset::{RECORD_SIZE, SceneView};
use crate::lights::{Light, Sun};
use crate::record::{BASIS, Layer, PLANES, SHADOW, first_plane, shadow_weights, weights};
use crate::studio::SUNS;
use crate::words::{Caption, Gaze, LightWords};

/// Pixels on a side of an example.
pub const SIZE: usize = 32;
const PIXELS: usize = SIZE * SIZE;

/// What lights the picture around the object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Surroundings {
    /// The light that is said, object and place in one rendering.
    Whole,
    /// The light that is said, the object put in afterwards.
    Said,
    /// The light that the object is seen under, which is not the one that is said.
    Seen,
    /// A light of its own.
    Other,
}

impl Surroundings {
    fn draw(recipe: &Recipe, relit: bool, stream: &mut NoiseStream) -> Self {
        let kind = stream.uniform();
        match relit {
            true if kind < 0.18 => Self::Other,
            // It looks as if it belonged there, and yet is not what is said.
            true if kind < 0.45 => Self::Seen,
            // As where light is read: all of the picture is seen under the other light.
            true if kind > 0.65 => Self::Whole,
            false if kind < recipe.foreign_light => Self::Other,
            false if kind > 0.8 => Self::Whole,
            _ => Self::Said,
        }
    }

    fn is_foreign(self) -> bool {
        matches!(self, Self::Seen | Self::Other)
    }
}

/// A picture [3, SIZE, SIZE], linear or in [0, 1].
pub type Picture = Vec<f32>;

/// A crop of a record, perhaps mirrored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    /// First column in the record.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Left and right swapped.
    pub mirrored: bool,
}

impl Window {
    /// The middle of the record.
    pub const MIDDLE: Self = Self {
        x: (RECORD_SIZE - SIZE) / 2,
        y: (RECORD_SIZE - SIZE) / 2,
        mirrored: false,
    };

    /// The middle for every even draw of noise, its mirror image for every odd one: what the model gets
    /// wrong of one it partly gets wrong differently of the other (docs/prior.md).
    pub fn of_draw(draw: usize) -> Self {
        Self {
            mirrored: draw % 2 == 1,
            ..Self::MIDDLE
        }
    }

    /// Anywhere.
    pub fn draw(stream: &mut NoiseStream) -> Self {
        Self {
            x: stream.below(RECORD_SIZE - SIZE + 1),
            y: stream.below(RECORD_SIZE - SIZE + 1),
            mirrored: stream.below(2) == 1,
        }
    }
}

/// A scene seen through a window.
#[derive(Debug, Clone)]
pub struct Lens<'a> {
    scene: SceneView<'a>,
    window: Window,
}

impl<'a> Lens<'a> {
    /// `scene` through `window`.
    pub fn new(scene: SceneView<'a>, window: Window) -> Self {
        Self { scene, window }
    }

    /// Where the middle of the window lies for the camera.
    pub fn gaze(&self) -> Gaze {
        let middle = |start: usize| {
            let half = 0.5 * RECORD_SIZE as f32;
            (start as f32 + 0.5 * SIZE as f32) / half - 1.0
        };
        let outlook = self.scene.outlook;
        outlook.at(middle(self.window.x), middle(self.window.y))
    }

    /// A light, relative to the camera, as it is from where the window lies, and in the mirror if it is one.
    pub fn words(&self, words: LightWords) -> LightWords {
        let words = words.seen_from(self.gaze().heading);
        match self.window.mirrored {
            true => words.mirrored(),
            false => words,
        }
    }

    /// The scene's suns.
    pub fn suns(&self) -> &[Sun] {
        &self.scene.suns
    }

    fn row(&self, plane: usize, row: usize) -> &[f16] {
        let start = (plane * RECORD_SIZE + self.window.y + row) * RECORD_SIZE + self.window.x;
        &self.scene.planes[start..start + SIZE]
    }

    /// Adds `weight` times a plane to `out`.
    fn add(&self, plane: usize, weight: f32, out: &mut [f32]) {
        if weight == 0.0 {
            return;
        }
        for (row, out) in out.chunks_exact_mut(SIZE).enumerate() {
            let values = self.row(plane, row);
            if self.window.mirrored {
                let values = values.iter().rev();
                out.iter_mut()
                    .zip(values)
                    .for_each(|(o, v)| *o += weight * v.to_f32());
            } else {
                out.iter_mut()
                    .zip(values)
                    .for_each(|(o, v)| *o += weight * v.to_f32());
            }
        }
    }

    /// Linear picture of a layer under `light`.
    pub fn layer(&self, layer: Layer, light: &Light) -> Picture {
        let mut out = vec![0.0; 3 * PIXELS];
        for (b, weight) in weights(light).iter().enumerate().take(BASIS) {
            for c in 0..3 {
                let plane = first_plane(layer) + b * 3 + c;
                self.add(plane, weight[c], &mut out[c * PIXELS..][..PIXELS]);
            }
        }
        out
    }

    /// What of the ground's light the object leaves, [3, SIZE, SIZE].
    pub fn shadow(&self, light: &Light) -> Picture {
        let mut out = vec![0.0; 3 * PIXELS];
        let weights: [Vec3; SHADOW] = shadow_weights(light, &self.scene.suns);
        for (b, weight) in weights.iter().enumerate() {
            for c in 0..3 {
                self.add(9 * BASIS + b, weight[c], &mut out[c * PIXELS..][..PIXELS]);
            }
        }
        out
    }

    /// Coverage of the main object, [SIZE, SIZE].
    pub fn coverage(&self) -> Vec<f32> {
        let mut out = vec![0.0; PIXELS];
        self.add(PLANES - 1, 1.0, &mut out);
        out
    }

    /// The main object under `light` in the place under `place`, linear.
    pub fn composite(&self, place: &Light, light: &Light) -> Picture {
        let mut out = self.layer(Layer::Background, place);
        let object = self.layer(Layer::Object, light);
        let (shadow, coverage) = (self.shadow(light), self.coverage());
        for (i, value) in out.iter_mut().enumerate() {
            *value = *value * shadow[i] * (1.0 - coverage[i % PIXELS]) + object[i];
        }
        out
    }
}

/// From linear light to a picture in [0, 1].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tone {
    /// Factor on linear light.
    pub exposure: f32,
    /// 0: clipped at white; 1: rolled off as 1 - exp(-x).
    pub shoulder: f32,
}

impl Tone {
    /// A camera's choice.
    pub fn draw(stream: &mut NoiseStream) -> Self {
        Self {
            exposure: (0.35 * (2.0 * stream.uniform() - 1.0)).exp() as f32,
            shoulder: stream.uniform() as f32,
        }
    }

    /// Encodes a linear picture for display (sRGB).
    pub fn apply(&self, linear: &mut [f32]) {
        for v in linear {
            let x = (*v * self.exposure).max(0.0);
            let soft = 1.0 - (-x).exp();
            let x = x.min(1.0) + (soft - x.min(1.0)) * self.shoulder;
            *v = if x <= 0.003_130_8 {
                12.92 * x
            } else {
                1.055 * x.powf(1.0 / 2.4) - 0.055
            };
        }
    }
}

/// What the model sees of one example, and what it should make of it.
#[derive(Debug, Clone)]
pub struct Example {
    /// The picture in [0, 1].
    pub image: Picture,
    /// What noise is put on where it is not the picture: the same under another light than is said.
    pub seen: Option<Picture>,
    /// What is shown around the mask, in [0, 1].
    pub shown: Picture,
    /// 1 where the model may paint, [SIZE, SIZE].
    pub mask: Vec<f32>,
    /// Weight of each pixel in the loss, [SIZE, SIZE].
    pub weight: Vec<f32>,
    /// What is said.
    pub caption: Option<Caption>,
    /// The light that the object is seen under.
    pub light: LightWords,
    /// Other lights, to be told from the one that is said.
    pub rivals: Vec<Rival>,
}

/// Another light than the one under which a picture is seen.
#[derive(Debug, Clone)]
pub struct Rival {
    /// What says it.
    pub caption: Caption,
    /// The picture under it, in [0, 1], to be asked for; without, it is only to be told from the one that is seen.
    pub image: Option<Picture>,
}

/// Shares of what examples show; each is one ingredient of the recipe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recipe {
    /// Captions that name the light.
    pub light_words: f64,
    /// Examples that show the place around the object.
    pub background: f64,
    /// Composites under a light other than the place's, with their own
    /// light in the caption.
    pub foreign_light: f64,
    /// Other lights beside each one that is said; pictures under all but the first are asked for, too.
    pub rivals: usize,
    /// Examples that are seen under another light than is said, and asked for under the one that is.
    pub relit: f64,
}

impl Default for Recipe {
    fn default() -> Self {
        Self {
            light_words: 0.85,
            background: 0.85,
            foreign_light: 0.5,
            rivals: 0,
            relit: 0.0,
        }
    }
}

impl Recipe {
    /// The same with `rivals` beside each caption; every caption names its light, three in ten show
    /// nothing around the object, as where light is read, and what is shown is always under the light that is
    /// to be told, so that it may be told from there, too.
    pub fn contrasted(&self, rivals: usize) -> Self {
        Self {
            light_words: 1.0,
            background: self.background.min(0.7),
            foreign_light: 0.0,
            rivals,
            relit: 0.0,
        }
    }
}

/// Planes of rows of [`SIZE`] values with left and right swapped.
pub fn mirrored(planes: &[f32]) -> Vec<f32> {
    let rows = planes.chunks_exact(SIZE);
    rows.flat_map(|row| row.iter().rev().copied()).collect()
}

/// The largest value within `radius` pixels (a square).
pub fn dilate(mask: &[f32], radius: usize) -> Vec<f32> {
    let pass = |input: &[f32], stride: usize, other: usize| -> Vec<f32> {
        let mut out = vec![0f32; PIXELS];
        for line in 0..SIZE {
            for i in 0..SIZE {
                let low = i.saturating_sub(radius);
                let high = (i + radius).min(SIZE - 1);
                out[line * other + i * stride] = (low..=high)
                    .map(|j| input[line * other + j * stride])
                    .fold(0.0, f32::max);
            }
        }
        out
    };
    pass(&pass(mask, 1, SIZE), SIZE, 1)
}

/// 1 inside the smallest box around `mask`, grown by `margin` of its sides.
fn boxed(mask: &[f32], margin: [f32; 4]) -> Vec<f32> {
    let on = |i: usize| mask[i] > 0.02;
    let (mut x, mut y) = ([SIZE, 0], [SIZE, 0]);
    for i in (0..PIXELS).filter(|&i| on(i)) {
        x = [x[0].min(i % SIZE), x[1].max(i % SIZE + 1)];
        y = [y[0].min(i / SIZE), y[1].max(i / SIZE + 1)];
    }
    if x[0] >= x[1] {
        return vec![0.0; PIXELS];
    }
    let side = (x[1] - x[0]).max(y[1] - y[0]) as f32;
    let low = |v: usize, m: f32| (v as f32 - m * side).max(0.0) as usize;
    let high = |v: usize, m: f32| ((v as f32 + m * side).ceil() as usize).min(SIZE);
    let (x, y) = (
        [low(x[0], margin[0]), high(x[1], margin[1])],
        [low(y[0], margin[2]), high(y[1], margin[3])],
    );
    (0..PIXELS)
        .map(|i| {
            let inside = (x[0]..x[1]).contains(&(i % SIZE)) && (y[0]..y[1]).contains(&(i / SIZE));
            f32::from(inside)
        })
        .collect()
}

impl Example {
    /// Draws an example of `scene`.
    pub fn draw(scene: SceneView<'_>, recipe: &Recipe, stream: &mut NoiseStream) -> Self {
        let window = Window::draw(stream);
        let (class, color) = (scene.class, scene.color);
        let lens = Lens::new(scene, window);
        let drawn = Light::draw(lens.suns(), stream);
        let relit = recipe.relit > 0.0 && stream.uniform() < recipe.relit;
        let surroundings = Surroundings::draw(recipe, relit, stream);
        let light = match surroundings.is_foreign() {
            true => Light::draw(lens.suns(), stream),
            false => drawn,
        };
        let other = relit.then(|| other_light(&light, lens.suns(), stream));
        let around = match surroundings {
            Surroundings::Seen => other.unwrap_or(drawn),
            Surroundings::Whole | Surroundings::Said | Surroundings::Other => drawn,
        };
        let tone = Tone::draw(stream);
        let picture = |light: &Light| {
            let mut image = match surroundings {
                Surroundings::Whole => lens.layer(Layer::Whole, light),
                _ => lens.composite(&around, light),
            };
            tone.apply(&mut image);
            image
        };
        let image = picture(&light);
        let seen = other.as_ref().map(&picture);
        let coverage = lens.coverage();
        let hard: Vec<f32> = coverage.iter().map(|&c| f32::from(c > 0.02)).collect();
        let view = stream.uniform();
        // What is seen is asked for under other lights, too.
        let several = relit || recipe.rivals > 0;
        let (mask, shown) =
            if view >= recipe.background || (several && surroundings == Surroundings::Whole) {
                (vec![1.0; PIXELS], image.clone())
            } else if view < 0.25 * recipe.background
                && !surroundings.is_foreign()
                && recipe.rivals == 0
            {
                // As in inpainting: the picture itself around a box.
                let margin = std::array::from_fn(|_| 0.7 * stream.uniform() as f32);
                (boxed(&coverage, margin), image.clone())
            } else {
                let mut clean = lens.layer(Layer::Background, &around);
                tone.apply(&mut clean);
                (dilate(&hard, stream.below(2)), clean)
            };
        let weight = dilate(&hard, 5).iter().map(|m| 0.15 + m).collect();
        let named = relit || surroundings.is_foreign() || stream.uniform() < recipe.light_words;
        let said = stream.uniform();
        let class = match said {
            x if x < 0.25 => "object".to_owned(),
            x if x < 0.6 => format!("{color} {class}"),
            _ => class.to_owned(),
        };
        let words = lens.words(light.words(lens.suns()));
        let seen_light = other.as_ref().unwrap_or(&light);
        let seen_light = lens.words(seen_light.words(lens.suns()));
        let rivals = match named {
            true => recipe.rivals,
            false => 0,
        };
        let rivals = (0..rivals)
            .map(|i| {
                // Suns anywhere for the first, which is not in the record, so that there is no picture.
                let other = (i > 0).then(|| other_light(&light, lens.suns(), stream));
                let words = match &other {
                    Some(other) => lens.words(other.words(lens.suns())),
                    None => words.rival(stream),
                };
                Rival {
                    caption: Caption::new(&class, Some(&words)),
                    image: other.map(|other| picture(&other)),
                }
            })
            .collect();
        let caption = if named {
            Some(Caption::new(&class, Some(&words)))
        } else if stream.uniform() < 0.5 {
            Some(Caption::new(&class, None))
        } else {
            None
        };
        Self {
            image,
            seen,
            shown,
            mask,
            weight,
            caption,
            light: seen_light,
            rivals,
        }
    }
}

/// A light that `light` might be taken for: its sun elsewhere, half of the time next to where it is, and one time in
/// eight the sky another one, too.
fn other_light(light: &Light, suns: &[Sun], stream: &mut NoiseStream) -> Light {
    let (near, step) = (stream.uniform() < 0.5, stream.below(suns.len() - 1));
    let step = match near {
        // Suns are numbered around the sky.
        true => [1, suns.len() - 1][step % 2],
        false => step + 1,
    };
    let sun = (light.sun + step) % suns.len();
    if stream.uniform() < 0.875 && light.share > 0.0 {
        return light.turned_to(sun, suns);
    }
    let other = Light::draw(suns, stream);
    other.scaled(light.irradiance(suns) / other.irradiance(suns))
}

/// The difference of two angles, radians in [0, pi].
pub fn angle_between(a: f32, b: f32) -> f32 {
    let d = (a - b).rem_euclid(2.0 * PI);
    d.min(2.0 * PI - d)
}

/// Number of suns that every scene has.
pub const LIGHTS: usize = SUNS;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::Record;
    use crate::studio::{Brief, Kinds, Outlook, Setting, Stage, View};
    use crate::words::Mixture;

    #[test]
    fn a_light_is_told_from_where_the_window_looks_and_then_mirrored() {
        let lens = |x: usize, mirrored: bool| {
            let scene = SceneView {
                planes: &[],
                class: "box",
                color: "white",
                outlook: Outlook {
                    pitch: 0.0,
                    reach: 0.5,
                },
                suns: vec![],
            };
            let window = Window {
                x,
                mirrored,
                ..Window::MIDDLE
            };
            Lens::new(scene, window)
        };
        let light = LightWords {
            azimuth: 0.7,
            elevation: 0.5,
            sun_share: 0.8,
        };
        let told = |x: usize, mirrored: bool| lens(x, mirrored).words(light).azimuth;
        // The last window's middle lies 4 pixels to the right of 20, of which 20 pixels are a half of what lies ahead.
        let heading = (0.5f32 * 4.0 / 20.0).atan();
        let last = RECORD_SIZE - SIZE;
        for (found, wanted) in [
            (told(Window::MIDDLE.x, false), 0.7),
            (told(last, false), 0.7 - heading),
            (told(last, true), heading - 0.7),
            (told(0, false), 0.7 + heading),
        ] {
            assert!((found - wanted).abs() < 1e-6, "{found} {wanted}");
        }
        let lower = Window {
            y: last,
            ..Window::MIDDLE
        };
        let scene = lens(0, false).scene;
        assert!((Lens::new(scene, lower).gaze().pitch - heading).abs() < 1e-6);
    }

    fn one_stage() -> Stage {
        let brief = Brief {
            kinds: Kinds::Trained,
            setting: Setting::Open,
            view: View::Close,
        };
        Stage::draw(3, 1, RECORD_SIZE as u32, brief)
    }

    fn view_of<'a>(stage: &Stage, planes: &'a [f16]) -> SceneView<'a> {
        SceneView {
            planes,
            class: "box",
            color: "white",
            outlook: stage.outlook(),
            suns: stage.suns.clone(),
        }
    }

    fn planes_of(stage: &Stage) -> Vec<f16> {
        let record = Record::trace(stage, 3, 1);
        record.planes.iter().map(|&v| f16::from_f32(v)).collect()
    }

    fn mixtures(example: &Example) -> Vec<Mixture> {
        example.caption.clone().expect("a caption").mixtures
    }

    fn mixtures_of(light: &LightWords) -> Vec<Mixture> {
        Caption::new("object", Some(light)).mixtures
    }

    #[test]
    fn rivals_have_pictures_of_their_own_and_no_light_is_given_away() {
        let stage = one_stage();
        let planes = planes_of(&stage);
        let scene = view_of(&stage, &planes);
        let recipe = Recipe::default().contrasted(3);
        let (mut covered, mut open) = (0, 0);
        for index in 0..40 {
            let mut stream = NoiseStream::new(4, index);
            let example = Example::draw(scene.clone(), &recipe, &mut stream);
            assert!(example.caption.is_some() && example.seen.is_none());
            assert_eq!(mixtures(&example), mixtures_of(&example.light));
            let [unseen, seen @ ..] = &example.rivals[..] else {
                panic!("no rivals")
            };
            assert!(unseen.image.is_none() && seen.len() == 2);
            for rival in seen {
                let image = rival.image.as_ref().expect("a picture");
                assert_ne!(image, &example.image, "{index}");
                assert_ne!(Some(&rival.caption), example.caption.as_ref());
            }
            // What is shown does not give the object's light away: nothing, or the place without the object, hidden only
            // where that stands.
            if example.mask.iter().all(|m| *m == 1.0) {
                covered += 1;
            } else {
                open += 1;
                let window = Window::draw(&mut NoiseStream::new(4, index));
                let coverage = Lens::new(scene.clone(), window).coverage();
                let hard: Vec<f32> = coverage.iter().map(|&c| f32::from(c > 0.02)).collect();
                let mut near = example.mask.iter().zip(dilate(&hard, 1));
                assert!(near.all(|(m, near)| *m <= near), "{index}");
            }
        }
        assert!(covered > 5 && open > 10, "{covered} {open}");
    }

    #[test]
    fn what_is_seen_under_another_light_differs_where_the_object_and_its_shadow_are() {
        let stage = one_stage();
        let planes = planes_of(&stage);
        let scene = view_of(&stage, &planes);
        let recipe = Recipe {
            relit: 1.0,
            ..Recipe::default()
        };
        let (mut elsewhere, mut whole) = (0, 0);
        for index in 0..60 {
            let window = Window::draw(&mut NoiseStream::new(4, index));
            let mut stream = NoiseStream::new(4, index);
            let example = Example::draw(scene.clone(), &recipe, &mut stream);
            // What is said is not what is seen.
            assert_ne!(mixtures(&example), mixtures_of(&example.light));
            let seen = example.seen.expect("another light");
            let differs = |i: usize| {
                (0..3).any(|c| (example.image[c * PIXELS + i] - seen[c * PIXELS + i]).abs() > 0.02)
            };
            assert!((0..PIXELS).any(differs), "{index}");
            // Where neither the suns of this scene are shaded nor much of the sky.
            let lens = Lens::new(scene.clone(), window);
            let coverage = lens.coverage();
            let mut free: Vec<bool> = coverage.iter().map(|c| *c == 0.0).collect();
            for plane in 0..SHADOW {
                let mut shade = vec![0.0; PIXELS];
                lens.add(9 * BASIS + plane, 1.0, &mut shade);
                free.iter_mut().zip(shade).for_each(|(f, s)| *f &= s > 0.97);
            }
            let changed = (0..PIXELS).filter(|&i| free[i] && differs(i)).count();
            // Of whole pictures everything is lit anew, and nothing is shown around the object.
            if changed > 0 {
                whole += 1;
                assert!(example.mask.iter().all(|m| *m == 1.0), "{index}");
            } else {
                elsewhere += 1;
            }
        }
        assert!(whole > 4 && elsewhere > 30, "{whole} {elsewhere}");
    }
}
