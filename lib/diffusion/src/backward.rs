//! Gradients along the graph that candle keeps.
//!
//! candle's own backward pass adds every gradient to a tensor of zeros: three passes over the memory for every input of
//! every operation. Here operations are applied through [`apply1`], [`apply2`] and [`apply3`], which note what leads back
//! from the result, and [`gradients`] keeps the first gradient of a tensor as it is.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use candle_core::backend::BackendStorage;
use candle_core::backprop::GradStore;
use candle_core::{
    CpuStorage, CudaStorage, CustomOp1, CustomOp2, CustomOp3, Layout, MetalStorage, Result, Shape,
    Tensor, TensorId,
};

/// What leads from a result back to the inputs.
trait Step: Send + Sync {
    /// Each input, and the gradient that the result `y` passes to it.
    fn back(&self, y: &Tensor, g: &Tensor) -> Result<Vec<(&Tensor, Gradient)>>;
}

/// An operation with its inputs. candle's graph owns it.
struct Applied<O, const N: usize> {
    op: O,
    inputs: [Tensor; N],
}

/// What candle gets of it.
struct Held<O, const N: usize>(Arc<Applied<O, N>>);

/// The steps of all graphs that there are, by result. Those of a graph that is dropped are dropped with it.
static STEPS: Mutex<Option<Steps>> = Mutex::new(None);

#[derive(Default)]
struct Steps {
    by_result: HashMap<TensorId, Weak<dyn Step>>,
    /// How many lived when dropped ones were last forgotten.
    alive: usize,
}

/// Steps beyond twice those alive before dropped ones are forgotten.
const FORGET: usize = 1024;

fn with_steps<R>(f: impl FnOnce(&mut Steps) -> R) -> R {
    let mut steps = STEPS.lock().unwrap_or_else(PoisonError::into_inner);
    f(steps.get_or_insert_default())
}

fn note(y: &Tensor, step: Weak<dyn Step>) {
    with_steps(|steps| {
        if steps.by_result.len() > 2 * steps.alive + FORGET {
            steps.by_result.retain(|_, step| step.strong_count() > 0);
            steps.alive = steps.by_result.len();
        }
        steps.by_result.insert(y.id(), step);
    });
}

/// What there is for operations of one number of inputs.
macro_rules! operations {
    (
        $apply:ident, $custom:ident, $by:ident, $n:literal, $first:ident $first_layout:ident $(, $other:ident $layout:ident)*;
        $gradients:ty, $found:pat => $list:expr
    ) => {
        /// The result of an operation, from which [`gradients`] finds its way back.
        pub(crate) fn $apply<O>($first: &Tensor, $($other: &Tensor,)* op: O) -> Result<Tensor>
        where
            O: $custom + Send + Sync + 'static,
        {
            let inputs = [$first.clone() $(, $other.clone())*];
            if !inputs.iter().any(Tensor::track_op) {
                return $first.$by($($other,)* Arc::new(Box::new(op)));
            }
            let applied = Arc::new(Applied { op, inputs });
            let step = Arc::downgrade(&applied);
            let y = $first.$by($($other,)* Arc::new(Box::new(Held(applied))))?;
            note(&y, step);
            Ok(y)
        }

        impl<O: $custom + Send + Sync> Step for Applied<O, $n> {
            fn back(&self, y: &Tensor, g: &Tensor) -> Result<Vec<(&Tensor, Gradient)>> {
                let [$first $(, $other)*] = &self.inputs;
                let $found = self.op.bwd($first $(, $other)*, y, g)?;
                Ok(self.inputs.iter().zip($list).collect())
            }
        }

        impl<O: $custom + Send + Sync> $custom for Held<O, $n> {
            fn name(&self) -> &'static str {
                self.0.op.name()
            }

            fn cpu_fwd(
                &self, $first: &CpuStorage, $first_layout: &Layout, $($other: &CpuStorage, $layout: &Layout),*
            ) -> Result<(CpuStorage, Shape)> {
                self.0.op.cpu_fwd($first, $first_layout $(, $other, $layout)*)
            }

            fn cuda_fwd(
                &self, $first: &CudaStorage, $first_layout: &Layout, $($other: &CudaStorage, $layout: &Layout),*
            ) -> Result<(CudaStorage, Shape)> {
                self.0.op.cuda_fwd($first, $first_layout $(, $other, $layout)*)
            }

            fn metal_fwd(
                &self, $first: &MetalStorage, $first_layout: &Layout, $($other: &MetalStorage, $layout: &Layout),*
            ) -> Result<(MetalStorage, Shape)> {
                self.0.op.metal_fwd($first, $first_layout $(, $other, $layout)*)
            }

            fn bwd(&self, $first: &Tensor, $($other: &Tensor,)* y: &Tensor, g: &Tensor) -> Result<$gradients> {
                self.0.op.bwd($first, $($other,)* y, g)
            }
        }
    };
}

type Gradient = Option<Tensor>;
operations!(apply1, CustomOp1, apply_op1_arc, 1, a la; Gradient, da => [da]);
operations!(apply2, CustomOp2, apply_op2_arc, 2, a la, b lb; (Gradient, Gradient), (da, db) => [da, db]);
operations!(
    apply3, CustomOp3, apply_op3_arc, 3, a la, b lb, c lc;
    (Gradient, Gradient, Gradient), (da, db, dc) => [da, db, dc]
);

