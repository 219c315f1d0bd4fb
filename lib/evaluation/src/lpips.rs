//! The learned perceptual distance LPIPS with AlexNet features [Zhang et al., "The Unreasonable Effectiveness of
//! Deep Features as a Perceptual Metric", CVPR 2018], with weights that the user supplies.
use std::collections::HashMap;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use dipir_imaging::raster::DisplayImage;

/// What can be wrong with the weights or the pictures.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LpipsError {
    /// The file cannot be used.
    #[error(
        "cannot use {path}: {message}; it must hold the tensors of lpips.LPIPS(net=\"alex\").state_dict()"
    )]
    Weights {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        message: String,
    },
    /// The pictures cannot be compared.
    #[error(
        "LPIPS compares pictures of one size and sides of at least {SMALLEST} pixels, these are {a:?} and {b:?}"
    )]
    Pictures {
        /// Width and height of one.
        a: [usize; 2],
        /// Of the other.
        b: [usize; 2],
    },
    /// The networks cannot be evaluated.
    #[error("cannot compute LPIPS: {0}")]
    Network(#[from] candle_core::Error),
}

/// A convolution of AlexNet, and whether the maximum of 3 x 3 pixels is taken before it.
struct Layer {
    name: &'static str,
    /// [out, in, side, side]
    shape: [usize; 4],
    stride: usize,
    padding: usize,
    pooled: bool,
}

const LAYERS: [Layer; 5] = [
    Layer {
        name: "net.slice1.0",
        shape: [64, 3, 11, 11],
        stride: 4,
        padding: 2,
        pooled: false,
    },
    Layer {
        name: "net.slice2.3",
        shape: [192, 64, 5, 5],
        stride: 1,
        padding: 2,
        pooled: true,
    },
    Layer {
        name: "net.slice3.6",
        shape: [384, 192, 3, 3],
        stride: 1,
        padding: 1,
        pooled: true,
    },
    Layer {
        name: "net.slice4.8",
        shape: [256, 384, 3, 3],
        stride: 1,
        padding: 1,
        pooled: false,
    },
    Layer {
        name: "net.slice5.10",
        shape: [256, 256, 3, 3],
        stride: 1,
        padding: 1,
        pooled: false,
    },
];

/// Means and spreads of the colours that AlexNet was trained on, of pictures in [-1, 1].
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Smallest side of a picture: the second pooling needs three pixels to take the maximum of.
pub const SMALLEST: usize = 31;

/// The networks.
pub struct Lpips {
    /// Weights [out, in, side, side] and biases [1, out, 1, 1] of each layer.
    convolutions: Vec<(Tensor, Tensor)>,
    /// Weights of the channels of each layer, [1, out, 1, 1].
    linear: Vec<Tensor>,
}

impl Lpips {
    /// Reads a safetensors file with the tensors of `lpips.LPIPS(net="alex").state_dict()`.
    pub fn load(path: &Path) -> Result<Self, LpipsError> {
        let fail = |message: String| LpipsError::Weights {
            path: path.to_owned(),
            message,
        };
        let tensors: HashMap<String, Tensor> =
            candle_core::safetensors::load(path, &Device::Cpu).map_err(|e| fail(e.to_string()))?;
        let tensor = |name: String, shape: &[usize]| -> Result<Tensor, LpipsError> {
            // The package keeps the layers' weights under two names, and files may have either.
            let other = name.replacen("lin", "lins.", 1);
            let found = tensors
                .get(&name)
                .or_else(|| tensors.get(&other))
                .ok_or_else(|| fail(format!("the tensor {name:?} is missing")))?;
            if found.dims() != shape {
                let message = format!(
                    "the tensor {name:?} is {:?}, expected {shape:?}",
                    found.dims()
                );
                return Err(fail(message));
            }
            Ok(found.to_dtype(DType::F32)?)
        };
        let (mut convolutions, mut linear) = (vec![], vec![]);
        for (k, layer) in LAYERS.iter().enumerate() {
            let out = layer.shape[0];
            let weight = tensor(format!("{}.weight", layer.name), &layer.shape)?;
            let bias = tensor(format!("{}.bias", layer.name), &[out])?;
            convolutions.push((weight, bias.reshape((1, out, 1, 1))?));
            linear.push(tensor(format!("lin{k}.model.1.weight"), &[1, out, 1, 1])?);
        }
        Ok(Self {
            convolutions,
            linear,
        })
    }

