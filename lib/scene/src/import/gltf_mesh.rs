//! Mesh primitives of a glTF document.
use glam::{DMat3, DMat4, DVec3, Vec2, Vec3, Vec4};
use gltf::json::mesh::{Mode, Primitive, Semantic};
use gltf::json::validation::Checked;
use gltf::json::{Accessor, Index};

use super::accessor::{Buffers, get};
use super::document::Document;
use super::gltf::{Group, not_read};
use super::tangents;
use crate::error::Error;
use crate::material::{Material, TextureRef};
use crate::mesh::{TriangleMesh, normal_matrix};

const EXPORT: &str = "export the file again";

/// Four joints of every vertex, and their weights.
type Influences = (Vec<[usize; 4]>, Vec<[f32; 4]>);

/// Reads primitives; remembers what had to be ignored or repaired.
pub(super) struct MeshReader<'a> {
    document: &'a Document<'a>,
    buffers: &'a Buffers<'a>,
    /// By node.
    globals: &'a [Option<DMat4>],
    materials: &'a [Material],
    has_normals: bool,
    pub uses_default_material: bool,
    pub warnings: Vec<String>,
}

impl<'a> MeshReader<'a> {
    pub fn new(
        document: &'a Document<'a>,
        buffers: &'a Buffers<'a>,
        globals: &'a [Option<DMat4>],
        materials: &'a [Material],
    ) -> Self {
        let has_normals = document
            .meshes
            .iter()
            .flat_map(|m| &m.primitives)
            .any(|p| attribute(p, Semantic::Normals).is_some());
        Self {
            document,
            buffers,
            globals,
            materials,
            has_normals,
            uses_default_material: false,
            warnings: Vec::new(),
        }
    }

    /// One primitive in the coordinates that the group's transforms expect, with the attributes
    /// that its material reads. `None` if it has no triangles.
    pub fn read(&mut self, group: &Group, index: usize) -> Result<Option<TriangleMesh>, Error> {
        let primitive = &self.document.meshes[group.mesh].primitives[index];
        let at = format!("meshes[{}].primitives[{index}]", group.mesh);
        let mode = match primitive.mode {
            Checked::Valid(Mode::Points) => {
                self.undrawn("points", &at);
                return Ok(None);
            }
            Checked::Valid(Mode::Lines | Mode::LineLoop | Mode::LineStrip) => {
                self.undrawn("lines", &at);
                return Ok(None);
            }
            Checked::Valid(mode) => mode,
            Checked::Invalid => {
                let pointer = format!("/meshes/{}/primitives/{index}/mode", group.mesh);
                return Err(Error::malformed(
                    format!(
                        "{at}.mode is {}; accepted: 0 to 6",
                        self.document.quoted(&pointer)
                    ),
                    EXPORT,
                ));
            }
        };
        let Some(positions) = attribute(primitive, Semantic::Positions) else {
            self.warnings
                .push(format!("{at} has no positions and is left out"));
            return Ok(None);
        };
        let place = format!("{at}.attributes.POSITION");
        let mut extensions = primitive.extensions.iter().flat_map(|e| e.others.keys());
        if let Some(name) = extensions.find(|n| n.contains("compression")) {
            let stored = self.buffers.accessor(positions, &place)?;
            if stored.buffer_view.is_none() && stored.sparse.is_none() {
                return Err(not_read(name));
            }
            // The uncompressed copy that an optional extension promises.
            self.warnings.push(format!(
                "{at}: {name} is not read, its uncompressed copy is"
            ));
        }
        let material = self.material(primitive, &at)?;
        let mut mesh = TriangleMesh {
            positions: self
                .buffers
                .floats(positions, &place, false, Vec3::from_array)?,
            ..TriangleMesh::default()
        };
        if let Some(bad) = mesh.first_non_finite() {
            let p = mesh.positions[bad];
            return Err(Error::NotFinite {
                place,
                element: bad as u64,
                value: format!("{}, {}, {}", p.x, p.y, p.z),
            });
        }
        mesh.indices = self.triangles(primitive, mode, mesh.positions.len(), &at)?;
        if mesh.indices.is_empty() {
            return Ok(None);
        }
        mesh.normals = self.vertex_floats(
            primitive,
            Semantic::Normals,
            &at,
            &mesh,
            true,
            Vec3::from_array,
        )?;
        self.apply_morph(group, primitive, &at, &mut mesh)?;
        self.read_shading(primitive, material, &at, &mut mesh)?;
        if let Some(node) = group.shaped_by {
            self.apply_skin(node, primitive, &at, &mut mesh)?;
        }
        mesh.materials = vec![material as u32; mesh.indices.len()];
        self.complete(material, &at, &mut mesh);
        Ok(Some(mesh))
    }

