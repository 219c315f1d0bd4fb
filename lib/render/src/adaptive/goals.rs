//! How many samples each job gets in a round.
use super::{EstimatedError, Stop};
use crate::job::{Job, REPLICATES};
use crate::viewing::SquaredError;

/// Samples per pixel and replicate of the first round. More are wasted: most pixels of a large photograph need no more.
/// Fewer miss highlights, and the error is more often above what is stated (`benches/calibration.rs`).
const FIRST_ROUND: u32 = 4;

/// No job grows faster than this from one round to the next, because early variances are
/// uncertain.
const MAX_GROWTH: f64 = 4.0;

/// A tile whose own display-referred RMSE is above this and above twice the target gets more samples, even when the target is
/// reached: its noise is seen beside smooth tiles. Chosen by eye.
const SEEN: f64 = 0.04;
/// Samples per pixel and replicate that a tile may get for that.
const MOST_FOR_TILE: u32 = 64;

/// Samples per pixel and replicate of the first round, `limit` at most.
pub(super) fn first_goal(stop: Stop, limit: u32) -> u32 {
    match stop {
        // A quarter first, so that long renders show something early.
        Stop::Samples(n) => {
            let n = n.div_ceil(REPLICATES as u32).max(1);
            if n >= 4 * FIRST_ROUND { n / 4 } else { n }
        }
        Stop::TargetError(_) | Stop::TimeBudget(_) => FIRST_ROUND.min(limit),
    }
}

/// Samples per pixel and replicate that every job should reach in the next round, which under a time
/// budget may cost `allowance`.
pub(super) fn next_goals(
    stop: Stop,
    limit: u32,
    jobs: &[Job],
    errors: &[SquaredError],
    error: &EstimatedError,
    allowance: f64,
) -> Vec<u32> {
    let unchanged = || jobs.iter().map(|job| job.samples).collect();
    match stop {
        Stop::Samples(n) => vec![n.div_ceil(REPLICATES as u32).max(1); jobs.len()],
        Stop::TargetError(target) => {
            let target = f64::from(target);
            let scale = match error.upper_95 <= target {
                true => 0.0,
                false => {
                    // The estimate itself has to come as far below the target as its bound lies above it.
                    let slack = error.rmse / error.upper_95;
                    let allowed = (target * slack).powi(2) * error.touched_pixels as f64;
                    spread(jobs, errors).map(|(root, c)| root * c).sum::<f64>() / allowed
                }
            };
            let goals = goals(jobs, errors, scale, limit);
            let least = jobs
                .iter()
                .zip(errors)
                .map(|(job, e)| unseen(job.samples, e.sum, job.pixels.len() as f64, target, limit));
            goals
                .into_iter()
                .zip(least)
                .map(|(n, least)| n.max(least))
                .collect()
        }
        Stop::TimeBudget(_) => {
            let spent_already: f64 = jobs.iter().map(Job::cost).sum();
            let per_scale = spread(jobs, errors).map(|(root, c)| root * c).sum::<f64>();
            if per_scale == 0.0 {
                return unchanged();
            }
            // Jobs that are ahead of their share stay, so look for the scale that spends what
            // the round may spend.
            let spent = |scale: f64| -> f64 {
                goals(jobs, errors, scale, limit)
                    .iter()
                    .zip(jobs)
                    .map(|(&n, job)| job.cost() * f64::from(n) / f64::from(job.samples.max(1)))
                    .sum()
            };
            let whole = spent_already + allowance;
            let (mut low, mut high) = (0.0, whole / per_scale * 8.0);
            for _ in 0..32 {
                let middle = 0.5 * (low + high);
                if spent(middle) <= whole {
                    low = middle;
                } else {
                    high = middle;
                }
            }
            goals(jobs, errors, low, limit)
        }
    }
}

/// `(sqrt(V / c), c)` of every job: V the variance times samples, c the cost of a sample per pixel
/// and replicate.
fn spread<'a>(
    jobs: &'a [Job],
    errors: &'a [SquaredError],
) -> impl Iterator<Item = (f64, f64)> + 'a {
    jobs.iter().zip(errors).map(|(job, e)| {
        let n = f64::from(job.samples.max(1));
        let cost = (job.cost() / n).max(1e-9);
        ((e.sum * n / cost).sqrt(), cost)
    })
}

/// Samples per pixel and replicate that bring a tile's noise below [`SEEN`], [`MOST_FOR_TILE`] at most.
pub(crate) fn unseen(samples: u32, error: f64, pixels: f64, target: f64, limit: u32) -> u32 {
    let most = SEEN.max(2.0 * target).powi(2) * pixels;
    let best = f64::from(samples) * error / most;
    goal(best.min(f64::from(MOST_FOR_TILE)), samples, limit)
}

fn goals(jobs: &[Job], errors: &[SquaredError], scale: f64, limit: u32) -> Vec<u32> {
    spread(jobs, errors)
        .zip(jobs)
        .map(|((root, _), job)| goal(root * scale, job.samples, limit))
        .collect()
}

/// Samples per pixel and replicate of a job in the next round, of which it has `samples` and would best have `best`.
pub(crate) fn goal(best: f64, samples: u32, limit: u32) -> u32 {
    let wanted = best.min(f64::from(samples) * MAX_GROWTH).ceil() as u32;
    // Multiples of four keep the sequences stratified.
    let stratified = wanted.checked_next_multiple_of(4).unwrap_or(limit);
    stratified.min(limit).max(samples)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tile_whose_noise_is_seen_gets_more_though_the_target_is_reached() {
        let block = crate::shadow::Block {
            x: 0,
            y: 0,
            width: 8,
            height: 8,
        };
        let pixels = crate::job::PixelSet::new(block, |_| true);
        let mut job = Job::new(crate::job::Layer::PlaneShadow, block, pixels, None);
        job.samples = 4;
        let error = |rmse: f64| SquaredError {
            sum: 64.0 * rmse * rmse,
            variance: 0.0,
        };
        let reached = EstimatedError {
            rmse: 0.01,
            upper_95: 0.011,
            touched_pixels: 1 << 20,
        };
        let next = |rmse: f64, jobs: &[Job]| {
            let stop = Stop::TargetError(0.012);
            next_goals(stop, 1000, jobs, &[error(rmse)], &reached, 0.0)[0]
        };
        assert_eq!(next(0.039, std::slice::from_ref(&job)), 4);
        // Twice the noise that is allowed, four times the samples.
        assert_eq!(next(0.08, std::slice::from_ref(&job)), 16);
        // A caustic does not make a draft a final picture.
        job.samples = 64;
        assert_eq!(next(1.0, std::slice::from_ref(&job)), 64);
    }

    #[test]
    fn a_job_that_has_enough_gets_nothing_and_others_whole_strata() {
        assert_eq!(goal(7.9, 8, 100), 8);
        assert_eq!(goal(8.1, 8, 100), 12);
        assert_eq!(goal(1e9, 8, 100), 32);
        assert_eq!(goal(1e9, 32, 100), 100);
    }
}
