//! Where objects are put at first: side by side on the ground that the picture shows.
use dipir_scene::camera::Camera;
use dipir_scene::pixels::{ground_at, horizon_row};
use dipir_scene::proxy::Plane;
use glam::DVec2;

use crate::error::SetupError;

/// The row of the objects' feet, of the picture's height from the top.
const ROW: f64 = 2.0 / 3.0;
/// Least distance from the horizon to the feet, of what is below the horizon.
const BELOW_HORIZON: f64 = 0.3;
/// Least share of the picture's height below the horizon.
const LEAST_GROUND: f64 = 0.05;
/// Most of the picture's width that objects take.
const MOST_WIDTH: f64 = 0.8;
/// Metres between objects.
const GAP_M: f64 = 0.3;

/// The pixels at which objects of these widths, metres, stand: in one row, in the middle of the
/// picture, as far apart as they are wide if there is room.
///
/// # Errors
/// If there is no ground at such pixels.
pub fn spots(
    camera: &Camera,
    plane: &Plane,
    widths_m: &[f64],
) -> Result<Vec<[f64; 2]>, SetupError> {
    let [w, h] = camera.resolution.map(f64::from);
    let none = |detail: String| SetupError::NoGround {
        detail,
        remedy: "look further down with --pitch -10".into(),
    };
    let horizon = [0.1, 0.5, 0.9]
        .map(|share| horizon_row(camera, plane, share * w))
        .into_iter()
        .flatten()
        .fold(f64::NEG_INFINITY, f64::max);
    if horizon > (1.0 - LEAST_GROUND) * h {
        return Err(none(format!("its horizon is at row {horizon:.0} of {h}")));
    }
    let row = (ROW * h).max(horizon + BELOW_HORIZON * (h - horizon));
    let row = number_of_pixel(row);
    let middle = DVec2::new(0.5 * w, row);
    let point = ground_at(camera, plane, middle);
    let point = point.ok_or_else(|| none(format!("there is none at row {row:.0}")))?;
    let from = point - camera.position.as_dvec3();
    let depth = -from.dot(camera.rotation.as_dmat3().z_axis);
    let total = widths_m.iter().sum::<f64>() + GAP_M * widths_m.len().saturating_sub(1) as f64;
    let pixels_a_metre =
        (f64::from(camera.focal_px.x) / depth).min(MOST_WIDTH * w / total.max(1e-9));
    let mut left = -0.5 * total;
    let mut found = Vec::with_capacity(widths_m.len());
    for width in widths_m {
        let x = number_of_pixel(0.5 * w + pixels_a_metre * (left + 0.5 * width));
        left += width + GAP_M;
        if ground_at(camera, plane, DVec2::new(x, row)).is_none() {
            return Err(none(format!(
                "there is none at column {x:.0}, row {row:.0}"
            )));
        }
        found.push([x, row]);
    }
    Ok(found)
}

/// A warning if neighbours at `spots` are nearer to each other than they are wide: the ground that is seen there has no
/// room for all.
pub fn crowded(
    camera: &Camera,
    plane: &Plane,
    spots: &[[f64; 2]],
    widths_m: &[f64],
) -> Option<String> {
    let ground = |spot: [f64; 2]| ground_at(camera, plane, DVec2::from_array(spot));
    let close = |(spots, widths): (&[[f64; 2]], &[f64])| match (ground(spots[0]), ground(spots[1]))
    {
        (Some(a), Some(b)) => a.distance(b) < 0.5 * (widths[0] + widths[1]),
        _ => false,
    };
    if !spots.windows(2).zip(widths_m.windows(2)).any(close) {
        return None;
    }
    let width = f64::from(camera.resolution[0]);
    let row = spots[0][1];
    let seen = ground([0.0, row]).zip(ground([width, row]));
    let seen = seen.map_or_else(String::new, |(a, b)| format!(" of {:.1} m", a.distance(b)));
    Some(format!(
        "the {} objects take {:.1} m side by side{seen} that the picture shows at row {row:.0}, so they may stand in each \
         other: make them smaller (--height-m), move them apart (dipir place), or let each look for free ground (--place auto)",
        spots.len(),
        widths_m.iter().sum::<f64>(),
    ))
}

/// How wide and how high what stands at `spot` appears, pixels; `None` if it reaches behind the camera.
pub fn appears(
    camera: &Camera,
    plane: &Plane,
    spot: [f64; 2],
    width_m: f64,
    height_m: f64,
) -> Option<[f64; 2]> {
    let foot = ground_at(camera, plane, DVec2::from_array(spot))?;
    let rotation = camera.rotation.as_dmat3();
    let from = foot - camera.position.as_dvec3();
    let depth = -from.dot(rotation.z_axis);
    let top = foot + height_m * plane.normal.as_dvec3().normalize();
    let top = camera.project(top.as_vec3())?.as_dvec2();
    let width = f64::from(camera.focal_px.x) * width_m / depth;
    Some([width, top.distance(DVec2::from_array(spot))])
}

