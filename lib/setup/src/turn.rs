//! How the camera of a photograph is turned: what the picture shows, or a default.
use dipir_calibration::{CameraEstimate, Interval};

use crate::view::{Aim, rounded};

/// Row of the horizon where it is unknown, of the height from the top.
const DEFAULT_HORIZON: f64 = 0.4;
/// A turn that leaves less ground than this share of the height is not believed.
const LOWEST_HORIZON: f64 = 0.85;
/// Half widths of 90% intervals up to which what the picture shows is used, degrees.
const MOST_PITCH_HALF_DEG: f64 = 12.0;
const MOST_ROLL_HALF_DEG: f64 = 3.5;
/// Straight lines are named as a reason if as many agree.
const LEAST_LINES: f64 = 6.0;

/// How a camera is turned, and how sure that is.
pub(crate) struct Turn {
    /// How.
    pub(crate) aim: Aim,
    /// Where it comes from.
    pub(crate) why: String,
    /// If the picture seems to show no ground.
    pub(crate) warning: Option<String>,
}

/// From looking along -z, to a hundredth of a degree.
pub(crate) fn turned(pitch: f64, roll: f64) -> Aim {
    Aim::Turned {
        pitch_deg: rounded(pitch),
        roll_deg: rounded(roll),
    }
}

/// How the camera is turned, and why.
pub(crate) fn shown(size: [f64; 2], focal_px: f64, seen: &CameraEstimate) -> Turn {
    let row = |pitch_deg: f64| 0.5 * size[1] + focal_px * pitch_deg.to_radians().tan();
    let (pitch, roll) = (seen.pitch_deg, seen.roll_deg);
    let agreeing = seen.agreeing.upright + seen.agreeing.level;
    let lines = match agreeing >= LEAST_LINES {
        true => format!(
            "{agreeing:.0} of {} straight lines and the look",
            seen.lines
        ),
        false => "the look".into(),
    };
    let horizon = row(pitch.middle);
    if pitch.half_width() <= MOST_PITCH_HALF_DEG && horizon < LOWEST_HORIZON * size[1] {
        let sure = roll.half_width() <= MOST_ROLL_HALF_DEG;
        // Cameras are held level, unless the picture says otherwise.
        let (roll_deg, used) = match (sure, roll.holds(0.0)) {
            (false, _) => (0.0, ", which is too wide: 0 is used"),
            (true, true) => (0.0, ", which may be level: 0 is used"),
            (true, false) => (roll.middle, ""),
        };
        let why = format!(
            "from {lines} of the picture: pitch {:.1} to {:.1}, roll {:.1} to {:.1} degrees \
             (90%){used}; horizon at row {horizon:.0}; or --pitch",
            pitch.low, pitch.high, roll.low, roll.high
        );
        return Turn {
            aim: turned(pitch.middle, roll_deg),
            why,
            warning: None,
        };
    }
    default_turn(size, focal_px, pitch)
}

/// The turn where the picture does not tell it: the horizon is as near to its usual row as the interval
/// of the pitch allows, and high enough for some ground.
fn default_turn(size: [f64; 2], focal_px: f64, pitch: Interval) -> Turn {
    let pitch_of = |share: f64| {
        let tangent = (share - 0.5) * size[1] / focal_px;
        tangent.atan().to_degrees()
    };
    let most = pitch_of(LOWEST_HORIZON);
    let within = pitch_of(DEFAULT_HORIZON).clamp(pitch.low, pitch.high.max(pitch.low));
    let deg = rounded(within.min(most));
    // The whole degrees hold what is written.
    let range = format!(
        "a pitch of {:.0} to {:.0} degrees",
        pitch.low.floor(),
        pitch.high.ceil()
    );
    let no_ground =
        pitch.low > most || (pitch.half_width() <= MOST_PITCH_HALF_DEG && pitch.middle >= most);
    let why = match no_ground {
        true => format!("the picture seems to show no ground: {range} (90%)"),
        false => format!(
            "neither straight lines nor the look of the picture tell it: {range} is possible (90%)"
        ),
    };
    let share = 0.5 + focal_px * deg.to_radians().tan() / size[1];
    let horizon = match share < 0.0 {
        true => "above the picture".into(),
        false => format!(
            "at row {:.0}, {:.0}% from the top",
            share * size[1],
            100.0 * share
        ),
    };
    let so = match pitch.low > most {
        true => ", above where all of these put it, to leave some ground",
        false => "",
    };
    Turn {
        aim: turned(deg, 0.0),
        why: format!(
            "a guess, for {why}. It puts the horizon {horizon}{so}; a larger pitch_deg moves it \
             down. dipir place shows horizon and ground to set them by eye; or --pitch"
        ),
        warning: no_ground.then(|| {
            format!(
                "the picture seems to show no ground ({range}, 90%), so what stands on the ground is in a \
                 guessed place: look at it with dipir place, or give --pitch"
            )
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A picture of 600 x 400 pixels whose pitch lies in this interval, at a focal length of 600 pixels.
    fn pitched(low: f64, high: f64) -> (f64, Turn) {
        let seen = CameraEstimate {
            pitch_deg: Interval {
                low,
                middle: 0.5 * (low + high),
                high,
            },
            roll_deg: Interval {
                low: -1.0,
                middle: 0.0,
                high: 1.0,
            },
            fov_deg: Interval {
                low: 50.0,
                middle: 55.0,
                high: 60.0,
            },
            lines: 0,
            agreeing: Default::default(),
        };
        let turn = shown([600.0, 400.0], 600.0, &seen);
        let Aim::Turned { pitch_deg, .. } = turn.aim else {
            panic!("angles");
        };
        (pitch_deg, turn)
    }

    #[test]
    fn the_default_pitch_lies_in_the_interval_that_is_said() {
        // The horizon at 40% is a pitch of -3.81 degrees.
        for (low, high, pitch, said) in [
            (-20.0, 10.0, -3.81, "at row 160, 40% from the top"),
            (2.34, 30.0, 2.34, "at row 225, 56% from the top"),
            (-40.0, -7.0, -7.0, "at row 126, 32% from the top"),
            (-70.0, -40.0, -40.0, "above the picture"),
        ] {
            let (found, turn) = pitched(low, high);
            assert_eq!(found, pitch);
            assert!(turn.why.contains(said), "{}", turn.why);
            assert_eq!(turn.warning, None);
        }
        assert!(pitched(2.34, 30.0).1.why.contains("2 to 30 degrees"));
    }

    #[test]
    fn a_picture_without_ground_is_warned_of_and_gets_some() {
        // At 13.13 degrees the horizon is at 85%.
        for (low, high, pitch) in [(10.0, 20.0, 10.0), (20.0, 30.0, 13.13), (30.0, 70.0, 13.13)] {
            let (found, turn) = pitched(low, high);
            assert_eq!(found, pitch);
            let said = format!("seems to show no ground: a pitch of {low} to {high} degrees");
            assert!(turn.why.contains(&said), "{}", turn.why);
            assert_eq!(turn.why.contains("to leave some ground"), low > 13.13);
            let warning = turn.warning.unwrap();
            assert!(warning.starts_with("the picture seems to show no ground ("));
            assert!(!warning.contains('\n'));
        }
    }
}
