//! What a killed recovery of materials needs to go on to the same bytes.
//!
//! Random numbers are functions of seed and iteration, so the iteration is their position.
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::adam::Adam;
use crate::error::OptimizeError;
use crate::materials::MaterialSettings;
use crate::snapshot::{Snapshot, SnapshotFile};
use crate::tensors::Tensors;

/// The state between two iterations.
#[derive(Clone, Debug, PartialEq)]
pub struct MaterialState {
    /// The next iteration.
    pub iteration: usize,
    /// What is recovered.
    pub parameters: Tensors,
    /// Moments of the optimiser.
    pub adam: Adam,
    /// The mean of the parameters so far, over the steps that count.
    pub mean: Tensors,
    /// Steps that were not finite, one after the other up to now.
    pub bad_in_a_row: usize,
    /// Loss of every step's picture, where it is a number.
    pub losses: Vec<f64>,
}

/// Version of the file.
const SCHEMA: u32 = 1;

/// The part of a checkpoint that is JSON.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    schema: u32,
    materials: Vec<usize>,
    settings: MaterialSettings,
    iteration: usize,
    steps: u64,
    #[serde(default)]
    bad_in_a_row: usize,
    losses: Vec<f64>,
}

impl MaterialState {
    /// Before the first iteration.
    pub fn new(parameters: Tensors) -> Self {
        Self {
            iteration: 0,
            adam: Adam::new(&parameters),
            mean: parameters.zeros_like(),
            parameters,
            bad_in_a_row: 0,
            losses: Vec::new(),
        }
    }

    /// Writes the state of a run for the materials with these indices; a crash leaves the earlier
    /// file or this one.
    pub fn write(
        &self,
        path: &Path,
        materials: &[usize],
        settings: &MaterialSettings,
    ) -> Result<(), OptimizeError> {
        let header = Header {
            schema: SCHEMA,
            materials: materials.to_vec(),
            settings: *settings,
            iteration: self.iteration,
            steps: self.adam.steps,
            bad_in_a_row: self.bad_in_a_row,
            losses: self.losses.clone(),
        };
        let mut snapshot = Snapshot::new(&header);
        snapshot.add_set("parameters", &self.parameters);
        snapshot.add_set("first", &self.adam.first);
        snapshot.add_set("second", &self.adam.second);
        snapshot.add_set("mean", &self.mean);
        snapshot.write(path)
    }

    /// Reads the state of a run for the same materials with the same settings, whose parameters
    /// have the shape of `start`. `None` if there is no file.
    pub fn read(
        path: &Path,
        materials: &[usize],
        settings: &MaterialSettings,
        start: &Tensors,
    ) -> Result<Option<Self>, OptimizeError> {
        let Some(file) = SnapshotFile::read(path)? else {
            return Ok(None);
        };
        let header: Header = file.header()?;
        file.check_schema(header.schema, SCHEMA)?;
        if header.materials != materials || header.settings != *settings {
            return Err(file.refused("belongs to a run with other settings".into()));
        }
        Ok(Some(Self {
            iteration: header.iteration,
            parameters: file.set("parameters", start)?,
            adam: Adam {
                first: file.set("first", start)?,
                second: file.set("second", start)?,
                steps: header.steps,
            },
            mean: file.set("mean", start)?,
            bad_in_a_row: header.bad_in_a_row,
            losses: header.losses,
        }))
    }
}
