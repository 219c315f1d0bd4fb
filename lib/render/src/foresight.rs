//! What a lower error costs, foreseen from the samples drawn so far.
//!
//! The rounds of [`crate::adaptive`] are played through on the jobs' squared errors and costs instead of their samples,
//! with the same goals. A job's squared error is taken to fall with a power of its samples, the one that the jobs that
//! grew have shown where they held most of the error: 1 for independent samples, more where stratification helps.
use crate::adaptive::{EstimatedError, goal, unseen};
use crate::job::Job;
use crate::viewing::SquaredError;

/// The power before any job has grown: that of independent samples.
const POWER: f64 = 1.0;
/// Powers that are believed: 3 is that of scrambled nets on a smooth integrand, the best there is
/// [Owen 1997, "Scrambled net variance for integrals of smooth functions"].
const POWERS: [f64; 2] = [0.5, 3.0];
/// Jobs that grew tell the power if they held this share of the squared error.
const SHARE_TO_LEARN_FROM: f64 = 0.5;
/// Rounds that are played through at most; each multiplies the samples by up to 4.
const ROUNDS: usize = 32;
/// Share of the samples' squared error that the denoiser is taken to leave where it has not been tried. Of .25 to 1 it foretells
/// most scenes of `benches/forecasts.rs` best.
const DENOISED: f64 = 0.4;
/// Error of most pictures after the first round, from which the share of the first round is guessed while it is under way.
const FIRST_ERROR: f64 = 0.027;

/// A job after a round.
#[derive(Clone, Copy, Debug)]
struct Point {
    /// Summed over its pixels, display-referred.
    squared_error: f64,
    /// The same before noise is removed.
    drawn: f64,
    /// Per pixel and replicate.
    samples: f64,
    /// Of one such sample.
    cost: f64,
    /// Of the job.
    pixels: f64,
}

/// What is not known of a cost. How far such costs are off, `benches/forecasts.rs` says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Guess {
    /// How many highlights smaller than a pixel the samples have missed.
    Highlights,
    /// How much noise the denoiser would remove: it was not tried.
    Denoiser,
}

/// What is known of the jobs.
#[derive(Clone, Debug)]
pub struct Foresight {
    /// After the first round, which every target pays for.
    first: Vec<Point>,
    /// After the last round.
    last: Vec<Point>,
    /// Squared error in units of what a target of 1 allows, and cost: after every round.
    rounds: Vec<(f64, f64)>,
    /// The power of the last round that tells it.
    power: f64,
    /// That of the first one.
    early: Option<f64>,
    /// Cost that every target pays once, beside the jobs.
    once: f64,
    /// Whether noise is removed.
    denoises: bool,
    /// Of every job the squared error that removing noise would have left after the first round, where that was tried.
    denoised: Option<Vec<f64>>,
    /// Whether highlights smaller than a pixel were found.
    highlights: bool,
    /// Squared error allowed for a target of 1, summed over the pixels: less than their number, because it is the bound
    /// that has to reach the target.
    allowed: f64,
    /// Samples per pixel and replicate at most.
    limit: u32,
}

impl Foresight {
    /// Nothing is known yet.
    pub(crate) fn new(limit: u32, denoises: bool) -> Self {
        Self {
            first: vec![],
            last: vec![],
            rounds: vec![],
            denoises,
            denoised: None,
            highlights: false,
            power: POWER,
            early: None,
            once: 0.0,
            allowed: 0.0,
            limit,
        }
    }

    /// Adds what a round has led to: of each job the error that is left, and that before noise was removed.
    pub(crate) fn learn(
        &mut self,
        jobs: &[Job],
        errors: &[SquaredError],
        drawn: &[f64],
        error: &EstimatedError,
    ) {
        let points = jobs
            .iter()
            .zip(errors)
            .zip(drawn)
            .map(|((job, e), &drawn)| {
                let samples = f64::from(job.samples.max(1));
                Point {
                    squared_error: e.sum,
                    drawn,
                    samples,
                    cost: (job.cost() / samples).max(1e-9),
                    pixels: job.pixels.len() as f64,
                }
            });
        let points: Vec<Point> = points.collect();
        if self.first.is_empty() {
            self.first.clone_from(&points);
        } else if let Some(power) = power(&self.last, &points) {
            self.power = power;
            self.early.get_or_insert(power);
        }
        self.last = points;
        let slack = match error.upper_95 > 0.0 {
            true => error.rmse / error.upper_95,
            false => 1.0,
        };
        self.allowed = slack.powi(2) * error.touched_pixels as f64;
        self.rounds
            .push((sum(&self.last) / self.allowed, self.spent(&self.last)));
    }

