//! The small model that knows light: scenes to train it on, how captions
//! name light, its training, and what it finds out about a photograph.

mod backdrop;
pub mod blueprint;
pub mod dataset;
pub mod encoder;
pub mod energy;
pub mod error;
pub mod examples;
pub mod gates;
pub mod lights;
mod naming;
mod photo;
pub mod place;
pub mod reader;
pub mod record;
pub mod shapes;
mod shards;
pub mod student;
pub mod studio;
pub mod tokenizer_files;
pub mod trainer;
pub mod words;
mod yard;

pub use error::{Error, Result};
