//! Photographs of linear light, as OpenEXR and Radiance store it. Their exposure is arbitrary, no value is white, and
//! nothing is clipped: they are looked at as a camera would expose them.
use dipir_estimator::{BORDER_DEG, Estimator, LightEstimate, Visible};
use dipir_imaging::exposure::automatic_exposure_ev;
use dipir_imaging::file::Photo;
use dipir_imaging::raster::LinearImage;
use dipir_imaging::tone::ToneCurves;
use dipir_scene::camera::Camera;

/// Whether a photograph, as it was read, is linear light without a white.
pub(crate) fn is_linear(taken: &Photo) -> bool {
    taken.values.is_none()
}

/// The factor that exposes a photograph as a camera would; 1 if a camera exposed it. `taken` is the photograph as it was
/// read, `image` the same without the distortion of its lens.
pub(crate) fn gain(taken: &Photo, image: &LinearImage) -> f32 {
    match is_linear(taken) {
        // Beyond a million times, numbers say nothing of a picture.
        true => automatic_exposure_ev(image).clamp(-20.0, 20.0).exp2(),
        false => 1.0,
    }
}

/// The light of a photograph, on its scale.
pub(super) fn estimate(
    estimator: &Estimator,
    taken: &Photo,
    image: &LinearImage,
    camera: &Camera,
) -> LightEstimate {
    let gain = gain(taken, image);
    if gain == 1.0 {
        return estimator.estimate(image, camera);
    }
    let exposed = LinearImage(image.0.map(|p| *p * gain));
    estimator.estimate(&exposed, camera).scaled(gain.recip())
}

/// What a photograph shows of the light, in `size` texels. `radiance` is the photograph with its gain map, where it has one.
pub(super) fn visible(
    taken: &Photo,
    radiance: &LinearImage,
    camera: &Camera,
    size: [usize; 2],
) -> Visible {
    let most = taken.gain.as_ref().map_or(1.0, |gain| gain.most());
    let seen = Visible::up_to(most, radiance, camera, size, BORDER_DEG);
    match is_linear(taken) {
        true => seen.unclipped(),
        false => seen,
    }
}

/// The curve on the object where the configuration names none: the one that was recovered. Where none was, linear light
/// has none.
pub(crate) fn tone(taken: &Photo, found: ToneCurves) -> Option<ToneCurves> {
    (!is_linear(taken) || found != ToneCurves::identity()).then_some(found)
}
