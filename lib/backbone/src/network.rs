//! EfficientNet-Lite0 [Tan & Le 2019; Lite variant by Google 2020] up to block 14.
use std::sync::OnceLock;

use dipir_imaging::raster::Raster;
use glam::Vec3;
use half::f16;
use safetensors::{Dtype, SafeTensors};

use crate::layers::{Layer, Map, Scale, Window, by_channel, clamped, dense, pointwise};
use crate::tuned::{TUNED_FROM, Tuned};

/// Channels of the two maps: after block 10 and after block 14.
pub const CHANNELS: [usize; 2] = [112, 192];
/// Blocks after which maps are kept.
const KEPT: [usize; 2] = [10, 14];
/// Side and step of each block's kernel.
const BLOCKS: [[usize; 2]; 15] = [
    [3, 1],
    [3, 2],
    [3, 1],
    [5, 2],
    [5, 1],
    [3, 2],
    [3, 1],
    [3, 1],
    [5, 1],
    [5, 1],
    [5, 1],
    [5, 2],
    [5, 1],
    [5, 1],
    [5, 1],
];

/// Why weights are refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the weights of the backbone are not usable: {0}")]
pub struct BackboneError(pub(crate) String);

/// Expansion, convolution by channel, projection.
struct Block {
    expand: Option<Layer>,
    depthwise: Layer,
    project: Layer,
    window: Window,
}

/// The network.
pub struct Backbone {
    stem: Layer,
    blocks: Vec<Block>,
}

impl Backbone {
    /// The network that is part of the program, read once.
    ///
    /// # Panics
    /// Never: the tests read the same bytes.
    pub fn embedded() -> &'static Self {
        static ONCE: OnceLock<Backbone> = OnceLock::new();
        ONCE.get_or_init(|| {
            Self::from_bytes(include_bytes!("../weights/lite0.safetensors"))
                .expect("the embedded weights are those of the tests")
        })
    }

    /// The network of a safetensors file's bytes; `weights/make.py` says what is in it.
    ///
    /// # Errors
    /// If tensors are missing or do not fit together.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, BackboneError> {
        let file = SafeTensors::deserialize(bytes).map_err(|e| BackboneError(e.to_string()))?;
        let stem = layer(&file, "stem", 27)?;
        let mut channels = stem.bias.len();
        let mut blocks = Vec::new();
        for (n, [side, step]) in BLOCKS.into_iter().enumerate() {
            let expand = match n {
                0 => None,
                _ => Some(layer(&file, &format!("block.{n}.expand"), channels)?),
            };
            let wide = expand.as_ref().map_or(channels, |e| e.bias.len());
            let depthwise = layer(&file, &format!("block.{n}.depthwise"), side * side)?;
            if depthwise.bias.len() != wide {
                let found = depthwise.bias.len();
                return Err(BackboneError(format!(
                    "`block.{n}.depthwise` has {found} channels, not {wide}"
                )));
            }
            let project = layer(&file, &format!("block.{n}.project"), wide)?;
            channels = project.bias.len();
            let window = Window { side, step };
            blocks.push(Block {
                expand,
                depthwise,
                project,
                window,
            });
        }
        for (kept, wanted) in KEPT.into_iter().zip(CHANNELS) {
            let found = blocks[kept].project.bias.len();
            if found != wanted {
                return Err(BackboneError(format!(
                    "block {kept} has {found} channels, not {wanted}"
                )));
            }
        }
        Ok(Self { stem, blocks })
    }

    /// The two maps of a picture in display values, `[0, 1]`. Pixels that are no numbers count as black.
    pub fn maps(&self, picture: &Raster<Vec3>) -> [Map; 2] {
        self.maps_behind(self.front(picture), None)
    }

    /// The map before block [`TUNED_FROM`]: what the maps of all tunings have in common.
    pub fn front(&self, picture: &Raster<Vec3>) -> Map {
        let value =
            |v: f32| (if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) } * 255.0 - 127.0) / 128.0;
        let values = picture
            .pixels()
            .iter()
            .flat_map(|p| p.to_array().map(value));
        let input = Map {
            width: picture.width(),
            height: picture.height(),
            channels: 3,
            values: values.collect(),
        };
        let mut x = clamped(dense(&input, &self.stem, Window { side: 3, step: 2 }));
        for block in &self.blocks[..TUNED_FROM] {
            x = block.apply(x, None);
        }
        x
    }

    /// The two maps behind a [`front`](Self::front), as the network is or tuned.
    pub fn maps_behind(&self, front: Map, tuned: Option<&Tuned>) -> [Map; 2] {
        let mut x = front;
        let mut kept = Vec::with_capacity(2);
        for (n, block) in self.blocks.iter().enumerate().skip(TUNED_FROM) {
            x = block.apply(x, tuned.map(|t| &t.blocks[n - TUNED_FROM]));
            if KEPT.contains(&n) {
                kept.push(x.clone());
            }
        }
        let deep = kept.pop().unwrap_or_else(|| x.clone());
        [kept.pop().unwrap_or(x), deep]
    }

    /// Outputs of the three layers of each block from [`TUNED_FROM`] on.
    pub(crate) fn tuned_sizes(&self) -> Vec<[usize; 3]> {
        let of = |b: &Block| {
            let wide = b.depthwise.bias.len();
            [wide, wide, b.project.bias.len()]
        };
        self.blocks[TUNED_FROM..].iter().map(of).collect()
    }
}

impl Block {
    fn apply(&self, x: Map, tuned: Option<&[Scale; 3]>) -> Map {
        let scale = |k: usize| tuned.map(|t| &t[k]);
        let expand = |e| clamped(pointwise(&x, e, scale(0)));
        let wide = self.expand.as_ref().map(expand);
        let wide = wide.as_ref().unwrap_or(&x);
        let deep = clamped(by_channel(wide, &self.depthwise, self.window, scale(1)));
        let mut y = pointwise(&deep, &self.project, scale(2));
        if self.window.step == 1 && y.channels == x.channels {
            y.values
                .iter_mut()
                .zip(&x.values)
                .for_each(|(y, x)| *y += x);
        }
        y
    }
}

/// `NAME.weight` of `inputs` rows in half precision and `NAME.bias` in single.
fn layer(file: &SafeTensors<'_>, name: &str, inputs: usize) -> Result<Layer, BackboneError> {
    let tensor = |part: &str, kind: Dtype| {
        let name = format!("{name}.{part}");
        let tensor = file
            .tensor(&name)
            .map_err(|_| BackboneError(format!("`{name}` is missing")))?;
        match tensor.dtype() == kind {
            true => Ok(tensor),
            false => Err(BackboneError(format!(
                "`{name}` is {:?}, not {kind:?}",
                tensor.dtype()
            ))),
        }
    };
    let (weight, bias) = (tensor("weight", Dtype::F16)?, tensor("bias", Dtype::F32)?);
    let outputs = bias.data().len() / 4;
    if outputs == 0 || weight.shape() != [inputs, outputs] {
        let found = weight.shape();
        return Err(BackboneError(format!(
            "`{name}.weight` is {found:?}, not {inputs} x {outputs}"
        )));
    }
    let half = |b: &[u8]| f16::from_le_bytes([b[0], b[1]]).to_f32();
    let single = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    let all = Layer {
        weight: weight.data().chunks_exact(2).map(half).collect(),
        bias: bias.data().chunks_exact(4).map(single).collect(),
    };
    match all.weight.iter().chain(&all.bias).all(|v| v.is_finite()) {
        true => Ok(all),
        false => Err(BackboneError(format!(
            "`{name}` holds values that are not finite"
        ))),
    }
}
