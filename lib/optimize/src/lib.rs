//! Recovering the light of a photograph, and its tone curve, from what an inserted object ought
//! to look like in it [DiPIR, ECCV 2024, sections 4.1 and 4.3].
//!
//! One iteration goes through these modules, forwards and then backwards, by hand:
//!
//! ```text
//! parameters --> two maps --> fused --> object, shadow ratio --> toned --> composite --> display
//!  parameters     light       light         transport           imaging    imaging      imaging
//!                    |                                                                     |
//!                 regularisers                                                         guidance
//! ```
//!
//! [`objective`] holds that chain and its exact adjoint, [`guidance`] the loss on the picture,
//! [`adam`] the steps, [`optimization`] the loop over all of it.
pub mod adam;
pub mod checkpoint;
pub mod crop;
pub mod error;
pub mod guidance;
pub mod history;
pub mod lighting;
pub mod material_checkpoint;
pub mod materials;
pub mod objective;
pub mod optimization;
pub mod parameters;
pub mod recorder;
pub mod settings;
mod snapshot;
pub mod tensors;
pub mod transport;

#[cfg(test)]
mod testing;

pub use error::OptimizeError;
