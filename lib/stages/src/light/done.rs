//! What the light stage prints when it has run.
use std::fmt;

use dipir_cli::output::json_path;
use dipir_estimator::grid::relative;
use dipir_estimator::posterior::words;
use dipir_optimize::history::Row;
use serde_json::{Value, json};

use super::Done;
use super::words::{in_words, is_unplaced_sun, of_shadow};
use crate::{shown, written};

impl Done {
    fn records(&self) -> usize {
        self.found.history.iter().filter(|r| r.recorded).count()
    }

    fn guidance(&self, row: Option<&Row>) -> Option<f64> {
        row.and_then(|r| r.guidance)
    }

    /// For programs.
    pub fn to_json(&self) -> Value {
        let history = &self.found.history;
        json!({
            "folder": json_path(&self.folder),
            "size": self.camera.resolution,
            "iterations": history.len(),
            "wanted": self.wanted,
            "resumed_at": self.resumed_at,
            "skipped": self.found.skipped(),
            "stopped_early": self.found.stopped_early,
            "recorded_anew": self.records(),
            "guidance_at_start": self.guidance(history.first()),
            "guidance_at_end": self.guidance(history.last()),
            "rmse": self.found.rmse,
            "reading": self.found.reading,
            "estimate": self.found.estimated.as_ref().map(|e| &e.estimate),
            "other_presets": self.outlook.to_json(),
            "peak_direction": self.found.lighting.peak_direction(),
            "fusion_residual": self.found.lighting.fusion_residual,
            "elapsed_s": self.manifest.elapsed_s,
            "timings_s": self.manifest.timings_s,
            "peak_rss_bytes": self.manifest.peak_rss_bytes,
        })
    }
}

impl fmt::Display for Done {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        written(f, &self.folder, &self.manifest)?;
        match self.found.history.len() {
            0 => write!(f, "\n  nothing was optimised: the start is the light")?,
            n => {
                write!(f, "\n  {n} iterations")?;
                if let Some(wanted) = self.wanted {
                    write!(f, " of {wanted} within light.time_budget_s,")?;
                }
                let [width, height] = self.camera.resolution;
                write!(f, " on {width} x {height} pixels")?
            }
        }
        if let Some(rmse) = self.found.rmse {
            write!(f, ", {rmse:.5} of display-referred RMSE from the reference")?;
        }
        let estimated = self.found.estimated.as_ref();
        match estimated.filter(|_| self.found.history.is_empty()) {
            // The estimate tells itself where its light comes from, with how sure it is.
            Some(estimated) => {
                if let Some(chosen) = estimated.chosen() {
                    write!(f, "\n  {chosen}")?;
                }
            }
            None if self.is_neutral => {
                write!(f, "\n  it is neutral, nearly alike from all sides")?;
            }
            None => {
                if let Some(peak) = self.found.lighting.peak_direction() {
                    let seen = words(relative(peak, &self.camera));
                    write!(f, "\n  most light comes {seen}")?;
                }
            }
        }
        if let Some(estimated) = estimated {
            write!(f, "\n  {}", in_words(&estimated.estimate))?;
            if estimated.chosen().is_none() && is_unplaced_sun(&estimated.estimate) {
                write!(
                    f,
                    "\n  the sun probably shines, but its direction is not known well enough for a sharp shadow: {}say where \
                     the sun is (light.sun), or choose one of {} by its number (light.candidate)",
                    of_shadow(estimated.shadow),
                    shown(&self.folder.join("candidates.png"))
                )?;
            }
            if estimated.photographs > 1 {
                write!(f, "\n  from {} photographs", estimated.photographs)?;
            }
            if estimated.has_gain {
                write!(
                    f,
                    "\n  the photograph's gain map tells how bright what it shows is beyond white"
                )?;
            }
        }
        let skipped = self.found.skipped();
        if skipped > 0 {
            write!(
                f,
                "\n  {skipped} steps were skipped, because something was not finite"
            )?;
        }
        if !self.outlook.0.is_empty() {
            write!(f, "\n  {}", self.outlook.text())?;
        }
        Ok(())
    }
}
