//! Limited-memory BFGS [Nocedal and Wright 2006, algorithm 7.5].
use std::collections::VecDeque;

/// Pairs of steps and gradient changes that are kept.
const MEMORY: usize = 10;
/// Sufficient decrease of a step, as a share of what the slope promises [ibid., section 3.1].
const DECREASE: f64 = 1e-4;

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// A step `s` and the change `y` of the gradient along it.
struct Pair {
    s: Vec<f64>,
    y: Vec<f64>,
    /// `1 / (s . y)`, positive.
    rho: f64,
}

/// Minimises `f`, which returns its value and gradient, from `x`, for at most `iterations` steps; ends
/// early where no step along the search direction descends. Returns the best point.
pub(crate) fn minimise(
    mut x: Vec<f64>,
    iterations: usize,
    mut f: impl FnMut(&[f64]) -> (f64, Vec<f64>),
) -> Vec<f64> {
    let (mut value, mut gradient) = f(&x);
    let mut pairs: VecDeque<Pair> = VecDeque::with_capacity(MEMORY);
    for _ in 0..iterations {
        let direction = search_direction(&gradient, &pairs);
        let slope = dot(&direction, &gradient);
        if slope >= 0.0 || !slope.is_finite() {
            break;
        }
        // Without curvature known, start with a step of a tenth in the parameters.
        let mut length = match pairs.is_empty() {
            true => 0.1 / dot(&direction, &direction).sqrt(),
            false => 1.0,
        };
        let mut accepted = None;
        for _ in 0..20 {
            let moved: Vec<f64> = x
                .iter()
                .zip(&direction)
                .map(|(x, d)| x + length * d)
                .collect();
            let (v, g) = f(&moved);
            if v.is_finite() && v <= value + DECREASE * length * slope {
                accepted = Some((moved, v, g));
                break;
            }
            length *= 0.4;
        }
        let Some((moved, v, g)) = accepted else { break };
        let s: Vec<f64> = moved.iter().zip(&x).map(|(a, b)| a - b).collect();
        let y: Vec<f64> = g.iter().zip(&gradient).map(|(a, b)| a - b).collect();
        let curvature = dot(&s, &y);
        if curvature > 1e-12 * dot(&y, &y) {
            if pairs.len() == MEMORY {
                pairs.pop_front();
            }
            let rho = 1.0 / curvature;
            pairs.push_back(Pair { s, y, rho });
        }
        (x, value, gradient) = (moved, v, g);
    }
    x
}

/// `-H g` by the two-loop recursion.
fn search_direction(gradient: &[f64], pairs: &VecDeque<Pair>) -> Vec<f64> {
    let mut q: Vec<f64> = gradient.iter().map(|g| -g).collect();
    let mut alphas = Vec::with_capacity(pairs.len());
    for p in pairs.iter().rev() {
        let alpha = p.rho * dot(&p.s, &q);
        q.iter_mut().zip(&p.y).for_each(|(q, y)| *q -= alpha * y);
        alphas.push(alpha);
    }
    if let Some(p) = pairs.back() {
        let scale = 1.0 / (p.rho * dot(&p.y, &p.y));
        q.iter_mut().for_each(|q| *q *= scale);
    }
    for (p, alpha) in pairs.iter().zip(alphas.into_iter().rev()) {
        let beta = p.rho * dot(&p.y, &q);
        q.iter_mut()
            .zip(&p.s)
            .for_each(|(q, s)| *q += (alpha - beta) * s);
    }
    q
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_valley_of_rosenbrock_is_descended_to_its_end() {
        let f = |x: &[f64]| {
            let (a, b) = (1.0 - x[0], x[1] - x[0] * x[0]);
            (
                a * a + 100.0 * b * b,
                vec![-2.0 * a - 400.0 * x[0] * b, 200.0 * b],
            )
        };
        let x = minimise(vec![-1.2, 1.0], 100, f);
        assert!(
            (x[0] - 1.0).abs() < 1e-6 && (x[1] - 1.0).abs() < 1e-6,
            "{x:?}"
        );
    }
}
