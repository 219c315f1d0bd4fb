//! How many samples go where, and when there are enough.
//!
//! Samples are drawn in rounds. After each round the display-referred squared error of every job
//! (a layer of a block of pixels) is estimated from the spread of its independently scrambled
//! replicates, and the next round's samples go where they lower the total error most per unit of
//! cost: `n_i` in proportion to `sqrt(V_i / c_i)`, with `V_i` the variance and `c_i` the cost of
//! one sample (Lagrange's rule). Cost is counted in rays and samples, never in seconds, so that the
//! same samples are drawn by any number of threads on any machine; a time budget only decides
//! after which round to stop.
mod goals;

use std::collections::HashSet;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use self::goals::{first_goal, next_goals};
pub(crate) use self::goals::{goal, unseen};
use crate::contribution::{LeaveOut, LeftOut};
use crate::counters::RayCounts;
use crate::denoise::{Denoiser, auxiliary::Auxiliary};
use crate::error::RenderError;
use crate::film::Film;
use crate::foresight::{Foresight, first_share};
use crate::highlights::Found;
use crate::job::{Job, Layer, REPLICATES};
use crate::render::Simulation;
use crate::viewing::{SquaredError, Viewing};

/// Is told of the progress after every round and from time to time, and may break off.
pub type Watch<'a> = dyn FnMut(&Progress) -> ControlFlow<()> + 'a;

/// When to stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Stop {
    /// After this many samples in every pixel (rounded up to a multiple of [`REPLICATES`]).
    Samples(u32),
    /// When the 95% bound of the estimated error is at most this display-referred RMSE.
    TargetError(f32),
    /// When this time is over, counted from the call that renders; the last round is as large as
    /// is expected to fit.
    TimeBudget(Duration),
}

/// Under a time budget the total cost grows at most by this factor a round, so that how long the
/// last one takes is foreseen from rounds much like it.
const TIMED_GROWTH: f64 = 1.5;

/// Share of the time left that the last round is planned to take: rounds differ.
const LAST_ROUND: f64 = 0.97;

/// A round that would add less than this share of the cost so far is not worth its overhead.
const LEAST_GROWTH: f64 = 0.03;

/// The estimated error of the composite.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EstimatedError {
    /// Display-referred RMSE over the pixels that the object or its shadow touches.
    pub rmse: f64,
    /// One-sided 95% confidence bound of it.
    pub upper_95: f64,
    /// Those pixels, without the ones that a time budget left to a coarser picture.
    pub touched_pixels: u64,
}

/// State after a round, and every [`REPORT_EVERY`] of the next one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Progress {
    /// Rounds done; 0 while the first is under way, when nothing is known of the error.
    pub round: u32,
    /// Error so far.
    pub error: EstimatedError,
    /// Image samples drawn so far, all layers.
    pub samples: u64,
    /// Rays traced so far.
    pub rays: u64,
    /// Time since the first round began.
    pub elapsed: Duration,
    /// Share of the work that is done, in `[0, 1]`, as far as it can be foreseen.
    pub fraction: f64,
}

/// How often a round says how far it is. Only where the caller's thread is none of rayon's, which would wait in vain.
const REPORT_EVERY: Duration = Duration::from_millis(200);

/// What the rounds led to.
#[derive(Clone, Debug)]
pub struct Refined {
    /// The layers.
    pub film: Film,
    /// Their error.
    pub error: EstimatedError,
    /// Rays traced.
    pub counts: RayCounts,
    /// Image samples drawn, all layers.
    pub samples: u64,
    /// Rounds.
    pub rounds: u32,
    /// What other errors cost.
    pub foresight: Foresight,
    /// What effects contribute, where that was asked for.
    pub left_out: Option<LeftOut>,
}

/// What a round draws.
#[derive(Clone, Copy)]
pub struct Round<'a> {
    /// What is simulated.
    pub simulation: Simulation,
    /// The layers so far, where the round measures what effects contribute: the object's are done before shadows begin.
    pub measures: Option<(&'a Film, &'a Viewing<'a>)>,
}

/// Samples per replicate of a pixel with a highlight in its first round: the highlight may fill a hundredth of the area
/// that they concentrate on.
const FIRST_ROUND_WITH_HIGHLIGHT: u32 = 1024;

