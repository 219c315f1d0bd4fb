//! What joins layers: sums, concatenation, images to tokens and back. On the CPU these are operations of the crate's own, so
//! that gradients pass through them in one pass over the memory; elsewhere they are candle's.

use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp1, CustomOp2, Layout, Shape, Tensor};

use super::backend::has_kernels;
use crate::backward::{apply1, apply2};
use crate::error::Result;
use crate::kernels::joining;
use crate::kernels::tensor::{floats, from_floats, read, store};

type Pair = (Option<Tensor>, Option<Tensor>);

/// x + y, of one shape.
pub(crate) fn add(x: &Tensor, y: &Tensor) -> Result<Tensor> {
    if has_kernels(x) && x.dims() == y.dims() {
        return Ok(apply2(&x.contiguous()?, &y.contiguous()?, Add)?);
    }
    Ok((x + y)?)
}

/// x [batch, channels, h, w] with `shift` [batch, channels] added to every pixel.
pub(crate) fn add_to_channels(x: &Tensor, shift: &Tensor) -> Result<Tensor> {
    let (batch, channels) = shift.dims2()?;
    if has_kernels(x) && x.dims()[..2] == [batch, channels] {
        return Ok(apply2(
            &x.contiguous()?,
            &shift.contiguous()?,
            AddToChannels,
        )?);
    }
    Ok(x.broadcast_add(&shift.reshape((batch, channels, 1, 1))?)?)
}

/// The channels of x [batch, channels, h, w], then those of y.
pub(crate) fn concatenate_channels(x: &Tensor, y: &Tensor) -> Result<Tensor> {
    let ((batch, _, height, width), other) = (x.dims4()?, y.dims4()?);
    if has_kernels(x) && (batch, height, width) == (other.0, other.2, other.3) {
        return Ok(apply2(&x.contiguous()?, &y.contiguous()?, Concatenate)?);
    }
    Ok(Tensor::cat(&[x, y], 1)?)
}

/// x [batch, channels, h, w] as tokens [batch, h w, channels].
pub(crate) fn tokens_of(x: &Tensor) -> Result<Tensor> {
    if has_kernels(x) {
        return Ok(apply1(&x.contiguous()?, Tokens)?);
    }
    let (batch, channels, height, width) = x.dims4()?;
    let pixels = x.reshape((batch, channels, height * width))?;
    Ok(pixels.transpose(1, 2)?.contiguous()?)
}

/// x [batch, channels, h, w] plus the image of `tokens` [batch, h w, channels].
pub(crate) fn add_tokens(x: &Tensor, tokens: &Tensor) -> Result<Tensor> {
    let (batch, channels, height, width) = x.dims4()?;
    if has_kernels(x) && tokens.dims() == [batch, height * width, channels] {
        return Ok(apply2(&x.contiguous()?, &tokens.contiguous()?, AddTokens)?);
    }
    let image = tokens.transpose(1, 2)?.contiguous()?.reshape(x.shape())?;
    Ok((x + image)?)
}

/// Channels and pixels of an image [batch, channels, h, w].
fn sizes(image: &Shape) -> candle_core::Result<(usize, usize)> {
    let (_, channels, height, width) = image.dims4()?;
    Ok((channels, height * width))
}

struct Add;

impl CustomOp2 for Add {
    fn name(&self) -> &'static str {
        "add"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        lx: &Layout,
        y: &CpuStorage,
        ly: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let z = joining::add(&floats(x, lx)?, &floats(y, ly)?);
        Ok((store(z, x.dtype()), lx.shape().clone()))
    }

    fn bwd(&self, _: &Tensor, _: &Tensor, _: &Tensor, g: &Tensor) -> candle_core::Result<Pair> {
        Ok((Some(g.clone()), Some(g.clone())))
    }
}

struct AddToChannels;

impl CustomOp2 for AddToChannels {
    fn name(&self) -> &'static str {
        "add to channels"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        lx: &Layout,
        shift: &CpuStorage,
        ls: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (_, pixels) = sizes(lx.shape())?;
        let y = joining::add_to_rows(&floats(x, lx)?, &floats(shift, ls)?, pixels);
        Ok((store(y, x.dtype()), lx.shape().clone()))
    }

    fn bwd(&self, x: &Tensor, shift: &Tensor, _: &Tensor, g: &Tensor) -> candle_core::Result<Pair> {
        let sums = || {
            let (_, pixels) = sizes(x.shape())?;
            let sums = joining::row_sums(&read(&g.contiguous()?)?, pixels);
            from_floats(sums, shift.shape(), shift.dtype())
        };
        Ok((Some(g.clone()), shift.track_op().then(sums).transpose()?))
    }
}

struct Concatenate;

impl CustomOp2 for Concatenate {
    fn name(&self) -> &'static str {
        "concatenate channels"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        lx: &Layout,
        y: &CpuStorage,
        ly: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (batch, first, height, width) = lx.shape().dims4()?;
        let (_, second, _, _) = ly.shape().dims4()?;
        let (x_, y_) = (floats(x, lx)?, floats(y, ly)?);
        let mut z = Vec::with_capacity(x_.len() + y_.len());
        for item in 0..batch {
            for (part, channels) in [(&x_, first), (&y_, second)] {
                let size = channels * height * width;
                z.extend_from_slice(&part[item * size..][..size]);
            }
        }
        let shape = Shape::from((batch, first + second, height, width));
        Ok((store(z, x.dtype()), shape))
    }

    fn bwd(&self, x: &Tensor, y: &Tensor, _: &Tensor, g: &Tensor) -> candle_core::Result<Pair> {
        let (first, second) = (x.dim(1)?, y.dim(1)?);
        let part = |like: &Tensor, start, count| {
            let part = || g.narrow(1, start, count)?.contiguous();
            like.track_op().then(part).transpose()
        };
        Ok((part(x, 0, first)?, part(y, first, second)?))
    }
}

struct Tokens;

impl CustomOp1 for Tokens {
    fn name(&self) -> &'static str {
        "tokens"
    }

    fn cpu_fwd(&self, x: &CpuStorage, lx: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let (channels, pixels) = sizes(lx.shape())?;
        let y = joining::transposed(&floats(x, lx)?, (channels, pixels), None);
        let shape = Shape::from((lx.dims()[0], pixels, channels));
        Ok((store(y, x.dtype()), shape))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, g: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let (channels, pixels) = sizes(x.shape())?;
        let dx = joining::transposed(&read(&g.contiguous()?)?, (pixels, channels), None);
        Ok(Some(from_floats(dx, x.shape(), x.dtype())?))
    }
}

struct AddTokens;

impl CustomOp2 for AddTokens {
    fn name(&self) -> &'static str {
        "add tokens"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        lx: &Layout,
        tokens: &CpuStorage,
        lt: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (channels, pixels) = sizes(lx.shape())?;
        let x_ = floats(x, lx)?;
        let y = joining::transposed(&floats(tokens, lt)?, (pixels, channels), Some(&x_));
        Ok((store(y, x.dtype()), lx.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        tokens: &Tensor,
        _: &Tensor,
        g: &Tensor,
    ) -> candle_core::Result<Pair> {
        let (channels, pixels) = sizes(x.shape())?;
        let turned = || {
            let values = joining::transposed(&read(&g.contiguous()?)?, (channels, pixels), None);
            from_floats(values, tokens.shape(), tokens.dtype())
        };
        Ok((Some(g.clone()), tokens.track_op().then(turned).transpose()?))
    }
}
