//! The `[concepts]` table.
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// The `[concepts]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ConceptsTable {
    /// Images; 0 switches concept preservation off.
    pub count: usize,
    /// Steps of the sampler.
    pub steps: usize,
    /// Classifier-free guidance scale, 1 for none.
    pub guidance: f64,
    /// Side of the images in pixels; the model's own by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size: Option<usize>,
    /// Folder of finished images that scenes of one class and model share, and in which an
    /// interrupted run goes on; `concepts-cache` in the folder of artifacts by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cache: Option<PathBuf>,
}

impl Default for ConceptsTable {
    fn default() -> Self {
        Self {
            count: 32,
            // DPM-Solver++ changes little beyond 20 to 30 steps.
            steps: 25,
            guidance: 7.5,
            size: None,
            cache: None,
        }
    }
}
