//! Noise schedules: how much signal and noise a timestep has, and what the
//! network's output means.

mod class;

use std::path::Path;

use candle_core::Tensor;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::config::ConfigFile;
use crate::error::{Error, Result, argument};

/// How the noise variances grow over the timesteps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum BetaSchedule {
    /// Linear in beta [Ho et al. 2020].
    #[serde(rename = "linear")]
    Linear,
    /// Linear in sqrt(beta), of latent diffusion.
    #[serde(rename = "scaled_linear")]
    ScaledLinear,
    /// alpha bar is a squared cosine [Nichol & Dhariwal 2021].
    #[serde(rename = "squaredcos_cap_v2")]
    SquaredCosine,
}

/// What the network predicts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Prediction {
    /// The noise.
    #[serde(rename = "epsilon")]
    Epsilon,
    /// sqrt(alpha bar) noise - sqrt(1 - alpha bar) sample [Salimans & Ho 2022].
    #[serde(rename = "v_prediction")]
    Velocity,
    /// The clean sample.
    #[serde(rename = "sample")]
    Sample,
}

/// Which timesteps a sampler visits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Spacing {
    /// Evenly from the first to the last.
    Linspace,
    /// Multiples of the step, from 0 upwards.
    Leading,
    /// Multiples of the step, from the last downwards.
    Trailing,
}

/// The keys of `scheduler/scheduler_config.json` that matter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ScheduleConfig {
    /// Timesteps of training.
    pub num_train_timesteps: usize,
    /// First noise variance.
    pub beta_start: f64,
    /// Last noise variance.
    pub beta_end: f64,
    /// Curve between them.
    pub beta_schedule: BetaSchedule,
    /// Variances spelled out; overrules the curve.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trained_betas: Option<Vec<f64>>,
    /// Rescale so that the last timestep has no signal [Lin et al. 2024].
    pub rescale_betas_zero_snr: bool,
    /// What the network predicts.
    pub prediction_type: Prediction,
    /// Added to the timesteps of "leading" spacing.
    pub steps_offset: usize,
    /// Which timesteps a sampler visits; each has its own default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timestep_spacing: Option<Spacing>,
    /// Whether DDIM's last step ends at no noise at all, or at that of the
    /// first timestep.
    pub set_alpha_to_one: bool,
}

impl Default for ScheduleConfig {
    /// diffusers' defaults, but for the betas of a few classes.
    fn default() -> Self {
        Self {
            num_train_timesteps: 1000,
            beta_start: 1e-4,
            beta_end: 0.02,
            beta_schedule: BetaSchedule::Linear,
            trained_betas: None,
            rescale_betas_zero_snr: false,
            prediction_type: Prediction::Epsilon,
            steps_offset: 0,
            timestep_spacing: None,
            set_alpha_to_one: true,
        }
    }
}

/// Most timesteps of a training: a hundred times those of published models.
const MAX_TIMESTEPS: usize = 100_000;

/// Stands for "no signal" where a division by it follows, as diffusers has it.
pub(crate) const ALMOST_NO_SIGNAL: f64 = 5.960_464_477_539_063e-8; // 2^-24

/// Signal and noise by timestep.
#[derive(Debug, Clone)]
pub struct NoiseSchedule {
    config: ScheduleConfig,
    alpha_bars: Vec<f64>,
    unused: Vec<String>,
}

impl NoiseSchedule {
    /// Reads `scheduler_config.json`; the sampler that it names is ignored, unless its noise is not of variances.
    pub fn load(folder: &Path) -> Result<Self> {
        Self::load_as(folder, None)
    }

    /// As [`Self::load`]; `prediction` takes the place of what the file says of it.
    pub fn load_as(folder: &Path, prediction: Option<Prediction>) -> Result<Self> {
        let file = ConfigFile::read(&folder.join("scheduler_config.json"))?;
        let class = file.get("_class_name").and_then(Value::as_str);
        let class = class.unwrap_or_default().to_owned();
        if class::is_foreign(&class) {
            return Err(file.error(format!(
                "_class_name = \"{class}\" is not supported: its noise is not that of a schedule of betas; use a model of \
                 the Stable Diffusion 1 or 2 family, or the scheduler that this one was trained with"
            )));
        }
        let file = file.with_defaults(class::betas(&class));
        let mut config: ScheduleConfig = file.parse()?;
        config.prediction_type = prediction.unwrap_or(config.prediction_type);
        let schedule = Self::new(config).map_err(|e| match e {
            Error::Argument(message) => file.error(message),
            other => other,
        })?;
        Ok(Self {
            unused: class::unused(&file, &class),
            ..schedule
        })
    }

