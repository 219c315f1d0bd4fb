//! Faces with more than three corners.
use std::collections::VecDeque;

use glam::{DVec2, DVec3, Vec3};

/// Faces with more corners are cut in halves instead of fans. The triangles of a fan all reach its
/// first corner, so that a ray there would have to be tested against every one.
const LARGEST_FAN: usize = 32;
/// Concave faces with more corners are cut as if they were convex: the time to cut one grows with the square of the corners.
const LARGEST_CONCAVE: usize = 1024;
/// A face that turns the other way at a corner by less than this, radians, counts as convex.
const FLAT: f64 = 1e-5;

/// The warning about a concave face that is too large.
pub(super) const TOO_LARGE: &str = "a concave face of more than 1024 corners may be drawn where it is not: cut faces into \
                                    triangles before the object is exported";

/// Cuts a face into triangles of the same orientation; those that name a corner twice are left out. A convex face becomes
/// a fan, a concave one loses one ear after another [Meisters 1975]. Returns whether the face is concave and too large for
/// that.
pub(super) fn triangulate(
    corners: &[u32],
    positions: &[Vec3],
    mut emit: impl FnMut([u32; 3]),
) -> bool {
    let mut each = |a: usize, b: usize, c: usize| {
        let [a, b, c] = [a, b, c].map(|k| corners[k]);
        if a != b && b != c && c != a {
            emit([a, b, c]);
        }
    };
    let n = corners.len();
    let concave = Outline::of(corners, positions).filter(|outline| !outline.is_convex());
    match &concave {
        Some(outline) if n <= LARGEST_CONCAVE => outline.cut_ears(&mut each),
        _ if n <= LARGEST_FAN => (1..n.saturating_sub(1)).for_each(|k| each(0, k, k + 1)),
        _ => halve(n, &mut each),
    }
    concave.is_some() && n > LARGEST_CONCAVE
}

/// Each piece is bounded by the corners from one to another, and the line between these.
fn halve(n: usize, each: &mut impl FnMut(usize, usize, usize)) {
    let mut pieces = vec![(0, n - 1)];
    while let Some((first, last)) = pieces.pop() {
        if last - first >= 2 {
            let middle = first + (last - first) / 2;
            each(first, middle, last);
            pieces.extend([(middle, last), (first, middle)]);
        }
    }
}

/// A face in its plane, counter-clockwise.
struct Outline {
    points: Vec<DVec2>,
    /// By how much rounding may have moved a corner.
    rounding: f64,
}

/// Twice the area of a triangle, negative if it is clockwise.
fn area(a: DVec2, b: DVec2, c: DVec2) -> f64 {
    (b - a).perp_dot(c - a)
}

impl Outline {
    /// `None` if the face has no more than three corners, or no area.
    fn of(corners: &[u32], positions: &[Vec3]) -> Option<Self> {
        if corners.len() <= 3 {
            return None;
        }
        let at = |corner: u32| positions[corner as usize];
        let first = at(corners[0]).as_dvec3();
        let solid: Vec<DVec3> = corners.iter().map(|c| at(*c).as_dvec3() - first).collect();
        let pairs = solid.windows(2).map(|pair| pair[0].cross(pair[1]));
        let normal: DVec3 = pairs.sum();
        // Along the longest axis of the normal the face is seen largest; the order of the others keeps it counter-clockwise.
        let size = normal.abs();
        let (axis, [u, v]) = if size.x >= size.y && size.x >= size.z {
            (0, [1, 2])
        } else if size.y >= size.z {
            (1, [2, 0])
        } else {
            (2, [0, 1])
        };
        let along = normal[axis];
        let flat = |p: &DVec3| match along < 0.0 {
            true => DVec2::new(p[v], p[u]),
            false => DVec2::new(p[u], p[v]),
        };
        let largest = corners.iter().map(|c| at(*c).abs().max_element());
        (along != 0.0).then(|| Self {
            points: solid.iter().map(flat).collect(),
            rounding: f64::from(f32::EPSILON * largest.fold(0.0, f32::max)),
        })
    }

    /// Whether it turns the same way at all corners, but for rounding.
    fn is_convex(&self) -> bool {
        let n = self.points.len();
        (0..n).all(|k| {
            let [a, b, c] = [k, k + 1, k + 2].map(|k| self.points[k % n]);
            let (before, after) = ((b - a).length(), (c - b).length());
            let turn = (b - a).perp_dot(c - b);
            turn >= -(FLAT * before * after + self.rounding * (before + after))
        })
    }

