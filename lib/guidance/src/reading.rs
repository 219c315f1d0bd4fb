//! The light that a model with light captions estimates from crops of the photograph, and the start
//! of the optimisation that is made of it.
use std::ops::ControlFlow;

use dipir_diffusion::model::Model;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_imaging::resize::{CropResize, Filter, PixelBox};
use dipir_light::gaussian::SphericalGaussian;
use dipir_optimize::parameters::Parameters;
use dipir_prior::caption::ViewDirection;
use dipir_prior::encoder::{LightEncoder, SunSkyEstimate};
use dipir_prior::inversion::{Crop, InversionSettings, Reading, invert};
use dipir_prior::picture::SIZE;
use dipir_scene::camera::Camera;
use dipir_scene::proxy::Proxy;
use glam::{DVec3, Vec2, Vec3};

use crate::error::{Error, Result};

/// Side of a crop, in units of the longer side of the object's box. In the pictures that the model was trained on, the
/// object's box is about two fifths as long as the picture.
const CROP: f32 = 2.6;
/// Most crops from which light is estimated.
const CROPS: usize = 12;
/// The first of them, around the place of the insertion.
const NEAR: usize = 3;
/// Least width of the sun's lobe at the start, radians: the middle of the widths in training.
const SUN_SIGMA: f32 = 0.07;
/// Added width of the sun's lobe for each radian of the azimuth's uncertainty: a narrow lobe would cast
/// a hard shadow in the wrong place.
const HEDGE: f32 = 0.5;
/// Largest width of the sun's lobe, radians.
const WIDEST: f32 = 0.8;
/// Albedo of the ground: the share of its light that it reflects.
const GROUND_ALBEDO: f32 = 0.3;

/// Where an object is inserted.
#[derive(Clone, Copy)]
pub struct Insertion<'a> {
    /// The camera that took the photograph.
    pub camera: &'a Camera,
    /// The ground that catches the shadow.
    pub proxy: &'a Proxy,
    /// The object's pixels.
    pub object: PixelBox,
}

/// Horizontal unit vectors: where the camera looks, and its right.
fn ground_axes(camera: &Camera) -> (Vec3, Vec3) {
    let flat = |v: Vec3| Vec3::new(v.x, 0.0, v.z);
    // A camera that looks straight down has its forward where its top is.
    let forward = flat(-camera.rotation.z_axis);
    let forward = if forward.length() > 1e-3 {
        forward
    } else {
        flat(camera.rotation.y_axis)
    };
    let forward = forward.normalize_or(Vec3::NEG_Z);
    (forward, forward.cross(Vec3::Y))
}

/// The direction of an azimuth that is relative to the camera, and an elevation.
fn direction(camera: &Camera, azimuth: f32, elevation: f32) -> Vec3 {
    let (forward, right) = ground_axes(camera);
    let (s, c) = azimuth.sin_cos();
    (forward * c + right * s) * elevation.cos() + Vec3::Y * elevation.sin()
}

/// The planes [3, SIZE, SIZE] of a square picture, clamped to [0, 1].
pub fn planes(picture: &Raster<Vec3>) -> Vec<f32> {
    dipir_tensors::planes(&picture.map(|p| p.clamp(Vec3::ZERO, Vec3::ONE)))
}

fn crop_of(photo: &Raster<Vec3>, camera: &Camera, region: PixelBox) -> Crop {
    let size = (photo.width(), photo.height());
    let resize = CropResize::new(size, region, (SIZE, SIZE), Filter::Tent);
    Crop {
        picture: planes(&resize.apply(photo)),
        view_direction: view_direction(camera, region),
    }
}

/// Where the middle of `region` lies: azimuths of a crop are relative to its heading.
pub fn view_direction(camera: &Camera, region: PixelBox) -> ViewDirection {
    let corner = Vec2::new(region.x as f32, region.y as f32);
    let half = Vec2::new(region.width as f32, region.height as f32) * 0.5;
    let ray = camera.ray(corner + half).direction;
    let (forward, right) = ground_axes(camera);
    ViewDirection::along(ray, forward, right)
}

/// A square of `side` around a point, moved into the picture.
fn square(size: (usize, usize), center: Vec2, side: f32) -> PixelBox {
    let side = (side.round() as usize).clamp(1, size.0.min(size.1));
    let start = |c: f32, limit: usize| {
        let first = (c - 0.5 * side as f32).round().max(0.0) as usize;
        first.min(limit - side)
    };
    PixelBox {
        x: start(center.x, size.0),
        y: start(center.y, size.1),
        width: side,
        height: side,
    }
}

