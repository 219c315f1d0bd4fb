//! Adam [Kingma & Ba 2015] for named tensors, with a learning rate per group and gradients clipped
//! tensor by tensor.
//!
//! A tensor's gradient is clipped to [`CLIP`] times its own running root mean square, known from
//! Adam's second moment: groups differ in scale by orders of magnitude, so one threshold for all
//! would never touch some and always touch others. A single outlier of 1e6 would otherwise swell
//! the second moment so much that the parameter stood still for the rest of the run. A gradient
//! that has truly grown gets through in a few steps, for the mean square then doubles each time.
use crate::error::OptimizeError;
use crate::tensors::{Group, Tensors, norm};

/// Decay of the mean of gradients [Kingma & Ba 2015].
const BETA1: f64 = 0.9;
/// Decay of the mean of squares: a memory of 100 steps, where the usual .999 would remember all
/// 600 and with them the much larger gradients of the start.
const BETA2: f64 = 0.99;
/// Added to the root of the mean square: below this, a gradient counts as none.
const EPSILON: f64 = 1e-10;
/// Largest norm of a gradient, in units of its running root mean square.
const CLIP: f64 = 10.0;

/// Moments of every tensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Adam {
    /// Running means of gradients, biased towards 0.
    pub first: Tensors,
    /// Running means of squared gradients, biased towards 0.
    pub second: Tensors,
    /// Steps taken.
    pub steps: u64,
}

impl Adam {
    /// For tensors of these names and sizes.
    pub fn new(parameters: &Tensors) -> Self {
        Self {
            first: parameters.zeros_like(),
            second: parameters.zeros_like(),
            steps: 0,
        }
    }

    /// Takes a step against `gradient`, `rate` being the learning rate of each group; a rate of 0
    /// leaves a group where it is. Nothing is changed if a gradient is missing or mis-sized. The
    /// gradient has to be finite: [`Tensors::first_not_finite`] checks it.
    pub fn step(
        &mut self,
        parameters: &mut Tensors,
        gradient: &Tensors,
        rate: impl Fn(Group) -> f64,
    ) -> Result<(), OptimizeError> {
        check(parameters, gradient)?;
        self.steps += 1;
        let unbiased = |beta: f64| 1.0 / (1.0 - beta.powf(self.steps as f64));
        let (scale1, scale2) = (unbiased(BETA1), unbiased(BETA2));
        // Before the first step there is no mean square to clip by.
        let before = 1.0 / (1.0 - BETA2.powf((self.steps as f64 - 1.0).max(1.0)));
        let moments = self.first.0.iter_mut().zip(&mut self.second.0);
        for (p, (first, second)) in parameters.0.iter_mut().zip(moments) {
            let Some(g) = gradient.get(p.name) else {
                continue;
            };
            let rate = rate(p.group);
            let share = clipped_share(&g.values, &second.values, before);
            for (k, value) in p.values.iter_mut().enumerate() {
                let g = share * g.values[k];
                let (m, v) = (&mut first.values[k], &mut second.values[k]);
                *m = BETA1 * *m + (1.0 - BETA1) * g;
                *v = BETA2 * *v + (1.0 - BETA2) * g * g;
                *value -= rate * (*m * scale1) / ((*v * scale2).sqrt() + EPSILON);
            }
        }
        Ok(())
    }
}

fn check(parameters: &Tensors, gradient: &Tensors) -> Result<(), OptimizeError> {
    for p in &parameters.0 {
        let tensor = p.name;
        let g = gradient
            .get(tensor)
            .ok_or(OptimizeError::MissingGradient { tensor })?;
        if g.values.len() != p.values.len() {
            return Err(OptimizeError::GradientSize {
                tensor,
                found: g.values.len(),
                expected: p.values.len(),
            });
        }
    }
    Ok(())
}