    /// Cuts off one ear after another. A corner is tried again only when a neighbour is gone, for no other cut makes it an ear:
    /// three tries a corner suffice.
    fn cut_ears(&self, each: &mut impl FnMut(usize, usize, usize)) {
        let n = self.points.len();
        let mut ring: Vec<[usize; 2]> = (0..n).map(|k| [(k + n - 1) % n, (k + 1) % n]).collect();
        let mut is_cut = vec![false; n];
        let mut waiting: VecDeque<usize> = (0..n).collect();
        let (mut left, mut first) = (n, 0);
        while left > 3
            && let Some(tip) = waiting.pop_front()
        {
            if is_cut[tip] || !self.is_ear(tip, &ring) {
                continue;
            }
            let [before, after] = ring[tip];
            each(before, tip, after);
            (ring[before][1], ring[after][0]) = (after, before);
            (is_cut[tip], left, first) = (true, left - 1, before);
            waiting.extend([before, after]);
        }
        // The last three, or what crosses itself.
        let mut corner = ring[first][1];
        for _ in 2..left {
            let after = ring[corner][1];
            each(first, corner, after);
            corner = after;
        }
    }

    /// Whether no other corner that is left lies in the triangle at `tip`, which turns as the face does. Corners where holes
    /// are joined to the outline are there twice.
    fn is_ear(&self, tip: usize, ring: &[[usize; 2]]) -> bool {
        let [before, after] = ring[tip];
        let [a, b, c] = [before, tip, after].map(|k| self.points[k]);
        let is_within = |p: DVec2| {
            p != a
                && p != b
                && p != c
                && area(a, b, p) >= 0.0
                && area(b, c, p) >= 0.0
                && area(c, a, p) >= 0.0
        };
        let own = area(a, b, c);
        let mut others = std::iter::successors(Some(ring[after][1]), |k| Some(ring[*k][1]))
            .take_while(|k| *k != before);
        own == 0.0 || own > 0.0 && !others.any(|k| is_within(self.points[k]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Triangles of a face in the plane z = 0, and whether it was too large.
    fn cut(outline: &[[f32; 2]]) -> (Vec<[u32; 3]>, bool) {
        let positions: Vec<Vec3> = outline
            .iter()
            .map(|[x, y]| Vec3::new(*x, *y, 0.0))
            .collect();
        let corners: Vec<u32> = (0..outline.len() as u32).collect();
        let mut all = Vec::new();
        let too_large = triangulate(&corners, &positions, |t| all.push(t));
        (all, too_large)
    }

    /// The area of a face, and of the triangles that it was cut into, none of which may be clockwise.
    fn areas(outline: &[[f32; 2]]) -> [f64; 2] {
        let at = |k: usize| DVec2::from_array(outline[k % outline.len()].map(f64::from));
        let own = (0..outline.len()).map(|k| 0.5 * at(k).perp_dot(at(k + 1)));
        let parts = cut(outline).0.into_iter().map(|t| {
            let [a, b, c] = t.map(|k| at(k as usize));
            let part = 0.5 * area(a, b, c);
            assert!(part >= 0.0, "{t:?}");
            part
        });
        [own.sum(), parts.sum()]
    }

    #[test]
    fn a_concave_face_is_cut_into_triangles_that_cover_it_once() {
        let arrow = [[1.0, 2.0], [0.0, 1.0], [-1.0, 2.0], [0.0, 0.0]];
        let ell = [
            [0.0, 1.0],
            [0.0, 0.0],
            [2.0, 0.0],
            [2.0, 2.0],
            [1.0, 2.0],
            [1.0, 1.0],
        ];
        // A hole, joined to the outline by a line that goes there and back.
        let frame = [
            [0.0, 0.0],
            [3.0, 0.0],
            [3.0, 3.0],
            [0.0, 3.0],
            [0.0, 0.0],
            [1.0, 1.0],
            [1.0, 2.0],
            [2.0, 2.0],
            [2.0, 1.0],
            [1.0, 1.0],
        ];
        let comb: Vec<[f32; 2]> = (0..100)
            .rev()
            .map(|k| [k as f32, if k % 2 == 0 { 1.0 } else { 9.0 }])
            .chain([[0.0, 0.0], [99.0, 0.0]])
            .collect();
        let star: Vec<[f32; 2]> = (0..1000)
            .map(|k| {
                let (sin, cos) = (k as f32 * 0.001 * std::f32::consts::TAU).sin_cos();
                let radius = if k % 2 == 0 { 1.0 } else { 0.3 };
                [radius * cos, radius * sin]
            })
            .collect();
        // Out along one side and back along the other, three times around.
        let spiral: Vec<[f32; 2]> = (0..600)
            .map(|k| {
                let (turn, wide) = if k < 300 { (k, 0.2) } else { (599 - k, 0.0) };
                let angle = turn as f32 * 0.01 * std::f32::consts::TAU;
                let radius = 1.0 + 0.1 * angle + wide;
                [radius * angle.cos(), radius * angle.sin()]
            })
            .collect();
        for outline in [&arrow[..], &ell, &frame, &comb, &star, &spiral] {
            let n = outline.len();
            assert_eq!(cut(outline).0.len(), n - 2);
            assert!(!cut(outline).1);
            // From each first corner.
            for first in [0, 1, n / 2] {
                let mut turned = outline.to_vec();
                turned.rotate_left(first);
                let [own, parts] = areas(&turned);
                // Sums in double precision of numbers below 100.
                assert!(
                    (own - parts).abs() < 1e-9,
                    "{n} corners from {first}: {own}, {parts}"
                );
            }
        }
    }

    #[test]
    fn a_face_may_lie_in_any_plane() {
        let arrow = [[1.0, 2.0], [0.0, 1.0], [-1.0, 2.0], [0.0, 0.0]];
        for [u, v] in [[0, 1], [1, 0], [1, 2], [2, 1], [2, 0], [0, 2]] {
            let positions = arrow.map(|[x, y]| {
                let mut place = Vec3::splat(5.0);
                (place[u], place[v]) = (x, y);
                place
            });
            let mut all = Vec::new();
            triangulate(&[0, 1, 2, 3], &positions, |t| all.push(t));
            all.iter_mut().for_each(|t| t.sort());
            all.sort();
            // The notch is at corner 1.
            assert_eq!(all, [[0, 1, 3], [1, 2, 3]]);
        }
    }

    #[test]
    fn what_crosses_itself_ends() {
        let bow = [[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.9]];
        assert_eq!(cut(&bow).0.len(), 2);
        // Corners of a lattice, in an order that goes all over it.
        let tangle: Vec<[f32; 2]> = (0..1024)
            .map(|k| [(k * 389 % 32) as f32, (k * 389 / 32 % 37) as f32])
            .collect();
        assert_eq!(cut(&tangle).0.len(), tangle.len() - 2);
    }

    #[test]
    fn a_concave_face_of_too_many_corners_is_told() {
        let star = |n: usize| -> Vec<[f32; 2]> {
            let corner = |k: usize| {
                let (sin, cos) = (k as f32 / n as f32 * std::f32::consts::TAU).sin_cos();
                let radius = if k.is_multiple_of(2) { 1.0 } else { 0.3 };
                [radius * cos, radius * sin]
            };
            (0..n).map(corner).collect()
        };
        assert!(!cut(&star(LARGEST_CONCAVE)).1);
        assert!(cut(&star(LARGEST_CONCAVE + 2)).1);
    }

    #[test]
    fn a_face_of_a_million_corners_has_few_triangles_at_any_place() {
        let n = 1 << 20;
        let corners: Vec<u32> = (0..n).collect();
        let rim = |i: u32| (std::f64::consts::TAU * f64::from(i) / f64::from(n)).sin_cos();
        // Sine first: x is the second.
        let place_of = |i: u32| Vec3::new(rim(i).1 as f32, rim(i).0 as f32, 0.0);
        let positions: Vec<Vec3> = corners.iter().map(|i| place_of(*i)).collect();
        // Off the axes, at which boxes of chords end.
        let place = (0.3, 0.4);
        let (mut count, mut boxes_there, mut area) = (0, 0, 0.0);
        let too_large = triangulate(&corners, &positions, |triangle| {
            let [a, b, c] = triangle.map(rim);
            count += 1;
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
        // Single precision moves its corners by more than it turns there.
        assert!(!too_large);
        // The polygon's area is that of the circle but for (2 pi / n)^2 / 6 of it.
        assert!((area - std::f64::consts::PI).abs() < 1e-6, "{area}");
        // At most some triangles of each of twenty levels; of a fan it would be a quarter million.
        assert!(boxes_there <= 60, "{boxes_there}");
    }

    #[test]
    fn small_faces_are_fans() {
        let mut all = Vec::new();
        let in_a_point = [Vec3::ZERO; 10];
        triangulate(&[7, 8, 9, 8, 5], &in_a_point, |t| all.push(t));
        assert_eq!(all, [[7, 8, 9], [7, 9, 8], [7, 8, 5]]);
        triangulate(&[1], &in_a_point, |_| panic!("no triangle"));
    }
}
