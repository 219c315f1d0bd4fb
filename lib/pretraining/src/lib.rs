//! What makes and trains the small model of `dipir-prior`: generated scenes, training of the diffusion model and of the
//! light encoder, quality checks, and the command line of `dipir-pretrain`. Nothing of the pipeline depends on it.

pub mod architecture;
mod backdrop;
mod batch;
mod camera;
pub mod checks;
pub mod command_line;
pub mod contact_sheet;
mod courtyard;
mod data_parallel;
pub mod dataset;
mod denoiser;
pub mod direct_light;
pub mod encoder_training;
pub mod error;
pub mod examples;
pub mod generated_photograph;
mod ground;
pub mod lighting;
mod random;
pub mod scene;
pub mod shapes;
mod sky;
mod square_camera;
mod tokenizer_files;
pub mod trainer;
pub mod training_run;
mod window;

pub use camera::CameraResponse;
pub use error::{Error, Result};
