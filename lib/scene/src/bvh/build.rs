//! From boxes of triangles to nodes of eight children.
//!
//! A binary hierarchy, improved by the reinsertion of obvhs, is cut into nodes of at most eight
//! children and packs of at most eight triangles at the least expected cost of a random ray, by
//! dynamic programming [Ylitie, Karras, Laine 2017, section 3.1].
use std::cmp::Ordering;

use glam::Vec3;
use obvhs::bvh2::reinsertion::ReinsertionOptimizer;

use super::cluster::{cluster, order};
use super::lanes::LANES;
use super::node::{ChildRef, Node, PackBuilder};
use super::traverse::{MAX_DEPTH, Tree};

/// What visiting a pack costs, in visits of a node: measured, the optimum is flat.
const PACK_COST: f32 = 1.0;

/// Share of the nodes that reinsertion tries to improve.
const REINSERTION: f32 = 0.05;

/// A binary hierarchy: `children` of inner nodes, else `None`.
struct Binary {
    boxes: Vec<[Vec3; 2]>,
    /// First of two adjacent children, or the primitive with [`Binary::LEAF`] set.
    links: Vec<u32>,
}

impl Binary {
    const LEAF: u32 = 1 << 31;

    fn children(&self, node: u32) -> Option<[u32; 2]> {
        let link = self.links[node as usize];
        (link & Self::LEAF == 0).then_some([link, link + 1])
    }

    /// Visits the triangles below `node` from left to right until `f` returns false; tells
    /// whether it never did.
    fn for_each_triangle(&self, node: u32, mut f: impl FnMut(u32) -> bool) -> bool {
        let mut stack = vec![node];
        while let Some(node) = stack.pop() {
            match self.children(node) {
                Some([left, right]) => stack.extend([right, left]),
                None => {
                    if !f(self.links[node as usize] & !Self::LEAF) {
                        return false;
                    }
                }
            }
        }
        true
    }

    fn half_area(&self, node: u32) -> f32 {
        let [min, max] = self.boxes[node as usize];
        let d = max - min;
        d.x * d.y + d.y * d.z + d.z * d.x
    }
}

/// Builds the tree over `triangles`, whose mesh indices are `ids`. Of those that `compare`, given
/// two indices into `triangles`, calls equal, only the first is kept.
pub fn build(
    triangles: &[[Vec3; 3]],
    ids: &[u32],
    compare: impl Fn(u32, u32) -> Ordering + Sync,
) -> Tree {
    let mut tree = Tree {
        nodes: Vec::new(),
        packs: Vec::new(),
        triangles: Vec::new(),
        root: ChildRef::NONE,
        visits: 0.0,
    };
    if triangles.is_empty() {
        return tree;
    }
    let binary = binary(triangles, compare);
    let costs = Costs::new(&binary, triangles);
    // A box without an area is met by no random ray.
    let area = binary.half_area(0);
    if area > 0.0 {
        tree.visits = costs.table[0][0] / area;
    }
    let mut emitter = Emitter {
        binary: &binary,
        costs: &costs,
        triangles,
        ids,
        tree: &mut tree,
    };
    let root = emitter.emit();
    tree.root = root;
    tree
}

fn binary(triangles: &[[Vec3; 3]], compare: impl Fn(u32, u32) -> Ordering + Sync) -> Binary {
    let clustering = cluster(triangles, &order(triangles, compare));
    let mut tree = clustering.tree;
    if !clustering.stalled {
        ReinsertionOptimizer::default().run(&mut tree, REINSERTION, None);
    }
    let corner = |p: [f32; 3]| Vec3::from_array(p);
    Binary {
        boxes: tree
            .nodes
            .iter()
            .map(|n| {
                let b = n.aabb();
                [corner(b.min.to_array()), corner(b.max.to_array())]
            })
            .collect(),
        links: tree
            .nodes
            .iter()
            .map(|n| match n.is_leaf() {
                true => n.first_index | Binary::LEAF,
                false => n.first_index,
            })
            .collect(),
    }
}

