//! What asks the UNet, while it is trained, for the light that it sees.

use std::collections::BTreeMap;

use candle_core::{Device, Tensor, Var};
use dipir_diffusion::layers::Linear;
use dipir_diffusion::parameters::Parameters;

use crate::error::Result;
use crate::words::LightWords;

/// Names the light that is seen from what the UNet's middle block makes of a picture, whatever is said. Only
/// training has it.
#[derive(Debug)]
pub(crate) struct NamingHead {
    hidden: Linear,
    out: Linear,
    variables: BTreeMap<String, Var>,
}

impl NamingHead {
    const HIDDEN: usize = 96;
    /// Cosine and sine of the azimuth, and the elevation in radians from .75 on.
    const OUTPUTS: usize = 3;

    /// From `inputs` numbers.
    pub(crate) fn new(inputs: usize, seed: u64) -> Result<Self> {
        let parameters = Parameters::random(seed, &Device::Cpu);
        let p = &parameters;
        Ok(Self {
            hidden: Linear::new(&p.sub("hidden"), inputs, Self::HIDDEN)?,
            out: Linear::new(&p.sub("out"), Self::HIDDEN, Self::OUTPUTS)?,
            variables: parameters.finish(|_| false)?,
        })
    }

    pub(crate) fn variables(&self) -> &BTreeMap<String, Var> {
        &self.variables
    }

    /// Mean squared error for middles [rows, channels, h, w] over rows that have a sun; 0 where none has.
    pub(crate) fn loss(&self, middle: &Tensor, lights: &[LightWords]) -> Result<Tensor> {
        let h = self.hidden.forward(&middle.flatten_from(1)?)?.silu()?;
        let told = self.out.forward(&h)?;
        let wanted: Vec<f32> = lights
            .iter()
            .flat_map(|l| [l.azimuth.cos(), l.azimuth.sin(), l.elevation - 0.75])
            .collect();
        let wanted = Tensor::from_vec(wanted, told.shape(), &Device::Cpu)?;
        let sunny: Vec<f32> = lights.iter().map(|l| f32::from(!l.is_overcast())).collect();
        let count = sunny.iter().sum::<f32>().max(1.0);
        let error = (told - wanted)?.sqr()?.sum(1)?;
        let error = (error * Tensor::new(sunny.as_slice(), &Device::Cpu)?)?.sum_all()?;
        Ok((error / f64::from(count))?)
    }
}
