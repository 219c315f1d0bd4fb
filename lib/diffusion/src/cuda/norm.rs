//! Layer and group normalisation. Statistics are merged from chunks of a row: a sample's group has up to millions of values,
//! and one block of threads would take them all.

use candle_core::{CudaStorage, DType, Result};

use super::{Argument, View, alike, empty, launch, whole};

/// Rows of `n` values that are normalised apart.
#[derive(Clone, Copy)]
pub(crate) struct NormShape {
    pub rows: usize,
    pub n: usize,
    /// Rows, one after the other, that have channels of their own.
    pub groups: usize,
    /// Values, one after the other, that share a channel.
    pub pixels: usize,
    pub eps: f32,
    pub silu: bool,
}

/// Fewest values of a chunk, and the most chunks of a row.
const CHUNK: usize = 4096;
const CHUNKS: usize = 64;
/// Values that a thread takes at once where they are of one channel, or each of one of its own.
const PACK: usize = 8;

impl NormShape {
    fn chunk(&self) -> usize {
        self.n.div_ceil(CHUNKS).next_multiple_of(PACK).max(CHUNK)
    }

    fn chunks(&self) -> usize {
        self.n.div_ceil(self.chunk())
    }

    fn arguments(&self) -> Result<[Argument; 7]> {
        let of = Argument::try_from;
        Ok([
            of(self.n)?,
            of(self.chunk())?,
            of(self.groups)?,
            of(self.n / self.pixels.max(1))?,
            of(self.pixels)?,
            of(usize::from(self.silu))?,
            self.eps.into(),
        ])
    }

    fn launch(&self, name: &str, views: &[View], more: &[Argument]) -> Result<()> {
        let mut arguments: Vec<Argument> = views.iter().map(|&v| v.into()).collect();
        arguments.extend(more);
        let packs = self.n.is_multiple_of(PACK)
            && (self.pixels == 1 || self.pixels.is_multiple_of(PACK))
            && views.iter().all(|v| v.is_aligned());
        let pack = if packs { PACK } else { 1 };
        let threads = (self.n / pack).next_multiple_of(32).clamp(32, 256) as u32;
        let (name, grid) = (format!("{name}_{pack}"), (self.rows, self.chunks(), 1));
        launch(
            views[0].device,
            (&name, views[0].dtype),
            grid,
            threads,
            &arguments,
        )
    }

    /// Mean and sum of squares of every chunk.
    fn statistics(&self, x: View) -> Result<CudaStorage> {
        let parts = self.pairs(x)?;
        let sizes = [self.n.try_into()?, self.chunk().try_into()?];
        self.launch("norm_sums", &[x, self.whole(&parts)?], &sizes)?;
        Ok(parts)
    }

    fn pairs(&self, x: View) -> Result<CudaStorage> {
        empty(x.device, DType::F32, 2 * self.rows * self.chunks())
    }

    fn whole<'a>(&self, pairs: &'a CudaStorage) -> Result<View<'a>> {
        whole(pairs, 2 * self.rows * self.chunks())
    }
}

pub(crate) fn norm(s: NormShape, x: View, gamma: View, beta: View) -> Result<CudaStorage> {
    let dtype = alike(&[x, gamma, beta])?;
    let parts = s.statistics(x)?;
    let y = empty(x.device, dtype, s.rows * s.n)?;
    let views = [x, gamma, beta, s.whole(&parts)?, whole(&y, s.rows * s.n)?];
    s.launch("norm_apply", &views, &s.arguments()?)?;
    Ok(y)
}

/// The gradient at x.
pub(crate) fn vjp_input(
    s: NormShape,
    x: View,
    gamma: View,
    beta: View,
    g: View,
) -> Result<CudaStorage> {
    let dtype = alike(&[x, gamma, beta, g])?;
    let (parts, sums) = (s.statistics(x)?, s.pairs(x)?);
    let (statistics, sums) = (s.whole(&parts)?, s.whole(&sums)?);
    let arguments = s.arguments()?;
    s.launch(
        "norm_vjp_sums",
        &[x, gamma, beta, statistics, g, sums],
        &arguments,
    )?;
    let dx = empty(x.device, dtype, s.rows * s.n)?;
    let to = whole(&dx, s.rows * s.n)?;
    s.launch(
        "norm_vjp",
        &[x, gamma, beta, statistics, g, sums, to],
        &arguments,
    )?;
    Ok(dx)
}
