//! The walk of one ray through the hierarchy.
//!
//! A ray visits ten records or so, each chosen by the one before: latency and mispredicted
//! branches are the cost, not arithmetic. The nearest hit needs children in the order of their
//! distances, and sorting two or three by compare and branch beat every branch-free order that
//! was tried; any hit needs no distances, so there all children are pushed in one store, in an
//! order that depends on the octant of the direction alone.
use std::mem::MaybeUninit;

use super::lanes::{self, F32x8, LANES, U32x8};
use super::node::{BoxRay, ChildRef, Node, Pack, PackRay};
use super::ray::LocalRay;
use crate::triangle::TriangleHit;

/// Levels of nodes that a hierarchy may have; the builder keeps to it.
pub const MAX_DEPTH: usize = 48;

/// Entries that a walk may need: each level leaves at most seven siblings behind, and a vector
/// store writes eight entries wherever it ends.
pub const STACK: usize = MAX_DEPTH * (LANES - 1) + 2 * LANES;

/// Nodes, packs, and where to start.
#[derive(Clone)]
pub struct Tree {
    /// Inner nodes.
    pub nodes: Vec<Node>,
    /// Leaves.
    pub packs: Vec<Pack>,
    /// Mesh indices of the packs' triangles: apart, as only hits need them.
    pub triangles: Vec<[u32; LANES]>,
    /// [`ChildRef::NONE`] if there is nothing to hit.
    pub root: ChildRef,
}

/// Entry `i` of a stack, which must have been written.
///
/// A node leaves at most seven entries behind for each of at most [`MAX_DEPTH`] levels, so every
/// index in use is below [`STACK`]; the walks read only below their `len`, where they wrote.
#[inline(always)]
fn read<T: Copy>(stack: &[MaybeUninit<T>; STACK], i: usize) -> T {
    debug_assert!(i < STACK);
    // SAFETY: see above.
    unsafe { stack.get_unchecked(i).assume_init() }
}

/// Writes entry `i` of a stack, which must be at most its `len`; see [`read`].
#[inline(always)]
fn write<T>(stack: &mut [MaybeUninit<T>; STACK], i: usize, entry: T) {
    debug_assert!(i < STACK);
    // SAFETY: see `read`.
    unsafe { stack.get_unchecked_mut(i) }.write(entry);
}

/// For each octant of directions and each set of hit slots: the nearest slot in the highest
/// byte, the others from the lowest byte up, farthest first. A slot's bits say on which side
/// of its node it lies, so `slot ^ octant` grows with distance.
static ORDER: [[u64; 256]; 8] = {
    let mut table = [[0; 256]; 8];
    let mut octant = 0;
    while octant < 8 {
        let mut hits = 0;
        while hits < 256 {
            let mut bytes = 0u64;
            let mut n = 0;
            let mut rank = 8;
            while rank > 0 {
                rank -= 1;
                let slot = rank ^ octant;
                if hits >> slot & 1 == 1 {
                    // The last one found is the nearest: it moves to the top.
                    let farther = bytes >> 56;
                    bytes = bytes << 8 >> 8 | (slot as u64) << 56;
                    if n > 0 {
                        bytes |= farther << (8 * (n - 1));
                    }
                    n += 1;
                }
            }
            table[octant][hits] = bytes;
            hits += 1;
        }
        octant += 1;
    }
    table
};

impl Tree {
    /// The node that `child` is.
    #[inline(always)]
    fn node(&self, child: ChildRef) -> &Node {
        debug_assert!(!child.is_pack());
        // SAFETY: the builder makes references to records that exist, and a `Tree` is not
        // changed afterwards.
        unsafe { self.nodes.get_unchecked(child.index()) }
    }

    #[inline(always)]
    fn pack(&self, child: ChildRef) -> &Pack {
        debug_assert!(child.is_pack());
        // SAFETY: as above.
        unsafe { self.packs.get_unchecked(child.index()) }
    }

    /// Prefetches the memory of `child` before its visit.
    #[inline(always)]
    fn prefetch(&self, child: ChildRef) {
        if child.is_pack() {
            lanes::prefetch(&self.packs, child.index());
        } else {
            lanes::prefetch(&self.nodes, child.index());
        }
    }

    /// Mesh indices of the triangles, grouped into at most `count` neighbourhoods.
    pub fn parts(&self, count: usize) -> Vec<Vec<u32>> {
        // Half areas of boxes, and what they hold.
        let mut parts = match self.root {
            ChildRef::NONE => Vec::new(),
            root => vec![(f32::INFINITY, root)],
        };
        // The largest box is opened until no node is left that may be.
        while let Some(i) = (0..parts.len())
            .filter(|&i| !parts[i].1.is_pack() && parts.len() + LANES - 1 <= count)
            .max_by(|&i, &j| parts[i].0.total_cmp(&parts[j].0))
        {
            let (_, node) = parts.swap_remove(i);
            parts.extend(self.node(node).half_areas());
        }
        parts
            .iter()
            .map(|&(_, part)| {
                let mut ids = Vec::new();
                let mut stack = vec![part];
                while let Some(child) = stack.pop() {
                    if child.is_pack() {
                        let ids_of_pack = self.triangles[child.index()];
                        ids.extend(ids_of_pack.iter().filter(|&&id| id != u32::MAX));
                    } else {
                        stack.extend(self.node(child).half_areas().map(|(_, c)| c));
                    }
                }
                ids
            })
            .collect()
    }

