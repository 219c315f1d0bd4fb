//! Layers of the undistorted photograph, bent back onto the photograph as it was taken.
use dipir_imaging::ImagingError;
use dipir_imaging::layers::{Layers, Precision};
use dipir_render::film::Film;
use dipir_scene::undistortion::Undistortion;
use glam::Vec3;

/// What was rendered. Where the undistorted picture shows nothing there is no object and no shadow.
pub(super) fn film(mut film: Film, way: &Undistortion) -> Film {
    film.object = way.distort(&film.object, Vec3::ZERO);
    film.alpha = way.distort(&film.alpha, 0.0);
    film.shadow = way.distort(&film.shadow, Vec3::ONE);
    film.mirrored = film.mirrored.map(|added| way.distort(&added, Vec3::ZERO));
    film
}

/// The layers that the scene stage wrote. Depths and normals are taken from the nearest pixel.
pub(super) fn gbuffer(layers: &Layers, way: &Undistortion) -> Result<Layers, ImagingError> {
    let depth = way.distort_unmixed(layers.channel("depth.Z")?, f32::INFINITY);
    let mut bent = Layers::new(depth.width(), depth.height());
    bent.insert("depth.Z", Precision::Full, depth)?;
    let normal = way.distort_unmixed(&layers.xyz("normal")?, Vec3::ZERO);
    bent.insert_xyz("normal", Precision::Half, &normal)?;
    let albedo = way.distort(&layers.rgb("albedo")?, Vec3::ZERO);
    bent.insert_rgb("albedo", Precision::Half, &albedo)?;
    Ok(bent)
}
