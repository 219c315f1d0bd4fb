//! Wavefront OBJ files.
//!
//! Read line by line, so that an error names its line; faces are cut into triangles, texture
//! coordinates are turned to glTF's convention (v down).
use std::borrow::Cow;
use std::collections::{HashMap, HashSet};

use dipir_imaging::transfer::Transfer;
use glam::{DVec3, Vec2, Vec3, Vec4};

use super::container::{self, Resolver};
use super::mtl::{self, Library};
use super::tangents;
use super::{Imported, Limits, polygon};
use crate::error::Error;
use crate::material::Material;
use crate::mesh::TriangleMesh;
use crate::texture::check_sizes;

const EXPORT: &str = "export the file again";

/// Beyond this, in the file's unit, single precision loses detail: places are kept relative to the first vertex.
pub(super) const FAR: f32 = 1e4;

/// How some programs on Windows write what is no number, `-1.#IND` or `1.#QNAN`, where a comment seems to begin.
const NOT_A_NUMBER: &str = ".#";

/// A comment in which ZBrush writes colours of vertices.
const POLYPAINT: &str = "#MRGB ";

/// Material of triangles without one; what follows it downwards are names that no library has defined yet.
const NO_MATERIAL: u32 = u32::MAX;

/// A corner of a face: indices of position, texture coordinate and normal, from 0.
type Corner = (u32, Option<u32>, Option<u32>);

/// Reads an OBJ file from memory; `resolver` finds its material libraries and their textures.
pub fn load_obj_bytes(
    bytes: &[u8],
    resolver: &dyn Resolver,
    limits: &Limits,
) -> Result<Imported, Error> {
    let mut reader = Reader {
        limits: *limits,
        ..Reader::default()
    };
    for (number, line) in logical_lines(dipir_files::without_byte_order_mark(bytes)) {
        reader
            .statement(&line, resolver)
            .map_err(|problem| match problem {
                Problem::Here(detail) => {
                    Error::malformed(format!("line {number}: {detail}"), EXPORT)
                }
                Problem::Elsewhere(error) => *error,
            })?;
    }
    reader.finish()
}

/// Lines by number, continuation lines joined. A comment ends with its line: one may end with the name of a folder, `C:\models\`.
fn logical_lines(bytes: &[u8]) -> impl Iterator<Item = (usize, Cow<'_, str>)> {
    let end = mtl::line_end(bytes);
    let mut lines = bytes.split(move |b| *b == end).enumerate();
    std::iter::from_fn(move || {
        let (number, first) = lines.next()?;
        let mut text = mtl::decoded(first);
        // Where the last line begins, the only one that is looked at: a statement may have millions.
        let mut last = 0;
        while !text[last..].contains('#') && text[last..].trim_end().ends_with('\\') {
            let joined = text.to_mut();
            joined.truncate(joined.trim_end().len() - 1);
            let Some((_, next)) = lines.next() else {
                break;
            };
            joined.push(' ');
            last = joined.len();
            joined.push_str(&mtl::decoded(next));
        }
        Some((number + 1, text))
    })
}

enum Problem {
    /// In the current line.
    Here(String),
    /// In another file, or about the whole.
    Elsewhere(Box<Error>),
}

impl From<Error> for Problem {
    fn from(error: Error) -> Self {
        Self::Elsewhere(Box::new(error))
    }
}

#[derive(Default)]
struct Reader {
    limits: Limits,
    positions: Vec<Vec3>,
    /// Display-referred, of the vertices that have one.
    colors: Vec<Option<Vec3>>,
    /// Likewise, of the vertices in their order, where it comes from comments.
    paint: Vec<Option<Vec3>>,
    uvs: Vec<Vec2>,
    normals: Vec<Vec3>,
    mesh: TriangleMesh,
    vertices: HashMap<Corner, u32>,
    corners: Vec<u32>,
    library: Library,
    /// Names of those read; naming one again adds nothing.
    libraries: HashSet<String>,
    material: Option<u32>,
    /// Names of materials that were used before a library defined them.
    undefined: Vec<String>,
    /// Where the positions' (0, 0, 0) lies in the file.
    origin: DVec3,
    /// Whether some face is concave and too large to be cut as such.
    has_huge_face: bool,
    /// Whether some corner names a texture coordinate, a normal.
    has: [bool; 2],
    warnings: Vec<String>,
}

