//! Derivatives by central differences, to hold analytic ones against.

/// `(f(x + h) - f(x - h)) / (2 h)`. In f64 the error is about `h^2 |f'''| / 6 + eps |f| / h`:
/// least near `h = (3 eps |f| / |f'''|)^(1/3)`, 6e-6 of the scale of `x`, where some ten
/// digits are right.
pub fn central_difference(f: impl Fn(f64) -> f64, x: f64, h: f64) -> f64 {
    (f(x + h) - f(x - h)) / (2.0 * h)
}

/// `|a - b| / max(|a|, |b|, floor)`: relative where there is something to be relative to.
pub fn relative_error(a: f64, b: f64, floor: f64) -> f64 {
    (a - b).abs() / a.abs().max(b.abs()).max(floor)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn central_differences_have_ten_digits() {
        for x in [0.1f64, 1.0, 3.0] {
            let d = central_difference(f64::sin, x, 6e-6);
            assert!(relative_error(d, x.cos(), 1e-3) < 1e-9, "{x}");
        }
    }
}
