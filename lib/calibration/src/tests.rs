use dipir_imaging::raster::{LinearImage, Raster};
use glam::{DVec2, DVec3, Vec3};
use proptest::prelude::*;

use crate::generated::{Built, picture};
use crate::lines::Lines;
use crate::network::{Member, Network, SCORED};
use crate::pose::{Pose, fov_deg, log_focal};
use crate::posterior::{Axis, Posterior};
use crate::segments::Segment;
use crate::whole::{FOCALS, PITCHES, WHOLE};
use crate::{CameraEstimator, Evidence, KnownFocal, SEARCHED};

/// An estimator that knows nothing of pictures.
fn ignorant() -> CameraEstimator {
    CameraEstimator {
        members: Vec::new(),
        trust: 1.0,
    }
}

/// The segments of bars along the axes of a world that is turned by 30 degrees about the vertical.
fn bars(pose: &Pose, size: [usize; 2]) -> Vec<Segment> {
    let (w, h) = (size[0] as f64, size[1] as f64);
    let own = pose.rotation().transpose();
    let turn = glam::DMat3::from_rotation_y(30f64.to_radians());
    let focal = pose.focal() * w.max(h);
    let seen = |p: DVec3| {
        let p = own * p;
        (p.z < -0.1).then(|| 0.5 * DVec2::new(w, h) + focal * DVec2::new(p.x, -p.y) / -p.z)
    };
    let mut all = Vec::new();
    for k in 0..27 {
        let at = DVec3::new(
            f64::from(k % 3) - 1.0,
            f64::from(k / 3 % 3) - 1.2,
            f64::from(k / 9),
        );
        let at = DVec3::new(3.0 * at.x, 1.5 * at.y, -6.0 - 3.0 * at.z);
        for axis in [turn.x_axis, turn.y_axis, turn.z_axis] {
            if let (Some(a), Some(b)) = (seen(at), seen(at + axis)) {
                let length = a.distance(b);
                all.push(Segment {
                    middle: 0.5 * (a + b),
                    direction: (b - a) / length,
                    length,
                });
            }
        }
    }
    all
}

fn grey() -> Evidence {
    let pose = Pose::new(0.0, 0.0, 60.0);
    Evidence::new(&picture(Built::Room, 0, &pose, [32, 24]))
}

proptest! {
    #[test]
    fn angles_of_view_and_focal_lengths_belong_together(fov in 5.0f64..150.0) {
        prop_assert!((fov_deg(log_focal(fov)) - fov).abs() < 1e-9);
    }

    #[test]
    fn lines_agree_with_their_own_camera_more_than_with_others(
        pitch in -30.0f64..20.0, roll in -5.0f64..5.0, fov in 40.0f64..80.0, upright in any::<bool>(),
    ) {
        let size = if upright { [480, 640] } else { [640, 480] };
        let own = Pose::new(pitch, roll, fov);
        let lines = Lines::new(&bars(&own, size), size);
        // The mean of the logarithms under the narrower spread.
        let mean = |pose: &Pose| lines.features(pose)[5];
        for off in [-3.0, 3.0] {
            let pitched = Pose { pitch_deg: pitch + off, ..own };
            let rolled = Pose { roll_deg: roll + off, ..own };
            prop_assert!(mean(&pitched) < mean(&own) - 0.1);
            prop_assert!(mean(&rolled) < mean(&own) - 0.1);
        }
        let agree = lines.agreement(&own);
        prop_assert!(agree.upright + agree.level > 0.9 * lines.count() as f64, "{agree:?}");
    }
}

#[test]
fn without_networks_everything_is_possible() {
    let found = ignorant().grid(&grey(), None).posterior(1.0);
    let [pitch, roll] = [found.interval(0), found.interval(1)];
    // 90% of what is searched, 80 and 16 degrees, and a step: half of each end's point lies outside.
    assert!(
        (pitch.half_width() - 0.45 * (80.0 + 80.0 / 14.0)).abs() < 0.1,
        "{pitch:?}"
    );
    assert!(
        (roll.half_width() - 0.45 * (16.0 + 16.0 / 12.0)).abs() < 0.1,
        "{roll:?}"
    );
    // All angles from 24 to 100 degrees are alike.
    let fov = found.fov_deg();
    assert!((fov.middle - 62.0).abs() < 3.0, "{fov:?}");
}

