//! Samplers: from noise to a sample in a few evaluations of the network.

use candle_core::Tensor;

use crate::error::{Result, argument};
use crate::schedule::{ALMOST_NO_SIGNAL, NoiseSchedule, Spacing};

/// Which solver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Solver {
    /// Deterministic DDIM [Song et al. 2021].
    Ddim,
    /// DPM-Solver++(2M), second order, midpoint [Lu et al. 2022].
    DpmSolver2M,
}

/// The state of one sampling run.
#[derive(Debug, Clone)]
pub struct Sampler<'a> {
    schedule: &'a NoiseSchedule,
    solver: Solver,
    timesteps: Vec<usize>,
    /// Steps between timesteps of DDIM.
    stride: usize,
    /// The clean sample of the step before, for the second order.
    previous: Option<(usize, Tensor)>,
}

impl<'a> Sampler<'a> {
    /// Visits `steps` timesteps, spaced as the schedule's configuration says.
    pub fn new(schedule: &'a NoiseSchedule, solver: Solver, steps: usize) -> Result<Self> {
        let n = schedule.len();
        if steps == 0 || steps > n {
            return argument(format!("sampler: {steps} steps, accepted: 1 to {n}"));
        }
        let timesteps = match solver {
            Solver::Ddim => ddim_timesteps(schedule, steps)?,
            Solver::DpmSolver2M => dpm_timesteps(schedule, steps)?,
        };
        Ok(Self {
            schedule,
            solver,
            timesteps,
            stride: n / steps,
            previous: None,
        })
    }

    /// Timesteps in the order of visiting, falling.
    pub fn timesteps(&self) -> &[usize] {
        &self.timesteps
    }

    /// One step: the network's `output` at `x` for timestep number `index`
    /// to the next, less noisy `x`.
    pub fn step(&mut self, index: usize, output: &Tensor, x: &Tensor) -> Result<Tensor> {
        let Some(&t) = self.timesteps.get(index) else {
            return argument(format!("sampler: step {index} of {}", self.timesteps.len()));
        };
        match self.solver {
            Solver::Ddim => self.ddim(t, output, x),
            Solver::DpmSolver2M => self.dpm(index, t, output, x),
        }
    }

    fn ddim(&self, t: usize, output: &Tensor, x: &Tensor) -> Result<Tensor> {
        let last = if self.schedule.config().set_alpha_to_one {
            1.0
        } else {
            self.schedule.alpha_bar(0)?
        };
        let next = match t.checked_sub(self.stride) {
            Some(t) => self.schedule.alpha_bar(t)?,
            None => last,
        };
        let x0 = self.schedule.sample_of(output, x, t)?;
        let noise = self.schedule.noise_of(output, x, t)?;
        Ok(((x0 * next.sqrt())? + (noise * (1.0 - next).sqrt())?)?)
    }

    /// (signal, noise) factors of step `index`; after the last, no noise.
    fn factors(&self, index: usize) -> Result<(f64, f64)> {
        match self.timesteps.get(index) {
            Some(&t) => {
                let a = self.schedule.alpha_bar(t)?;
                let a = if a > 0.0 { a } else { ALMOST_NO_SIGNAL };
                Ok((a.sqrt(), (1.0 - a).sqrt()))
            }
            None => Ok((1.0, 0.0)),
        }
    }

    fn dpm(&mut self, index: usize, t: usize, output: &Tensor, x: &Tensor) -> Result<Tensor> {
        let (signal, sigma) = self.factors(index)?;
        let (next_signal, next_sigma) = self.factors(index + 1)?;
        let x0 = self.schedule.sample_of(output, x, t)?;
        let previous = self.previous.replace((index, x0.clone()));
        // lambda = ln(signal / noise); h its increase, infinite at the end.
        let lambda = signal.ln() - sigma.ln();
        let h = if next_sigma > 0.0 {
            next_signal.ln() - next_sigma.ln() - lambda
        } else {
            f64::INFINITY
        };
        let decay = (-h).exp_m1();
        let first_order = ((x * (next_sigma / sigma))? - (&x0 * (next_signal * decay))?)?;
        let at_end = index + 1 == self.timesteps.len();
        match previous {
            // The last step goes to zero noise, where the second order has no
            // finite ratio of steps.
            Some((before, x0_before)) if before + 1 == index && !at_end => {
                let (signal_before, sigma_before) = self.factors(before)?;
                let r = (lambda - signal_before.ln() + sigma_before.ln()) / h;
                let slope = ((x0 - x0_before)? * (0.5 * next_signal * decay / r))?;
                Ok((first_order - slope)?)
            }
            _ => Ok(first_order),
        }
    }
}

/// Round half to even, as NumPy does.
fn round(x: f64) -> usize {
    x.round_ties_even().max(0.0) as usize
}

