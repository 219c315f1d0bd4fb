//! Many numbers as few: medians with bootstrap intervals.
use dipir_numerics::stats::{bootstrap_median_interval, median};
use serde::{Deserialize, Serialize};

/// Resamples of every bootstrap: the ends of a 95% interval move by about a thousandth of its width
/// from one seed to another.
const RESAMPLES: u32 = 4000;
/// Confidence of every interval.
const LEVEL: f64 = 0.95;

/// A sample in five numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Values.
    pub count: usize,
    /// Their median.
    pub median: f64,
    /// Lower end of the median's 95% bootstrap interval; `None` of one value, which says nothing of how others would differ.
    pub low: Option<f64>,
    /// Its upper end.
    pub high: Option<f64>,
    /// Their mean.
    pub mean: f64,
}

impl Summary {
    /// The summary of the values that are finite; `None` if none is.
    pub fn of(values: &[f64], seed: u64) -> Option<Self> {
        let values: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
        let (low, high) = bootstrap_median_interval(&values, LEVEL, RESAMPLES, seed)?;
        let known = |end: f64| (values.len() > 1).then_some(end);
        Some(Self {
            count: values.len(),
            median: median(&values)?,
            low: known(low),
            high: known(high),
            mean: values.iter().sum::<f64>() / values.len() as f64,
        })
    }

    /// `0.0123 (0.0101 to 0.0150)`; `0.0123 (no interval)` of one value.
    pub fn text(&self, digits: usize) -> String {
        let median = self.median;
        match self.low.zip(self.high) {
            Some((low, high)) => format!("{median:.digits$} ({low:.digits$} to {high:.digits$})"),
            None => format!("{median:.digits$} (no interval)"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_summary_leaves_out_what_is_not_a_number() {
        let s = Summary::of(&[1.0, f64::NAN, 3.0, 2.0, f64::INFINITY], 1).unwrap();
        assert_eq!((s.count, s.median, s.mean), (3, 2.0, 2.0));
        let (low, high) = s.low.zip(s.high).unwrap();
        assert!(low >= 1.0 && high <= 3.0 && low <= high);
        assert_eq!(Summary::of(&[f64::NAN], 1), None);
        assert_eq!(s.text(1), "2.0 (1.0 to 3.0)");
    }

    #[test]
    fn one_value_has_no_interval() {
        let s = Summary::of(&[0.25], 1).unwrap();
        assert_eq!(
            (s.low, s.high, s.text(2).as_str()),
            (None, None, "0.25 (no interval)")
        );
    }
}
