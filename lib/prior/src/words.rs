//! Light in words: how a caption names where the sun stands, how high, and
//! how clear the sky is; and the vocabulary for it.
//!
//! Values between two words are mixtures of their embeddings, so that the
//! language is continuous although its words are few.

use std::f32::consts::{PI, TAU};

use dipir_diffusion::noise::NoiseStream;
use serde::{Deserialize, Serialize};

/// Where the sun stands on a clock face that lies on the ground, seen from
/// above with the camera at six looking to twelve.
pub const CLOCK: [&str; 12] = [
    "twelve", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten",
    "eleven",
];
/// Words for the sun's height and the elevations that they name, degrees.
pub const HEIGHTS: [(&str, f32); 3] = [("low", 15.0), ("middle", 40.0), ("high", 65.0)];
/// Words for the share of the light on the ground that comes from the sun.
pub const SKIES: [(&str, f32); 3] = [("hazy", 0.4), ("fair", 0.7), ("clear", 0.95)];
/// The word for a sky without sun.
pub const OVERCAST: &str = "overcast";
/// Colours of objects.
pub const COLORS: [&str; 8] = [
    "white", "grey", "black", "red", "orange", "yellow", "green", "blue",
];

/// Other words that captions and prompts use.
const OTHERS: [&str; 60] = [
    ",",
    "a",
    "photo",
    "of",
    "object",
    "ball",
    "box",
    "cylinder",
    "cone",
    "ring",
    "car",
    "table",
    "sun",
    "at",
    "in",
    "on",
    "the",
    "scene",
    "style",
    "sks",
    "rendering",
    "with",
    "under",
    "an",
    "sky",
    "light",
    "bright",
    "sunlight",
    "sunset",
    "shade",
    "noon",
    "early",
    "morning",
    "soft",
    "from",
    "side",
    "strong",
    "shadows",
    "street",
    "beach",
    "forest",
    "front",
    "house",
    "studio",
    "grass",
    "wooden",
    "floor",
    "parking",
    "lot",
    "mountains",
    "indoors",
    "large",
    "small",
    "close",
    "up",
    "silver",
    "brown",
    "ground",
    "left",
    "right",
];

/// Every word that is one token, in the order of their tokens.
pub fn vocabulary() -> Vec<&'static str> {
    let mut words: Vec<&str> = OTHERS.to_vec();
    words.extend(COLORS);
    words.extend(CLOCK);
    words.extend(HEIGHTS.map(|(word, _)| word));
    words.extend(SKIES.map(|(word, _)| word));
    words.push(OVERCAST);
    words
}

/// What a caption says about light.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LightWords {
    /// Angle from the camera's forward direction to the sun on the ground,
    /// towards the right, radians.
    pub azimuth: f32,
    /// Angle of the sun above the ground, radians.
    pub elevation: f32,
    /// Share of the light on the ground that comes from the sun, 0 to 1.
    pub sun_share: f32,
}

/// Where the middle of a picture lies for the camera that took it, on level ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaze {
    /// Angle on the ground from the camera's forward direction, towards the right, radians.
    pub heading: f32,
    /// Angle below the horizon, radians.
    pub pitch: f32,
}

impl Gaze {
    /// Along `direction`, where `forward` and `right` are level and of unit length.
    pub fn along(direction: glam::Vec3, forward: glam::Vec3, right: glam::Vec3) -> Self {
        let (x, z) = (direction.dot(right), direction.dot(forward));
        Self {
            heading: x.atan2(z),
            pitch: (-direction.y).atan2(x.hypot(z)),
        }
    }
}

