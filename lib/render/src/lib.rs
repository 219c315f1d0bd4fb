//! Light transport: from a scene and a light to pictures.
pub mod adaptive;
pub mod blocker;
pub mod bsdf;
mod coarse;
pub mod convexity;
pub mod counters;
pub mod effects;
pub mod error;
pub mod features;
pub mod film;
pub mod footprint;
pub mod foreground;
pub mod foresight;
pub mod gbuffer;
pub mod highlights;
pub mod job;
pub mod light;
pub mod material_gradient;
pub mod photo;
pub mod pilot;
pub mod render;
pub mod shadow;
pub mod shapes;
pub mod surface;
#[cfg(test)]
mod testing;
pub mod transport;
pub mod world;
