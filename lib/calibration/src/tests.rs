use std::sync::LazyLock;

use glam::{DVec2, DVec3};
use proptest::prelude::*;

use crate::generated::{Built, picture};
use crate::lines::Lines;
use crate::network::{Head, Network, soft};
use crate::pose::{Pose, fov_deg, log_focal};
use crate::posterior::{Axis, Posterior};
use crate::segments::Segment;
use crate::{CameraEstimator, Evidence, KnownFocal, Trust};

/// An estimator that goes by lines alone.
fn by_lines() -> CameraEstimator {
    CameraEstimator {
        turn: Vec::new(),
        focal: Vec::new(),
        trust: Trust {
            lines: 0.3,
            turn: 0.0,
            focal: 0.0,
        },
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

fn evidence(segments: &[Segment], size: [usize; 2]) -> Evidence {
    static GREY: LazyLock<Evidence> = LazyLock::new(|| {
        Evidence::new(&picture(
            Built::Room,
            0,
            &Pose::new(0.0, 0.0, 60.0),
            [32, 24],
        ))
    });
    Evidence {
        lines: Lines::new(segments, size),
        thumbnail: GREY.thumbnail.clone(),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    #[test]
    fn bars_along_three_axes_give_the_whole_camera(
        pitch in -30.0f64..20.0, roll in -5.0f64..5.0, fov in 40.0f64..80.0, upright in any::<bool>(),
    ) {
        let size = if upright { [480, 640] } else { [640, 480] };
        let pose = Pose::new(pitch, roll, fov);
        let found = by_lines().posterior(&evidence(&bars(&pose, size), size), None);
        // Exact segments: what is left are the grid's steps and the width of the likelihood.
        prop_assert!((found.interval(0).middle - pitch).abs() < 1.0, "{:?}", found.interval(0));
        prop_assert!((found.interval(1).middle - roll).abs() < 0.5, "{:?}", found.interval(1));
        // A level camera hardly tells it from level bars.
        prop_assert!(found.fov_deg().holds(fov), "{:?}", found.fov_deg());
    }

    #[test]
    fn angles_of_view_and_focal_lengths_belong_together(fov in 5.0f64..150.0) {
        prop_assert!((fov_deg(log_focal(fov)) - fov).abs() < 1e-9);
    }
}

#[test]
fn a_true_pose_is_more_probable_than_others_and_explains_all_bars() {
    let pose = Pose::new(-12.0, 2.0, 60.0);
    let lines = Lines::new(&bars(&pose, [640, 480]), [640, 480]);
    let best = lines.log_likelihood(&pose, 0.0);
    for (pitch, roll, fov) in [(-8.0, 2.0, 60.0), (-12.0, 0.0, 60.0), (-12.0, 2.0, 75.0)] {
        assert!(lines.log_likelihood(&Pose::new(pitch, roll, fov), 0.0) < best - 3.0);
    }
    let agree = lines.agreement(&pose);
    assert!(
        agree.upright + agree.level > 0.9 * lines.count() as f64,
        "{agree:?}"
    );
}

#[test]
fn without_lines_and_networks_everything_is_possible() {
    let found = by_lines().posterior(&evidence(&[], [640, 480]), None);
    let [pitch, roll] = [found.interval(0), found.interval(1)];
    // 90% of what is searched, 82 and 20 degrees, and a step: half of each end's point lies outside.
    assert!((pitch.half_width() - 38.7).abs() < 0.5, "{pitch:?}");
    assert!((roll.half_width() - 9.56).abs() < 0.2, "{roll:?}");
}

#[test]
fn a_known_focal_length_stays_what_it_is() {
    let known = KnownFocal {
        relative: 0.9,
        sigma: 0.02,
    };
    let found = by_lines().posterior(&evidence(&[], [640, 480]), Some(known));
    let focal = found.interval(2);
    // 1.645 standard deviations either way, on a grid of three quarters of one.
    assert!((focal.middle - 0.9f64.ln()).abs() < 1e-3, "{focal:?}");
    assert!((focal.half_width() - 0.0329).abs() < 0.004, "{focal:?}");
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

#[test]
fn soft_targets_sum_to_one_and_have_their_mean_at_the_value() {
    let axis = Axis::between(0.0, 10.0, 11);
    let target = soft(&axis, 4.3);
    let mean: f64 = axis
        .values()
        .zip(&target)
        .map(|(v, t)| v * f64::from(*t))
        .sum();
    // A bell that is sampled at .7 of its width.
    assert!((mean - 4.3).abs() < 1e-2 && (target.iter().sum::<f32>() - 1.0).abs() < 1e-5);
}

#[test]
fn weights_survive_their_file_and_others_are_refused_by_name() {
    let zero = |head: Head, hidden: usize| Network {
        mean: vec![0.0; head.inputs()],
        deviation: vec![1.0; head.inputs()],
        layers: [
            vec![0.01; head.inputs() * hidden],
            vec![0.0; hidden],
            vec![0.02; hidden * hidden],
            vec![0.0; hidden],
            vec![0.03; hidden * head.outputs()],
            vec![0.5; head.outputs()],
        ],
    };
    let estimator = CameraEstimator {
        turn: vec![zero(Head::Turn, 3), zero(Head::Turn, 2)],
        focal: vec![zero(Head::Focal, 2)],
        ..by_lines()
    };
    let bytes = estimator.to_bytes().unwrap();
    assert_eq!(CameraEstimator::from_bytes(&bytes).unwrap(), estimator);
    let refused = CameraEstimator {
        focal: Vec::new(),
        ..estimator
    };
    let error = CameraEstimator::from_bytes(&refused.to_bytes().unwrap()).unwrap_err();
    assert!(
        error.to_string().contains("`focal.0.mean` is missing"),
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
