//! Lookup table.

use candle_core::Tensor;

use crate::error::Result;
use crate::parameters::{Init, Parameters};

/// Rows of a table by index.
#[derive(Debug, Clone)]
pub struct Embedding {
    table: Tensor,
}

impl Embedding {
    /// Table [entries, size] below `parameters`.
    pub fn new(parameters: &Parameters, entries: usize, size: usize) -> Result<Self> {
        Ok(Self {
            table: parameters.get("weight", &[entries, size], Init::Normal(0.02))?,
        })
    }

    /// The table [entries, size].
    pub fn table(&self) -> &Tensor {
        &self.table
    }

    /// Indices [batch, length] to [batch, length, size].
    pub fn forward(&self, indices: &Tensor) -> Result<Tensor> {
        let (batch, length) = indices.dims2()?;
        let rows = self.table.index_select(&indices.flatten_all()?, 0)?;
        Ok(rows.reshape((batch, length, self.table.dims()[1]))?)
    }
}
