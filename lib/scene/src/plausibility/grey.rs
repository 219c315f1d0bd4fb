//! Objects in colour in a photograph without.
use dipir_imaging::raster::LinearImage;
use dipir_imaging::transfer::Transfer;
use glam::{Vec3, Vec4};

use crate::material::Material;
use crate::mesh::TriangleMesh;

/// By how much the channels of a grey picture may differ, of white: two steps of 8 bits.
const NO_COLOUR: f32 = 2.0 / 255.0;

/// A sentence about a photograph without colour around objects that may have some.
pub(super) fn coloured_in_grey(
    photo: &LinearImage,
    mesh: &TriangleMesh,
    materials: &[Material],
) -> Option<String> {
    let in_colour =
        mesh.colors.iter().copied().any(has_colour) || materials.iter().any(may_have_colour);
    (in_colour && is_grey(photo)).then(|| {
        "the photograph is grey, and the objects keep their colours: for a grey picture take the colour out of the result, \
         as in magick composite.png -colorspace gray grey.png"
            .into()
    })
}

/// Whether the picture shows something, all of it grey.
fn is_grey(photo: &LinearImage) -> bool {
    let encoded = |v: f32| Transfer::Srgb.encode_scalar(v);
    let pixels = photo.0.pixels();
    let is_grey = |p: &Vec3| encoded(p.max_element()) - encoded(p.min_element()) < NO_COLOUR;
    let Some(first) = pixels.first().map(|p| encoded(p.y)) else {
        return false;
    };
    // An area of one value is no photograph.
    pixels
        .iter()
        .any(|p| (encoded(p.y) - first).abs() >= NO_COLOUR)
        && pixels.iter().all(is_grey)
}

fn has_colour(color: Vec4) -> bool {
    let rgb = color.truncate();
    rgb.max_element() - rgb.min_element() > 0.01 * rgb.max_element()
}

/// Textures are not decoded here: one is taken to have colours.
fn may_have_colour(material: &Material) -> bool {
    material.base_color_texture.is_some()
        || material.emissive_texture.is_some()
        || has_colour(material.base_color)
        || has_colour(material.emissive.extend(1.0))
}

#[cfg(test)]
mod tests {
    use dipir_imaging::raster::Raster;

    use super::*;

    fn picture(color: Vec3) -> LinearImage {
        let pixels = (0..6).map(|i| color * (i as f32 / 5.0)).collect();
        LinearImage(Raster::from_pixels(3, 2, pixels))
    }

    #[test]
    fn an_object_in_colour_in_a_grey_photograph_is_told() {
        let red = Material {
            base_color: Vec4::new(0.8, 0.1, 0.1, 1.0),
            ..Material::default()
        };
        let white = Material {
            base_color: Vec4::ONE,
            ..Material::default()
        };
        let mesh = TriangleMesh::default();
        let grey = picture(Vec3::ONE);
        let told = |photo: &LinearImage, material: &Material| {
            coloured_in_grey(photo, &mesh, std::slice::from_ref(material))
        };
        let found = told(&grey, &red).unwrap();
        assert!(found.starts_with("the photograph is grey"), "{found}");
        assert_eq!(told(&grey, &white), None);
        assert_eq!(told(&picture(Vec3::new(1.0, 0.9, 0.8)), &red), None);
        let plain = LinearImage(Raster::filled(3, 2, Vec3::splat(0.5)));
        assert_eq!(told(&plain, &red), None);
        let painted = TriangleMesh {
            colors: vec![Vec4::new(0.0, 1.0, 0.0, 1.0)],
            ..mesh.clone()
        };
        assert!(coloured_in_grey(&grey, &painted, &[]).is_some());
    }
}
