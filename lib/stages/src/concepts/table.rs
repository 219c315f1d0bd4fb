//! The `[concepts]` table.
use std::path::PathBuf;

use dipir_pipeline::config::Config;
use dipir_pipeline::error::ConfigError;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Largest side of an image, pixels: four times that of published models.
const MAX_SIZE: usize = 4096;

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
    #[schemars(range(min = 1, max = 4096), extend("x-default" = "the model's own"), example = 512)]
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

impl ConceptsTable {
    /// Refuses what no run can work with.
    pub(super) fn check(&self, config: &Config) -> Result<(), ConfigError> {
        if self.steps == 0 {
            return Err(config.out_of_range("concepts.steps", self.steps, "at least 1"));
        }
        if !(self.guidance >= 0.0 && self.guidance.is_finite()) {
            return Err(config.out_of_range("concepts.guidance", self.guidance, "at least 0"));
        }
        match self.size {
            Some(size) if !(1..=MAX_SIZE).contains(&size) => {
                let accepted = format!("1 to {MAX_SIZE}");
                Err(config.out_of_range("concepts.size", size, &accepted))
            }
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn values_that_no_run_can_work_with_are_refused_by_line_and_key() {
        let refusal = |line: &str| {
            let text = format!("[concepts]\n{line}\n");
            let config = Config::parse(Path::new("pipeline.toml"), &text, &[]).expect("TOML");
            let table: ConceptsTable = config.table("concepts").expect("a table");
            table.check(&config).err().map(|e| e.to_string())
        };
        for (line, key, accepted) in [
            ("steps = 0", "steps: 0", "at least 1"),
            ("guidance = nan", "guidance: NaN", "at least 0"),
            ("guidance = -0.5", "guidance: -0.5", "at least 0"),
            ("size = 0", "size: 0", "1 to 4096"),
            ("size = 4097", "size: 4097", "1 to 4096"),
        ] {
            let wanted =
                format!("pipeline.toml:2: concepts.{key} is out of range; accepted: {accepted}");
            assert_eq!(refusal(line).as_deref(), Some(wanted.as_str()));
        }
        assert_eq!(refusal("size = 4096"), None);
    }
}