    /// Adds what every target takes once beside the jobs: rays and samples.
    pub(crate) fn learn_of_effort(&mut self, effort: u64) {
        self.once += effort as f64;
        self.rounds.iter_mut().for_each(|r| r.1 += effort as f64);
    }

    /// What jobs and all else have cost.
    fn spent(&self, points: &[Point]) -> f64 {
        self.once + points.iter().map(|p| p.cost * p.samples).sum::<f64>()
    }

    /// Adds what removing noise would have left of each job's squared error after the first round.
    pub(crate) fn learn_of_denoiser(&mut self, left: &[SquaredError]) {
        self.denoised = Some(left.iter().map(|e| e.sum).collect());
    }

    /// Highlights smaller than a pixel were found.
    pub(crate) fn learn_of_highlights(&mut self) {
        self.highlights = true;
    }

    /// Why the cost of `target`, with noise removed or not, is a guess; None if it is an estimate.
    pub fn guess(&self, target: f64, denoises: bool) -> Option<Guess> {
        let reached = self.rounds.last().is_some_and(|r| r.0 <= target * target);
        match () {
            () if self.highlights && !reached => Some(Guess::Highlights),
            () if denoises && !self.denoises && self.denoised.is_none() => Some(Guess::Denoiser),
            () => None,
        }
    }

    /// What reaching the 95% bound `target` costs in all, over what was spent so far. Below 1 for targets that earlier
    /// rounds had reached, down to the first round's share.
    pub fn cost_of(&self, target: f64) -> f64 {
        self.cost_with(target, self.denoises)
    }

    /// As [`cost_of`](Self::cost_of), where noise is removed or not, whatever was done.
    pub fn cost_with(&self, target: f64, denoises: bool) -> f64 {
        let (first, last, share, powers) = match (self.denoises, denoises) {
            (true, false) => {
                let [first, last] = [&self.first, &self.last].map(|p| as_drawn(p));
                let power = power(&first, &last).unwrap_or(POWER);
                return self.played((&first, power), (&last, power), target);
            }
            (false, true) => {
                let share = match &self.denoised {
                    Some(left) => left.iter().sum::<f64>() / sum(&self.first),
                    None => DENOISED,
                };
                let mut first = scaled(&self.first, share);
                let left = self.denoised.iter().flatten();
                first
                    .iter_mut()
                    .zip(left)
                    .for_each(|(p, &left)| p.squared_error = left);
                (first, scaled(&self.last, share), share, [POWER; 2])
            }
            _ => (
                self.first.clone(),
                self.last.clone(),
                1.0,
                [self.early.unwrap_or(self.power), self.power],
            ),
        };
        // A round that reached the target has shown what is enough.
        let reached = self.rounds.iter().find(|r| r.0 * share <= target * target);
        let most = reached.map_or(f64::INFINITY, |r| r.1 / self.spent(&self.last));
        let cost = self.played((&first, powers[0]), (&last, powers[1]), target);
        cost.min(most)
    }

    /// The rounds after `last` are played through, or those after `first` for a target that `last` has reached, each with
    /// its power.
    fn played(&self, first: (&[Point], f64), last: (&[Point], f64), target: f64) -> f64 {
        let allowed = self.allowed * target * target;
        let (points, power) = if sum(last.0) > allowed { last } else { first };
        let mut points = points.to_vec();
        for _ in 0..ROUNDS {
            if !self.play(&mut points, power, target) {
                break;
            }
        }
        let ratio = self.spent(&points) / self.spent(&self.last);
        if ratio.is_finite() { ratio } else { 1.0 }
    }

    /// One round more; whether any job has grown.
    fn play(&self, points: &mut [Point], power: f64, target: f64) -> bool {
        let allowed = self.allowed * target * target;
        let root = |p: &Point| (p.squared_error * p.samples / p.cost).sqrt();
        let scale = match sum(points) <= allowed {
            true => 0.0,
            false => points.iter().map(|p| root(p) * p.cost).sum::<f64>() / allowed,
        };
        let mut grown = false;
        for point in points {
            let samples = point.samples as u32;
            let least = unseen(
                samples,
                point.squared_error,
                point.pixels,
                target,
                self.limit,
            );
            let goal = goal(root(point) * scale, samples, self.limit).max(least);
            let goal = f64::from(goal);
            if goal > point.samples {
                point.squared_error *= (goal / point.samples).powf(-power);
                point.samples = goal;
                grown = true;
            }
        }
        grown
    }
}