#[test]
fn a_known_focal_length_stays_what_it_is() {
    let known = KnownFocal {
        relative: 0.9,
        sigma: 0.02,
    };
    let found = ignorant().grid(&grey(), Some(known)).posterior(1.0);
    let focal = found.interval(2);
    // 1.645 standard deviations either way, on three points 1.35 of them apart, each spread as wide.
    assert!((focal.middle - 0.9f64.ln()).abs() < 1e-3, "{focal:?}");
    assert!((focal.half_width() - 0.0329).abs() < 0.003, "{focal:?}");
}

#[test]
fn streets_and_rooms_with_straight_lines_are_found_to_a_degree() {
    let estimator = CameraEstimator::embedded().unwrap();
    let mut off = Vec::new();
    for n in 0..6 {
        let built = [Built::Street, Built::Room][n % 2];
        let pose = Pose::new(
            -15.0 + 4.0 * n as f64,
            1.5 * n as f64 - 3.0,
            50.0 + 5.0 * n as f64,
        );
        let image = picture(built, n as u64, &pose, [640, 480]);
        let known = KnownFocal {
            relative: pose.focal(),
            sigma: 0.02,
        };
        let found = estimator.estimate(&image, Some(known));
        off.push((found.pitch_deg.middle - pose.pitch_deg).abs());
        off.push((found.roll_deg.middle - pose.roll_deg).abs());
    }
    assert!(off.iter().all(|e| *e < 1.0), "{off:?}");
}

#[test]
fn the_same_photograph_gives_the_same_estimate() {
    let image = picture(Built::Street, 3, &Pose::new(-5.0, 1.0, 60.0), [320, 240]);
    let estimator = CameraEstimator::embedded().unwrap();
    assert_eq!(
        estimator.estimate(&image, None),
        estimator.estimate(&image, None)
    );
}

#[test]
fn quantiles_are_those_of_an_even_and_of_a_pointed_distribution() {
    let axis = Axis::between(-2.0, 2.0, 5);
    let one = Axis::between(0.0, 1.0, 2);
    let even = Posterior::new([axis, one, one], &[0.0; 20]);
    // Five points stand for -2.5 to 2.5.
    assert!((even.quantile(0, 0.05) + 2.25).abs() < 1e-9);
    assert!((even.quantile(0, 0.5)).abs() < 1e-9);
    let mut logs = [-1e3; 20];
    logs[4..8].fill(0.0);
    let pointed = Posterior::new([axis, one, one], &logs);
    assert!((pointed.quantile(0, 0.5) + 1.0).abs() < 1e-9);
    assert!((pointed.marginal(0)[1] - 1.0).abs() < 1e-9);
}

/// A network of so many inputs, hidden units and outputs.
fn network(inputs: usize, hidden: usize, outputs: usize) -> Network {
    let wave = |n: usize, scale: f32| (0..n).map(|k| scale * (k as f32).sin()).collect();
    Network {
        mean: wave(inputs, 0.3),
        deviation: vec![2.0; inputs],
        layers: [
            wave(inputs * hidden, 0.7),
            wave(hidden, 0.2),
            wave(hidden * hidden, 0.9),
            wave(hidden, 0.4),
            wave(hidden * outputs, 0.8),
            wave(outputs, 0.5),
        ],
    }
}

#[test]
fn networks_say_what_their_layers_say_one_by_one() {
    let (inputs, hidden, outputs) = (3, 4, 2);
    let network = network(inputs, hidden, outputs);
    let x = [0.5, -1.5, 40.0];
    let [a, b, c, d, e, f] = network.layers.each_ref().map(|l| {
        let all = l.iter().map(|v| f64::from(*v));
        all.collect::<Vec<f64>>()
    });
    let silu = |v: f64| v / (1.0 + (-v).exp());
    let dot = |x: &[f64], w: &[f64], n: usize, k: usize, bias: f64| -> f64 {
        bias + x
            .iter()
            .enumerate()
            .map(|(i, x)| x * w[i * n + k])
            .sum::<f64>()
    };
    // The third is cut off at 5 deviations.
    let mean = |k: usize| f64::from(network.mean[k]);
    let x64: Vec<f64> = vec![(0.5 - mean(0)) / 2.0, (-1.5 - mean(1)) / 2.0, 5.0];
    let h: Vec<f64> = (0..hidden)
        .map(|k| silu(dot(&x64, &a, hidden, k, b[k])))
        .collect();
    let h: Vec<f64> = (0..hidden)
        .map(|k| h[k] + silu(dot(&h, &c, hidden, k, d[k])))
        .collect();
    for (k, found) in network.outputs(&x).into_iter().enumerate() {
        let wanted = dot(&h, &e, outputs, k, f[k]);
        assert!((f64::from(found) - wanted).abs() < 1e-5, "{found} {wanted}");
    }
}