/// What leads back from each of the `results`; none if from one of them only candle knows it.
fn steps_of<'a>(results: impl Iterator<Item = &'a Tensor>) -> Option<Vec<Arc<dyn Step>>> {
    let step = |steps: &Steps, y: &Tensor| steps.by_result.get(&y.id()).and_then(Weak::upgrade);
    with_steps(|steps| results.map(|y| step(steps, y)).collect())
}

/// The gradients of all variables that `y` depends on, where that at `y` is `g`. candle's own backward pass finds them if one
/// of its own operations leads to `y`: what leads back from those only candle knows.
pub fn gradients(y: &Tensor, g: &Tensor) -> Result<GradStore> {
    let nodes: Vec<&Tensor> = y.sorted_nodes();
    let results = || nodes.iter().copied().filter(|node| !node.is_variable());
    let Some(steps) = steps_of(results()) else {
        let nothing = Tensor::zeros((), y.dtype(), y.device())?;
        return y.apply_op2(&nothing, GivenGradient(g.detach()))?.backward();
    };
    let mut found = GradStore::default();
    found.insert(y, g.detach());
    for (node, step) in results().zip(steps) {
        let Some(g) = found.remove(node) else {
            candle_core::bail!("no gradient reaches a result of shape {:?}", node.shape());
        };
        for (input, gradient) in step.back(node, &g)? {
            let Some(gradient) = gradient.filter(|_| input.track_op()) else {
                continue;
            };
            let sum = match found.remove(input) {
                Some(other) => (other + gradient)?,
                None => gradient,
            };
            found.insert(input, sum.detach());
        }
    }
    Ok(found)
}

/// Has no value of its own; says what the gradient at the first argument is, without the products that a weighted sum
/// would keep.
struct GivenGradient(Tensor);

impl CustomOp2 for GivenGradient {
    fn name(&self) -> &'static str {
        "given gradient"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        nothing: &CpuStorage,
        layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        Ok((nothing.try_clone(layout)?, layout.shape().clone()))
    }

    fn cuda_fwd(
        &self,
        _: &CudaStorage,
        _: &Layout,
        nothing: &CudaStorage,
        layout: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        Ok((nothing.try_clone(layout)?, layout.shape().clone()))
    }

    fn metal_fwd(
        &self,
        _: &MetalStorage,
        _: &Layout,
        nothing: &MetalStorage,
        layout: &Layout,
    ) -> Result<(MetalStorage, Shape)> {
        Ok((nothing.try_clone(layout)?, layout.shape().clone()))
    }

    fn bwd(&self, _: &Tensor, _: &Tensor, _: &Tensor, _: &Tensor) -> Result<(Gradient, Gradient)> {
        Ok((Some(self.0.clone()), None))
    }
}

/// Whether [`gradients`] finds its own way from `y`.
#[cfg(test)]
pub(crate) fn knows_the_way(y: &Tensor) -> bool {
    let nodes = y.sorted_nodes();
    steps_of(nodes.iter().copied().filter(|node| !node.is_variable())).is_some()
}

#[cfg(test)]
mod tests {
    use candle_core::Var;

    use super::*;
    use crate::differences::normal;
    use crate::layers::{Activation, Linear, activate, add};

    #[test]
    fn gradients_are_candles_bit_by_bit_and_steps_go_with_their_graph() {
        let [x, w] = [(1, [5, 4]), (2, [4, 4])]
            .map(|(i, shape)| Var::from_tensor(&normal(i, &shape)).expect("variable"));
        let layer = Linear::from_tensors(w.as_tensor().clone(), None).expect("layer");
        // x and the layer's result are used twice each, the weight too.
        let network = || {
            let h = layer.forward(&x).expect("layer");
            let h = add(&h, &activate(Activation::Silu, &h).expect("activation")).expect("sum");
            add(&layer.forward(&h).expect("layer"), &x).expect("sum")
        };
        let y = network();
        let g = normal(3, &[5, 4]);
        assert!(knows_the_way(&y));
        let found = gradients(&y, &g).expect("gradients");
        let zero = Tensor::zeros((), y.dtype(), y.device()).expect("zero");
        let all = y.apply_op2(&zero, GivenGradient(g.clone())).expect("loss");
        let candles = all.backward().expect("candle's");
        // An operation of candle's own leads the whole way to candle.
        let other = (&y * 1.0).expect("product");
        assert!(!knows_the_way(&other));
        let through_candle = gradients(&other, &g).expect("gradients");
        let values = |store: &GradStore, of: &Var| {
            let gradient = store.get(of).expect("a gradient");
            gradient
                .flatten_all()
                .and_then(|t| t.to_vec1::<f32>())
                .expect("numbers")
        };
        for variable in [&x, &w] {
            assert_eq!(values(&found, variable), values(&candles, variable));
            assert_eq!(values(&found, variable), values(&through_candle, variable));
        }
        let id = y.id();
        drop((y, all, other));
        let alive = with_steps(|steps| {
            steps
                .by_result
                .get(&id)
                .is_some_and(|step| step.strong_count() > 0)
        });
        assert!(!alive, "the step outlives its graph");
    }
}