/// Draws samples until `stop`. `advance(job, n, round)` brings a job to `n` samples per pixel and
/// replicate; the first round simulates `simulation`, and measures what may be left out from the next one on, if
/// `leave_out` says what; `find_highlights(film, jobs)` says once, after the first round, which pixels of the object start
/// again with another density of samples; with `auxiliary` pictures the layers are filtered after every round if `denoise`
/// says so, else once, to learn what that would save; `progress` may break off whenever it is called. A time budget counts
/// from `start`; where it ends within the first round, the pixels that have no samples yet are taken from `coarse`, the same
/// picture at a lower resolution. Without one, the first round is always finished.
pub(crate) fn refine(
    size: (usize, usize),
    mut jobs: Vec<Job>,
    stop: Stop,
    start: Instant,
    max_samples: u32,
    viewing: &Viewing,
    simulation: Simulation,
    leave_out: Option<&LeaveOut>,
    advance: &(impl Fn(&mut Job, u32, &Round) + Sync),
    find_highlights: &dyn Fn(&Film, &[Job]) -> Found,
    auxiliary: Option<&Auxiliary>,
    denoise: bool,
    coarse: Option<&Film>,
    progress: &mut dyn FnMut(&Progress) -> ControlFlow<()>,
) -> Result<Refined, RenderError> {
    let limit = max_samples.div_ceil(REPLICATES as u32).max(1);
    let mut film = Film::new(size.0, size.1);
    let mut goals = vec![first_goal(stop, limit); jobs.len()];
    let mut round = 0;
    let is_late = || match stop {
        Stop::TimeBudget(budget) => coarse.is_some() && start.elapsed() >= budget,
        _ => false,
    };
    let mut others = Effort::default();
    let mut foresight = Foresight::new(limit, denoise);
    let mut denoiser = auxiliary.filter(|_| denoise).map(Denoiser::new);
    let mut report = Progress::default();
    let (mut simulation, mut stop, mut left_out) = (simulation, stop, None::<LeftOut>);
    loop {
        let round_start = Instant::now();
        let cost_before: f64 = jobs.iter().map(Job::cost).sum();
        let end_of_round = match stop {
            Stop::TargetError(target) if round == 0 => first_share(f64::from(target)),
            _ => share_after(report.fraction, &jobs, &goals),
        };
        let mut within_round = |share: f64| {
            let fraction = match stop {
                Stop::TimeBudget(budget) => share_of_time(start.elapsed(), budget),
                _ => report.fraction + share * (end_of_round - report.fraction),
            };
            let elapsed = start.elapsed();
            progress(&Progress {
                elapsed,
                fraction,
                ..report
            })
        };
        let is_wanted = |job: &Job, goal| goal > job.samples && (job.samples > 0 || !is_late());
        let measures = leave_out.is_some() && round == 0;
        let phases: &[Phase] = match measures {
            true => &[Phase::Object, Phase::Shadow],
            false => &[Phase::All],
        };
        for (number, &phase) in phases.iter().enumerate() {
            let drawn = Round {
                simulation,
                measures: measures.then_some((&film, viewing)),
            };
            let share = |share| (number as f64 + share) / phases.len() as f64;
            let is_wanted = |job: &Job, goal| phase.holds(job) && is_wanted(job, goal);
            let advance = |job: &mut Job, goal: u32| advance(job, goal, &drawn);
            let report = |done| within_round(share(done));
            let before: Vec<u32> = jobs.iter().map(|job| job.samples).collect();
            if draw(&mut jobs, &goals, phase, &is_wanted, &advance, report).is_break() {
                return Err(RenderError::Interrupted);
            }
            film.develop_more(&jobs, &before);
        }
        let cost_of_round = jobs.iter().map(Job::cost).sum::<f64>() - cost_before;
        let seconds_of_round = round_start.elapsed().as_secs_f64();
        round += 1;
        if round == 1
            && let Some(coarse) = coarse
        {
            film.fill_in(&jobs, coarse);
        }
        if let (1, Some(allowed)) = (round, leave_out) {
            let decided = leave_out_of(&jobs, simulation, allowed, stop, &film, viewing);
            jobs.iter_mut().for_each(|job| job.measured = None);
            simulation = decided.simulation;
            stop = without_bias(stop, &decided);
            left_out = Some(decided);
        }
        if round == 1 && !is_late() {
            let found = find_highlights(&film, &jobs);
            others.counts = found.counts;
            if !found.pixels.is_empty() {
                foresight.learn_of_highlights();
            }
            let goal = FIRST_ROUND_WITH_HIGHLIGHT.min(limit);
            let drawn = Round {
                simulation,
                measures: None,
            };
            let advance = |job: &mut Job, goal: u32| advance(job, goal, &drawn);
            let begun = start_again(&mut jobs, found, goal, &mut others, &advance);
            film.develop(&jobs[begun..]);
            foresight.learn_of_effort(others.counts.total() + others.samples);
        }
        let (errors, drawn) = errors_of(&mut film, &jobs, denoiser.as_mut(), viewing);
        let error = total_error(&errors, &jobs, &film, viewing);
        let cost: f64 = jobs.iter().map(Job::cost).sum();
        foresight.learn(&jobs, &errors, &drawn, &error);
        if let (1, false, Some(auxiliary)) = (round, denoise, auxiliary) {
            let mut denoiser = Denoiser::new(auxiliary);
            let (left, _) = errors_of(&mut film, &jobs, Some(&mut denoiser), viewing);
            film.develop(&jobs);
            foresight.learn_of_denoiser(&left);
        }
        let growth = match stop {
            Stop::TimeBudget(budget) => {
                let rate = seconds_of_round / cost_of_round.max(1.0);
                let left = budget.as_secs_f64() - start.elapsed().as_secs_f64();
                timed_growth(left, rate * cost)
            }
            _ => 0.0,
        };
        let next = next_goals(stop, limit, &jobs, &errors, &error, cost * growth);
        let out_of_time = matches!(stop, Stop::TimeBudget(_)) && growth == 0.0;
        let done = out_of_time
            || next
                .iter()
                .zip(jobs.iter())
                .all(|(&n, job)| n <= job.samples);
        let error = with_bias(error, left_out.as_ref());
        report = Progress {
            round,
            error,
            samples: jobs.iter().map(Job::samples_drawn).sum::<u64>() + others.samples,
            rays: jobs.iter().map(|j| j.counts.total()).sum::<u64>() + others.counts.total(),
            elapsed: start.elapsed(),
            fraction: if done {
                1.0
            } else {
                fraction(stop, &foresight, cost, &jobs, &next, start.elapsed())
            },
        };
        if progress(&report).is_break() {
            return Err(RenderError::Interrupted);
        }
        if done {
            let mut counts = others.counts;
            jobs.iter().for_each(|job| counts.merge(&job.counts));
            return Ok(Refined {
                film,
                error,
                counts,
                samples: report.samples,
                rounds: round,
                foresight,
                left_out,
            });
        }
        goals = next;
    }
}