    /// What `scheduler_config.json` asks of its sampler and nothing here does, as keys or classes that name it.
    pub fn unused(&self) -> &[String] {
        &self.unused
    }

    /// Computes the schedule in f64. Refuses variances outside [0, 1), variances without noise that are to be rescaled, and
    /// a noise prediction where the last timestep is noise alone: it does not determine the sample.
    pub fn new(config: ScheduleConfig) -> Result<Self> {
        let betas = betas(&config)?;
        let mut alpha_bars: Vec<f64> = betas
            .iter()
            .scan(1.0, |product, beta| {
                *product *= 1.0 - beta;
                Some(*product)
            })
            .collect();
        if config.rescale_betas_zero_snr {
            if config.prediction_type == Prediction::Epsilon {
                return argument(
                    "rescale_betas_zero_snr with prediction_type = \"epsilon\": a timestep of pure noise cannot give the sample; use v_prediction",
                );
            }
            let (first, last) = (
                alpha_bars[0].sqrt(),
                alpha_bars[alpha_bars.len() - 1].sqrt(),
            );
            if first == last {
                return argument(
                    "rescale_betas_zero_snr: the last timestep has no more noise than the first; check num_train_timesteps, beta_start and beta_end",
                );
            }
            for a in &mut alpha_bars {
                *a = ((a.sqrt() - last) * first / (first - last)).powi(2);
            }
        }
        // A noisy sample is divided by the signal, in f32.
        let signal = alpha_bars[alpha_bars.len() - 1].sqrt();
        if config.prediction_type == Prediction::Epsilon && signal < f64::from(f32::MIN_POSITIVE) {
            return argument(format!(
                "the last of {} timesteps has no signal, and prediction_type = \"epsilon\" cannot give the sample there; check num_train_timesteps and the betas, or use v_prediction",
                alpha_bars.len()
            ));
        }
        Ok(Self {
            config,
            alpha_bars,
            unused: vec![],
        })
    }

    /// The configuration.
    pub fn config(&self) -> &ScheduleConfig {
        &self.config
    }

    /// Timesteps of training; valid ones are 0..len.
    pub fn len(&self) -> usize {
        self.alpha_bars.len()
    }

    /// Never true: a schedule has at least one timestep.
    pub fn is_empty(&self) -> bool {
        self.alpha_bars.is_empty()
    }

    /// What the network predicts.
    pub fn prediction(&self) -> Prediction {
        self.config.prediction_type
    }

    /// Share of the signal's variance at `t`, in [0, 1], falling with t.
    pub fn alpha_bar(&self, t: usize) -> Result<f64> {
        match self.alpha_bars.get(t) {
            Some(&a) => Ok(a),
            None => argument(format!(
                "timestep {t} is outside 0..{}",
                self.alpha_bars.len()
            )),
        }
    }

    /// (sqrt(alpha bar), sqrt(1 - alpha bar)): factors of signal and noise.
    pub fn signal_and_noise(&self, t: usize) -> Result<(f64, f64)> {
        let a = self.alpha_bar(t)?;
        Ok((a.sqrt(), (1.0 - a).sqrt()))
    }

    /// The timestep nearest to `fraction` of the schedule, 0 to 1.
    pub fn timestep_at(&self, fraction: f64) -> usize {
        let last = self.len() - 1;
        ((fraction * last as f64).round().max(0.0) as usize).min(last)
    }

    /// Noisy sample: signal * x0 + noise factor * noise.
    pub fn add_noise(&self, x0: &Tensor, noise: &Tensor, t: usize) -> Result<Tensor> {
        let (signal, sigma) = self.signal_and_noise(t)?;
        Ok(((x0 * signal)? + (noise * sigma)?)?)
    }

    /// As [`NoiseSchedule::add_noise`] with a timestep for each batch item.
    pub fn add_noise_each(
        &self,
        x0: &Tensor,
        noise: &Tensor,
        timesteps: &[usize],
    ) -> Result<Tensor> {
        self.per_item(x0, noise, timesteps, |signal, sigma| (signal, sigma))
    }

    /// The noise by which `x0` becomes `noisy` at each item's timestep: the inverse of [`Self::add_noise_each`].
    pub fn noise_between_each(
        &self,
        x0: &Tensor,
        noisy: &Tensor,
        timesteps: &[usize],
    ) -> Result<Tensor> {
        self.per_item(x0, noisy, timesteps, |signal, sigma| {
            (-signal / sigma, 1.0 / sigma)
        })
    }

    /// What the network should predict for these samples and this noise.
    pub fn target(&self, x0: &Tensor, noise: &Tensor, timesteps: &[usize]) -> Result<Tensor> {
        match self.config.prediction_type {
            Prediction::Epsilon => Ok(noise.clone()),
            Prediction::Sample => Ok(x0.clone()),
            Prediction::Velocity => {
                self.per_item(x0, noise, timesteps, |signal, sigma| (-sigma, signal))
            }
        }
    }

