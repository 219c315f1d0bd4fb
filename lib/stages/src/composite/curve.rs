//! The tone curve on object and shadow.
use dipir_imaging::file::Photo;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::tone::ToneCurves;
use glam::Vec3;

use super::Source;
use super::table::Tone;
use crate::light::exposed;

/// What is done to the light of the object and to the shadow before they are laid over the
/// photograph.
pub(super) enum Curve {
    None,
    /// On the object's own colour, which is `rgb / alpha`.
    Object(Box<ToneCurves>),
    /// Reinhard and a spline on the object, a spline per channel on the shadow.
    Recovered(Box<ToneCurves>),
}

impl Curve {
    /// The table's, else the one that was recovered with the light, else none.
    pub(super) fn of(tone: Option<Tone>, light: &Source, taken: &Photo) -> Self {
        match (tone, light) {
            (Some(tone), _) => match tone.curves() {
                Some(curves) => Self::Object(Box::new(curves)),
                None => Self::None,
            },
            (None, Source::Map(_)) => Self::None,
            (None, Source::Recovered(light)) => match exposed::tone(taken, light.tone) {
                Some(tone) => Self::Recovered(Box::new(tone)),
                None => Self::None,
            },
        }
    }

    /// The curves, if there are any.
    pub(super) fn curves(&self) -> Option<&ToneCurves> {
        match self {
            Self::None => None,
            Self::Object(curves) | Self::Recovered(curves) => Some(curves),
        }
    }

    pub(super) fn apply(
        &self,
        object: Raster<Vec3>,
        alpha: &Raster<f32>,
        shadow: Raster<Vec3>,
    ) -> (Raster<Vec3>, Raster<Vec3>) {
        let object = LinearImage(object);
        match self {
            Self::None => (object.0, shadow),
            Self::Object(curves) => (curves.apply_object(&object, alpha).0, shadow),
            Self::Recovered(curves) => (
                curves.apply_object(&object, alpha).0,
                curves.apply_shadow(&LinearImage(shadow)).0,
            ),
        }
    }
}
