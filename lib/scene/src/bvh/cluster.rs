//! A binary hierarchy by parallel locally-ordered clustering [Meister, Bittner 2018].
//!
//! Boxes along a Morton curve are merged in rounds: each chooses the neighbour with which it has
//! the smallest common box, and two that choose each other merge. Where boxes grow along the curve,
//! as in a fan of triangles, each chooses its predecessor and a round merges a single pair. Such a
//! round merges neighbours on the curve instead. Hence n boxes take O(log n) rounds and
//! O(n log n) time, whatever they are.
use std::cmp::Ordering;

use glam::Vec3;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::node::Bvh2Node;
use rayon::prelude::*;

/// How far along the curve a box looks for a neighbour.
const RADIUS: usize = 14;

/// Rounds in which a box looks at the two next to it alone: there are many boxes then, and near
/// ones are good enough.
const NEAR_ROUNDS: usize = 3;

/// A round is stalled if it would merge less than one pair for so many boxes.
const STALLED: usize = 16;

/// With so few boxes left, a stalled round costs next to nothing.
const FEW: usize = 64;

/// The triangles along a Morton curve; of those that `compare` calls equal only the first.
/// Vertices lie in `[-1, 1]`.
pub fn order(triangles: &[[Vec3; 3]], compare: impl Fn(u32, u32) -> Ordering + Sync) -> Vec<u32> {
    let mut keyed: Vec<(u64, u32)> = triangles
        .par_iter()
        .enumerate()
        .map(|(t, corners)| {
            let [min, max] = bounds(corners);
            (morton((min + max) * 0.5), t as u32)
        })
        .collect();
    keyed.par_sort_unstable();
    let mut order: Vec<u32> = Vec::with_capacity(keyed.len());
    // Equal triangles have equal codes.
    for run in keyed.chunk_by_mut(|a, b| a.0 == b.0) {
        if run.len() > 1 {
            run.sort_unstable_by(|a, b| compare(a.1, b.1).then(a.1.cmp(&b.1)));
        }
        let first = order.len();
        for &(_, t) in &*run {
            if order.len() == first || compare(order[order.len() - 1], t) != Ordering::Equal {
                order.push(t);
            }
        }
    }
    order
}

/// A hierarchy and how it came about.
pub struct Clustering {
    /// One triangle a leaf; its `max_depth` is above the number of rounds.
    pub tree: Bvh2,
    /// Whether some round was stalled. Boxes contain one another then, and a search for better
    /// places in the tree would visit most of it for every node.
    pub stalled: bool,
}

/// Builds the hierarchy over the triangles in `order`.
pub fn cluster(triangles: &[[Vec3; 3]], order: &[u32]) -> Clustering {
    let mut current: Vec<Bvh2Node> = order
        .iter()
        .map(|&t| {
            let [min, max] = bounds(&triangles[t as usize]);
            // By way of arrays: obvhs may use another version of glam.
            let bounds = Aabb::new(min.to_array().into(), max.to_array().into());
            Bvh2Node::new(bounds, 1, t)
        })
        .collect();
    let mut tree = Bvh2::default();
    let Some(&first) = current.first() else {
        return Clustering {
            tree,
            stalled: false,
        };
    };
    // Children come in pairs; the root is alone at the start.
    tree.nodes = vec![first; 2 * current.len() - 1];
    let mut free = tree.nodes.len();
    let (mut rounds, mut stalled) = (0, false);
    while current.len() > 1 {
        let radius = if rounds < NEAR_ROUNDS { 1 } else { RADIUS };
        let (partners, forced) = partners(&current, radius);
        stalled |= forced;
        let mut next = Vec::with_capacity(current.len());
        for (i, &node) in current.iter().enumerate() {
            let j = partners[i] as usize;
            if i == j || partners[j] as usize != i {
                next.push(node);
            } else if i < j {
                free -= 2;
                tree.nodes[free] = node;
                tree.nodes[free + 1] = current[j];
                let union = node.aabb().union(current[j].aabb());
                next.push(Bvh2Node::new(union, 0, free as u32));
            }
        }
        current = next;
        rounds += 1;
    }
    tree.nodes[0] = current[0];
    tree.max_depth = tree.max_depth.max(rounds + 1);
    Clustering { tree, stalled }
}

