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
            let seen = exposed::visible(loaded.taken(), &loaded.radiance(), camera, MAP);
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

#[cfg(test)]
mod tests {
    use clap::Parser;
    use dipir_cli::session::Session;
    use dipir_scene::config::SceneConfig;
    use dipir_scene::scene::Scene;
    use glam::Vec3;

    use super::*;
    use crate::command_line::light::Cli;

    /// White above, grey below; a gain map of 3 stops on the white.
    const PHOTO: &[u8] = include_bytes!("../../../../fuzz/seeds/photograph/gain_map.jpg");

    #[test]
    fn a_gain_map_makes_what_is_seen_brighter_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("photo.jpg"), PHOTO).unwrap();
        let object = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
        std::fs::write(folder.path().join("object.obj"), object).unwrap();
        let seen = |lens: &str, gain: bool| {
            let text = format!(
                "[scene]\nbackground = \"photo.jpg\"\n[[scene.objects]]\npath = \"object.obj\"\nposition = [0.0, 0.0, 0.0]\n\
                 [scene.camera]\nposition = [0.0, 1.6, 5.0]\nlook_at = [0.0, 1.6, 0.0]\nfov_deg = 50.0\n{lens}\
                 [scene.proxy]\nplane = {{ point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }}\n"
            );
            let file = folder.path().join("pipeline.toml");
            std::fs::write(&file, text).unwrap();
            let args = ["dipir-light", "-q", "-p", &file.display().to_string()];
            let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
            let config: SceneConfig = session.config.table("scene").unwrap();
            let mut loaded = Scene::load(&config, folder.path()).unwrap();
            assert!(loaded.taken().gain.is_some(), "{:?}", loaded.warnings);
            if !gain {
                let photo = loaded.original.as_mut().map(|o| &mut o.photo);
                photo.unwrap_or(&mut loaded.photo).gain = None;
            }
            let dark = EnvironmentMap::constant(8, 4, Vec3::splat(0.01));
            surroundings(&loaded, &[], &dark, true)
        };
        for lens in ["", "distortion = { k1 = -0.1 }\n"] {
            let (brighter, plain) = (seen(lens, true), seen(lens, false));
            let at = |map: &EnvironmentMap, y: f32| {
                let (i, j) = map.texel_of(Vec3::new(0.0, y, -1.0).normalize());
                map.texel(i, j)
            };
            let (sky, ground) = (at(&brighter, 0.25).x, at(&brighter, -0.25));
            // (1 + 1/64) 2^3 - 1/64. A texel is the mean of places, which JPEG leaves within a hundredth of white.
            assert!((sky - 8.109).abs() < 0.08, "{sky}");
            assert!((at(&plain, 0.25).x - 1.0).abs() < 0.01);
            assert_eq!(ground, at(&plain, -0.25));
        }
    }
}
