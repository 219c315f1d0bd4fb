//! What the user states of the sun: `[light] sun = { … }` and `[light] shadow = { … }`.
use glam::{DVec2, DVec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::direction::azimuth_of_bearing;
use crate::error::SunError;
use crate::position::{self, Position};
use crate::shadow::{Angle, CLICK_SIGMA_PX, HEIGHT_SIGMA, Shadow};
use crate::time::Time;

/// `sun = { … }`: each part is optional, and what is left out stays unknown.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SunTable {
    /// When the photograph was taken, ISO 8601 with the offset of its zone. Without an offset that of the longitude, in
    /// whole hours, is taken, which may be an hour off.
    #[schemars(extend("x-default" = "the photograph's own"), example = &"2026-06-21T12:34:56+02:00")]
    pub time: Option<String>,
    /// Latitude of the place, degrees north. It belongs to `longitude`.
    #[schemars(range(min = -90.0, max = 90.0), extend("x-default" = "the photograph's own"), example = 48.1)]
    pub latitude: Option<f64>,
    /// Longitude of the place, degrees east. It belongs to `latitude`.
    #[schemars(range(min = -180.0, max = 360.0), extend("x-default" = "the photograph's own"), example = 11.6)]
    pub longitude: Option<f64>,
    /// Where the camera looked, degrees clockwise from true north.
    #[schemars(range(min = -360.0, max = 360.0), extend("x-default" = "the photograph's own"), example = 225.0)]
    pub heading_deg: Option<f64>,
    /// Standard deviation of the heading, degrees.
    #[schemars(range(min = 0.0, max = 180.0), extend("x-default" = "10; 14 for the photograph's own heading from magnetic north"), example = 5.0)]
    pub heading_sure_deg: Option<f64>,
    /// Azimuth of the sun, degrees clockwise, counted from `relative_to`. It replaces `time`, and says that the sun shines.
    #[schemars(range(min = -360.0, max = 360.0), example = 60.0)]
    pub azimuth_deg: Option<f64>,
    /// Elevation of the sun, degrees above the horizon. It replaces `time`, and says that the sun shines.
    #[schemars(range(min = -90.0, max = 90.0), example = 35.0)]
    pub elevation_deg: Option<f64>,
    /// From where `azimuth_deg` counts.
    #[schemars(example = &"north")]
    pub relative_to: RelativeTo,
    /// Standard deviation of `azimuth_deg` and `elevation_deg`, degrees.
    #[schemars(range(min = 0.0, max = 180.0), extend("default" = SAID_SIGMA_DEG), example = 5.0)]
    pub sure_deg: Option<f64>,
    /// Angular radius of the sun, degrees: 0.27 in a clear sky, more in haze.
    #[schemars(range(min = 0.01, max = 90.0), extend("x-default" = "estimated"), example = 0.27)]
    pub size_deg: Option<f64>,
    /// Share of the sun in the light on a surface that faces it.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-default" = "estimated"), example = 0.7)]
    pub share: Option<f64>,
}

/// From where an azimuth counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RelativeTo {
    /// Where the camera looks: 90 is on the right.
    #[default]
    View,
    /// The world's -z: 90 is +x.
    World,
    /// North; needs a heading.
    North,
}

/// Standard deviation of an angle that the user states, degrees.
const SAID_SIGMA_DEG: f64 = 3.0;
/// Standard deviation of a compass in a telephone or a hand, degrees.
const COMPASS_SIGMA_DEG: f64 = 10.0;
/// By how much magnetic north is off true north, degrees: over 20 in South Africa and New Zealand, below 10 in most of
/// Europe and Asia [World Magnetic Model 2025].
const DECLINATION_SIGMA_DEG: f64 = 10.0;
/// By how much a clock of an unknown zone may be off the zone of its place: summer time.
const ZONE_SIGMA_S: f64 = 3600.0;

