//! Training examples of the diffusion model: a recorded scene under a random light, seen through a random window.
//!
//! A plain example puts noise on the picture that is the target. A relit example puts noise on the picture under another
//! light than its caption describes; the target is the picture under the light of the caption.

use std::f32::consts::TAU;

use dipir_diffusion::noise::NoiseStream;
use dipir_prior::caption::{Caption, LightDescription};
use dipir_prior::picture::{PIXELS, Picture, SIZE, dilate};

use crate::camera::CameraResponse;
use crate::dataset::RecordedScene;
use crate::direct_light::Layer;
use crate::lighting::{Sun, SunSkyLight};
use crate::random::between;
use crate::window::{CroppedScene, Window};

/// The light around the object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Surroundings {
    /// The light of the caption; object and surroundings are one rendering.
    Rendered,
    /// The light of the caption; the object is composited.
    Described,
    /// The light of the picture under noise, which the caption does not describe; the object is composited.
    Noised,
    /// A light of its own; the object is composited.
    Independent,
}

impl Surroundings {
    fn draw(recipe: &Recipe, relit: bool, stream: &mut NoiseStream) -> Self {
        let kind = stream.uniform();
        match relit {
            true if kind < 0.18 => Self::Independent,
            // The object matches its surroundings, and neither matches the caption.
            true if kind < 0.45 => Self::Noised,
            // As in inversion: the whole picture has another light than the caption.
            true if kind > 0.65 => Self::Rendered,
            false if kind < recipe.foreign_light => Self::Independent,
            false if kind > 0.8 => Self::Rendered,
            _ => Self::Described,
        }
    }

    /// Whether the caption's light is not that of the surroundings.
    fn are_foreign(self) -> bool {
        matches!(self, Self::Noised | Self::Independent)
    }
}

/// Inputs and targets of the model for one picture.
#[derive(Debug, Clone)]
pub struct Example {
    /// The target, display values in [0, 1].
    pub image: Picture,
    /// The picture that noise is put on, if it is not the target: the same under another light.
    pub noised: Option<Picture>,
    /// The picture that is visible outside of the mask, in [0, 1].
    pub visible: Picture,
    /// 1 where the model may paint, [SIZE, SIZE].
    pub mask: Vec<f32>,
    /// Weight of each pixel in the loss, [SIZE, SIZE].
    pub weight: Vec<f32>,
    /// The caption; `None` is the empty one.
    pub caption: Option<Caption>,
    /// The light of the picture that noise is put on.
    pub light: LightDescription,
    /// Other captions for the same noisy picture.
    pub alternatives: Vec<AlternativeLight>,
}

/// A caption that describes another light than that of the noisy picture.
#[derive(Debug, Clone)]
pub struct AlternativeLight {
    /// The caption.
    pub caption: Caption,
    /// The picture under its light, in [0, 1], which is the target then. Without it, only the contrastive loss uses the
    /// caption.
    pub image: Option<Picture>,
}

/// Which examples are drawn: shares of all, from 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recipe {
    /// Captions that describe the light.
    pub light_captions: f64,
    /// Examples in which the surroundings of the object are visible.
    pub background: f64,
    /// Composites whose caption describes another light than that of the surroundings.
    pub foreign_light: f64,
    /// Number of alternative captions for each example. All but the first have pictures.
    pub alternatives: usize,
    /// Relit examples.
    pub relit: f64,
}

impl Default for Recipe {
    fn default() -> Self {
        Self {
            light_captions: 0.85,
            background: 0.85,
            foreign_light: 0.5,
            alternatives: 0,
            relit: 0.0,
        }
    }
}

impl Recipe {
    /// The recipe of the contrastive loss, with `alternatives` for each example. Every caption describes the light. The
    /// surroundings are always under the light to be recognised, and hidden in three examples of ten, as in inversion.
    pub fn contrastive(&self, alternatives: usize) -> Self {
        Self {
            light_captions: 1.0,
            background: self.background.min(0.7),
            foreign_light: 0.0,
            alternatives,
            relit: 0.0,
        }
    }
}

/// A mask of the smallest box around `mask`. Each side moves out by its `margin`, in longer sides of the box.
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

/// The lights and pictures of one example.
struct Scenario<'a> {
    scene: CroppedScene<'a>,
    surroundings: Surroundings,
    /// The light of the surroundings.
    around: SunSkyLight,
    response: CameraResponse,
}

