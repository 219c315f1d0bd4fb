//! From a photograph to a distribution over cameras.
use std::collections::HashMap;

use dipir_imaging::raster::LinearImage;
use rayon::prelude::*;
use safetensors::tensor::SafeTensors;

use crate::error::CalibrationError;
use crate::features::Thumbnail;
use crate::lines::{Agreement, Lines};
use crate::network::{self, Head, LOG_FOCAL, Network, PITCH, ROLL};
use crate::pose::Pose;
use crate::posterior::{Axis, Interval, Posterior};
use crate::segments::segments;

/// Points of the grids, from coarse to fine: pitch, roll, focal length.
const COARSE: [usize; 3] = [33, 21, 13];
const FINE: [usize; 3] = [21, 17, 9];
/// How often the grid is drawn closer.
const ROUNDS: usize = 3;
/// What the outermost points of a closer grid may leave out.
const LEFT_OUT: f64 = 2e-3;
/// What is searched: pitch and roll, degrees, and the logarithm of the focal length.
const SEARCHED: [[f64; 2]; 3] = [[-50.0, 32.0], [-10.0, 10.0], [-0.9, 1.0]];
/// How much of a grid's step blurs the lines' likelihood, so that no peak falls between its points.
const BLUR: f64 = 0.35;
/// Least probability of a bin: what a network excludes is not excluded quite.
const LEAST: f64 = 1e-4;

/// How far each source is trusted: powers of its density.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trust {
    /// Straight lines.
    pub lines: f64,
    /// The network's pitch and roll.
    pub turn: f64,
    /// The network's focal length.
    pub focal: f64,
}

/// A focal length from elsewhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownFocal {
    /// Over the picture's longer side.
    pub relative: f64,
    /// One standard deviation, relative.
    pub sigma: f64,
}

/// What a photograph tells, before it is weighed.
#[derive(Clone, Debug)]
pub struct Evidence {
    /// Straight lines.
    pub lines: Lines,
    /// The look.
    pub thumbnail: Thumbnail,
}

impl Evidence {
    /// Of a photograph of any size.
    pub fn new(image: &LinearImage) -> Self {
        let size = [image.0.width(), image.0.height()];
        Self {
            lines: Lines::new(&segments(image), size),
            thumbnail: Thumbnail::new(image),
        }
    }
}

/// The camera of a photograph; intervals hold 90%.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraEstimate {
    /// Upwards, degrees.
    pub pitch_deg: Interval,
    /// Clockwise about the line of sight, degrees.
    pub roll_deg: Interval,
    /// Along the longer side, degrees.
    pub fov_deg: Interval,
    /// Straight lines that were found.
    pub lines: usize,
    /// How many of them agree with the middles.
    pub agreeing: Agreement,
}

/// Networks and how far they are trusted.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraEstimator {
    /// Networks of pitch and roll, whose answers are averaged; none: only lines count.
    pub turn: Vec<Network>,
    /// Networks of the focal length.
    pub focal: Vec<Network>,
    /// How far each source is trusted.
    pub trust: Trust,
}

impl CameraEstimator {
    /// The one that is part of the program.
    ///
    /// # Errors
    /// Never, unless the program was built with weights of another version.
    pub fn embedded() -> Result<Self, CalibrationError> {
        Self::from_bytes(include_bytes!("../weights/camera.safetensors"))
    }

