//! Models from a hub that speaks Hugging Face's protocol: which of a
//! repository's files make a model in the diffusers layout, fetching them so
//! that an interrupted run goes on where it stopped, and verifying each
//! against the hash that the hub publishes.
//!
//! Nothing else in the project reaches the network.

mod client;
mod error;
mod fetch;
mod selection;

pub use client::{Hub, RemoteFile, Revision};
pub use error::{Error, Result};
pub use fetch::{Outcome, Progress, SOURCE_FILE, Source, fetch, verify};
pub use selection::{Variant, select};
