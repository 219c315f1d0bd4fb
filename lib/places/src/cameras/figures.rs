//! How far estimated cameras are off, and how often their intervals hold.
use dipir_calibration::Posterior;
use dipir_calibration::pose::{Pose, fov_deg};
use dipir_numerics::stats::median;

/// A photograph, what was told of its camera, and its camera.
#[derive(Clone, Debug)]
pub struct Case {
    /// What it belongs to.
    pub group: String,
    /// The truth.
    pub truth: Pose,
    /// Whether the focal length was given.
    pub focal_known: bool,
    /// Errors of pitch and roll, degrees, and of the field of view, relative.
    pub off: [f64; 3],
    /// Half widths of the 90% intervals, in the same units.
    pub half: [f64; 3],
    /// Whether the intervals hold the truth.
    pub held: [bool; 3],
}

impl Case {
    /// Compares.
    pub fn new(group: &str, truth: &Pose, posterior: &Posterior, focal_known: bool) -> Self {
        let all = [
            posterior.interval(0),
            posterior.interval(1),
            posterior.fov_deg(),
        ];
        let fov = fov_deg(truth.log_focal);
        let values = [truth.pitch_deg, truth.roll_deg, fov];
        let units = [1.0, 1.0, fov];
        Self {
            group: group.into(),
            truth: *truth,
            focal_known,
            off: [0, 1, 2].map(|k| (all[k].middle - values[k]).abs() / units[k]),
            half: [0, 1, 2].map(|k| all[k].half_width() / units[k]),
            held: [0, 1, 2].map(|k| all[k].holds(values[k])),
        }
    }
}

/// Figures of some cases.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Which.
    pub name: String,
    /// How many.
    pub count: usize,
    /// Median errors: degrees, degrees, relative.
    pub median: [f64; 3],
    /// 90th percentiles of the errors.
    pub worst: [f64; 3],
    /// Median half widths of the intervals.
    pub half: [f64; 3],
    /// Shares of the intervals that hold the truth.
    pub held: [f64; 3],
}

impl Row {
    /// Of the cases for which `belongs` holds.
    pub fn of(name: &str, cases: &[Case], belongs: impl Fn(&Case) -> bool) -> Self {
        let own: Vec<&Case> = cases.iter().filter(|c| belongs(c)).collect();
        let all =
            |value: &dyn Fn(&Case) -> f64| -> Vec<f64> { own.iter().map(|c| value(c)).collect() };
        let middle = |value: &dyn Fn(&Case) -> f64| median(&all(value)).unwrap_or(f64::NAN);
        let worst = |value: &dyn Fn(&Case) -> f64| {
            let mut all = all(value);
            all.sort_by(f64::total_cmp);
            let last = all.len().saturating_sub(1) as f64;
            all.get((0.9 * last).round() as usize)
                .copied()
                .unwrap_or(f64::NAN)
        };
        let held = |k: usize| own.iter().filter(|c| c.held[k]).count() as f64;
        Self {
            name: name.into(),
            count: own.len(),
            median: [0, 1, 2].map(|k| middle(&|c| c.off[k])),
            worst: [0, 1, 2].map(|k| worst(&|c| c.off[k])),
            half: [0, 1, 2].map(|k| middle(&|c| c.half[k])),
            held: [0, 1, 2].map(|k| held(k) / own.len() as f64),
        }
    }
}

/// A table of figures in Markdown.
pub fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "| | photographs | pitch: median, 90th, held | roll | field of view |\n|---|--:|--:|--:|--:|\n",
    );
    for row in rows {
        text += &format!("| {} | {} |", row.name, row.count);
        for k in 0..3 {
            let (scale, unit) = if k == 2 { (100.0, "%") } else { (1.0, "") };
            text += &format!(
                " {:.1}{unit}, {:.1}{unit}, {:.0}% of ±{:.1}{unit} |",
                scale * row.median[k],
                scale * row.worst[k],
                100.0 * row.held[k],
                scale * row.half[k]
            );
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_of_an_even_count_lies_between_the_middle_two() {
        let case = |off: f64| Case {
            group: "place".into(),
            truth: Pose {
                pitch_deg: 0.0,
                roll_deg: 0.0,
                log_focal: 0.0,
            },
            focal_known: true,
            off: [off; 3],
            half: [2.0 * off; 3],
            held: [off < 2.5; 3],
        };
        let row = Row::of("all", &[4.0, 1.0, 3.0, 2.0].map(case), |_| true);
        assert_eq!((row.median, row.half), ([2.5; 3], [5.0; 3]));
        assert_eq!((row.worst, row.held), ([4.0; 3], [0.5; 3]));
        let none = Row::of("none", &[], |_| true);
        assert!(none.count == 0 && none.median[0].is_nan() && none.worst[0].is_nan());
    }
}
