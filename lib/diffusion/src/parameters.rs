//! The parameters of a model while it is being built: read from weights that
//! are checked against the configuration, or drawn at random for training.

use std::cell::RefCell;
use std::collections::{BTreeMap, HashSet};
use std::rc::Rc;

use candle_core::{DType, Device, Tensor, Var};

use crate::error::{Error, Result};
use crate::noise::NoiseStream;
use crate::weights::Weights;

/// How a parameter starts when there are no weights to read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// All equal.
    Constant(f64),
    /// Uniform in +-1/sqrt(fan in), PyTorch's default for linear and conv layers.
    FanIn(usize),
    /// Normal with this standard deviation.
    Normal(f64),
}

/// Where parameters come from.
enum Source {
    Weights(Weights),
    Tensors(BTreeMap<String, Tensor>),
    Random(u64),
}

struct Shared {
    source: Source,
    dtype: DType,
    device: Device,
    trainable: bool,
    seen: RefCell<HashSet<String>>,
    problems: RefCell<Vec<String>>,
    variables: RefCell<BTreeMap<String, Var>>,
    /// Optional prefix that published files have and newer exports lack.
    optional_prefix: Option<&'static str>,
}

/// A view of a model's parameters below a dotted prefix.
#[derive(Clone)]
pub struct Parameters {
    shared: Rc<Shared>,
    prefix: String,
}

impl Parameters {
    /// Parameters read from `weights`, frozen unless `trainable`.
    pub fn from_weights(weights: Weights, dtype: DType, device: &Device, trainable: bool) -> Self {
        Self::new(Source::Weights(weights), dtype, device, trainable)
    }

    /// Trainable f32 parameters drawn from `seed`, each from its own stream
    /// keyed by its name, so that the order of construction does not matter.
    pub fn random(seed: u64, device: &Device) -> Self {
        Self::new(Source::Random(seed), DType::F32, device, true)
    }

    /// Parameters that are in memory already, used as they are: variables
    /// stay variables.
    pub fn from_tensors(tensors: BTreeMap<String, Tensor>) -> Self {
        Self::new(Source::Tensors(tensors), DType::F32, &Device::Cpu, false)
    }

    fn new(source: Source, dtype: DType, device: &Device, trainable: bool) -> Self {
        let shared = Shared {
            source,
            dtype,
            device: device.clone(),
            trainable,
            seen: Default::default(),
            problems: Default::default(),
            variables: Default::default(),
            optional_prefix: None,
        };
        Self {
            shared: Rc::new(shared),
            prefix: String::new(),
        }
    }

    /// Names may lack `prefix` (with its dot) in the weights. Call it first,
    /// before any view is made.
    pub fn with_optional_prefix(mut self, prefix: &'static str) -> Self {
        if let Some(shared) = Rc::get_mut(&mut self.shared) {
            shared.optional_prefix = Some(prefix);
        }
        self
    }

    /// The view below `name`.
    pub fn sub(&self, name: impl std::fmt::Display) -> Self {
        let prefix = if self.prefix.is_empty() {
            name.to_string()
        } else {
            format!("{}.{name}", self.prefix)
        };
        Self {
            shared: self.shared.clone(),
            prefix,
        }
    }

    /// The dotted prefix of this view.
    pub fn path(&self) -> &str {
        &self.prefix
    }

    /// The device that tensors live on.
    pub fn device(&self) -> &Device {
        &self.shared.device
    }

    /// The type that tensors are converted to.
    pub fn dtype(&self) -> DType {
        self.shared.dtype
    }

    /// Whether the weights hold `name` below this prefix (always, if random).
    pub fn contains(&self, name: &str) -> bool {
        match &self.shared.source {
            Source::Weights(weights) => weights.contains(&self.stored_name(weights, name)),
            Source::Tensors(tensors) => tensors.contains_key(&self.full_name(name)),
            Source::Random(_) => true,
        }
    }

    fn full_name(&self, name: &str) -> String {
        if self.prefix.is_empty() {
            name.to_owned()
        } else {
            format!("{}.{name}", self.prefix)
        }
    }

    fn stored_name(&self, weights: &Weights, name: &str) -> String {
        let full = self.full_name(name);
        match self
            .shared
            .optional_prefix
            .and_then(|prefix| full.strip_prefix(prefix))
        {
            Some(short) if !weights.contains(&full) => short.to_owned(),
            _ => full,
        }
    }

