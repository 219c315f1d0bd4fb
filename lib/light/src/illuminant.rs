//! The interface of distant lights.
use glam::{Vec2, Vec3};

/// A direction drawn in proportion to the light, with its radiance and density.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LightSample {
    /// Unit vector towards the light, world space.
    pub direction: Vec3,
    /// Radiance arriving from `direction`, linear Rec.709.
    pub radiance: Vec3,
    /// Density per steradian with which `direction` was drawn; 0 means "no sample" (a black light).
    pub pdf: f32,
}

/// Light that arrives from infinitely far away.
///
/// `sample` and `pdf` describe one density over the unit sphere: it integrates to 1
/// (or is 0 everywhere for a black light) and is positive wherever `eval` is.
pub trait Illuminant: Sync {
    /// Radiance arriving from the unit vector `direction`.
    fn eval(&self, direction: Vec3) -> Vec3;
    /// Draws a direction from two uniform numbers in `[0, 1)`.
    fn sample(&self, u: Vec2) -> LightSample;
    /// Density per steradian of `sample` at the unit vector `direction`.
    fn pdf(&self, direction: Vec3) -> f32;
    /// [`eval`](Self::eval) and [`pdf`](Self::pdf) together, for the price of one where they
    /// share their work.
    fn eval_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        (self.eval(direction), self.pdf(direction))
    }
}

impl<T: Illuminant + ?Sized> Illuminant for &T {
    fn eval(&self, direction: Vec3) -> Vec3 {
        (**self).eval(direction)
    }
    fn sample(&self, u: Vec2) -> LightSample {
        (**self).sample(u)
    }
    fn pdf(&self, direction: Vec3) -> f32 {
        (**self).pdf(direction)
    }
    fn eval_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        (**self).eval_pdf(direction)
    }
}

impl<T: Illuminant + Send + ?Sized> Illuminant for std::sync::Arc<T> {
    fn eval(&self, direction: Vec3) -> Vec3 {
        (**self).eval(direction)
    }
    fn sample(&self, u: Vec2) -> LightSample {
        (**self).sample(u)
    }
    fn pdf(&self, direction: Vec3) -> f32 {
        (**self).pdf(direction)
    }
    fn eval_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        (**self).eval_pdf(direction)
    }
}
