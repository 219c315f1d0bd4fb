//! What lies where on the ground's plane, so that a part of it is looked at without a walk through all.
use std::ops::Range;

use glam::{DVec2, DVec3};

/// Side of a cell, metres: an object and the air around it take a few.
const CELL_M: f64 = 0.5;
/// By how much areas are widened, metres: far above the rounding of positions, which is 2e-9 at 1e7 m.
const ROUNDING_M: f64 = 1e-3;

/// Coordinates on a plane.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Chart {
    origin: DVec3,
    right: DVec3,
    ahead: DVec3,
}

impl Chart {
    /// Of the plane through `origin` with the unit normal `up`.
    pub(crate) fn new(origin: DVec3, up: DVec3) -> Self {
        let right = up.any_orthonormal_vector();
        Self {
            origin,
            right,
            ahead: up.cross(right),
        }
    }

    /// Of the point below or above `p`, metres.
    pub(crate) fn at(&self, p: DVec3) -> DVec2 {
        let from = p - self.origin;
        DVec2::new(self.right.dot(from), self.ahead.dot(from))
    }
}

/// Items in square cells of a plane.
pub(crate) struct Cells<T> {
    /// Row and column of the cell, and the item, in this order.
    items: Vec<([i32; 2], T)>,
    /// The items of each row that has some.
    rows: Vec<Range<usize>>,
}

impl<T> Cells<T> {
    /// Items where they lie, metres.
    pub(crate) fn new(items: impl Iterator<Item = (DVec2, T)>) -> Self {
        let cell = |at: DVec2| [index(at.y), index(at.x)];
        let mut items: Vec<_> = items.map(|(at, item)| (cell(at), item)).collect();
        items.sort_unstable_by_key(|item| item.0);
        let (mut rows, mut end) = (Vec::new(), 0);
        for row in items.chunk_by(|a, b| a.0[0] == b.0[0]) {
            rows.push(end..end + row.len());
            end += row.len();
        }
        Self { items, rows }
    }

    /// Whether `test` holds for an item in the convex polygon with these corners, metres. Some items around it are
    /// tested, too.
    pub(crate) fn any(&self, corners: &[DVec2], mut test: impl FnMut(&T) -> bool) -> bool {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for corner in corners {
            (low, high) = (low.min(corner.y), high.max(corner.y));
        }
        let (first, last) = (index(low - ROUNDING_M), index(high + ROUNDING_M));
        let number = |row: &Range<usize>| self.items[row.start].0[0];
        let start = self.rows.partition_point(|row| number(row) < first);
        let rows = self.rows[start..].iter();
        rows.take_while(|row| number(row) <= last).any(|row| {
            let Some([from, to]) = columns(corners, number(row)) else {
                return false;
            };
            let items = &self.items[row.clone()];
            let start = items.partition_point(|item| item.0[1] < from);
            let items = items[start..].iter();
            items
                .take_while(|item| item.0[1] <= to)
                .any(|item| test(&item.1))
        })
    }
}

/// Row or column of a coordinate.
fn index(metres: f64) -> i32 {
    (metres / CELL_M).floor() as i32
}

/// First and last column of a convex polygon in a row; `None` if it does not reach there.
fn columns(corners: &[DVec2], row: i32) -> Option<[i32; 2]> {
    let low = f64::from(row) * CELL_M - ROUNDING_M;
    let high = low + CELL_M + 2.0 * ROUNDING_M;
    let (mut left, mut right) = (f64::INFINITY, f64::NEG_INFINITY);
    for (a, b) in corners.iter().zip(corners.iter().cycle().skip(1)) {
        let rise = b.y - a.y;
        // Where the edge enters the row and leaves it, as shares of the edge.
        let (enters, leaves) = match rise == 0.0 {
            true if (low..=high).contains(&a.y) => (0.0, 1.0),
            true => continue,
            false => {
                let (p, q) = ((low - a.y) / rise, (high - a.y) / rise);
                (p.min(q).max(0.0), p.max(q).min(1.0))
            }
        };
        if enters <= leaves {
            for x in [enters, leaves].map(|share| a.x + share * (b.x - a.x)) {
                (left, right) = (left.min(x), right.max(x));
            }
        }
    }
    (left <= right).then(|| [index(left - ROUNDING_M), index(right + ROUNDING_M)])
}

/// The corners of a square around `middle`.
pub(crate) fn square(middle: DVec2, half_m: f64) -> [DVec2; 4] {
    let signs = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
    signs.map(|(x, y)| middle + half_m * DVec2::new(x, y))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn inside(corners: &[DVec2], p: DVec2) -> bool {
        let edges = corners.iter().zip(corners.iter().cycle().skip(1));
        let mut sides = edges.map(|(a, b)| (*b - *a).perp_dot(p - *a));
        sides.all(|side| side >= 0.0)
    }

    proptest! {
        #[test]
        fn every_item_in_a_polygon_is_tested_and_none_far_from_it(
            items in proptest::collection::vec((-9.0f64..9.0, -9.0f64..9.0), 0..300),
            middle in (-9.0f64..9.0, -9.0f64..9.0),
            (turn, length, start, end) in (0.0f64..7.0, 0.0f64..8.0, 0.0f64..2.0, 0.0f64..2.0),
        ) {
            let items: Vec<DVec2> = items.into_iter().map(DVec2::from).collect();
            let cells = Cells::new(items.iter().map(|p| (*p, *p)));
            let middle = DVec2::from(middle);
            let ahead = DVec2::from_angle(turn);
            let (side, tip) = (ahead.perp(), middle + length * ahead);
            let trapezoid = [
                middle + start * side, middle - start * side, tip - end * side, tip + end * side,
            ];
            for corners in [trapezoid, square(middle, start)] {
                let mut tested = Vec::new();
                let found = cells.any(&corners, |p| {
                    tested.push(*p);
                    false
                });
                prop_assert!(!found);
                for p in items.iter().filter(|p| inside(&corners, **p)) {
                    prop_assert!(tested.contains(p), "{p}");
                }
                // A cell and the rounding beyond the box around the polygon.
                let low = corners.into_iter().reduce(DVec2::min).unwrap() - CELL_M - 2.0 * ROUNDING_M;
                let high = corners.into_iter().reduce(DVec2::max).unwrap() + CELL_M + 2.0 * ROUNDING_M;
                prop_assert!(tested.iter().all(|p| p.cmpge(low).all() && p.cmple(high).all()));
            }
        }
    }

    #[test]
    fn the_first_item_that_passes_ends_the_search() {
        let cells = Cells::new((0..100).map(|i| (DVec2::new(0.01 * f64::from(i), 0.1), i)));
        let mut tested = 0;
        assert!(cells.any(&square(DVec2::new(0.2, 0.1), 0.1), |_| {
            tested += 1;
            true
        }));
        assert_eq!(tested, 1);
        let nothing = Cells::<u8>::new(std::iter::empty());
        assert!(!nothing.any(&square(DVec2::ZERO, 1.0), |_| true));
    }
}
