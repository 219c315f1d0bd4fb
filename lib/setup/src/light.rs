//! The `[light]` table: the light is estimated from the photograph and from what its file holds of the sun.
use dipir_imaging::facts::Facts;
use dipir_sun::table::{SunTable, Taken};
use glam::DVec3;

use crate::document::{number, printable, quoted};

/// Columns of a comment.
const COLUMNS: usize = 100;

/// Where the middle of the sun stands when it sets, degrees: the air bends its light, and its upper edge sets last.
const SUNSET_DEG: f64 = -0.833;

/// What the photograph's file says of the sun.
struct Told<'a> {
    time: Option<&'a str>,
    /// Latitude and longitude, degrees.
    place: Option<[f64; 2]>,
    /// Degrees from north, and which north.
    heading: Option<(f64, &'static str)>,
}

impl<'a> Told<'a> {
    fn of(facts: &'a Facts) -> Self {
        let place = facts.latitude_deg.zip(facts.longitude_deg);
        Self {
            time: facts.time.as_deref(),
            place: place.map(<[f64; 2]>::from),
            heading: facts.heading.map(|h| {
                let north = if h.magnetic { "magnetic" } else { "true" };
                (h.deg, north)
            }),
        }
    }

    /// What is there: `the time 2026-06-21T12:34:56 and the place`.
    fn known(&self) -> Vec<String> {
        let time = self.time.map(|t| format!("the time {}", printable(t)));
        let place = self.place.map(|_| "the place".into());
        let heading = self
            .heading
            .map(|(deg, north)| format!("the heading, {deg:.0} degrees from {north} north"));
        [time, place, heading].into_iter().flatten().collect()
    }

    /// Where the sun was by time and place, if that is below the horizon.
    fn below_horizon(&self) -> Option<String> {
        let [latitude, longitude] = self.place?;
        let taken = Taken {
            time: self.time.map(Into::into),
            latitude_deg: Some(latitude),
            longitude_deg: Some(longitude),
            ..Taken::default()
        };
        // Without a heading the elevation alone follows, and no way of looking matters.
        let known = SunTable::default().resolve("light.sun", &taken, DVec3::NEG_Z);
        let sun = known.ok()?.elevation.filter(|e| e.deg < SUNSET_DEG)?;
        let unsure = match sun.sigma_deg >= 0.5 {
            true => format!(
                " (give or take {:.0}, for the time has no zone)",
                sun.sigma_deg
            ),
            false => String::new(),
        };
        let count = format!("{:.0}", -sun.deg);
        let unit = if count == "1" { "degree" } else { "degrees" };
        Some(format!(
            "By time and place the sun was {count} {unit} below the horizon{unsure} and lights nothing: it was night, or the \
             camera's clock is wrong. If it is, write the time:"
        ))
    }

    /// What follows of the sun, and how to say more.
    fn consequence(&self) -> &'static str {
        match (
            self.time.is_some(),
            self.place.is_some(),
            self.heading.is_some(),
        ) {
            (true, true, true) => "The sun is taken from them; to say otherwise:",
            (true, true, false) => {
                "They give how high the sun stands; without a heading nothing follows of its direction: write \
                 heading_deg, where the camera looked, clockwise from north (180.0 is an example):"
            }
            (true, false, _) => {
                "Without a place nothing follows of the sun: write latitude and longitude (these are examples):"
            }
            (false, true, _) => {
                "Without a time nothing follows of the sun: write time (this is an example):"
            }
            (false, false, _) => {
                "Without time and place nothing follows of the sun: write time, latitude and longitude (these are \
                 examples):"
            }
        }
    }

    /// What is known and examples of what is missing, as keys of `sun`.
    fn keys(&self) -> String {
        let time = self.time.unwrap_or("2026-06-21T12:00:00+02:00");
        let [latitude, longitude] = self.place.unwrap_or([48.14, 11.58]);
        let mut keys = format!(
            "time = {}, latitude = {}, longitude = {}",
            quoted(time),
            number(latitude, 5),
            number(longitude, 5)
        );
        let by_default = (self.time.is_some() && self.place.is_some()).then_some(180.0);
        if let Some(deg) = self.heading.map(|h| h.0).or(by_default) {
            keys += &format!(", heading_deg = {}", number(deg, 1));
        }
        keys
    }
}

