//! What the page changes of a `pipeline.toml`.
use anyhow::bail;
use serde::{Deserialize, Serialize};

/// Most objects that a page may ask for.
const MOST_OBJECTS: usize = 200;

/// Changes of a file; what is absent stays as it is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Edit {
    /// How often the file had been saved when it was read: sizes and objects are those of that text.
    #[serde(default)]
    pub revision: u64,
    /// All objects, in the order in which the file will have them.
    pub objects: Vec<ObjectEdit>,
    /// How the camera is turned, and how wide it sees.
    #[serde(default)]
    pub turn: Option<Turn>,
    /// Height of the camera over the ground, metres.
    #[serde(default)]
    pub height_m: Option<f64>,
    /// Where the sun is.
    #[serde(default)]
    pub sun: Option<SunEdit>,
    /// A shadow in the photograph.
    #[serde(default)]
    pub shadow: Option<ShadowEdit>,
    /// Exposure of the light, stops.
    #[serde(default)]
    pub exposure_ev: Option<f64>,
    /// Whether the painted mask is used.
    #[serde(default)]
    pub mask: bool,
}

impl Edit {
    /// All of it that a record of light transport depends on.
    pub fn without_light(&self) -> Self {
        Self {
            sun: None,
            exposure_ev: None,
            ..self.clone()
        }
    }
}

/// An object.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectEdit {
    /// Index of the object of the file that it is, or is a copy of.
    pub of: usize,
    /// Where it stands, pixels of the photograph.
    #[serde(default)]
    pub at: Option<[f64; 2]>,
    /// Turn about the up direction, degrees.
    #[serde(default)]
    pub yaw_deg: Option<f64>,
    /// Factor on the size that the file says.
    #[serde(default)]
    pub size: Option<f64>,
}

/// A camera's direction over a level ground, and its field of view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Turn {
    /// Upwards, degrees.
    pub pitch_deg: f64,
    /// Clockwise about the line of sight, degrees.
    pub roll_deg: f64,
    /// Vertical field of view, degrees.
    pub fov_deg: f64,
}

/// A sun by its direction.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SunEdit {
    /// From the view to the right, degrees.
    pub azimuth_deg: f64,
    /// Above the horizon, degrees.
    pub elevation_deg: f64,
}

/// A shadow, pixels of the photograph.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShadowEdit {
    /// Where the thing stands.
    pub foot: [f64; 2],
    /// Where the shadow of its top falls.
    pub tip: [f64; 2],
    /// Height of the thing, metres.
    #[serde(default)]
    pub height_m: Option<f64>,
}

impl Edit {
    /// An edit that changes nothing of a file as it was opened, with this many objects.
    pub fn none(objects: usize) -> Self {
        let object = |of| ObjectEdit {
            of,
            ..ObjectEdit::default()
        };
        Self {
            objects: (0..objects).map(object).collect(),
            ..Self::default()
        }
    }

    /// Refuses numbers that make no sense before anything is computed from them.
    ///
    /// # Errors
    /// The first of them.
    pub fn check(&self) -> anyhow::Result<()> {
        if self.objects.len() > MOST_OBJECTS {
            bail!("more than {MOST_OBJECTS} objects are not placed here");
        }
        let finite = |values: &[f64]| values.iter().all(|v| v.is_finite() && v.abs() < 1e7);
        for object in &self.objects {
            let size = object.size.unwrap_or(1.0);
            let yaw = object.yaw_deg.unwrap_or(0.0);
            if !(finite(&object.at.unwrap_or_default())
                && finite(&[yaw])
                && size > 0.0
                && size < 1e6)
            {
                bail!("an object's pixel, turn or size is no usable number");
            }
        }
        if let Some(height) = self.height_m
            && !(height > 1e-3 && height < 1e5)
        {
            bail!("the camera stands between a millimetre and 100 km above the ground");
        }
        if let Some(turn) = &self.turn
            && !(turn.pitch_deg.abs() <= 90.0
                && turn.roll_deg.abs() <= 180.0
                && (1.0..170.0).contains(&turn.fov_deg))
        {
            bail!(
                "the camera's pitch is within 90 degrees, its roll within 180, its view from 1 to 170"
            );
        }
        if !finite(&[self.exposure_ev.unwrap_or(0.0)])
            || self.exposure_ev.is_some_and(|e| e.abs() > 20.0)
        {
            bail!("an exposure is within 20 stops");
        }
        if let Some(sun) = &self.sun
            && !(sun.azimuth_deg.abs() <= 360.0 && sun.elevation_deg.abs() <= 90.0)
        {
            bail!("the sun's azimuth is within 360 degrees, its elevation within 90");
        }
        if let Some(shadow) = &self.shadow {
            if !(finite(&shadow.foot) && finite(&shadow.tip)) {
                bail!("a shadow's foot or tip is no usable pixel");
            }
            if shadow.foot == shadow.tip {
                bail!("a shadow's foot and tip are two pixels");
            }
            if shadow.height_m.is_some_and(|h| !(1e-3..=1e4).contains(&h)) {
                bail!("what throws the shadow is between a millimetre and 10 km high");
            }
        }
        Ok(())
    }
}
