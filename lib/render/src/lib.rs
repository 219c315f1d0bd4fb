//! Light transport: from a scene and a light to pictures.
pub mod bsdf;
pub mod surface;