/// Number `i` of the timesteps from 0 to `last` in `parts` equal parts, by NumPy's products: 15 of 30 parts of 999 are
/// below 499.5, where they would be 500 in another order.
fn evenly(i: usize, last: usize, parts: usize) -> usize {
    round(i as f64 * (last as f64 / parts as f64))
}

fn ddim_timesteps(schedule: &NoiseSchedule, steps: usize) -> Result<Vec<usize>> {
    let n = schedule.len();
    let spacing = schedule
        .config()
        .timestep_spacing
        .unwrap_or(Spacing::Leading);
    let offset = schedule.config().steps_offset;
    let mut timesteps: Vec<usize> = match spacing {
        Spacing::Linspace if steps == 1 => vec![0],
        Spacing::Linspace => (0..steps)
            .map(|i| evenly(i, n - 1, steps - 1))
            .rev()
            .collect(),
        Spacing::Leading => (0..steps).map(|i| i * (n / steps) + offset).rev().collect(),
        Spacing::Trailing => trailing(n, steps),
    };
    clamp(&mut timesteps, n);
    Ok(timesteps)
}

fn dpm_timesteps(schedule: &NoiseSchedule, steps: usize) -> Result<Vec<usize>> {
    let n = schedule.len();
    let spacing = schedule
        .config()
        .timestep_spacing
        .unwrap_or(Spacing::Linspace);
    let offset = schedule.config().steps_offset;
    let mut timesteps: Vec<usize> = match spacing {
        Spacing::Linspace => (1..=steps).map(|i| evenly(i, n - 1, steps)).rev().collect(),
        Spacing::Leading => (1..=steps)
            .map(|i| i * (n / (steps + 1)) + offset)
            .rev()
            .collect(),
        Spacing::Trailing => trailing(n, steps),
    };
    clamp(&mut timesteps, n);
    if timesteps.windows(2).any(|pair| pair[0] <= pair[1]) {
        return argument(format!(
            "sampler: {steps} steps do not fit into {n} timesteps with this spacing; use fewer"
        ));
    }
    Ok(timesteps)
}

fn trailing(n: usize, steps: usize) -> Vec<usize> {
    let stride = n as f64 / steps as f64;
    (0..steps)
        .map(|i| round(n as f64 - i as f64 * stride).saturating_sub(1))
        .collect()
}

/// An offset may push the first timestep past the end.
fn clamp(timesteps: &mut [usize], n: usize) {
    timesteps.iter_mut().for_each(|t| *t = (*t).min(n - 1));
}

/// Classifier-free guidance [Ho & Salimans 2022]: unconditional + scale
/// (conditional - unconditional). Scale 1 is the conditional prediction; the
/// weight s of score distillation is scale - 1.
pub fn guided(unconditional: &Tensor, conditional: &Tensor, scale: f64) -> Result<Tensor> {
    Ok((unconditional + ((conditional - unconditional)? * scale)?)?)
}

/// Runs `sampler` from step `first`, with `predict` as the network.
pub fn sample(
    sampler: &mut Sampler,
    first: usize,
    start: &Tensor,
    mut predict: impl FnMut(&Tensor, usize) -> Result<Tensor>,
) -> Result<Tensor> {
    let mut x = start.clone();
    for index in first..sampler.timesteps.len() {
        let t = sampler.timesteps[index];
        let output = predict(&x, t)?;
        x = sampler.step(index, &output, &x)?;
    }
    Ok(x)
}

/// SDEdit [Meng et al. 2022]: noises `latents` to a share `strength` in
/// (0, 1] of the schedule, and samples from there.
pub fn edit(
    sampler: &mut Sampler,
    latents: &Tensor,
    noise: &Tensor,
    strength: f64,
    predict: impl FnMut(&Tensor, usize) -> Result<Tensor>,
) -> Result<Tensor> {
    if !(strength > 0.0 && strength <= 1.0) {
        return argument(format!(
            "SDEdit: strength {strength}, accepted: above 0, up to 1"
        ));
    }
    let steps = sampler.timesteps.len();
    let run = ((steps as f64 * strength) as usize).clamp(1, steps);
    let first = steps - run;
    let start = sampler
        .schedule
        .add_noise(latents, noise, sampler.timesteps[first])?;
    sample(sampler, first, &start, predict)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::ScheduleConfig;

    /// Of DPMSolverMultistepScheduler.set_timesteps(30) and DDIMScheduler.set_timesteps(31), diffusers 0.42.1.
    #[test]
    fn timesteps_halfway_between_two_are_those_of_diffusers() {
        let schedule = NoiseSchedule::new(ScheduleConfig {
            timestep_spacing: Some(Spacing::Linspace),
            ..ScheduleConfig::default()
        });
        let schedule = schedule.expect("valid schedule");
        for (solver, steps) in [(Solver::DpmSolver2M, 30), (Solver::Ddim, 31)] {
            let sampler = Sampler::new(&schedule, solver, steps).expect("steps");
            assert_eq!(sampler.timesteps()[14..17], [533, 499, 466], "{solver:?}");
        }
    }
}