/// The share of all work that the first round is guessed to be, before anything is known of the picture. Behind it, most
/// pictures cost as the inverse of the error: the jobs that hold most of the error are few at first.
pub(crate) fn first_share(target: f64) -> f64 {
    (target / FIRST_ERROR).clamp(0.0, 1.0)
}

fn sum(points: &[Point]) -> f64 {
    points.iter().map(|p| p.squared_error).sum()
}

/// The same jobs with `share` of their errors.
fn scaled(points: &[Point], share: f64) -> Vec<Point> {
    let scaled = points.iter().map(|&p| Point {
        squared_error: share * p.squared_error,
        ..p
    });
    scaled.collect()
}

/// The same jobs with the errors of their samples.
fn as_drawn(points: &[Point]) -> Vec<Point> {
    let drawn = points.iter().map(|&p| Point {
        squared_error: p.drawn,
        ..p
    });
    drawn.collect()
}

/// The power of the samples with which the squared error of the jobs that grew has fallen, found by bisection. None if
/// they held little of it.
fn power(before: &[Point], after: &[Point]) -> Option<f64> {
    let grew = before.iter().zip(after);
    let grew = grew.filter(|(b, a)| a.samples > b.samples);
    let grew: Vec<_> = grew
        .map(|(b, a)| (a.samples / b.samples, b.squared_error, a.squared_error))
        .collect();
    let held: f64 = grew.iter().map(|g| g.1).sum();
    let all: f64 = before.iter().map(|p| p.squared_error).sum();
    if held <= SHARE_TO_LEARN_FROM * all {
        return None;
    }
    let left: f64 = grew.iter().map(|g| g.2).sum();
    let [mut low, mut high] = POWERS;
    for _ in 0..32 {
        let middle = 0.5 * (low + high);
        let expected: f64 = grew.iter().map(|g| g.1 * g.0.powf(-middle)).sum();
        match expected > left {
            true => low = middle,
            false => high = middle,
        }
    }
    Some(0.5 * (low + high))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(errors: &[f64], samples: f64) -> Vec<Point> {
        let point = |&squared_error: &f64| Point {
            squared_error,
            drawn: 2.0 * squared_error,
            samples,
            cost: 1.0,
            pixels: 1.0,
        };
        errors.iter().map(point).collect()
    }

    fn known(errors: &[f64], power: f64) -> Foresight {
        Foresight {
            first: points(errors, 8.0),
            last: points(errors, 8.0),
            rounds: vec![],
            denoises: true,
            denoised: None,
            highlights: false,
            power,
            early: None,
            once: 0.0,
            allowed: errors.len() as f64,
            limit: 1 << 20,
        }
    }

    #[test]
    fn jobs_of_equal_error_cost_the_inverse_square_of_the_target() {
        // Mean square 4: a target of 0.2 is a tenth of the error. 100 times 8 samples.
        let even = known(&[4.0; 10], 1.0);
        assert_eq!(even.cost_of(2.0), 1.0);
        assert!(
            (even.cost_of(0.2) - 100.0).abs() < 1.0,
            "{}",
            even.cost_of(0.2)
        );
        // As the error falls with the samples instead of their root, 10 times; the last round, which does not know,
        // draws up to 4 times what is needed.
        let smooth = known(&[4.0; 10], 2.0).cost_of(0.2);
        assert!((10.0..=40.0).contains(&smooth), "{smooth}");
    }

    #[test]
    fn error_in_few_jobs_is_cheap_to_lower() {
        // One job in a hundred holds all: it alone grows, to 100 times its samples.
        let mut errors = [0.0; 100];
        errors[0] = 400.0;
        let cost = known(&errors, 1.0).cost_of(0.2);
        assert!((cost - 1.99).abs() < 0.05, "{cost}");
        // A target that was passed already costs the first round at least.
        let mut done = known(&errors, 1.0);
        done.last = points(&[0.01; 100], 80.0);
        assert!((done.cost_of(10.0) - 0.1).abs() < 1e-12);
    }

    #[test]
    fn a_target_out_of_reach_costs_as_many_samples_as_there_are() {
        let mut even = known(&[4.0; 10], 1.0);
        even.limit = u32::MAX;
        let most = f64::from(u32::MAX) / 8.0;
        assert!((even.cost_of(1e-9) / most - 1.0).abs() < 1e-9);
    }

    #[test]
    fn without_the_denoiser_the_errors_of_the_samples_count_and_with_it_a_share_of_them() {
        // Twice the squared error takes twice the samples, up to the next multiple of four, .5 of the first 8.
        let even = known(&[4.0; 10], 1.0);
        let cost = even.cost_with(0.2, false);
        assert!((cost - 200.0).abs() < 1.0, "{cost}");
        let without = Foresight {
            denoises: false,
            ..even.clone()
        };
        let cost = without.cost_with(0.2, true);
        assert!((cost - 100.0 * DENOISED).abs() < 1.0, "{cost}");
        assert_eq!(without.cost_with(0.2, false), without.cost_of(0.2));
        // A round that reached the target bounds what it costs.
        let reached = Foresight {
            rounds: vec![(0.04 / DENOISED, 80.0)],
            ..without
        };
        assert!((reached.cost_with(0.2, true) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn with_highlights_only_what_was_reached_is_more_than_a_guess() {
        let mut one = Foresight {
            rounds: vec![(0.04, 80.0)],
            ..known(&[4.0; 10], 1.0)
        };
        assert_eq!(one.guess(0.1, true), None);
        one.learn_of_highlights();
        assert_eq!(one.guess(0.1, true), Some(Guess::Highlights));
        assert_eq!(one.guess(0.2, true), None);
    }

    #[test]
    fn what_a_denoiser_that_did_not_run_removes_is_guessed() {
        let one = known(&[4.0; 10], 1.0);
        assert_eq!(one.guess(0.1, false), None);
        let without = Foresight {
            denoises: false,
            ..one
        };
        assert_eq!(without.guess(0.1, true), Some(Guess::Denoiser));
        assert_eq!(without.guess(0.1, false), None);
    }

    #[test]
    fn what_a_denoiser_that_was_tried_would_leave_is_no_guess() {
        let mut one = Foresight {
            denoises: false,
            ..known(&[4.0; 10], 1.0)
        };
        let left = [SquaredError {
            sum: 1.0,
            variance: 0.0,
        }; 10];
        one.learn_of_denoiser(&left);
        assert_eq!(one.guess(0.1, true), None);
        // A quarter of the errors takes a quarter of the samples.
        let cost = one.cost_with(0.2, true);
        assert!((cost - 25.0).abs() < 1.0, "{cost}");
        // A target that the samples have passed, to which the filter would have come with the first 8 of 800.
        one.last = points(&[0.01; 10], 800.0);
        let cost = one.cost_with(1.0, true);
        assert!((cost - 0.01).abs() < 1e-9, "{cost}");
    }

    #[test]
    fn effort_beside_the_jobs_is_paid_once() {
        // Ten jobs of 8 samples, 80 rays beside them. Samples go up to the next multiple of four, half of 8: half of .5.
        let mut one = known(&[4.0; 10], 1.0);
        one.learn_of_effort(80);
        let cost = one.cost_of(0.2);
        assert!((cost - 0.5 * (1.0 + 100.0)).abs() < 0.5, "{cost}");
    }

    #[test]
    fn a_target_that_is_reached_is_played_with_the_power_of_the_first_rounds() {
        let mut one = known(&[1.0; 10], 1.0);
        one.last = points(&[1e-4; 10], 800.0);
        let independent = one.cost_of(0.25);
        one.early = Some(2.0);
        let stratified = one.cost_of(0.25);
        // 16 times the 8 samples; 4 times, of which the last round does not know, see above.
        assert!((independent - 0.16).abs() < 1e-9, "{independent}");
        assert!((0.04..=0.08).contains(&stratified), "{stratified}");
    }

    #[test]
    fn a_tile_whose_noise_is_seen_gets_more_though_the_target_is_reached() {
        // One pixel of a hundred has noise of .08, where .04 is seen: four times its samples.
        let mut errors = [0.0; 100];
        errors[0] = 0.08 * 0.08;
        let cost = known(&errors, 1.0).cost_of(0.01);
        assert!((cost - 1.03).abs() < 1e-9, "{cost}");
    }

    #[test]
    fn the_power_is_that_of_the_jobs_that_grew() {
        let before = points(&[1.0, 3.0, 2.0], 8.0);
        let mut after = before.clone();
        for (point, growth) in after.iter_mut().zip([4.0f64, 2.0, 1.0]) {
            point.samples *= growth;
            point.squared_error *= growth.powf(-1.5);
        }
        assert!((power(&before, &after).unwrap() - 1.5).abs() < 1e-6);
        after = before.clone();
        after[0].samples = 16.0;
        assert!(power(&before, &after).is_none(), "a sixth of the error");
        assert_eq!(first_share(1.0), 1.0);
    }
}
