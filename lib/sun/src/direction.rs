//! Between azimuth with elevation and unit vectors of the world.
use glam::DVec3;

/// The unit vector towards the sky at these angles of the world, degrees.
pub fn direction(azimuth_deg: f64, elevation_deg: f64) -> DVec3 {
    let (sin_a, cos_a) = azimuth_deg.to_radians().sin_cos();
    let (sin_e, cos_e) = elevation_deg.to_radians().sin_cos();
    DVec3::new(cos_e * sin_a, sin_e, -cos_e * cos_a)
}

/// Azimuth in `[0, 360)` and elevation of a direction, degrees; inverse of [`direction`].
pub fn angles(direction: DVec3) -> (f64, f64) {
    let azimuth = direction
        .x
        .atan2(-direction.z)
        .to_degrees()
        .rem_euclid(360.0);
    let level = direction.x.hypot(direction.z);
    (azimuth, direction.y.atan2(level).to_degrees())
}

/// The azimuth in the world of what has the bearing `bearing_deg` from north, if a camera that
/// looks along `forward` has the bearing `heading_deg`.
pub fn azimuth_of_bearing(bearing_deg: f64, heading_deg: f64, forward: DVec3) -> f64 {
    (bearing_deg - heading_deg + angles(forward).0).rem_euclid(360.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn azimuths_go_clockwise_from_where_an_unturned_camera_looks() {
        assert!(direction(0.0, 0.0).abs_diff_eq(DVec3::NEG_Z, 1e-12));
        assert!(direction(90.0, 0.0).abs_diff_eq(DVec3::X, 1e-12));
        assert!(direction(123.0, 90.0).abs_diff_eq(DVec3::Y, 1e-12));
        for (azimuth, elevation) in [(10.0, 5.0), (200.0, -40.0), (359.0, 80.0)] {
            let (a, e) = angles(direction(azimuth, elevation));
            assert!((a - azimuth).abs() < 1e-9 && (e - elevation).abs() < 1e-9);
        }
    }

    #[test]
    fn a_sun_in_the_south_is_behind_a_camera_that_looks_north() {
        // The camera looks along +x and a little down; south is then -x.
        let forward = DVec3::new(1.0, -0.2, 0.0);
        let azimuth = azimuth_of_bearing(180.0, 0.0, forward);
        assert!(direction(azimuth, 0.0).abs_diff_eq(DVec3::NEG_X, 1e-12));
        // East is on its right hand, +z.
        let azimuth = azimuth_of_bearing(90.0, 0.0, forward);
        assert!(direction(azimuth, 0.0).abs_diff_eq(DVec3::Z, 1e-12));
    }
}
