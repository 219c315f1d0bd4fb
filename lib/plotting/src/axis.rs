//! From values to places along an axis, and which values are labelled.

/// What an axis shows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scale {
    /// Written beside the axis.
    pub label: String,
    /// Whether it is logarithmic; values that are not positive are left out.
    pub log: bool,
    /// The values at its ends, else those of the data.
    pub range: Option<(f64, f64)>,
}

impl Scale {
    /// Whether the axis has a place for `value`.
    pub(crate) fn shows(&self, value: f64) -> bool {
        value.is_finite() && (!self.log || value > 0.0)
    }
}

/// Values to places along an axis.
pub(crate) struct Axis {
    pub(crate) low: f64,
    pub(crate) high: f64,
    log: bool,
    pub(crate) from: f32,
    pub(crate) to: f32,
}

impl Axis {
    /// An axis from `from` to `to` for `values`, with some room around them if `padded`.
    pub(crate) fn new(
        scale: &Scale,
        values: impl Iterator<Item = f64>,
        padded: bool,
        (from, to): (f32, f32),
    ) -> Self {
        let empty = (f64::INFINITY, f64::NEG_INFINITY);
        let found = values
            .filter(|v| scale.shows(*v))
            .fold(empty, |(l, h), v| (l.min(v), h.max(v)));
        let found = match found.0 <= found.1 {
            true => found,
            false => (0.1, 1.0),
        };
        let (low, high) = scale
            .range
            .unwrap_or_else(|| with_room(found, scale.log, padded));
        let log = scale.log;
        Self {
            low,
            high,
            log,
            from,
            to,
        }
    }

    /// The place of a value.
    pub(crate) fn at(&self, value: f64) -> f32 {
        let map = |v: f64| if self.log { v.ln() } else { v };
        let share = (map(value) - map(self.low)) / (map(self.high) - map(self.low));
        self.from + share as f32 * (self.to - self.from)
    }

    /// Round values, about five; on a logarithmic axis powers of ten, with their doubles and
    /// fivefolds where there are few.
    pub(crate) fn ticks(&self) -> Vec<f64> {
        if self.log {
            let ticks = self.log_ticks();
            if ticks.len() >= 2 {
                return ticks;
            }
        }
        let step = round_up((self.high - self.low) / 5.0);
        let first = (self.low / step).ceil() as i64;
        (first..first + 20)
            .map(|k| k as f64 * step)
            .take_while(|v| *v <= self.high + 1e-9 * step)
            .collect()
    }

    fn log_ticks(&self) -> Vec<f64> {
        let (first, last) = (
            self.low.log10().floor() as i32,
            self.high.log10().ceil() as i32,
        );
        let decades = (self.high / self.low).log10();
        let factors: &[f64] = if decades > 2.5 {
            &[1.0]
        } else {
            &[1.0, 2.0, 5.0]
        };
        let every = (decades / 6.0).ceil().max(1.0) as i32;
        (first..=last)
            .filter(|e| e.rem_euclid(every) == 0)
            .flat_map(|e| factors.iter().map(move |f| f * 10f64.powi(e)))
            .filter(|v| (self.low * (1.0 - 1e-9)..=self.high * (1.0 + 1e-9)).contains(v))
            .collect()
    }
}

/// A range that is never empty.
fn with_room((low, high): (f64, f64), log: bool, padded: bool) -> (f64, f64) {
    match (log, padded) {
        (true, true) => (low / 1.25, high * 1.25),
        (true, false) if high > low * 1.001 => (low, high),
        (true, false) => (low * 0.5, high * 2.0),
        (false, _) if high - low <= 1e-12 * high.abs().max(1e-12) => {
            // Beyond 1e16 a half is lost.
            let room = (1e-3 * high.abs()).max(0.5);
            (low - room, high + room)
        }
        (false, true) => (low - 0.05 * (high - low), high + 0.05 * (high - low)),
        (false, false) => (low, high),
    }
}

/// The smallest of 1, 2, 5 times a power of ten that is not below `step`.
fn round_up(step: f64) -> f64 {
    let power = 10f64.powf(step.log10().floor());
    let factors = [1.0, 2.0, 5.0];
    let factor = factors
        .into_iter()
        .find(|f| f * power >= step * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * power
}

/// A number with about three digits.
pub fn number(value: f64) -> String {
    let size = value.abs();
    if value == 0.0 {
        return "0".into();
    }
    if !(1e-3..1e5).contains(&size) {
        return format!("{value:.2e}").replace(".00e", "e");
    }
    let digits = (2 - size.log10().floor() as i32).clamp(0, 5) as usize;
    let text = format!("{value:.digits$}");
    match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').into(),
        false => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ticks(log: bool, values: [f64; 2]) -> Vec<String> {
        let scale = Scale {
            log,
            ..Scale::default()
        };
        let axis = Axis::new(&scale, values.into_iter(), false, (0.0, 1.0));
        axis.ticks().into_iter().map(number).collect()
    }

    #[test]
    fn ticks_are_round_and_few() {
        assert_eq!(
            ticks(false, [0.0, 1.0]),
            ["0", "0.2", "0.4", "0.6", "0.8", "1"]
        );
        assert_eq!(ticks(true, [0.1, 1.0]), ["0.1", "0.2", "0.5", "1"]);
        assert_eq!(
            ticks(true, [1e-3, 10.0]),
            ["0.001", "0.01", "0.1", "1", "10"]
        );
        assert!(ticks(true, [1e-12, 1e12]).len() <= 7);
        // Too narrow for any power of ten.
        assert_eq!(
            ticks(true, [3.0, 4.0]),
            ["3", "3.2", "3.4", "3.6", "3.8", "4"]
        );
    }

    #[test]
    fn the_ends_of_the_range_are_the_ends_of_the_axis() {
        for log in [false, true] {
            let scale = Scale {
                log,
                ..Scale::default()
            };
            let values = [0.5, f64::NAN, 8.0, f64::INFINITY];
            let axis = Axis::new(&scale, values.into_iter(), false, (10.0, 90.0));
            assert_eq!((axis.at(0.5), axis.at(8.0)), (10.0, 90.0));
        }
    }

    #[test]
    fn a_single_value_has_a_range_around_it() {
        for (log, padded) in [(false, false), (true, false), (true, true), (false, true)] {
            for value in [2.0, 1e18] {
                let (low, high) = with_room((value, value), log, padded);
                assert!(low < value && value < high);
            }
        }
        assert!(ticks(false, [-1e18, -1e18]).len() > 1);
    }

    #[test]
    fn numbers_are_short() {
        let shown: Vec<_> = [0.0, 1.0, 0.25, 1234.0, 12.345, 1e-7, 2.5e6, -0.5]
            .into_iter()
            .map(number)
            .collect();
        assert_eq!(
            shown,
            ["0", "1", "0.25", "1234", "12.3", "1e-7", "2.50e6", "-0.5"]
        );
    }
}