/// The comment that stands for the table, and shows how to write it.
pub(crate) fn light(facts: &Facts) -> String {
    let told = Told::of(facts);
    let known = told.known();
    let (words, keys) = match &known[..] {
        [] => (
            "The light is estimated from the photograph, whose file says nothing of time and place. Who knows \
             where the sun was says so:"
                .into(),
            "azimuth_deg = 90.0, elevation_deg = 40.0".into(),
        ),
        known => (
            format!(
                "The light is estimated from the photograph. Its file says {}. {}",
                listed(known),
                told.below_horizon()
                    .unwrap_or_else(|| told.consequence().into())
            ),
            told.keys(),
        ),
    };
    format!("{}# [light]\n# sun = {{ {keys} }}\n", comment(&words))
}

/// `a, b and c`.
fn listed(words: &[String]) -> String {
    match words {
        [] => String::new(),
        [one] => one.clone(),
        [first @ .., last] => format!("{} and {last}", first.join(", ")),
    }
}

/// Lines of a comment.
pub(crate) fn comment(words: &str) -> String {
    let mut text = String::new();
    let mut line = String::from("#");
    for word in words.split_whitespace() {
        if line.len() > 1 && line.len() + 1 + word.len() > COLUMNS {
            text += &line;
            text.push('\n');
            line = "#".into();
        }
        line.push(' ');
        line += word;
    }
    text + &line + "\n"
}

#[cfg(test)]
mod tests {
    use dipir_imaging::facts::Heading;

    use super::*;

    /// The comment in one line, of a file with a time, a place and a heading, where these are given.
    fn said(time: Option<&str>, place: Option<[f64; 2]>, heading: bool) -> String {
        let facts = Facts {
            time: time.map(Into::into),
            latitude_deg: place.map(|p| p[0]),
            longitude_deg: place.map(|p| p[1]),
            heading: heading.then_some(Heading {
                deg: 213.4,
                magnetic: true,
            }),
            ..Facts::of_size([900, 600])
        };
        light(&facts).replace("\n# ", " ")
    }

    const TIME: Option<&str> = Some("2026-06-21T12:34:56+02:00");
    const PLACE: Option<[f64; 2]> = Some([48.1, -11.5]);

    #[test]
    fn what_is_missing_for_the_sun_is_said() {
        for (text, part) in [
            (
                said(TIME, PLACE, true),
                "says the time 2026-06-21T12:34:56+02:00, the place and the heading, 213 degrees from \
                 magnetic north. The sun is taken from them",
            ),
            (
                said(TIME, PLACE, false),
                "without a heading nothing follows of its direction: write heading_deg",
            ),
            (
                said(TIME, None, false),
                "Its file says the time 2026-06-21T12:34:56+02:00. Without a place nothing follows of the sun: \
                 write latitude and longitude",
            ),
            (said(TIME, None, true), "Without a place nothing follows"),
            (
                said(None, PLACE, false),
                "Its file says the place. Without a time nothing follows of the sun: write time",
            ),
            (
                said(None, None, true),
                "Without time and place nothing follows",
            ),
            (said(None, None, false), "nothing of time and place"),
        ] {
            assert!(text.contains(part), "{part}: {text}");
            assert!(!text.contains("are used"), "{text}");
        }
    }

    #[test]
    fn a_sun_below_the_horizon_is_said() {
        // The sun's midnight is 46 minutes after that of Greenwich, and 2 for the equation of time: it is 90 - 48.1 - 23.4
        // degrees below.
        let night = said(Some("2026-06-21T02:48:00+02:00"), PLACE, true);
        let told = "By time and place the sun was 18 degrees below the horizon and lights nothing: it was night, or the \
                    camera's clock is wrong. If it is, write the time: ";
        assert!(night.contains(told), "{night}");
        assert!(!night.contains("is taken from them"), "{night}");
        assert!(night.contains("sun = { time = "), "{night}");
        let unsure = said(Some("2026-06-21T00:48:00"), PLACE, false);
        let part = "below the horizon (give or take ";
        assert!(
            unsure.contains(part) && unsure.contains(", for the time has no zone)"),
            "{unsure}"
        );
        for known in [
            said(TIME, PLACE, true),
            said(TIME, None, true),
            said(Some("night"), PLACE, true),
        ] {
            assert!(!known.contains("below"), "{known}");
        }
    }

    #[test]
    fn a_place_on_the_equator_or_on_the_meridian_of_greenwich_is_a_place() {
        for place in [[0.0, 9.5], [51.5, 0.0]] {
            assert!(said(TIME, Some(place), true).contains("the place"));
        }
    }

    #[test]
    fn comments_are_wrapped() {
        let text = comment(&"word ".repeat(50));
        assert!(
            text.lines()
                .all(|l| l.starts_with("# word") && l.len() <= COLUMNS)
        );
        assert_eq!(text.matches("word").count(), 50);
    }
}
