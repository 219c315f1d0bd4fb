//! What a killed run needs to go on to the same bytes: one file, replaced in one step.
//!
//! Tensors in safetensors (f64, so that nothing is rounded), everything else as JSON in its header.
//! Random numbers are functions of seed and iteration, so the iteration is their position.
use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File};
use std::io::Write;
use std::path::Path;

use glam::Vec3;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use serde::{Deserialize, Serialize};

use crate::adam::Adam;
use crate::error::OptimizeError;
use crate::history::Row;
use crate::parameters::Parameters;
use crate::settings::Settings;
use crate::tensors::Tensors;

/// The state between two iterations.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// The next iteration.
    pub iteration: usize,
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
const SCHEMA: u32 = 1;

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
            adam: Adam::new(&parameters.to_tensors()),
            parameters,
            bad_in_a_row: 0,
            records: 0,
            record_light: None,
            history: Vec::new(),
        }
    }

    /// Writes the state beside `path`, flushes it and renames it into place: a crash leaves the
    /// earlier checkpoint or this one.
    pub fn write(&self, path: &Path, settings: &Settings) -> Result<(), OptimizeError> {
        let failed = |e| OptimizeError::io("write", path, e);
        let bytes = self.to_bytes(settings).map_err(failed)?;
        let partial = path.with_extension("partial");
        let mut file = File::create(&partial).map_err(failed)?;
        file.write_all(&bytes).map_err(failed)?;
        file.sync_all().map_err(failed)?;
        fs::rename(&partial, path).map_err(failed)
    }

    fn to_bytes(&self, settings: &Settings) -> std::io::Result<Vec<u8>> {
        let header = Header {
            schema: SCHEMA,
            settings: settings.clone(),
            iteration: self.iteration,
            steps: self.adam.steps,
            bad_in_a_row: self.bad_in_a_row,
            records: self.records,
            history: self.history.clone(),
        };
        let metadata = HashMap::from([("state".to_string(), serde_json::to_string(&header)?)]);
        let mut data = BTreeMap::new();
        let parameters = self.parameters.to_tensors();
        let sets = [
            ("parameters", &parameters),
            ("first", &self.adam.first),
            ("second", &self.adam.second),
        ];
        for (set, tensors) in sets {
            for t in &tensors.0 {
                let bytes: Vec<u8> = t.values.iter().flat_map(|v| v.to_le_bytes()).collect();
                data.insert(
                    format!("{set}.{}", t.name),
                    (Dtype::F64, vec![t.values.len()], bytes),
                );
            }
        }
        if let Some(light) = &self.record_light {
            let numbers = light.iter().flat_map(|t| t.to_array());
            let bytes: Vec<u8> = numbers.flat_map(f32::to_le_bytes).collect();
            data.insert(
                "record_light".into(),
                (Dtype::F32, vec![light.len(), 3], bytes),
            );
        }
        let views: Result<Vec<_>, _> = data
            .iter()
            .map(|(name, (dtype, shape, bytes))| {
                TensorView::new(*dtype, shape.clone(), bytes).map(|view| (name, view))
            })
            .collect();
        let views = views.map_err(std::io::Error::other)?;
        safetensors::serialize(views, Some(metadata)).map_err(std::io::Error::other)
    }

    /// Reads a checkpoint of a run with these settings and parameters of the same shape as
    /// `start`. `None` if there is no file.
    pub fn read(
        path: &Path,
        settings: &Settings,
        start: &Parameters,
    ) -> Result<Option<Self>, OptimizeError> {
        let bytes = match fs::read(path) {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            read => read.map_err(|e| OptimizeError::io("read", path, e))?,
        };
        let bad = |detail: String| OptimizeError::BadFile {
            path: path.into(),
            detail,
            remedy: "delete it to start from the beginning",
        };
        let damaged = |e: &dyn std::fmt::Display| bad(format!("is damaged: {e}"));
        let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(|e| damaged(&e))?;
        let text = metadata.metadata().as_ref().and_then(|m| m.get("state"));
        let text = text.ok_or_else(|| bad("is no checkpoint of an optimisation".into()))?;
        let header: Header = serde_json::from_str(text)
            .map_err(|e| bad(format!("was written by another version: {e}")))?;
        if header.schema != SCHEMA {
            return Err(bad(format!("has schema {}, not {SCHEMA}", header.schema)));
        }
        if header.settings != *settings {
            return Err(bad("belongs to a run with other settings".into()));
        }
        let tensors = SafeTensors::deserialize(&bytes).map_err(|e| damaged(&e))?;
        let shape = start.to_tensors();
        let load = |set: &str| load_set(&tensors, set, &shape).map_err(bad);
        let adam = Adam {
            first: load("first")?,
            second: load("second")?,
            steps: header.steps,
        };
        Ok(Some(Self {
            iteration: header.iteration,
            parameters: Parameters::from_tensors(&load("parameters")?),
            adam,
            bad_in_a_row: header.bad_in_a_row,
            records: header.records,
            record_light: load_light(&tensors).map_err(bad)?,
            history: header.history,
        }))
    }
}

fn load_set(file: &SafeTensors, set: &str, shape: &Tensors) -> Result<Tensors, String> {
    let mut loaded = shape.clone();
    for t in &mut loaded.0 {
        let name = format!("{set}.{}", t.name);
        let view = file
            .tensor(&name)
            .map_err(|_| format!("holds no tensor \"{name}\""))?;
        if view.dtype() != Dtype::F64 || view.shape() != [t.values.len()] {
            return Err(format!(
                "holds \"{name}\" as {:?} {:?}; expected F64 [{}]",
                view.dtype(),
                view.shape(),
                t.values.len()
            ));
        }
        let numbers = view.data().as_chunks::<8>().0.iter();
        t.values = numbers.map(|b| f64::from_le_bytes(*b)).collect();
        if t.values.iter().any(|v| !v.is_finite()) {
            return Err(format!("holds a NaN or an infinity in \"{name}\""));
        }
    }
    Ok(loaded)
}

fn load_light(file: &SafeTensors) -> Result<Option<Vec<Vec3>>, String> {
    let Ok(view) = file.tensor("record_light") else {
        return Ok(None);
    };
    if view.dtype() != Dtype::F32 || view.shape().len() != 2 || view.shape()[1] != 3 {
        return Err("holds a \"record_light\" that is no list of colours".into());
    }
    let texel = |b: &[u8; 12]| {
        let at = |k: usize| f32::from_le_bytes([b[k], b[k + 1], b[k + 2], b[k + 3]]);
        Vec3::new(at(0), at(4), at(8))
    };
    Ok(Some(
        view.data().as_chunks::<12>().0.iter().map(texel).collect(),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::{OptimizeTable, Preset};

    fn settings() -> Settings {
        OptimizeTable::default().settings(Preset::Draft, 3).unwrap()
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
