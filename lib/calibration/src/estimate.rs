//! From a photograph to a distribution over cameras.
use std::collections::HashMap;

use dipir_backbone::frame;
use dipir_imaging::raster::LinearImage;
use rayon::prelude::*;
use safetensors::tensor::SafeTensors;

use crate::error::CalibrationError;
use crate::lines::{Agreement, Lines};
use crate::look::Look;
use crate::network::{self, Member};
use crate::pose::{Pose, fov_deg, log_focal};
use crate::posterior::{Axis, Interval, Posterior};
use crate::segments::segments;
use crate::whole::{BLUR, Table, Whole};

/// What is searched, and what networks learn from: pitch, roll and the angle along the longer side, degrees.
pub const SEARCHED: [[f64; 2]; 3] = [[-50.0, 30.0], [-8.0, 8.0], [24.0, 100.0]];
/// Points of the grids, from coarse to fine: pitch, roll, focal length.
const COARSE: [usize; 3] = [33, 17, 11];
const FINE: [usize; 3] = [15, 13, 7];
/// Points of a focal length that is known, over this many deviations either way.
const KNOWN: usize = 3;
const KNOWN_DEVIATIONS: f64 = 1.35;
/// How often the grid is drawn closer.
const ROUNDS: usize = 2;
/// What the outermost points of a closer grid may leave out.
const LEFT_OUT: f64 = 4e-3;

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
    /// Edges, brightness and tint.
    pub look: Look,
    /// The picture as a whole.
    pub whole: Whole,
    /// Logarithm of the longer side that was looked at over that of the photograph: 0 without a frame.
    within: f64,
}

impl Evidence {
    /// Of a photograph of any size, without the frame around it.
    pub fn new(image: &LinearImage) -> Self {
        let Some(inside) = frame::inside(image) else {
            return Self::blurred(image, BLUR);
        };
        let longer = |w: usize, h: usize| w.max(h) as f64;
        let [_, _, width, height] = inside;
        Self {
            within: (longer(width, height) / longer(image.0.width(), image.0.height())).ln(),
            ..Self::blurred(&frame::cut(image, inside), BLUR)
        }
    }

    /// With another blur of the whole than photographs get, and with its frame.
    pub fn blurred(image: &LinearImage, blur: usize) -> Self {
        let size = [image.0.width(), image.0.height()];
        Self {
            lines: Lines::new(&segments(image), size),
            look: Look::new(image),
            whole: Whole::new(image, blur),
            within: 0.0,
        }
    }

    /// What lines and look tell of a camera, whose focal length is relative to the side that was looked at.
    pub fn features(&self, pose: &Pose) -> Vec<f32> {
        self.look.features(&self.lines, pose)
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

/// Networks, and how far they are trusted.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraEstimator {
    /// Their scores are averaged.
    pub members: Vec<Member>,
    /// Power of their density.
    pub trust: f64,
}

impl CameraEstimator {
    /// The estimator with the weights that are built into the program.
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
        let metadata = header.metadata().as_ref();
        let trust = metadata.and_then(|m| m.get("trust")?.parse::<f64>().ok());
        let trust = trust.filter(|v| v.is_finite() && *v >= 0.0);
        let file = SafeTensors::deserialize(bytes).map_err(refused)?;
        Ok(Self {
            members: network::members(&file)?,
            trust: trust.ok_or_else(|| CalibrationError::Weights("`trust` is missing".into()))?,
        })
    }

    /// As a safetensors file.
    ///
    /// # Errors
    /// If the format refuses the networks.
    pub fn to_bytes(&self) -> Result<Vec<u8>, CalibrationError> {
        let trust = ("trust".to_string(), self.trust.to_string());
        network::to_bytes(&self.members, HashMap::from([trust]))
    }

    /// The camera of a photograph.
    pub fn estimate(&self, image: &LinearImage, known: Option<KnownFocal>) -> CameraEstimate {
        self.weighed(&Evidence::new(image), known)
    }

