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
            if error.upper_95 <= f64::from(target) {
                return unchanged();
            }
            // The estimate itself has to come as far below the target as its bound lies above it.
            let slack = error.rmse / error.upper_95;
            let allowed = (f64::from(target) * slack).powi(2) * error.touched_pixels as f64;
            let scale = spread(jobs, errors).map(|(root, c)| root * c).sum::<f64>() / allowed;
            goals(jobs, errors, scale, limit)
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
    fn a_job_that_has_enough_gets_nothing_and_others_whole_strata() {
        assert_eq!(goal(7.9, 8, 100), 8);
        assert_eq!(goal(8.1, 8, 100), 12);
        assert_eq!(goal(1e9, 8, 100), 32);
        assert_eq!(goal(1e9, 32, 100), 100);
    }
}
