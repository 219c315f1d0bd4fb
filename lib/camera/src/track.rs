//! What the keys of an animation say between them, as glTF 2.0 interpolates.
use glam::{DQuat, DVec4};

/// How a value goes from one key to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Course {
    /// Straight; rotations along the shorter great circle.
    Linear,
    /// It stays until the next key.
    Step,
    /// A cubic of Hermite: each key has a slope that comes in, a value and a slope that goes out, by the second.
    CubicSpline,
}

/// Largest change of a value that still is constant: above the rounding of single precision.
const CONSTANT: f64 = 1e-6;

/// A value over time: translation and scale in three components, rotations as quaternions.
#[derive(Clone, Debug)]
pub(crate) struct Track {
    /// Seconds, increasing, at least one.
    times: Vec<f64>,
    /// One a key, three of a [`Course::CubicSpline`].
    values: Vec<DVec4>,
    course: Course,
    is_rotation: bool,
}

impl Track {
    /// An error says what is wrong with the keys, as something that a track has.
    pub fn new(
        times: Vec<f64>,
        values: Vec<DVec4>,
        course: Course,
        is_rotation: bool,
    ) -> Result<Self, String> {
        let of_key = match course {
            Course::CubicSpline => 3,
            _ => 1,
        };
        if times.is_empty() || values.len() != of_key * times.len() {
            let (times, values) = (times.len(), values.len());
            return Err(format!(
                "{times} times and {values} values, of which each time has {of_key}"
            ));
        }
        let bad = |what: &str, key: usize| Err(format!("{what} at its key {key}"));
        if let Some(key) = times.iter().position(|t| !t.is_finite()) {
            return bad("a time that is no number", key);
        }
        if let Some(key) = times.windows(2).position(|t| t[0] >= t[1]) {
            let [before, after] = [times[key], times[key + 1]];
            return Err(format!(
                "times that do not increase: {after} s comes after {before} s"
            ));
        }
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            return bad("a value that is no number", at / of_key);
        }
        let mut track = Self {
            times,
            values,
            course,
            is_rotation,
        };
        if is_rotation {
            let keys = 0..track.times.len();
            if let Some(key) = keys
                .into_iter()
                .find(|key| track.value(*key).length() < 1e-9)
            {
                return bad("a rotation of length 0", key);
            }
            // Slopes of a spline go with the length that its values have.
            if course != Course::CubicSpline {
                track.values.iter_mut().for_each(|v| *v = v.normalize());
            }
        }
        Ok(track)
    }

    /// The times of its keys, seconds.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// The value of a key.
    fn value(&self, key: usize) -> DVec4 {
        match self.course {
            Course::CubicSpline => self.values[3 * key + 1],
            _ => self.values[key],
        }
    }

    /// Whether it has one value at all times, up to rounding.
    pub fn is_constant(&self) -> bool {
        let first = self.value(0);
        let near =
            |a: DVec4, b: DVec4| (a - b).abs().max_element() <= CONSTANT * (1.0 + b.length());
        let same = |v: DVec4| near(v, first) || (self.is_rotation && near(-v, first));
        let mut keys = 0..self.times.len();
        let flat = |slope: &DVec4| slope.abs().max_element() <= CONSTANT;
        let is_flat = match self.course {
            Course::CubicSpline => self.values.chunks(3).all(|k| flat(&k[0]) && flat(&k[2])),
            _ => true,
        };
        // Slopes of a single key lead nowhere.
        self.times.len() == 1 || is_flat && keys.all(|key| same(self.value(key)))
    }

    /// The value at `time_s`; before the first key and after the last one it is theirs. Rotations have length 1, or, where
    /// a spline goes through 0, no numbers.
    pub fn at(&self, time_s: f64) -> DVec4 {
        let after = self.times.partition_point(|t| *t <= time_s);
        let last = self.times.len() - 1;
        let value = match after {
            0 => self.value(0),
            n if n > last => self.value(last),
            _ => self.between(after - 1, time_s),
        };
        match self.is_rotation {
            true => value.normalize(),
            false => value,
        }
    }

    /// The value between this key and the next.
    fn between(&self, key: usize, time_s: f64) -> DVec4 {
        let span = self.times[key + 1] - self.times[key];
        let s = (time_s - self.times[key]) / span;
        let (from, to) = (self.value(key), self.value(key + 1));
        match self.course {
            Course::Step => from,
            Course::Linear if self.is_rotation => {
                let [from, to] = [from, to].map(DQuat::from_vec4);
                DVec4::from(from.slerp(to, s))
            }
            Course::Linear => from.lerp(to, s),
            Course::CubicSpline => {
                let (out, into) = (self.values[3 * key + 2], self.values[3 * key + 3]);
                let (s2, s3) = (s * s, s * s * s);
                (2.0 * s3 - 3.0 * s2 + 1.0) * from
                    + span * (s3 - 2.0 * s2 + s) * out
                    + (3.0 * s2 - 2.0 * s3) * to
                    + span * (s3 - s2) * into
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_1_SQRT_2;

    use super::*;

    fn vector(x: f64) -> DVec4 {
        DVec4::new(x, 2.0 * x, -x, 0.0)
    }

    /// A turn about y by this many degrees.
    fn turn(degrees: f64) -> DVec4 {
        let half = 0.5 * degrees.to_radians();
        DVec4::new(0.0, half.sin(), 0.0, half.cos())
    }

    fn track(times: &[f64], values: &[DVec4], course: Course, is_rotation: bool) -> Track {
        Track::new(times.into(), values.into(), course, is_rotation).unwrap()
    }

    #[test]
    fn values_go_straight_stay_or_follow_their_slopes_and_hold_at_the_ends() {
        let keys = [1.0, 3.0, 4.0];
        let values = [10.0, 20.0, 0.0].map(vector);
        for (course, wanted) in [
            // By hand: a quarter of the way from 10 to 20, and half of it from 20 to 0.
            (Course::Linear, [(1.5, 12.5), (3.5, 10.0)]),
            (Course::Step, [(2.999, 10.0), (3.0, 20.0)]),
        ] {
            let track = track(&keys, &values, course, false);
            for (time, want) in wanted
                .into_iter()
                .chain([(-5.0, 10.0), (1.0, 10.0), (9.0, 0.0)])
            {
                let got = track.at(time);
                assert!(
                    got.abs_diff_eq(vector(want), 1e-12),
                    "{course:?} {time}: {got}"
                );
            }
        }
        // From 10 with slope 4 to 20 with slope -2, in 2 s. Half way the cubic has (10 + 20) / 2 + 2 * (4 - -2) / 8, and after
        // a quarter 27/32 * 10 + 5/32 * 20 + 2 * (9/64 * 4 - 3/64 * -2).
        let cubic = [99.0, 10.0, 4.0, -2.0, 20.0, 99.0].map(vector);
        let track = track(&keys[..2], &cubic, Course::CubicSpline, false);
        for (time, want) in [(2.0, 16.5), (1.5, 12.875), (0.0, 10.0), (3.0, 20.0)] {
            let got = track.at(time);
            assert!(got.abs_diff_eq(vector(want), 1e-12), "{time}: {got}");
        }
    }

    #[test]
    fn rotations_take_the_shorter_way_at_an_even_pace() {
        // The same turn has two quaternions: both ends give the same way.
        for end in [turn(90.0), -turn(90.0), 3.0 * turn(90.0)] {
            let track = track(&[0.0, 3.0], &[turn(0.0), end], Course::Linear, true);
            for (time, degrees) in [(1.0, 30.0), (2.0, 60.0), (7.0, 90.0)] {
                let along = track.at(time).dot(turn(degrees)).abs();
                assert!((along - 1.0).abs() < 1e-12, "{time}: {along}");
            }
        }
        // Without slopes the spline is half way in the middle: the mean of both, made a unit.
        let zero = DVec4::ZERO;
        let keys = [zero, turn(0.0), zero, zero, turn(90.0), zero];
        let middle = track(&[0.0, 1.0], &keys, Course::CubicSpline, true).at(0.5);
        assert!(middle.abs_diff_eq(turn(45.0), 1e-12), "{middle}");
        // A slope that turns it about x, too, before it is made a unit: 0.5 * (0, 0, 0, 1) + 0.5 * (0, 0, 0, 1) + 1/8 * (8, ...).
        let out = DVec4::new(8.0, 0.0, 0.0, 0.0);
        let keys = [zero, turn(0.0), out, zero, turn(0.0), zero];
        let middle = track(&[0.0, 1.0], &keys, Course::CubicSpline, true).at(0.5);
        let want = DVec4::new(FRAC_1_SQRT_2, 0.0, 0.0, FRAC_1_SQRT_2);
        assert!(middle.abs_diff_eq(want, 1e-12), "{middle}");
    }

    #[test]
    fn what_does_not_change_is_constant() {
        let is = |values: &[DVec4], course, is_rotation| {
            let times = [0.0, 1.0];
            track(&times, values, course, is_rotation).is_constant()
        };
        assert!(is(
            &[vector(5.0), vector(5.000_000_1)],
            Course::Linear,
            false
        ));
        assert!(!is(&[vector(5.0), vector(5.001)], Course::Step, false));
        assert!(is(&[turn(20.0), -turn(20.0)], Course::Linear, true));
        assert!(!is(&[vector(1.0), vector(-1.0)], Course::Linear, false));
        let spline = |slope: f64| {
            let keys = [0.0, 5.0, slope, 0.0, 5.0, 0.0].map(vector);
            is(&keys, Course::CubicSpline, false)
        };
        assert!(spline(0.0) && !spline(1.0));
        let one = [1.0, 5.0, 1.0].map(vector);
        assert!(track(&[0.5], &one, Course::CubicSpline, false).is_constant());
    }

    #[test]
    fn keys_that_cannot_be_are_told() {
        let said = |times: &[f64], values: &[DVec4], course, is_rotation| {
            Track::new(times.into(), values.into(), course, is_rotation).unwrap_err()
        };
        let two = [vector(1.0), vector(2.0)];
        for (times, want) in [
            (
                &[0.0, 0.0][..],
                "times that do not increase: 0 s comes after 0 s",
            ),
            (
                &[1.0, 0.5],
                "times that do not increase: 0.5 s comes after 1 s",
            ),
            (&[0.0, f64::NAN], "a time that is no number at its key 1"),
            (
                &[0.0, f64::INFINITY],
                "a time that is no number at its key 1",
            ),
            (&[], "0 times and 2 values, of which each time has 1"),
            (&[0.0], "1 times and 2 values, of which each time has 1"),
        ] {
            assert_eq!(said(times, &two, Course::Linear, false), want);
        }
        let cubic = said(&[0.0, 1.0], &two, Course::CubicSpline, false);
        assert_eq!(cubic, "2 times and 2 values, of which each time has 3");
        let nan = [vector(1.0), vector(f64::NAN)];
        let want = "a value that is no number at its key 1";
        assert_eq!(said(&[0.0, 1.0], &nan, Course::Step, false), want);
        let none = [turn(0.0), DVec4::ZERO];
        let want = "a rotation of length 0 at its key 1";
        assert_eq!(said(&[0.0, 1.0], &none, Course::Linear, true), want);
    }
}
