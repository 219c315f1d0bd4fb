//! 3D objects, as the scene importer sees them.
use std::path::Path;

use dipir_cli::output::json_path;
use dipir_scene::import::load_object;
use dipir_scene::material::{AlphaMode, Material};
use dipir_scene::texture::decode_textures;
use glam::Vec3;
use serde_json::json;

use crate::report::{Report, Table, number};

pub(crate) fn inspect(path: &Path) -> anyhow::Result<Report> {
    let object = load_object(path)?;
    // The scene stage refuses an object with a texture that cannot be read.
    decode_textures(&object.textures, |_| true)?;
    let mesh = &object.mesh;
    let low = mesh
        .positions
        .iter()
        .copied()
        .fold(Vec3::INFINITY, Vec3::min);
    let high = mesh
        .positions
        .iter()
        .copied()
        .fold(Vec3::NEG_INFINITY, Vec3::max);
    let extent = high - low;
    let mut attributes = Vec::new();
    for (name, there) in [
        ("normals", !mesh.normals.is_empty()),
        ("tangents", !mesh.tangents.is_empty()),
        ("first uv set", !mesh.uvs[0].is_empty()),
        ("second uv set", !mesh.uvs[1].is_empty()),
        ("vertex colours", !mesh.colors.is_empty()),
    ] {
        if there {
            attributes.push(name);
        }
    }
    let mut text = format!(
        "  {} triangles, {} vertices, {} textures; {}\n  {} x {} x {} m (width, height, depth)\n",
        mesh.indices.len(),
        mesh.positions.len(),
        object.textures.len(),
        match attributes.is_empty() {
            true => "positions only".into(),
            false => attributes.join(", "),
        },
        number(extent.x.into()),
        number(extent.y.into()),
        number(extent.z.into()),
    );
    let mut counts = vec![0usize; object.materials.len()];
    for &m in &mesh.materials {
        if let Some(count) = counts.get_mut(m as usize) {
            *count += 1;
        }
    }
    let mut table = Table::new(&[
        "material",
        ">triangles",
        ">metallic",
        ">roughness",
        "features",
    ]);
    for (material, count) in object.materials.iter().zip(&counts) {
        table.row([
            match material.name.as_str() {
                "" => "(no name)".into(),
                name => name.into(),
            },
            count.to_string(),
            number(material.metallic.into()),
            number(material.roughness.into()),
            features(material).join(", "),
        ]);
    }
    text.push_str(&table.render());
    for warning in &object.warnings {
        text.push_str(&format!("  warning: {warning}\n"));
    }
    let materials: Vec<_> = object
        .materials
        .iter()
        .zip(&counts)
        .map(|(m, count)| {
            json!({
                "name": m.name, "triangles": count, "base_color": m.base_color,
                "metallic": m.metallic, "roughness": m.roughness, "features": features(m),
            })
        })
        .collect();
    Ok(Report {
        title: format!("{}: 3D object", path.display()),
        text,
        json: json!({
            "path": json_path(path), "kind": "object", "triangles": mesh.indices.len(),
            "vertices": mesh.positions.len(), "textures": object.textures.len(),
            "attributes": attributes, "min_m": low, "max_m": high, "materials": materials,
            "warnings": object.warnings,
        }),
        problems: Vec::new(),
    })
}

fn features(m: &Material) -> Vec<&'static str> {
    [
        ("base colour texture", m.base_color_texture.is_some()),
        (
            "metal-roughness texture",
            m.metallic_roughness_texture.is_some(),
        ),
        ("normal map", m.normal_texture.is_some()),
        ("emissive", m.emissive != Vec3::ZERO),
        ("alpha mask", matches!(m.alpha_mode, AlphaMode::Mask { .. })),
        ("alpha blend", m.alpha_mode == AlphaMode::Blend),
        ("double-sided", m.double_sided),
        ("clearcoat", m.clearcoat.is_some()),
        ("transmission", m.transmission.is_some()),
        ("volume", m.extensions.volume.is_some()),
        ("specular", m.extensions.specular.is_some()),
        ("sheen", m.extensions.sheen.is_some()),
        ("anisotropy", m.extensions.anisotropy.is_some()),
        ("iridescence", m.extensions.iridescence.is_some()),
        ("unlit", m.unlit),
    ]
    .into_iter()
    .filter_map(|(name, there)| there.then_some(name))
    .collect()
}

#[cfg(test)]
mod tests {
    use dipir_scene::material::{Anisotropy, MaterialExtensions};

    use super::*;

    #[test]
    fn an_extension_of_the_material_is_told() {
        let material = Material {
            extensions: MaterialExtensions {
                anisotropy: Some(Anisotropy {
                    strength: 1.0,
                    rotation_rad: 0.0,
                    texture: None,
                }),
                ..MaterialExtensions::default()
            },
            ..Material::default()
        };
        assert!(features(&material).contains(&"anisotropy"));
        assert!(!features(&Material::default()).contains(&"anisotropy"));
    }
}
