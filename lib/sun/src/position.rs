//! The sun's position in the sky, from time and place.

/// A position in the sky.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Position {
    /// Degrees clockwise from true north, in `[0, 360)`.
    pub azimuth_deg: f64,
    /// Degrees above the horizon, without the atmosphere's refraction.
    pub elevation_deg: f64,
}

/// Largest error of [`position`] between 1950 and 2080, degrees.
pub const ERROR_DEG: f64 = 0.02;

/// Where the sun's centre is, `unix_s` seconds of universal time after the beginning of 1970, seen
/// from `latitude_deg` north and `longitude_deg` east.
///
/// The sun's apparent place of low accuracy and the apparent sidereal time of Greenwich [Meeus,
/// Astronomical Algorithms, 2nd ed., chapters 12 and 25], as in NOAA's solar calculator, corrected for
/// parallax. The difference between dynamical and universal time (70 s) is left out: it is .001
/// degrees.
pub fn position(unix_s: f64, latitude_deg: f64, longitude_deg: f64) -> Position {
    // Days and centuries since noon of the first of January 2000.
    let days = unix_s / 86_400.0 - 10_957.5;
    let t = days / 36_525.0;
    let (right_ascension, declination, sidereal) = apparent_place(days, t);
    let hour_angle = sidereal + longitude_deg.to_radians() - right_ascension;
    let latitude = latitude_deg.to_radians();
    let (sin_d, cos_d) = declination.sin_cos();
    let (sin_l, cos_l) = latitude.sin_cos();
    let (sin_h, cos_h) = hour_angle.sin_cos();
    let azimuth = (-cos_d * sin_h).atan2(sin_d * cos_l - cos_d * cos_h * sin_l);
    let sine = (sin_l * sin_d + cos_l * cos_d * cos_h).clamp(-1.0, 1.0);
    let elevation = sine.asin().to_degrees();
    Position {
        azimuth_deg: azimuth.to_degrees().rem_euclid(360.0),
        elevation_deg: elevation - PARALLAX_DEG * elevation.to_radians().cos(),
    }
}

/// Angle of the earth's radius, seen from the sun.
const PARALLAX_DEG: f64 = 0.002_44;

/// Right ascension and declination of the sun, and the sidereal time of Greenwich, radians.
fn apparent_place(days: f64, t: f64) -> (f64, f64, f64) {
    let mean_longitude = 280.466_46 + t * (36_000.769_83 + t * 0.000_303_2);
    let anomaly = (357.529_11 + t * (35_999.050_29 - t * 0.000_153_7)).to_radians();
    let center = (1.914_602 - t * (0.004_817 + t * 0.000_014)) * anomaly.sin()
        + (0.019_993 - t * 0.000_101) * (2.0 * anomaly).sin()
        + 0.000_289 * (3.0 * anomaly).sin();
    let node = (125.04 - 1_934.136 * t).to_radians();
    // Aberration, and nutation by its largest term.
    let nutation = -0.004_78 * node.sin();
    let longitude = (mean_longitude + center - 0.005_69 + nutation).to_radians();
    let obliquity = (23.439_291 - 0.013_004_2 * t + 0.002_56 * node.cos()).to_radians();
    let right_ascension = (obliquity.cos() * longitude.sin()).atan2(longitude.cos());
    let declination = (obliquity.sin() * longitude.sin()).asin();
    let sidereal = 280.460_618_37
        + (360.985_647_366_29 * days).rem_euclid(360.0)
        + 0.000_387_933 * t * t
        + nutation * obliquity.cos();
    (right_ascension, declination, sidereal.to_radians())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::direction::direction;
    use crate::time::Time;

    /// Angle between two positions, degrees.
    fn apart(a: Position, b: Position) -> f64 {
        let of = |p: Position| direction(p.azimuth_deg, p.elevation_deg);
        of(a)
            .cross(of(b))
            .length()
            .atan2(of(a).dot(of(b)))
            .to_degrees()
    }

    #[test]
    fn two_hundred_positions_of_an_ephemeris_are_met() {
        let table = include_str!("../tests/positions.csv");
        let mut most = 0.0f64;
        for line in table.lines().skip(1) {
            let (time, rest) = line.split_once(',').unwrap();
            let rest: Vec<f64> = rest.split(',').map(|v| v.parse().unwrap()).collect();
            let [latitude, longitude, azimuth_deg, elevation_deg] = rest[..] else {
                panic!("{line}");
            };
            let want = Position {
                azimuth_deg,
                elevation_deg,
            };
            let got = position(Time::parse(time).unwrap().unix_s, latitude, longitude);
            most = most.max(apart(got, want));
        }
        assert!(most < ERROR_DEG, "{most}");
    }

    #[test]
    fn the_published_example_of_nrels_algorithm_is_met() {
        // Reda and Andreas 2008 (NREL/TP-560-34302), table A5.1: the elevation is before refraction.
        let time = Time::parse("2003-10-17T12:30:30-07:00").unwrap();
        let want = Position {
            azimuth_deg: 194.340_241,
            elevation_deg: 39.872_046,
        };
        let got = position(time.unix_s, 39.742_476, -105.178_6);
        assert!(apart(got, want) < ERROR_DEG, "{got:?}");
    }

    #[test]
    fn at_an_equinox_the_noon_sun_stands_over_the_equator() {
        // 2024-03-20, 03:06 universal time; somewhere on the equator it is noon, within .05 degrees.
        let time = Time::parse("2024-03-20T03:06:00Z").unwrap().unix_s;
        let best = (0..3600).map(|i| position(time, 0.0, 0.1 * f64::from(i)).elevation_deg);
        assert!((best.fold(f64::MIN, f64::max) - 90.0).abs() < 0.1);
    }
}