    /// a x0 + b noise with factors for each batch item.
    fn per_item(
        &self,
        x0: &Tensor,
        noise: &Tensor,
        timesteps: &[usize],
        factors: impl Fn(f64, f64) -> (f64, f64),
    ) -> Result<Tensor> {
        if x0.dims().first() != Some(&timesteps.len()) {
            return argument(format!(
                "{} timesteps for samples {:?}",
                timesteps.len(),
                x0.dims()
            ));
        }
        let mut shape = vec![1; x0.rank()];
        shape[0] = timesteps.len();
        let (mut a, mut b) = (vec![], vec![]);
        for &t in timesteps {
            let (signal, sigma) = self.signal_and_noise(t)?;
            let (of_x0, of_noise) = factors(signal, sigma);
            a.push(of_x0 as f32);
            b.push(of_noise as f32);
        }
        let column = |values: Vec<f32>| -> Result<Tensor> {
            Ok(Tensor::from_vec(values, shape.as_slice(), x0.device())?.to_dtype(x0.dtype())?)
        };
        Ok((x0.broadcast_mul(&column(a)?)? + noise.broadcast_mul(&column(b)?)?)?)
    }

    /// The noise that the network's `output` at `x_t` means. Finite at both
    /// ends of the schedule; a sample prediction at a timestep without noise
    /// gives 0.
    pub fn noise_of(&self, output: &Tensor, x_t: &Tensor, t: usize) -> Result<Tensor> {
        let (signal, sigma) = self.signal_and_noise(t)?;
        match self.config.prediction_type {
            Prediction::Epsilon => Ok(output.clone()),
            Prediction::Velocity => Ok(((output * signal)? + (x_t * sigma)?)?),
            Prediction::Sample if sigma == 0.0 => Ok(x_t.zeros_like()?),
            Prediction::Sample => Ok(((x_t - (output * signal)?)? / sigma)?),
        }
    }

    /// The clean sample that the network's `output` at `x_t` means.
    pub fn sample_of(&self, output: &Tensor, x_t: &Tensor, t: usize) -> Result<Tensor> {
        let (signal, sigma) = self.signal_and_noise(t)?;
        match self.config.prediction_type {
            // The constructor refuses schedules whose signal vanishes.
            Prediction::Epsilon => Ok(((x_t - (output * sigma)?)? / signal)?),
            Prediction::Velocity => Ok(((x_t * signal)? - (output * sigma)?)?),
            Prediction::Sample => Ok(output.clone()),
        }
    }
}

