//! Measures how good the light of a method is on scenes whose true light is known: makes scenes, runs the methods on
//! them through the executables, and compares pictures and lights with the true ones. Nothing of the pipeline imports
//! this.
//!
//! Everything is in one folder: `scenes/`, `maps/` and `objects/` that are made, `runs/METHOD/SCENE/`
//! with pictures and scores, `work/` where stages run, and the report.
mod check;
mod chosen;
mod columns;
pub mod command_line;
pub mod definition;
pub mod folder;
mod generated;
pub mod left_out;
mod lights;
pub mod make;
pub mod methods;
mod metrics;
mod page;
mod panoramas;
mod parts;
pub mod report;
mod report_page;
pub mod run;
mod runner;
pub mod score;
pub mod spheres;
pub mod study;
