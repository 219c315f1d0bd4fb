//! PLY files with faces, ASCII and binary of both byte orders.
use dipir_imaging::transfer::Transfer;
use glam::{Vec3, Vec4};

use super::mtl::grey;
use super::{Imported, Limits, polygon};
use crate::error::Error;
use crate::mesh::TriangleMesh;

const EXPORT: &str = "export the file again";

/// Reads a PLY file from memory: positions, normals, colours (display-referred) and faces.
pub fn load_ply_bytes(bytes: &[u8], limits: &Limits) -> Result<Imported, Error> {
    let (header, body) = Header::read(bytes)?;
    let count = |name: &str| {
        let element = header.elements.iter().find(|e| e.name == name);
        element.map_or(0, |e| e.count)
    };
    let (vertices, faces) = (count("vertex"), count("face"));
    if faces == 0 && vertices > 0 {
        return Err(Error::malformed(
            format!("the file is a cloud of {vertices} points without faces"),
            "make a mesh of it, for instance by MeshLab's screened Poisson reconstruction",
        ));
    }
    // Points within need no triangle, but a face has one.
    limits.check_mesh(vertices, faces)?;
    let mut input = Input {
        rest: body,
        format: header.format,
    };
    let mut reader = Reader {
        mesh: TriangleMesh::default(),
        limits,
    };
    for element in &header.elements {
        // An element without properties takes no bytes, whatever its count.
        let rows = match element.properties.is_empty() {
            true => 0,
            false => element.count,
        };
        let layout = Layout::of(element)?;
        for row in 0..rows {
            let read = match &layout {
                Layout::Vertex(slots) => reader.vertex(&element.properties, slots, &mut input),
                Layout::Face(at) => reader.face(&element.properties, *at, &mut input),
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
    reader.finish()
}

#[derive(Clone, Copy)]
enum Format {
    Ascii,
    LittleEndian,
    BigEndian,
}

#[derive(Clone, Copy)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// What stands for a full colour channel.
    fn full(self) -> f64 {
        match self {
            Self::U8 => 255.0,
            Self::U16 => 65535.0,
            _ => 1.0,
        }
    }
}

struct Property {
    name: String,
    /// Of a list's length.
    length: Option<Scalar>,
    kind: Scalar,
}

impl Property {
    /// How many numbers there are.
    fn length(&self, input: &mut Input) -> Result<u64, String> {
        let Some(kind) = self.length else {
            return Ok(1);
        };
        let n = input.number(kind)?;
        match n >= 0.0 && n.fract() == 0.0 {
            true => Ok(n as u64),
            false => Err(format!("a list of {n} numbers")),
        }
    }

    fn skip(&self, input: &mut Input) -> Result<(), String> {
        for _ in 0..self.length(input)? {
            input.number(self.kind)?;
        }
        Ok(())
    }
}

struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

struct Header {
    format: Format,
    elements: Vec<Element>,
}

impl Header {
    /// The header and what follows it.
    fn read(bytes: &[u8]) -> Result<(Self, &[u8]), Error> {
        let mut rest = bytes;
        let mut format = None;
        let mut elements: Vec<Element> = Vec::new();
        for number in 1.. {
            let Some(end) = rest.iter().position(|b| *b == b'\n') else {
                return Err(Error::malformed("the header has no end_header", EXPORT));
            };
            let line = String::from_utf8_lossy(&rest[..end]).into_owned();
            rest = &rest[end + 1..];
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            let understood = match words[..] {
                ["ply"] if number == 1 => true,
                _ if number == 1 => {
                    return Err(Error::malformed("the file does not start with ply", EXPORT));
                }
                ["end_header"] => break,
                [] | ["comment" | "obj_info", ..] => true,
                ["format", kind, "1.0"] => {
                    format = match kind {
                        "ascii" => Some(Format::Ascii),
                        "binary_little_endian" => Some(Format::LittleEndian),
                        "binary_big_endian" => Some(Format::BigEndian),
                        _ => None,
                    };
                    format.is_some()
                }
                ["element", name, count] => count.parse().is_ok_and(|count| {
                    elements.push(Element {
                        name: name.into(),
                        count,
                        properties: Vec::new(),
                    });
                    true
                }),
                ["property", ..] => add_property(&words[1..], &mut elements).is_some(),
                _ => false,
            };
            if !understood {
                return Err(Error::malformed(
                    format!("line {number}: \"{}\" is not understood", line.trim()),
                    EXPORT,
                ));
            }
        }
        match format {
            Some(format) => Ok((Self { format, elements }, rest)),
            None => Err(Error::malformed("the header has no format", EXPORT)),
        }
    }
}

/// Adds the property that `words` describe to the last element.
fn add_property(words: &[&str], elements: &mut [Element]) -> Option<()> {
    let (length, kind, name) = match *words {
        ["list", length, kind, name] => (Some(Scalar::named(length)?), kind, name),
        [kind, name] => (None, kind, name),
        _ => return None,
    };
    elements.last_mut()?.properties.push(Property {
        name: name.into(),
        length,
        kind: Scalar::named(kind)?,
    });
    Some(())
}

/// The numbers behind the header.
struct Input<'a> {
    rest: &'a [u8],
    format: Format,
}

impl Input<'_> {
    fn number(&mut self, kind: Scalar) -> Result<f64, String> {
        if let Format::Ascii = self.format {
            let text = self.rest.trim_ascii_start();
            let end = text.iter().position(u8::is_ascii_whitespace);
            let (word, rest) = text.split_at(end.unwrap_or(text.len()));
            self.rest = rest;
            let word = String::from_utf8_lossy(word);
            return match word.parse() {
                Ok(number) => Ok(number),
                Err(_) if word.is_empty() => Err("the file ends here".into()),
                Err(_) => Err(format!("\"{word}\" is not a number")),
            };
        }
        Ok(match kind {
            Scalar::I8 => self.bytes(i8::from_be_bytes)?.into(),
            Scalar::U8 => self.bytes(u8::from_be_bytes)?.into(),
            Scalar::I16 => self.bytes(i16::from_be_bytes)?.into(),
            Scalar::U16 => self.bytes(u16::from_be_bytes)?.into(),
            Scalar::I32 => self.bytes(i32::from_be_bytes)?.into(),
            Scalar::U32 => self.bytes(u32::from_be_bytes)?.into(),
            Scalar::F32 => self.bytes(f32::from_be_bytes)?.into(),
            Scalar::F64 => self.bytes(f64::from_be_bytes)?,
        })
    }

    fn bytes<const N: usize, T>(&mut self, from: fn([u8; N]) -> T) -> Result<T, String> {
        let (bytes, rest) = self
            .rest
            .split_first_chunk::<N>()
            .ok_or("the file ends here")?;
        self.rest = rest;
        let mut bytes = *bytes;
        if let Format::LittleEndian = self.format {
            bytes.reverse();
        }
        Ok(from(bytes))
    }
}

