//! The light around the place as a map. Where the photograph shows the surroundings, the map shows
//! them as the photograph does.
use dipir_estimator::{Visible, merged, overlaid};
use dipir_light::environment::EnvironmentMap;
use dipir_light::gaussian::SphericalGaussian;
use dipir_light::rasterize::rasterize;
use dipir_scene::scene::LoadedScene;

use super::exposed;

/// Columns and rows of the map: texels of .7 degrees, about what a photograph resolves of its own
/// view when it is reflected by a small object.
pub(super) const MAP: [usize; 2] = [512, 256];
/// A lobe narrower than this, radians, is traced as a lobe: two texels of the map.
const NARROW: f32 = 2.0 * std::f32::consts::TAU / MAP[0] as f32;

/// `lobes` with the narrow ones first, and how many these are.
pub(super) fn narrow_first(lobes: &[SphericalGaussian]) -> (Vec<SphericalGaussian>, usize) {
    let (narrow, wide): (Vec<_>, Vec<_>) = lobes.iter().partition(|l| l.sigma < NARROW);
    let sources = narrow.len();
    (narrow.into_iter().chain(wide).copied().collect(), sources)
}

/// The map of `lobes`.
pub(super) fn map_of(lobes: &[SphericalGaussian]) -> EnvironmentMap {
    rasterize(lobes, MAP[0], MAP[1])
}

/// `light` with what the photograph and the `others` of its place show, if that is wanted.
pub(super) fn surroundings(
    loaded: &LoadedScene,
    others: &[Visible],
    light: &EnvironmentMap,
    visible: bool,
) -> EnvironmentMap {
    let [width, height] = MAP;
    match visible {
        true => {
            let camera = &loaded.scene.camera;
            let seen = exposed::visible(loaded.taken(), &loaded.photo.image, camera, MAP);
            merged(&seen, &with_others(others, light))
        }
        false => light.resampled(width, height),
    }
}

/// `light` with what the other photographs of the place show.
pub(super) fn with_others(others: &[Visible], light: &EnvironmentMap) -> EnvironmentMap {
    let add = |light: EnvironmentMap, seen: &Visible| overlaid(seen, &light);
    others.iter().fold(light.clone(), add)
}
