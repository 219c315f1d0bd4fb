//! An estimated light in words, with how sure it is.
use dipir_estimator::posterior::side;
use dipir_estimator::{Interval, LightEstimate};

use super::estimate::DrawnShadow;

/// A quantity of the light, its middle and its 80% interval in numbers, and the interval in words.
pub(crate) struct Quantity {
    /// What it is.
    pub(crate) name: &'static str,
    /// Its median, with the unit.
    pub(crate) middle: String,
    /// What holds the truth in four of five photographs.
    pub(crate) interval: String,
    /// The same in words.
    pub(crate) words: String,
}

/// An estimate in a sentence.
pub(super) fn in_words(estimate: &LightEstimate) -> String {
    let [azimuth, elevation, exposure, share] = quantities(estimate).map(|q| q.words);
    format!(
        "estimated: most light {}; in four of five such photographs it comes from {azimuth}, {elevation}; the mean light \
         is {exposure}, its strongest source {share}; a sun with a probability of {}",
        estimate.words,
        percent(estimate.sun_probability)
    )
}

/// Whether a sun is more probable than none, but its direction is not known well enough for a sharp shadow.
pub(super) fn is_unplaced_sun(estimate: &LightEstimate) -> bool {
    estimate.sun_probability >= 0.5 && estimate.source.is_none()
}

/// What a shadow could still tell of the sun, as the first of several ways; empty if nothing.
pub(super) fn of_shadow(drawn: DrawnShadow) -> &'static str {
    match drawn {
        DrawnShadow::None => "draw one (light.shadow), ",
        DrawnShadow::WithoutHeight => {
            "say how tall what casts the drawn one is (light.shadow.height_m), "
        }
        DrawnShadow::WithHeight => "",
    }
}

/// Azimuth, elevation, exposure and share.
pub(crate) fn quantities(estimate: &LightEstimate) -> [Quantity; 4] {
    let (azimuth, elevation) = (&estimate.azimuth_deg, &estimate.elevation_deg);
    let (exposure, share) = (&estimate.exposure_stops, &estimate.share);
    let quantity = |name, i: &Interval, show: &dyn Fn(f64) -> String, words| Quantity {
        name,
        middle: show(i.middle),
        interval: format!("{} to {}", show(i.low), show(i.high)),
        words,
    };
    let degrees = |deg: f64| format!("{deg:.0}°");
    let times = |stops: f64| format!("{:.2}", stops.exp2());
    [
        quantity(
            "azimuth, to the right of the view",
            azimuth,
            &degrees,
            sides(azimuth),
        ),
        quantity("elevation", elevation, &degrees, heights(elevation)),
        quantity(
            "exposure: mean light over the photograph's mean",
            exposure,
            &|stops| format!("{stops:+.1} stops"),
            format!(
                "{} to {} times as bright as the photograph's mean",
                times(exposure.low),
                times(exposure.high)
            ),
        ),
        quantity(
            "share of the strongest source",
            share,
            &percent,
            format!(
                "{} to {} of all light",
                percent(share.low),
                percent(share.high)
            ),
        ),
    ]
}

/// A share or a probability in percent. What is possible is not called 0%, nor what is not certain 100%.
pub(crate) fn percent(share: f64) -> String {
    match (100.0 * share).round() {
        0.0 if share > 0.0 => "under 1%".into(),
        100.0 if share < 1.0 => "over 99%".into(),
        percent => format!("{percent:.0}%"),
    }
}

/// The elevations of an interval.
fn heights(i: &Interval) -> String {
    // Without the sign of a zero.
    let (low, high) = (i.low.round() + 0.0, i.high.round() + 0.0);
    let below = |deg: f64| format!("{} degrees below the horizon", -deg);
    match (low < 0.0, high < 0.0) {
        (true, true) => format!("{} to {}", -low, below(high)),
        (true, false) => format!("{} to {high} degrees high", below(low)),
        (false, _) => format!("{low} to {high} degrees high"),
    }
}

/// The sides of an arc.
fn sides(arc: &Interval) -> String {
    let (low, middle, high) = (side(arc.low), side(arc.middle), side(arc.high));
    if arc.high - arc.low >= 359.5 {
        return "any side".into();
    }
    if arc.high - arc.low > 180.0 {
        return format!("any side but {}", side(arc.middle + 180.0));
    }
    match (low == middle, high == middle) {
        (true, true) => middle,
        (true, false) | (false, true) => format!("{low} to {high}"),
        (false, false) => format!("{low} to {high}, through {middle}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heights_below_the_horizon_are_said_to_be() {
        for (low, high, wanted) in [
            (11.2, 70.6, "11 to 71 degrees high"),
            (-7.8, 34.0, "8 degrees below the horizon to 34 degrees high"),
            (-20.0, -5.0, "20 to 5 degrees below the horizon"),
        ] {
            assert_eq!(heights(&Interval::new(low, low, high)), wanted);
        }
    }

    #[test]
    fn what_is_possible_is_not_called_impossible() {
        let shown = [0.0, 0.004, 0.006, 0.5, 0.994, 0.996, 1.0].map(percent);
        let wanted = ["0%", "under 1%", "1%", "50%", "99%", "over 99%", "100%"];
        assert_eq!(shown, wanted);
    }

    #[test]
    fn a_shadow_that_was_drawn_is_not_asked_for_again() {
        assert!(of_shadow(DrawnShadow::None).starts_with("draw one"));
        let known = |height_m| DrawnShadow::of(Some(height_m));
        assert!(of_shadow(known(None)).contains("light.shadow.height_m"));
        assert_eq!(of_shadow(known(Some(1.8))), "");
    }

    #[test]
    fn arcs_are_said_by_their_sides() {
        for (low, high, wanted) in [
            (-20.0, 15.0, "ahead"),
            (10.0, 60.0, "ahead to ahead on the right"),
            (
                -60.0,
                60.0,
                "ahead on the left to ahead on the right, through ahead",
            ),
            // Across the back: 190 degrees are 170 to the left.
            (
                100.0,
                235.0,
                "the right to behind on the left, through behind",
            ),
            (-135.0, 135.0, "any side but behind"),
            (-45.0, 225.0, "any side but the left"),
            (-180.0, 180.0, "any side"),
        ] {
            let arc = Interval::new(low, 0.5 * (low + high), high);
            assert_eq!(sides(&arc), wanted, "{low} to {high}");
        }
    }
}