impl Scenario<'_> {
    /// The picture with the object under `light`, display values.
    fn picture(&self, light: &SunSkyLight) -> Picture {
        let mut image = match self.surroundings {
            Surroundings::Rendered => self.scene.layer(Layer::Whole, light),
            _ => self.scene.composite(&self.around, light),
        };
        self.response.apply(&mut image);
        image
    }

    /// Mask and visible picture of an example whose target is `image`. `shared` if several targets share them.
    fn condition(
        &self,
        image: &Picture,
        recipe: &Recipe,
        shared: bool,
        stream: &mut NoiseStream,
    ) -> (Vec<f32>, Picture) {
        let coverage = self.scene.coverage();
        let kind = stream.uniform();
        if kind >= recipe.background || (shared && self.surroundings == Surroundings::Rendered) {
            return (vec![1.0; PIXELS], image.clone());
        }
        if kind < 0.25 * recipe.background
            && !self.surroundings.are_foreign()
            && recipe.alternatives == 0
        {
            // As in inpainting: the picture itself around a box.
            let margin = std::array::from_fn(|_| 0.7 * stream.uniform() as f32);
            return (boxed(&coverage, margin), image.clone());
        }
        let mut clean = self.scene.layer(Layer::Background, &self.around);
        self.response.apply(&mut clean);
        (dilate(&object_mask(&coverage), stream.below(2)), clean)
    }

    fn describe(&self, light: &SunSkyLight) -> LightDescription {
        let description = light.describe(self.scene.suns());
        self.scene.seen_through_window(description)
    }
}

/// 1 where the object covers at least a fiftieth of a pixel.
pub(crate) fn object_mask(coverage: &[f32]) -> Vec<f32> {
    coverage.iter().map(|&c| f32::from(c > 0.02)).collect()
}

/// The object's name in a caption: "object", or its class, with or without the colour.
fn object_name(class: &str, color: &str, stream: &mut NoiseStream) -> String {
    match stream.uniform() {
        x if x < 0.25 => "object".to_owned(),
        x if x < 0.6 => format!("{color} {class}"),
        _ => class.to_owned(),
    }
}

impl Example {
    /// Draws an example of `scene`.
    pub fn draw(scene: RecordedScene<'_>, recipe: &Recipe, stream: &mut NoiseStream) -> Self {
        let window = Window::draw(stream);
        let (class, color) = (scene.class, scene.color);
        let scene = CroppedScene::new(scene, window);
        let drawn = SunSkyLight::draw(scene.suns(), stream);
        let relit = recipe.relit > 0.0 && stream.uniform() < recipe.relit;
        let surroundings = Surroundings::draw(recipe, relit, stream);
        let light = match surroundings.are_foreign() {
            true => SunSkyLight::draw(scene.suns(), stream),
            false => drawn,
        };
        let noised = relit.then(|| other_light(&light, scene.suns(), stream));
        let around = match surroundings {
            Surroundings::Noised => noised.unwrap_or(drawn),
            _ => drawn,
        };
        let scenario = Scenario {
            scene,
            surroundings,
            around,
            response: CameraResponse::draw(stream),
        };
        let image = scenario.picture(&light);
        let shared = relit || recipe.alternatives > 0;
        let (mask, visible) = scenario.condition(&image, recipe, shared, stream);
        let near = dilate(&object_mask(&scenario.scene.coverage()), 5);
        let describes_light =
            relit || surroundings.are_foreign() || stream.uniform() < recipe.light_captions;
        let name = object_name(class, color, stream);
        let description = scenario.describe(&light);
        let alternatives = match describes_light {
            true => recipe.alternatives,
            false => 0,
        };
        let alternatives = (0..alternatives)
            .map(|i| {
                // The first has its sun anywhere, for which there is no recorded picture.
                let other = (i > 0).then(|| other_light(&light, scenario.scene.suns(), stream));
                let description = match &other {
                    Some(other) => scenario.describe(other),
                    None => alternative_description(&description, stream),
                };
                AlternativeLight {
                    caption: Caption::new(&name, Some(&description)),
                    image: other.map(|other| scenario.picture(&other)),
                }
            })
            .collect();
        let caption = if describes_light {
            Some(Caption::new(&name, Some(&description)))
        } else if stream.uniform() < 0.5 {
            Some(Caption::new(&name, None))
        } else {
            None
        };
        Self {
            noised: noised.as_ref().map(|light| scenario.picture(light)),
            light: scenario.describe(noised.as_ref().unwrap_or(&light)),
            image,
            visible,
            mask,
            weight: near.iter().map(|m| 0.15 + m).collect(),
            caption,
            alternatives,
        }
    }
}

