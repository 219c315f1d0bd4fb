//! Gradients against central differences. The crate's own tests and those beside this folder share it.

use candle_core::{DType, Device, Tensor, Var};
use dipir_diffusion::noise::NoiseStream;

pub type Outcome = Result<(), Box<dyn std::error::Error>>;

/// Half the distance of the two values of a difference.
const STEP: f32 = 1e-2;

/// Standard normal values.
pub fn normal(stream: u64, shape: &[usize]) -> Tensor {
    NoiseStream::new(11, stream)
        .normal_tensor(shape, DType::F32, &Device::Cpu)
        .expect("tensor")
}

/// The gradient at a layer's result `y` from which all gradients here start.
pub fn probe(y: &Tensor) -> Tensor {
    normal(99, y.dims())
}

/// Compares `gradient`, of sum(layer * probe) at `variable`, with central differences at up to 12 elements. `layer`
/// depends on `variable`. Differences of n values of size 1 carry rounding of 1e-7 sqrt(n) / STEP, of which four are
/// allowed, and with third derivatives of order 1 a truncation of 1e-4 / 6: 5e-3 of the largest gradient is far above.
pub fn assert_gradient(
    name: &str,
    variable: &Var,
    gradient: &Tensor,
    layer: &dyn Fn() -> dipir_diffusion::Result<Tensor>,
) -> Outcome {
    assert_eq!(gradient.dims(), variable.dims(), "{name}: shapes");
    let shape = variable.dims().to_vec();
    let gradient = gradient.flatten_all()?.to_vec1::<f32>()?;
    let values = variable.flatten_all()?.to_vec1::<f32>()?;
    let largest = gradient.iter().fold(0f32, |m, g| m.max(g.abs()));
    assert!(
        largest.is_finite(),
        "{name}: a gradient that is not a number"
    );
    let set = |values: Vec<f32>| variable.set(&Tensor::from_vec(values, &shape[..], &Device::Cpu)?);
    for element in (0..values.len()).step_by(values.len().div_ceil(12)) {
        let at = |shift: f32| -> Result<(f64, usize), Box<dyn std::error::Error>> {
            let mut moved = values.clone();
            moved[element] += shift;
            set(moved)?;
            let y = layer()?.to_dtype(DType::F64)?;
            let sum = (&y * probe(&y).to_dtype(DType::F64)?)?.sum_all()?;
            Ok((sum.to_scalar::<f64>()?, y.elem_count()))
        };
        let ((above, count), (below, _)) = (at(STEP)?, at(-STEP)?);
        let numerical = (above - below) / f64::from(2.0 * STEP);
        let error = (numerical - f64::from(gradient[element])).abs();
        let rounding = 4.0 * 1e-7 * (count as f64).sqrt() / f64::from(STEP);
        assert!(
            error < 5e-3 * f64::from(largest) + rounding,
            "{name}, element {element}: difference {numerical}, gradient {}",
            gradient[element]
        );
    }
    Ok(set(values)?)
}

/// Compares the gradients of sum(layer * probe) at all `variables`, by name, as [`assert_gradient`] does.
pub fn assert_gradients_of(
    name: &str,
    variables: &[(String, Var)],
    layer: &dyn Fn() -> dipir_diffusion::Result<Tensor>,
) -> Outcome {
    let y = layer()?;
    let gradients = (&y * probe(&y))?.sum_all()?.backward()?;
    for (what, variable) in variables {
        let name = format!("{name}: {what}");
        let gradient = gradients.get(variable);
        let gradient = gradient.ok_or_else(|| format!("{name} got no gradient"))?;
        assert_gradient(&name, variable, gradient, layer)?;
    }
    Ok(())
}
