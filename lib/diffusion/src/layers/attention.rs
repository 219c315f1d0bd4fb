//! Scaled dot-product attention over heads [Vaswani et al. 2017].

#[cfg(feature = "cuda")]
use candle_core::CudaStorage;
use std::sync::OnceLock;

use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp3, D, DType, Device, Layout, Shape, Tensor};
use half::bf16;

use super::backend::has_kernels_anywhere;
use crate::backward::apply3;
#[cfg(feature = "cuda")]
use crate::cuda::{self, View};
use crate::error::{Result, argument};
use crate::kernels::attention::panels::{self, Softmax};
use crate::kernels::attention::{self, AttentionShape};
use crate::kernels::matmul::Engine;
use crate::kernels::tensor::{floats, from_floats, halves, read, store, with_halves};
use crate::kernels::tiles;

/// Which keys a query sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Causality {
    /// All.
    Full,
    /// Those at its own position and before.
    Causal,
}

/// softmax(q k^T / sqrt(head size)) v with the heads side by side.
///
/// Logits are held in f32 for every storage type: those of Stable Diffusion
/// 2.1 reach 3e5 before scaling, beyond the range of f16.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attention {
    /// Number of heads; divides the width.
    pub heads: usize,
    /// Mask.
    pub causality: Causality,
}

impl Attention {
    /// q [batch, queries, width], k and v [batch, keys, width] to
    /// [batch, queries, width].
    pub fn forward(&self, q: &Tensor, k: &Tensor, v: &Tensor) -> Result<Tensor> {
        let (q, k, v) = (q.contiguous()?, k.contiguous()?, v.contiguous()?);
        let shape = self.shape(q.shape(), k.shape(), v.shape())?;
        if has_kernels_anywhere(&q, &[]) {
            return Ok(apply3(&q, &k, &v, AttentionOp::new(*self))?);
        }
        self.forward_composed(&q, &k, &v, shape)
    }

    /// [`Attention::forward`] composed of candle's operations, for devices without kernels.
    pub(super) fn forward_composed(
        &self,
        q: &Tensor,
        k: &Tensor,
        v: &Tensor,
        shape: AttentionShape,
    ) -> Result<Tensor> {
        let split = |t: &Tensor| -> candle_core::Result<Tensor> {
            let (batch, length, width) = t.dims3()?;
            t.reshape((batch, length, self.heads, width / self.heads))?
                .transpose(1, 2)?
                .contiguous()
        };
        // bf16 has the range for unscaled logits; f16 products are taken in f32.
        let wide = if q.dtype() == DType::BF16 {
            DType::BF16
        } else {
            DType::F32
        };
        let scaled = (split(q)?.to_dtype(wide)? * shape.scale as f64)?;
        let logits = scaled
            .matmul(&split(k)?.to_dtype(wide)?.t()?)?
            .to_dtype(DType::F32)?;
        let logits = match self.causality {
            Causality::Full => logits,
            Causality::Causal => {
                logits.broadcast_add(&causal_mask(shape.queries, shape.keys, q.device())?)?
            }
        };
        // Without a gradient through the maximum: it cancels.
        let shifted = logits
            .broadcast_sub(&logits.detach().max_keepdim(D::Minus1)?)?
            .exp()?;
        let p = shifted
            .broadcast_div(&shifted.sum_keepdim(D::Minus1)?)?
            .to_dtype(q.dtype())?;
        let out = p.matmul(&split(v)?)?;
        Ok(out.transpose(1, 2)?.reshape(q.shape())?)
    }

    pub(super) fn shape(&self, q: &Shape, k: &Shape, v: &Shape) -> Result<AttentionShape> {
        let (batch, queries, width) = q.dims3()?;
        let (key_batch, keys, key_width) = k.dims3()?;
        if k != v
            || key_batch != batch
            || key_width != width
            || self.heads == 0
            || width % self.heads != 0
            || keys == 0
        {
            return argument(format!(
                "attention with {} heads: queries {q:?}, keys {k:?} and values {v:?} do not fit",
                self.heads
            ));
        }
        let head_dim = width / self.heads;
        let scale = (1.0 / (head_dim as f64).sqrt()) as f32;
        let causal = self.causality == Causality::Causal;
        Ok(AttentionShape {
            batch,
            heads: self.heads,
            queries,
            keys,
            head_dim,
            scale,
            causal,
        })
    }
}

/// 0 where a key is visible, -inf elsewhere.
fn causal_mask(queries: usize, keys: usize, device: &Device) -> Result<Tensor> {
    let values: Vec<f32> = (0..queries)
        .flat_map(|i| (0..keys).map(move |j| if j <= i { 0.0 } else { f32::NEG_INFINITY }))
        .collect();
    Ok(Tensor::from_vec(values, (queries, keys), device)?)
}

