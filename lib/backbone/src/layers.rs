//! Convolutions of feature maps, with batch normalisation folded into weights and biases.
use crate::product::product;

/// Numbers by row, column and channel.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Numbers of each cell.
    pub channels: usize,
    /// All numbers, cell after cell.
    pub values: Vec<f32>,
}

impl Map {
    /// The mean of each channel over the map.
    pub fn mean(&self) -> Vec<f32> {
        let mut sums = vec![0f64; self.channels];
        for cell in self.values.chunks_exact(self.channels) {
            sums.iter_mut()
                .zip(cell)
                .for_each(|(s, v)| *s += f64::from(*v));
        }
        let count = (self.width * self.height) as f64;
        sums.iter().map(|s| (s / count) as f32).collect()
    }
}

/// Weights of a layer and the bias of each of its outputs.
pub(crate) struct Layer {
    /// Dense: `inputs x outputs`; by channel: `taps x channels`.
    pub weight: Vec<f32>,
    pub bias: Vec<f32>,
}

impl Layer {
    /// What the products are added to, for so many cells: the bias, or 0 where a [`Scale`] brings its own.
    fn start(&self, cells: usize, tuned: Option<&Scale>) -> Vec<f32> {
        match tuned {
            None => self.bias.repeat(cells),
            Some(_) => vec![0.0; cells * self.bias.len()],
        }
    }
}

/// Changes a layer: its outputs without their bias are multiplied by `factor`, then `bias` is added.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Scale {
    pub factor: Vec<f32>,
    pub bias: Vec<f32>,
}

impl Scale {
    fn apply(tuned: Option<&Self>, values: &mut [f32]) {
        let Some(Self { factor, bias }) = tuned else {
            return;
        };
        for cell in values.chunks_exact_mut(bias.len()) {
            for ((v, s), b) in cell.iter_mut().zip(factor).zip(bias) {
                *v = *v * s + b;
            }
        }
    }
}

/// The side of a square kernel and its step.
#[derive(Clone, Copy)]
pub(crate) struct Window {
    pub side: usize,
    pub step: usize,
}

impl Window {
    /// For a line of `n` inputs: the number of outputs, and how many taps of the first output lie before the line. The
    /// padding that all outputs need is split in half; the odd tap comes after the line.
    fn line(self, n: usize) -> (usize, usize) {
        let outputs = n.div_ceil(self.step);
        let outside = ((outputs - 1) * self.step + self.side).saturating_sub(n);
        (outputs, outside / 2)
    }

    /// Calls `tap(output cell, kernel tap, input cell)` for all taps that lie inside of the map.
    fn taps(self, map: &Map, mut tap: impl FnMut(usize, usize, usize)) -> [usize; 2] {
        let (columns, left) = self.line(map.width);
        let (rows, above) = self.line(map.height);
        for (y, x) in (0..rows).flat_map(|y| (0..columns).map(move |x| (y, x))) {
            for k in 0..self.side * self.side {
                let row = (y * self.step + k / self.side).wrapping_sub(above);
                let column = (x * self.step + k % self.side).wrapping_sub(left);
                if row < map.height && column < map.width {
                    tap(y * columns + x, k, row * map.width + column);
                }
            }
        }
        [columns, rows]
    }
}

/// A map times a matrix, cell by cell.
pub(crate) fn pointwise(map: &Map, layer: &Layer, tuned: Option<&Scale>) -> Map {
    let (cells, inputs, outputs) = (map.width * map.height, map.channels, layer.bias.len());
    let mut values = layer.start(cells, tuned);
    let size = (cells, outputs, inputs);
    product(
        size,
        (&map.values, inputs, 1),
        (&layer.weight, outputs, 1),
        &mut values,
        true,
    );
    Scale::apply(tuned, &mut values);
    Map {
        channels: outputs,
        values,
        ..*map
    }
}

/// A convolution of all channels with all.
pub(crate) fn dense(map: &Map, layer: &Layer, window: Window) -> Map {
    let taps = window.side * window.side;
    let (columns, rows) = (window.line(map.width).0, window.line(map.height).0);
    let n = map.channels;
    let mut patches = vec![0.0; columns * rows * taps * n];
    window.taps(map, |to, k, from| {
        let at = (to * taps + k) * n;
        patches[at..at + n].copy_from_slice(&map.values[from * n..(from + 1) * n]);
    });
    let patches = Map {
        width: columns,
        height: rows,
        channels: taps * n,
        values: patches,
    };
    pointwise(&patches, layer, None)
}

/// A convolution of each channel with itself.
pub(crate) fn by_channel(map: &Map, layer: &Layer, window: Window, tuned: Option<&Scale>) -> Map {
    let n = map.channels;
    let (columns, rows) = (window.line(map.width).0, window.line(map.height).0);
    let mut values = layer.start(columns * rows, tuned);
    window.taps(map, |to, k, from| {
        let input = &map.values[from * n..(from + 1) * n];
        let weight = &layer.weight[k * n..(k + 1) * n];
        let output = &mut values[to * n..(to + 1) * n];
        for ((o, x), w) in output.iter_mut().zip(input).zip(weight) {
            *o += x * w;
        }
    });
    Scale::apply(tuned, &mut values);
    Map {
        width: columns,
        height: rows,
        channels: n,
        values,
    }
}

/// Between 0 and 6.
pub(crate) fn clamped(mut map: Map) -> Map {
    map.values.iter_mut().for_each(|v| *v = v.clamp(0.0, 6.0));
    map
}
