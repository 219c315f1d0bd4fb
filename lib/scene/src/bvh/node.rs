//! The two kinds of record that a ray visits: inner nodes with eight boxes, and packs of eight
//! triangles.
use glam::{Vec3, Vec3A};

pub use super::lanes::LANES;
use super::lanes::{F32x8, Row, U32x8, Words};
use super::ray::LocalRay;
use crate::triangle::TriangleHit;

/// Points to a node, or to a pack if the highest bit is set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChildRef(pub u32);

impl ChildRef {
    /// No child.
    pub const NONE: Self = Self(u32::MAX);
    const PACK: u32 = 1 << 31;

    /// The node `index`.
    pub fn node(index: usize) -> Self {
        Self(index as u32)
    }
    /// The pack `index`.
    pub fn pack(index: usize) -> Self {
        Self(index as u32 | Self::PACK)
    }
    /// Whether this is a pack.
    #[inline(always)]
    pub fn is_pack(self) -> bool {
        self.0 & Self::PACK != 0
    }
    /// Index into the nodes or the packs.
    #[inline(always)]
    pub fn index(self) -> usize {
        (self.0 & !Self::PACK) as usize
    }
}

/// The boxes of up to eight children, coordinate by coordinate: 256 bytes, four cache lines.
#[derive(Clone)]
#[repr(C, align(64))]
pub struct Node {
    /// `bounds[2 k]` holds the lower, `bounds[2 k + 1]` the upper coordinates along axis `k`.
    pub bounds: [Row; 6],
    /// What the boxes hold.
    pub children: Words,
}

impl Node {
    /// No children: boxes that nothing hits.
    pub const EMPTY: Self = Self {
        bounds: {
            let low = Row([f32::INFINITY; LANES]);
            let high = Row([f32::NEG_INFINITY; LANES]);
            [low, high, low, high, low, high]
        },
        children: Words([ChildRef::NONE.0; LANES]),
    };

    /// Child `slot`.
    #[inline(always)]
    pub fn child(&self, slot: usize) -> ChildRef {
        ChildRef(self.children.0[slot & (LANES - 1)])
    }

    /// The children, with half the area of their boxes.
    pub fn half_areas(&self) -> impl Iterator<Item = (f32, ChildRef)> {
        let extent =
            |axis: usize, i: usize| self.bounds[2 * axis + 1].0[i] - self.bounds[2 * axis].0[i];
        (0..LANES)
            .filter(move |&i| extent(0, i) >= 0.0)
            .map(move |i| {
                let (x, y, z) = (extent(0, i), extent(1, i), extent(2, i));
                (x * y + y * z + z * x, self.child(i))
            })
    }

    /// Sets child `slot`.
    pub fn set(&mut self, slot: usize, min: Vec3, max: Vec3, child: ChildRef) {
        for axis in 0..3 {
            self.bounds[2 * axis].0[slot] = min[axis];
            self.bounds[2 * axis + 1].0[slot] = max[axis];
        }
        self.children.0[slot] = child.0;
    }
}

/// A ray prepared for the box test.
///
/// `t = (b - o) / d` is evaluated as `b (1/d) - o (1/d)`, with the origin moved outwards by
/// [`LocalRay::pad`] for the near and for the far planes, which widens every box by as much at
/// no cost a box.
pub struct BoxRay {
    inverse: [F32x8; 3],
    near_origin: [F32x8; 3],
    far_origin: [F32x8; 3],
    /// Which row of [`Node::bounds`] is entered first.
    near_row: [usize; 3],
}

impl BoxRay {
    /// Prepares `ray`.
    #[inline(always)]
    pub fn new(ray: &LocalRay) -> Self {
        let pad = Vec3A::splat(ray.pad).copysign(ray.inverse);
        let splat = |v: Vec3A| [F32x8::splat(v.x), F32x8::splat(v.y), F32x8::splat(v.z)];
        Self {
            inverse: splat(ray.inverse),
            near_origin: splat((ray.origin + pad) * ray.inverse),
            far_origin: splat((ray.origin - pad) * ray.inverse),
            near_row: [0, 1, 2].map(|k| 2 * k + (ray.octant >> k & 1)),
        }
    }

    /// The children whose box is met between 0 and `t_max`, one bit each, and where.
    #[inline(always)]
    pub fn test(&self, node: &Node, t_max: F32x8) -> (u32, F32x8) {
        let plane = |row: usize| {
            debug_assert!(row < 6);
            // SAFETY: `near_row[k]` is `2 k` or `2 k + 1` by construction, and `^ 1` swaps these.
            F32x8::load(unsafe { node.bounds.get_unchecked(row) })
        };
        // The maximum with 0 and the minimum with a non-negative limit make the order of bits
        // that of floats; integer instructions answer sooner.
        let near = |k: usize| plane(self.near_row[k]).mul_sub(self.inverse[k], self.near_origin[k]);
        let far =
            |k: usize| plane(self.near_row[k] ^ 1).mul_sub(self.inverse[k], self.far_origin[k]);
        let enter = near(0)
            .max_bits(near(1))
            .max_bits(near(2).max_bits(F32x8::splat(0.0)));
        let leave = far(0).min_bits(far(1)).min_bits(far(2).min_bits(t_max));
        (!enter.gt_bits(leave).signs() & 255, enter)
    }
}