/// The least cost of making a subtree from at most `i` children of a wide node.
struct Costs {
    /// `table[n][i - 1]` for `1 <= i < 8`.
    table: Vec<[f32; LANES - 1]>,
    /// Whether the subtree fits into a pack.
    fits: Vec<bool>,
    /// Triangles below, saturating.
    counts: Vec<u32>,
}

impl Costs {
    fn new(binary: &Binary, triangles: &[[Vec3; 3]]) -> Self {
        let n = binary.links.len();
        let mut costs = Self {
            table: vec![[0.0; LANES - 1]; n],
            fits: vec![true; n],
            counts: vec![1; n],
        };
        // Parents before children; links need not be ordered after reinsertion.
        let mut order = Vec::with_capacity(n);
        let mut stack = vec![0u32];
        while let Some(node) = stack.pop() {
            order.push(node);
            stack.extend(binary.children(node).into_iter().flatten());
        }
        for &node in order.iter().rev() {
            let area = binary.half_area(node);
            let i = node as usize;
            let Some([left, right]) = binary.children(node) else {
                costs.table[i] = [area * PACK_COST; LANES - 1];
                continue;
            };
            costs.counts[i] =
                costs.counts[left as usize].saturating_add(costs.counts[right as usize]);
            let as_node = costs.split(left, right, LANES).0 + area;
            costs.fits[i] = costs.fits[left as usize]
                && costs.fits[right as usize]
                && costs.counts[i] <= LANES as u32
                && {
                    let mut pack = PackBuilder::EMPTY;
                    binary.for_each_triangle(node, |t| pack.push(&triangles[t as usize]))
                };
            costs.table[i][0] = if costs.fits[i] {
                as_node.min(area * PACK_COST)
            } else {
                as_node
            };
            for slots in 2..LANES {
                costs.table[i][slots - 1] =
                    costs.table[i][slots - 2].min(costs.split(left, right, slots).0);
            }
        }
        costs
    }

    /// The cheapest way to share `slots` between two subtrees, and the left one's share.
    fn split(&self, left: u32, right: u32, slots: usize) -> (f32, usize) {
        let (l, r) = (&self.table[left as usize], &self.table[right as usize]);
        let mut best = (f32::INFINITY, 1);
        for k in 1..slots {
            let cost = l[k - 1] + r[slots - k - 1];
            if cost < best.0 {
                best = (cost, k);
            }
        }
        best
    }

    fn is_pack(&self, binary: &Binary, node: u32) -> bool {
        let Some([left, right]) = binary.children(node) else {
            return true;
        };
        let area = binary.half_area(node);
        self.fits[node as usize] && area * PACK_COST <= self.split(left, right, LANES).0 + area
    }
}

struct Emitter<'a> {
    binary: &'a Binary,
    costs: &'a Costs,
    triangles: &'a [[Vec3; 3]],
    ids: &'a [u32],
    tree: &'a mut Tree,
}

/// What a wide node is made from.
enum Source {
    /// A node of the binary hierarchy.
    Subtree(u32),
    /// A list of triangles, where the binary hierarchy is too deep to follow.
    List(Vec<u32>),
}