    fn undrawn(&mut self, what: &str, at: &str) {
        self.warnings
            .push(format!("{at} is made of {what}, which are not drawn"));
    }

    fn material(&mut self, primitive: &Primitive, at: &str) -> Result<usize, Error> {
        match primitive.material {
            Some(m) => {
                let m = m.value();
                get(self.materials, m, &format!("{at}.material"), "materials")?;
                Ok(m)
            }
            None => {
                self.uses_default_material = true;
                Ok(self.materials.len())
            }
        }
    }

    /// A per-vertex attribute; empty if the primitive does not have it.
    fn vertex_floats<const N: usize, T>(
        &self,
        primitive: &Primitive,
        name: Semantic,
        at: &str,
        mesh: &TriangleMesh,
        normalize: bool,
        map: impl Fn([f32; N]) -> T,
    ) -> Result<Vec<T>, Error> {
        let place = format!("{at}.attributes.{}", name.to_string());
        let Some(accessor) = attribute(primitive, name) else {
            return Ok(Vec::new());
        };
        // Before anything is read: an accessor without bytes behind it may claim any length.
        let count = self.buffers.accessor(accessor, &place)?.count.0;
        same_count(&place, count, mesh.positions.len())?;
        self.buffers.floats(accessor, &place, normalize, map)
    }

    fn triangles(
        &mut self,
        primitive: &Primitive,
        mode: Mode,
        vertices: usize,
        at: &str,
    ) -> Result<Vec<[u32; 3]>, Error> {
        let indices = match primitive.indices {
            Some(accessor) => {
                let place = format!("{at}.indices");
                let indices = self.buffers.unsigned(accessor, &place)?;
                if let Some(k) = indices.iter().position(|&i| i as usize >= vertices) {
                    return Err(Error::Dangling {
                        place: format!("{place}, element {k},"),
                        index: u64::from(indices[k]),
                        count: vertices as u64,
                        things: "vertices there",
                    });
                }
                Some(indices)
            }
            None => None,
        };
        let count = indices.as_ref().map_or(vertices, Vec::len);
        let corner = |k: usize| indices.as_ref().map_or(k as u32, |i| i[k]);
        if mode == Mode::Triangles && !count.is_multiple_of(3) {
            self.warnings.push(format!(
                "{at} has {count} corners, not a multiple of 3; the last {} are left out",
                count % 3
            ));
        }
        let triangles = match mode {
            Mode::Triangles => count / 3,
            _ => count.saturating_sub(2),
        };
        let mut list: Vec<[u32; 3]> = Vec::with_capacity(triangles);
        list.extend((0..triangles).map(|t| match mode {
            Mode::Triangles => [corner(3 * t), corner(3 * t + 1), corner(3 * t + 2)],
            Mode::TriangleStrip => [corner(t), corner(t + 1 + t % 2), corner(t + 2 - t % 2)],
            _ => [corner(t + 1), corner(t + 2), corner(0)],
        }));
        // Strips are joined by triangles that name a vertex twice.
        list.retain(|[a, b, c]| a != b && b != c && c != a);
        Ok(list)
    }

    /// Adds morph targets by their default weights.
    fn apply_morph(
        &mut self,
        group: &Group,
        primitive: &Primitive,
        at: &str,
        mesh: &mut TriangleMesh,
    ) -> Result<(), Error> {
        let of_node = group
            .shaped_by
            .and_then(|n| self.document.nodes[n].weights.as_ref());
        let weights = of_node.or(self.document.meshes[group.mesh].weights.as_ref());
        for (t, target) in primitive.targets.iter().flatten().enumerate() {
            let weight = weights.and_then(|w| w.get(t)).copied().unwrap_or(0.0);
            if weight == 0.0 || !weight.is_finite() {
                continue;
            }
            for (name, accessor, values) in [
                ("POSITION", target.positions, &mut mesh.positions),
                ("NORMAL", target.normals, &mut mesh.normals),
            ] {
                let Some(accessor) = accessor.filter(|_| !values.is_empty()) else {
                    continue;
                };
                let place = format!("{at}.targets[{t}].{name}");
                let count = self.buffers.accessor(accessor, &place)?.count.0;
                same_count(&place, count, values.len())?;
                let deltas =
                    self.buffers
                        .floats(accessor, &place, name == "NORMAL", Vec3::from_array)?;
                for (value, delta) in values.iter_mut().zip(deltas) {
                    *value += weight * delta;
                }
            }
        }
        Ok(())
    }

