//! Properties of estimates that hold for any weights.
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_light::environment::EnvironmentMap;
use dipir_light::gaussian::SgMixture;
use dipir_light::luminance::luminance;
use dipir_scene::camera::{Camera, FieldOfView};
use glam::{DVec3, Vec3};

use crate::features::{FEATURES, OF_PARTS, SmallPhoto};
use crate::grid::{BINS, bin_direction, direction, heading, relative};
use crate::network::{HISTOGRAM, Network, OUTPUTS, Sight};
use crate::posterior::{PeakPosterior, words};
use crate::{Calibration, Estimator, LightEstimate, ViewEstimate, Visible, combine, merged};

/// The direction at degrees of azimuth and elevation relative to the view.
fn direction_deg(azimuth: f64, elevation: f64) -> Vec3 {
    direction(azimuth.to_radians() as f32, elevation.to_radians() as f32)
}

pub(crate) fn estimator() -> Estimator {
    brighter([0.0; 2])
}

/// The estimator of the tests whose two networks see a light that is brighter by these logarithms.
fn brighter(by: [f32; 2]) -> Estimator {
    let wave = |n: usize, scale: f32| {
        (0..n)
            .map(|k| scale * (0.37 * (k * k % 1013) as f32).sin())
            .collect::<Vec<_>>()
    };
    let hidden = 8;
    let mut bias = wave(OUTPUTS, 0.5);
    bias[HISTOGRAM + 40] += 3.0;
    let brighter = |by: f32| {
        let mut bias = bias.clone();
        bias[..HISTOGRAM].iter_mut().for_each(|b| *b += by);
        bias
    };
    let network = |sight: Sight, by: f32| Network {
        sight,
        hidden,
        mean: vec![0.0; sight.count()],
        deviation: vec![1.0; sight.count()],
        first: [wave(sight.count() * hidden, 0.1), vec![0.1; hidden]],
        second: [wave(hidden * hidden, 0.3), vec![0.0; hidden]],
        output: [wave(hidden * OUTPUTS, 0.3), brighter(by)],
    };
    let [parts, kind] = Sight::ALL;
    let pair = [network(parts, by[0]), network(kind, by[1])];
    Estimator::new(vec![pair], Vec::new(), Calibration::default()).unwrap()
}

/// A picture that is not its own mirror image.
pub(crate) fn photo(width: usize, height: usize) -> LinearImage {
    let pixel = |k: usize| {
        let (x, y) = (
            (k % width) as f32 / width as f32,
            (k / width) as f32 / height as f32,
        );
        Vec3::new(0.2 + 0.6 * x, 0.3 + 0.3 * y, 0.5 * (1.0 - y) + 0.2 * x * y)
    };
    LinearImage(Raster::from_pixels(
        width,
        height,
        (0..width * height).map(pixel).collect(),
    ))
}

fn mirrored(photo: &LinearImage) -> LinearImage {
    let pixels = (0..photo.0.height()).flat_map(|y| photo.0.row(y).iter().rev().copied());
    LinearImage(Raster::from_pixels(
        photo.0.width(),
        photo.0.height(),
        pixels.collect(),
    ))
}

/// A level camera at eye height that looks to an azimuth, degrees.
pub(crate) fn camera(azimuth_deg: f32, width: u32, height: u32) -> Camera {
    let (sin, cos) = azimuth_deg.to_radians().sin_cos();
    let eye = Vec3::new(0.0, 1.6, 0.0);
    let ahead = eye + Vec3::new(sin, -0.2, -cos);
    Camera::look_at(
        eye,
        ahead,
        Vec3::Y,
        FieldOfView::Vertical(0.8),
        [width, height],
    )
}

pub(crate) fn finite(e: &LightEstimate) -> bool {
    let map = e.map();
    let texels = map
        .texels()
        .iter()
        .all(|t| t.is_finite() && t.min_element() >= 0.0);
    let intervals = [e.exposure_stops, e.share, e.azimuth_deg, e.elevation_deg];
    texels
        && intervals
            .iter()
            .all(|i| i.low <= i.middle && i.middle <= i.high && i.high.is_finite())
}