/// How much the middle of a crop stands out from what surrounds it: the distance of their mean colours, in standard
/// deviations of the surroundings.
fn interest(picture: &[f32]) -> f32 {
    let n = SIZE * SIZE;
    let inside = |i: usize, margin: usize| {
        let kept = margin..SIZE - margin;
        kept.contains(&(i % SIZE)) && kept.contains(&(i / SIZE))
    };
    let (mut middle, mut around): (Vec<Vec3>, Vec<Vec3>) = (vec![], vec![]);
    for i in 0..n {
        let color = Vec3::new(picture[i], picture[n + i], picture[2 * n + i]);
        if inside(i, 3 * SIZE / 8) {
            middle.push(color);
        } else if inside(i, SIZE / 8) && !inside(i, SIZE / 4) {
            around.push(color);
        }
    }
    let mean = |v: &[Vec3]| v.iter().sum::<Vec3>() / v.len() as f32;
    let (center, ring) = (mean(&middle), mean(&around));
    let spread = around.iter().map(|c| c.distance_squared(ring)).sum::<f32>();
    center.distance(ring) / (0.05 + (spread / around.len() as f32).sqrt())
}

/// How far away the ground under a pixel is, along the view; `None` where there is none.
fn ground_depth(camera: &Camera, proxy: &Proxy, pixel: Vec2) -> Option<f32> {
    let Proxy::Plane(plane) = proxy else {
        return None;
    };
    let ray = camera.ray(pixel);
    let t = (plane.point - ray.origin).dot(plane.normal) / ray.direction.dot(plane.normal);
    let depth = t * ray.direction.dot(-camera.rotation.z_axis);
    (depth.is_finite() && depth > 0.0).then_some(depth)
}

/// Sizes at which the photograph's own objects are searched for, as multiples of the inserted
/// object's size.
const OWN_SIZES: [f32; 4] = [0.2, 0.4, 0.7, 1.1];
/// Smallest side of a crop, pixels: less holds too little of an object.
const SMALLEST: f32 = 24.0;
/// Least contrast of a crop's middle with its surroundings for it to be taken for an object.
const LEAST_INTEREST: f32 = 0.4;