impl Reader {
    fn statement(&mut self, line: &str, resolver: &dyn Resolver) -> Result<(), Problem> {
        if let Some(paint) = line.strip_prefix(POLYPAINT) {
            self.polypaint(paint);
        }
        let (word, mut rest) = mtl::statement(line);
        if line.contains(NOT_A_NUMBER) && ["v", "vt", "vn"].contains(&word) {
            rest = line.trim()[word.len()..].trim_start();
        }
        match word {
            "v" => self.vertex(rest)?,
            "vt" => {
                let ([u, v], _) = floats::<2>(rest, 1, "vt u v")?;
                self.uvs.push(if u.is_finite() && v.is_finite() {
                    Vec2::new(u, 1.0 - v)
                } else {
                    Vec2::ZERO
                });
            }
            "vn" => {
                let (n, _) = floats::<3>(rest, 3, "vn x y z")?;
                self.normals.push(Vec3::from_array(n));
            }
            "f" => self.face(rest)?,
            "usemtl" => self.use_material(rest),
            "mtllib" => self.read_library(mtl::unquoted(rest), resolver)?,
            "p" | "l" => self
                .warnings
                .push("points and lines are not drawn".to_owned()),
            "curv" | "curv2" | "surf" => self.warnings.push(
                "curves and free-form surfaces are not drawn: export the object as a mesh"
                    .to_owned(),
            ),
            // Objects, groups and smoothing do not matter here.
            _ => {}
        }
        Ok(())
    }

    fn vertex(&mut self, rest: &str) -> Result<(), Problem> {
        let (v, count) = floats::<7>(rest, 3, "v x y z")?;
        let position = Vec3::new(v[0], v[1], v[2]);
        if !position.is_finite() {
            return Err(Error::NotFinite {
                place: "vertices (v)".into(),
                element: self.positions.len() as u64 + 1,
                value: format!("{}, {}, {}", v[0], v[1], v[2]),
            }
            .into());
        }
        if self.positions.is_empty() && position.abs().max_element() > FAR {
            self.origin = exact(rest);
        }
        let position = match self.origin == DVec3::ZERO {
            true => position,
            false => (exact(rest) - self.origin).as_vec3(),
        };
        // Three more numbers are a colour; a single one is a weight.
        if count >= 6 {
            self.colors.resize(self.positions.len(), None);
            self.colors.push(Some(Vec3::new(v[3], v[4], v[5])));
        }
        self.positions.push(position);
        if !self.colors.is_empty() {
            self.colors.resize(self.positions.len(), None);
        }
        Ok(())
    }

    /// Eight hexadecimal digits a vertex: a mask, red, green and blue.
    fn polypaint(&mut self, digits: &str) {
        for digits in digits.trim().as_bytes().chunks_exact(8) {
            let number = std::str::from_utf8(digits).ok();
            let number = number.and_then(|n| u32::from_str_radix(n, 16).ok());
            let rgb =
                |n: u32| Vec3::from_array([16, 8, 0].map(|at| (n >> at & 255) as f32 / 255.0));
            self.paint.push(number.map(rgb));
        }
    }

    fn face(&mut self, rest: &str) -> Result<(), Problem> {
        self.corners.clear();
        for text in rest.split_ascii_whitespace() {
            let corner = self.corner(text)?;
            let next = self.vertices.len() as u32;
            let index = *self.vertices.entry(corner).or_insert(next);
            if index == next {
                self.mesh.positions.push(self.positions[corner.0 as usize]);
            }
            self.corners.push(index);
        }
        if self.corners.len() < 3 {
            let what = "faces of fewer than three corners are not drawn";
            self.warnings.push(what.to_owned());
        }
        let material = self.material.unwrap_or(NO_MATERIAL);
        let mesh = &mut self.mesh;
        self.has_huge_face |= polygon::triangulate(&self.corners, &mesh.positions, |triangle| {
            mesh.indices.push(triangle);
            mesh.materials.push(material);
        });
        self.limits.check_mesh(
            self.mesh.positions.len() as u64,
            self.mesh.indices.len() as u64,
        )?;
        Ok(())
    }

    fn corner(&mut self, text: &str) -> Result<Corner, Problem> {
        let mut parts = text.split('/');
        let position = parts.next().unwrap_or("");
        let v = index(position, self.positions.len(), "vertices (v)")?;
        let mut optional = |count: usize, things: &str, has: &mut bool| match parts.next() {
            None | Some("") => Ok(None),
            Some(text) => {
                *has = true;
                index(text, count, things).map(Some)
            }
        };
        let vt = optional(self.uvs.len(), "texture coordinates (vt)", &mut self.has[0])?;
        let vn = optional(self.normals.len(), "normals (vn)", &mut self.has[1])?;
        Ok((v, vt, vn))
    }