/// The error that is left of each job, after its noise is removed from `film` if there is a `denoiser`, and that of its samples
/// before.
fn errors_of(
    film: &mut Film,
    jobs: &[Job],
    denoiser: Option<&mut Denoiser>,
    viewing: &Viewing,
) -> (Vec<SquaredError>, Vec<f64>) {
    let denoised = match denoiser {
        Some(denoiser) => denoiser.denoise(film, jobs, viewing),
        None => vec![None; jobs.len()],
    };
    let film = &*film;
    let errors = jobs
        .par_iter()
        .zip(denoised)
        .map(|(job, denoised)| match denoised {
            Some(error) => (error.left, error.drawn),
            None => {
                let error = viewing.squared_error(film, job);
                (error, error.sum)
            }
        });
    errors.unzip()
}

/// Brings every job for which `is_wanted` holds to its goal, and tells `report` the share that is done from time to
/// time; breaks off when it says so.
fn draw(
    jobs: &mut [Job],
    goals: &[u32],
    phase: Phase,
    is_wanted: &(impl Fn(&Job, u32) -> bool + Sync),
    advance: &(impl Fn(&mut Job, u32) + Sync),
    mut report: impl FnMut(f64) -> ControlFlow<()>,
) -> ControlFlow<()> {
    let work = |job: &Job, goal: u32| match phase.holds(job) {
        true => work(job, goal) as u64,
        false => 0,
    };
    let all: u64 = jobs.iter().zip(goals).map(|(j, &g)| work(j, g)).sum();
    let (done, is_broken) = (AtomicU64::new(0), AtomicBool::new(false));
    let mut draw = || {
        let jobs = jobs.par_iter_mut().zip(goals).with_max_len(1);
        jobs.for_each(|(job, &goal)| {
            if is_broken.load(Ordering::Relaxed) {
                return;
            }
            let work = work(job, goal);
            if is_wanted(job, goal) {
                advance(job, goal);
            }
            done.fetch_add(work, Ordering::Relaxed);
        });
    };
    if rayon::current_thread_index().is_some() {
        draw();
        return ControlFlow::Continue(());
    }
    let (end, ended) = channel::<()>();
    rayon::in_place_scope(|scope| {
        scope.spawn(move |_| {
            draw();
            drop(end);
        });
        while ended.recv_timeout(REPORT_EVERY) == Err(RecvTimeoutError::Timeout) {
            let share = done.load(Ordering::Relaxed) as f64 / all.max(1) as f64;
            if report(share).is_break() {
                is_broken.store(true, Ordering::Relaxed);
            }
        }
    });
    match is_broken.into_inner() {
        true => ControlFlow::Break(()),
        false => ControlFlow::Continue(()),
    }
}