#[test]
fn a_picture_of_one_shade_tells_nothing() {
    let image = LinearImage(Raster::filled(90, 60, Vec3::splat(0.3)));
    let estimator = CameraEstimator::embedded().unwrap();
    let known = KnownFocal {
        relative: 1.0,
        sigma: 0.02,
    };
    for known in [None, Some(known)] {
        assert_eq!(
            estimator.estimate(&image, known),
            CameraEstimator {
                trust: estimator.trust,
                ..ignorant()
            }
            .estimate(&image, known)
        );
    }
}

#[test]
fn a_mirrored_photograph_is_rolled_the_other_way() {
    let pose = Pose::new(-9.0, 3.0, 65.0);
    let image = picture(Built::Room, 4, &pose, [320, 240]);
    let turned = |k: usize| *image.0.get(319 - k % 320, k / 320);
    let turned = LinearImage(Raster::from_pixels(
        320,
        240,
        (0..320 * 240).map(turned).collect(),
    ));
    let estimator = CameraEstimator::embedded().unwrap();
    let [a, b] = [&image, &turned].map(|i| estimator.estimate(i, None));
    // Segments of a mirrored picture differ by rounding: a tenth of the half widths, which are .5 and .9 degrees.
    assert!((a.roll_deg.middle + b.roll_deg.middle).abs() < 0.05);
    assert!((a.pitch_deg.middle - b.pitch_deg.middle).abs() < 0.09);
    assert!(a.roll_deg.holds(3.0), "{:?}", a.roll_deg);
}

#[test]
fn weights_survive_their_file_and_others_are_refused_by_name() {
    let member = |hidden: usize| Member {
        whole: network(WHOLE, hidden, PITCHES * FOCALS),
        scorer: network(SCORED, hidden + 1, 1),
    };
    let estimator = CameraEstimator {
        members: vec![member(3), member(2)],
        trust: 0.7,
    };
    let bytes = estimator.to_bytes().unwrap();
    assert_eq!(CameraEstimator::from_bytes(&bytes).unwrap(), estimator);
    let error = CameraEstimator::from_bytes(&ignorant().to_bytes().unwrap()).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("`member.0.whole.mean` is missing"),
        "{error}"
    );
    let mut other = estimator;
    other.members[1].whole = network(WHOLE, 3, 7);
    let error = CameraEstimator::from_bytes(&other.to_bytes().unwrap()).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("`member.1.whole.output.weight` has another size"),
        "{error}"
    );
    let error = CameraEstimator::from_bytes(&bytes[..100]).unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("the camera's weights are refused"),
        "{error}"
    );
}

/// A picture with bars of one shade beside and above it.
fn framed(picture: &LinearImage, bars: [usize; 2], shade: f32) -> LinearImage {
    let (w, h) = (
        picture.0.width() + 2 * bars[0],
        picture.0.height() + 2 * bars[1],
    );
    let pixel = |k: usize| match [(k % w).checked_sub(bars[0]), (k / w).checked_sub(bars[1])] {
        [Some(x), Some(y)] if x < picture.0.width() && y < picture.0.height() => {
            *picture.0.get(x, y)
        }
        _ => Vec3::splat(shade),
    };
    LinearImage(Raster::from_pixels(w, h, (0..w * h).map(pixel).collect()))
}

