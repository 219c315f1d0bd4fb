//! Instants, as ISO 8601 writes them.

/// An instant read from a text.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Time {
    /// Seconds since the beginning of 1970, of the universal time or, if the zone is unknown, as if
    /// the clock had shown universal time.
    pub unix_s: f64,
    /// Whether the text says by how much the clock was off universal time.
    pub zone_known: bool,
}

impl Time {
    /// Reads `2026-06-21T12:34:56+02:00`; a space for the `T`, no seconds, `Z`, and no offset are
    /// accepted. `None` if the text is not of this form or no such day exists.
    pub fn parse(text: &str) -> Option<Self> {
        let text = text.trim();
        if !text.is_ascii() {
            return None;
        }
        let (day, rest) = (text.get(..10)?, text.get(10..)?);
        let rest = rest.strip_prefix(['T', 't', ' '])?;
        let zone_at = rest.find(['Z', 'z', '+', '-']).unwrap_or(rest.len());
        let (clock, zone) = rest.split_at(zone_at);
        let day = days_since_1970(day)?;
        let offset_s = match zone {
            "" => None,
            "Z" | "z" => Some(0.0),
            _ => Some(offset_s(zone)?),
        };
        Some(Self {
            unix_s: day as f64 * 86_400.0 + clock_s(clock)? - offset_s.unwrap_or(0.0),
            zone_known: offset_s.is_some(),
        })
    }

    /// The instant, with the zone of a place `longitude_deg` east of Greenwich where none is known:
    /// whole hours nearest to the sun's own time.
    pub fn at_longitude(self, longitude_deg: f64) -> f64 {
        match self.zone_known {
            true => self.unix_s,
            false => {
                // 270 degrees east are 90 west, where it is 6 hours earlier and not 18 later.
                let east_deg = match longitude_deg > 180.0 {
                    true => longitude_deg - 360.0,
                    false => longitude_deg,
                };
                self.unix_s - 3600.0 * (east_deg / 15.0).round()
            }
        }
    }
}

fn number(text: &str, digits: usize) -> Option<u32> {
    let all = text.len() == digits && text.bytes().all(|b| b.is_ascii_digit());
    all.then(|| text.parse().ok()).flatten()
}

/// Of `yyyy-mm-dd` in the Gregorian calendar.
fn days_since_1970(day: &str) -> Option<i64> {
    let mut parts = day.split('-');
    let year = i64::from(number(parts.next()?, 4)?);
    let month = i64::from(number(parts.next()?, 2)?);
    let date = i64::from(number(parts.next()?, 2)?);
    let leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    let length = match month {
        2 => 28 + i64::from(leap),
        4 | 6 | 9 | 11 => 30,
        1..=12 => 31,
        _ => return None,
    };
    if !(1..=length).contains(&date) || parts.next().is_some() {
        return None;
    }
    // Years are counted from March, so that a leap day comes last.
    let (year, month) = match month {
        1 | 2 => (year - 1, month + 9),
        _ => (year, month - 3),
    };
    let before = 365 * year + year.div_euclid(4) - year.div_euclid(100) + year.div_euclid(400);
    // 153 days are five months from March on.
    let days = before + (153 * month + 2) / 5 + date - 1;
    Some(days - 719_468)
}

/// Of `hh:mm`, `hh:mm:ss` or `hh:mm:ss.fff`.
fn clock_s(clock: &str) -> Option<f64> {
    let mut parts = clock.split(':');
    let hours = number(parts.next()?, 2).filter(|&h| h < 24)?;
    let minutes = number(parts.next()?, 2).filter(|&m| m < 60)?;
    let seconds = match parts.next() {
        None => 0.0,
        Some(seconds) => {
            let (whole, part) = seconds.split_once('.').unwrap_or((seconds, "0"));
            let whole = number(whole, 2).filter(|&s| s <= 60)?;
            let part = number(part, part.len()).filter(|_| part.len() <= 9)?;
            f64::from(whole) + f64::from(part) / 10f64.powi(part_digits(seconds))
        }
    };
    if parts.next().is_some() {
        return None;
    }
    Some(f64::from(hours) * 3600.0 + f64::from(minutes) * 60.0 + seconds)
}

/// Digits after the point.
fn part_digits(seconds: &str) -> i32 {
    seconds
        .split_once('.')
        .map_or(1, |(_, part)| part.len() as i32)
}

/// Of `+hh:mm`, `+hhmm` or `+hh`.
fn offset_s(zone: &str) -> Option<f64> {
    let sign = match zone.get(..1)? {
        "-" => -1.0,
        _ => 1.0,
    };
    let digits = zone[1..].replace(':', "");
    let (hours, minutes) = match digits.len() {
        2 => (number(&digits, 2)?, 0),
        4 => (number(&digits[..2], 2)?, number(&digits[2..], 2)?),
        _ => return None,
    };
    (hours <= 14 && minutes < 60).then(|| sign * f64::from(3600 * hours + 60 * minutes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn unix(text: &str) -> f64 {
        Time::parse(text).unwrap().unix_s
    }

    #[test]
    fn times_of_all_forms_are_instants() {
        assert_eq!(unix("1970-01-01T00:00:00Z"), 0.0);
        assert_eq!(unix("2000-02-29 12:00Z"), 951_825_600.0);
        assert_eq!(unix("2026-06-21T12:34:56+02:00"), 1_782_038_096.0);
        assert_eq!(unix("2026-06-21T05:04:56.500-0530"), 1_782_038_096.5);
        assert_eq!(unix("1950-03-01T00:00:00Z"), -626_054_400.0);
        assert!(Time::parse("2026-06-21T12:34:56+02").unwrap().zone_known);
        let local = Time::parse("2026-06-21T12:34:56").unwrap();
        assert!(!local.zone_known);
        // The place's own zone: an hour from Greenwich at 15 degrees.
        assert_eq!(local.at_longitude(13.4), unix("2026-06-21T11:34:56Z"));
        // One place has one zone, whichever way its longitude is counted.
        assert_eq!(local.at_longitude(-90.0), unix("2026-06-21T18:34:56Z"));
        assert_eq!(local.at_longitude(270.0), local.at_longitude(-90.0));
    }

    #[test]
    fn what_is_no_time_is_refused() {
        for text in [
            "",
            "2026-06-21",
            "2026-02-29T00:00:00Z",
            "2026-13-01T00:00:00Z",
            "2026-6-21T12:00Z",
            "2026-06-21T24:00:00Z",
            "2026-06-21T12:60Z",
            "2026-06-21T12:00:00+25:00",
            "12:00",
            "2026-06-21T12:00:00 PM",
            "2026-06-21T1é:00:00Z",
        ] {
            assert_eq!(Time::parse(text), None, "{text}");
        }
    }

    proptest! {
        #[test]
        fn no_text_makes_it_panic(text in "\\PC{0,30}", digits in "[0-9T:Z+. -]{0,30}") {
            let _ = Time::parse(&text);
            let _ = Time::parse(&digits);
        }
    }
}
