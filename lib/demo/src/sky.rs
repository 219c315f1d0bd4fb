//! A clear afternoon sky with a few clouds, as a function of direction.
use glam::Vec3;

use crate::noise::fbm;
use crate::solids::smoothstep;

/// The sky of the demo.
#[derive(Clone, Copy, Debug)]
pub struct Sky {
    /// Unit vector towards the middle of the sun.
    pub sun: Vec3,
    /// Irradiance of the sun on a surface that faces it, linear Rec.709.
    pub sun_irradiance: Vec3,
    /// Angular radius of the sun, radians. Larger than the true 0.0047, so that a map of a
    /// thousand columns resolves it.
    pub sun_radius_rad: f32,
    /// Factor on the sky's radiance.
    pub brightness: f32,
}

impl Default for Sky {
    fn default() -> Self {
        Self {
            sun: Vec3::new(-0.68, 0.60, 0.16).normalize(),
            sun_irradiance: Vec3::new(4.3, 3.9, 3.2),
            sun_radius_rad: 0.0075,
            brightness: 0.16,
        }
    }
}

impl Sky {
    /// Radiance from `direction`, the sun left out.
    pub fn without_sun(&self, direction: Vec3) -> Vec3 {
        // CIE standard clear sky, type 12 [CIE S 011, 2003]: gradation and indicatrix.
        let height = direction.y.max(0.02);
        let gradation = 1.0 - (-0.32 / height).exp();
        let angle = direction.dot(self.sun).clamp(-1.0, 1.0).acos();
        let indicatrix = |chi: f32| {
            1.0 + 10.0 * ((-3.0 * chi).exp() - (-3.0 * std::f32::consts::FRAC_PI_2).exp())
                + 0.45 * chi.cos().powi(2)
        };
        let luminance = gradation * indicatrix(angle);
        // Blue above, pale towards the horizon, warm around the sun.
        let zenith = Vec3::new(0.30, 0.55, 1.10);
        let horizon = Vec3::new(0.82, 0.95, 1.10);
        let warm = Vec3::new(1.12, 1.02, 0.86);
        let pale = (1.0 - direction.y.max(0.0)).powi(4);
        let color = zenith.lerp(horizon, pale).lerp(warm, (-4.0 * angle).exp());
        let clear = self.brightness * luminance * color;
        self.clouded(direction, angle, clear)
    }

    fn clouded(&self, direction: Vec3, angle: f32, clear: Vec3) -> Vec3 {
        if direction.y <= 0.01 {
            return clear;
        }
        // A layer of clouds, bent down like the atmosphere so that it thins out at the horizon.
        let p = direction / (direction.y + 0.12);
        let shape = fbm(Vec3::new(1.1 * p.x, 0.7, 1.7 * p.z), 6, 11);
        let detail = fbm(Vec3::new(4.0 * p.x, 2.0, 6.0 * p.z), 4, 12);
        let density = smoothstep(0.53, 0.74, shape + 0.12 * (detail - 0.5));
        let silver = 0.55 + 1.3 * (-3.0 * angle).exp();
        let cloud = self.brightness * 4.2 * silver * Vec3::new(1.0, 0.985, 0.96);
        clear.lerp(cloud, 0.75 * density * smoothstep(0.02, 0.16, direction.y))
    }
}
