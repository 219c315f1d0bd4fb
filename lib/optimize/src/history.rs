//! What happened, iteration by iteration: `history.json`.
use serde::{Deserialize, Serialize};

/// One iteration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// From 0.
    pub iteration: usize,
    /// Sum of the terms; `null` in a step that was skipped because something was not finite.
    pub loss: Option<f64>,
    /// Loss of the guidance.
    pub guidance: Option<f64>,
    /// Consistency of both maps, weighted.
    pub consistency: Option<f64>,
    /// Cauchy regulariser on the shadow's map, weighted.
    pub regularizer: Option<f64>,
    /// Euclidean norm of the gradient of all parameters.
    pub gradient_norm: Option<f64>,
    /// Timestep of the diffusion model, as a share of all.
    pub t: Option<f64>,
    /// How far both maps are fused, 0 to 1.
    pub fusion: f32,
    /// Factor on every learning rate.
    pub rate: f64,
    /// What was not finite, if the step was skipped.
    pub skipped: Option<String>,
    /// Whether the transport was recorded anew before this iteration.
    pub recorded: bool,
    /// Wall time of the iteration. All else is the same in every run, this is not.
    pub seconds: f64,
}

/// Whether the loss stands still: over the last `patience` rows the mean of the guidance's loss is
/// not at least a thousandth below that of the `patience` rows before. Both windows have to lie at
/// or beyond row `from`. Never for a patience of 0.
pub fn stands_still(history: &[Row], patience: usize, from: usize) -> bool {
    if patience == 0 || history.len() < from + 2 * patience {
        return false;
    }
    let mean = |rows: &[Row]| {
        let losses: Vec<f64> = rows.iter().filter_map(|r| r.guidance).collect();
        losses.iter().sum::<f64>() / losses.len() as f64
    };
    let (before, last) = history[history.len() - 2 * patience..].split_at(patience);
    let (before, last) = (mean(before), mean(last));
    // Comparisons with NaN, the mean of nothing, are false: no reason to stop.
    last > before * (1.0 - 1e-3)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(losses: impl Iterator<Item = f64>) -> Vec<Row> {
        let row = |(iteration, loss)| Row {
            iteration,
            loss: Some(loss),
            guidance: Some(loss),
            consistency: None,
            regularizer: None,
            gradient_norm: None,
            t: None,
            fusion: 1.0,
            rate: 1.0,
            skipped: None,
            recorded: false,
            seconds: 0.1,
        };
        losses.enumerate().map(row).collect()
    }

    #[test]
    fn a_falling_loss_goes_on_a_flat_one_stops_and_patience_zero_never_does() {
        let falling = rows((0..100).map(|k| 0.99f64.powi(k)));
        let flat = rows((0..100).map(|_| 0.5));
        assert!(!stands_still(&falling, 20, 0));
        assert!(stands_still(&flat, 20, 0));
        assert!(!stands_still(&flat, 0, 0));
        assert!(
            !stands_still(&flat, 20, 61),
            "the windows reach back before row 61"
        );
        assert!(!stands_still(&flat[..39], 20, 0));
    }
}