#[test]
fn a_turned_camera_turns_the_light_with_it() {
    let (estimator, photo) = (estimator(), photo(60, 40));
    let here = estimator.estimate(&photo, &camera(0.0, 60, 40));
    // A quarter turn is 16 whole texels, so that maps agree to the rounding of the camera's rays.
    let there = estimator.estimate(&photo, &camera(90.0, 60, 40));
    assert!((there.heading_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-6);
    let turned = here.map().rotated_y(-std::f64::consts::FRAC_PI_2);
    for (a, b) in turned.texels().iter().zip(there.map().texels()) {
        assert!(a.distance(*b) < 1e-3 * (1.0 + a.length()), "{a} {b}");
    }
}

#[test]
fn a_mirrored_photograph_has_mirrored_light() {
    let (estimator, photo, camera) = (estimator(), photo(64, 64), camera(0.0, 64, 64));
    let (plain, other) = (
        estimator.estimate(&photo, &camera).map(),
        estimator.estimate(&mirrored(&photo), &camera).map(),
    );
    let width = plain.width();
    for (k, a) in plain.texels().iter().enumerate() {
        let b = other.texel(k / width, width - 1 - k % width);
        assert!(
            a.distance(b) < 1e-3 * (1.0 + a.length()),
            "texel {k}: {a} {b}"
        );
    }
}

#[test]
fn brightness_is_told_by_the_network_that_sees_the_kind_of_place() {
    let (photo, camera) = (photo(60, 40), camera(0.0, 60, 40));
    let map = |by: [f32; 2]| brighter(by).estimate(&photo, &camera).map();
    let (plain, parts, kind) = (map([0.0; 2]), map([0.7, 0.0]), map([0.0, 0.7]));
    for (k, p) in plain.texels().iter().enumerate() {
        assert!(parts.texels()[k].distance(*p) < 1e-4 * p.length());
        assert!((kind.texels()[k] / 0.7f32.exp()).distance(*p) < 1e-4 * p.length());
    }
}

#[test]
fn the_same_photograph_has_the_same_estimate_to_the_bit() {
    let (estimator, photo, camera) = (estimator(), photo(90, 50), camera(30.0, 90, 50));
    assert_eq!(
        estimator.estimate(&photo, &camera),
        estimator.estimate(&photo, &camera)
    );
}

#[test]
fn looking_down_with_the_head_to_the_north_is_heading_north() {
    let down = Camera::look_at(
        Vec3::ZERO,
        Vec3::NEG_Y,
        Vec3::NEG_Z,
        FieldOfView::Vertical(1.0),
        [8, 8],
    );
    assert!(heading(&down).abs() < 1e-6, "{}", heading(&down));
    let up = Camera::look_at(
        Vec3::ZERO,
        Vec3::Y,
        Vec3::Z,
        FieldOfView::Vertical(1.0),
        [8, 8],
    );
    assert!(heading(&up).abs() < 1e-6, "{}", heading(&up));
}

#[test]
fn the_right_of_the_picture_is_the_right_of_the_view() {
    let camera = camera(200.0, 60, 40);
    // What the camera sees at its right edge, in the world.
    let towards = camera.ray(glam::Vec2::new(60.0, 20.0)).direction;
    let seen = relative(towards, &camera);
    assert!(
        (seen.y - towards.y).abs() < 1e-6,
        "elevation stays: {seen} of {towards}"
    );
    assert!(seen.x > 0.3 && seen.z < -0.8, "{seen}");
    let mut ahead = -camera.rotation.z_axis;
    ahead.y = 0.0;
    assert!((relative(ahead.normalize(), &camera) - Vec3::NEG_Z).length() < 1e-6);
}

#[test]
fn lobes_light_surfaces_as_the_map_does() {
    let estimate = estimator().estimate(&photo(60, 40), &camera(20.0, 60, 40));
    let (map, lobes) = (estimate.map(), SgMixture::new(estimate.lobes(24)).unwrap());
    let total = map.integral();
    // The fit keeps each channel's energy; irradiance blurs what it does not resolve.
    assert!((lobes.integral() - total).abs().max_element() < 1e-3 * total.max_element());
    for normal in [Vec3::X, Vec3::Y, Vec3::Z, Vec3::NEG_X, Vec3::NEG_Z] {
        let truth: DVec3 = (0..map.width() * map.height())
            .map(|k| {
                let (i, j) = (k / map.width(), k % map.width());
                let cos = f64::from(map.direction_of(i, j).dot(normal).max(0.0));
                map.texel(i, j).as_dvec3() * map.solid_angle(i) * cos
            })
            .sum();
        let off = (lobes.irradiance(normal) - truth).abs().max_element();
        assert!(
            off < 0.05 * truth.max_element(),
            "{normal}: {off} of {truth}"
        );
    }
}

#[test]
fn a_map_holds_the_energy_of_its_parts() {
    let estimate = estimator().estimate(&photo(60, 40), &camera(0.0, 60, 40));
    let peak = (estimate.map().integral() - estimate.base_map().integral()).as_vec3();
    assert!(
        peak.distance(Vec3::from(estimate.peak)) < 1e-3 * peak.length(),
        "{peak}"
    );
}

#[test]
fn intervals_hold_what_they_say() {
    let sharp = PeakPosterior::normalised((0..BINS).map(|k| f64::from(k == 3 * 24 + 23)).collect());
    let azimuth = sharp.azimuth_interval(0.8);
    // Bin 23 spans 345 to 360 degrees: the shortest arc with .8 of it is 12 degrees long.
    assert!(
        azimuth.low >= -15.1 && azimuth.high <= 0.1 && azimuth.high - azimuth.low < 13.1,
        "{azimuth:?}"
    );
    let elevation = sharp.elevation_interval(0.8);
    assert!(
        elevation.low > 32.0 && elevation.high < 52.0,
        "{elevation:?}"
    );
    let open = PeakPosterior::uniform().azimuth_interval(0.8);
    assert!((open.high - open.low - 288.0).abs() < 0.1, "{open:?}");
}

#[test]
fn an_arc_across_the_back_keeps_its_middle_behind() {
    let mut weights = vec![0.0; BINS];
    (weights[24 + 11], weights[24 + 12]) = (1.0, 1.0);
    let i = PeakPosterior::normalised(weights).azimuth_interval(0.8);
    assert!(
        i.middle.abs() > 174.0 && i.low <= i.middle && i.middle <= i.high,
        "{i:?}"
    );
}

#[test]
fn directions_have_words() {
    assert_eq!(
        words(direction_deg(-140.0, 35.0)),
        "from behind on the left, 35 degrees high"
    );
    assert_eq!(
        words(direction_deg(5.0, -4.0)),
        "from ahead, 4 degrees below the horizon"
    );
    assert_eq!(
        words(direction_deg(90.0, 10.0)),
        "from the right, 10 degrees high"
    );
    assert_eq!(
        words(direction_deg(0.0, 80.0)),
        "from above, 80 degrees high"
    );
}

#[test]
fn candidates_are_far_apart_and_their_probabilities_sum_to_one() {
    let estimate = estimator().estimate(&photo(60, 40), &camera(0.0, 60, 40));
    let all = estimate.candidates(8);
    assert_eq!(all.len(), 8);
    assert!((all.iter().map(|c| c.probability).sum::<f64>() - 1.0).abs() < 1e-9);
    let towards: Vec<Vec3> = all.iter().filter_map(|c| c.direction).collect();
    for (k, a) in towards.iter().enumerate() {
        for b in &towards[..k] {
            assert!(a.dot(*b) < 40f32.to_radians().cos() + 1e-3);
        }
    }
    assert!(estimate.candidates(0).is_empty());
}

/// A photograph's estimate among those of others.
fn of(estimate: &LightEstimate, stops: Option<f64>) -> ViewEstimate {
    ViewEstimate {
        estimate: estimate.clone(),
        stops,
    }
}

#[test]
fn two_views_of_one_sun_are_surer_than_each() {
    let mut one = estimator().estimate(&photo(60, 40), &camera(0.0, 60, 40));
    one.posterior = PeakPosterior::normalised(
        (0..BINS)
            .map(|k| f64::from(bin_direction(k).dot(direction_deg(60.0, 30.0)) * 6.0).exp())
            .collect(),
    );
    let mut two = one.clone();
    // The second camera is turned by 90 degrees to the right: the same sun stands 30 degrees to its left.
    two.heading_rad = std::f64::consts::FRAC_PI_2;
    two.posterior = one.posterior.turned(90.0);
    let both = combine(&[of(&one, Some(0.0)), of(&two, Some(0.0))]).unwrap();
    let towards = direction_deg(60.0, 30.0);
    assert!(both.posterior.density(towards) > one.posterior.density(towards));
    // Twice the logarithms over the root of two; a tenth of the probability is doubt.
    let surer = |w: &f32| (f64::from(*w) + 0.1 / BINS as f64).powf(std::f64::consts::SQRT_2);
    let wanted = PeakPosterior::normalised(one.posterior.weights.iter().map(surer).collect());
    for (a, b) in both.posterior.weights.iter().zip(&wanted.weights) {
        assert!((a - b).abs() < 1e-6, "{a} {b}");
    }
    assert!(both.posterior.mode().dot(towards) > 0.98);
    assert!(combine(&[]).is_err());
    assert_eq!(combine(&[of(&one, None)]).unwrap(), one);
}

/// Relative difference of two maps' texels, over the brightest.
fn apart(a: &EnvironmentMap, b: &EnvironmentMap) -> f32 {
    let brightest = a
        .texels()
        .iter()
        .map(|t| t.max_element())
        .fold(0.0, f32::max);
    let differences = a
        .texels()
        .iter()
        .zip(b.texels())
        .map(|(a, b)| a.distance(*b));
    differences.fold(0.0, f32::max) / brightest
}

#[test]
fn all_cameras_turned_alike_turn_the_light_and_nothing_else() {
    let (width, height) = (60, 40);
    let pictures = [photo(width, height), photo(height, width)];
    let light = |turn_deg: f64| {
        let view = |k: usize| {
            let (w, h) = (pictures[k].0.width() as u32, pictures[k].0.height() as u32);
            let heading = [0.0, 80.0][k] + turn_deg;
            let estimate = estimator().estimate(&pictures[k], &camera(heading as f32, w, h));
            of(&estimate, [Some(0.0), Some(-0.7)][k])
        };
        combine(&[view(0), view(1)]).unwrap()
    };
    let here = light(0.0);
    for turn in [22.5, 45.0, 180.0, -90.0] {
        let there = light(turn);
        let off = there.heading_rad - here.heading_rad - turn.to_radians();
        assert!(off.sin().abs() < 1e-5 && off.cos() > 0.0, "{off}");
        // Cameras are f32 matrices: everything relative to the view is equal to some units of their rounding.
        for (a, b) in here.posterior.weights.iter().zip(&there.posterior.weights) {
            assert!((a - b).abs() < 1e-5, "{turn}: {a} {b}");
        }
        assert_eq!(here.words, there.words);
        let stops = here.exposure_stops.middle - there.exposure_stops.middle;
        assert!(stops.abs() < 1e-4 && here.share.high - there.share.high < 1e-4);
        // A heading to the right is a turn clockwise seen from above; 22.5 degrees are 4 texels.
        let turned = here.map().rotated_y(-turn.to_radians());
        assert!(apart(&turned, &there.map()) < 1e-3, "{turn}");
    }
}

#[test]
fn views_of_one_light_at_known_exposures_give_that_light() {
    // One light, seen by cameras that look 0, 90 and 180 degrees to the right: columns of 22.5 degrees move by 4.
    let first = estimator().estimate(&photo(60, 40), &camera(0.0, 60, 40));
    let seen = |quarters: usize, stops: f64| {
        let mut e = first.clone();
        e.heading_rad += quarters as f64 * std::f64::consts::FRAC_PI_2;
        e.posterior = first.posterior.turned(90.0 * quarters as f64);
        let column = |k: usize| k / 16 * 16 + (k + 4 * quarters) % 16;
        let scale = stops.exp2() as f32;
        e.base = (0..128)
            .map(|k| first.base[column(k)].map(|v| v * scale))
            .collect();
        e.peak = first.peak.map(|v| v * scale);
        e.reference *= stops.exp2();
        e
    };
    let views = |known: bool| {
        [(0, 0.0), (1, 1.5), (2, -0.5)]
            .map(|(quarters, stops)| of(&seen(quarters, stops), known.then_some(stops)))
    };
    for known in [true, false] {
        let all = combine(&views(known)).unwrap();
        for (a, b) in all.base.iter().flatten().zip(first.base.iter().flatten()) {
            assert!((a / b - 1.0).abs() < 1e-3, "{a} {b}");
        }
        for (a, b) in all.peak.iter().zip(first.peak) {
            assert!((a / b - 1.0).abs() < 1e-3, "{a} {b}");
        }
        assert!((all.exposure_stops.middle - first.exposure_stops.middle).abs() < 1e-9);
        let width = |e: &LightEstimate| e.exposure_stops.high - e.exposure_stops.low;
        assert!((width(&all) - width(&first)).abs() < 1e-9, "{known}");
    }
}

#[test]
fn a_view_of_an_unknown_exposure_does_not_tell_how_bright_the_light_is() {
    let first = estimator().estimate(&photo(60, 40), &camera(0.0, 60, 40));
    let mut bright = first.clone();
    bright.base.iter_mut().flatten().for_each(|v| *v *= 4.0);
    bright.peak = bright.peak.map(|v| 4.0 * v);
    let mean = |e: &LightEstimate| e.map().integral().element_sum();
    let brighter = |stops| {
        mean(&combine(&[of(&first, Some(0.0)), of(&bright, stops)]).unwrap()) / mean(&first)
    };
    assert!((brighter(None) - 1.0).abs() < 1e-3);
    // Both are equally sure: the mean of 0 and 2 stops.
    assert!((brighter(Some(0.0)) - 2.0).abs() < 5e-3);
    assert!((brighter(Some(2.0)) - 1.0).abs() < 1e-3);
}

#[test]
fn what_is_seen_is_where_the_camera_looks() {
    let camera = camera(90.0, 60, 40);
    let seen = Visible::new(
        &LinearImage(Raster::filled(60, 40, Vec3::splat(0.5))),
        &camera,
        64,
        32,
        3.0,
    );
    for (k, alpha) in seen.alpha.iter().enumerate() {
        let direction = seen.map.direction_of(k / 64, k % 64);
        let inside = camera
            .project(camera.position + direction)
            .is_some_and(|p| p.x > 0.0 && p.y > 0.0 && p.x < 60.0 && p.y < 40.0);
        // Half a texel of 5.6 degrees may cross the border.
        assert!(
            *alpha == 0.0 || inside || *alpha < 0.5,
            "texel {k}: {alpha}"
        );
        if *alpha > 0.0 {
            assert!(seen.map.texels()[k].distance(Vec3::splat(0.5)) < 1e-5);
        }
    }
    assert!(seen.alpha.iter().any(|a| *a > 0.99));
    let darker = seen.clone().scaled(0.25);
    assert!((darker.map.peak().1.max_element() - 0.125).abs() < 1e-5);
    assert_eq!(darker.alpha, seen.alpha);
    let brightest = seen.scaled(f32::MAX).scaled(1e9).map.integral();
    assert!(brightest.is_finite() && brightest.x > 1e38);
}

#[test]
fn a_merged_map_shows_the_photograph_and_keeps_clipped_sources() {
    let camera = camera(0.0, 60, 40);
    let bright = EnvironmentMap::constant(64, 32, Vec3::splat(3.0));
    let grey = LinearImage(Raster::filled(60, 40, Vec3::splat(0.5)));
    let seen = Visible::new(&grey, &camera, 64, 32, 3.0);
    let map = merged(&seen, &bright);
    let best = (0..seen.alpha.len())
        .max_by(|a, b| seen.alpha[*a].total_cmp(&seen.alpha[*b]))
        .unwrap();
    assert!(map.texels()[best].distance(Vec3::splat(0.5)) < 1e-2);
    // Behind the camera the estimate's own exposure holds.
    let behind = luminance(map.eval(Vec3::Z));
    assert!((behind - 3.0).abs() < 0.05, "{behind}");
    let white = LinearImage(Raster::filled(60, 40, Vec3::ONE));
    let clipped = merged(&Visible::new(&white, &camera, 64, 32, 3.0), &bright);
    assert!(luminance(clipped.texels()[best]) > 2.99);
}

#[test]
fn a_merged_map_is_continuous_across_the_photographs_border() {
    // A sky that grows brighter to the right, a photograph of it, and an estimate that is a stop too dark.
    let black = EnvironmentMap::constant(128, 64, Vec3::ZERO);
    let sky = |d: Vec3| Vec3::splat(0.4 + 0.1 * d.x + 0.1 * d.y);
    let map = |scale: f32| {
        let texels = (0..128 * 64).map(|k| sky(black.direction_of(k / 128, k % 128)) * scale);
        EnvironmentMap::new(128, 64, texels.collect()).unwrap()
    };
    let camera = camera(0.0, 120, 80);
    let pixel = |k: usize| {
        let at = glam::Vec2::new((k % 120) as f32 + 0.5, (k / 120) as f32 + 0.5);
        sky(camera.ray(at).direction)
    };
    let photo = LinearImage(Raster::from_pixels(120, 80, (0..9600).map(pixel).collect()));
    let seen = Visible::new(&photo, &camera, 128, 64, 5.0);
    let (truth, merged) = (map(1.0), merged(&seen, &map(0.5)));
    for (k, t) in merged.texels().iter().enumerate() {
        if seen.alpha[k] > 0.999 {
            // A pixel of the photograph is .5 degrees wide, over which the sky changes by .001.
            assert!(t.distance(truth.texels()[k]) < 5e-3, "texel {k}");
        }
    }
    let stops = |row: usize, column: usize| luminance(merged.texel(row, column % 128)).log2();
    for (row, column) in (16..48).flat_map(|r| (0..128).map(move |c| (r, c))) {
        // The border's factor falls from 2 to 1 as a logistic curve, by at most 1.9 stops a radian: .09 for a texel of
        // .05 radians, and .02 more by the sky itself.
        let step = (stops(row, column) - stops(row, column + 1)).abs();
        assert!(step < 0.15, "row {row}, column {column}: {step}");
    }
}

#[test]
fn features_are_of_the_whole_photograph_at_any_size() {
    let camera = |n: u32| camera(0.0, n, n);
    let (small, large) = (
        SmallPhoto::new(&photo(64, 64), &camera(64)),
        SmallPhoto::new(&photo(256, 256), &camera(256)),
    );
    let [a, b] = [small, large].map(|photo| photo.features(&[]).remove(0));
    assert!(a.len() == FEATURES && b.len() == FEATURES);
    // The ramps are sampled at pixel corners: they differ by 3/8 of a pixel of the smaller one, under .006.
    let most = a[..OF_PARTS]
        .iter()
        .zip(&b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    assert!(most < 0.1, "{most}");
    // The backbone's features are of the order of 1.
    let pairs = a[OF_PARTS..].iter().zip(&b[OF_PARTS..]);
    let squares = pairs.clone().map(|(a, b)| (a - b).powi(2)).sum::<f32>();
    let size = pairs.map(|(a, _)| a * a).sum::<f32>();
    assert!(squares < 0.02 * size, "{squares} of {size}");
}

#[test]
fn weights_come_back_from_their_file_and_others_are_refused() {
    let estimator = estimator();
    let bytes = estimator.to_bytes().unwrap();
    assert_eq!(Estimator::from_bytes(&bytes).unwrap(), estimator);
    let refused = Estimator::from_bytes(&bytes[..bytes.len() / 2])
        .unwrap_err()
        .to_string();
    assert!(refused.contains("dipir-pretrain light"), "{refused}");
    let missing = Estimator::load("nowhere.safetensors")
        .unwrap_err()
        .to_string();
    assert!(missing.contains("nowhere.safetensors"), "{missing}");
}

#[test]
fn the_embedded_estimator_is_bounded_on_any_photograph() {
    let estimator = Estimator::embedded().unwrap();
    let estimate = estimator.estimate(&photo(60, 40), &camera(0.0, 60, 40));
    assert!(finite(&estimate));
    // A light that is a thousand times the photograph is no answer to a picture of middle greys.
    assert!(estimate.exposure_stops.middle.abs() < 10.0, "{estimate:?}");
}

#[test]
fn each_tuning_of_the_backbone_is_for_as_many_networks() {
    let whole = Estimator::embedded().unwrap();
    let tuned = whole.tuned();
    assert!(tuned.len() > 1);
    let bytes = whole.to_bytes().unwrap();
    assert_eq!(Estimator::from_bytes(&bytes).unwrap(), whole);
    let small = SmallPhoto::new(&photo(64, 64), &camera(0.0, 64, 64));
    let features = small.features(tuned);
    assert_eq!(features.len(), tuned.len());
    for (a, b) in features.iter().zip(&features[1..]) {
        assert!(a[..OF_PARTS] == b[..OF_PARTS] && a[OF_PARTS..] != b[OF_PARTS..]);
    }
    let weights = crate::network::from_bytes(&estimator().to_bytes().unwrap()).unwrap();
    let three = vec![weights.members[0].clone(); 3];
    let refused = Estimator::new(three, tuned[..2].to_vec(), Calibration::default());
    let refused = refused.unwrap_err().to_string();
    assert!(
        refused.contains("3 pairs") && refused.contains("2 tunings"),
        "{refused}"
    );
}