/// The factor that keeps a gradient within [`CLIP`] times its running root mean square.
fn clipped_share(gradient: &[f64], second: &[f64], unbiased: f64) -> f64 {
    let usual = (second.iter().sum::<f64>() * unbiased).sqrt();
    let now = norm(|| gradient.iter());
    if usual > 0.0 && now > CLIP * usual {
        CLIP * usual / now
    } else {
        1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensors::Tensor;

    fn tensors(values: &[f64]) -> Tensors {
        Tensors(vec![
            Tensor {
                name: "foreground.direction",
                group: Group::Direction,
                values: values.to_vec(),
            },
            Tensor {
                name: "exposure",
                group: Group::Exposure,
                values: vec![1.0],
            },
        ])
    }

    #[test]
    fn a_missing_gradient_is_refused_by_name_and_nothing_moves() {
        let mut p = tensors(&[1.0, 2.0]);
        let mut adam = Adam::new(&p);
        let before = (p.clone(), adam.clone());
        let mut g = tensors(&[1.0, 1.0]);
        g.0.pop();
        let error = adam.step(&mut p, &g, |_| 0.1).unwrap_err();
        assert_eq!(
            error.to_string(),
            "no gradient for the tensor `exposure`; every parameter needs one, zeros if it is at rest"
        );
        let error = adam.step(&mut p, &tensors(&[1.0]), |_| 0.1).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the gradient of `foreground.direction` has 1 values; expected 2, as many as the parameter"
        );
        assert_eq!((p, adam), before);
    }

    #[test]
    fn the_first_steps_agree_with_the_algorithm_as_published() {
        let mut p = tensors(&[1.0, -2.0]);
        let mut adam = Adam::new(&p);
        let (mut x, mut m, mut v) = (1.0f64, 0.0f64, 0.0f64);
        for t in 1..=5 {
            let g = 0.3 * t as f64 - 1.0;
            adam.step(&mut p, &tensors(&[g, 0.0]), |_| 0.1).unwrap();
            m = 0.9 * m + 0.1 * g;
            v = 0.99 * v + 0.01 * g * g;
            let (mh, vh) = (m / (1.0 - 0.9f64.powi(t)), v / (1.0 - 0.99f64.powi(t)));
            x -= 0.1 * mh / (vh.sqrt() + EPSILON);
            // A dozen roundings of numbers around 1.
            assert!((p.0[0].values[0] - x).abs() < 1e-14);
            assert_eq!(p.0[0].values[1], -2.0, "no gradient, no step");
        }
    }

    #[test]
    fn a_group_with_rate_zero_stays_and_the_others_move() {
        let mut p = tensors(&[1.0, 2.0]);
        let mut adam = Adam::new(&p);
        let rate = |group| if group == Group::Exposure { 0.0 } else { 0.1 };
        adam.step(&mut p, &tensors(&[1.0, 1.0]), rate).unwrap();
        assert_eq!(p.get("exposure").unwrap().values, [1.0]);
        assert!(p.0[0].values[0] < 1.0);
    }

    #[test]
    fn zero_gradients_leave_everything_at_rest_for_ever() {
        let mut p = tensors(&[1.0, 2.0]);
        let zero = p.zeros_like();
        let mut adam = Adam::new(&p);
        for _ in 0..100 {
            adam.step(&mut p, &zero, |_| 0.1).unwrap();
        }
        assert_eq!(p, tensors(&[1.0, 2.0]));
    }

    #[test]
    fn gradients_of_1e6_move_no_further_than_the_learning_rate_allows() {
        let mut p = tensors(&[0.0, 0.0]);
        let mut adam = Adam::new(&p);
        for k in 0..1000 {
            let sign = if k % 3 == 0 { -1.0 } else { 1.0 };
            let before = p.0[0].values[0];
            adam.step(&mut p, &tensors(&[sign * 1e6, 1e6]), |_| 0.01)
                .unwrap();
            // |m| <= sqrt(v) (1 - b1) / sqrt(1 - b2) at most, once unbiased: 1.
            assert!((p.0[0].values[0] - before).abs() <= 0.01 * 1.0001);
        }
        assert!(p.first_not_finite().is_none());
        assert!(
            (p.0[0].values[1] + 10.0).abs() < 1e-6,
            "a steady gradient moves by the rate"
        );
    }

    #[test]
    fn after_one_outlier_the_parameter_still_moves() {
        let run = |at: usize, outlier: f64| {
            let mut p = tensors(&[0.0, 0.0]);
            let mut adam = Adam::new(&p);
            for k in 0..100 {
                let g = if k == at { outlier } else { 1.0 };
                adam.step(&mut p, &tensors(&[g, g]), |_| 0.01).unwrap();
            }
            p.0[0].values[0]
        };
        let calm = run(50, 1.0);
        assert!((calm + 1.0).abs() < 1e-6);
        // The outlier enters as 10: the mean square becomes 2 and decays from there. Early on it is a mean of few, up to
        // 50 after the second step: the parameter moves at a seventh of the rate first, at half of it fifty steps later.
        for (at, least) in [(1, 0.4), (5, 0.4), (50, 0.8)] {
            let struck = -run(at, 1e6);
            assert!(struck > least && struck < 1.3, "{at}: {struck}");
        }
    }
}