/// What a property of a vertex is: position, normal and colour, three each.
type Slots = Vec<Option<usize>>;

enum Layout {
    Vertex(Slots),
    /// Which property is the list of corners.
    Face(usize),
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
            "face" => {
                let corners = ["vertex_indices", "vertex_index"];
                let is_corners =
                    |p: &Property| p.length.is_some() && corners.contains(&p.name.as_str());
                let at = element.properties.iter().position(is_corners);
                at.map(Self::Face)
                    .ok_or_else(|| missing("list vertex_indices"))
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
    limits: &'a Limits,
}

impl Reader<'_> {
    fn vertex(
        &mut self,
        properties: &[Property],
        slots: &[Option<usize>],
        input: &mut Input,
    ) -> Result<(), Problem> {
        let mut values = [0.0; 9];
        for (property, slot) in properties.iter().zip(slots) {
            match slot {
                Some(k) if *k < 6 => values[*k] = input.number(property.kind)? as f32,
                Some(k) => {
                    values[*k] = (input.number(property.kind)? / property.kind.full()) as f32;
                }
                None => property.skip(input)?,
            }
        }
        let [x, y, z, nx, ny, nz, r, g, b] = values;
        let position = Vec3::new(x, y, z);
        if !position.is_finite() {
            return Err(Problem::Here(format!(
                "the position ({x}, {y}, {z}) is not finite"
            )));
        }
        self.mesh.positions.push(position);
        if slots.contains(&Some(3)) {
            self.mesh.normals.push(Vec3::new(nx, ny, nz));
        }
        if slots.contains(&Some(6)) {
            let linear = [r, g, b].map(|c| Transfer::Srgb.decode_scalar(c.clamp(0.0, 1.0)));
            let color = Vec3::from_array(linear).extend(1.0);
            self.mesh.colors.push(match color.is_finite() {
                true => color,
                false => Vec4::ONE,
            });
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
                let index = input.number(property.kind)?;
                let count = self.mesh.positions.len();
                if !(index >= 0.0 && index.fract() == 0.0 && index < count as f64) {
                    return Err(Problem::Here(format!(
                        "corner {index}, but {count} vertices stand before the faces"
                    )));
                }
                corners.push(index as u32);
            }
        }
        let more = corners.len().saturating_sub(2) + self.mesh.indices.len();
        self.limits
            .check_mesh(0, more as u64)
            .map_err(Problem::Limit)?;
        polygon::triangulate(&corners, |t| self.mesh.indices.push(t));
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
        if !self.mesh.normals.is_empty() {
            let repaired = self.mesh.repair_normals();
            if repaired > 0 {
                warnings.push(format!(
                    "{repaired} normals were zero or not finite and are computed from the triangles"
                ));
            }
        }
        let mut material = grey();
        if !self.mesh.colors.is_empty() {
            // The colours are those of the surface.
            material.base_color = Vec4::ONE;
        }
        Ok(Imported {
            warnings,
            ..Imported::of(self.mesh, material)
        })
    }
}