/// What the photograph's own data say; the table comes first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Taken {
    /// ISO 8601.
    pub time: Option<String>,
    /// Degrees north.
    pub latitude_deg: Option<f64>,
    /// Degrees east.
    pub longitude_deg: Option<f64>,
    /// Degrees clockwise from north.
    pub heading_deg: Option<f64>,
    /// Whether that is magnetic north.
    pub heading_is_magnetic: bool,
}

/// What is known of the sun, in angles of the world.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Known {
    /// Azimuth, clockwise from -z.
    pub azimuth: Option<Angle>,
    /// Elevation.
    pub elevation: Option<Angle>,
    /// Angular radius, degrees.
    pub radius_deg: Option<f64>,
    /// Share of the light, 0 to 1.
    pub share: Option<f64>,
}

impl SunTable {
    /// Errors on values that no sun has. `at` is the table's path, `light.sun`.
    ///
    /// # Errors
    /// The first key that is wrong, with its value and the accepted form.
    pub fn check(&self, at: &str) -> Result<(), SunError> {
        let degrees = "degrees";
        let ranges: [(&str, Option<f64>, f64, f64, &'static str); 9] = [
            (
                "latitude",
                self.latitude,
                -90.0,
                90.0,
                "degrees north from -90 to 90",
            ),
            (
                "longitude",
                self.longitude,
                -180.0,
                360.0,
                "degrees east from -180 to 360",
            ),
            (
                "heading_deg",
                self.heading_deg,
                -360.0,
                360.0,
                "degrees clockwise from north",
            ),
            (
                "azimuth_deg",
                self.azimuth_deg,
                -360.0,
                360.0,
                "degrees clockwise from -360 to 360",
            ),
            (
                "elevation_deg",
                self.elevation_deg,
                -90.0,
                90.0,
                "degrees above the horizon, -90 to 90",
            ),
            (
                "size_deg",
                self.size_deg,
                0.01,
                90.0,
                "an angular radius from 0.01 to 90 degrees, 0.27 for a clear sky",
            ),
            (
                "share",
                self.share,
                0.0,
                1.0,
                "a share of the light from 0 to 1",
            ),
            ("sure_deg", self.sure_deg, 0.0, 180.0, degrees),
            (
                "heading_sure_deg",
                self.heading_sure_deg,
                0.0,
                180.0,
                degrees,
            ),
        ];
        for (name, value, least, most, accepted) in ranges {
            in_range(at, name, value, least, most, accepted)?;
        }
        if let Some(text) = &self.time
            && Time::parse(text).is_none()
        {
            return Err(SunError::Value {
                key: format!("{at}.time"),
                value: format!("\"{}\"", text.escape_debug()),
                accepted: "a date and time with its offset, \"2026-06-21T12:34:56+02:00\"",
            });
        }
        if self.latitude.is_some() != self.longitude.is_some() {
            return Err(SunError::Missing {
                key: format!(
                    "{at}.{}",
                    if self.latitude.is_some() {
                        "longitude"
                    } else {
                        "latitude"
                    }
                ),
                remedy: "write both, or leave both to the photograph",
            });
        }
        let angles = [
            ("azimuth_deg", self.azimuth_deg),
            ("elevation_deg", self.elevation_deg),
        ];
        for (name, value) in angles {
            if value.is_some() && self.time.is_some() {
                return Err(SunError::Conflict {
                    first: format!("{at}.time"),
                    second: format!("{at}.{name}"),
                });
            }
        }
        Ok(())
    }

    /// What this table and the photograph's own data say of the sun, for a camera that looks along
    /// `forward`. Without a heading time and place give the elevation alone.
    ///
    /// # Errors
    /// As [`check`](Self::check), and if an azimuth from north has no heading.
    pub fn resolve(&self, at: &str, taken: &Taken, forward: DVec3) -> Result<Known, SunError> {
        self.check(at)?;
        let heading = self.heading(taken);
        let mut known = Known {
            radius_deg: self.size_deg,
            share: self.share,
            ..Known::default()
        };
        let said_nothing = self.azimuth_deg.is_none() && self.elevation_deg.is_none();
        if said_nothing && let Some((sun, sigma_deg)) = self.by_time(taken) {
            known.elevation = Some(Angle {
                deg: sun.elevation_deg,
                sigma_deg: sigma_deg[1],
            });
            known.azimuth = heading.map(|heading| Angle {
                deg: azimuth_of_bearing(sun.azimuth_deg, heading.deg, forward),
                sigma_deg: sigma_deg[0].hypot(heading.sigma_deg),
            });
        }
        let sigma_deg = self.sure_deg.unwrap_or(SAID_SIGMA_DEG);
        if let Some(deg) = self.elevation_deg {
            known.elevation = Some(Angle { deg, sigma_deg });
        }
        if let Some(azimuth) = self.azimuth_deg {
            let (deg, more) = match (self.relative_to, heading) {
                (RelativeTo::View, _) => (azimuth_of_bearing(azimuth, 0.0, forward), 0.0),
                (RelativeTo::World, _) => (azimuth.rem_euclid(360.0), 0.0),
                (RelativeTo::North, Some(heading)) => {
                    let deg = azimuth_of_bearing(azimuth, heading.deg, forward);
                    (deg, heading.sigma_deg)
                }
                (RelativeTo::North, None) => {
                    return Err(SunError::Missing {
                        key: format!("{at}.heading_deg"),
                        remedy: "an azimuth from north needs the camera's own bearing",
                    });
                }
            };
            known.azimuth = Some(Angle {
                deg,
                sigma_deg: sigma_deg.hypot(more),
            });
        }
        Ok(known)
    }

    /// What is missing, if a time, a place or a heading is written and nothing follows of the sun.
    pub fn idle(&self, taken: &Taken) -> Option<&'static str> {
        let written = [self.latitude, self.longitude, self.heading_deg];
        let said = self.azimuth_deg.is_some() || self.elevation_deg.is_some();
        if said || (self.time.is_none() && written == [None; 3]) || self.by_time(taken).is_some() {
            return None;
        }
        let time = self.time.is_some() || taken.time.is_some();
        let place = [
            self.latitude.or(taken.latitude_deg),
            self.longitude.or(taken.longitude_deg),
        ];
        let place = place.iter().all(Option::is_some);
        Some(match (time, place) {
            (true, false) => {
                "without a place the time says nothing of the sun: write latitude and longitude, too"
            }
            (false, true) => "without a time the place says nothing of the sun: write time, too",
            (false, false) => {
                "without a time and a place the heading says nothing of the sun: write time, latitude and longitude, too"
            }
            (true, true) => "time and place say nothing of the sun",
        })
    }

