//! PLY files with faces or strips of triangles.
use dipir_points::ply::{Element, Header, Input, Property};
use glam::{DVec3, Vec3, Vec4};

use super::mtl::grey;
use super::obj::{self, FAR};
use super::{Imported, Limits, polygon};
use crate::error::Error;
use crate::material::AlphaMode;
use crate::mesh::TriangleMesh;

const EXPORT: &str = "export the file again";

/// Reads a PLY file from memory: positions, normals, colours (display-referred) and faces.
pub fn load_ply_bytes(bytes: &[u8], limits: &Limits) -> Result<Imported, Error> {
    let (header, mut input) = Header::read(bytes).map_err(|e| Error::malformed(e, EXPORT))?;
    let count = |name: &str| {
        let mut elements = header.elements.iter().filter(|e| e.name == name);
        match (elements.next(), elements.next()) {
            (Some(_), Some(_)) => Err(Error::malformed(
                format!("element {name} is there twice"),
                EXPORT,
            )),
            (one, _) => Ok(one.map_or(0, |e| e.count)),
        }
    };
    let vertices = count("vertex")?;
    let faces = count("face")?.saturating_add(count("tristrips")?);
    let mut properties = header.elements.iter().flat_map(|e| &e.properties);
    if faces == 0 && properties.any(|p| p.name == "f_dc_0") {
        return Err(Error::malformed(
            format!("the file holds {vertices} Gaussian splats, not a mesh"),
            "export a mesh (.glb or .obj) from the program that made it",
        ));
    }
    if faces == 0 && vertices > 0 {
        return Err(Error::malformed(
            format!("the file is a cloud of {vertices} points without faces"),
            "make a mesh of it, for instance by MeshLab's screened Poisson reconstruction",
        ));
    }
    // Points within need no triangle, but a face has one.
    limits.check_mesh(vertices, faces)?;
    let mut reader = Reader {
        mesh: TriangleMesh::default(),
        colors: Vec::new(),
        alphas: Vec::new(),
        origin: DVec3::ZERO,
        has_huge_face: false,
        limits,
    };
    for element in &header.elements {
        let layout = Layout::of(element)?;
        for row in 0..element.rows() {
            let read = match &layout {
                Layout::Vertex(slots) => reader.vertex(&element.properties, slots, &mut input),
                Layout::Face(at) => reader.face(&element.properties, *at, &mut input),
                Layout::Strips(at) => reader.strips(&element.properties, *at, &mut input),
                Layout::Other => (element.properties.iter())
                    .try_for_each(|p| p.skip(&mut input).map_err(Problem::Here)),
            };
            read.map_err(|problem| match problem {
                Problem::Here(what) => Error::malformed(
                    format!("element {} {row}: {what}", element.name),
                    "export or copy the file again",
                ),
                Problem::Limit(error) => error,
            })?;
        }
    }
    let mut imported = reader.finish()?;
    let properties = header.elements.iter().flat_map(|e| &e.properties);
    if properties
        .into_iter()
        .any(|p| COORDINATES.contains(&p.name.as_str()))
    {
        imported.warnings.push(
            "texture coordinates and textures are not read: convert it, for instance by MeshLab to a .obj or .glb file"
                .into(),
        );
    }
    let is_colored = |e: &Element| e.properties.iter().any(|p| p.name == "red");
    let mut faces = header.elements.iter().filter(|e| e.name == "face");
    if faces.any(is_colored) {
        imported.warnings.push(
            "colours of faces are not read: transfer them to vertices, for instance by MeshLab"
                .into(),
        );
    }
    Ok(imported)
}

/// Names of texture coordinates.
const COORDINATES: [&str; 5] = ["texcoord", "s", "u", "texture_u", "s1"];

/// What a property of a vertex is: position, normal and colour, three each, and alpha.
type Slots = Vec<Option<usize>>;

/// Where the alpha of a vertex is put.
const ALPHA: usize = 9;

