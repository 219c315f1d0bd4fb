//! Low-rank adaptation of the attention projections [Hu et al. 2022].

mod file;
mod settings;

use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor, Var};

pub use file::{LoraInfo, LoraStyle};
pub use settings::lora_files;

use crate::error::{Result, argument};
use crate::layers::Linear;
use crate::noise::NoiseStream;

/// A linear layer that an adapter may extend.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AdapterTarget {
    /// The layer's dotted name in the UNet.
    pub name: String,
    /// Its inputs.
    pub inputs: usize,
    /// Its outputs.
    pub outputs: usize,
    /// Stored as a 1x1 convolution in the model's files.
    pub pointwise_conv: bool,
}

impl AdapterTarget {
    /// Whether the layer is one of to_q, to_k, to_v, to_out.0: those that are
    /// trained.
    pub fn is_attention(&self) -> bool {
        ["to_q", "to_k", "to_v", "to_out.0"]
            .iter()
            .any(|end| self.name.ends_with(&format!(".{end}")))
    }
}

/// The product up * down * scale that is added to one layer's weight.
#[derive(Debug, Clone)]
pub struct Adapter {
    down: Linear,
    up: Linear,
    /// As given: the scale times the rank may round to another number.
    alpha: f64,
    scale: f64,
    pointwise_conv: bool,
}

impl Adapter {
    /// From down [rank, inputs], up [outputs, rank] and alpha; the scale is
    /// alpha / rank.
    pub fn new(down: Tensor, up: Tensor, alpha: f64) -> Result<Self> {
        let (rank, up_rank) = (down.dims2()?.0, up.dims2()?.1);
        if rank == 0 || rank != up_rank || !alpha.is_finite() {
            return argument(format!(
                "adapter: down {:?}, up {:?}, alpha {alpha}: the ranks must agree and alpha be finite",
                down.dims(),
                up.dims()
            ));
        }
        Ok(Self {
            down: Linear::from_tensors(down, None)?,
            up: Linear::from_tensors(up, None)?,
            alpha,
            scale: alpha / rank as f64,
            pointwise_conv: false,
        })
    }

    /// The same for a layer that is a 1x1 convolution in the model's files: there [rank, inputs, 1, 1] and
    /// [outputs, rank, 1, 1] are the shapes of its matrices.
    pub fn of_pointwise_conv(self) -> Self {
        Self {
            pointwise_conv: true,
            ..self
        }
    }

    /// One of its matrices in f32 and in the shape that files have.
    fn as_stored(&self, matrix: &Tensor) -> Result<Tensor> {
        let (rows, columns) = matrix.dims2()?;
        let matrix = matrix.detach().to_dtype(DType::F32)?;
        Ok(match self.pointwise_conv {
            true => matrix.reshape((rows, columns, 1, 1))?,
            false => matrix,
        })
    }

    /// Rank of the product.
    pub fn rank(&self) -> usize {
        self.down.outputs()
    }

    /// alpha, the scale times the rank.
    pub fn alpha(&self) -> f64 {
        self.alpha
    }

    /// Matrix [rank, inputs], "A" of PEFT and "down" of kohya.
    pub fn down(&self) -> &Tensor {
        self.down.weight()
    }

    /// Matrix [outputs, rank], "B" of PEFT and "up" of kohya.
    pub fn up(&self) -> &Tensor {
        self.up.weight()
    }

    /// What the adapter adds to the layer's result, in x's precision.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let dtype = x.dtype();
        let matching = |layer: &Linear| -> Result<Linear> {
            if layer.weight().dtype() == dtype {
                return Ok(layer.clone());
            }
            Linear::from_tensors(layer.weight().to_dtype(dtype)?, None)
        };
        let y = matching(&self.up)?.forward(&matching(&self.down)?.forward(x)?)?;
        Ok(if self.scale == 1.0 {
            y
        } else {
            (y * self.scale)?
        })
    }
}

/// Adapters by the name of the layer that each extends.
#[derive(Debug, Clone, Default)]
pub struct Lora {
    adapters: BTreeMap<String, Adapter>,
    variables: BTreeMap<String, Var>,
}

impl Lora {
    /// Trainable adapters for the attention projections among `targets`:
    /// `down` uniform in +-1/sqrt(inputs) as PEFT draws it, `up` zero, so
    /// that training starts from the unchanged model. Masters are f32.
    pub fn new(
        targets: &[AdapterTarget],
        rank: usize,
        alpha: f64,
        seed: u64,
        device: &Device,
    ) -> Result<Self> {
        if rank == 0 {
            return argument("lora: rank must be at least 1");
        }
        let mut lora = Self::default();
        for target in targets.iter().filter(|t| t.is_attention()) {
            let mut stream = NoiseStream::named(seed, &target.name);
            let bound = 1.0 / (target.inputs as f64).sqrt();
            let values: Vec<f32> = (0..rank * target.inputs)
                .map(|_| ((2.0 * stream.uniform() - 1.0) * bound) as f32)
                .collect();
            let down = Tensor::from_vec(values, (rank, target.inputs), device)?;
            let up = Tensor::zeros((target.outputs, rank), DType::F32, device)?;
            lora.insert(&target.name, &down, &up, alpha)?;
        }
        Ok(lora)
    }

    /// Adds a trainable adapter that starts from the given matrices.
    pub fn insert(&mut self, name: &str, down: &Tensor, up: &Tensor, alpha: f64) -> Result<()> {
        let (down, up) = (Var::from_tensor(down)?, Var::from_tensor(up)?);
        let adapter = Adapter::new(down.as_tensor().clone(), up.as_tensor().clone(), alpha)?;
        self.adapters.insert(name.to_owned(), adapter);
        self.variables.insert(format!("{name}.lora_A"), down);
        self.variables.insert(format!("{name}.lora_B"), up);
        Ok(())
    }

    /// Adds a frozen adapter.
    pub fn insert_frozen(&mut self, name: &str, adapter: Adapter) {
        self.adapters.insert(name.to_owned(), adapter);
    }

    /// The same adapters as constants in the precision `dtype` of a model: predictions with them keep nothing for a backward
    /// pass.
    pub fn constant(&self, dtype: DType) -> Result<Self> {
        let constant = |layer: &Linear| {
            let weight = layer.weight().detach().to_dtype(dtype)?;
            Linear::from_tensors(weight, None)
        };
        let mut lora = Self::default();
        for (name, adapter) in &self.adapters {
            let (down, up) = (constant(&adapter.down)?, constant(&adapter.up)?);
            let constant = Adapter {
                down,
                up,
                ..*adapter
            };
            lora.insert_frozen(name, constant);
        }
        Ok(lora)
    }

    /// The adapter of the layer `name`.
    pub fn adapter(&self, name: &str) -> Option<&Adapter> {
        self.adapters.get(name)
    }

    /// All adapters.
    pub fn adapters(&self) -> &BTreeMap<String, Adapter> {
        &self.adapters
    }

    /// Trainable matrices, `<layer>.lora_A` and `<layer>.lora_B`; empty after
    /// loading from a file.
    pub fn variables(&self) -> &BTreeMap<String, Var> {
        &self.variables
    }
}