    /// The offset that `time` is taken to have, if it is written without one and tells of the sun: `+02:00`.
    pub fn assumed_offset(&self, taken: &Taken) -> Option<String> {
        let time = Time::parse(self.time.as_deref()?)?;
        let longitude = self.longitude.or(taken.longitude_deg)?;
        self.by_time(taken).filter(|_| !time.zone_known)?;
        let hours = (time.unix_s - time.at_longitude(longitude)) / 3600.0;
        Some(format!(
            "{}{:02}:00",
            if hours < 0.0 { '-' } else { '+' },
            hours.abs()
        ))
    }

    fn heading(&self, taken: &Taken) -> Option<Angle> {
        let deg = self
            .heading_deg
            .or(taken.heading_deg)
            .filter(|d| d.is_finite())?;
        let by_compass = match self.heading_deg.is_none() && taken.heading_is_magnetic {
            true => COMPASS_SIGMA_DEG.hypot(DECLINATION_SIGMA_DEG),
            false => COMPASS_SIGMA_DEG,
        };
        let sigma_deg = self.heading_sure_deg.unwrap_or(by_compass);
        Some(Angle { deg, sigma_deg })
    }

    /// The sun by time and place, and the standard deviations of azimuth and elevation.
    fn by_time(&self, taken: &Taken) -> Option<(Position, [f64; 2])> {
        let time = self.time.as_deref().or(taken.time.as_deref())?;
        let time = Time::parse(time)?;
        let (latitude, longitude) = match (self.latitude, self.longitude) {
            (Some(latitude), Some(longitude)) => (latitude, longitude),
            _ => (taken.latitude_deg?, taken.longitude_deg?),
        };
        let unix_s = time.at_longitude(longitude);
        let at = |unix_s| position::position(unix_s, latitude, longitude);
        let sun = at(unix_s);
        if time.zone_known {
            return Some((sun, [position::ERROR_DEG; 2]));
        }
        let (early, late) = (at(unix_s - ZONE_SIGMA_S), at(unix_s + ZONE_SIGMA_S));
        let turn = (late.azimuth_deg - early.azimuth_deg + 180.0).rem_euclid(360.0) - 180.0;
        let climb = [early, late].map(|p| (p.elevation_deg - sun.elevation_deg).abs());
        Some((sun, [0.5 * turn.abs(), climb[0].max(climb[1])]))
    }
}

