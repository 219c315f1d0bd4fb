//! What varies from one evaluation of a model to the next.

use std::sync::Arc;

use crate::lora::Lora;
use crate::recompute::Recompute;

/// Options of one forward pass. Cheap to clone.
#[derive(Debug, Clone, Default)]
pub struct Pass {
    /// Adapter applied to the attention projections.
    pub lora: Option<Arc<Lora>>,
    /// Only the first rows of the batch see the adapter; all if `None`. This
    /// lets adapted and un-adapted predictions share one batch.
    pub lora_rows: Option<usize>,
    /// Drop activations inside blocks and compute them again backwards.
    pub recompute: Option<Recompute>,
}

impl Pass {
    /// With an adapter on every row.
    pub fn with_lora(lora: &Arc<Lora>) -> Self {
        Self {
            lora: Some(lora.clone()),
            ..Self::default()
        }
    }

    /// The same pass without recomputation: what runs inside a segment.
    pub(crate) fn inside_segment(&self) -> Self {
        Self {
            recompute: None,
            ..self.clone()
        }
    }
}
