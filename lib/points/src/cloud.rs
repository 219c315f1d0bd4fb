//! Points, and from where they were seen.
use dipir_numerics::sampler::Stream;
use glam::{DMat3, DVec3};

/// Random numbers of this crate.
pub(crate) const POINTS: Stream = Stream(11);

/// Points of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cloud {
    /// Finite positions, metres.
    pub points: Vec<DVec3>,
    /// Where the sensor stood, if it is known: behind what it saw it did not see.
    pub viewpoint: Option<DVec3>,
}

/// Most points that are kept of a file; of more, every second, third, … is.
pub const MOST_POINTS: usize = 20_000_000;
/// Farthest coordinate of a point, metres, as of what a configuration says: the largest northing of UTM. Beyond it are
/// numbers that stand for no echo.
const FARTHEST_M: f64 = 1e7;

impl Cloud {
    /// Without points that are too far away to be of a scene.
    pub(crate) fn near(mut self) -> Self {
        self.points.retain(|p| p.abs().max_element() < FARTHEST_M);
        self
    }

    /// Scaled, then turned and shifted; without points that this brings beyond all numbers.
    pub(crate) fn moved(mut self, scale: f64, rotation: DMat3, position: DVec3) -> Self {
        let to_world = |p: DVec3| rotation * (scale * p) + position;
        self.points.retain_mut(|p| {
            *p = to_world(*p);
            p.is_finite()
        });
        self.viewpoint = self.viewpoint.map(to_world);
        self
    }
}

/// Collects at most [`MOST_POINTS`] of `count` announced points, evenly.
pub(crate) struct Collector {
    points: Vec<DVec3>,
    every: usize,
    seen: usize,
}

impl Collector {
    pub(crate) fn new(count: usize) -> Self {
        Self {
            points: Vec::new(),
            every: count.div_ceil(MOST_POINTS).max(1),
            seen: 0,
        }
    }

    /// Points that are not finite are those that a sensor did not see.
    pub(crate) fn add(&mut self, point: DVec3) {
        if self.seen.is_multiple_of(self.every) && point.is_finite() {
            self.points.push(point);
        }
        self.seen += 1;
    }

    pub(crate) fn points(self) -> Vec<DVec3> {
        self.points
    }

    /// Those of `all` that are kept.
    pub(crate) fn of(all: Vec<DVec3>) -> Vec<DVec3> {
        let mut found = Self::new(all.len());
        all.into_iter().for_each(|point| found.add(point));
        found.points()
    }
}
