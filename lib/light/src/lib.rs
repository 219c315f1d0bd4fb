//! Light from far away: spherical Gaussians and environment maps.
pub mod cone;
pub mod cosine;
pub mod environment;
mod environment_sampler;
pub mod error;
pub mod fit;
pub mod fusion;
pub mod gaussian;
pub mod illuminant;
mod lbfgs;
pub mod luminance;
pub mod map_with_lobes;
mod mixture;
pub mod plane;
mod quadrature;
pub mod rasterize;
pub mod regularizer;
mod trigonometry;

#[cfg(test)]
mod testing;