/// Up to eight triangles over at most eight vertices: 128 bytes, two cache lines.
///
/// Neighbours in a mesh share vertices, so a pack of shared vertices is less than half as
/// large as one that spells out three for every triangle, and a vertex is sheared once.
#[derive(Clone)]
#[repr(C, align(128))]
pub struct Pack {
    /// The vertices, coordinate by coordinate.
    pub vertices: [Row; 3],
    /// The triangles: vertices 0, 1, 2 in three bits each from the lowest up; the highest bit
    /// is set where there is no triangle.
    pub corners: Words,
}

impl Pack {
    /// The watertight test of triangle `lane`.
    #[inline(always)]
    pub fn intersect(&self, lane: usize, ray: &LocalRay, t_max: f32) -> Option<TriangleHit> {
        let word = self.corners.0[lane];
        let vertex = |shift: u32| {
            let i = (word >> shift) as usize & 7;
            ray.shear
                .axes
                .map(|axis| self.vertices[axis].0[i] - ray.origin[axis])
        };
        ray.shear
            .intersect([vertex(0), vertex(3), vertex(6)], t_max)
    }
}

/// Collects triangles for a [`Pack`].
#[derive(Clone)]
pub struct PackBuilder {
    vertices: [Vec3; LANES],
    vertex_count: usize,
    corners: [u32; LANES],
    triangle_count: usize,
}

impl PackBuilder {
    /// No triangles.
    pub const EMPTY: Self = Self {
        vertices: [Vec3::ZERO; LANES],
        vertex_count: 0,
        corners: [1 << 31; LANES],
        triangle_count: 0,
    };

    /// Adds a triangle; false if there is no room.
    pub fn push(&mut self, triangle: &[Vec3; 3]) -> bool {
        if self.triangle_count == LANES {
            return false;
        }
        let mut word = 0;
        for (j, vertex) in triangle.iter().enumerate() {
            let known = &self.vertices[..self.vertex_count];
            let index = known
                .iter()
                .position(|v| v == vertex)
                .unwrap_or(self.vertex_count);
            if index == LANES {
                return false;
            }
            if index == self.vertex_count {
                self.vertices[index] = *vertex;
                self.vertex_count += 1;
            }
            word |= (index as u32) << (3 * j);
        }
        self.corners[self.triangle_count] = word;
        self.triangle_count += 1;
        true
    }

    pub fn finish(&self) -> Pack {
        let row = |k: usize| Row(std::array::from_fn(|i| self.vertices[i][k]));
        Pack {
            vertices: [row(0), row(1), row(2)],
            corners: Words(self.corners),
        }
    }
}

/// A ray prepared for the triangle test.
pub struct PackRay {
    origin: [F32x8; 3],
    shear: [F32x8; 3],
    axes: [usize; 3],
}

impl PackRay {
    /// Prepares `ray`.
    #[inline(always)]
    pub fn new(ray: &LocalRay) -> Self {
        let origin = ray.origin.to_array();
        Self {
            origin: ray.shear.axes.map(|k| F32x8::splat(origin[k])),
            shear: ray.shear.factors.map(F32x8::splat),
            axes: ray.shear.axes,
        }
    }

    /// A superset of the triangles that the ray meets between 0 and `t_max`, one bit each.
    /// [`Pack::intersect`], whose arithmetic this repeats, decides.
    ///
    /// Edge functions of zero, which that one settles in f64, pass. Distances are compared
    /// vertex by vertex: a hit lies between the nearest and the farthest, however thin the
    /// triangle. Integer maxima order floats correctly, except two negative ones; of these only
    /// the sign is used.
    #[inline(always)]
    pub fn candidates(&self, pack: &Pack, t_max: F32x8) -> u32 {
        let [sx, sy, sz] = self.shear;
        let row = |k: usize| {
            let axis = self.axes[k];
            debug_assert!(axis < 3);
            // SAFETY: the axes of a `Shear` are a permutation of 0, 1, 2.
            F32x8::load(unsafe { pack.vertices.get_unchecked(axis) }).sub(self.origin[k])
        };
        let z = row(2);
        let (x, y, t) = (sx.mul_from(z, row(0)), sy.mul_from(z, row(1)), sz.mul(z));
        let corner_0 = U32x8::load(&pack.corners);
        let corner_1 = corner_0.shift_right::<3>();
        let corner_2 = corner_0.shift_right::<6>();
        let (ax, ay, at) = (x.select(corner_0), y.select(corner_0), t.select(corner_0));
        let (bx, by, bt) = (x.select(corner_1), y.select(corner_1), t.select(corner_1));
        let (cx, cy, ct) = (x.select(corner_2), y.select(corner_2), t.select(corner_2));
        let u = cx.mul(by).sub(cy.mul(bx));
        let v = ax.mul(cy).sub(ay.mul(cx));
        let w = bx.mul(ay).sub(by.mul(ax));
        let zero = F32x8::splat(0.0);
        let some_positive = u.max_bits(v).max_bits(w).gt_bits(zero);
        let some_negative = u
            .negate()
            .max_bits(v.negate())
            .max_bits(w.negate())
            .gt_bits(zero);
        let too_far = at.min_bits(bt).min_bits(ct).gt_bits(t_max);
        let behind = at.max_bits(bt).max_bits(ct);
        let rejected = some_positive
            .and(some_negative)
            .or(too_far)
            .or(behind)
            .or(F32x8::from_bits(corner_0));
        !rejected.signs() & 255
    }
}