    fn use_material(&mut self, name: &str) {
        self.material = self.library.index_of(name).or_else(|| {
            // The library may come later.
            self.undefined.push(name.to_owned());
            Some(NO_MATERIAL - self.undefined.len() as u32)
        });
    }

    /// Gives each triangle its material. Returns whether some have none.
    fn resolve_materials(&mut self) -> bool {
        let default = self.library.materials.len() as u32;
        let find = |name: &String| {
            let found = self.library.index_of(name);
            if found.is_none() {
                let what = format!("material \"{name}\" is not defined; grey is used");
                self.warnings.push(what);
            }
            found.unwrap_or(default)
        };
        let late: Vec<u32> = self.undefined.iter().map(find).collect();
        for m in &mut self.mesh.materials {
            if *m >= default {
                let late = late.get((NO_MATERIAL - *m).wrapping_sub(1) as usize);
                *m = late.copied().unwrap_or(default);
            }
        }
        self.mesh.materials.contains(&default)
    }

    fn read_library(&mut self, name: &str, resolver: &dyn Resolver) -> Result<(), Problem> {
        if !self.libraries.insert(name.to_owned()) {
            return Ok(());
        }
        let own = name.replace('\\', "/");
        // Some exporters name it by where it lay on their machine: beside the object it is looked for, too.
        let bare = own.rsplit('/').next().unwrap_or_default();
        let found = resolver.read(&own).map(|bytes| (&*own, bytes));
        let found = found.or_else(|e| match bare == own || are_libraries(name) {
            true => Err(e),
            false => resolver.read(bare).map(|bytes| (bare, bytes)).or(Err(e)),
        });
        match found {
            Ok((name, bytes)) => {
                let path = container::named(name);
                dipir_files::refuse_utf16(&bytes).map_err(|source| Error::Read {
                    role: "the material library".into(),
                    path: path.clone(),
                    source,
                })?;
                self.library
                    .read(&bytes, name, resolver)
                    .map_err(|e| Problem::from(e.in_file(path)))
            }
            // One statement may name several; a name with blanks is tried first.
            Err(_) if are_libraries(name) => name
                .split_whitespace()
                .try_for_each(|one| self.read_library(one, resolver)),
            Err(e) => {
                let reason = container::plain_reason(&e);
                self.warnings.push(format!(
                    "material library \"{name}\" cannot be read ({reason}); grey is used"
                ));
                Ok(())
            }
        }
    }

    fn finish(mut self) -> Result<Imported, Error> {
        if self.mesh.indices.is_empty() {
            return Err(Error::Empty {
                remedy: "check that the file has faces (f)",
            });
        }
        check_sizes(&self.library.textures, &self.limits)?;
        self.library.drop_heights();
        self.library.add_opacities(&self.limits)?;
        let lacks_material = self.resolve_materials();
        let mut materials = std::mem::take(&mut self.library.materials);
        if lacks_material {
            let is_painted = !self.colors.is_empty() || !self.paint.is_empty();
            materials.push(match is_painted {
                // The colours are those of the surface.
                true => Material {
                    base_color: Vec4::ONE,
                    ..mtl::grey()
                },
                false => mtl::grey(),
            });
        }
        if self.has_huge_face {
            self.warnings.push(polygon::TOO_LARGE.into());
        }
        if self.colors.is_empty() && !self.paint.is_empty() {
            self.colors = std::mem::take(&mut self.paint);
            self.colors.resize(self.positions.len(), None);
        }
        self.gather(&materials);
        let mut warnings = self.warnings;
        warnings.append(&mut self.library.warnings);
        Imported {
            mesh: self.mesh,
            origin: self.origin,
            materials,
            textures: self.library.textures,
            lights: Vec::new(),
            warnings,
            dependencies: Vec::new(),
            missing: Vec::new(),
        }
        .checked(&self.limits)
    }

