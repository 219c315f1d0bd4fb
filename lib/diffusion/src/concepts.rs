//! Prompts for images of a class: the same thing in many colours, places and
//! lights, so that an adapter trained on them keeps the class and forgets
//! none of its variety.

use crate::noise::NoiseStream;

/// What varies; chosen so that no choice contradicts another.
const COLORS: [&str; 10] = [
    "white", "black", "silver", "red", "blue", "green", "yellow", "orange", "brown", "grey",
];
const SIZES: [&str; 4] = ["", "large ", "small ", "close-up "];
const PLACES: [&str; 10] = [
    "on a street",
    "on a beach",
    "in a forest",
    "in front of a house",
    "in a studio",
    "on grass",
    "on a wooden floor",
    "in a parking lot",
    "in the mountains",
    "indoors",
];
const LIGHTS: [&str; 8] = [
    "in bright sunlight",
    "under an overcast sky",
    "at sunset",
    "in the shade",
    "at noon",
    "in the early morning",
    "with soft light from the side",
    "with strong shadows",
];

/// A concept image to be made: its prompt and the seed of its noise.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Concept {
    /// What is asked for.
    pub prompt: String,
    /// Key of the image's noise.
    pub seed: u64,
}

/// The caption under which concept images are trained.
pub fn class_prompt(class: &str) -> String {
    format!("a photo of a {class}")
}

/// Concept number `index` for `class`: attributes and seed follow from
/// (`seed`, `index`) alone, so that a longer list begins with the shorter one.
pub fn concept(class: &str, index: usize, seed: u64) -> Concept {
    let mut stream = NoiseStream::new(seed, index as u64);
    let mut choose = |words: &[&'static str]| words[stream.below(words.len())];
    let (color, size, place, light) = (
        choose(&COLORS),
        choose(&SIZES),
        choose(&PLACES),
        choose(&LIGHTS),
    );
    let prompt = format!("a {size}photo of a {color} {class} {place}, {light}");
    Concept {
        prompt,
        seed: stream.next_u64(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn concepts_vary_and_do_not_depend_on_their_number() {
        let all: Vec<Concept> = (0..100).map(|i| concept("car", i, 7)).collect();
        assert!(all.iter().all(|c| c.prompt.contains(" car ")));
        let (prompts, seeds): (HashSet<_>, HashSet<_>) =
            all.iter().map(|c| (&c.prompt, c.seed)).unzip();
        // 3200 combinations: 100 draws collide about 1.5 times.
        assert!(prompts.len() > 90 && seeds.len() == 100);
        assert_eq!(concept("car", 3, 7), all[3]);
        assert_ne!(concept("car", 3, 8), all[3]);
    }
}