/// Words and weights that stand at one place of a caption; weights sum to 1.
pub type Mixture = Vec<(&'static str, f32)>;

impl LightWords {
    /// Whether the sky is named overcast and nothing is said of the sun.
    pub fn is_overcast(&self) -> bool {
        self.sun_share < 0.15
    }

    /// The mixtures for clock, height and sky.
    pub fn mixtures(&self) -> [Mixture; 3] {
        let hours = (self.azimuth.rem_euclid(TAU) / TAU) * 12.0;
        let (hour, part) = (hours.floor(), hours.fract());
        let clock = |h: f32| CLOCK[h as usize % 12];
        let degrees = self.elevation * 180.0 / PI;
        [
            vec![(clock(hour), 1.0 - part), (clock(hour + 1.0), part)],
            between(&HEIGHTS, degrees),
            between(&SKIES, self.sun_share),
        ]
    }

    /// The same light in a mirror that swaps left and right.
    pub fn mirrored(&self) -> Self {
        Self {
            azimuth: -self.azimuth,
            ..*self
        }
    }

    /// The same light from where the camera's forward direction is turned right by `angle`.
    pub fn seen_from(&self, angle: f32) -> Self {
        Self {
            azimuth: self.azimuth - angle,
            ..*self
        }
    }

    /// A light that this one might be taken for: another azimuth near by or anywhere, the mirror image,
    /// another elevation, another sky.
    pub fn rival(&self, stream: &mut NoiseStream) -> Self {
        let mut range = |low: f64, high: f64| (low + (high - low) * stream.uniform()) as f32;
        let kind = range(0.0, 1.0);
        let side = if range(0.0, 1.0) < 0.5 { -1.0 } else { 1.0 };
        let amount = range(0.0, 1.0);
        if self.is_overcast() {
            return Self {
                azimuth: amount * TAU,
                elevation: range(0.25, 1.2),
                sun_share: range(0.45, 0.93),
            };
        }
        match kind {
            x if x < 0.45 => Self {
                azimuth: self.azimuth + side * (20.0 + 40.0 * amount).to_radians(),
                ..*self
            },
            x if x < 0.6 => Self {
                azimuth: amount * TAU,
                ..*self
            },
            x if x < 0.7 => Self {
                azimuth: -self.azimuth,
                ..*self
            },
            x if x < 0.93 => {
                let step = side * (10.0 + 25.0 * amount).to_radians();
                let turned = |e: f32| (0.2..1.3).contains(&e);
                let elevation = match turned(self.elevation + step) {
                    true => self.elevation + step,
                    false => self.elevation - step,
                };
                Self { elevation, ..*self }
            }
            x if x < 0.96 => Self {
                sun_share: 0.0,
                ..*self
            },
            _ => {
                let step = 0.25 + 0.15 * amount;
                let sun_share = match self.sun_share > 0.69 {
                    true => self.sun_share - step,
                    false => self.sun_share + step,
                };
                Self { sun_share, ..*self }
            }
        }
    }

    /// The same light from the three other quarters: what is common to all four, brightness, height,
    /// sky, is not of the light's direction.
    pub fn turned(&self) -> [Self; 3] {
        [1.0, 2.0, 3.0].map(|quarters| Self {
            azimuth: self.azimuth + quarters * PI / 2.0,
            ..*self
        })
    }
}

/// The two neighbours of `value` on a scale of words; beyond the ends, the
/// last step goes on, which keeps different values different.
fn between(scale: &[(&'static str, f32); 3], value: f32) -> Mixture {
    let i = usize::from(value > scale[1].1);
    let (low, high) = (scale[i], scale[i + 1]);
    let t = ((value - low.1) / (high.1 - low.1)).clamp(-0.3, 1.3);
    vec![(low.0, 1.0 - t), (high.0, t)]
}

/// A caption: plain words, and places whose embedding is a mixture.
#[derive(Debug, Clone, PartialEq)]
pub struct Caption {
    /// The text with a placeholder word at each mixture.
    pub text: String,
    /// Mixtures in the order of their placeholders.
    pub mixtures: Vec<Mixture>,
}

/// Stands where a mixture goes; token `vocab_size + i` for the i-th.
pub const PLACEHOLDERS: [&str; 3] = ["mixeda", "mixedb", "mixedc"];

impl Caption {
    /// "a photo of a {class}", and what `light` says if it is given.
    pub fn new(class: &str, light: Option<&LightWords>) -> Self {
        let mut text = format!("a photo of a {class}");
        let mut mixtures = vec![];
        match light {
            Some(light) if light.is_overcast() => text.push_str(&format!(", {OVERCAST}")),
            Some(light) => {
                let [a, b, c] = PLACEHOLDERS;
                text.push_str(&format!(", sun at {a}, {b}, {c}"));
                mixtures.extend(light.mixtures());
            }
            None => {}
        }
        Self { text, mixtures }
    }

    /// The nearest caption in words alone.
    pub fn spoken(&self) -> String {
        let mut text = self.text.clone();
        for (placeholder, mixture) in PLACEHOLDERS.iter().zip(&self.mixtures) {
            let word = mixture
                .iter()
                .max_by(|a, b| a.1.total_cmp(&b.1))
                .map_or("", |m| m.0);
            text = text.replace(placeholder, word);
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_ahead_is_left_of_who_looks_to_the_right() {
        let ahead = LightWords {
            azimuth: 0.0,
            elevation: 0.5,
            sun_share: 0.8,
        };
        let hour = |w: &LightWords| {
            let all = w.mixtures()[0].clone();
            all.into_iter()
                .max_by(|a, b| a.1.total_cmp(&b.1))
                .unwrap()
                .0
        };
        let turned = ahead.seen_from(PI / 2.0);
        assert_eq!(hour(&ahead), "twelve");
        assert_eq!(hour(&turned), "nine");
        assert_eq!(hour(&turned.mirrored()), "three");
    }

    #[test]
    fn rivals_say_another_light_that_could_be() {
        let light = LightWords {
            azimuth: 1.0,
            elevation: 0.5,
            sun_share: 0.8,
        };
        let overcast = LightWords {
            sun_share: 0.0,
            ..light
        };
        let mut stream = NoiseStream::new(1, 2);
        let mut heights = 0;
        for _ in 0..500 {
            let rival = light.rival(&mut stream);
            let [a, b] = [light, rival].map(|l| Caption::new("ball", Some(&l)));
            assert_ne!(a, b);
            assert!((0.2..1.3).contains(&rival.elevation), "{rival:?}");
            assert!((0.0..=0.95).contains(&rival.sun_share), "{rival:?}");
            heights += usize::from(rival.elevation != light.elevation);
            assert!(!overcast.rival(&mut stream).is_overcast());
        }
        assert!((50..200).contains(&heights), "{heights}");
    }

    #[test]
    fn a_light_from_the_other_sides_is_the_same_light() {
        let light = LightWords {
            azimuth: 1.0,
            elevation: 0.5,
            sun_share: 0.8,
        };
        let around = light.turned();
        let sum = around
            .iter()
            .chain([&light])
            .map(|l| glam::Vec2::from_angle(l.azimuth));
        assert!(sum.sum::<glam::Vec2>().length() < 1e-6);
        assert!(
            around
                .iter()
                .all(|l| (l.elevation, l.sun_share) == (0.5, 0.8))
        );
    }

    #[test]
    fn captions_name_the_light() {
        let light = LightWords {
            azimuth: PI / 2.0,
            elevation: 0.3,
            sun_share: 0.9,
        };
        let caption = Caption::new("car", Some(&light));
        assert_eq!(
            caption.spoken(),
            "a photo of a car, sun at three, low, clear"
        );
        let overcast = LightWords {
            sun_share: 0.0,
            ..light
        };
        assert_eq!(
            Caption::new("car", Some(&overcast)).spoken(),
            "a photo of a car, overcast"
        );
    }

    #[test]
    fn mixtures_are_continuous_around_the_clock() {
        let at = |degrees: f32| {
            let light = LightWords {
                azimuth: degrees.to_radians(),
                elevation: 0.6,
                sun_share: 0.7,
            };
            let mut weights = [0f32; 12];
            for (word, weight) in &light.mixtures()[0] {
                let hour = CLOCK.iter().position(|w| w == word).expect("an hour");
                weights[hour] += weight;
            }
            weights
        };
        for step in 0..720 {
            let (a, b) = (at(step as f32 * 0.5), at(step as f32 * 0.5 + 0.5));
            let change: f32 = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum();
            assert!(change < 0.05, "{step}: {change}");
            assert!((a.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn no_word_comes_twice() {
        let mut words = vocabulary();
        words.sort_unstable();
        words.windows(2).for_each(|w| assert_ne!(w[0], w[1]));
    }
}