    /// Fills the attributes of the vertices that faces use.
    fn gather(&mut self, materials: &[Material]) {
        let n = self.mesh.positions.len();
        let reads_uv = materials.iter().any(|m| m.texture_refs().next().is_some());
        let normal_map = |material: u32| {
            let map = materials.get(material as usize)?.normal_texture;
            map.map(|(texture, _)| texture.transform)
        };
        if reads_uv {
            if !self.has[0] {
                self.warnings
                    .push("there are textures but no texture coordinates".to_owned());
            }
            self.mesh.uvs[0] = vec![Vec2::ZERO; n];
        }
        if self.has[1] {
            self.mesh.normals = vec![Vec3::ZERO; n];
        }
        if !self.colors.is_empty() {
            self.mesh.colors = vec![Vec4::ONE; n];
        }
        let white = white_of(self.colors.iter().flatten());
        for (&(v, vt, vn), &i) in &self.vertices {
            let i = i as usize;
            if let (Some(vt), Some(uv)) = (vt, self.mesh.uvs[0].get_mut(i)) {
                *uv = self.uvs[vt as usize];
            }
            if let (Some(vn), Some(normal)) = (vn, self.mesh.normals.get_mut(i)) {
                *normal = self.normals[vn as usize];
            }
            if let Some(color) = self.mesh.colors.get_mut(i) {
                *color = linear(self.colors[v as usize], white);
            }
        }
        if self.has[1] {
            let repaired = self.mesh.repair_normals();
            if repaired > 0 {
                self.warnings.push(format!(
                    "{repaired} normals were missing or broken and are computed from the triangles"
                ));
            }
        }
        if materials.iter().any(|m| m.normal_texture.is_some()) {
            if self.mesh.normals.is_empty() {
                self.mesh.split_flat();
            }
            tangents::generate(&mut self.mesh, 0, &normal_map);
        }
    }
}

/// What white is of display-referred colours: 1, but some tools write bytes.
pub(super) fn white_of<'a>(colors: impl Iterator<Item = &'a Vec3>) -> f32 {
    let finite = colors.filter(|c| c.is_finite());
    match finite.map(|c| c.max_element()).fold(0.0, f32::max) {
        most if most >= 2.0 => 255.0,
        _ => 1.0,
    }
}

/// A display-referred colour on a scale from 0 to `white`; white where there is none.
pub(super) fn linear(color: Option<Vec3>, white: f32) -> Vec4 {
    let decode = |x: f32| match x.is_finite() {
        true => Transfer::Srgb.decode_scalar((x / white).clamp(0.0, 1.0)),
        false => 1.0,
    };
    let color = color.unwrap_or(Vec3::splat(white));
    Vec3::from_array(color.to_array().map(decode)).extend(1.0)
}

/// Whether these are the names of several libraries.
fn are_libraries(names: &str) -> bool {
    let is_one = |name: &str| name.to_ascii_lowercase().ends_with(".mtl");
    names.contains(char::is_whitespace) && names.split_whitespace().all(is_one)
}

/// The first three numbers in double precision.
fn exact(rest: &str) -> DVec3 {
    let mut words = rest.split_ascii_whitespace();
    let mut next = || words.next().and_then(|w| w.parse().ok()).unwrap_or(0.0);
    DVec3::new(next(), next(), next())
}

/// Up to `N` numbers, at least `least`; the rest is zero. Returns how many there were.
fn floats<const N: usize>(
    rest: &str,
    least: usize,
    form: &str,
) -> Result<([f32; N], usize), Problem> {
    let mut out = [0.0; N];
    let mut count = 0;
    for text in rest.split_ascii_whitespace().take(N) {
        let number = match text.contains(NOT_A_NUMBER) {
            true => Ok(f32::NAN),
            false => text.parse(),
        };
        out[count] = number
            .map_err(|_| Problem::Here(format!("\"{text}\" is not a number; accepted: {form}")))?;
        count += 1;
    }
    if count < least {
        return Err(Problem::Here(format!("{count} numbers; accepted: {form}")));
    }
    Ok((out, count))
}

/// An index from 1, or from the end if negative, as one from 0.
fn index(text: &str, count: usize, things: &str) -> Result<u32, Problem> {
    let number: i64 = text.parse().map_err(|_| {
        Problem::Here(format!(
            "\"{text}\" is not an index; accepted: f v/vt/vn with whole numbers"
        ))
    })?;
    let from_zero = match number {
        1.. => number - 1,
        // Zero is no index in this format: it becomes `count`, which is refused.
        _ => number.saturating_add(count as i64),
    };
    match u32::try_from(from_zero) {
        Ok(i) if (i as usize) < count => Ok(i),
        _ => Err(Problem::Here(format!(
            "a face refers to {number}, but there are {count} {things} so far"
        ))),
    }
}
