//! STL files, binary and ASCII. That they have no unit is said where objects are placed, [`crate::plausibility`].
use std::collections::HashMap;

use glam::{Vec3, Vec4};

use super::mtl::{grey, line_end};
use super::{Imported, Limits, obj};
use crate::error::Error;
use crate::mesh::TriangleMesh;

const EXPORT: &str = "export the file again";

/// A header of 80 bytes and the number of triangles.
const HEADER: usize = 84;

/// A normal, three corners and two bytes that may be a colour.
const RECORD: usize = 50;

/// Reads an STL file from memory. Stored normals are not used: they are those of the triangles.
pub fn load_stl_bytes(bytes: &[u8], limits: &Limits) -> Result<Imported, Error> {
    let announced = bytes
        .get(80..HEADER)
        .map(|b| u64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])));
    let mut warnings = Vec::new();
    // Writers that cannot go back leave the number 0.
    let behind = bytes.len().saturating_sub(HEADER);
    let there = (behind / RECORD) as u64;
    let announced = match announced {
        Some(0) if there > 0 && behind.is_multiple_of(RECORD) && !is_text(bytes) => {
            warnings.push(format!(
                "no triangles are announced, and the {there} for which the file has bytes are read"
            ));
            Some(there)
        }
        announced => announced,
    };
    let needed = announced.map(|n| HEADER as u64 + n * RECORD as u64);
    let mut mesh = Mesh::new(limits);
    match (announced, needed) {
        _ if is_text(bytes) => read_text(bytes, &mut mesh)?,
        (Some(n), Some(needed)) => {
            let length = bytes.len() as u64;
            if needed > length {
                return Err(Error::malformed(
                    format!(
                        "{n} triangles are announced, which take {needed} bytes, but the file has {length}"
                    ),
                    "export or copy the file again",
                ));
            }
            if needed < length {
                warnings.push(format!(
                    "the {} bytes behind the {n} triangles that the file announces are not read",
                    length - needed
                ));
            }
            limits.check_mesh(0, n)?;
            let records = bytes[HEADER..needed as usize].as_chunks::<RECORD>().0;
            let colors = Colors::of(&bytes[..HEADER], records);
            for record in records {
                let float = |at: usize| {
                    f32::from_le_bytes([record[at], record[at + 1], record[at + 2], record[at + 3]])
                };
                let corner = |k: usize| Vec3::from_array([0, 4, 8].map(|c| float(12 * k + c)));
                let color = colors.as_ref().map(|colors| colors.at(record));
                mesh.push([corner(1), corner(2), corner(3)], color)?;
            }
        }
        _ => {
            return Err(Error::malformed(
                format!(
                    "an STL file has {HEADER} bytes or more, this one {}",
                    bytes.len()
                ),
                "export or copy the file again",
            ));
        }
    }
    Ok(Imported {
        warnings,
        ..mesh.finish()?
    })
}

/// What the last two bytes of a record mean: three numbers of five bits each, display-referred, and a flag.
enum Colors {
    /// As VisCAM and SolidView write them, blue in the lowest bits: where the flag is set there is a colour.
    OfTriangles,
    /// As Magics writes them, red in the lowest bits: where the flag is set the colour is that of the whole, in the header.
    OrOfWhole(Vec3),
    /// Of the whole alone.
    OfWhole(Vec3),
}

const FLAG: u16 = 0x8000;

fn attribute(record: &[u8; RECORD]) -> u16 {
    u16::from_le_bytes([record[RECORD - 2], record[RECORD - 1]])
}

impl Colors {
    /// `None` if there are none.
    fn of(header: &[u8], records: &[[u8; RECORD]]) -> Option<Self> {
        const WHOLE: &[u8] = b"COLOR=";
        let at = header.windows(WHOLE.len()).position(|w| w == WHOLE);
        let rgb = at.and_then(|at| header[..80].get(at + WHOLE.len()..)?.first_chunk::<3>());
        match rgb {
            Some(rgb) => {
                let whole = Vec3::from_array(rgb.map(|v| f32::from(v) / 255.0));
                // Black triangles would be said so as well by who says nothing of them.
                Some(match records.iter().all(|record| attribute(record) == 0) {
                    true => Self::OfWhole(whole),
                    false => Self::OrOfWhole(whole),
                })
            }
            None => (records.iter())
                .any(|record| attribute(record) & FLAG != 0)
                .then_some(Self::OfTriangles),
        }
    }

