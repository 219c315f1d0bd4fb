//! A photograph out of a panorama: the perspective view that a camera in its middle has.
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_light::environment::EnvironmentMap;
use glam::{EulerRot, Mat3, Vec3};
use rayon::prelude::*;

/// A camera in the middle of a panorama.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PanoramaView {
    /// Vertical field of view, radians, in `(0, pi)`.
    pub fov_rad: f32,
    /// Turn to the right, radians; 0 looks along -z.
    pub yaw_rad: f32,
    /// Turn upwards, radians.
    pub pitch_rad: f32,
    /// Turn of the camera clockwise about its line of sight, radians.
    pub roll_rad: f32,
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
}

/// Samples along each side of a pixel.
const SAMPLES: usize = 4;

impl PanoramaView {
    /// Columns: the camera's right, up and backward axes.
    pub fn rotation(&self) -> Mat3 {
        Mat3::from_euler(EulerRot::YXZ, -self.yaw_rad, self.pitch_rad, -self.roll_rad)
    }

    /// The direction through the image position (`x`, `y`) in pixels from the top left corner.
    pub fn direction(&self, x: f32, y: f32) -> Vec3 {
        let half_height = (0.5 * self.fov_rad).tan();
        let scale = 2.0 * half_height / self.height as f32;
        let right = (x - 0.5 * self.width as f32) * scale;
        let up = (0.5 * self.height as f32 - y) * scale;
        (self.rotation() * Vec3::new(right, up, -1.0)).normalize()
    }

    /// What the camera sees of `map`, interpolated between texels, which a photograph does not
    /// show as squares.
    pub fn take(&self, map: &EnvironmentMap) -> LinearImage {
        let pixels = (0..self.width * self.height)
            .into_par_iter()
            .map(|n| {
                let (x, y) = ((n % self.width) as f32, (n / self.width) as f32);
                let mut sum = Vec3::ZERO;
                for i in 0..SAMPLES * SAMPLES {
                    let offset = |k: usize| (k as f32 + 0.5) / SAMPLES as f32;
                    let direction =
                        self.direction(x + offset(i % SAMPLES), y + offset(i / SAMPLES));
                    sum += bilinear(map, direction);
                }
                sum / (SAMPLES * SAMPLES) as f32
            })
            .collect();
        LinearImage(Raster::from_pixels(self.width, self.height, pixels))
    }
}

/// The map between the centres of its texels; rows end at the poles, columns go around.
fn bilinear(map: &EnvironmentMap, direction: Vec3) -> Vec3 {
    let (width, height) = (map.width(), map.height());
    let u = direction
        .x
        .atan2(-direction.z)
        .rem_euclid(std::f32::consts::TAU);
    let x = u / std::f32::consts::TAU * width as f32 - 0.5;
    let v = direction.y.clamp(-1.0, 1.0).acos() / std::f32::consts::PI;
    let y = (v * height as f32 - 0.5).clamp(0.0, (height - 1) as f32);
    let (fx, fy) = (x - x.floor(), y - y.floor());
    let column = |k: i64| (x.floor() as i64 + k).rem_euclid(width as i64) as usize;
    let row = |k: usize| (y as usize + k).min(height - 1);
    let top = map
        .texel(row(0), column(0))
        .lerp(map.texel(row(0), column(1)), fx);
    let bottom = map
        .texel(row(1), column(0))
        .lerp(map.texel(row(1), column(1)), fx);
    top.lerp(bottom, fy)
}

#[cfg(test)]
mod tests {
    use std::f32::consts::{FRAC_PI_2, PI};

    use super::*;

    fn view(yaw_rad: f32, pitch_rad: f32) -> PanoramaView {
        PanoramaView {
            fov_rad: FRAC_PI_2,
            yaw_rad,
            pitch_rad,
            roll_rad: 0.0,
            width: 3,
            height: 3,
        }
    }

    #[test]
    fn the_middle_pixel_looks_where_yaw_and_pitch_point() {
        let middle = |yaw, pitch| view(yaw, pitch).direction(1.5, 1.5);
        assert!(middle(0.0, 0.0).distance(Vec3::NEG_Z) < 1e-6);
        assert!(middle(FRAC_PI_2, 0.0).distance(Vec3::X) < 1e-6);
        assert!(middle(0.0, FRAC_PI_2).distance(Vec3::Y) < 1e-6);
        assert!(middle(PI, 0.0).distance(Vec3::Z) < 1e-6);
    }

    #[test]
    fn image_edges_lie_half_the_field_of_view_away() {
        let up = view(0.0, 0.0).direction(1.5, 0.0);
        assert!(up.distance(Vec3::new(0.0, 1.0, -1.0).normalize()) < 1e-6);
        let right = view(0.0, 0.0).direction(3.0, 1.5);
        assert!(right.distance(Vec3::new(1.0, 0.0, -1.0).normalize()) < 1e-6);
    }

    #[test]
    fn a_view_shows_the_map_where_the_map_says() {
        // One bright texel: the view towards its middle is brightest in its own middle pixel.
        let (width, height, i, j) = (32, 16, 6, 9);
        let mut texels = vec![Vec3::ZERO; width * height];
        texels[i * width + j] = Vec3::ONE;
        let map = EnvironmentMap::new(width, height, texels).unwrap();
        let towards = map.direction_of(i, j);
        let pitch = towards.y.asin();
        let yaw = towards.x.atan2(-towards.z);
        let image = PanoramaView {
            fov_rad: 0.2,
            ..view(yaw, pitch)
        }
        .take(&map);
        let brightest = image.0.pixels().iter().map(|p| p.x).fold(0.0, f32::max);
        assert_eq!(image.0.get(1, 1).x, brightest);
        assert!(brightest > 0.5);
    }
}