#[test]
fn a_frame_does_not_pass_for_upright_and_level_things() {
    let pose = Pose::new(-12.0, 4.0, 60.0);
    let image = picture(Built::Street, 3, &pose, [320, 240]);
    let estimator = CameraEstimator::embedded().unwrap();
    let plain = estimator.estimate(&image, None);
    for (bars, shade) in [
        ([32, 24], 0.0),
        ([2, 2], 1.0),
        ([0, 90], 0.0),
        ([100, 0], 0.0),
    ] {
        let photo = framed(&image, bars, shade);
        let longer = photo.0.width().max(photo.0.height()) as f64;
        // The same focal length of 320 pixels' sides, over another side.
        let relative = pose.focal() * 320.0 / longer;
        let wanted = fov_deg(relative.ln());
        let found = estimator.estimate(&photo, None);
        // Three pixels at each bar are cut off with it: a hundredth of the picture, which moves what is found by less
        // than half of the interval.
        for (found, plain) in [
            (found.pitch_deg, plain.pitch_deg),
            (found.roll_deg, plain.roll_deg),
        ] {
            assert!(
                (found.middle - plain.middle).abs() < plain.half_width(),
                "{bars:?}: {found:?} {plain:?}"
            );
        }
        assert!(
            found.roll_deg.holds(4.0) && found.pitch_deg.holds(-12.0),
            "{bars:?}: {found:?}"
        );
        assert!(
            found.fov_deg.holds(wanted),
            "{bars:?}: {wanted} in {:?}",
            found.fov_deg
        );
        let known = KnownFocal {
            relative,
            sigma: 0.02,
        };
        let known = estimator.estimate(&photo, Some(known));
        assert!(
            (known.fov_deg.middle - wanted).abs() < 0.5,
            "{bars:?}: {:?}",
            known.fov_deg
        );
        assert!(
            (known.roll_deg.middle - 4.0).abs() < 1.0
                && (known.pitch_deg.middle + 12.0).abs() < 1.0,
            "{known:?}"
        );
        assert!(
            known.agreeing.upright + known.agreeing.level > 0.5 * known.lines as f64,
            "{known:?}"
        );
    }
}

#[test]
fn photographs_of_any_shape_and_brightness_have_intervals_within_what_is_searched() {
    let estimator = CameraEstimator::embedded().unwrap();
    let of = |size: [usize; 2], value: &dyn Fn(usize, Vec3) -> Vec3| {
        let plain = picture(Built::Street, 3, &Pose::new(-5.0, 1.0, 60.0), size);
        let pixels = plain.0.pixels().iter().enumerate();
        let pixels = pixels.map(|(k, p)| value(k, *p)).collect();
        LinearImage(Raster::from_pixels(size[0], size[1], pixels))
    };
    for image in [
        of([240, 80], &|_, p| p),
        of([80, 240], &|_, p| p),
        of([32, 24], &|_, p| p),
        of([1, 1], &|_, p| p),
        of([1, 90], &|_, p| p),
        of([160, 120], &|_, p| 0.01 * p),
        of([160, 120], &|_, p| (8.0 * p).min(Vec3::ONE)),
        of([160, 120], &|_, p| 1e6 * p),
        of([160, 120], &|k, p| if k % 61 == 0 { Vec3::NAN } else { p }),
        of([160, 120], &|k, p| {
            if k % 61 == 0 { Vec3::INFINITY } else { p }
        }),
    ] {
        let found = estimator.estimate(&image, None);
        let all = [found.pitch_deg, found.roll_deg, found.fov_deg];
        for (interval, [low, high]) in all.into_iter().zip(SEARCHED) {
            let inside = low - 5.0 < interval.low && interval.high < high + 5.0;
            let ordered = interval.low < interval.middle && interval.middle < interval.high;
            // The outermost points of a grid stand for half a step more: 3 degrees of 80 on 15 points.
            assert!(inside && ordered, "{:?}: {found:?}", image.0.width());
        }
    }
}

#[test]
fn the_sides_of_a_frame_are_no_lines() {
    let pixel = |k: usize| Vec3::splat(0.3 + 0.001 * (k % 160) as f32);
    let soft = LinearImage(Raster::from_pixels(
        160,
        120,
        (0..160 * 120).map(pixel).collect(),
    ));
    let photo = framed(&soft, [16, 12], 0.0);
    assert!(Evidence::blurred(&photo, 1).lines.count() >= 4);
    assert_eq!(Evidence::new(&photo).lines.count(), 0);
}
