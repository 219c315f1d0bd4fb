//! Captions that describe light: the sun's azimuth and elevation and how clear the sky is, and their vocabulary.
//!
//! A value between two words is a weighted mean of the words' embeddings, so a caption changes continuously with the light.

use std::f32::consts::{PI, TAU};

use serde::{Deserialize, Serialize};

/// Words for the sun's azimuth: hours of a clock face on the ground, seen from above, with the camera at six looking
/// towards twelve.
pub const CLOCK: [&str; 12] = [
    "twelve", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten",
    "eleven",
];
/// Words for the sun's elevation, and what each means, degrees.
pub const HEIGHTS: [(&str, f32); 3] = [("low", 15.0), ("middle", 40.0), ("high", 65.0)];
/// Words for the sun's share of the irradiance of the ground, and what each means.
pub const SKIES: [(&str, f32); 3] = [("hazy", 0.4), ("fair", 0.7), ("clear", 0.95)];
/// The word for a sky without a sun.
pub const OVERCAST: &str = "overcast";
/// Words for colours of objects.
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

/// All words that are one token, in the order of the tokens.
pub fn vocabulary() -> Vec<&'static str> {
    let mut words: Vec<&str> = OTHERS.to_vec();
    words.extend(COLORS);
    words.extend(CLOCK);
    words.extend(HEIGHTS.map(|(word, _)| word));
    words.extend(SKIES.map(|(word, _)| word));
    words.push(OVERCAST);
    words
}

/// The light as a caption describes it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LightDescription {
    /// Angle on the ground from the camera's forward direction to the sun, positive to the right, radians.
    pub azimuth: f32,
    /// Angle of the sun above the horizon, radians.
    pub elevation: f32,
    /// The sun's share of the irradiance of the ground, 0 to 1.
    pub sun_share: f32,
}

/// Direction of the middle of a picture from the camera that took it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewDirection {
    /// Angle on the ground from the camera's forward direction, positive to the right, radians.
    pub heading: f32,
    /// Angle below the horizon, radians.
    pub pitch: f32,
}

impl ViewDirection {
    /// The angles of `direction`; `forward` and `right` are horizontal unit vectors.
    pub fn along(direction: glam::Vec3, forward: glam::Vec3, right: glam::Vec3) -> Self {
        let (x, z) = (direction.dot(right), direction.dot(forward));
        Self {
            heading: x.atan2(z),
            pitch: (-direction.y).atan2(x.hypot(z)),
        }
    }
}

/// Words with weights that sum to 1, for one placeholder of a caption.
pub type WordMixture = Vec<(&'static str, f32)>;

impl LightDescription {
    /// Whether the caption says overcast, and nothing of the sun.
    pub fn is_overcast(&self) -> bool {
        self.sun_share < 0.15
    }

    /// Mixtures of words for azimuth, elevation and the sun's share.
    pub fn mixtures(&self) -> [WordMixture; 3] {
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

    /// The same light with left and right swapped.
    pub fn mirrored(&self) -> Self {
        Self {
            azimuth: -self.azimuth,
            ..*self
        }
    }

    /// The same light for a camera that is turned right by `angle`, radians.
    pub fn seen_from(&self, angle: f32) -> Self {
        Self {
            azimuth: self.azimuth - angle,
            ..*self
        }
    }

    /// The same light turned by one, two and three quarters of a circle. All else that predictions for them share,
    /// such as brightness, is not about the direction.
    pub fn quarter_turns(&self) -> [Self; 3] {
        [1.0, 2.0, 3.0].map(|quarters| Self {
            azimuth: self.azimuth + quarters * PI / 2.0,
            ..*self
        })
    }
}

/// The two words next to `value`, weighted linearly. Weights extrapolate by up to .3 beyond the ends of the scale, so
/// that values there still differ.
fn between(scale: &[(&'static str, f32); 3], value: f32) -> WordMixture {
    let i = usize::from(value > scale[1].1);
    let (low, high) = (scale[i], scale[i + 1]);
    let t = ((value - low.1) / (high.1 - low.1)).clamp(-0.3, 1.3);
    vec![(low.0, 1.0 - t), (high.0, t)]
}

/// A caption: text with placeholders, and the mixture of words for each.
#[derive(Debug, Clone, PartialEq)]
pub struct Caption {
    /// The text, with a placeholder for each mixture.
    pub text: String,
    /// Mixtures in the order of the placeholders.
    pub mixtures: Vec<WordMixture>,
}

/// Words that stand for mixtures; the i-th is the token `vocab_size + i`.
pub const PLACEHOLDERS: [&str; 3] = ["mixeda", "mixedb", "mixedc"];

impl Caption {
    /// "a photo of a {class}", followed by `light` if it is given.
    pub fn new(class: &str, light: Option<&LightDescription>) -> Self {
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
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The caption with the likeliest word for every placeholder.
    fn plain_text(caption: &Caption) -> String {
        let mut text = caption.text.clone();
        for (placeholder, mixture) in PLACEHOLDERS.iter().zip(&caption.mixtures) {
            let likeliest = mixture.iter().max_by(|a, b| a.1.total_cmp(&b.1));
            text = text.replace(placeholder, likeliest.unwrap().0);
        }
        text
    }

    #[test]
    fn a_camera_that_turns_right_sees_what_was_ahead_on_its_left() {
        let ahead = LightDescription {
            azimuth: 0.0,
            elevation: 0.5,
            sun_share: 0.8,
        };
        let hour = |w: &LightDescription| {
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
    fn quarter_turns_change_the_azimuth_alone() {
        let light = LightDescription {
            azimuth: 1.0,
            elevation: 0.5,
            sun_share: 0.8,
        };
        let around = light.quarter_turns();
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
    fn captions_describe_the_light() {
        let light = LightDescription {
            azimuth: PI / 2.0,
            elevation: 0.3,
            sun_share: 0.9,
        };
        let caption = Caption::new("car", Some(&light));
        assert_eq!(
            plain_text(&caption),
            "a photo of a car, sun at three, low, clear"
        );
        let overcast = LightDescription {
            sun_share: 0.0,
            ..light
        };
        assert_eq!(
            plain_text(&Caption::new("car", Some(&overcast))),
            "a photo of a car, overcast"
        );
    }

    #[test]
    fn mixtures_are_continuous_around_the_clock() {
        let at = |degrees: f32| {
            let light = LightDescription {
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