/// For each node the one that it would merge with, and whether the round was stalled.
fn partners(nodes: &[Bvh2Node], radius: usize) -> (Vec<u32>, bool) {
    let n = nodes.len();
    let partners: Vec<u32> = (0..n)
        .into_par_iter()
        .with_min_len(1024)
        .map(|i| {
            let mut best = (f32::INFINITY, usize::MAX, i);
            for j in i.saturating_sub(radius)..(i + radius + 1).min(n) {
                if i == j {
                    continue;
                }
                let cost = nodes[i].aabb().union(nodes[j].aabb()).half_area();
                // Both sides see a tie alike, so that equal boxes pair up.
                if cost < best.0 || (cost == best.0 && i ^ j < best.1) {
                    best = (cost, i ^ j, j);
                }
            }
            best.2 as u32
        })
        .collect();
    let pairs = (0..n)
        .filter(|&i| partners[i] as usize > i && partners[partners[i] as usize] as usize == i)
        .count();
    if n > FEW && pairs * STALLED < n {
        // Of an odd number of boxes the last stays alone.
        let next = (0..n).map(|i| (i ^ 1).min(n - 1) as u32);
        return (next.collect(), true);
    }
    (partners, false)
}

fn bounds([a, b, c]: &[Vec3; 3]) -> [Vec3; 2] {
    [a.min(*b).min(*c), a.max(*b).max(*c)]
}

/// The place of a point of `[-1, 1]` on the curve, 21 bits an axis.
fn morton(point: Vec3) -> u64 {
    let spread = |x: f32| {
        // Saturates at both ends.
        let mut v = (((x * 0.5 + 0.5) * 2_097_152.0) as u64).min(0x1f_ffff);
        v = (v | v << 32) & 0x001f_0000_0000_ffff;
        v = (v | v << 16) & 0x001f_0000_ff00_00ff;
        v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
        v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
        (v | v << 2) & 0x1249_2492_4924_9249
    };
    spread(point.x) << 2 | spread(point.y) << 1 | spread(point.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each round but those with [`FEW`] boxes leaves at most 15 of 16.
    fn most_rounds(n: usize) -> usize {
        let many = (n as f64 / FEW as f64).ln() / (16f64 / 15.0).ln();
        FEW + many.max(0.0).ceil() as usize
    }

    fn index_order(a: u32, b: u32) -> Ordering {
        a.cmp(&b)
    }

    fn flat(x: f32, size: f32) -> [Vec3; 3] {
        let corner = |dx: f32, dy: f32| Vec3::new(x + dx * size, dy * size, 0.0);
        [corner(-1.0, -1.0), corner(1.0, -1.0), corner(0.0, 1.0)]
    }

    #[test]
    fn rounds_grow_with_the_logarithm_whatever_the_triangles() {
        let n = 20_000;
        let step = |i: usize| i as f32 / n as f32;
        let rim = |i: usize| {
            let (s, c) = (std::f32::consts::TAU * step(i)).sin_cos();
            Vec3::new(c, s, 0.0)
        };
        let shapes: [(&str, Vec<[Vec3; 3]>); 5] = [
            ("coincident", vec![flat(0.0, 1.0); n]),
            ("points", vec![[Vec3::ZERO; 3]; n]),
            ("nested", (0..n).map(|i| flat(0.0, step(i))).collect()),
            (
                "fan",
                (0..n).map(|i| [Vec3::X, rim(i), rim(i + 1)]).collect(),
            ),
            ("growing", {
                let size = |i: usize| 2f32.powf(-60.0 * step(i));
                (0..n).map(|i| flat(size(i) * 0.5, size(i) * 0.5)).collect()
            }),
        ];
        for (name, triangles) in shapes {
            // Sorted by index where codes are equal: the order that is worst for nested boxes.
            let order = order(&triangles, index_order);
            assert_eq!(order.len(), n);
            let Clustering { tree, stalled } = cluster(&triangles, &order);
            assert_eq!(stalled, !matches!(name, "coincident" | "points"), "{name}");
            let bound = most_rounds(n) + 1;
            assert!(tree.max_depth <= bound, "{name}: {} levels", tree.max_depth);
            let mut seen = vec![false; n];
            for leaf in tree.nodes.iter().filter(|node| node.is_leaf()) {
                seen[leaf.first_index as usize] = true;
            }
            assert!(seen.iter().all(|s| *s), "{name}");
        }
    }

    #[test]
    fn of_equal_triangles_the_first_is_kept() {
        let triangles = vec![flat(0.5, 0.1), flat(0.0, 0.1), flat(0.5, 0.1)];
        let key = |t: u32| triangles[t as usize].map(|p| p.to_array().map(f32::to_bits));
        let mut kept = order(&triangles, |a, b| key(a).cmp(&key(b)));
        kept.sort_unstable();
        assert_eq!(kept, [0, 1]);
    }
}
