//! What a killed run needs to go on to the same bytes: one file, replaced in one step.
//!
//! Random numbers are functions of seed and iteration, so the iteration is their position.
use std::path::Path;

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::adam::Adam;
use crate::error::OptimizeError;
use crate::history::Row;
use crate::parameters::Parameters;
use crate::settings::Settings;
use crate::snapshot::{Snapshot, SnapshotFile};

/// The state between two iterations.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// The next iteration.
    pub iteration: usize,
    /// Iterations of the run, where a time budget decided them.
    pub planned: Option<usize>,
    /// What is optimised.
    pub parameters: Parameters,
    /// Moments of the optimiser.
    pub adam: Adam,
    /// Steps that were not finite, one after the other up to now.
    pub bad_in_a_row: usize,
    /// Times that the transport was recorded anew.
    pub records: usize,
    /// The light that the last of these records was made for.
    pub record_light: Option<Vec<Vec3>>,
    /// One row per iteration.
    pub history: Vec<Row>,
}

/// Version of the file.
const SCHEMA: u32 = 2;

/// The part of a checkpoint that is JSON.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    schema: u32,
    settings: Settings,
    iteration: usize,
    steps: u64,
    bad_in_a_row: usize,
    records: usize,
    history: Vec<Row>,
}

impl State {
    /// Before the first iteration.
    pub fn new(parameters: Parameters) -> Self {
        Self {
            iteration: 0,
            planned: None,
            adam: Adam::new(&parameters.to_tensors()),
            parameters,
            bad_in_a_row: 0,
            records: 0,
            record_light: None,
            history: Vec::new(),
        }
    }

    /// Writes the state beside `path`, flushes it and renames it into place: a crash leaves the
    /// earlier checkpoint or this one. The iterations of `settings` are those of the schedule.
    pub fn write(&self, path: &Path, settings: &Settings) -> Result<(), OptimizeError> {
        let header = Header {
            schema: SCHEMA,
            settings: settings.clone(),
            iteration: self.iteration,
            steps: self.adam.steps,
            bad_in_a_row: self.bad_in_a_row,
            records: self.records,
            history: self.history.clone(),
        };
        let mut snapshot = Snapshot::new(&header);
        snapshot.add_set("parameters", &self.parameters.to_tensors());
        snapshot.add_set("first", &self.adam.first);
        snapshot.add_set("second", &self.adam.second);
        if let Some(light) = &self.record_light {
            snapshot.add_colors("record_light", light);
        }
        snapshot.write(path)
    }

    /// Reads a checkpoint of a run with these settings and parameters of the same shape as
    /// `start`. `None` if there is no file.
    pub fn read(
        path: &Path,
        settings: &Settings,
        start: &Parameters,
    ) -> Result<Option<Self>, OptimizeError> {
        let Some(file) = SnapshotFile::read(path)? else {
            return Ok(None);
        };
        let header: Header = file.header()?;
        file.check_schema(header.schema, SCHEMA)?;
        let scheduled = header.settings.iterations;
        let planned = settings
            .time_budget_s
            .is_some_and(|_| (1..=settings.iterations).contains(&scheduled))
            .then_some(scheduled);
        let expected = Settings {
            iterations: planned.unwrap_or(settings.iterations),
            ..settings.clone()
        };
        if header.settings != expected {
            return Err(file.refused("belongs to a run with other settings".into()));
        }
        let shape = start.to_tensors();
        let adam = Adam {
            first: file.set("first", &shape)?,
            second: file.set("second", &shape)?,
            steps: header.steps,
        };
        Ok(Some(Self {
            iteration: header.iteration,
            planned,
            parameters: Parameters::from_tensors(&file.set("parameters", &shape)?),
            adam,
            bad_in_a_row: header.bad_in_a_row,
            records: header.records,
            record_light: file.colors("record_light")?,
            history: header.history,
        }))
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use safetensors::tensor::TensorView;

    use super::*;
    use crate::settings::LightTable;
    use crate::testing::PRESET;

    fn settings() -> Settings {
        LightTable::default().settings(&PRESET, 3).unwrap()
    }

    fn state() -> State {
        let mut state = State::new(Parameters::neutral(4, 0.3));
        state.iteration = 17;
        state.adam.first.0[1].values[2] = 0.1 + 0.2;
        state.adam.steps = 16;
        state.record_light = Some(vec![Vec3::new(0.1, 2.0, 3e5); 6]);
        state.records = 1;
        state
    }

    #[test]
    fn what_is_written_comes_back_bit_by_bit_and_the_same_state_gives_the_same_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        let start = Parameters::neutral(4, 0.9);
        assert_eq!(State::read(&path, &settings(), &start).unwrap(), None);
        state().write(&path, &settings()).unwrap();
        let first = fs::read(&path).unwrap();
        assert_eq!(
            State::read(&path, &settings(), &start).unwrap(),
            Some(state())
        );
        state().write(&path, &settings()).unwrap();
        assert_eq!(fs::read(&path).unwrap(), first);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn damaged_foreign_and_mismatched_checkpoints_are_refused_with_the_reason() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        state().write(&path, &settings()).unwrap();
        let refusal = |settings: &Settings, lobes| {
            let start = Parameters::neutral(lobes, 1.0);
            State::read(&path, settings, &start)
                .unwrap_err()
                .to_string()
        };
        let other = Settings {
            seed: 4,
            ..settings()
        };
        assert!(refusal(&other, 4).contains("belongs to a run with other settings; delete it"));
        let shape = refusal(&settings(), 5);
        assert!(
            shape.contains("\"first.foreground.log_radiance\" as F64 [12]; expected F64 [15]"),
            "{shape}"
        );
        let whole = fs::read(&path).unwrap();
        for length in [0, 5, 100, whole.len() - 1] {
            fs::write(&path, &whole[..length]).unwrap();
            assert!(refusal(&settings(), 4).contains("is damaged"), "{length}");
        }
        let empty: Vec<(String, TensorView)> = vec![];
        fs::write(&path, safetensors::serialize(empty, None).unwrap()).unwrap();
        assert!(refusal(&settings(), 4).contains("is no checkpoint"));
    }
}
