//! Changing the number of samples of a line: a sparse matrix, and its transpose for gradients.
//!
//! Sample `i` covers `[i, i + 1]`, its centre is at `i + 1/2`.
use std::ops::Range;

/// How an output sample weighs the input samples around it. Weights are positive and sum to 1, so
/// constants stay and nothing rings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// The exact mean over the output sample's footprint: keeps the sum when minifying, repeats
    /// samples when magnifying by whole numbers.
    Area,
    /// A triangle of two input samples when magnifying (linear interpolation), widened to two output
    /// samples when minifying, so that nothing aliases.
    Tent,
}

/// For every output sample the input samples that it is made of, with their weights.
#[derive(Clone, Debug, PartialEq)]
pub struct Taps<W = f64> {
    /// Output `o` weighs `entries[starts[o]..starts[o + 1]]`.
    starts: Vec<usize>,
    /// Input sample and weight.
    entries: Vec<(usize, W)>,
}

impl Taps {
    /// `outputs` samples over the part of length `extent` from `start` on of a line of `inputs` samples.
    /// At the line's ends the weights are cut and normalised. Panics if anything is empty.
    pub fn new(start: f64, extent: f64, outputs: usize, inputs: usize, filter: Filter) -> Self {
        assert!(
            outputs > 0 && inputs > 0 && extent > 0.0,
            "cannot resample {extent} of {inputs} samples to {outputs}"
        );
        let step = extent / outputs as f64;
        let mut taps = Self {
            starts: vec![0],
            entries: Vec::new(),
        };
        for o in 0..outputs {
            let (first, mut weights) = match filter {
                Filter::Area => area(
                    start + o as f64 * step,
                    start + (o + 1) as f64 * step,
                    inputs,
                ),
                Filter::Tent => tent(start + (o as f64 + 0.5) * step - 0.5, step.max(1.0), inputs),
            };
            let total: f64 = weights.iter().sum();
            if total > 0.0 {
                weights.iter_mut().for_each(|w| *w /= total);
            } else {
                // Beyond the end: the nearest sample.
                weights = vec![1.0];
            }
            let kept = (first..).zip(weights).filter(|(_, w)| *w > 0.0);
            taps.entries.extend(kept);
            taps.starts.push(taps.entries.len());
        }
        taps
    }

    /// Weights in single precision; those that vanish are left out.
    pub fn single(&self) -> Taps<f32> {
        let mut single = Taps {
            starts: vec![0],
            entries: Vec::with_capacity(self.entries.len()),
        };
        for o in 0..self.outputs() {
            let narrow = self.of(o).iter().map(|&(i, w)| (i, w as f32));
            single.entries.extend(narrow.filter(|(_, w)| *w > 0.0));
            single.starts.push(single.entries.len());
        }
        single
    }
}

impl Taps<f32> {
    /// `kernel`, of an odd length, around each of `samples` of a line of `inputs` samples. Beyond its ends the line goes on as
    /// it ends.
    pub fn of_kernel(kernel: &[f32], samples: Range<usize>, inputs: usize) -> Self {
        let mut taps = Self {
            starts: vec![0],
            entries: Vec::with_capacity(kernel.len() * samples.len()),
        };
        for o in samples {
            let at = |k: usize| (o + k).saturating_sub(kernel.len() / 2).min(inputs - 1);
            let weights = kernel.iter().enumerate();
            taps.entries.extend(weights.map(|(k, &w)| (at(k), w)));
            taps.starts.push(taps.entries.len());
        }
        taps
    }
}

/// First sample and weights of a mean over `[low, high]`.
fn area(low: f64, high: f64, inputs: usize) -> (usize, Vec<f64>) {
    let first = (low.floor().max(0.0) as usize).min(inputs - 1);
    let end = (high.ceil().max(0.0) as usize).clamp(first + 1, inputs);
    let overlap = |i: usize| (high.min((i + 1) as f64) - low.max(i as f64)).max(0.0);
    (first, (first..end).map(overlap).collect())
}

