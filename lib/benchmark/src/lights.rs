//! Maps of methods that need no optimisation, on the photograph's scale.
use dipir_imaging::raster::LinearImage;
use dipir_light::environment::EnvironmentMap;
use dipir_light::fit::fit;
use dipir_light::rasterize::rasterize;
use dipir_scene::camera::Camera;
use dipir_stages::composite::table::Tone;
use dipir_stages::known_light;
use glam::{DVec3, Vec3};

/// Columns and rows of projected maps.
const PROJECTED: [usize; 2] = [256, 128];
/// Columns and rows of the map of fitted lobes. A texel has .35 degrees, so that a sun hardly gets wider.
const FITTED: [usize; 2] = [1024, 512];
/// Lobes that are fitted to a map: as many as the optimiser has.
const LOBES: usize = 32;

/// Exposed light before the camera's curve, from a value behind it. Values above .95, where Reinhard's
/// curve is flat, count as .95.
fn before_curve(tone: Tone, value: Vec3) -> Vec3 {
    match tone {
        Tone::None => value,
        Tone::Reinhard => {
            let v = value.clamp(Vec3::ZERO, Vec3::splat(0.95));
            v / (Vec3::ONE - v)
        }
    }
}

/// A light from everywhere that is as bright as the photograph in its mean.
pub fn neutral(photo: &LinearImage, tone: Tone) -> EnvironmentMap {
    let pixels = photo.0.pixels();
    let sum = pixels
        .iter()
        .map(|p| before_curve(tone, *p).as_dvec3())
        .sum::<DVec3>();
    let mean = (sum / pixels.len() as f64).as_vec3();
    EnvironmentMap::constant(8, 4, mean)
}

/// The photograph in the directions that it shows: a light without any model.
pub fn projected(
    photo: &LinearImage,
    tone: Tone,
    camera: &Camera,
) -> anyhow::Result<EnvironmentMap> {
    let exposed = LinearImage(photo.0.map(|p| before_curve(tone, *p)));
    known_light::projected(&exposed, camera, PROJECTED)
}

/// Lobes fitted to the truth: the best that the representation can do.
pub fn fitted(truth: &EnvironmentMap) -> EnvironmentMap {
    fitted_lobes(truth, LOBES, FITTED)
}

fn fitted_lobes(
    truth: &EnvironmentMap,
    count: usize,
    [width, height]: [usize; 2],
) -> EnvironmentMap {
    rasterize(&fit(truth, count).lobes, width, height)
}

#[cfg(test)]
mod tests {
    use dipir_imaging::raster::Raster;
    use dipir_scene::camera::FieldOfView;

    use super::*;

    fn plain(value: Vec3) -> LinearImage {
        LinearImage(Raster::filled(12, 8, value))
    }

    #[test]
    fn a_neutral_light_is_the_photograph_s_mean_before_the_curve() {
        let map = neutral(&plain(Vec3::splat(0.5)), Tone::Reinhard);
        assert!(map.texels().iter().all(|t| t.distance(Vec3::ONE) < 1e-5));
    }

    #[test]
    fn a_projected_light_shows_the_photograph_where_the_camera_looks() {
        let mut photo = plain(Vec3::splat(0.5));
        // The left half is dark.
        for y in 0..8 {
            for x in 0..6 {
                *photo.0.get_mut(x, y) = Vec3::ZERO;
            }
        }
        let camera = Camera::look_at(
            Vec3::ZERO,
            Vec3::NEG_Z,
            Vec3::Y,
            FieldOfView::Vertical(1.0),
            [12, 8],
        );
        let map = projected(&photo, Tone::Reinhard, &camera).unwrap();
        // Looking along -z, left is -x; what is behind is mirrored, so left stays left.
        for z in [-1.0, 1.0] {
            let left = map.eval(Vec3::new(-0.3, 0.0, z).normalize());
            let right = map.eval(Vec3::new(0.3, 0.0, z).normalize());
            assert!(
                left.x < 0.01 && (right.x - 1.0).abs() < 1e-4,
                "{left} {right}"
            );
        }
    }

    #[test]
    fn fitted_lobes_keep_the_energy() {
        let mut texels = vec![Vec3::splat(0.3); 64 * 32];
        texels[8 * 64 + 20] = Vec3::splat(200.0);
        let truth = EnvironmentMap::new(64, 32, texels).unwrap();
        let ratio = fitted_lobes(&truth, 3, [64, 32]).integral() / truth.integral();
        assert!((ratio.x - 1.0).abs() < 0.02, "{ratio}");
    }
}
