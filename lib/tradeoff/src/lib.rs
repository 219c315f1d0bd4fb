//! What accuracy costs: settings are turned one at a time and several together, the executables run with
//! them as a user would, and errors and processor seconds are drawn. Nothing of the pipeline imports
//! this.
pub mod command_line;
mod knobs;
mod lights;
mod measure;
mod scenes;
pub mod sweep;
mod tables;
