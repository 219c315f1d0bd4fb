//! What the light stage prints when it has run.
use std::fmt;

use dipir_optimize::history::Row;
use glam::Vec3;
use serde_json::{Value, json};

use super::Done;
use super::words::in_words;
use crate::written;

/// Degrees above the horizon, and counter-clockwise from +z seen from above.
fn angles_deg(direction: Vec3) -> [f32; 2] {
    let elevation = direction.y.clamp(-1.0, 1.0).asin();
    let azimuth = direction.x.atan2(direction.z);
    [elevation.to_degrees(), azimuth.to_degrees()]
}

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
            "folder": self.folder,
            "size": self.size,
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
                write!(f, " on {} x {} pixels", self.size[0], self.size[1])?
            }
        }
        if let Some(rmse) = self.found.rmse {
            write!(f, ", {rmse:.5} of display-referred RMSE from the reference")?;
        }
        if let Some(peak) = self.found.lighting.peak_direction() {
            let [elevation, azimuth] = angles_deg(peak);
            write!(
                f,
                "\n  most light comes from {elevation:.1} degrees above the horizon, {azimuth:.1} \
                 degrees from +z towards +x"
            )?;
        }
        if let Some(estimated) = &self.found.estimated {
            write!(f, "\n  {}", in_words(&estimated.estimate))?;
            if estimated.photographs > 1 {
                write!(f, "\n  from {} photographs", estimated.photographs)?;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_are_told_as_heights_and_turns() {
        assert_eq!(angles_deg(Vec3::Y)[0], 90.0);
        assert_eq!(angles_deg(Vec3::Z), [0.0, 0.0]);
        assert_eq!(angles_deg(Vec3::X), [0.0, 90.0]);
        assert_eq!(angles_deg(Vec3::NEG_X), [0.0, -90.0]);
    }
}