/// `shadow = { … }`: a shadow that the user marked.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ShadowTable {
    /// Pixel where the thing stands on the ground: column and row.
    #[schemars(extend("x-default" = "none; required"), extend("examples" = [[640.0, 480.0]]))]
    pub foot: [f64; 2],
    /// Pixel where the shadow of its top falls: column and row.
    #[schemars(extend("x-default" = "none; required"), extend("examples" = [[820.0, 510.0]]))]
    pub tip: [f64; 2],
    /// Height of the thing, metres. Without it the elevation of the sun stays unknown.
    #[schemars(range(min = 0.001, max = 10000.0), example = 1.8)]
    #[serde(default)]
    pub height_m: Option<f64>,
    /// Standard deviation of each coordinate, pixels.
    #[schemars(range(min = 0.0, max = 10000.0), extend("default" = CLICK_SIGMA_PX), example = 4.0)]
    #[serde(default)]
    pub sure_px: Option<f64>,
}

impl ShadowTable {
    /// The shadow. `at` is the table's path, `light.shadow`.
    ///
    /// # Errors
    /// The first key that is wrong, with its value and the accepted form.
    pub fn resolve(&self, at: &str) -> Result<Shadow, SunError> {
        let pixels = self.foot.into_iter().chain(self.tip);
        for (name, v) in ["foot", "foot", "tip", "tip"].into_iter().zip(pixels) {
            let accepted = "a pixel [column, row], for instance [640.0, 480.0]";
            in_range(at, name, Some(v), -1e6, 1e6, accepted)?;
        }
        in_range(
            at,
            "height_m",
            self.height_m,
            1e-3,
            1e4,
            "metres above 0, as in 1.8",
        )?;
        in_range(at, "sure_px", self.sure_px, 0.0, 1e4, "pixels, as in 2.0")?;
        Ok(Shadow {
            foot: DVec2::from_array(self.foot),
            tip: DVec2::from_array(self.tip),
            height_m: self.height_m,
            sigma_px: self.sure_px.unwrap_or(CLICK_SIGMA_PX),
            sigma_height: HEIGHT_SIGMA,
        })
    }
}

