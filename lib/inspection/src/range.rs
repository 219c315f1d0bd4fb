//! The range of many values.
use dipir_numerics::sum::Neumaier;
use serde_json::{Value, json};

use crate::report::number;

/// Least, mean and largest of the finite values, NaN without any, and how many are not finite.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// Least finite value.
    pub min: f64,
    /// Mean of the finite values.
    pub mean: f64,
    /// Largest finite value.
    pub max: f64,
    /// Values that are not numbers.
    pub nan: usize,
    /// Infinite values.
    pub infinite: usize,
}

impl Range {
    /// The range of `values`.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Self {
        let (mut min, mut max) = (f64::INFINITY, f64::NEG_INFINITY);
        let (mut finite, mut nan, mut infinite) = (0usize, 0, 0);
        let mut mean = Neumaier::default();
        for value in values {
            match value {
                v if v.is_nan() => nan += 1,
                v if v.is_infinite() => infinite += 1,
                v => {
                    (min, max) = (min.min(v), max.max(v));
                    mean.add(v);
                    finite += 1;
                }
            }
        }
        let known = |value: f64| if finite > 0 { value } else { f64::NAN };
        Self {
            min: known(min),
            mean: mean.total() / finite as f64,
            max: known(max),
            nan,
            infinite,
        }
    }

    /// The range for programs; null without a finite value.
    pub fn to_json(self) -> Value {
        json!({
            "min": self.min, "mean": self.mean, "max": self.max,
            "nan": self.nan, "infinite": self.infinite,
        })
    }

    /// Cells of a table: least, mean, largest, and how many values are not finite.
    pub fn cells(self) -> [String; 4] {
        let strange = match (self.nan, self.infinite) {
            (0, 0) => String::new(),
            (n, 0) => format!("{n} NaN"),
            (0, i) => format!("{i} infinite"),
            (n, i) => format!("{n} NaN, {i} infinite"),
        };
        let cell = |value: f64| match value.is_nan() {
            true => "-".into(),
            false => number(value),
        };
        [cell(self.min), cell(self.mean), cell(self.max), strange]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_beyond_single_precision_keep_their_size() {
        let range = Range::of([1e300, -1e-300, f64::INFINITY, f64::NAN]);
        assert_eq!((range.min, range.max), (-1e-300, 1e300));
        assert_eq!((range.mean, range.nan, range.infinite), (5e299, 1, 1));
        // One that single precision would round to 1.
        assert_eq!(Range::of([1.0 + 1e-12]).mean, 1.0 + 1e-12);
    }

    #[test]
    fn without_a_finite_value_there_is_no_range() {
        let range = Range::of([f64::NAN, f64::NEG_INFINITY]);
        assert_eq!(range.cells(), ["-", "-", "-", "1 NaN, 1 infinite"]);
        assert_eq!(range.to_json()["min"], Value::Null);
        assert_eq!(Range::of([]).cells(), ["-", "-", "-", ""]);
    }
}