/// Which jobs are drawn at a time.
#[derive(Clone, Copy)]
enum Phase {
    All,
    Object,
    Shadow,
}

impl Phase {
    fn holds(self, job: &Job) -> bool {
        match self {
            Phase::All => true,
            Phase::Object => job.layer == Layer::Object,
            Phase::Shadow => job.layer != Layer::Object,
        }
    }
}

/// What is left out after the first round.
fn leave_out_of(
    jobs: &[Job],
    simulation: Simulation,
    allowed: &LeaveOut,
    stop: Stop,
    film: &Film,
    viewing: &Viewing,
) -> LeftOut {
    let target = match stop {
        Stop::TargetError(target) => Some(f64::from(target)),
        _ => None,
    };
    let touched = touched_pixels(film, viewing);
    LeftOut::decide(jobs, simulation, allowed, target, touched)
}

/// Where samples stop, so that with what is left out the error is as `stop` says.
fn without_bias(stop: Stop, left_out: &LeftOut) -> Stop {
    match stop {
        Stop::TargetError(target) => {
            let square = f64::from(target).powi(2) - left_out.lost.upper_95.powi(2);
            Stop::TargetError(square.max(0.0).sqrt() as f32)
        }
        _ => stop,
    }
}

/// The error of samples and of what is left out together: they are independent.
fn with_bias(error: EstimatedError, left_out: Option<&LeftOut>) -> EstimatedError {
    let lost = left_out.map(|l| l.lost).unwrap_or_default();
    EstimatedError {
        rmse: error.rmse.hypot(lost.rmse),
        upper_95: error.upper_95.hypot(lost.upper_95),
        ..error
    }
}

/// What bringing `job` to `goal` costs, by what its samples cost so far: of a job without any, its number of samples.
fn work(job: &Job, goal: u32) -> f64 {
    let more = f64::from(goal.saturating_sub(job.samples));
    match job.samples {
        0 => more * job.pixels.len() as f64,
        n => more * job.cost() / f64::from(n),
    }
}

/// The share of all work that is done when `goals` are reached, where `fraction` of it is now.
fn share_after(fraction: f64, jobs: &[Job], goals: &[u32]) -> f64 {
    let done: f64 = jobs.iter().map(Job::cost).sum();
    let more: f64 = jobs.iter().zip(goals).map(|(j, &g)| work(j, g)).sum();
    match done > 0.0 {
        true => (fraction * (done + more) / done).min(1.0),
        false => 0.25,
    }
}

fn share_of_time(elapsed: Duration, budget: Duration) -> f64 {
    (elapsed.as_secs_f64() / budget.as_secs_f64().max(1e-9)).min(1.0)
}

/// Effort that no job accounts for.
#[derive(Clone, Copy, Debug, Default)]
struct Effort {
    counts: RayCounts,
    samples: u64,
}

