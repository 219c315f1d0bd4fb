//! Activation checkpointing: a segment's inner values are dropped after the
//! forward pass and computed again during the backward pass
//! [Chen et al. 2016].

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use candle_core::backend::BackendStorage;
use candle_core::backprop::GradStore;
use candle_core::{
    CpuStorage, CudaStorage, CustomOp3, Layout, MetalStorage, Shape, Tensor, TensorId, Var,
};

use crate::backward::{apply3, gradients};
use crate::error::{Result, argument};

/// Collects the gradients that recomputed segments find for `variables`.
///
/// A backward pass through recomputed segments leaves the gradients of the
/// segments' parameters here; [`Recompute::drain_into`] adds them to the
/// gradients of the rest of the graph.
#[derive(Debug, Clone)]
pub struct Recompute {
    variables: Arc<Vec<Var>>,
    gradients: Arc<Mutex<HashMap<TensorId, Tensor>>>,
}

type Segment = dyn Fn(&Tensor, &Tensor) -> candle_core::Result<Tensor> + Send + Sync;

impl Recompute {
    /// For the parameters that are being trained.
    pub fn new(variables: Vec<Var>) -> Self {
        Self {
            variables: Arc::new(variables),
            gradients: Default::default(),
        }
    }

    /// For the same parameters, without gradients yet: what another backward pass collects apart.
    pub fn another(&self) -> Self {
        Self {
            variables: self.variables.clone(),
            gradients: Default::default(),
        }
    }

    /// Runs `segment` on (x, context) without keeping its inner values. One
    /// of the two inputs has to be part of a graph, or the gradients of the
    /// segment's own parameters are never asked for.
    pub fn run(
        &self,
        x: &Tensor,
        context: &Tensor,
        segment: impl Fn(&Tensor, &Tensor) -> Result<Tensor> + Send + Sync + 'static,
    ) -> Result<Tensor> {
        let segment: Arc<Segment> =
            Arc::new(move |x, context| segment(x, context).map_err(candle_core::Error::wrap));
        let y = segment(&x.detach(), &context.detach())?
            .detach()
            .contiguous()?;
        let op = RecomputeOp {
            segment,
            owner: self.clone(),
        };
        Ok(apply3(x, context, &y, op)?)
    }

    /// Adds the collected gradients to `gradients` and forgets them.
    pub fn drain_into(&self, gradients: &mut GradStore) -> Result<()> {
        let mut collected = self
            .gradients
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        for variable in self.variables.iter() {
            if let Some(found) = collected.remove(&variable.id()) {
                add_gradient(gradients, variable, found)?;
            }
        }
        Ok(())
    }

    fn collect(&self, gradients: &mut GradStore) -> candle_core::Result<()> {
        let mut collected = self
            .gradients
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        for variable in self.variables.iter() {
            if let Some(found) = gradients.remove(variable) {
                let sum = match collected.remove(&variable.id()) {
                    Some(other) => (other + found)?,
                    None => found,
                };
                collected.insert(variable.id(), sum);
            }
        }
        Ok(())
    }
}

/// Adds `found` to the gradient of `variable`.
pub(crate) fn add_gradient(gradients: &mut GradStore, variable: &Var, found: Tensor) -> Result<()> {
    let sum = match gradients.remove(variable) {
        Some(other) => (other + found)?,
        None => found,
    };
    gradients.insert(variable, sum);
    Ok(())
}

/// Passes the third argument, the segment's value, through; replays the
/// segment when its gradient arrives.
struct RecomputeOp {
    segment: Arc<Segment>,
    owner: Recompute,
}

impl CustomOp3 for RecomputeOp {
    fn name(&self) -> &'static str {
        "recompute"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        y: &CpuStorage,
        layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        Ok((y.try_clone(layout)?, layout.shape().clone()))
    }

    fn cuda_fwd(
        &self,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
        y: &CudaStorage,
        layout: &Layout,
    ) -> candle_core::Result<(CudaStorage, Shape)> {
        Ok((y.try_clone(layout)?, layout.shape().clone()))
    }

    fn metal_fwd(
        &self,
        _: &MetalStorage,
        _: &Layout,
        _: &MetalStorage,
        _: &Layout,
        y: &MetalStorage,
        layout: &Layout,
    ) -> candle_core::Result<(MetalStorage, Shape)> {
        Ok((y.try_clone(layout)?, layout.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        context: &Tensor,
        _: &Tensor,
        _: &Tensor,
        g: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let leaf = |t: &Tensor| -> candle_core::Result<Tensor> {
            if t.track_op() {
                Ok(Var::from_tensor(&t.detach())?.as_tensor().clone())
            } else {
                Ok(t.clone())
            }
        };
        let (x_leaf, context_leaf) = (leaf(x)?, leaf(context)?);
        let y = (self.segment)(&x_leaf, &context_leaf)?;
        let mut found = gradients(&y, g)?;
        let (dx, dcontext) = (found.remove(&x_leaf), found.remove(&context_leaf));
        self.owner.collect(&mut found)?;
        Ok((
            dx.filter(|_| x.track_op()),
            dcontext.filter(|_| context.track_op()),
            None,
        ))
    }
}

/// The gradient at x of a loss whose gradient at segment(x) is `g`: computes the segment again.
pub(crate) fn gradient_through(
    segment: impl FnOnce(&Tensor) -> Result<Tensor>,
    x: Tensor,
    g: &Tensor,
) -> Result<Tensor> {
    let leaf = Var::from_tensor(&x)?;
    drop(x);
    let mut found = gradients(&segment(&leaf)?, g)?;
    match found.remove(&leaf) {
        Some(gradient) => Ok(gradient),
        None => argument("the segment's value does not depend on its input"),
    }
}
