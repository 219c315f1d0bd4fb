//! The `[concepts]` table.
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The `[concepts]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ConceptsTable {
    /// Images of the object's class; 0 switches concept preservation off.
    #[schemars(example = 16)]
    pub count: usize,
    /// Denoising steps of an image.
    #[schemars(range(min = 1), example = 30)]
    pub steps: usize,
    /// Scale of classifier-free guidance; 1 is none.
    #[schemars(range(min = 0.0), example = 5.0)]
    pub guidance: f64,
    /// Side of the images, pixels.
    #[schemars(extend("x-default" = "the model's own"), example = 512)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size: Option<usize>,
    /// Folder of finished images that scenes of one class and model share, and in which an
    /// interrupted run goes on.
    #[schemars(extend("format" = "path"), extend("x-default" = "`concepts-cache` in `pipeline.out`"), example = &"../concepts-cache")]
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