    /// From the bytes of [`to_bytes`](Self::to_bytes).
    ///
    /// # Errors
    /// If they are of another shape.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, CalibrationError> {
        let refused = |e: safetensors::SafeTensorError| CalibrationError::Weights(e.to_string());
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(refused)?;
        let metadata = header.metadata().clone().unwrap_or_default();
        let number = |name: &str| {
            let value = metadata.get(name).and_then(|v| v.parse::<f64>().ok());
            let value = value.filter(|v| v.is_finite() && *v >= 0.0);
            value.ok_or_else(|| CalibrationError::Weights(format!("`{name}` is missing")))
        };
        let file = SafeTensors::deserialize(bytes).map_err(refused)?;
        Ok(Self {
            turn: network::members(&file, Head::Turn)?,
            focal: network::members(&file, Head::Focal)?,
            trust: Trust {
                lines: number("trust_lines")?,
                turn: number("trust_turn")?,
                focal: number("trust_focal")?,
            },
        })
    }

    /// As a safetensors file.
    ///
    /// # Errors
    /// If the format refuses the networks.
    pub fn to_bytes(&self) -> Result<Vec<u8>, CalibrationError> {
        let Trust { lines, turn, focal } = self.trust;
        let trusts = [("lines", lines), ("turn", turn), ("focal", focal)];
        let entry = |(name, value): (&str, f64)| (format!("trust_{name}"), value.to_string());
        let metadata: HashMap<String, String> = trusts.into_iter().map(entry).collect();
        let networks = [(Head::Turn, &self.turn[..]), (Head::Focal, &self.focal[..])];
        network::to_bytes(&networks, metadata)
    }

    /// The camera of a photograph.
    pub fn estimate(&self, image: &LinearImage, known: Option<KnownFocal>) -> CameraEstimate {
        self.weighed(&Evidence::new(image), known)
    }

    /// The camera that evidence tells.
    pub fn weighed(&self, evidence: &Evidence, known: Option<KnownFocal>) -> CameraEstimate {
        let posterior = self.posterior(evidence, known);
        CameraEstimate {
            pitch_deg: posterior.interval(0),
            roll_deg: posterior.interval(1),
            fov_deg: posterior.fov_deg(),
            lines: evidence.lines.count(),
            agreeing: evidence.lines.agreement(&posterior.middle()),
        }
    }

    /// The distribution over cameras, on a grid around where it is.
    pub fn posterior(&self, evidence: &Evidence, known: Option<KnownFocal>) -> Posterior {
        let mut axes = coarse(known);
        let mut posterior = self.on_grid(evidence, known, axes);
        for _ in 0..ROUNDS {
            let closer = posterior.closer(FINE, LEFT_OUT);
            // What is searched stays the limit.
            axes = [0, 1, 2].map(|k| {
                let high = closer[k].value(closer[k].count - 1);
                let most = axes[k].value(axes[k].count - 1);
                Axis::between(closer[k].low.max(axes[k].low), high.min(most), FINE[k])
            });
            posterior = self.on_grid(evidence, known, axes);
        }
        posterior
    }

    fn on_grid(
        &self,
        evidence: &Evidence,
        known: Option<KnownFocal>,
        axes: [Axis; 3],
    ) -> Posterior {
        self.terms(evidence, known, axes).posterior(&self.trust)
    }

    /// What is told of each point of the first grid, before it is weighed: for choosing how far each source is trusted.
    pub fn coarse_terms(&self, evidence: &Evidence, known: Option<KnownFocal>) -> Terms {
        self.terms(evidence, known, coarse(known))
    }

    fn terms(&self, evidence: &Evidence, known: Option<KnownFocal>, axes: [Axis; 3]) -> Terms {
        let [pitches, rolls, focals] = axes;
        let spread = BLUR * pitches.step.max(rolls.step);
        let plain = evidence.thumbnail.features();
        let looks: Vec<[Vec<f64>; 2]> = focals
            .values()
            .map(|log_focal| self.turn_scores(&evidence.thumbnail, &plain, log_focal))
            .collect();
        let of_focal = self.focal_scores(&evidence.thumbnail, &plain, known);
        let of = |k: usize| {
            let c = k % focals.count;
            let pose = Pose {
                pitch_deg: pitches.value(k / focals.count / rolls.count),
                roll_deg: rolls.value(k / focals.count % rolls.count),
                log_focal: focals.value(c),
            };
            let [pitch, roll] = &looks[c];
            let turn =
                PITCH.interpolated(pitch, pose.pitch_deg) + ROLL.interpolated(roll, pose.roll_deg);
            let [focal, given] = of_focal(pose.log_focal);
            [
                evidence.lines.log_likelihood(&pose, spread),
                turn,
                focal,
                given,
            ]
        };
        let count = pitches.count * rolls.count * focals.count;
        let logs = (0..count).into_par_iter().map(of).collect();
        Terms { axes, logs }
    }

    /// Logarithms of the densities of pitch and roll at the networks' bins, for a focal length.
    fn turn_scores(&self, thumbnail: &Thumbnail, plain: &[f32], log_focal: f64) -> [Vec<f64>; 2] {
        let mut features = plain.to_vec();
        features.extend(thumbnail.angular(log_focal.exp() as f32));
        let members = if thumbnail.is_blank() {
            &[]
        } else {
            &self.turn[..]
        };
        let told = mean(members, Head::Turn, &features);
        [0, 1].map(|k| told[k].iter().map(|p| (p + LEAST).ln()).collect())
    }

    /// The logarithms of the density of the focal length by the look, and as it is known.
    fn focal_scores(
        &self,
        thumbnail: &Thumbnail,
        plain: &[f32],
        known: Option<KnownFocal>,
    ) -> impl Fn(f64) -> [f64; 2] + Sync {
        let members = if thumbnail.is_blank() {
            &[]
        } else {
            &self.focal[..]
        };
        let told = mean(members, Head::Focal, plain);
        let scores: Vec<f64> = told[0].iter().map(|p| (p + LEAST).ln()).collect();
        move |log_focal| match known {
            Some(known) => {
                let off = (log_focal - known.relative.ln()) / known.sigma;
                [0.0, -0.5 * off * off]
            }
            None => [LOG_FOCAL.interpolated(&scores, log_focal), 0.0],
        }
    }
}

/// The first grid.
fn coarse(known: Option<KnownFocal>) -> [Axis; 3] {
    let [pitch, roll, mut focal] = SEARCHED;
    let mut counts = COARSE;
    if let Some(known) = known {
        let middle = known.relative.ln();
        focal = [middle - 3.0 * known.sigma, middle + 3.0 * known.sigma];
        counts[2] = 5;
    }
    let between = |[low, high]: [f64; 2], n: usize| Axis::between(low, high, n);
    [
        between(pitch, counts[0]),
        between(roll, counts[1]),
        between(focal, counts[2]),
    ]
}

/// Logarithms of densities of each point of a grid: lines, the networks' turn and focal length, the known focal length.
#[derive(Clone, Debug)]
pub struct Terms {
    axes: [Axis; 3],
    logs: Vec<[f64; 4]>,
}

impl Terms {
    /// Weighs them.
    pub fn posterior(&self, trust: &Trust) -> Posterior {
        let weigh = |[lines, turn, focal, given]: &[f64; 4]| {
            trust.lines * lines + trust.turn * turn + trust.focal * focal + given
        };
        let logs: Vec<f64> = self.logs.iter().map(weigh).collect();
        Posterior::new(self.axes, &logs)
    }
}

/// The mean answer of some networks; without any, all is alike.
fn mean(members: &[Network], head: Head, features: &[f32]) -> Vec<Vec<f64>> {
    let even = |axis: &Axis| vec![1.0 / axis.count as f64; axis.count];
    let mut sum: Vec<Vec<f64>> = head.axes().iter().map(even).collect();
    for (n, member) in members.iter().enumerate() {
        let told = member.probabilities(head, features);
        let kept = n as f64 / (n + 1) as f64;
        for (s, t) in sum.iter_mut().flatten().zip(told.iter().flatten()) {
            *s = *s * kept + t / (n + 1) as f64;
        }
    }
    sum
}