/// First sample and weights of a triangle around sample number `centre`, which may lie between two.
fn tent(centre: f64, radius: f64, inputs: usize) -> (usize, Vec<f64>) {
    let last = inputs - 1;
    let first = ((centre - radius).ceil().max(0.0) as usize).min(last);
    let end = ((centre + radius).floor().max(0.0) as usize).clamp(first, last);
    let weight = |i: usize| (1.0 - (i as f64 - centre).abs() / radius).max(0.0);
    (first, (first..=end).map(weight).collect())
}

impl<W: Copy> Taps<W> {
    /// Output samples.
    pub fn outputs(&self) -> usize {
        self.starts.len() - 1
    }

    /// Input samples and weights of an output sample, from left to right.
    pub fn of(&self, output: usize) -> &[(usize, W)] {
        &self.entries[self.starts[output]..self.starts[output + 1]]
    }

    /// The same for a line that begins `by` samples earlier.
    pub fn shifted(mut self, by: usize) -> Self {
        self.entries.iter_mut().for_each(|(i, _)| *i += by);
        self
    }

    /// The transposed matrix: for each of `inputs` samples the outputs that it goes into.
    pub fn transposed(&self, inputs: usize) -> Self {
        let mut by_input = vec![Vec::new(); inputs];
        for o in 0..self.outputs() {
            for &(i, weight) in self.of(o) {
                by_input[i].push((o, weight));
            }
        }
        let mut starts = vec![0];
        let mut entries = Vec::with_capacity(self.entries.len());
        for taps in by_input {
            entries.extend(taps);
            starts.push(entries.len());
        }
        Self { starts, entries }
    }

    /// From the first input sample with a weight to the one after the last.
    pub fn touched(&self) -> std::ops::Range<usize> {
        let first = self.entries.iter().map(|e| e.0).min().unwrap_or(0);
        let end = self.entries.iter().map(|e| e.0 + 1).max().unwrap_or(0);
        first..end
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kernel_s_line_goes_on_as_it_ends() {
        let taps = Taps::of_kernel(&[0.25, 0.5, 0.25], 0..3, 3);
        assert_eq!(taps.of(0), [(0, 0.25), (0, 0.5), (1, 0.25)]);
        assert_eq!(taps.of(1), [(0, 0.25), (1, 0.5), (2, 0.25)]);
        assert_eq!(taps.of(2), [(1, 0.25), (2, 0.5), (2, 0.25)]);
        let part = Taps::of_kernel(&[1.0; 5], 4..5, 9);
        assert_eq!(part.touched(), 2..7);
    }

    const FILTERS: [Filter; 2] = [Filter::Area, Filter::Tent];

    #[test]
    fn weights_are_positive_and_sum_to_one_wherever_the_part_lies() {
        for filter in FILTERS {
            for (start, extent) in [(0.0, 7.0), (1.3, 4.4), (-2.0, 12.0), (6.5, 0.1), (9.0, 3.0)] {
                for outputs in [1, 2, 5, 40] {
                    let taps = Taps::new(start, extent, outputs, 7, filter);
                    assert_eq!(taps.outputs(), outputs);
                    for o in 0..outputs {
                        let sum: f64 = taps.of(o).iter().map(|t| t.1).sum();
                        // At most 7 rounded weights.
                        assert!((sum - 1.0).abs() < 7.0 * f64::EPSILON, "{filter:?} {sum}");
                        assert!(taps.of(o).iter().all(|t| t.0 < 7 && t.1 > 0.0));
                    }
                }
            }
        }
    }

    #[test]
    fn a_mean_weighs_by_overlap_and_a_tent_by_distance() {
        let mean = Taps::new(0.0, 3.0, 2, 3, Filter::Area);
        assert_eq!(mean.of(0), [(0, 1.0 / 1.5), (1, 0.5 / 1.5)]);
        // Output centre 1/4 of a sample left of the middle of sample 1.
        let tent = Taps::new(0.75, 1.0, 1, 3, Filter::Tent);
        assert_eq!(tent.of(0), [(0, 0.25), (1, 0.75)]);
    }

    #[test]
    fn transposing_twice_gives_the_matrix_back() {
        for filter in FILTERS {
            let taps = Taps::new(0.0, 9.0, 4, 9, filter);
            assert_eq!(taps.transposed(9).transposed(4), taps);
            assert_eq!(taps.touched(), 0..9);
            assert_eq!(taps.shifted(3).touched(), 3..12);
        }
    }
}
