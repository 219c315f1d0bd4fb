//! Gauss-Legendre quadrature.
use std::f64::consts::PI;
use std::sync::OnceLock;

/// Nodes in `[0, 1]` and weights that sum to 1.
pub(crate) type Rule = Vec<(f64, f64)>;

/// The rule with `n` nodes, exact for polynomials of degree `2 n - 1`: roots of the Legendre
/// polynomial by Newton's method from Tricomi's estimate.
pub(crate) fn gauss_legendre(n: usize) -> Rule {
    (0..n)
        .map(|k| {
            let mut x = (PI * (k as f64 + 0.75) / (n as f64 + 0.5)).cos();
            let mut slope = 1.0;
            for _ in 0..20 {
                let (mut p, mut before) = (1.0, 0.0);
                for m in 0..n {
                    let m = m as f64;
                    (p, before) = (((2.0 * m + 1.0) * x * p - m * before) / (m + 1.0), p);
                }
                slope = n as f64 * (x * p - before) / (x * x - 1.0);
                let step = p / slope;
                x -= step;
                if step.abs() < 1e-15 {
                    break;
                }
            }
            (0.5 * (1.0 - x), 1.0 / ((1.0 - x * x) * slope * slope))
        })
        .collect()
}

/// The 16-node rule, computed once.
pub(crate) fn rule_16() -> &'static Rule {
    static RULE: OnceLock<Rule> = OnceLock::new();
    RULE.get_or_init(|| gauss_legendre(16))
}

/// Integral of `f` over `[low, high]`, split at those of `breaks` that fall inside, 16 nodes a
/// piece: converged where `f` is smooth between breaks.
pub(crate) fn integrate_pieces(
    low: f64,
    high: f64,
    breaks: &mut [f64],
    mut f: impl FnMut(f64) -> f64,
) -> f64 {
    breaks.sort_by(f64::total_cmp);
    let mut total = 0.0;
    let mut start = low;
    let inside = breaks.iter().copied().filter(|b| *b > low && *b < high);
    for end in inside.chain([high]) {
        let length = end - start;
        for &(x, w) in rule_16() {
            total += w * length * f(start + x * length);
        }
        start = end;
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rule_of_n_nodes_is_exact_to_degree_2n_minus_1() {
        for n in [1usize, 2, 3, 5, 16] {
            let rule = gauss_legendre(n);
            for degree in 0..2 * n as i32 {
                let sum: f64 = rule.iter().map(|&(x, w)| w * x.powi(degree)).sum();
                let exact = 1.0 / f64::from(degree + 1);
                assert!((sum - exact).abs() < 1e-14, "{n} nodes, degree {degree}");
            }
        }
    }
}
