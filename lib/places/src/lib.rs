//! Training the light estimator on panoramas of real places.
//!
//! Photographs are drawn from the panoramas as cameras would take them, each with the light that falls on its camera.
//! Places are left out in folds, never photographs: figures are of places that nothing was trained on.
pub mod cameras;
pub mod error;
pub mod examples;
pub mod figures;
pub mod left_out;
mod loss;
mod network;
pub mod place;
pub mod probes;
pub mod run;
pub mod several;
pub mod shot;
#[cfg(test)]
mod tests;
pub mod trainer;
pub mod view;

pub use error::PlacesError;
pub use left_out::LeftOut;
pub use run::{Progress, Settings, run};
