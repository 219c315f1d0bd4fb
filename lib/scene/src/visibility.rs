//! Why nothing of an object can be seen.
use glam::{DVec3, Vec3};

use crate::camera::Camera;
use crate::material::{AlphaMode, Material};
use crate::mesh::TriangleMesh;

/// Says why nothing of the placed `mesh` can be seen, which of its `materials` cannot, or that it is inside out; one sentence
/// each. Whether the mesh lies in the picture is not checked.
pub fn hidden(mesh: &TriangleMesh, materials: &[Material], camera: &Camera) -> Vec<String> {
    let nothing = |why: String| vec![format!("nothing of it can be seen: {why}")];
    if let Some(why) = without_extent(mesh, camera) {
        return nothing(why);
    }
    let mut used = vec![false; materials.len()];
    for &m in &mesh.materials {
        used[m as usize] = true;
    }
    let used: Vec<&Material> = materials
        .iter()
        .zip(used)
        .filter_map(|(m, used)| used.then_some(m))
        .collect();
    // Colours multiply the material's alpha.
    let most = mesh.colors.iter().map(|c| c.w).reduce(f32::max);
    let most = most.unwrap_or(1.0);
    let without: Vec<&Material> = used
        .iter()
        .copied()
        .filter(|m| is_transparent(m, most))
        .collect();
    if !used.is_empty() && without.len() == used.len() {
        return nothing(
            "its materials are fully transparent (alpha 0, in an MTL file \"d 0\")".into(),
        );
    }
    if is_all_behind(mesh, materials, camera) {
        return nothing(
            "all its triangles are single-sided and seen from behind; is the camera inside it, or is it a sheet that needs \
             both sides (doubleSided in glTF)?"
                .into(),
        );
    }
    let inside_out = is_inside_out(mesh, &used, camera).then(|| {
        "its triangles are single-sided and face inwards, so that its inner sides are seen, in the dark; turn them outwards \
         (in Blender: Mesh, Normals, Recalculate Outside), or make them double-sided (doubleSided in glTF)"
            .into()
    });
    without
        .iter()
        .map(|m| {
            format!(
                "the material \"{}\" is fully transparent (alpha 0, in an MTL file \"d 0\"): its triangles cannot be seen",
                m.name
            )
        })
        .chain(inside_out)
        .collect()
}

/// A mesh is closed if the sum of its triangles' area vectors is less than this share of their areas.
const CLOSED: f64 = 1e-3;

/// How much of what it encloses a mesh that is inside out has, at least, as a negative volume.
const INWARDS: f64 = 0.1;

/// Whether its back faces are seen.
fn has_backs(material: &Material) -> bool {
    material.double_sided || material.transmission.is_some()
}

/// Whether a closed mesh whose backs do not show turns its fronts inwards, seen from outside: from inside it may be a room.
fn is_inside_out(mesh: &TriangleMesh, used: &[&Material], camera: &Camera) -> bool {
    let Some((low, high)) = mesh.bounds() else {
        return false;
    };
    let eye = camera.position;
    if used.iter().any(|m| has_backs(m)) || (eye.cmpge(low).all() && eye.cmple(high).all()) {
        return false;
    }
    let middle = (low.as_dvec3() + high.as_dvec3()) * 0.5;
    let (mut vectors, mut areas, mut volume, mut all) = (DVec3::ZERO, 0.0, 0.0, 0.0f64);
    for (t, corners) in mesh.indices.iter().enumerate() {
        let vector = mesh.scaled_normal(t);
        let part = vector.dot(mesh.positions[corners[0] as usize].as_dvec3() - middle);
        vectors += vector;
        areas += vector.length();
        volume += part;
        all += part.abs();
    }
    vectors.length() < CLOSED * areas && volume < -INWARDS * all
}

/// Whether the camera sees the back of every triangle, and no back shows.
fn is_all_behind(mesh: &TriangleMesh, materials: &[Material], camera: &Camera) -> bool {
    let eye = camera.position.as_dvec3();
    let mut triangles = mesh.indices.iter().zip(&mesh.materials);
    !mesh.indices.is_empty()
        && triangles.all(|(corners, &material)| {
            let [a, b, c] = corners.map(|i| mesh.positions[i as usize].as_dvec3());
            let is_behind = (b - a).cross(c - a).dot(eye - a) <= 0.0;
            is_behind && !has_backs(&materials[material as usize])
        })
}

fn is_transparent(material: &Material, most_alpha: f32) -> bool {
    let alpha = material.base_color.w * most_alpha;
    match material.alpha_mode {
        AlphaMode::Opaque => false,
        AlphaMode::Mask { cutoff } => alpha < cutoff,
        AlphaMode::Blend => alpha <= 0.0,
    }
}

/// From as far as this, metres, hardly an object is meant to be less than a pixel.
const ON_A_MAP_M: f64 = 1e3;

fn without_extent(mesh: &TriangleMesh, camera: &Camera) -> Option<String> {
    let (low, high) = mesh.bounds()?;
    let (low, high) = (low.as_dvec3(), high.as_dvec3());
    let size = low.distance(high);
    if size == 0.0 {
        return Some("all its vertices lie in one point (is a scale or a matrix zero?)".into());
    }
    if (0..mesh.indices.len()).all(|t| mesh.scaled_normal(t).length_squared() == 0.0) {
        return Some("none of its triangles has an area (is a scale zero along an axis?)".into());
    }
    let pixels = below_a_pixel(mesh.bounds()?, camera)?;
    let distance = camera.position.as_dvec3().distance((low + high) * 0.5);
    if distance > ON_A_MAP_M {
        return Some(format!(
            "it lies {} km away; if its file has the coordinates of a map, write anchor = \"center\", else raise its scale",
            short(distance * 1e-3)
        ));
    }
    Some(format!(
        "it is {} m across, {} of a pixel; raise its scale, or write height_m",
        short(size),
        short(pixels)
    ))
}

/// Two digits that count, or three, with an exponent only where zeros would have to be counted.
pub(crate) fn short(value: f64) -> String {
    match value {
        0.0 => "0".into(),
        1e-3..1e-2 => format!("{value:.4}"),
        1e-2..1e-1 => format!("{value:.3}"),
        1e-1..10.0 => format!("{value:.2}"),
        10.0..1e5 => format!("{value:.0}"),
        _ => format!("{value:.1e}"),
    }
}

/// How much of a pixel a mesh of these bounds takes, if that is less than one.
pub(crate) fn below_a_pixel((low, high): (Vec3, Vec3), camera: &Camera) -> Option<f64> {
    let (low, high) = (low.as_dvec3(), high.as_dvec3());
    let size = low.distance(high);
    let distance = camera.position.as_dvec3().distance((low + high) * 0.5);
    let pixels = size * f64::from(camera.focal_px.max_element()) / distance;
    (distance > size && pixels < 1.0).then_some(pixels)
}

#[cfg(test)]
mod tests {
    use super::short;

    #[test]
    fn no_length_is_rounded_to_nothing() {
        for (value, text) in [
            (0.0, "0"),
            (0.0004, "4.0e-4"),
            (0.004, "0.0040"),
            (0.0123, "0.012"),
            (0.9, "0.90"),
            (1.8, "1.80"),
            (1800.0, "1800"),
            (8.7e15, "8.7e15"),
        ] {
            assert_eq!(short(value), text);
        }
    }
}