enum Layout {
    Vertex(Slots),
    /// Which property is the list of corners.
    Face(usize),
    /// The same of strips of triangles.
    Strips(usize),
    Other,
}

impl Layout {
    fn of(element: &Element) -> Result<Self, Error> {
        let slot = |p: &Property| match p.name.as_str() {
            "x" => Some(0),
            "y" => Some(1),
            "z" => Some(2),
            "nx" => Some(3),
            "ny" => Some(4),
            "nz" => Some(5),
            "red" | "diffuse_red" => Some(6),
            "green" | "diffuse_green" => Some(7),
            "blue" | "diffuse_blue" => Some(8),
            "alpha" | "diffuse_alpha" => Some(ALPHA),
            _ => None,
        };
        let missing = |what: &str| {
            Error::malformed(format!("element {} has no {what}", element.name), EXPORT)
        };
        match element.name.as_str() {
            "vertex" => {
                let scalar = |p: &Property| slot(p).filter(|_| p.length.is_none());
                let slots: Slots = element.properties.iter().map(scalar).collect();
                match (0..3).all(|k| slots.contains(&Some(k))) {
                    true => Ok(Self::Vertex(slots)),
                    false => Err(missing("x, y and z")),
                }
            }
            name @ ("face" | "tristrips") => {
                let corners = ["vertex_indices", "vertex_index"];
                let is_corners =
                    |p: &Property| p.length.is_some() && corners.contains(&p.name.as_str());
                let at = element.properties.iter().position(is_corners);
                let at = at.ok_or_else(|| missing("list vertex_indices"))?;
                Ok(match name {
                    "face" => Self::Face(at),
                    _ => Self::Strips(at),
                })
            }
            _ => Ok(Self::Other),
        }
    }
}

enum Problem {
    Here(String),
    Limit(Error),
}

impl From<String> for Problem {
    fn from(what: String) -> Self {
        Self::Here(what)
    }
}

struct Reader<'a> {
    mesh: TriangleMesh,
    /// Display-referred, of all vertices or none.
    colors: Vec<Vec3>,
    /// Likewise.
    alphas: Vec<f32>,
    /// Where the positions' (0, 0, 0) lies in the file.
    origin: DVec3,
    /// Whether some face is concave and too large to be cut as such.
    has_huge_face: bool,
    limits: &'a Limits,
}

