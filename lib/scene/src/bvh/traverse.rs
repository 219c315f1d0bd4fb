//! The walk of one ray through the hierarchy.
//!
//! A ray visits ten records or so, each chosen by the one before: latency and mispredicted
//! branches are the cost, not arithmetic. The nearest hit needs children in the order of their
//! distances, and sorting two or three by compare and branch beat every branch-free order that
//! was tried; any hit needs no distances, so there all children are pushed in one store, in an
//! order that depends on the octant of the direction alone.
use std::mem::MaybeUninit;

use super::lanes::{F32x8, LANES, U32x8};
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
    /// `None` if there is nothing to hit.
    pub root: Option<ChildRef>,
}

/// Children still to visit. An entry holds the distance of its box in the upper half and the
/// child in the lower, so that entries compare by distance: non-negative floats order as
/// their bits do.
struct Stack {
    entries: [MaybeUninit<u64>; STACK],
    len: usize,
}

impl Stack {
    #[inline(always)]
    fn new() -> Self {
        Self {
            entries: [const { MaybeUninit::uninit() }; STACK],
            len: 0,
        }
    }

    #[inline(always)]
    fn push(&mut self, entry: u64) {
        debug_assert!(self.len < STACK);
        // SAFETY: a node pushes at most seven entries more than it popped, and a hierarchy has
        // at most `MAX_DEPTH` levels of nodes, so `len < STACK`.
        unsafe { self.entries.get_unchecked_mut(self.len) }.write(entry);
        self.len += 1;
    }

    #[inline(always)]
    fn pop(&mut self) -> Option<u64> {
        self.len = self.len.checked_sub(1)?;
        // SAFETY: entries below the old `len` were written by `push`, and `len <= STACK`.
        Some(unsafe { self.entries.get_unchecked(self.len).assume_init() })
    }

    /// Sorts the entries from `start`, so that the nearest is popped first.
    #[inline(always)]
    fn sort_from(&mut self, start: usize) {
        // SAFETY: entries below `len` were written by `push`.
        let new = unsafe { self.entries[start..self.len].assume_init_mut() };
        for i in 1..new.len() {
            let entry = new[i];
            let mut j = i;
            while j > 0 && new[j - 1] < entry {
                new[j] = new[j - 1];
                j -= 1;
            }
            new[j] = entry;
        }
    }
}

/// For each octant of directions and each set of hit slots: those slots, farthest first, a byte
/// each. A slot's bits say on which side of its node it lies, so `slot ^ octant` grows with
/// distance.
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
                    bytes |= (slot as u64) << (8 * n);
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

    /// The nearest hit with `0 < t <= t_max` that `accept(triangle, u, v)` takes, and its
    /// triangle.
    #[inline]
    pub fn closest(
        &self,
        ray: &LocalRay,
        accept: impl Fn(u32, f32, f32) -> bool,
    ) -> Option<(u32, TriangleHit)> {
        let box_ray = BoxRay::new(ray);
        let pack_ray = PackRay::new(ray);
        let mut limit = ray.t_max;
        let mut limits = F32x8::splat(limit);
        let mut best = None;
        let mut stack = Stack::new();
        let mut current = self.root?;
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
                        (enter[slot].to_bits() as u64) << 32 | node.child(slot).0 as u64
                    };
                    let (a, b) = (entry(first), entry(hits.trailing_zeros() as usize));
                    hits &= hits - 1;
                    if hits == 0 {
                        stack.push(a.max(b));
                        current = ChildRef(a.min(b) as u32);
                        continue;
                    }
                    let start = stack.len;
                    stack.push(a);
                    stack.push(b);
                    while hits != 0 {
                        stack.push(entry(hits.trailing_zeros() as usize));
                        hits &= hits - 1;
                    }
                    stack.sort_from(start);
                }
            }
            current = loop {
                let Some(entry) = stack.pop() else {
                    return best;
                };
                if f32::from_bits((entry >> 32) as u32) <= limit {
                    break ChildRef(entry as u32);
                }
            };
        }
    }

    /// Whether `accept(triangle, u, v)` takes any hit with `0 < t <= t_max`.
    #[inline]
    pub fn occluded(&self, ray: &LocalRay, accept: impl Fn(u32, f32, f32) -> bool) -> bool {
        let Some(mut current) = self.root else {
            return false;
        };
        let box_ray = BoxRay::new(ray);
        let pack_ray = PackRay::new(ray);
        let limits = F32x8::splat(ray.t_max);
        let order = &ORDER[ray.octant & 7];
        let mut stack = [const { MaybeUninit::<u32>::uninit() }; STACK];
        let mut len = 0;
        loop {
            if current.is_pack() {
                let pack = self.pack(current);
                let mut lanes = pack_ray.candidates(pack, limits);
                while lanes != 0 {
                    let lane = lanes.trailing_zeros() as usize;
                    lanes &= lanes - 1;
                    if let Some(hit) = pack.intersect(lane, ray, ray.t_max)
                        && accept(self.triangles[current.index()][lane], hit.u, hit.v)
                    {
                        return true;
                    }
                }
            } else {
                let node = self.node(current);
                let (hits, _) = box_ray.test(node, limits);
                let order = U32x8::from_bytes(order[hits as usize & 255]);
                debug_assert!(len + LANES <= STACK);
                // SAFETY: `len` grows by at most seven a level, so eight more entries fit
                // (`STACK`); the cast keeps the element's size and alignment.
                let top =
                    unsafe { &mut *stack.as_mut_ptr().add(len).cast::<[MaybeUninit<u32>; 8]>() };
                U32x8::load(&node.children).select(order).store_uninit(top);
                len += hits.count_ones() as usize;
            }
            if len == 0 {
                return false;
            }
            len -= 1;
            // SAFETY: the stores above wrote every entry below the old `len`.
            current = ChildRef(unsafe { stack.get_unchecked(len).assume_init() });
        }
    }
}