    /// The nearest hit with `0 < t <= t_max` that `accept(triangle, u, v)` takes,
    /// and its triangle.
    #[inline]
    pub fn closest(
        &self,
        ray: &LocalRay,
        t_max: f32,
        accept: impl Fn(u32, f32, f32) -> bool,
    ) -> Option<(u32, TriangleHit)> {
        let box_ray = BoxRay::new(ray);
        let pack_ray = PackRay::new(ray);
        let mut limit = t_max;
        let mut limits = F32x8::splat(limit);
        let mut best = None;
        let mut stack = [const { MaybeUninit::<u64>::uninit() }; STACK];
        let mut len = 0;
        let mut current = self.root;
        if current == ChildRef::NONE {
            return None;
        }
        loop {
            if current.is_pack() {
                let pack = self.pack(current);
                let mut lanes = pack_ray.candidates(pack, limits);
                while lanes != 0 {
                    let lane = lanes.trailing_zeros() as usize;
                    lanes &= lanes - 1;
                    let Some(hit) = pack.intersect(lane, ray, limit) else {
                        continue;
                    };
                    let triangle = self.triangles[current.index()][lane];
                    if accept(triangle, hit.u, hit.v) {
                        best = Some((triangle, hit));
                        limit = hit.t;
                        limits = F32x8::splat(limit);
                    }
                }
            } else {
                let node = self.node(current);
                let (mut hits, enter) = box_ray.test(node, limits);
                if hits != 0 {
                    let first = hits.trailing_zeros() as usize;
                    hits &= hits - 1;
                    if hits == 0 {
                        current = node.child(first);
                        continue;
                    }
                    let enter = enter.to_array();
                    let entry = |slot: usize| {
                        let child = node.child(slot);
                        self.prefetch(child);
                        (enter[slot].to_bits() as u64) << 32 | child.0 as u64
                    };
                    // The nearest is visited next; the others are inserted, farthest first.
                    let mut nearest = entry(first);
                    let start = len;
                    while hits != 0 {
                        let next = entry(hits.trailing_zeros() as usize);
                        hits &= hits - 1;
                        let farther = nearest.max(next);
                        nearest = nearest.min(next);
                        let mut i = len;
                        while i > start && read(&stack, i - 1) < farther {
                            let nearer = read(&stack, i - 1);
                            write(&mut stack, i, nearer);
                            i -= 1;
                        }
                        write(&mut stack, i, farther);
                        len += 1;
                    }
                    current = ChildRef(nearest as u32);
                    continue;
                }
            }
            current = loop {
                if len == 0 {
                    return best;
                }
                len -= 1;
                let entry = read(&stack, len);
                if f32::from_bits((entry >> 32) as u32) <= limit {
                    break ChildRef(entry as u32);
                }
            };
        }
    }

    /// Whether `accept(triangle, u, v)` takes any hit with `0 < t <= t_max`.
    #[inline]
    pub fn occluded(
        &self,
        ray: &LocalRay,
        t_max: f32,
        accept: impl Fn(u32, f32, f32) -> bool,
    ) -> bool {
        let box_ray = BoxRay::new(ray);
        let pack_ray = PackRay::new(ray);
        let limits = F32x8::splat(t_max);
        let order = &ORDER[ray.octant & 7];
        let mut stack = [const { MaybeUninit::<u32>::uninit() }; STACK];
        // Popped last, it ends the walk.
        stack[0].write(ChildRef::NONE.0);
        let mut len = 1;
        let mut current = self.root;
        loop {
            if !current.is_pack() {
                debug_assert!((1..=STACK - LANES).contains(&len));
                let top = ChildRef(read(&stack, len - 1));
                let node = self.node(current);
                let (hits, _) = box_ray.test(node, limits);
                let order = order[hits as usize & 255];
                // SAFETY: `len` grows by at most seven a level, so eight more entries fit
                // (`STACK`); the cast keeps the element's size and alignment.
                let free = unsafe {
                    &mut *stack
                        .as_mut_ptr()
                        .add(len)
                        .cast::<[MaybeUninit<u32>; LANES]>()
                };
                U32x8::load(&node.children)
                    .select(U32x8::from_bytes(order))
                    .store_uninit(free);
                // All but the nearest are pushed; without hits, the top is popped.
                len = len + hits.count_ones() as usize - 1;
                let nearest = node.child((order >> 56) as usize);
                current = if hits == 0 { top } else { nearest };
                continue;
            }
            if current == ChildRef::NONE {
                return false;
            }
            let pack = self.pack(current);
            let mut lanes = pack_ray.candidates(pack, limits);
            while lanes != 0 {
                let lane = lanes.trailing_zeros() as usize;
                lanes &= lanes - 1;
                if let Some(hit) = pack.intersect(lane, ray, t_max)
                    && accept(self.triangles[current.index()][lane], hit.u, hit.v)
                {
                    return true;
                }
            }
            len -= 1;
            current = ChildRef(read(&stack, len));
        }
    }
}
