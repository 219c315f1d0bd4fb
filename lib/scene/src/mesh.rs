//! Indexed triangles with their vertex attributes.
use glam::{DMat3, DMat4, DVec3, Vec2, Vec3, Vec4};

/// Triangles in world space. Every attribute is either empty or has one entry a vertex.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// Vertex positions, metres.
    pub positions: Vec<Vec3>,
    /// Three vertex indices a triangle, counter-clockwise seen from the front.
    pub indices: Vec<[u32; 3]>,
    /// Unit shading normals; empty means flat shading.
    pub normals: Vec<Vec3>,
    /// Unit tangents with the bitangent's sign in `w`; a zero tangent means "none here".
    pub tangents: Vec<Vec4>,
    /// The two texture coordinate sets, glTF convention (v down).
    pub uvs: [Vec<Vec2>; 2],
    /// Linear RGBA vertex colours that multiply the base colour.
    pub colors: Vec<Vec4>,
    /// Index of each triangle's material.
    pub materials: Vec<u32>,
}

/// The smallest and the largest coordinates of `points`, or `None` if there are none.
pub(crate) fn bounds(points: impl Iterator<Item = Vec3>) -> Option<(Vec3, Vec3)> {
    let wider = |(low, high): (Vec3, Vec3), p: (Vec3, Vec3)| (low.min(p.0), high.max(p.1));
    points.map(|p| (p, p)).reduce(wider)
}

impl TriangleMesh {
    /// The smallest and the largest coordinates of the vertices that triangles use, or `None` if
    /// there is no triangle.
    pub fn bounds(&self) -> Option<(Vec3, Vec3)> {
        bounds(self.corners())
    }

    /// The positions of all corners of all triangles.
    pub fn corners(&self) -> impl Iterator<Item = Vec3> {
        self.indices
            .iter()
            .flatten()
            .map(|&i| self.positions[i as usize])
    }

    /// The first vertex whose position is not finite, if there is one.
    pub fn first_non_finite(&self) -> Option<usize> {
        self.positions.iter().position(|p| !p.is_finite())
    }

    /// Applies an affine map in double precision. A map that mirrors also reverses the order of
    /// each triangle's vertices and the sign of the tangents, so that fronts stay fronts.
    pub fn transform(&mut self, map: &DMat4) {
        for p in &mut self.positions {
            *p = map.transform_point3(p.as_dvec3()).as_vec3();
        }
        let linear = DMat3::from_mat4(*map);
        let mirrored = linear.determinant() < 0.0;
        let for_normals = normal_matrix(&linear);
        for n in &mut self.normals {
            let mapped = (for_normals * n.as_dvec3()).normalize_or_zero().as_vec3();
            if mapped != Vec3::ZERO {
                *n = mapped;
            }
        }
        for t in &mut self.tangents {
            let mapped = (linear * t.truncate().as_dvec3()).normalize_or_zero();
            *t = mapped.as_vec3().extend(if mirrored { -t.w } else { t.w });
        }
        if mirrored {
            for triangle in &mut self.indices {
                triangle.swap(1, 2);
            }
        }
    }

    /// Adds the triangles of `other`, whose material `i` is this mesh's `i + first_material`.
    /// Where only one mesh has an attribute, the other gets neutral values. Where only one has
    /// normals, the other's triangles get vertices of their own with geometric normals.
    pub fn append(&mut self, mut other: Self, first_material: u32) {
        for m in &mut other.materials {
            *m += first_material;
        }
        if self.indices.is_empty() {
            *self = other;
            return;
        }
        if other.indices.is_empty() {
            return;
        }
        match (self.normals.is_empty(), other.normals.is_empty()) {
            (true, false) => self.split_flat(),
            (false, true) => other.split_flat(),
            _ => {}
        }
        let (n, m) = (self.positions.len(), other.positions.len());
        let base = n as u32;
        join(&mut self.tangents, other.tangents, n, m, Vec4::ZERO);
        for (mine, theirs) in self.uvs.iter_mut().zip(other.uvs) {
            join(mine, theirs, n, m, Vec2::ZERO);
        }
        join(&mut self.colors, other.colors, n, m, Vec4::ONE);
        self.normals.extend(other.normals);
        self.positions.extend(other.positions);
        self.materials.extend(other.materials);
        self.indices
            .extend(other.indices.iter().map(|t| t.map(|i| i + base)));
    }

