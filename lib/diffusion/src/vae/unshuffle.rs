//! An exact autoencoder for small pixel-space models: blocks of pixels
//! become channels and back.

use candle_core::Tensor;

use crate::error::{Result, argument};

/// [batch, c, h f, w f] to [batch, c f f, h, w], channel c f f + row f + column.
pub fn pixel_unshuffle(x: &Tensor, factor: usize) -> Result<Tensor> {
    let (batch, channels, height, width) = x.dims4()?;
    if factor == 0 || height % factor != 0 || width % factor != 0 {
        return argument(format!(
            "an image of {width}x{height} does not divide into blocks of {factor}x{factor}"
        ));
    }
    let (h, w) = (height / factor, width / factor);
    let blocks = x
        .reshape(&[batch, channels, h, factor, w, factor][..])?
        .permute([0, 1, 3, 5, 2, 4].as_slice())?;
    Ok(blocks
        .contiguous()?
        .reshape((batch, channels * factor * factor, h, w))?)
}

/// The inverse of [`pixel_unshuffle`].
pub fn pixel_shuffle(x: &Tensor, factor: usize) -> Result<Tensor> {
    let (batch, channels, h, w) = x.dims4()?;
    if factor == 0 || channels % (factor * factor) != 0 {
        return argument(format!(
            "{channels} channels do not divide into blocks of {factor}x{factor}"
        ));
    }
    let c = channels / (factor * factor);
    let blocks = x
        .reshape(&[batch, c, factor, factor, h, w][..])?
        .permute([0, 1, 4, 2, 5, 3].as_slice())?;
    Ok(blocks
        .contiguous()?
        .reshape((batch, c, h * factor, w * factor))?)
}
