//! Nearest-neighbour enlargement.
//!
//! candle's own `upsample_nearest2d` loses gradients when its input has a
//! second consumer; this one does not.

use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp1, Layout, Shape, Tensor};
use rayon::prelude::*;

use super::backend::has_kernels;
use crate::backward::apply1;
use crate::error::Result;
use crate::kernels::tensor::{floats, from_floats, read, store};

/// Enlarges [batch, channels, h, w] to `height` x `width` by repeating the
/// nearest source pixel, floor(i * h / height), as PyTorch's "nearest".
pub fn upsample_nearest(x: &Tensor, height: usize, width: usize) -> Result<Tensor> {
    let x = x.contiguous()?;
    if has_kernels(&x) {
        return Ok(apply1(&x, NearestOp { height, width })?);
    }
    upsample_composed(&x, height, width)
}

/// [`upsample_nearest`] composed of candle's operations, for devices without kernels.
pub(super) fn upsample_composed(x: &Tensor, height: usize, width: usize) -> Result<Tensor> {
    let (_, _, h, w) = x.dims4()?;
    let rows = Tensor::from_vec(sources(h, height), height, x.device())?;
    let columns = Tensor::from_vec(sources(w, width), width, x.device())?;
    Ok(x.index_select(&rows, 2)?.index_select(&columns, 3)?)
}

/// The source index of each of `to` targets among `from`.
fn sources(from: usize, to: usize) -> Vec<u32> {
    (0..to).map(|i| (i * from / to) as u32).collect()
}

struct NearestOp {
    height: usize,
    width: usize,
}

impl CustomOp1 for NearestOp {
    fn name(&self) -> &'static str {
        "upsample nearest"
    }

    fn cpu_fwd(&self, x: &CpuStorage, lx: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let (batch, channels, h, w) = lx.shape().dims4()?;
        let (rows, columns) = (sources(h, self.height), sources(w, self.width));
        let values = floats(x, lx)?;
        let mut y = vec![0f32; batch * channels * self.height * self.width];
        y.par_chunks_mut(self.height * self.width)
            .zip(values.par_chunks(h * w))
            .for_each(|(y, x)| {
                for (y, &row) in y.chunks_mut(self.width).zip(&rows) {
                    let x = &x[row as usize * w..][..w];
                    y.iter_mut()
                        .zip(&columns)
                        .for_each(|(y, &column)| *y = x[column as usize]);
                }
            });
        Ok((
            store(y, x.dtype()),
            Shape::from((batch, channels, self.height, self.width)),
        ))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, g: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let (_, _, h, w) = x.dims4()?;
        let (rows, columns) = (sources(h, self.height), sources(w, self.width));
        let g = g.contiguous()?;
        let values = read(&g)?;
        let mut dx = vec![0f32; x.elem_count()];
        dx.par_chunks_mut(h * w)
            .zip(values.par_chunks(self.height * self.width))
            .for_each(|(dx, g)| {
                for (g, &row) in g.chunks(self.width).zip(&rows) {
                    let dx = &mut dx[row as usize * w..][..w];
                    g.iter()
                        .zip(&columns)
                        .for_each(|(&g, &column)| dx[column as usize] += g);
                }
            });
        Ok(Some(from_floats(dx, x.shape(), x.dtype())?))
    }
}