    /// Reserves memory for so many vertices and triangles in every attribute that is in use.
    pub fn reserve(&mut self, vertices: usize, triangles: usize) {
        fn grow<T>(values: &mut Vec<T>, total: usize) {
            if !values.is_empty() {
                values.reserve_exact(total.saturating_sub(values.len()));
            }
        }
        grow(&mut self.positions, vertices);
        grow(&mut self.normals, vertices);
        grow(&mut self.tangents, vertices);
        grow(&mut self.colors, vertices);
        self.uvs.iter_mut().for_each(|uv| grow(uv, vertices));
        grow(&mut self.indices, triangles);
        grow(&mut self.materials, triangles);
    }

    /// Gives every triangle vertices of its own, with its geometric normal.
    pub fn split_flat(&mut self) {
        let order: Vec<u32> = self.indices.as_flattened().to_vec();
        fn gather<T: Copy>(values: &mut Vec<T>, order: &[u32]) {
            if !values.is_empty() {
                *values = order.iter().map(|&i| values[i as usize]).collect();
            }
        }
        gather(&mut self.positions, &order);
        gather(&mut self.tangents, &order);
        gather(&mut self.colors, &order);
        for uv in &mut self.uvs {
            gather(uv, &order);
        }
        for (i, triangle) in self.indices.iter_mut().enumerate() {
            let k = 3 * i as u32;
            *triangle = [k, k + 1, k + 2];
        }
        self.normals = (0..self.indices.len())
            .flat_map(|t| {
                let normal = self.scaled_normal(t).normalize_or(DVec3::Y).as_vec3();
                [normal; 3]
            })
            .collect();
    }

    /// The geometric normal of a triangle times twice its area, square metres.
    pub fn scaled_normal(&self, triangle: usize) -> DVec3 {
        let [a, b, c] = self.indices[triangle].map(|i| self.positions[i as usize].as_dvec3());
        (b - a).cross(c - a)
    }

    /// Brings normals to unit length. One that is zero or not finite becomes the area-weighted mean
    /// of its triangles' normals. Returns how many these were.
    pub fn repair_normals(&mut self) -> usize {
        let mut broken = 0;
        for n in &mut self.normals {
            *n = if n.is_finite() {
                n.as_dvec3().normalize_or_zero().as_vec3()
            } else {
                Vec3::ZERO
            };
            broken += usize::from(*n == Vec3::ZERO);
        }
        if broken > 0 {
            let mut sums = vec![DVec3::ZERO; self.positions.len()];
            for t in 0..self.indices.len() {
                let normal = self.scaled_normal(t);
                for i in self.indices[t] {
                    sums[i as usize] += normal;
                }
            }
            for (n, sum) in self.normals.iter_mut().zip(sums) {
                if *n == Vec3::ZERO {
                    *n = sum.normalize_or(DVec3::Y).as_vec3();
                }
            }
        }
        broken
    }
}

/// How normals change under a linear map of points, up to a positive factor. The matrix of
/// cofactors has the direction of the inverse transpose, but exists for maps that flatten, too. Its
/// sign keeps normals on the outside of mirrored objects.
pub fn normal_matrix(linear: &DMat3) -> DMat3 {
    let [x, y, z] = [linear.x_axis, linear.y_axis, linear.z_axis];
    let sign = if linear.determinant() < 0.0 {
        -1.0
    } else {
        1.0
    };
    DMat3::from_cols(y.cross(z), z.cross(x), x.cross(y)) * sign
}

/// Appends `theirs` (of `m` vertices) to `mine` (of `n`), filling whichever is absent.
fn join<T: Copy>(mine: &mut Vec<T>, theirs: Vec<T>, n: usize, m: usize, neutral: T) {
    if mine.is_empty() && theirs.is_empty() {
        return;
    }
    mine.resize(n, neutral);
    if theirs.is_empty() {
        mine.resize(n + m, neutral);
    } else {
        mine.extend(theirs);
    }
}