/// What multiplies numbers of `dtype` on the CPU.
fn engine(dtype: DType) -> Engine {
    match tiles::suit([dtype]) {
        true => Engine::Tiles,
        false => Engine::best(),
    }
}

struct AttentionOp {
    attention: Attention,
    /// Of the result, where the kernel for panels computed it.
    softmax: OnceLock<Softmax>,
}

impl AttentionOp {
    fn new(attention: Attention) -> Self {
        Self {
            attention,
            softmax: OnceLock::new(),
        }
    }

    fn shape(&self, q: &Shape, k: &Shape) -> candle_core::Result<AttentionShape> {
        self.attention
            .shape(q, k, k)
            .map_err(candle_core::Error::wrap)
    }
}

impl CustomOp3 for AttentionOp {
    fn name(&self) -> &'static str {
        "attention"
    }

    fn cpu_fwd(
        &self,
        q: &CpuStorage,
        lq: &Layout,
        k: &CpuStorage,
        lk: &Layout,
        v: &CpuStorage,
        lv: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let shape = self.shape(lq.shape(), lk.shape())?;
        if tiles::suit([q.dtype()]) && !shape.causal {
            let out = tiles::attention(shape, halves(q, lq)?, halves(k, lk)?, halves(v, lv)?);
            return Ok((CpuStorage::BF16(out), lq.shape().clone()));
        }
        let (engine, q_, k_, v_) = (
            engine(q.dtype()),
            floats(q, lq)?,
            floats(k, lk)?,
            floats(v, lv)?,
        );
        let out = if engine == Engine::Panels && panels::suit(shape) {
            let (out, softmax) = panels::attention(shape, &q_, &k_, &v_);
            self.softmax.get_or_init(|| softmax);
            out
        } else {
            attention::attention(engine, shape, &q_, &k_, &v_)
        };
        Ok((store(out, q.dtype()), lq.shape().clone()))
    }

    #[cfg(feature = "cuda")]
    fn cuda_fwd(
        &self,
        q: &CudaStorage,
        lq: &Layout,
        k: &CudaStorage,
        lk: &Layout,
        v: &CudaStorage,
        lv: &Layout,
    ) -> candle_core::Result<(CudaStorage, Shape)> {
        let shape = self.shape(lq.shape(), lk.shape())?;
        let (q, k, v) = (View::new(q, lq)?, View::new(k, lk)?, View::new(v, lv)?);
        let out = cuda::attention::attention(shape, q, k, v)?;
        Ok((out, lq.shape().clone()))
    }

    fn bwd(
        &self,
        q: &Tensor,
        k: &Tensor,
        v: &Tensor,
        y: &Tensor,
        g: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let shape = self.shape(q.shape(), k.shape())?;
        let g = g.contiguous()?;
        #[cfg(feature = "cuda")]
        if g.device().is_cuda() {
            let [q_, k_, v_, y_, g_] = [q, k, v, y, &g].map(View::of);
            let [dq, dk, dv] = cuda::attention::vjp(shape, [q_?, k_?, v_?, y_?, g_?])?;
            let wanted = |like: &Tensor, d| like.track_op().then(|| cuda::tensor(d, like.shape()));
            return Ok((wanted(q, dq), wanted(k, dk), wanted(v, dv)));
        }
        // One head has one job: products that share its rows among threads are faster there.
        if tiles::suit([q.dtype()]) && !shape.causal && shape.batch * shape.heads > 1 {
            let (dq, dk, dv) = with_halves([q, k, v, y, &g], |[q, k, v, y, g]| {
                tiles::attention_vjp(shape, [q, k, v], y, g)
            })?;
            let wanted = |like: &Tensor, values: Vec<bf16>| {
                like.track_op()
                    .then(|| Tensor::from_vec(values, like.shape(), like.device()))
                    .transpose()
            };
            return Ok((wanted(q, dq)?, wanted(k, dk)?, wanted(v, dv)?));
        }
        let (q_, k_, v_) = (read(q)?, read(k)?, read(v)?);
        let (engine, y, g) = (engine(q.dtype()), read(y)?, read(&g)?);
        let (dq, dk, dv) = match self.softmax.get() {
            Some(softmax) if panels::suit_vjp(shape) => {
                panels::attention_vjp(shape, softmax, [&q_, &k_, &v_], &y, &g)
            }
            _ => attention::attention_vjp(engine, shape, &q_, &k_, &v_, &y, &g),
        };
        let wanted = |like: &Tensor, values: Vec<f32>| {
            like.track_op()
                .then(|| from_floats(values, like.shape(), like.dtype()))
                .transpose()
        };
        Ok((wanted(q, dq)?, wanted(k, dk)?, wanted(v, dv)?))
    }
}
