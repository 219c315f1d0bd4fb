//! Where objects stand that the file does not put at pixels.
use dipir_preview::arrangement::{Arrangement, Placed};
use dipir_scene::camera::Camera;
use dipir_scene::pixels::{ground_at, mesh_at};
use dipir_scene::placement::Rest;
use dipir_scene::proxy::{Plane, Proxy};
use glam::{DVec2, DVec3, Vec3};

use crate::document::Document;
use crate::edit::Edit;

/// Height over a plane up to which an object stands on it, metres: placement warns of more.
const ON_IT_M: f64 = 1e-3;

/// The ground before an edit and with it.
pub(crate) struct Grounds<'a> {
    pub(crate) before: &'a Proxy,
    pub(crate) after: &'a Proxy,
}

impl Grounds<'_> {
    /// The point that `camera` sees at `pixel`: of the ground; of a level at the object's own height where
    /// its position, not the ground, says how high it stands. `None` if neither is seen there.
    pub(crate) fn point_at(
        &self,
        camera: &Camera,
        object: &Placed,
        rest: Option<Rest>,
        pixel: DVec2,
    ) -> Option<DVec3> {
        let plane = match (self.before, self.after) {
            (_, Proxy::Mesh(mesh)) if rest != Some(Rest::Position) => {
                return mesh_at(camera, mesh, pixel);
            }
            (Proxy::Plane(before), Proxy::Plane(after)) => {
                let height = over(object.contact, before);
                match height.abs() > ON_IT_M {
                    true => shelf(camera, after, height),
                    false => *after,
                }
            }
            _ => {
                let level = Plane {
                    point: object.contact.as_vec3(),
                    normal: Vec3::Y,
                };
                shelf(camera, &level, 0.0)
            }
        };
        ground_at(camera, &plane, pixel)
    }
}

/// Keeps objects whose places were looked for where they are shown, `before`: a run would look anew where they, their
/// order or the camera changed.
pub(crate) fn keep_places(
    document: &mut Document,
    edit: &Edit,
    before: &Arrangement,
) -> anyhow::Result<()> {
    let order = edit.objects.iter().map(|o| o.of);
    let all = !order.eq(0..before.objects.len()) || edit.turn.is_some() || edit.height_m.is_some();
    for (i, object) in edit.objects.iter().enumerate() {
        let changes = all || object.yaw_deg.is_some() || object.size.is_some();
        if changes && document.is_looked_for(i)? {
            document.put_at(i, before.objects[object.of].contact)?;
        }
    }
    Ok(())
}

/// Metres from a plane to a point, along the normal.
fn over(point: DVec3, plane: &Plane) -> f64 {
    let from = point - plane.point.as_dvec3();
    plane.normal.as_dvec3().dot(from)
}

/// The parallel of a plane at a height over it, with the side in front that `camera` sees.
fn shelf(camera: &Camera, plane: &Plane, height: f64) -> Plane {
    let point = plane.point.as_dvec3() + plane.normal.as_dvec3() * height;
    let shelf = Plane {
        point: point.as_vec3(),
        normal: plane.normal,
    };
    match over(camera.position.as_dvec3(), &shelf) < 0.0 {
        true => Plane {
            normal: -shelf.normal,
            ..shelf
        },
        false => shelf,
    }
}
