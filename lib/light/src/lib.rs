//! Light from far away: spherical Gaussians and environment maps.
pub mod environment;
mod environment_sampler;
pub mod error;
pub mod gaussian;
pub mod illuminant;
pub mod luminance;
mod trigonometry;