    /// The camera that evidence tells.
    pub fn weighed(&self, evidence: &Evidence, known: Option<KnownFocal>) -> CameraEstimate {
        let posterior = self.grid(evidence, known).posterior(self.trust);
        CameraEstimate {
            pitch_deg: posterior.interval(0),
            roll_deg: posterior.interval(1),
            fov_deg: posterior.fov_deg(),
            lines: evidence.lines.count(),
            agreeing: evidence.lines.agreement(&Pose {
                log_focal: posterior.middle().log_focal - evidence.within,
                ..posterior.middle()
            }),
        }
    }

    /// Scores on a grid around where the camera is.
    pub fn grid(&self, evidence: &Evidence, known: Option<KnownFocal>) -> Scores {
        // One shade looks alike under all cameras.
        let members: Vec<(&Member, Table)> = match evidence.look.is_blank() {
            true => Vec::new(),
            false => {
                let with_table = |m| (m, Member::table(m, &evidence.whole));
                self.members.iter().map(with_table).collect()
            }
        };
        // Relative to the side that is looked at, until the end.
        let known = known.map(|k| KnownFocal {
            relative: k.relative / evidence.within.exp(),
            ..k
        });
        let mut scores = on_grid(&members, evidence, known, coarse(known));
        for _ in 0..ROUNDS {
            let mut fine = FINE;
            fine[2] = if known.is_some() { KNOWN } else { FINE[2] };
            let closer = scores.posterior(self.trust).closer(fine, LEFT_OUT);
            // What is searched stays the limit.
            let axes = [0, 1, 2].map(|k| {
                let [low, high] = [scores.axes[k].low, scores.axes[k].last()];
                Axis::between(closer[k].low.max(low), closer[k].last().min(high), fine[k])
            });
            scores = on_grid(&members, evidence, known, axes);
        }
        scores.axes[2].low += evidence.within;
        scores
    }
}

fn on_grid(
    members: &[(&Member, Table)],
    evidence: &Evidence,
    known: Option<KnownFocal>,
    axes: [Axis; 3],
) -> Scores {
    let [pitches, rolls, focals] = axes;
    let of = |k: usize| {
        let pose = Pose {
            pitch_deg: pitches.value(k / focals.count / rolls.count),
            roll_deg: rolls.value(k / focals.count % rolls.count),
            log_focal: focals.value(k % focals.count),
        };
        let before = match known {
            Some(known) => {
                let off = (pose.log_focal - known.relative.ln()) / known.sigma;
                -0.5 * off * off
            }
            // All angles of view are alike: the density of the focal length's logarithm.
            None => fov_deg(pose.log_focal).to_radians().sin().ln(),
        };
        if members.is_empty() {
            return [0.0, before];
        }
        let features = evidence.features(&pose);
        let scores = members
            .iter()
            .map(|(m, table)| m.score(&features, table.told(&pose)));
        [scores.sum::<f64>() / members.len() as f64, before]
    };
    let count = pitches.count * rolls.count * focals.count;
    let logs = (0..count).into_par_iter().map(of).collect();
    Scores { axes, logs }
}

/// The first grid.
fn coarse(known: Option<KnownFocal>) -> [Axis; 3] {
    let [pitch, roll, fov] = SEARCHED;
    let focal = match known {
        Some(known) => {
            let (middle, off) = (known.relative.ln(), KNOWN_DEVIATIONS * known.sigma);
            Axis::between(middle - off, middle + off, KNOWN)
        }
        None => Axis::between(log_focal(fov[1]), log_focal(fov[0]), COARSE[2]),
    };
    [
        Axis::between(pitch[0], pitch[1], COARSE[0]),
        Axis::between(roll[0], roll[1], COARSE[1]),
        focal,
    ]
}

/// Scores of the points of a grid, and the logarithms of how probable each was before.
#[derive(Clone, Debug)]
pub struct Scores {
    axes: [Axis; 3],
    logs: Vec<[f64; 2]>,
}

impl Scores {
    /// Under a power of the scores' density.
    pub fn posterior(&self, trust: f64) -> Posterior {
        let logs = self
            .logs
            .iter()
            .map(|[score, before]| trust * score + before);
        Posterior::new(self.axes, &logs.collect::<Vec<f64>>())
    }
}