/// A tenth of a pixel is fine enough to be typed.
fn number_of_pixel(value: f64) -> f64 {
    (value * 10.0).round() / 10.0
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::view::{Aim, View};

    fn view(pitch_deg: f64, roll_deg: f64, fov_deg: f64) -> View {
        View {
            aim: Aim::Turned {
                pitch_deg,
                roll_deg,
            },
            fov_deg,
            ..View::default()
        }
    }

    proptest! {
        #[test]
        fn objects_stand_in_the_picture(
            fov_deg in 10.0f64..110.0, share in 0.0f64..0.9, roll_deg in -3.0f64..3.0,
            width in 100u32..5000, height in 100u32..5000,
            widths in proptest::collection::vec(0.05f64..6.0, 1..6),
        ) {
            // A pitch that puts the horizon at this share of the height.
            let tangent = (share - 0.5) * 2.0 * (0.5 * fov_deg).to_radians().tan();
            let view = view(tangent.atan().to_degrees(), roll_deg, fov_deg);
            let (camera, plane) = (view.camera([width, height]), view.plane());
            // A roll tilts the horizon of a wide picture out of it.
            let tilt = roll_deg.abs().to_radians().tan() * 0.5 * f64::from(width);
            prop_assume!(share + 2.0 * tilt / f64::from(height) < 0.9);
            let found = spots(&camera, &plane, &widths).unwrap();
            prop_assert_eq!(found.len(), widths.len());
            for [x, y] in found {
                prop_assert!(x >= 0.0 && x <= f64::from(width), "{}", x);
                prop_assert!(y >= 0.5 * f64::from(height) && y <= f64::from(height), "{}", y);
                let foot = ground_at(&camera, &plane, DVec2::new(x, y)).unwrap();
                let pixel = camera.project(foot.as_vec3()).unwrap().as_dvec2();
                // Single precision over a long focal length: 57,000 pixels at most.
                prop_assert!(pixel.distance(DVec2::new(x, y)) < 0.1, "{}", pixel);
            }
        }
    }

    #[test]
    fn objects_are_as_far_apart_as_they_are_wide() {
        let view = view(-10.0, 0.0, 40.0);
        let (camera, plane) = (view.camera([1500, 1000]), view.plane());
        let found = spots(&camera, &plane, &[1.0, 0.4]).unwrap();
        let [a, b] = [0, 1].map(|i| {
            let point = ground_at(&camera, &plane, DVec2::from_array(found[i])).unwrap();
            assert!((found[i][1] - 666.7).abs() < 0.01);
            point
        });
        // 0.5 + 0.3 + 0.2 m, to a tenth of a pixel.
        assert!((a.distance(b) - 1.0).abs() < 1e-3, "{}", a.distance(b));
    }

    #[test]
    fn objects_that_the_picture_has_no_room_for_are_said_to_stand_in_each_other() {
        // Level, a row 166.7 pixels below the horizon sees ground 1.6 m below the eye: 166.7 pixels are 1.6 m there.
        let view = view(0.0, 0.0, 40.0);
        let (camera, plane) = (view.camera([1500, 1000]), view.plane());
        let said = |widths: &[f64]| {
            let found = spots(&camera, &plane, widths).unwrap();
            crowded(&camera, &plane, &found, widths)
        };
        for roomy in [&[3.0][..], &[20.0], &[1.0, 0.4], &[2.0, 2.0, 2.0]] {
            assert_eq!(said(roomy), None, "{roomy:?}");
        }
        let text = said(&[4.0, 4.0, 4.0, 4.0]).unwrap();
        let seen = 1500.0 * 1.6 / 166.7;
        let part = format!("the 4 objects take 16.0 m side by side of {seen:.1} m");
        assert!(text.contains(&part), "{text}");
    }

    #[test]
    fn an_object_appears_as_large_as_its_distance_makes_it() {
        let view = view(0.0, 0.0, 40.0);
        let (camera, plane) = (view.camera([1500, 1000]), view.plane());
        let focal = f64::from(camera.focal_px.x);
        // 1.6 m below the eye and 8 m away.
        let spot = [750.0, 500.0 + focal / 5.0];
        let [width, height] = appears(&camera, &plane, spot, 0.4, 1.0).unwrap();
        assert!((width - focal * 0.05).abs() < 0.05, "{width}");
        assert!((height - focal * 0.125).abs() < 0.05, "{height}");
        assert_eq!(appears(&camera, &plane, [750.0, 100.0], 0.4, 1.0), None);
    }

    #[test]
    fn a_view_of_the_sky_is_refused() {
        let view = view(40.0, 0.0, 40.0);
        let error = spots(&view.camera([600, 400]), &view.plane(), &[1.0]).unwrap_err();
        assert!(
            error.to_string().contains("look further down with --pitch"),
            "{error}"
        );
    }
}