/// A light that could be confused with `light`: another sun of the scene, in half of the cases the next one, and in one
/// of eight another sky.
fn other_light(light: &SunSkyLight, suns: &[Sun], stream: &mut NoiseStream) -> SunSkyLight {
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
    let other = SunSkyLight::draw(suns, stream);
    other.scaled(light.irradiance(suns) / other.irradiance(suns))
}

/// A description that could be confused with `light`: another azimuth near it or anywhere, the mirrored one, another
/// elevation, or another sky.
fn alternative_description(light: &LightDescription, stream: &mut NoiseStream) -> LightDescription {
    let mut range = |low, high| between(stream, low, high);
    let kind = range(0.0, 1.0);
    let side = if range(0.0, 1.0) < 0.5 { -1.0 } else { 1.0 };
    let amount = range(0.0, 1.0);
    if light.is_overcast() {
        return LightDescription {
            azimuth: amount * TAU,
            elevation: range(0.25, 1.2),
            sun_share: range(0.45, 0.93),
        };
    }
    match kind {
        x if x < 0.45 => LightDescription {
            azimuth: light.azimuth + side * (20.0 + 40.0 * amount).to_radians(),
            ..*light
        },
        x if x < 0.6 => LightDescription {
            azimuth: amount * TAU,
            ..*light
        },
        x if x < 0.7 => LightDescription {
            azimuth: -light.azimuth,
            ..*light
        },
        x if x < 0.93 => {
            let step = side * (10.0 + 25.0 * amount).to_radians();
            let turned = |e: f32| (0.2..1.3).contains(&e);
            let elevation = match turned(light.elevation + step) {
                true => light.elevation + step,
                false => light.elevation - step,
            };
            LightDescription {
                elevation,
                ..*light
            }
        }
        x if x < 0.96 => LightDescription {
            sun_share: 0.0,
            ..*light
        },
        _ => {
            let step = 0.25 + 0.15 * amount;
            let sun_share = match light.sun_share > 0.69 {
                true => light.sun_share - step,
                false => light.sun_share + step,
            };
            LightDescription {
                sun_share,
                ..*light
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::RECORD_SIZE;
    use crate::direct_light::{DirectLightImages, FIRST_SHADOW_PLANE, SHADOW_PLANES};
    use crate::scene::{Framing, GeneratedScene, ObjectSet, SceneKind, Setting};
    use dipir_prior::caption::WordMixture;
    use half::f16;

    fn one_scene() -> GeneratedScene {
        let kind = SceneKind {
            objects: ObjectSet::Training,
            setting: Setting::Open,
            framing: Framing::Close,
        };
        GeneratedScene::draw(3, 1, RECORD_SIZE as u32, kind)
    }

    fn view_of<'a>(scene: &GeneratedScene, planes: &'a [f16]) -> RecordedScene<'a> {
        RecordedScene {
            planes,
            class: "box",
            color: "white",
            camera: scene.square_camera(),
            suns: scene.suns.clone(),
        }
    }

    fn planes_of(scene: &GeneratedScene) -> Vec<f16> {
        let images = DirectLightImages::trace(scene, 3, 1);
        images.planes.iter().map(|&v| f16::from_f32(v)).collect()
    }

    fn mixtures(example: &Example) -> Vec<WordMixture> {
        example.caption.clone().expect("a caption").mixtures
    }

    fn mixtures_of(light: &LightDescription) -> Vec<WordMixture> {
        Caption::new("object", Some(light)).mixtures
    }

    #[test]
    fn alternatives_have_their_own_pictures_and_the_visible_picture_hides_the_objects_light() {
        let scene = one_scene();
        let planes = planes_of(&scene);
        let scene = view_of(&scene, &planes);
        let recipe = Recipe::default().contrastive(3);
        let (mut covered, mut open) = (0, 0);
        for index in 0..40 {
            let mut stream = NoiseStream::new(4, index);
            let example = Example::draw(scene.clone(), &recipe, &mut stream);
            assert!(example.caption.is_some() && example.noised.is_none());
            assert_eq!(mixtures(&example), mixtures_of(&example.light));
            let [unseen, seen @ ..] = &example.alternatives[..] else {
                panic!("no alternatives")
            };
            assert!(unseen.image.is_none() && seen.len() == 2);
            for alternative in seen {
                let image = alternative.image.as_ref().expect("a picture");
                assert_ne!(image, &example.image, "{index}");
                assert_ne!(Some(&alternative.caption), example.caption.as_ref());
            }
            // Nothing is visible, or the surroundings without the object, and the mask covers the object alone.
            if example.mask.iter().all(|m| *m == 1.0) {
                covered += 1;
            } else {
                open += 1;
                let window = Window::draw(&mut NoiseStream::new(4, index));
                let coverage = CroppedScene::new(scene.clone(), window).coverage();
                let mut near = example.mask.iter().zip(dilate(&object_mask(&coverage), 1));
                assert!(near.all(|(m, near)| *m <= near), "{index}");
            }
        }
        assert!(covered > 5 && open > 10, "{covered} {open}");
    }

    #[test]
    fn a_relit_example_differs_where_the_object_and_its_shadow_are() {
        let scene = one_scene();
        let planes = planes_of(&scene);
        let scene = view_of(&scene, &planes);
        let recipe = Recipe {
            relit: 1.0,
            ..Recipe::default()
        };
        let (mut elsewhere, mut whole) = (0, 0);
        for index in 0..60 {
            let window = Window::draw(&mut NoiseStream::new(4, index));
            let mut stream = NoiseStream::new(4, index);
            let example = Example::draw(scene.clone(), &recipe, &mut stream);
            // The caption does not describe the noised picture.
            assert_ne!(mixtures(&example), mixtures_of(&example.light));
            let noised = example.noised.expect("another light");
            let differs = |i: usize| {
                (0..3)
                    .any(|c| (example.image[c * PIXELS + i] - noised[c * PIXELS + i]).abs() > 0.02)
            };
            assert!((0..PIXELS).any(differs), "{index}");
            // Pixels that no sun of the scene leaves in shadow, nor much of the sky.
            let cropped = CroppedScene::new(scene.clone(), window);
            let coverage = cropped.coverage();
            let mut free: Vec<bool> = coverage.iter().map(|c| *c == 0.0).collect();
            for plane in 0..SHADOW_PLANES {
                let mut shade = vec![0.0; PIXELS];
                cropped.add(FIRST_SHADOW_PLANE + plane, 1.0, &mut shade);
                free.iter_mut().zip(shade).for_each(|(f, s)| *f &= s > 0.97);
            }
            let changed = (0..PIXELS).filter(|&i| free[i] && differs(i)).count();
            // A rendered picture changes everywhere, and then nothing is visible around the object.
            if changed > 0 {
                whole += 1;
                assert!(example.mask.iter().all(|m| *m == 1.0), "{index}");
            } else {
                elsewhere += 1;
            }
        }
        assert!(whole > 4 && elsewhere > 30, "{whole} {elsewhere}");
    }

    #[test]
    fn alternative_descriptions_differ_and_are_possible() {
        let light = LightDescription {
            azimuth: 1.0,
            elevation: 0.5,
            sun_share: 0.8,
        };
        let overcast = LightDescription {
            sun_share: 0.0,
            ..light
        };
        let mut stream = NoiseStream::new(1, 2);
        let mut heights = 0;
        for _ in 0..500 {
            let alternative = alternative_description(&light, &mut stream);
            let [a, b] = [light, alternative].map(|l| Caption::new("ball", Some(&l)));
            assert_ne!(a, b);
            assert!(
                (0.2..1.3).contains(&alternative.elevation),
                "{alternative:?}"
            );
            assert!(
                (0.0..=0.95).contains(&alternative.sun_share),
                "{alternative:?}"
            );
            heights += usize::from(alternative.elevation != light.elevation);
            assert!(!alternative_description(&overcast, &mut stream).is_overcast());
        }
        assert!((50..200).contains(&heights), "{heights}");
    }
}
