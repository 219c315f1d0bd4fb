//! The gradient of the weights: the adjoint of the transformed convolution.

use rayon::prelude::*;

use super::super::SharedMut;
use super::super::conv::ConvShape;
use super::super::lanes::{LANES, Lane, gather, scatter, with_lanes};
use super::super::simd::vectorized;
use super::product::{Left, ROWS, multiply};
use super::transform::{Output, to_weights};
use super::{BLOCK, PATCH, POINTS, Planes, TAPS, TILE, Tiles, lift, lift_chunks, lift_inputs};

/// Groups of outputs of a job.
const OUTPUTS: usize = 2;
/// Groups of inputs of a job.
const INPUTS: usize = 2;
/// Lanes of one point of a job's products: one more, as in [`Tiles::pitch`].
const PITCH: usize = OUTPUTS * LANES * INPUTS + 1;

vectorized! {
    fn lift_outputs(tiles: Tiles, first: usize, planes: (Planes, usize), strip: &mut [Lane], target: &mut [Lane]) {
        lift::<Output, TILE>(tiles, first, planes, strip, target);
    }
}

/// Gradient with respect to the weights, [outputs, inputs, 3, 3], for the gradient `g` of the result.
pub(in super::super) fn gradient_of_weights(shape: ConvShape, g: &[f32], x: &[f32]) -> Vec<f32> {
    let tiles = Tiles::new(shape);
    let x = Planes {
        data: x,
        channels: shape.inputs,
        height: shape.height,
        width: shape.width,
        pad: shape.pad_before,
    };
    let g = Planes {
        data: g,
        channels: shape.outputs,
        height: shape.out_height(),
        width: shape.out_width(),
        pad: 0,
    };
    let mut dw = vec![0.0; shape.outputs * shape.inputs * TAPS];
    let target = SharedMut::new(&mut dw);
    let lanes = POINTS * tiles.pitch();
    let chunks = tiles.all.div_ceil(tiles.chunk());
    let together = (BLOCK / (lanes * (x.groups() + g.groups()))).max(1);
    let (down, across) = (g.groups().div_ceil(OUTPUTS), x.groups().div_ceil(INPUTS));
    for first in (0..chunks).step_by(together) {
        let count = together.min(chunks - first);
        with_lanes(count * lanes * x.groups(), |inputs| {
            with_lanes(count * lanes * g.groups(), |outputs| {
                lift_chunks(tiles, first, x, lift_inputs, inputs);
                lift_chunks(tiles, first, g, lift_outputs, outputs);
                (0..down * across).into_par_iter().for_each(|job| {
                    let corner = (job / across * OUTPUTS, job % across * INPUTS);
                    block(tiles, corner, (outputs, inputs), first > 0, target);
                });
            });
        });
    }
    dw
}

/// Gradients of the weights of [`OUTPUTS`] groups of outputs and [`INPUTS`] groups of inputs.
fn block(
    tiles: Tiles,
    (output, input): (usize, usize),
    (outputs, inputs): (&[Lane], &[Lane]),
    keep: bool,
    target: SharedMut,
) {
    let shape = tiles.shape;
    let all = (shape.outputs.div_ceil(LANES), shape.inputs.div_ceil(LANES));
    let (down, across) = (OUTPUTS.min(all.0 - output), INPUTS.min(all.1 - input));
    with_lanes(POINTS * PITCH, |products| {
        let lanes = POINTS * tiles.pitch();
        let chunks = outputs
            .chunks_exact(all.0 * lanes)
            .zip(inputs.chunks_exact(all.1 * lanes));
        for (index, (outputs, inputs)) in chunks.enumerate() {
            let (outputs, inputs) = (&outputs[output * lanes..], &inputs[input * lanes..]);
            multiply_tiles((tiles, down, across), outputs, inputs, index > 0, products);
        }
        let real = (LANES * down).min(shape.outputs - output * LANES);
        for (o, i) in (0..real).flat_map(|o| (0..across).map(move |i| (o, i))) {
            let products = &mut products[o * INPUTS + i..];
            lower(shape, output * LANES + o, input + i, products, keep, target);
        }
    });
}

vectorized! {
    /// `products[point][output][input group] += sum over tiles of outputs[group][point][tile] inputs[group][point][tile]`.
    fn multiply_tiles(
        size: (Tiles, usize, usize), outputs: &[Lane], inputs: &[Lane], keep: bool, products: &mut [Lane],
    ) {
        let (tiles, down, across) = size;
        let (chunk, pitch) = (tiles.chunk(), tiles.pitch());
        assert!(outputs.len() >= down * POINTS * pitch && inputs.len() >= across * POINTS * pitch);
        assert!(products.len() == POINTS * PITCH && down <= OUTPUTS && across <= INPUTS);
        assert!(chunk % LANES == 0);
        for point in 0..POINTS {
            let right = (inputs[point * pitch..].as_ptr(), POINTS * pitch);
            for row in (0..down * LANES).step_by(ROWS) {
                let lanes = &outputs[(row / LANES * POINTS + point) * pitch..];
                let data = lanes.as_ptr().cast::<f32>().wrapping_add(row % LANES);
                let left = Left::<1, LANES> { data, jump: LANES * LANES };
                let out = (products[point * PITCH + row * INPUTS..].as_mut_ptr(), INPUTS, 1);
                // SAFETY: the lengths were checked above.
                unsafe {
                    match across {
                        1 => multiply::<1, 1, LANES>(chunk / LANES, left, right, out, keep),
                        _ => multiply::<2, 1, LANES>(chunk / LANES, left, right, out, keep),
                    }
                }
            }
        }
    }
}

vectorized! {
    /// Products of one output and one group of inputs, by points, to taps; added to those there if asked.
    fn lower(shape: ConvShape, output: usize, group: usize, products: &mut [Lane], keep: bool, target: SharedMut) {
        for j in 0..PATCH {
            let column = to_weights(std::array::from_fn(|i| products[(i * PATCH + j) * PITCH]));
            for i in 0..3 {
                products[(i * PATCH + j) * PITCH] = column[i];
            }
        }
        let input = group * LANES;
        let rows = LANES.min(shape.inputs - input);
        let start = (output * shape.inputs + input) * TAPS;
        let mut taps = [Lane::ZERO; TAPS];
        for i in 0..3 {
            let row = to_weights(std::array::from_fn(|j| products[(i * PATCH + j) * PITCH]));
            taps[3 * i..][..3].copy_from_slice(&row);
        }
        if keep {
            // SAFETY: each job owns the kernels of its outputs and inputs.
            let old = unsafe { std::slice::from_raw_parts(target.at(start), rows * TAPS) };
            let mut before = [Lane::ZERO; TAPS];
            gather(old, TAPS, rows, &mut before);
            for (tap, before) in taps.iter_mut().zip(before) {
                *tap = *tap + before;
            }
        }
        // SAFETY: as above.
        unsafe { scatter(&taps, rows, target.at(start), TAPS) };
    }
}
