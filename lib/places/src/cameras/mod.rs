//! Training the networks that tell a photograph's camera, and how well it is told of places left out.
pub mod figures;
pub mod run;
#[cfg(test)]
mod tests;
mod trainer;

pub use figures::{Case, Row, table};
pub use run::{Outcome, Progress, Settings, run};
