//! Curves of the report, from the rows of a history.
use dipir_plotting::chart::{Chart, Mark, Panel, Scale, Series};
use serde_json::Value;

/// Width and height of a plot without its labels, pixels.
const SIZE: [f32; 2] = [560.0, 228.0];

/// A chart over `x_label`; its vertical axis is logarithmic if `log_y`.
pub fn over(x_label: &str, log_y: bool, series: Vec<Series>) -> Chart {
    Chart {
        x: Scale {
            label: x_label.into(),
            ..Scale::default()
        },
        y: Scale {
            log: log_y,
            ..Scale::default()
        },
        size: SIZE,
        panels: vec![Panel {
            series,
            ..Panel::default()
        }],
    }
}

/// `key` over `x` of every row where both are numbers.
pub fn column(history: &[Value], x: &str, key: &str, name: &str, color: usize) -> Series {
    let at = |row: &Value| Some((row[x].as_f64()?, row[key].as_f64()?));
    Series::line(name, color, history.iter().filter_map(at))
}

/// The values of a noisy quantity, pale, and their running mean: wide enough to show a trend
/// through the noise, narrow against the run.
pub fn noisy(history: &[Value], x: &str, key: &str, name: &str, color: usize) -> [Series; 2] {
    let window = (history.len() / 20).max(1);
    let raw = Series {
        mark: Mark::Faint,
        ..column(history, x, key, "", color)
    };
    let mut mean = raw.running_mean(window);
    if !name.is_empty() {
        mean.name = format!("{name}, {}", mean.name);
    }
    [raw, mean]
}
