//! Rounds and the error that is stated.
use crate::job::PixelSet;
use crate::shadow::Block;

use super::*;

#[test]
fn rounds_under_a_time_budget_grow_and_the_last_one_fills_what_is_left() {
    // Ten times as long is left: as much as a round may grow.
    assert_eq!(timed_growth(10.0, 1.0), TIMED_GROWTH - 1.0);
    // All that is left fits into one round.
    assert!((timed_growth(0.4, 1.0) - 0.4 * LAST_ROUND).abs() < 1e-12);
    // Two rounds: neither so small that it is not worth it.
    let growth = timed_growth(0.6, 1.0);
    assert!((growth - 0.3 * LAST_ROUND).abs() < 1e-12);
    assert!(timed_growth(0.6 - growth, 1.0 + growth) > LEAST_GROWTH);
    for over in [(0.0, 1.0), (-1.0, 1.0), (0.01, 1.0)] {
        assert_eq!(timed_growth(over.0, over.1), 0.0);
    }
}

#[test]
fn pixels_without_samples_do_not_make_the_error_smaller() {
    let job = |x| {
        let block = Block {
            x,
            y: 0,
            width: 8,
            height: 8,
        };
        Job::new(Layer::Object, block, PixelSet::new(block, |_| true), None)
    };
    let mut jobs = [job(0), job(8)];
    jobs[0].samples = 4;
    let mut film = Film::new(16, 8);
    film.alpha.pixels_mut().fill(1.0);
    let viewing = Viewing {
        background: None,
        tone: None,
        transfer: dipir_imaging::transfer::Transfer::Linear,
        gain: 1.0,
        adds: false,
        is_blurred: false,
    };
    let errors = [0.64, 0.0].map(|sum| SquaredError { sum, variance: 0.0 });
    let error = total_error(&errors, &jobs, &film, &viewing);
    assert_eq!(error.touched_pixels, 64);
    assert!((error.rmse - 0.1).abs() < 1e-12, "{error:?}");
}

#[test]
fn a_budget_is_kept_within_a_tenth_while_rounds_differ_by_a_fifth() {
    // Times are in units of the first round. The time of a round is predicted from the rate of the round before, at
    // most 1.21 times wrong. The last round exceeds the rest of the budget by at most 0.97 * 1.21 - 1 of it, and that
    // rest is at most a third of the budget: 6%. At most 0.03 / 0.97 * 1.21 of the budget stays unused: 4%.
    for budget in [1.5, 3.0, 10.0, 100.0, 1e4] {
        for first in [1.1, 1.0 / 1.1] {
            let (mut elapsed, mut cost, mut rate) = (1.0, 1.0, 1.0);
            for _ in 0..1000 {
                let growth = timed_growth(budget - elapsed, rate * cost);
                if growth == 0.0 {
                    break;
                }
                rate = if rate == first { 1.0 / first } else { first };
                elapsed += rate * growth * cost;
                cost += growth * cost;
            }
            let share = elapsed / budget;
            assert!((0.9..=1.1).contains(&share), "{share} of {budget}");
        }
    }
}

#[test]
fn samples_and_rays_of_pixels_that_start_again_are_counted() {
    use crate::counters::RayKind;
    use crate::highlights::PixelDensity;

    let block = |x| Block {
        x,
        y: 0,
        width: 2,
        height: 1,
    };
    let job = |x| {
        let mut job = Job::new(
            Layer::Object,
            block(x),
            PixelSet::new(block(x), |_| true),
            None,
        );
        job.samples = 4;
        (0..16).for_each(|_| job.counts.add(RayKind::Camera));
        job
    };
    let mut jobs = vec![job(0), job(8)];
    let drawn = |jobs: &[Job]| jobs.iter().map(Job::samples_drawn).sum::<u64>();
    let rays = |jobs: &[Job]| jobs.iter().map(|job| job.counts.total()).sum::<u64>();
    let before = (drawn(&jobs), rays(&jobs));
    // All of the first job, and half of the second one.
    let found = Found {
        pixels: [(0, 0), (1, 0), (8, 0)]
            .map(|pixel| (pixel, PixelDensity::default()))
            .to_vec(),
        ..Found::default()
    };
    let mut others = Effort::default();
    let begun = start_again(&mut jobs, found, 0, &mut others, &|_, _| {});
    assert_eq!((begun, jobs.len()), (1, 4));
    let after = (
        drawn(&jobs) + others.samples,
        rays(&jobs) + others.counts.total(),
    );
    assert_eq!(after, before);
}
