//! Light from far away: spherical Gaussians and environment maps.
pub mod illuminant;
