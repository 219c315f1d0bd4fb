//! What objects take up whose places nothing looks for.
use std::path::Path;

use dipir_points::place::Body;
use glam::DVec3;

use crate::camera::Camera;
use crate::config::ObjectSettings;
use crate::error::Error;
use crate::import;
use crate::limits::Limits;
use crate::proxy::Proxy;
use crate::surfaces::SeenSurfaces;
use crate::undistortion::Undistortion;

/// Foot and size of every object with a place of its own; nothing if no object looks for one.
pub(crate) fn taken(
    objects: &[ObjectSettings],
    base_dir: &Path,
    limits: &Limits,
    camera: &Camera,
    proxy: &Proxy,
    surfaces: Option<&SeenSurfaces>,
    undistortion: Option<&Undistortion>,
) -> Result<Vec<(DVec3, Body)>, Error> {
    let mut taken = Vec::new();
    if objects.iter().all(|o| o.auto.is_none()) {
        return Ok(taken);
    }
    for (i, object) in objects.iter().enumerate() {
        if object.auto.is_some() {
            continue;
        }
        let key = format!("scene.objects[{i}]");
        let imported = import::load_object_within(&base_dir.join(&object.path), limits)?;
        let pixels = match undistortion {
            Some(way) => object.pixels.undistorted(way, &key)?,
            None => object.pixels,
        };
        let placement = pixels.place(&object.placement, camera, proxy, surfaces, &key)?;
        let (map, _) = placement.resolve(&imported.mesh, imported.origin, proxy, &key)?;
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for corner in &imported.mesh.positions {
            let corner = map.transform_point3(corner.as_dvec3());
            (low, high) = (low.min(corner), high.max(corner));
        }
        let extent = high - low;
        let foot = (0.5 * (low + high)).with_y(low.y);
        let body = Body {
            radius_m: 0.5 * extent.x.hypot(extent.z),
            height_m: extent.y,
        };
        taken.push((foot, body));
    }
    Ok(taken)
}