    /// Texture coordinates, colours and tangents, as far as the material reads them.
    fn read_shading(
        &mut self,
        primitive: &Primitive,
        material: usize,
        at: &str,
        mesh: &mut TriangleMesh,
    ) -> Result<(), Error> {
        let surface = self.materials.get(material);
        let is_anisotropic = surface.is_some_and(|m| m.extensions.anisotropy.is_some());
        for set in 0..2 {
            // Where there are no tangents, the first set says which way highlights are longer.
            let name = Semantic::TexCoords(set);
            let turns = set == 0 && is_anisotropic && attribute(primitive, name.clone()).is_some();
            let used = self.material_uses(material, |t| u32::from(t.uv_set) == set);
            if !used && !turns {
                continue;
            }
            let finite = |uv| {
                let uv = Vec2::from_array(uv);
                if uv.is_finite() { uv } else { Vec2::ZERO }
            };
            let uvs = self.vertex_floats(primitive, name, at, mesh, false, finite)?;
            mesh.uvs[set as usize] = uvs;
            if mesh.uvs[set as usize].is_empty() {
                self.warnings.push(format!(
                    "{at} has no TEXCOORD_{set}, which its material reads; (0, 0) is used"
                ));
                mesh.uvs[set as usize] = vec![Vec2::ZERO; mesh.positions.len()];
            }
        }
        if let Some(accessor) = attribute(primitive, Semantic::Colors(0)) {
            self.buffers
                .accessor(accessor, &format!("{at}.attributes.COLOR_0"))?;
            let clean = |c: Vec4| {
                if c.is_finite() {
                    c.max(Vec4::ZERO)
                } else {
                    Vec4::ONE
                }
            };
            mesh.colors = if self.buffers.components(accessor)? == 3 {
                let map = |[r, g, b]: [f32; 3]| clean(Vec4::new(r, g, b, 1.0));
                self.vertex_floats(primitive, Semantic::Colors(0), at, mesh, true, map)?
            } else {
                let map = |c: [f32; 4]| clean(Vec4::from_array(c));
                self.vertex_floats(primitive, Semantic::Colors(0), at, mesh, true, map)?
            };
        }
        for set in (1..).take_while(|n| attribute(primitive, Semantic::Colors(*n)).is_some()) {
            self.warnings.push(format!(
                "{at}: COLOR_{set} is not read; only COLOR_0 is part of the surface"
            ));
        }
        if (is_anisotropic || self.normal_map(material).is_some()) && !mesh.normals.is_empty() {
            let unit = |[x, y, z, w]: [f32; 4]| {
                let direction = DVec3::new(x.into(), y.into(), z.into());
                let direction = direction.normalize_or_zero().as_vec3();
                direction.extend(if w < 0.0 { -1.0 } else { 1.0 })
            };
            mesh.tangents =
                self.vertex_floats(primitive, Semantic::Tangents, at, mesh, true, unit)?;
        }
        Ok(())
    }

    fn material_uses(&self, material: usize, wanted: impl Fn(&TextureRef) -> bool) -> bool {
        self.materials
            .get(material)
            .is_some_and(|m| m.texture_refs().any(wanted))
    }

    /// The normal map that tangents serve: the base's, else the coat's.
    fn normal_map(&self, material: usize) -> Option<TextureRef> {
        let material = self.materials.get(material)?;
        let coat = material.clearcoat.as_ref();
        material
            .normal_texture
            .or(coat.and_then(|c| c.normal_texture))
            .map(|(texture, _)| texture)
    }

