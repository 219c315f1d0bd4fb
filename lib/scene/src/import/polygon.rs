//! Faces with more than three corners.

/// Faces with more corners are cut in halves instead of fans. The triangles of a fan all reach its
/// first corner, so that a ray there would have to be tested against every one.
const LARGEST_FAN: usize = 32;

/// Cuts a convex face into triangles of the same orientation; those that name a corner twice are
/// left out.
pub(super) fn triangulate(corners: &[u32], mut emit: impl FnMut([u32; 3])) {
    let mut each = |a: usize, b: usize, c: usize| {
        let [a, b, c] = [a, b, c].map(|k| corners[k]);
        if a != b && b != c && c != a {
            emit([a, b, c]);
        }
    };
    let n = corners.len();
    if n <= LARGEST_FAN {
        (1..n.saturating_sub(1)).for_each(|k| each(0, k, k + 1));
        return;
    }
    // Each piece is bounded by the corners from one to another, and the line between these.
    let mut pieces = vec![(0, n - 1)];
    while let Some((first, last)) = pieces.pop() {
        if last - first >= 2 {
            let middle = first + (last - first) / 2;
            each(first, middle, last);
            pieces.extend([(middle, last), (first, middle)]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_face_of_a_million_corners_has_few_triangles_at_any_place() {
        let n = 1 << 20;
        let corners: Vec<u32> = (0..n).collect();
        let rim = |i: u32| (std::f64::consts::TAU * f64::from(i) / f64::from(n)).sin_cos();
        // Off the axes, at which boxes of chords end.
        let place = (0.3, 0.4);
        let (mut count, mut boxes_there, mut area) = (0, 0, 0.0);
        triangulate(&corners, |triangle| {
            let [a, b, c] = triangle.map(rim);
            count += 1;
            // Sine first: x is the second.
            area += 0.5 * ((b.1 - a.1) * (c.0 - a.0) - (c.1 - a.1) * (b.0 - a.0));
            let within = |k: fn((f64, f64)) -> f64| {
                let all = [k(a), k(b), k(c)];
                let low = all.iter().fold(f64::INFINITY, |m, v| m.min(*v));
                let high = all.iter().fold(f64::NEG_INFINITY, |m, v| m.max(*v));
                (low..=high).contains(&k(place))
            };
            boxes_there += usize::from(within(|p| p.0) && within(|p| p.1));
        });
        assert_eq!(count, n as usize - 2);
        // The polygon's area is that of the circle but for (2 pi / n)^2 / 6 of it.
        assert!((area - std::f64::consts::PI).abs() < 1e-6, "{area}");
        // At most some triangles of each of twenty levels; of a fan it would be a quarter million.
        assert!(boxes_there <= 60, "{boxes_there}");
    }

    #[test]
    fn small_faces_are_fans() {
        let mut all = Vec::new();
        triangulate(&[7, 8, 9, 8, 5], |t| all.push(t));
        assert_eq!(all, [[7, 8, 9], [7, 9, 8], [7, 8, 5]]);
        triangulate(&[1], |_| panic!("no triangle"));
    }
}
