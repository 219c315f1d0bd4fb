//! The vertices of a PLY file.
use glam::DVec3;

use super::{Element, Header, Input};
use crate::cloud::{Cloud, Collector};
use crate::error::PointsError;

/// Reads `x`, `y` and `z` of all vertices.
pub(crate) fn read(bytes: &[u8]) -> Result<Cloud, PointsError> {
    let wrong = |detail| PointsError::new("PLY", detail);
    let (header, mut input) = Header::read(bytes).map_err(wrong)?;
    for element in &header.elements {
        if element.name == "vertex" {
            return Ok(Cloud {
                points: vertices(element, &mut input).map_err(wrong)?,
                viewpoint: None,
            });
        }
        for _ in 0..element.rows() {
            let mut properties = element.properties.iter();
            (properties.try_for_each(|p| p.skip(&mut input))).map_err(wrong)?;
        }
    }
    Err(wrong("it has no vertices".into()))
}

fn vertices(element: &Element, input: &mut Input) -> Result<Vec<DVec3>, String> {
    let properties = &element.properties;
    let axis = |name: &str| {
        let of_axis = |p: &super::Property| p.name == name && p.length.is_none();
        properties.iter().position(of_axis)
    };
    let axes = [axis("x"), axis("y"), axis("z")];
    if axes.contains(&None) {
        return Err("its vertices have no x, y and z".into());
    }
    let mut found = Collector::new(element.count as usize);
    for _ in 0..element.rows() {
        let mut point = DVec3::ZERO;
        for (i, property) in properties.iter().enumerate() {
            match axes.iter().position(|a| *a == Some(i)) {
                Some(k) => point[k] = input.number(property.kind)?,
                None => property.skip(input)?,
            }
        }
        found.add(point);
    }
    Ok(found.points())
}
