//! The vertices of PLY files, ASCII and binary.
use glam::DVec3;

use crate::cloud::{Cloud, Collector};
use crate::error::PointsError;

const FORMAT: &str = "PLY";
/// Longer headers are none.
const MOST_HEADER: usize = 1 << 16;

#[derive(Clone, Copy)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Kind {
    fn of(word: &str) -> Option<Self> {
        Some(match word {
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

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    fn value(self, bytes: &[u8], big_endian: bool) -> f64 {
        let mut b = [0; 8];
        let n = self.bytes();
        b[..n].copy_from_slice(&bytes[..n]);
        if big_endian {
            b[..n].reverse();
        }
        let [b0, b1, b2, b3, ..] = b;
        match self {
            Self::I8 => f64::from(b0 as i8),
            Self::U8 => f64::from(b0),
            Self::I16 => f64::from(i16::from_le_bytes([b0, b1])),
            Self::U16 => f64::from(u16::from_le_bytes([b0, b1])),
            Self::I32 => f64::from(i32::from_le_bytes([b0, b1, b2, b3])),
            Self::U32 => f64::from(u32::from_le_bytes([b0, b1, b2, b3])),
            Self::F32 => f64::from(f32::from_le_bytes([b0, b1, b2, b3])),
            Self::F64 => f64::from_le_bytes(b),
        }
    }
}

struct Property {
    name: String,
    kind: Kind,
    /// Of the number of values, for lists.
    count: Option<Kind>,
}

struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

fn wrong(detail: impl Into<String>) -> PointsError {
    PointsError::new(FORMAT, detail)
}

/// Reads `x`, `y` and `z` of all vertices.
pub(crate) fn read(bytes: &[u8]) -> Result<Cloud, PointsError> {
    let head = &bytes[..bytes.len().min(MOST_HEADER)];
    let end = head.windows(10).position(|w| w == b"end_header");
    let end = end.ok_or_else(|| wrong("its header has no end"))?;
    let line_end = bytes[end..].iter().position(|&b| b == b'\n');
    let body = line_end.map_or(&[][..], |n| &bytes[end + n + 1..]);
    let header = String::from_utf8_lossy(&bytes[..end]);
    let (format, elements) = elements(&header)?;
    let points = match format {
        Some(big_endian) => binary(body, &elements, big_endian)?,
        None => ascii(&String::from_utf8_lossy(body), &elements)?,
    };
    Ok(Cloud {
        points,
        viewpoint: None,
    })
}

/// Whether the body is big-endian, `None` where it is text; and what it holds.
fn elements(header: &str) -> Result<(Option<bool>, Vec<Element>), PointsError> {
    let mut format = None;
    let mut elements: Vec<Element> = Vec::new();
    for line in header.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        let bad = || wrong(format!("its header says \"{}\"", line.escape_debug()));
        match words[..] {
            ["format", "ascii", _] => format = Some(None),
            ["format", "binary_little_endian", _] => format = Some(Some(false)),
            ["format", "binary_big_endian", _] => format = Some(Some(true)),
            ["element", name, count] => elements.push(Element {
                name: name.into(),
                count: count.parse().map_err(|_| bad())?,
                properties: Vec::new(),
            }),
            ["property", ref rest @ ..] => {
                let (count, kind, name) = match *rest {
                    ["list", count, kind, name] => {
                        (Some(Kind::of(count).ok_or_else(bad)?), kind, name)
                    }
                    [kind, name] => (None, kind, name),
                    _ => return Err(bad()),
                };
                let property = Property {
                    name: name.into(),
                    kind: Kind::of(kind).ok_or_else(bad)?,
                    count,
                };
                elements
                    .last_mut()
                    .ok_or_else(bad)?
                    .properties
                    .push(property);
            }
            _ => {}
        }
    }
    Ok((format.ok_or_else(|| wrong("it names no format"))?, elements))
}

/// Calls `next` for every value of every element up to the vertices, and collects these.
fn walk(
    elements: &[Element],
    mut next: impl FnMut(Kind) -> Option<f64>,
) -> Result<Vec<DVec3>, PointsError> {
    let cut = || wrong("it is cut short");
    for element in elements {
        let axis = |p: &Property| ["x", "y", "z"].iter().position(|n| *n == p.name);
        let is_vertex = element.name == "vertex";
        if is_vertex {
            let scalars = element.properties.iter().filter(|p| p.count.is_none());
            if scalars.filter(|p| axis(p).is_some()).count() != 3 {
                return Err(wrong("its vertices have no x, y and z"));
            }
        }
        let mut found = Collector::new(element.count);
        // An element without values has no bytes that would end it.
        let count = match element.properties.is_empty() {
            true => 0,
            false => element.count,
        };
        for _ in 0..count {
            let mut point = DVec3::ZERO;
            for property in &element.properties {
                let many = match property.count {
                    Some(kind) => next(kind).ok_or_else(cut)?.max(0.0) as usize,
                    None => 1,
                };
                for _ in 0..many {
                    let value = next(property.kind).ok_or_else(cut)?;
                    if let (Some(k), None) = (axis(property), property.count) {
                        point[k] = value;
                    }
                }
            }
            if is_vertex {
                found.add(point);
            }
        }
        if is_vertex {
            return Ok(found.points());
        }
    }
    Err(wrong("it has no vertices"))
}

fn binary(body: &[u8], elements: &[Element], big: bool) -> Result<Vec<DVec3>, PointsError> {
    let mut rest = body;
    walk(elements, |kind| {
        let (value, after) = rest.split_at_checked(kind.bytes())?;
        rest = after;
        Some(kind.value(value, big))
    })
}

fn ascii(body: &str, elements: &[Element]) -> Result<Vec<DVec3>, PointsError> {
    let mut words = body.split_ascii_whitespace();
    walk(elements, |_| words.next()?.parse().ok())
}
