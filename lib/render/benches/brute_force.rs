//! The renderer against plain path tracing in many random scenes; see `tests/brute_force`. Run with
//! `cargo bench -p dipir-render --bench brute_force -- FIRST END`: the numbers of the scenes, 0 to 40 if left out.
#[path = "../tests/brute_force/compare.rs"]
mod compare;
#[path = "../tests/brute_force/scenes.rs"]
mod scenes;
#[path = "../tests/brute_force/tracer.rs"]
mod tracer;

use std::time::Instant;

use compare::{adaptive, compare, fixed};
use scenes::Case;

fn main() {
    let numbers: Vec<u64> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    let (first, end) = match numbers[..] {
        [first, end] => (first, end),
        _ => (0, 40),
    };
    println!("largest difference in standard errors: object, coverage, shadow; seconds");
    for seed in first..end {
        let case = Case::new(seed, 24);
        for (name, settings) in [
            ("fixed", fixed(512, seed)),
            ("adaptive", adaptive(0.004, seed)),
        ] {
            let clock = Instant::now();
            let found = compare(&case, &settings, 512, seed);
            let [object, coverage, shadow] = found.map(|d| d.sigmas);
            let seconds = clock.elapsed().as_secs_f64();
            println!("{seed} {name}: {object:.1} {coverage:.1} {shadow:.1}; {seconds:.1}");
            for difference in found.iter().filter(|d| d.sigmas.is_nan() || d.sigmas > 5.0) {
                println!("  {difference}");
            }
        }
    }
}