    /// Poses a skinned mesh by its joints' rest transforms.
    fn apply_skin(
        &mut self,
        node: usize,
        primitive: &Primitive,
        at: &str,
        mesh: &mut TriangleMesh,
    ) -> Result<(), Error> {
        let Some(skin_index) = self.document.nodes[node].skin else {
            return Ok(());
        };
        let skin_index = skin_index.value();
        let skin_at = format!("skins[{skin_index}]");
        let skin = get(
            &self.document.skins,
            skin_index,
            &format!("nodes[{node}].skin"),
            "skins",
        )?;
        let mut joints = Vec::with_capacity(skin.joints.len());
        for &joint in &skin.joints {
            let place = format!("{skin_at}.joints");
            let global = get(self.globals, joint.value(), &place, "nodes")?;
            joints.push(global.unwrap_or(DMat4::IDENTITY));
        }
        if let Some(accessor) = skin.inverse_bind_matrices {
            let place = format!("{skin_at}.inverseBindMatrices");
            if self
                .buffers
                .accessor(accessor, &place)?
                .buffer_view
                .is_none()
            {
                return Err(Error::malformed(
                    format!("{place} refers to accessors[{accessor}], which has no bufferView"),
                    EXPORT,
                ));
            }
            let inverse = self
                .buffers
                .floats(accessor, &place, false, |m: [f32; 16]| {
                    DMat4::from_cols_array(&m.map(f64::from))
                })?;
            joints.iter_mut().zip(inverse).for_each(|(j, i)| *j *= i);
        }
        let influences = self.influences(primitive, at, mesh)?;
        if influences.is_empty() {
            self.warnings.push(format!(
                "{at} is skinned but has no joints or weights; it is left as stored"
            ));
            return Ok(());
        }
        self.warnings
            .push("skinned meshes are shown in their rest pose".to_owned());
        let mut mirrored = vec![false; mesh.positions.len()];
        for v in 0..mesh.positions.len() {
            let mut pose = DMat4::ZERO;
            let mut total = 0.0;
            for (set, (indices, weights)) in influences.iter().enumerate() {
                for (j, w) in indices[v].iter().zip(weights[v]) {
                    if w != 0.0 {
                        let place = || format!("{at}.attributes.JOINTS_{set}");
                        let joint = joints.get(*j).ok_or_else(|| Error::Dangling {
                            place: place(),
                            index: *j as u64,
                            count: joints.len() as u64,
                            things: "joints in its skin",
                        })?;
                        pose += *joint * f64::from(w);
                        total += f64::from(w);
                    }
                }
            }
            // A vertex that nothing holds stays; so does one whose pose is broken.
            if total <= 0.0 || !pose.is_finite() {
                continue;
            }
            let pose = pose * (1.0 / total);
            let linear = DMat3::from_mat4(pose);
            mirrored[v] = linear.determinant() < 0.0;
            mesh.positions[v] = pose
                .transform_point3(mesh.positions[v].as_dvec3())
                .as_vec3();
            if let Some(n) = mesh.normals.get_mut(v) {
                // Zero normals are repaired later.
                *n = normal_matrix(&linear)
                    .mul_vec3(n.as_dvec3())
                    .normalize_or_zero()
                    .as_vec3();
            }
            if let Some(t) = mesh.tangents.get_mut(v) {
                let direction = (linear * t.truncate().as_dvec3()).normalize_or_zero();
                let sign = if mirrored[v] { -t.w } else { t.w };
                *t = direction.as_vec3().extend(sign);
            }
        }
        // Fronts stay fronts, as under a node that mirrors.
        for triangle in &mut mesh.indices {
            if triangle.iter().filter(|v| mirrored[**v as usize]).count() >= 2 {
                triangle.swap(1, 2);
            }
        }
        if let Some(bad) = mesh.first_non_finite() {
            return Err(Error::NotFinite {
                place: format!("{at}.attributes.POSITION in its skin's rest pose"),
                element: bad as u64,
                value: format!("{:?}", mesh.positions[bad].to_array()),
            });
        }
        Ok(())
    }

    /// The joints of each vertex with their weights, four in each set.
    fn influences(
        &self,
        primitive: &Primitive,
        at: &str,
        mesh: &TriangleMesh,
    ) -> Result<Vec<Influences>, Error> {
        let mut sets = Vec::new();
        for set in 0.. {
            let (joints, weights) = (Semantic::Joints(set), Semantic::Weights(set));
            let index = |j: [f32; 4]| j.map(|v| v as usize);
            let joints = self.vertex_floats(primitive, joints, at, mesh, false, index)?;
            let weights = self.vertex_floats(primitive, weights, at, mesh, true, |w| w)?;
            if joints.is_empty() || weights.is_empty() {
                break;
            }
            sets.push((joints, weights));
        }
        Ok(sets)
    }

    /// Normals and tangents where the file has none or broken ones.
    fn complete(&mut self, material: usize, at: &str, mesh: &mut TriangleMesh) {
        let normal_map = self.normal_map(material);
        if mesh.normals.is_empty() {
            if self.has_normals || normal_map.is_some() {
                mesh.split_flat();
            }
        } else {
            let repaired = mesh.repair_normals();
            if repaired > 0 {
                self.warnings.push(format!(
                    "{at}: {repaired} normals were zero or not finite and are computed from the triangles"
                ));
            }
        }
        if let Some(map) = normal_map
            && mesh.tangents.is_empty()
        {
            tangents::generate(mesh, usize::from(map.uv_set), &|_| Some(map.transform));
        }
    }
}

fn same_count(place: &str, found: u64, vertices: usize) -> Result<(), Error> {
    if found == vertices as u64 {
        return Ok(());
    }
    Err(Error::malformed(
        format!("{place} has {found} elements, but there are {vertices} positions"),
        EXPORT,
    ))
}

fn attribute(primitive: &Primitive, name: Semantic) -> Option<Index<Accessor>> {
    primitive.attributes.get(&Checked::Valid(name)).copied()
}
