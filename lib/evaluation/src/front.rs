//! The Pareto front of cost and error, and its elbow.

/// Indices of the points that no other point beats, by rising cost. A point beats another if its cost and its error are
/// not higher, and one of them is lower. Points that are not finite and above 0 are left out; of equal
/// points the first counts.
pub fn pareto(points: &[(f64, f64)]) -> Vec<usize> {
    let usable = |v: f64| v.is_finite() && v > 0.0;
    let mut order: Vec<usize> = (0..points.len())
        .filter(|&k| usable(points[k].0) && usable(points[k].1))
        .collect();
    let by = |a: f64, b: f64| a.total_cmp(&b);
    order.sort_by(|&a, &b| {
        by(points[a].0, points[b].0)
            .then(by(points[a].1, points[b].1))
            .then(a.cmp(&b))
    });
    let mut front = Vec::new();
    let mut least = f64::INFINITY;
    for k in order {
        if points[k].1 < least {
            least = points[k].1;
            front.push(k);
        }
    }
    front
}

/// The point of a front after which accuracy gets dear: the one farthest below the straight line
/// between the front's ends, both axes logarithmic and scaled to the front's extent [Satopaa et al.
/// 2011, on logarithms]. An index into `points`; `None` for fewer than three points on the front, or
/// where none lies below the line.
pub fn elbow(points: &[(f64, f64)], front: &[usize]) -> Option<usize> {
    let (first, last) = (*front.first()?, *front.last()?);
    if front.len() < 3 {
        return None;
    }
    let place = |k: usize| (points[k].0.ln(), points[k].1.ln());
    let ((x0, y0), (x1, y1)) = (place(first), place(last));
    // From (0, 1) down to (1, 0): the distance to that line is in proportion to 1 - x - y.
    let below = |k: usize| {
        let (x, y) = place(k);
        1.0 - (x - x0) / (x1 - x0) - (y - y1) / (y0 - y1)
    };
    let inner = &front[1..front.len() - 1];
    let best = inner
        .iter()
        .copied()
        .max_by(|&a, &b| below(a).total_cmp(&below(b)))?;
    (below(best) > 0.0).then_some(best)
}

/// Three points of a front to offer: at the elbow (else in the front's middle), the best for at most a
/// quarter of its cost (else the cheapest), and the best for at most four times its cost. `None` for an
/// empty front.
pub fn three_presets(points: &[(f64, f64)], front: &[usize]) -> Option<[usize; 3]> {
    /// Two presets differ in cost by at least this factor: less is not noticed while waiting.
    const APART: f64 = 4.0;
    let first = *front.first()?;
    let middle = elbow(points, front).unwrap_or(front[front.len() / 2]);
    let best_within = |cost: f64| {
        let affordable = front.iter().rev().find(|&&k| points[k].0 <= cost);
        affordable.copied().unwrap_or(first)
    };
    let cost = points[middle].0;
    Some([best_within(cost / APART), middle, best_within(cost * APART)])
}

/// How far a point is from the front: the factor by which the front's point of at most the same cost
/// has less error; 1 on the front. `None` where no point of the front costs as little.
pub fn excess_error(points: &[(f64, f64)], front: &[usize], point: (f64, f64)) -> Option<f64> {
    let affordable = front
        .iter()
        .filter(|&&k| points[k].0 <= point.0 * (1.0 + 1e-9));
    let least = affordable.map(|&k| points[k].1).min_by(f64::total_cmp)?;
    Some((point.1 / least).max(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_nothing_beats_is_on_the_front() {
        let points = [
            (1.0, 8.0),
            (2.0, 9.0), // beaten by the first
            (2.0, 4.0),
            (3.0, 4.0), // dearer and no better
            (8.0, 1.0),
            (f64::NAN, 0.1),
            (0.5, f64::INFINITY),
            (8.0, 1.0), // the same again
        ];
        assert_eq!(pareto(&points), [0, 2, 4]);
        assert_eq!(pareto(&[]), [0usize; 0]);
    }

    #[test]
    fn the_elbow_is_where_the_gain_stops() {
        // Error halves with twice the time until 4, and hardly falls afterwards.
        let points = [(1.0, 16.0), (2.0, 8.0), (4.0, 4.0), (8.0, 3.8), (16.0, 3.6)];
        let front = pareto(&points);
        assert_eq!(elbow(&points, &front), Some(2));
    }

    #[test]
    fn a_straight_front_and_a_short_one_have_no_elbow() {
        // Bulging away from the origin: every inner point lies above the chord.
        let bulge = [(1.0, 16.0), (2.0, 15.0), (4.0, 1.0)];
        assert_eq!(elbow(&bulge, &pareto(&bulge)), None);
        let two = [(1.0, 2.0), (2.0, 1.0)];
        assert_eq!(elbow(&two, &pareto(&two)), None);
    }

    #[test]
    fn presets_lie_on_the_front_a_quarter_and_four_times_the_cost_away() {
        let points: Vec<(f64, f64)> = (0..9)
            .map(|k| {
                (
                    2f64.powi(k),
                    if k < 4 {
                        2f64.powi(-2 * k)
                    } else {
                        2f64.powi(-6 - k / 4)
                    },
                )
            })
            .collect();
        let front = pareto(&points);
        let [draft, standard, high] = three_presets(&points, &front).unwrap();
        assert_eq!(Some(standard), elbow(&points, &front));
        assert!(points[draft].0 <= points[standard].0 / 4.0);
        assert!(points[high].0 <= 4.0 * points[standard].0 && points[high].1 <= points[standard].1);
        let one = [(1.0, 1.0)];
        assert_eq!(three_presets(&one, &pareto(&one)), Some([0, 0, 0]));
        assert_eq!(three_presets(&one, &[]), None);
    }

    #[test]
    fn the_excess_is_the_factor_that_the_front_would_save() {
        let points = [(1.0, 8.0), (2.0, 4.0), (3.0, 6.0)];
        let front = pareto(&points);
        assert_eq!(excess_error(&points, &front, points[1]), Some(1.0));
        assert_eq!(excess_error(&points, &front, points[2]), Some(1.5));
        assert_eq!(excess_error(&points, &front, (0.5, 1.0)), None);
    }
}
