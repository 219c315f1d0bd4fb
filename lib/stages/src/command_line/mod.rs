//! The command lines of the stages' executables. Manual pages and completions read them, too.
#![allow(missing_docs)] // clap shows doc comments to users: what is flattened has none
pub mod composite;
pub mod concepts;
pub mod light;
pub mod lora;
pub mod model;
pub mod scene;