/// Gives every pixel that `found` names a job of its own, behind the others, and brings it to `goal` samples.
/// Returns the first of them. Adds to `others` the samples that are given up, and the rays of jobs that end.
fn start_again(
    jobs: &mut Vec<Job>,
    found: Found,
    goal: u32,
    others: &mut Effort,
    advance: &(impl Fn(&mut Job, u32) + Sync),
) -> usize {
    let names: HashSet<(u32, u32)> = found.pixels.iter().map(|f| f.0).collect();
    if !names.is_empty() {
        for job in jobs.iter_mut().filter(|job| job.layer == Layer::Object) {
            others.samples += job.samples_drawn();
            job.give_up(|pixel| names.contains(&pixel));
            others.samples -= job.samples_drawn();
        }
        let ended = jobs.iter().filter(|job| job.pixels.is_empty());
        ended.for_each(|job| others.counts.merge(&job.counts));
        jobs.retain(|job| !job.pixels.is_empty());
    }
    let first = jobs.len();
    jobs.extend(found.pixels.into_iter().map(|(p, f)| Job::focused(p, f)));
    let new = jobs[first..].par_iter_mut().with_max_len(1);
    new.for_each(|job| advance(job, goal));
    first
}

/// By which share of the cost so far the next round adds to it, `left` seconds before the end, when
/// all of it again would take `again` seconds; 0 to stop. A last but one round leaves enough for
/// the last.
fn timed_growth(left: f64, again: f64) -> f64 {
    let affordable = LAST_ROUND * left / again.max(1e-9);
    let most = TIMED_GROWTH - 1.0;
    match affordable {
        a if a < LEAST_GROWTH => 0.0,
        a if a <= most => a,
        a => most.min(0.5 * a),
    }
}

/// Pixels that the object or its shadow touches.
fn touched_pixels(film: &Film, viewing: &Viewing) -> u64 {
    let (width, height) = (film.alpha.width(), film.alpha.height());
    let rows = (0..height).into_par_iter().map(|y| {
        let touched = (0..width).filter(|&x| viewing.is_touched(film, x, y));
        touched.count() as u64
    });
    rows.sum()
}

/// Of these the pixels without samples, which a coarser picture fills in: how wrong they are is not known.
fn filled_pixels(jobs: &[Job], film: &Film, viewing: &Viewing) -> u64 {
    let filled = |job: &Job| {
        let pixels = job.pixels.iter().filter(|&(x, y)| {
            let (x, y) = (x as usize, y as usize);
            let covered = *film.alpha.get(x, y) > 0.0;
            match job.layer {
                Layer::Object => covered,
                _ => !covered && viewing.is_touched(film, x, y),
            }
        });
        pixels.count() as u64
    };
    jobs.iter().filter(|job| job.samples == 0).map(filled).sum()
}

fn total_error(
    errors: &[SquaredError],
    jobs: &[Job],
    film: &Film,
    viewing: &Viewing,
) -> EstimatedError {
    let total = errors
        .iter()
        .fold(SquaredError::default(), |sum, e| sum.merge(*e));
    let touched = touched_pixels(film, viewing);
    let touched = touched.saturating_sub(filled_pixels(jobs, film, viewing));
    let pixels = touched.max(1) as f64;
    // 1.645 standard errors bound a normal variable from above in 95% of cases. Of a sum of squares it
    // is the logarithm that is nearly normal: few pixels hold most of the error, and where the sum
    // comes out small, so does its standard error.
    let spread = total.variance.sqrt() / total.sum.max(f64::MIN_POSITIVE);
    let upper = total.sum * (1.645 * spread).exp();
    EstimatedError {
        rmse: (total.sum / pixels).sqrt(),
        upper_95: (upper / pixels).sqrt(),
        touched_pixels: touched,
    }
}

fn fraction(
    stop: Stop,
    foresight: &Foresight,
    cost: f64,
    jobs: &[Job],
    next: &[u32],
    elapsed: Duration,
) -> f64 {
    let f = match stop {
        Stop::TargetError(target) => 1.0 / foresight.cost_of(f64::from(target)),
        Stop::TimeBudget(budget) => share_of_time(elapsed, budget),
        Stop::Samples(_) => {
            let more: f64 = jobs.iter().zip(next).map(|(j, &n)| work(j, n)).sum();
            cost / (cost + more).max(1.0)
        }
    };
    if f.is_finite() {
        f.clamp(0.0, 1.0)
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests;
