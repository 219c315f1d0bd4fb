//! The last blocks with other scales and biases: the same weights, turned to a task.
use safetensors::{Dtype, SafeTensors};

use crate::layers::Scale;
use crate::network::{Backbone, BackboneError};

/// The first block that can be tuned.
pub const TUNED_FROM: usize = 9;
/// Layers of a block, in order.
const LAYERS: [&str; 3] = ["expand", "depthwise", "project"];

/// For each output of each layer from block [`TUNED_FROM`] on, what it is multiplied by, and its bias.
#[derive(Clone, Debug, PartialEq)]
pub struct Tuned {
    pub(crate) blocks: Vec<[Scale; 3]>,
}

impl Tuned {
    /// Reads `PREFIX.block.N.LAYER.scale` and `.bias` (float32) for the embedded network; none if the file has no tensor
    /// of that prefix.
    ///
    /// # Errors
    /// If one is missing, of another size or type, or holds values that are not finite.
    pub fn read(file: &SafeTensors<'_>, prefix: &str) -> Result<Option<Self>, BackboneError> {
        let start = format!("{prefix}.");
        if !file.names().into_iter().any(|n| n.starts_with(&start)) {
            return Ok(None);
        }
        let values = |name: String, count: usize| {
            let refused = |why: &str| BackboneError(format!("`{name}` {why}"));
            let tensor = file.tensor(&name).map_err(|_| refused("is missing"))?;
            if tensor.dtype() != Dtype::F32 || tensor.shape() != [count] {
                let (kind, shape) = (tensor.dtype(), tensor.shape());
                return Err(refused(&format!(
                    "is {kind:?} of {shape:?}, not F32 of [{count}]"
                )));
            }
            let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
            let all: Vec<f32> = tensor.data().chunks_exact(4).map(number).collect();
            match all.iter().all(|v| v.is_finite()) {
                true => Ok(all),
                false => Err(refused("holds values that are not finite")),
            }
        };
        let sizes = Backbone::embedded().tuned_sizes();
        let mut blocks = Vec::with_capacity(sizes.len());
        for (n, sizes) in sizes.into_iter().enumerate() {
            let layer = |k: usize| {
                let name = format!("{prefix}.block.{}.{}", n + TUNED_FROM, LAYERS[k]);
                Ok(Scale {
                    factor: values(format!("{name}.scale"), sizes[k])?,
                    bias: values(format!("{name}.bias"), sizes[k])?,
                })
            };
            blocks.push([layer(0)?, layer(1)?, layer(2)?]);
        }
        Ok(Some(Self { blocks }))
    }

    /// The tensors that [`read`](Self::read) takes, with their names.
    pub fn tensors(&self, prefix: &str) -> Vec<(String, &[f32])> {
        let mut all = Vec::new();
        for (n, block) in self.blocks.iter().enumerate() {
            for (scale, layer) in block.iter().zip(LAYERS) {
                let name = format!("{prefix}.block.{}.{layer}", n + TUNED_FROM);
                all.push((format!("{name}.scale"), scale.factor.as_slice()));
                all.push((format!("{name}.bias"), scale.bias.as_slice()));
            }
        }
        all
    }
}
