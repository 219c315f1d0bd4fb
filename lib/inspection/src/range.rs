//! The range of many values.
use dipir_numerics::sum::sum_f32;
use serde_json::{Value, json};

use crate::report::number;

/// Least, mean and largest of the finite values, and how many are not finite.
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
    /// The range of `values`; all 0 if none is finite.
    pub fn of(values: &[f32]) -> Self {
        let finite: Vec<f32> = values.iter().copied().filter(|v| v.is_finite()).collect();
        let nan = values.iter().filter(|v| v.is_nan()).count();
        let infinite = values.len() - finite.len() - nan;
        let fold = |f: fn(f32, f32) -> f32| finite.iter().copied().reduce(f).unwrap_or(0.0);
        Self {
            min: fold(f32::min).into(),
            mean: sum_f32(&finite) / finite.len().max(1) as f64,
            max: fold(f32::max).into(),
            nan,
            infinite,
        }
    }

    /// The range for programs.
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
        [
            number(self.min),
            number(self.mean),
            number(self.max),
            strange,
        ]
    }
}