/// Squares of the photograph: the first three around the place of the insertion, the others where
/// something seems to stand on the ground.
fn crops(photo: &Raster<Vec3>, place: &Insertion<'_>) -> Vec<Crop> {
    let &Insertion {
        camera,
        proxy,
        object,
    } = place;
    let size = (photo.width(), photo.height());
    let longer = object.width.max(object.height) as f32;
    let corner = Vec2::new(object.x as f32, object.y as f32);
    let extent = Vec2::new(object.width as f32, object.height as f32);
    let middle = corner + extent * 0.5;
    let mut chosen: Vec<Crop> = [1.0, 1.35, 0.8]
        .map(|scale| crop_of(photo, camera, square(size, middle, CROP * longer * scale)))
        .into();
    let near = ground_depth(camera, proxy, corner + extent * Vec2::new(0.5, 1.0));
    // Scores and places alone: of a large photograph there are many more crops than are taken.
    let mut found: Vec<(f32, Vec2, f32)> = vec![];
    let crop_at = |at: Vec2, side: f32| crop_of(photo, camera, square(size, at, side));
    for own in OWN_SIZES {
        // The side of a crop whose foot is at a row of pixels: as many metres there as the first crop has at the object.
        let side_at = |row: f32| {
            let depth = |row| ground_depth(camera, proxy, Vec2::new(0.5 * size.0 as f32, row));
            match (near, depth(row)) {
                (Some(near), Some(far)) => Some(CROP * longer * own * near / far),
                (None, _) => Some(CROP * longer * own),
                (Some(_), None) => None,
            }
        };
        let mut foot = 0.0;
        while foot < size.1 as f32 {
            let side = side_at(foot).filter(|s| *s >= SMALLEST);
            let Some(side) = side else {
                foot += 2.0;
                continue;
            };
            let middle = foot - 0.12 * side;
            let fits = middle >= 0.5 * side && middle + 0.5 * side <= size.1 as f32;
            let mut x = 0.5 * side;
            while fits && x + 0.5 * side <= size.0 as f32 {
                let at = Vec2::new(x, middle);
                let score = interest(&crop_at(at, side).picture);
                if score > LEAST_INTEREST {
                    found.push((score, at, side));
                }
                x += 0.12 * side;
            }
            foot += (0.12 * side).max(1.0);
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut taken: Vec<(Vec2, f32)> = vec![];
    for (_, at, side) in found {
        if chosen.len() == CROPS {
            break;
        }
        let apart = |(t, s): &(Vec2, f32)| t.distance(at) > 0.35 * side.max(*s);
        if taken.iter().all(apart) {
            taken.push((at, side));
            chosen.push(crop_at(at, side));
        }
    }
    chosen
}

/// Estimates the light from `photo`, display values, around the place of the insertion; `None` if the
/// model has no light encoder. `progress` gets the share that is done, and may stop the work.
///
/// # Errors
/// Those of the model; [`Error::Interrupted`] if `progress` stopped the work.
pub fn read_light(
    model: &Model,
    photo: &DisplayImage,
    place: &Insertion<'_>,
    settings: &InversionSettings,
    seed: u64,
    progress: &(dyn Fn(f64) -> ControlFlow<()> + Sync),
) -> Result<Option<Reading>> {
    let Some(encoder) = LightEncoder::load(&model.folder)? else {
        return Ok(None);
    };
    let crops = crops(&photo.0, place);
    match invert(model, &encoder, &crops, NEAR, settings, seed, progress)? {
        Some(reading) => Ok(Some(reading)),
        None => Err(Error::Interrupted),
    }
}

/// The start of the optimisation under an estimate of the light.
pub fn start(estimate: &SunSkyEstimate, camera: &Camera, lobes: usize) -> Parameters {
    let words = &estimate.description;
    let tint = |warmth: f32| {
        let v = Vec3::new((0.5 * warmth).exp(), 1.0, (-0.5 * warmth).exp());
        v * (3.0 / v.element_sum())
    };
    let total = estimate.irradiance;
    let sky = tint(estimate.sky_warmth) * ((1.0 - words.sun_share) * total / std::f32::consts::PI);
    let on_ground = tint(estimate.warmth) * (words.sun_share * total);
    let ground = (sky + on_ground / std::f32::consts::PI) * GROUND_ALBEDO;
    let sun = (!words.is_overcast()).then(|| {
        let lobe = SphericalGaussian {
            direction: direction(camera, words.azimuth, words.elevation),
            radiance: Vec3::ONE,
            sigma: SUN_SIGMA.hypot(HEDGE * estimate.spread()).min(WIDEST),
        };
        // Irradiance of the ground if the lobe's radiance is 1; at the horizon it would be next to nothing.
        let of_one = lobe.irradiance(Vec3::Y).x.max(0.1 * lobe.solid_angle());
        SphericalGaussian {
            radiance: on_ground / of_one as f32,
            ..lobe
        }
    });
    let wide = |v: Vec3| -> DVec3 { v.as_dvec3() };
    Parameters::from_light(lobes, wide(sky), wide(ground), sun.as_ref())
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_scene::camera::FieldOfView;
    use dipir_scene::proxy::Plane;

    #[test]
    fn azimuths_turn_from_the_view_to_the_right() {
        let camera = Camera::look_at(
            Vec3::new(3.0, 1.0, 0.0),
            Vec3::ZERO,
            Vec3::Y,
            FieldOfView::Vertical(0.7),
            [64, 48],
        );
        // Looking along -x: right is -z.
        let ahead = direction(&camera, 0.0, 0.0);
        let right = direction(&camera, std::f32::consts::FRAC_PI_2, 0.0);
        assert!(ahead.distance(Vec3::NEG_X) < 1e-5, "{ahead}");
        assert!(right.distance(Vec3::NEG_Z) < 1e-5, "{right}");
    }

    #[test]
    fn the_start_sends_the_light_that_was_estimated() {
        let camera = Camera::look_at(
            Vec3::new(0.0, 1.0, 3.0),
            Vec3::ZERO,
            Vec3::Y,
            FieldOfView::Vertical(0.7),
            [64, 48],
        );
        let estimate = SunSkyEstimate {
            description: dipir_prior::caption::LightDescription {
                azimuth: 0.4,
                elevation: 0.8,
                sun_share: 0.7,
            },
            confidence: 1.0,
            irradiance: 2.0,
            warmth: 0.0,
            sky_warmth: 0.0,
        };
        let width = |confidence: f32| {
            let estimate = SunSkyEstimate {
                confidence,
                ..estimate
            };
            let lobes = start(&estimate, &camera, 32).foreground_lobes();
            assert_eq!(lobes.len(), 32);
            let ground: DVec3 = lobes.iter().map(|l| l.irradiance(Vec3::Y)).sum();
            // Candidates near the horizon and the ambient lobe's slope leave some percent.
            assert!(
                (ground.y / 2.0 - 1.0).abs() < 0.15,
                "{confidence}: {ground}"
            );
            let sun = lobes
                .iter()
                .max_by(|a, b| a.radiance.x.total_cmp(&b.radiance.x));
            sun.expect("lobes").sigma
        };
        // An uncertain azimuth casts no hard shadow.
        let widths = [1.0, 0.95, 0.7, 0.0].map(width);
        assert!((widths[0] - SUN_SIGMA).abs() < 1e-3, "{widths:?}");
        assert!(widths.is_sorted_by(|a, b| a < b), "{widths:?}");
    }

    /// Grey ground seen from above, and the camera that sees it.
    fn ground(width: usize, height: usize) -> (Raster<Vec3>, Camera, Proxy) {
        let camera = Camera::look_at(
            Vec3::new(0.0, 2.0, 3.0),
            Vec3::ZERO,
            Vec3::Y,
            FieldOfView::Vertical(0.7),
            [width as u32, height as u32],
        );
        let plane = Plane {
            point: Vec3::ZERO,
            normal: Vec3::Y,
        };
        let photo = Raster::filled(width, height, Vec3::splat(0.5));
        (photo, camera, Proxy::Plane(plane))
    }

    #[test]
    fn what_stands_at_the_right_is_turned_to_by_its_angle_on_the_ground() {
        let (_, camera, _) = ground(160, 120);
        let at = |x: usize| PixelBox {
            x,
            y: 50,
            width: 20,
            height: 20,
        };
        assert!(view_direction(&camera, at(70)).heading.abs() < 1e-6);
        let (left, right) = (
            view_direction(&camera, at(0)).heading,
            view_direction(&camera, at(140)).heading,
        );
        assert!((left + right).abs() < 1e-6);
        // The middle of the picture is 3 metres away and 2 below.
        let down = (2f32 / 3.0).atan();
        assert!((view_direction(&camera, at(70)).pitch - down).abs() < 1e-6);
        // Of the ground point that is seen there.
        let ray = camera.ray(Vec2::new(150.0, 60.0)).direction;
        let (forward, across) = ground_axes(&camera);
        let tangent = ray.dot(across) / ray.dot(forward);
        assert!(
            right > 0.2 && (right.tan() - tangent).abs() < 1e-5,
            "{right}"
        );
    }

    #[test]
    fn crops_stay_inside_small_and_large_pictures() {
        let (photo, camera, proxy) = ground(40, 30);
        for side in [1, 8, 30] {
            let object = PixelBox {
                x: 3,
                y: 0,
                width: side,
                height: side,
            };
            let place = Insertion {
                camera: &camera,
                proxy: &proxy,
                object,
            };
            let found = crops(&photo, &place);
            // Nothing stands on empty ground.
            assert_eq!(found.len(), 3);
            assert!(found.iter().all(|c| c.picture.len() == 3 * SIZE * SIZE));
        }
    }

    #[test]
    fn an_object_of_the_photograph_is_found_and_stands_in_the_middle_of_its_crop() {
        let (mut photo, camera, proxy) = ground(160, 120);
        for y in 50..66 {
            for x in 110..126 {
                photo.pixels_mut()[y * 160 + x] = Vec3::new(0.8, 0.2, 0.1);
            }
        }
        let object = PixelBox {
            x: 30,
            y: 50,
            width: 24,
            height: 24,
        };
        let place = Insertion {
            camera: &camera,
            proxy: &proxy,
            object,
        };
        let found = crops(&photo, &place);
        assert!(found.len() > 3);
        let n = SIZE * SIZE;
        let red = |i: usize| found[3].picture[i] > 0.7;
        let (mut sum, mut count) = (Vec2::ZERO, 0);
        for i in (0..n).filter(|i| red(*i)) {
            sum += Vec2::new((i % SIZE) as f32, (i / SIZE) as f32);
            count += 1;
        }
        let middle = sum / count as f32;
        assert!(middle.distance(Vec2::splat(15.5)) < 5.0, "{middle}");
        // Towards the right of the view.
        assert!(
            found[3].view_direction.heading > 0.02,
            "{:?}",
            found[3].view_direction
        );
    }
}
