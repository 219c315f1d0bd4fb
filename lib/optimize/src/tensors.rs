//! Parameters, gradients and moments as flat lists of numbers with names, so that optimiser, checkpoints and errors
//! handle them without knowing what they mean.

/// The kind of a parameter. All of a group share a learning rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    /// Logarithms of lobe radiance.
    Radiance,
    /// Directions of lobes.
    Direction,
    /// Logarithms of lobe widths.
    Sigma,
    /// Tone curves.
    Tone,
    /// Logarithm of the exposure.
    Exposure,
    /// Factors of materials.
    Material,
}

/// A named list of numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// As in `foreground.direction`.
    pub name: &'static str,
    /// The group that sets its learning rate.
    pub group: Group,
    /// The numbers.
    pub values: Vec<f64>,
}

/// Named lists of numbers in a fixed order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tensors(pub Vec<Tensor>);

impl Tensors {
    /// The tensor called `name`.
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.0.iter().find(|t| t.name == name)
    }

    /// The first tensor with a NaN or an infinity.
    pub fn first_not_finite(&self) -> Option<&'static str> {
        let bad = |t: &&Tensor| t.values.iter().any(|v| !v.is_finite());
        self.0.iter().find(bad).map(|t| t.name)
    }

    /// Euclidean norm of all numbers together, which neither overflows nor underflows before
    /// its result does.
    pub fn norm(&self) -> f64 {
        let all = || self.0.iter().flat_map(|t| &t.values);
        norm(all)
    }

    /// Both tensors of each pair are their sum: the gradient of parameters that are one and the same.
    pub fn shared(mut self, pairs: &[[&str; 2]]) -> Self {
        self.pairwise(pairs, |a, b| a + b);
        self
    }

    /// The second tensor of each pair becomes the first.
    pub fn twinned(mut self, pairs: &[[&str; 2]]) -> Self {
        self.pairwise(pairs, |a, _| a);
        self
    }

    fn pairwise(&mut self, pairs: &[[&str; 2]], of: impl Fn(f64, f64) -> f64) {
        for [a, b] in pairs {
            let place = |name: &str| self.0.iter().position(|t| t.name == name);
            let (Some(a), Some(b)) = (place(a), place(b)) else {
                continue;
            };
            for k in 0..self.0[a].values.len().min(self.0[b].values.len()) {
                let value = of(self.0[a].values[k], self.0[b].values[k]);
                self.0[a].values[k] = value;
                self.0[b].values[k] = value;
            }
        }
    }

    /// The same names and sizes, filled with zeros.
    pub fn zeros_like(&self) -> Self {
        let zeroed = self.0.iter().map(|t| Tensor {
            values: vec![0.0; t.values.len()],
            ..*t
        });
        Self(zeroed.collect())
    }
}

/// Euclidean norm, scaled by the largest magnitude so that squares of 1e200 do no harm.
pub(crate) fn norm<'a, I: Iterator<Item = &'a f64>>(values: impl Fn() -> I) -> f64 {
    let largest = values().fold(0f64, |m, v| m.max(v.abs()));
    if largest == 0.0 || !largest.is_finite() {
        return largest;
    }
    let squares = values().map(|v| (v / largest).powi(2)).sum::<f64>();
    largest * squares.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn norms_of_huge_and_tiny_numbers_are_right() {
        for scale in [1e-200, 1.0, 1e200] {
            let values = [3.0 * scale, -4.0 * scale];
            assert!((norm(|| values.iter()) / (5.0 * scale) - 1.0).abs() < 1e-15);
        }
        assert_eq!(norm(|| [0.0].iter()), 0.0);
        assert_eq!(Tensors::default().norm(), 0.0);
    }
}