impl Emitter<'_> {
    /// Levels below which lists are halved instead: eleven more hold 2 * 8^11 triangles.
    const DEEP: usize = MAX_DEPTH - 11;

    /// Writes all nodes and packs; returns the root.
    fn emit(&mut self) -> ChildRef {
        if self.costs.is_pack(self.binary, 0) {
            return self.pack(&self.list(0));
        }
        self.tree.nodes.push(Node::EMPTY);
        // Sources, their wide nodes, and their levels.
        let mut stack = vec![(Source::Subtree(0), 0, 1)];
        while let Some((source, wide, level)) = stack.pop() {
            for (slot, [min, max], child) in self.children(source, level) {
                let reference = match child {
                    Source::Subtree(n) if self.costs.is_pack(self.binary, n) => {
                        self.pack(&self.list(n))
                    }
                    // Two triangles always fit into a pack.
                    Source::List(list) if list.len() <= 2 => self.pack(&list),
                    inner => {
                        self.tree.nodes.push(Node::EMPTY);
                        let index = self.tree.nodes.len() - 1;
                        stack.push((inner, index, level + 1));
                        ChildRef::node(index)
                    }
                };
                self.tree.nodes[wide].set(slot, min, max, reference);
            }
        }
        ChildRef::node(0)
    }

    /// The children of a wide node at `level`, with their slots and boxes.
    fn children(&self, source: Source, level: usize) -> Vec<(usize, [Vec3; 2], Source)> {
        let list = match source {
            Source::Subtree(node) if level < Self::DEEP => {
                let mut children = Vec::with_capacity(LANES);
                let [left, right] = self.binary.children(node).expect("leaves are packs");
                let (_, k) = self.costs.split(left, right, LANES);
                self.gather(left, k, &mut children);
                self.gather(right, LANES - k, &mut children);
                let slots = self.assign(node, &children);
                return slots
                    .into_iter()
                    .zip(children)
                    .map(|(slot, n)| (slot, self.binary.boxes[n as usize], Source::Subtree(n)))
                    .collect();
            }
            Source::Subtree(node) => self.list(node),
            Source::List(list) => list,
        };
        list.chunks(list.len().div_ceil(LANES).max(2))
            .map(|chunk| {
                let corners = chunk.iter().flat_map(|&t| self.triangles[t as usize]);
                let (min, max) = corners.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(a, b), p| {
                    (a.min(p), b.max(p))
                });
                ([min, max], Source::List(chunk.to_vec()))
            })
            .enumerate()
            .map(|(slot, (bounds, list))| (slot, bounds, list))
            .collect()
    }

    /// The triangles below `node` from left to right.
    fn list(&self, node: u32) -> Vec<u32> {
        let mut list = Vec::new();
        self.binary.for_each_triangle(node, |t| {
            list.push(t);
            true
        });
        list
    }

    /// Gives each child the free slot whose corner of the node it is nearest to, the most
    /// decided first.
    fn assign(&self, node: u32, children: &[u32]) -> Vec<usize> {
        let centre = |n: u32| {
            let [min, max] = self.binary.boxes[n as usize];
            min + max
        };
        let middle = centre(node);
        let mut slots = vec![LANES; children.len()];
        let mut free = [true; LANES];
        for _ in 0..children.len() {
            let mut best = (f32::NEG_INFINITY, 0, 0);
            for (i, &child) in children.iter().enumerate() {
                if slots[i] != LANES {
                    continue;
                }
                let d = centre(child) - middle;
                for s in 0..LANES {
                    if !free[s] {
                        continue;
                    }
                    let sign = |bit: usize| if s >> bit & 1 == 1 { 1.0 } else { -1.0 };
                    let score = d.x * sign(0) + d.y * sign(1) + d.z * sign(2);
                    if score > best.0 {
                        best = (score, i, s);
                    }
                }
            }
            slots[best.1] = best.2;
            free[best.2] = false;
        }
        slots
    }

    /// The nodes that take the place of `node` in its parent, which has `slots` places for it.
    fn gather(&self, node: u32, slots: usize, out: &mut Vec<u32>) {
        let table = &self.costs.table[node as usize];
        // Fewer slots at the same cost mean fewer children.
        let mut slots = slots;
        while slots > 1 && table[slots - 2] <= table[slots - 1] {
            slots -= 1;
        }
        match self.binary.children(node) {
            Some([left, right]) if slots > 1 => {
                let (_, k) = self.costs.split(left, right, slots);
                self.gather(left, k, out);
                self.gather(right, slots - k, out);
            }
            _ => out.push(node),
        }
    }

    fn pack(&mut self, list: &[u32]) -> ChildRef {
        let mut pack = PackBuilder::EMPTY;
        let mut ids = [u32::MAX; LANES];
        for (id, &triangle) in ids.iter_mut().zip(list) {
            let fits = pack.push(&self.triangles[triangle as usize]);
            debug_assert!(fits);
            *id = self.ids[triangle as usize];
        }
        self.tree.packs.push(pack.finish());
        self.tree.triangles.push(ids);
        ChildRef::pack(self.tree.packs.len() - 1)
    }
}