    /// The linear colour of a triangle.
    fn at(&self, record: &[u8; RECORD]) -> Vec4 {
        let bits = attribute(record);
        let [low, middle, high] = [0, 5, 10].map(|at| f32::from(bits >> at & 31) / 31.0);
        let is_flagged = bits & FLAG != 0;
        let color = match self {
            Self::OfTriangles if !is_flagged => return grey().base_color,
            Self::OfTriangles => Vec3::new(high, middle, low),
            Self::OrOfWhole(_) if !is_flagged => Vec3::new(low, middle, high),
            Self::OrOfWhole(whole) | Self::OfWhole(whole) => *whole,
        };
        obj::linear(Some(color), 1.0)
    }
}

/// Whether the file is ASCII. Some binary files start with "solid", too, but their number of triangles is no text: a byte
/// of it is a control character unless there are 150 million.
fn is_text(bytes: &[u8]) -> bool {
    let text = dipir_files::without_byte_order_mark(bytes).trim_ascii_start();
    let begins = text
        .get(..5)
        .is_some_and(|b| b.eq_ignore_ascii_case(b"solid"));
    let mut count = bytes.get(80..HEADER).unwrap_or_default().iter();
    begins && count.all(|b| !b.is_ascii_control() || b.is_ascii_whitespace())
}

fn read_text(bytes: &[u8], mesh: &mut Mesh) -> Result<(), Error> {
    let mut corners: Vec<Vec3> = Vec::new();
    let end = line_end(bytes);
    for (i, line) in bytes.split(|b| *b == end).enumerate() {
        let line = String::from_utf8_lossy(line);
        let wrong = |what: String| Err(Error::malformed(format!("line {}: {what}", i + 1), EXPORT));
        let mut words = line.split_ascii_whitespace();
        match words.next().map(str::to_ascii_lowercase).as_deref() {
            Some("vertex") => {
                let numbers: Vec<f32> = words.map_while(|w| w.parse().ok()).collect();
                match numbers[..] {
                    [x, y, z, ..] => corners.push(Vec3::new(x, y, z)),
                    _ => return wrong("accepted: vertex x y z".into()),
                }
            }
            Some("endfacet") => {
                match corners[..] {
                    [a, b, c] => mesh.push([a, b, c], None)?,
                    _ => {
                        return wrong(format!("a facet of {} corners; accepted: 3", corners.len()));
                    }
                }
                corners.clear();
            }
            _ => {}
        }
    }
    match corners.is_empty() {
        true => Ok(()),
        false => Err(Error::malformed(
            "the file ends within a facet",
            "export or copy the file again",
        )),
    }
}

/// Collects triangles; corners at the same place, of the same colour, become one vertex.
struct Mesh<'a> {
    mesh: TriangleMesh,
    known: HashMap<([u32; 3], Option<[u32; 4]>), u32>,
    limits: &'a Limits,
}

impl<'a> Mesh<'a> {
    fn new(limits: &'a Limits) -> Self {
        Self {
            mesh: TriangleMesh::default(),
            known: HashMap::new(),
            limits,
        }
    }

    /// Every triangle or none has a colour, linear.
    fn push(&mut self, corners: [Vec3; 3], color: Option<Vec4>) -> Result<(), Error> {
        let number = self.mesh.indices.len() as u64;
        if let Some(bad) = corners.iter().find(|p| !p.is_finite()) {
            return Err(Error::NotFinite {
                place: "triangles".into(),
                element: number,
                value: format!("{}, {}, {}", bad.x, bad.y, bad.z),
            });
        }
        let indices = corners.map(|p| {
            let next = self.mesh.positions.len() as u32;
            let place = p.to_array().map(|v| (v + 0.0).to_bits());
            let key = (place, color.map(|c| c.to_array().map(f32::to_bits)));
            let index = *self.known.entry(key).or_insert(next);
            if index == next {
                self.mesh.positions.push(p);
                self.mesh.colors.extend(color);
            }
            index
        });
        self.mesh.indices.push(indices);
        self.limits.check_mesh(0, number + 1)
    }

    fn finish(mut self) -> Result<Imported, Error> {
        self.mesh
            .indices
            .retain(|[a, b, c]| a != b && b != c && c != a);
        if self.mesh.indices.is_empty() {
            return Err(Error::Empty {
                remedy: "check that the file has facets",
            });
        }
        self.mesh.materials = vec![0; self.mesh.indices.len()];
        let mut material = grey();
        if !self.mesh.colors.is_empty() {
            material.base_color = Vec4::ONE;
        }
        Ok(Imported::of(self.mesh, material))
    }
}
