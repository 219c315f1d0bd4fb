//! Latitude-longitude environment maps, piecewise constant.
//!
//! OpenEXR's convention: the top row looks to +y, the centre column to +z, and +x lies to the
//! left of the centre. Texel `(i, j)` (row, column) is the cell between the polar angles
//! `pi i / H` and `pi (i + 1) / H` and the azimuths `2 pi j / W` and `2 pi (j + 1) / W`, where
//! a direction is `(sin phi sin theta, cos theta, -cos phi sin theta)`. Its radiance is one
//! colour: evaluation, sampling and transport all use that one definition.
use std::f64::consts::{PI, TAU};

use glam::{DVec3, Vec3};

use dipir_imaging::raster::{LinearImage, Raster};

use crate::error::LightError;
use crate::trigonometry::{atan2_turns, sin_cos_turns};

pub use crate::environment_sampler::EnvironmentSampler;

/// Radiance from every direction, constant over each cell of a latitude-longitude grid.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentMap {
    width: usize,
    height: usize,
    texels: Vec<Vec3>,
}

impl EnvironmentMap {
    /// A map of `width * height` texels, row by row from the top. Errors name the first texel
    /// that is negative or not finite.
    pub fn new(width: usize, height: usize, texels: Vec<Vec3>) -> Result<Self, LightError> {
        if width == 0 || height == 0 {
            return Err(LightError::Empty { width, height });
        }
        if texels.len() != width * height {
            return Err(LightError::TexelCount {
                found: texels.len(),
                width,
                height,
            });
        }
        let bad = |t: &Vec3| !t.is_finite() || t.min_element() < 0.0;
        if let Some(k) = texels.iter().position(bad) {
            return Err(LightError::Texel {
                column: k % width,
                row: k / width,
                value: texels[k],
            });
        }
        Ok(Self {
            width,
            height,
            texels,
        })
    }

    /// The same radiance from everywhere. Panics on an empty size or a negative or non-finite
    /// radiance.
    pub fn constant(width: usize, height: usize, radiance: Vec3) -> Self {
        assert!(width > 0 && height > 0, "{width} x {height} texels");
        assert!(
            radiance.is_finite() && radiance.min_element() >= 0.0,
            "radiance {radiance}"
        );
        Self {
            width,
            height,
            texels: vec![radiance; width * height],
        }
    }

    /// A map from an image in latitude-longitude layout.
    pub fn from_image(image: &LinearImage) -> Result<Self, LightError> {
        Self::new(image.0.width(), image.0.height(), image.0.pixels().to_vec())
    }

    /// The map as an image.
    pub fn to_image(&self) -> LinearImage {
        LinearImage(Raster::from_pixels(
            self.width,
            self.height,
            self.texels.clone(),
        ))
    }

    /// Columns, around the horizon.
    #[inline]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows, from +y down to -y.
    #[inline]
    pub fn height(&self) -> usize {
        self.height
    }

    /// All texels, row by row from the top.
    #[inline]
    pub fn texels(&self) -> &[Vec3] {
        &self.texels
    }

    /// Radiance of texel `(i, j)`: row, column.
    #[inline]
    pub fn texel(&self, i: usize, j: usize) -> Vec3 {
        self.texels[i * self.width + j]
    }

    /// Radiance arriving from the unit vector `direction`.
    #[inline]
    pub fn eval(&self, direction: Vec3) -> Vec3 {
        let (i, j) = self.texel_of(direction);
        self.texels[i * self.width + j]
    }

    /// Row and column of the texel that `direction` points to.
    #[inline]
    pub fn texel_of(&self, direction: Vec3) -> (usize, usize) {
        texel_of(direction, self.width, self.height)
    }

    /// Unit vector to the middle (in polar angle and azimuth) of texel `(i, j)`.
    #[inline]
    pub fn direction_of(&self, i: usize, j: usize) -> Vec3 {
        direction_at(
            (j as f32 + 0.5) / self.width as f32,
            (i as f32 + 0.5) / self.height as f32,
        )
    }

    /// Solid angle of every texel of row `i`, in steradians.
    #[inline]
    pub fn solid_angle(&self, i: usize) -> f64 {
        solid_angle(self.width, self.height, i)
    }

    /// Radiance integrated over the sphere.
    pub fn integral(&self) -> DVec3 {
        (0..self.height)
            .map(|i| {
                let row = &self.texels[i * self.width..(i + 1) * self.width];
                row.iter().map(|t| t.as_dvec3()).sum::<DVec3>() * self.solid_angle(i)
            })
            .sum()
    }
}

/// Solid angle in steradians of a texel in row `i` of a `width` x `height` map:
/// `(cos theta_i - cos theta_{i+1}) 2 pi / W`, as a product of sines, which keeps its digits
/// at the poles.
#[inline]
pub fn solid_angle(width: usize, height: usize, i: usize) -> f64 {
    let middle = PI * (i as f64 + 0.5) / height as f64;
    let half = 0.5 * PI / height as f64;
    2.0 * middle.sin() * half.sin() * TAU / width as f64
}

/// Unit vector at azimuth `2 pi u` and polar angle `pi v`.
#[inline]
pub fn direction_at(u: f32, v: f32) -> Vec3 {
    let (sin_phi, cos_phi) = sin_cos_turns(u);
    let (sin_theta, cos_theta) = sin_cos_turns(0.5 * v);
    Vec3::new(sin_phi * sin_theta, cos_theta, -cos_phi * sin_theta)
}

/// Row and column of the texel of a `width` x `height` map that `direction` points to.
#[inline]
pub fn texel_of(direction: Vec3, width: usize, height: usize) -> (usize, usize) {
    let u = atan2_turns(direction.x, -direction.z);
    let sin_theta = (direction.x * direction.x + direction.z * direction.z).sqrt();
    let v = 2.0 * atan2_turns(sin_theta, direction.y);
    let i = (v * height as f32) as usize;
    let j = (u * width as f32) as usize;
    (i.min(height - 1), j.min(width - 1))
}