    /// The parameter `name` of `shape`. A missing or mis-shaped tensor is
    /// noted and reported by [`Parameters::finish`], all of them together.
    pub fn get(&self, name: &str, shape: &[usize], init: Init) -> Result<Tensor> {
        let full = self.full_name(name);
        let shared = &self.shared;
        let tensor = match &shared.source {
            Source::Tensors(tensors) => match tensors.get(&full) {
                Some(tensor) if tensor.dims() == shape => tensor.clone(),
                found => {
                    let found = found.map(|t| t.dims().to_vec());
                    return crate::error::argument(format!(
                        "parameter {full:?}: wanted {shape:?}, found {found:?}"
                    ));
                }
            },
            Source::Random(seed) => draw(*seed, &full, shape, init, &shared.device)?,
            Source::Weights(weights) => {
                let stored = self.stored_name(weights, name);
                shared.seen.borrow_mut().insert(stored.clone());
                let problem = match weights.shape(&stored) {
                    None => Some(format!("tensor {stored:?} of shape {shape:?} is missing")),
                    Some(found) if !same_shape(found, shape) => Some(format!(
                        "tensor {stored:?} has shape {found:?}, the configuration asks for {shape:?}"
                    )),
                    Some(_) => None,
                };
                if let Some(problem) = problem {
                    shared.problems.borrow_mut().push(problem);
                    // One element stands in until `finish` refuses the model.
                    return Ok(Tensor::zeros(1, shared.dtype, &shared.device)?.broadcast_as(shape)?);
                }
                match weights.tensor(&stored, shared.dtype, &shared.device)? {
                    Some(tensor) => tensor.reshape(shape)?,
                    None => {
                        return crate::error::argument(format!(
                            "tensor {stored:?} vanished while reading"
                        ));
                    }
                }
            }
        };
        if !shared.trainable {
            return Ok(tensor);
        }
        let variable = Var::from_tensor(&tensor)?;
        let tensor = variable.as_tensor().clone();
        shared.variables.borrow_mut().insert(full, variable);
        Ok(tensor)
    }

    /// Ends the construction: an error names every missing, mis-shaped and
    /// superfluous tensor; otherwise the trainable parameters by name.
    /// Names for which `ignored` is true may be left over.
    pub fn finish(self, ignored: impl Fn(&str) -> bool) -> Result<BTreeMap<String, Var>> {
        let shared = &self.shared;
        let mut problems = shared.problems.take();
        if let Source::Weights(weights) = &shared.source {
            let seen = shared.seen.borrow();
            problems.extend(
                weights
                    .names()
                    .filter(|name| !seen.contains(*name) && !ignored(name))
                    .map(|name| {
                        format!("tensor {name:?} belongs to no layer of this configuration")
                    }),
            );
            if !problems.is_empty() {
                return Err(Error::Weights {
                    path: weights.path().to_owned(),
                    problems,
                });
            }
        }
        Ok(shared.variables.take())
    }
}

/// Equal, or a linear weight stored as a 1x1 convolution and the reverse
/// (older autoencoder exports).
fn same_shape(found: &[usize], wanted: &[usize]) -> bool {
    fn trimmed(shape: &[usize]) -> &[usize] {
        match shape {
            [matrix @ .., 1, 1] if matrix.len() == 2 => matrix,
            _ => shape,
        }
    }
    trimmed(found) == trimmed(wanted)
}

fn draw(seed: u64, name: &str, shape: &[usize], init: Init, device: &Device) -> Result<Tensor> {
    let count: usize = shape.iter().product();
    let mut stream = NoiseStream::named(seed, name);
    let values: Vec<f32> = match init {
        Init::Constant(value) => vec![value as f32; count],
        Init::FanIn(fan_in) => {
            let bound = 1.0 / (fan_in.max(1) as f64).sqrt();
            (0..count)
                .map(|_| ((2.0 * stream.uniform() - 1.0) * bound) as f32)
                .collect()
        }
        Init::Normal(deviation) => (0..count)
            .map(|_| stream.normal() * deviation as f32)
            .collect(),
    };
    Ok(Tensor::from_vec(values, shape, device)?)
}