    /// The distance of two pictures of the same size, 0 if they are equal; sides of at least [`SMALLEST`] pixels.
    pub fn distance(&self, a: &DisplayImage, b: &DisplayImage) -> Result<f64, LpipsError> {
        let [size, other] = [a, b].map(|i| [i.0.width(), i.0.height()]);
        if size != other || size[0].min(size[1]) < SMALLEST {
            return Err(LpipsError::Pictures { a: size, b: other });
        }
        let mut x = Tensor::cat(&[&input(a)?, &input(b)?], 0)?;
        let mut sum = 0.0;
        for ((layer, (weight, bias)), linear) in
            LAYERS.iter().zip(&self.convolutions).zip(&self.linear)
        {
            if layer.pooled {
                x = x.max_pool2d_with_stride(3, 2)?;
            }
            x = x
                .conv2d(weight, layer.padding, layer.stride, 1, 1)?
                .broadcast_add(bias)?
                .relu()?;
            let length = (x.sqr()?.sum_keepdim(1)?.sqrt()? + 1e-10)?;
            let unit = x.broadcast_div(&length)?;
            let difference = (unit.narrow(0, 0, 1)? - unit.narrow(0, 1, 1)?)?.sqr()?;
            let weighted = difference.broadcast_mul(linear)?.sum(1)?;
            sum += f64::from(weighted.mean_all()?.to_scalar::<f32>()?);
        }
        Ok(sum)
    }
}

/// [1, 3, height, width] as AlexNet was trained.
fn input(image: &DisplayImage) -> candle_core::Result<Tensor> {
    let pixels = image.0.pixels();
    let values: Vec<f32> = (0..3)
        .flat_map(|c| {
            pixels
                .iter()
                .map(move |p| (2.0 * p[c] - 1.0 - SHIFT[c]) / SCALE[c])
        })
        .collect();
    Tensor::from_vec(
        values,
        (1, 3, image.0.height(), image.0.width()),
        &Device::Cpu,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_imaging::raster::Raster;
    use glam::Vec3;

    fn network() -> Lpips {
        let ones = |shape: &[usize], value: f32| {
            Tensor::full(value, shape, &Device::Cpu).expect("a tensor")
        };
        Lpips {
            convolutions: LAYERS
                .iter()
                .map(|l| (ones(&l.shape, 0.01), ones(&[1, l.shape[0], 1, 1], 0.1)))
                .collect(),
            linear: LAYERS
                .iter()
                .map(|l| ones(&[1, l.shape[0], 1, 1], 1.0))
                .collect(),
        }
    }

    fn flat(width: usize, height: usize) -> DisplayImage {
        DisplayImage(Raster::from_pixels(
            width,
            height,
            vec![Vec3::splat(0.4); width * height],
        ))
    }

    #[test]
    fn the_smallest_picture_has_features_and_smaller_ones_are_refused() {
        let network = network();
        let small = flat(SMALLEST, SMALLEST);
        assert_eq!(network.distance(&small, &small).expect("a distance"), 0.0);
        for (a, b) in [(30, 40), (40, 30)] {
            let error = network
                .distance(&flat(a, b), &flat(a, b))
                .expect_err("too small");
            assert!(
                error.to_string().contains(&format!("[{a}, {b}]")),
                "{error}"
            );
        }
        assert!(network.distance(&flat(40, 40), &flat(41, 40)).is_err());
    }

    #[test]
    fn a_file_without_the_tensors_says_which() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("alex.safetensors");
        let error = Lpips::load(&path).err().expect("no file").to_string();
        assert!(error.contains("alex.safetensors"), "{error}");
        let tensor = Tensor::zeros((64, 3, 7, 7), DType::F32, &Device::Cpu).expect("a tensor");
        let wrong = HashMap::from([("net.slice1.0.weight".to_owned(), tensor)]);
        candle_core::safetensors::save(&wrong, &path).expect("written");
        let error = Lpips::load(&path).err().expect("wrong shape").to_string();
        assert!(
            error.contains("[64, 3, 7, 7], expected [64, 3, 11, 11]"),
            "{error}"
        );
        candle_core::safetensors::save(&HashMap::<String, Tensor>::new(), &path).expect("written");
        let error = Lpips::load(&path).err().expect("nothing in it").to_string();
        assert!(
            error.contains("\"net.slice1.0.weight\" is missing"),
            "{error}"
        );
    }
}