fn betas(config: &ScheduleConfig) -> Result<Vec<f64>> {
    let n = config.num_train_timesteps;
    if !(1..=MAX_TIMESTEPS).contains(&n) {
        return argument(format!(
            "num_train_timesteps = {n}; accepted: 1 to {MAX_TIMESTEPS}"
        ));
    }
    if config.steps_offset > n {
        return argument(format!(
            "steps_offset = {}; accepted: up to num_train_timesteps = {n}",
            config.steps_offset
        ));
    }
    let (start, end) = (config.beta_start, config.beta_end);
    let between = |a: f64, b: f64, i: usize| {
        if n == 1 {
            a
        } else {
            a + (b - a) * i as f64 / (n - 1) as f64
        }
    };
    let betas: Vec<f64> = match (&config.trained_betas, config.beta_schedule) {
        (Some(betas), _) => betas.clone(),
        (None, BetaSchedule::Linear) => (0..n).map(|i| between(start, end, i)).collect(),
        (None, BetaSchedule::ScaledLinear) => (0..n)
            .map(|i| between(start.max(0.0).sqrt(), end.max(0.0).sqrt(), i).powi(2))
            .collect(),
        (None, BetaSchedule::SquaredCosine) => {
            let alpha_bar = |t: f64| {
                ((t + 0.008) / 1.008 * std::f64::consts::FRAC_PI_2)
                    .cos()
                    .powi(2)
            };
            let at = |i: usize| alpha_bar(i as f64 / n as f64);
            // The cap keeps the last variance below 1.
            (0..n)
                .map(|i| (1.0 - at(i + 1) / at(i)).min(0.999))
                .collect()
        }
    };
    if betas.len() != n {
        return argument(format!(
            "trained_betas has {} entries, num_train_timesteps is {n}",
            betas.len()
        ));
    }
    match betas.iter().position(|b| !(0.0..1.0).contains(b)) {
        Some(i) => argument(format!(
            "noise variance {i} is {}, accepted: 0 <= beta < 1; check beta_start and beta_end",
            betas[i]
        )),
        None => Ok(betas),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    fn schedule(prediction_type: Prediction, zero_snr: bool) -> NoiseSchedule {
        NoiseSchedule::new(ScheduleConfig {
            beta_start: 0.00085,
            beta_end: 0.012,
            beta_schedule: BetaSchedule::ScaledLinear,
            rescale_betas_zero_snr: zero_snr,
            prediction_type,
            ..ScheduleConfig::default()
        })
        .expect("valid schedule")
    }

    fn vector(values: &[f32]) -> Tensor {
        Tensor::new(values, &Device::Cpu).expect("tensor")
    }

    #[test]
    fn the_target_of_every_prediction_gives_back_sample_and_noise_at_both_ends() {
        let (x0, noise) = (vector(&[0.3, -1.0, 2.0]), vector(&[1.0, 0.5, -0.25]));
        for (prediction, zero) in [
            (Prediction::Epsilon, false),
            (Prediction::Velocity, false),
            (Prediction::Velocity, true),
            (Prediction::Sample, true),
        ] {
            let schedule = schedule(prediction, zero);
            for t in [0, 500, 999] {
                let (x0, noise) = (
                    x0.unsqueeze(0).expect("x0"),
                    noise.unsqueeze(0).expect("noise"),
                );
                let x_t = schedule.add_noise(&x0, &noise, t).expect("x_t");
                let output = schedule.target(&x0, &noise, &[t]).expect("target");
                let close = |a: &Tensor, b: &Tensor, factor: f64| {
                    let d = (a - b)
                        .and_then(|d| d.abs()?.max_all()?.to_scalar::<f32>())
                        .expect("difference");
                    // A few ulp of values of 2, divided by the factor that
                    // the conversion has to undo.
                    assert!(
                        (d as f64) < 1e-6 / factor,
                        "{prediction:?} zero_snr={zero} t={t}: {d}"
                    );
                };
                let (signal, sigma) = schedule.signal_and_noise(t).expect("factors");
                let sample_factor = if prediction == Prediction::Epsilon {
                    signal
                } else {
                    1.0
                };
                let noise_factor = if prediction == Prediction::Sample {
                    sigma
                } else {
                    1.0
                };
                close(
                    &schedule.sample_of(&output, &x_t, t).expect("sample"),
                    &x0,
                    sample_factor,
                );
                close(
                    &schedule.noise_of(&output, &x_t, t).expect("noise"),
                    &noise,
                    noise_factor,
                );
            }
        }
    }

    #[test]
    fn zero_terminal_snr_ends_in_noise_alone_and_refuses_noise_prediction() {
        assert_eq!(
            schedule(Prediction::Velocity, true)
                .alpha_bar(999)
                .expect("alpha"),
            0.0
        );
        let config = ScheduleConfig {
            rescale_betas_zero_snr: true,
            ..ScheduleConfig::default()
        };
        let message = NoiseSchedule::new(config).expect_err("refused").to_string();
        assert!(message.contains("use v_prediction"), "{message}");
    }

    #[test]
    fn noise_predictions_need_a_signal_that_numbers_hold() {
        // (1 - .01)^100000 = e^-1005: the sample would be divided by 0.
        let config = ScheduleConfig {
            num_train_timesteps: 100_000,
            ..ScheduleConfig::default()
        };
        let message = NoiseSchedule::new(config.clone())
            .expect_err("refused")
            .to_string();
        assert!(
            message.contains("last of 100000 timesteps has no signal"),
            "{message}"
        );
        let config = ScheduleConfig {
            prediction_type: Prediction::Velocity,
            ..config
        };
        assert!(NoiseSchedule::new(config).is_ok());
    }

    #[test]
    fn noise_that_does_not_grow_cannot_be_rescaled_to_noise_alone() {
        let without_noise = ScheduleConfig {
            beta_start: 0.0,
            beta_end: 0.0,
            rescale_betas_zero_snr: true,
            prediction_type: Prediction::Velocity,
            ..ScheduleConfig::default()
        };
        let one_timestep = ScheduleConfig {
            num_train_timesteps: 1,
            beta_start: 0.1,
            ..without_noise.clone()
        };
        for config in [without_noise, one_timestep] {
            let message = NoiseSchedule::new(config).expect_err("refused").to_string();
            assert!(
                message.contains("no more noise than the first"),
                "{message}"
            );
        }
    }

    #[test]
    fn an_impossible_variance_is_named() {
        let config = ScheduleConfig {
            beta_end: 1.5,
            num_train_timesteps: 3,
            ..ScheduleConfig::default()
        };
        let message = NoiseSchedule::new(config).expect_err("refused").to_string();
        assert!(message.contains("noise variance 2 is 1.5"), "{message}");
    }
}
