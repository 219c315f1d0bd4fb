//! What reports say of a score.
use crate::score::Score;

/// A number of a score.
pub struct Metric {
    /// In tables.
    pub name: &'static str,
    /// Explains it, for the page.
    pub about: &'static str,
    /// Decimal places.
    pub digits: usize,
    /// Its value, if the score has it.
    pub of: fn(&Score) -> Option<f64>,
}

/// All of them, in the order of tables.
pub static METRICS: [Metric; 9] = [
    Metric {
        name: "RMSE",
        about: "display-referred, all pixels; less is better",
        digits: 4,
        of: |s| s.picture.map(|p| p.rmse),
    },
    Metric {
        name: "RMSE touched",
        about: "the same, over what object or shadow touch",
        digits: 4,
        of: |s| s.picture.map(|p| p.rmse_touched),
    },
    Metric {
        name: "SSIM",
        about: "structural similarity, all pixels; more is better",
        digits: 4,
        of: |s| s.picture.map(|p| p.ssim),
    },
    Metric {
        name: "si-RMSE",
        about: "RMSE after the best scale, all pixels",
        digits: 4,
        of: |s| s.picture.map(|p| p.si_rmse),
    },
    Metric {
        name: "si-RMSE object",
        about: "the same, over the object alone",
        digits: 4,
        of: |s| s.picture.map(|p| p.si_rmse_object),
    },
    Metric {
        name: "LPIPS",
        about: "learned perceptual distance with AlexNet, all pixels; less is better",
        digits: 4,
        of: |s| s.lpips,
    },
    Metric {
        name: "peak, degrees",
        about: "between the directions of most light",
        digits: 1,
        of: |s| s.light.and_then(|l| l.peak_deg),
    },
    Metric {
        name: "mean, degrees",
        about: "between the mean directions that light comes from",
        digits: 1,
        of: |s| s.light.and_then(|l| l.mean_deg),
    },
    Metric {
        name: "seconds",
        about: "of all stages of one scene; a stage that methods share counts in the one that ran first, so seconds do not compare methods",
        digits: 1,
        // The sum of no number is -0.
        of: |s| Some(s.seconds.iter().map(|(_, t)| t).sum::<f64>() + 0.0),
    },
];

/// What a run took: "seconds".
pub static SECONDS: &Metric = &METRICS[8];

/// The metric by which methods are compared: "RMSE touched".
pub static COMPARED: &Metric = &METRICS[1];