impl Reader<'_> {
    fn vertex(
        &mut self,
        properties: &[Property],
        slots: &[Option<usize>],
        input: &mut Input,
    ) -> Result<(), Problem> {
        let (mut values, mut exact) = ([0.0; ALPHA + 1], DVec3::ZERO);
        for (property, slot) in properties.iter().zip(slots) {
            match slot {
                Some(k) if *k < 6 => {
                    let number = input.number(property.kind)?;
                    values[*k] = number as f32;
                    if *k < 3 {
                        exact[*k] = number;
                    }
                }
                Some(k) => {
                    values[*k] = (input.number(property.kind)? / property.kind.full()) as f32;
                }
                None => property.skip(input)?,
            }
        }
        let [x, y, z, nx, ny, nz, r, g, b, alpha] = values;
        let position = Vec3::new(x, y, z);
        if !position.is_finite() {
            return Err(Problem::Here(format!(
                "the position ({x}, {y}, {z}) is not finite"
            )));
        }
        if self.mesh.positions.is_empty() && position.abs().max_element() > FAR {
            self.origin = exact;
        }
        self.mesh.positions.push((exact - self.origin).as_vec3());
        if slots.contains(&Some(3)) {
            self.mesh.normals.push(Vec3::new(nx, ny, nz));
        }
        if slots.contains(&Some(6)) {
            self.colors.push(Vec3::new(r, g, b));
        }
        if slots.contains(&Some(ALPHA)) {
            self.alphas.push(alpha);
        }
        Ok(())
    }

    fn face(
        &mut self,
        properties: &[Property],
        corners_at: usize,
        input: &mut Input,
    ) -> Result<(), Problem> {
        let mut corners: Vec<u32> = Vec::new();
        for (i, property) in properties.iter().enumerate() {
            if i != corners_at {
                property.skip(input)?;
                continue;
            }
            for _ in 0..property.length(input)? {
                corners.push(self.corner(input.number(property.kind)?)?);
            }
        }
        let more = corners.len().saturating_sub(2) + self.mesh.indices.len();
        self.limits
            .check_mesh(0, more as u64)
            .map_err(Problem::Limit)?;
        let mesh = &mut self.mesh;
        self.has_huge_face |=
            polygon::triangulate(&corners, &mesh.positions, |t| mesh.indices.push(t));
        Ok(())
    }

    fn corner(&self, index: f64) -> Result<u32, Problem> {
        let count = self.mesh.positions.len();
        match index >= 0.0 && index.fract() == 0.0 && index < count as f64 {
            true => Ok(index as u32),
            false => Err(Problem::Here(format!(
                "corner {index}, but {count} vertices stand before the faces"
            ))),
        }
    }

    /// Strips of triangles, an index of -1 between them: each corner makes one with the two before it, and every other
    /// triangle is turned around.
    fn strips(
        &mut self,
        properties: &[Property],
        corners_at: usize,
        input: &mut Input,
    ) -> Result<(), Problem> {
        for (i, property) in properties.iter().enumerate() {
            if i != corners_at {
                property.skip(input)?;
                continue;
            }
            let (mut before, mut is_turned) = ([None; 2], false);
            for _ in 0..property.length(input)? {
                let index = input.number(property.kind)?;
                if index == -1.0 {
                    (before, is_turned) = ([None; 2], false);
                    continue;
                }
                let c = self.corner(index)?;
                if let [Some(a), Some(b)] = before {
                    if a != b && b != c && c != a {
                        let triangle = if is_turned { [b, a, c] } else { [a, b, c] };
                        self.mesh.indices.push(triangle);
                    }
                    is_turned = !is_turned;
                }
                before = [before[1], Some(c)];
                let triangles = self.mesh.indices.len() as u64;
                (self.limits.check_mesh(0, triangles)).map_err(Problem::Limit)?;
            }
        }
        Ok(())
    }

    fn finish(mut self) -> Result<Imported, Error> {
        if self.mesh.indices.is_empty() {
            return Err(Error::Empty {
                remedy: "check that the file has faces of three corners or more",
            });
        }
        self.mesh.materials = vec![0; self.mesh.indices.len()];
        let mut warnings = Vec::new();
        if self.has_huge_face {
            warnings.push(polygon::TOO_LARGE.into());
        }
        if !self.mesh.normals.is_empty() {
            let repaired = self.mesh.repair_normals();
            if repaired > 0 {
                warnings.push(format!(
                    "{repaired} normals were zero or not finite and are computed from the triangles"
                ));
            }
        }
        let white = obj::white_of(self.colors.iter());
        let linear = |color: &Vec3| obj::linear(Some(*color), white);
        self.mesh.colors = self.colors.iter().map(linear).collect();
        let mut material = grey();
        if !self.mesh.colors.is_empty() {
            // The colours are those of the surface.
            material.base_color = Vec4::ONE;
        }
        let most = self.alphas.iter().copied().fold(0.0, f32::max);
        let full = if most >= 2.0 { 255.0 } else { 1.0 };
        if !self.alphas.is_empty() && most <= 0.0 {
            warnings
                .push("the alpha of all vertices is 0 and not read: the object is opaque".into());
        } else if self.alphas.iter().any(|alpha| *alpha < full) {
            self.mesh.colors.resize(self.alphas.len(), Vec4::ONE);
            for (color, alpha) in self.mesh.colors.iter_mut().zip(&self.alphas) {
                color.w = (alpha.min(full) / full).max(0.0);
            }
            material.alpha_mode = AlphaMode::Blend;
        }
        Ok(Imported {
            warnings,
            origin: self.origin,
            ..Imported::of(self.mesh, material)
        })
    }
}