fn in_range(
    at: &str,
    name: &str,
    value: Option<f64>,
    least: f64,
    most: f64,
    accepted: &'static str,
) -> Result<(), SunError> {
    match value {
        Some(v) if !(least..=most).contains(&v) => Err(SunError::Value {
            key: format!("{at}.{name}"),
            value: v.to_string(),
            accepted,
        }),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sun(text: &str) -> SunTable {
        toml::from_str(text).unwrap()
    }

    fn known(text: &str, taken: &Taken, forward: DVec3) -> Result<Known, String> {
        let known = sun(text).resolve("light.sun", taken, forward);
        known.map_err(|e| e.to_string())
    }

    /// A noon in June at 48 degrees north, in which the sun stands in the south.
    const NOON: &str = "time = \"2026-06-21T12:02:00Z\"\nlatitude = 48.0\nlongitude = 0.0\n";

    #[test]
    fn an_offset_that_is_assumed_is_told() {
        let assumed = |time: &str, longitude: f64| {
            let text = format!("time = \"{time}\"\nlatitude = 40.0\nlongitude = {longitude:?}");
            sun(&text).assumed_offset(&Taken::default())
        };
        let clock = "2026-06-21T12:34:56";
        assert_eq!(assumed(clock, 11.6).as_deref(), Some("+01:00"));
        assert_eq!(assumed(clock, 286.0).as_deref(), Some("-05:00"));
        assert_eq!(assumed(clock, 0.0).as_deref(), Some("+00:00"));
        assert_eq!(assumed("2026-06-21T12:34:56+02:00", 11.6), None);
        let without_place = sun("time = \"2026-06-21T12:34:56\"");
        assert_eq!(without_place.assumed_offset(&Taken::default()), None);
    }

    #[test]
    fn what_says_nothing_is_told() {
        let idle = |text: &str, taken: &Taken| sun(text).idle(taken).map(str::to_string);
        let nothing = Taken::default();
        let placed = Taken {
            latitude_deg: Some(48.0),
            longitude_deg: Some(0.0),
            ..Taken::default()
        };
        let time = "time = \"2026-06-21T12:02:00Z\"";
        assert!(idle(time, &nothing).unwrap().starts_with("without a place"));
        assert_eq!(idle(time, &placed), None);
        assert!(
            idle("heading_deg = 30.0", &nothing)
                .unwrap()
                .contains("the heading")
        );
        assert!(
            idle("heading_deg = 30.0", &placed)
                .unwrap()
                .starts_with("without a time")
        );
        for quiet in [
            "",
            "share = 0.5",
            "azimuth_deg = 3.0\nheading_deg = 4.0",
            NOON,
        ] {
            assert_eq!(idle(quiet, &nothing), None, "{quiet}");
        }
    }

    #[test]
    fn time_place_and_heading_give_both_angles_and_without_heading_the_elevation() {
        let nothing = Taken::default();
        let alone = known(NOON, &nothing, DVec3::NEG_Z).unwrap();
        let elevation = alone.elevation.unwrap();
        // 90 - 48 + 23.4.
        assert!((elevation.deg - 65.43).abs() < 0.05 && elevation.sigma_deg < 0.05);
        assert_eq!(alone.azimuth, None);
        // Looking east, along the world's -z: south is on the right.
        let text = format!("{NOON}heading_deg = 90.0\nheading_sure_deg = 4.0\nshare = 0.7");
        let turned = known(&text, &nothing, DVec3::NEG_Z).unwrap();
        let azimuth = turned.azimuth.unwrap();
        assert!((azimuth.deg - 90.0).abs() < 1.0, "{azimuth:?}");
        assert!((azimuth.sigma_deg - 4.0).abs() < 0.01);
        assert_eq!(turned.share, Some(0.7));
    }

    #[test]
    fn the_photographs_own_data_fill_in_and_an_unknown_zone_makes_unsure() {
        let taken = Taken {
            time: Some("2026-06-21T12:02:00".into()),
            latitude_deg: Some(48.0),
            longitude_deg: Some(0.0),
            heading_deg: Some(180.0),
            heading_is_magnetic: false,
        };
        let got = known("", &taken, DVec3::NEG_Z).unwrap();
        let (azimuth, elevation) = (got.azimuth.unwrap(), got.elevation.unwrap());
        let off = (azimuth.deg + 180.0).rem_euclid(360.0) - 180.0;
        assert!(off.abs() < 1.0 && azimuth.sigma_deg > 20.0, "{azimuth:?}");
        assert!(elevation.sigma_deg > 2.0, "{elevation:?}");
        assert_eq!(
            known("", &Taken::default(), DVec3::NEG_Z).unwrap(),
            Known::default()
        );
        let taken = Taken {
            time: Some("2026-06-21T12:02:00Z".into()),
            heading_is_magnetic: true,
            ..taken
        };
        let sigma = |text| {
            known(text, &taken, DVec3::NEG_Z)
                .unwrap()
                .azimuth
                .unwrap()
                .sigma_deg
        };
        // The position's error, .02 degrees, adds a hundred-thousandth.
        assert!((sigma("") - 200f64.sqrt()).abs() < 1e-4, "{}", sigma(""));
        assert!((sigma("heading_deg = 180") - 10.0).abs() < 1e-4);
    }

    #[test]
    fn angles_count_from_the_view_the_world_or_north() {
        let forward = DVec3::X;
        let azimuth = |text: &str| {
            let known = known(text, &Taken::default(), forward)?;
            Ok::<f64, String>(known.azimuth.unwrap().deg)
        };
        assert!((azimuth("azimuth_deg = -30").unwrap() - 60.0).abs() < 1e-9);
        let world = "azimuth_deg = -30\nrelative_to = \"world\"";
        assert_eq!(azimuth(world).unwrap(), 330.0);
        let north = "azimuth_deg = 180\nrelative_to = \"north\"";
        assert_eq!(
            azimuth(north).unwrap_err(),
            "light.sun.heading_deg is missing; an azimuth from north needs the camera's own bearing"
        );
        let north = format!("{north}\nheading_deg = 90");
        assert!((azimuth(&north).unwrap() - 180.0).abs() < 1e-9);
    }

    #[test]
    fn wrong_values_are_named() {
        let words = |text: &str| sun(text).check("light.sun").unwrap_err().to_string();
        assert_eq!(
            words("elevation_deg = 100"),
            "light.sun.elevation_deg is 100; accepted: degrees above the horizon, -90 to 90"
        );
        assert_eq!(
            words("time = \"noon\""),
            "light.sun.time is \"noon\"; accepted: a date and time with its offset, \"2026-06-21T12:34:56+02:00\""
        );
        assert_eq!(
            words("latitude = 48"),
            "light.sun.longitude is missing; write both, or leave both to the photograph"
        );
        assert_eq!(
            words("time = \"2026-06-21T12:34Z\"\nazimuth_deg = 3"),
            "light.sun.time and light.sun.azimuth_deg cannot both be given; keep one of them"
        );
        assert!(words("share = nan").starts_with("light.sun.share is NaN"));
        assert!(toml::from_str::<SunTable>("azimut_deg = 3").is_err());
        let shadow: ShadowTable =
            toml::from_str("foot = [1, 2]\ntip = [3, 4]\nheight_m = -1").unwrap();
        assert_eq!(
            shadow.resolve("light.shadow").unwrap_err().to_string(),
            "light.shadow.height_m is -1; accepted: metres above 0, as in 1.8"
        );
        assert!(toml::from_str::<ShadowTable>("foot = [1, 2]").is_err());
    }

    proptest! {
        /// A sun or an error, never a panic; angles are finite.
        #[test]
        fn no_table_makes_it_panic(
            numbers in proptest::collection::vec(
                proptest::option::of(prop_oneof![-400.0..400.0, Just(f64::NAN), Just(f64::INFINITY)]), 9),
            time in proptest::option::of("[0-9]{4}-[01][0-9]-[0-3][0-9]T[0-2][0-9]:[0-5][0-9]Z?"),
        ) {
            let n = |i: usize| numbers[i];
            let table = SunTable {
                time, latitude: n(0), longitude: n(1), heading_deg: n(2), heading_sure_deg: n(3),
                azimuth_deg: n(4), elevation_deg: n(5), relative_to: RelativeTo::View,
                sure_deg: n(6), size_deg: n(7), share: n(8),
            };
            if let Ok(known) = table.resolve("light.sun", &Taken::default(), DVec3::NEG_Z) {
                let angles = [known.azimuth, known.elevation];
                prop_assert!(angles.iter().flatten().all(|a| a.deg.is_finite()));
            }
        }
    }
}
