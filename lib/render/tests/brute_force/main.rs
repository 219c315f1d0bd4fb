//! The renderer's layers are those of a path tracer without any cleverness, in random small scenes. More of them:
//! `cargo bench -p dipir-render --bench brute_force -- FIRST END`.
mod combinations;
mod compare;
mod scenes;
mod tracer;

use compare::{adaptive, compare, fixed};
use scenes::Case;

/// Pixels along a side of a picture.
const SIZE: u32 = 16;
/// Plain samples of a pixel.
const SAMPLES: u32 = 256;
/// Standard errors by which a tile's mean may differ: 6 cases, 3 layers, 5 tiles, 3 channels are 270 differences, and the
/// errors, known from some 64 pixels, are those of samples that have long tails.
const MOST_SIGMAS: f64 = 5.5;

fn hold_for(seeds: std::ops::Range<u64>, is_adaptive: bool) {
    for seed in seeds {
        let case = Case::new(seed, SIZE);
        let settings = match is_adaptive {
            true => adaptive(0.004, seed),
            false => fixed(SAMPLES, seed),
        };
        for difference in compare(&case, &settings, SAMPLES, seed) {
            assert!(difference.sigmas < MOST_SIGMAS, "case {seed}: {difference}");
        }
    }
}

#[test]
fn pictures_of_a_fixed_number_of_samples_are_those_of_plain_path_tracing() {
    hold_for(42..46, false);
}

#[test]
fn pictures_of_adaptive_sampling_and_tight_tolerances_are_those_of_plain_path_tracing() {
    hold_for(2000..2002, true);
}
