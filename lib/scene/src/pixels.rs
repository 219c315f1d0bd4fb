//! Pixels of the photograph as points of the ground.
use glam::{DQuat, DVec2, DVec3, Vec2, Vec3};

use crate::camera::Camera;
use crate::error::Error;
use crate::mesh::TriangleMesh;
use crate::placement::{Placement, Rest};
use crate::proxy::{Plane, Proxy};
use crate::surfaces::{Seen, SeenSurfaces};
use crate::undistortion::Undistortion;

/// Pixels of the upright photograph that say where an object goes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pixels {
    /// Where it stands.
    pub at: Option<Vec2>,
    /// What its +z faces.
    pub to: Option<Vec2>,
}

/// Sine of the angle between ray and plane below which they do not meet: at an eye's height the
/// ground is a thousand kilometres away.
const GRAZING: f64 = 1e-6;

/// The point of `plane` that `camera` sees at `pixel`; `None` if it sees none there, or only the
/// plane's back.
pub fn ground_at(camera: &Camera, plane: &Plane, pixel: DVec2) -> Option<DVec3> {
    let d = (pixel - camera.principal_px.as_dvec2()) / camera.focal_px.as_dvec2();
    let direction = camera.rotation.as_dmat3() * DVec3::new(d.x, -d.y, -1.0);
    let normal = plane.normal.as_dvec3();
    let descent = -normal.dot(direction);
    let height = height(camera, plane);
    let sees = height > 0.0 && descent > GRAZING * direction.length();
    sees.then(|| camera.position.as_dvec3() + height / descent * direction)
}

/// The nearest point of `mesh` that `camera` sees at `pixel`.
pub fn mesh_at(camera: &Camera, mesh: &TriangleMesh, pixel: DVec2) -> Option<DVec3> {
    let origin = camera.position.as_dvec3();
    let d = (pixel - camera.principal_px.as_dvec2()) / camera.focal_px.as_dvec2();
    let direction = camera.rotation.as_dmat3() * DVec3::new(d.x, -d.y, -1.0);
    let mut nearest: Option<f64> = None;
    for triangle in &mesh.indices {
        let [a, b, c] = triangle.map(|i| mesh.positions[i as usize].as_dvec3() - origin);
        // Signed volumes with the ray: of one sign where it passes inside.
        let volumes = [(b, c), (c, a), (a, b)].map(|(p, q)| direction.dot(p.cross(q)));
        let total: f64 = volumes.iter().sum();
        if total == 0.0 || volumes.iter().any(|v| v * total < 0.0) {
            continue;
        }
        let point = (volumes[0] * a + volumes[1] * b + volumes[2] * c) / total;
        let away = point.dot(direction) / direction.length_squared();
        if away > 0.0 && nearest.is_none_or(|n| away < n) {
            nearest = Some(away);
        }
    }
    nearest.map(|away| origin + away * direction)
}

/// The row of the plane's horizon in a column of the image, pixels; `None` if the camera looks
/// along the normal.
pub fn horizon_row(camera: &Camera, plane: &Plane, column: f64) -> Option<f64> {
    let n = camera.rotation.as_dmat3().transpose() * plane.normal.as_dvec3();
    let principal = camera.principal_px.as_dvec2();
    let focal = camera.focal_px.as_dvec2();
    let x = (column - principal.x) / focal.x;
    (n.y.abs() > 1e-9).then(|| principal.y + focal.y * (n.x * x - n.z) / n.y)
}

/// Metres from the plane to the camera, along the normal.
fn height(camera: &Camera, plane: &Plane) -> f64 {
    let from = camera.position.as_dvec3() - plane.point.as_dvec3();
    plane.normal.as_dvec3().dot(from)
}

impl Pixels {
    /// The pixels of the undistorted photograph that show what these show of a photograph whose
    /// distortion `undistortion` undoes; `key` names the object's table in messages.
    pub fn undistorted(&self, undistortion: &Undistortion, key: &str) -> Result<Self, Error> {
        let size = DVec2::from_array(undistortion.lens().size);
        let moved = |pixel: Option<Vec2>, name: &str| {
            if let Some(pixel) = pixel {
                within(pixel, size.as_vec2(), &format!("{key}.{name}"))?;
            }
            let moved = pixel.map(|p| undistortion.to_working(p.as_dvec2()).ok_or(p));
            moved.transpose().map_err(|p| Error::Config {
                key: format!("{key}.{name}"),
                value: shown(p),
                accepted: "a pixel that the lens and the undistorted picture show".into(),
            })
        };
        Ok(Self {
            at: moved(self.at, "at_pixel")?.map(|p| p.as_vec2()),
            to: moved(self.to, "to_pixel")?.map(|p| p.as_vec2()),
        })
    }

    /// `placement` with the position and the yaw that the pixels say, on the proxy or, if it rests on what is seen, on
    /// `surfaces`; `key` names the object's table in messages.
    pub fn place(
        &self,
        placement: &Placement,
        camera: &Camera,
        proxy: &Proxy,
        surfaces: Option<&SeenSurfaces>,
        key: &str,
    ) -> Result<Placement, Error> {
        let mut placed = *placement;
        let size = Vec2::from(camera.resolution.map(|n| n as f32));
        let surfaces = surfaces.filter(|_| placement.rest == Some(Rest::Surface));
        let surface = |pixel: Vec2| surfaces.and_then(|s| s.seen_at(camera, pixel));
        let up = match proxy {
            Proxy::Plane(plane) => plane.normal.as_dvec3().normalize(),
            _ => DVec3::Y,
        };
        if let Some(at) = self.at {
            let key = format!("{key}.at_pixel");
            within(at, size, &key)?;
            placed.position = match surface(at) {
                Some(found) => level(&found, up, at, &key)?,
                None => seen(camera, proxy, at, &key)?.as_vec3(),
            };
        }
        if let Some(to) = self.to {
            let key = format!("{key}.to_pixel");
            within(to, size, &key)?;
            let target = match surface(to) {
                Some(found) => found.position.as_dvec3(),
                None => seen(camera, proxy, to, &key)?,
            };
            // In the frame in which the object stands upright.
            let upright = DQuat::from_rotation_arc(DVec3::Y, up);
            let ahead = upright.inverse() * (target - placed.position.as_dvec3());
            if ahead.x.hypot(ahead.z) < 1e-6 {
                return Err(Error::Config {
                    key,
                    value: shown(to),
                    accepted: "a pixel away from where the object stands".into(),
                });
            }
            placed.yaw_rad = ahead.x.atan2(ahead.z) as f32;
        }
        Ok(placed)
    }
}

/// A surface that leans more than this carries nothing, degrees.
const MOST_LEAN_DEG: f64 = 30.0;

/// Where an object stands on a surface that is seen at `pixel`.
fn level(found: &Seen, up: DVec3, pixel: Vec2, key: &str) -> Result<Vec3, Error> {
    let lean = up.dot(found.normal.as_dvec3()).clamp(-1.0, 1.0).acos();
    match lean.to_degrees() {
        lean if lean <= MOST_LEAN_DEG => Ok(found.position),
        lean => Err(Error::Config {
            key: key.into(),
            value: format!(
                "{}, where by scene.depth something is seen that leans {lean:.0} degrees",
                shown(pixel)
            ),
            accepted: "a pixel of something level, as a table's top; without rest = \"surface\" the object stands on the \
                       ground"
                .into(),
        }),
    }
}

/// Refuses pixels outside of a picture of `size` pixels.
fn within(pixel: Vec2, size: Vec2, key: &str) -> Result<(), Error> {
    match pixel.cmpge(Vec2::ZERO).all() && pixel.cmple(size).all() {
        true => Ok(()),
        false => Err(Error::Config {
            key: key.into(),
            value: shown(pixel),
            accepted: format!(
                "a pixel of the photograph, [0, 0] to {}; `position` also places what is outside of it",
                shown(size)
            ),
        }),
    }
}

fn shown(pixel: Vec2) -> String {
    format!("[{:?}, {:?}]", pixel.x, pixel.y)
}

/// The point of the proxy that is seen at `pixel`.
pub(crate) fn seen(camera: &Camera, proxy: &Proxy, pixel: Vec2, key: &str) -> Result<DVec3, Error> {
    if let Proxy::Mesh(mesh) = proxy {
        return mesh_at(camera, mesh, pixel.as_dvec2()).ok_or_else(|| Error::Config {
            key: key.into(),
            value: format!("{}, where the proxy's mesh is not seen", shown(pixel)),
            accepted: "a pixel that sees the mesh of scene.proxy".into(),
        });
    }
    let Proxy::Plane(plane) = proxy else {
        return Err(Error::Missing {
            key: "scene.proxy.plane".into(),
            remedy: format!(
                "{key} is a point of it: write plane = {{ point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }}"
            ),
        });
    };
    if let Some(point) = ground_at(camera, plane, pixel.as_dvec2()) {
        return Ok(point);
    }
    let height = height(camera, plane);
    let accepted = match horizon_row(camera, plane, pixel.x.into()) {
        _ if height <= 0.0 => format!(
            "a pixel of the plane's front, which the camera is {:.3} m behind: raise scene.camera.position",
            -height
        ),
        Some(row) => {
            let n = camera.rotation.as_dmat3().transpose() * plane.normal.as_dvec3();
            let side = if n.y > 0.0 { "below" } else { "above" };
            format!("a pixel {side} the horizon, which is at row {row:.1} in this column")
        }
        None => "a pixel that sees the plane of scene.proxy".into(),
    };
    Err(Error::Config {
        key: key.into(),
        value: format!("{}, where no ground is seen", shown(pixel)),
        accepted,
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use dipir_imaging::raster::Raster;

    use super::*;
    use crate::camera::FieldOfView;
    use crate::placement::{Anchor, Size};

    const GROUND: Plane = Plane {
        point: Vec3::ZERO,
        normal: Vec3::Y,
    };

    fn camera(look_at: Vec3) -> Camera {
        let position = Vec3::new(0.3, 1.6, 2.0);
        let view = FieldOfView::Vertical(0.7);
        Camera::look_at(position, look_at, Vec3::Y, view, [4000, 3000])
    }

    fn placement() -> Placement {
        Placement {
            position: Vec3::ZERO,
            yaw_rad: 0.0,
            pitch_rad: 0.0,
            roll_rad: 0.0,
            size: Size::Scale(1.0),
            rest: None,
            anchor: Anchor::Origin,
        }
    }

    fn place(camera: &Camera, proxy: &Proxy, pixels: Pixels) -> Result<Placement, String> {
        let placed = pixels.place(&placement(), camera, proxy, None, "scene.objects[0]");
        placed.map_err(|e| e.to_string())
    }

    fn at(x: f32, y: f32) -> Pixels {
        Pixels {
            at: Some(Vec2::new(x, y)),
            to: None,
        }
    }

    #[test]
    fn an_object_rests_on_the_level_surface_that_its_pixel_shows() {
        let camera = camera(Vec3::new(0.3, 0.4, -1.0));
        let [width, height] = [4000, 3000];
        // A plane in the camera's axes, right, up and ahead, over its distance.
        let through = |point: Vec3, normal: Vec3| {
            let n = camera.rotation.transpose() * normal;
            Vec3::new(n.x, n.y, -n.z) / normal.dot(point - camera.position)
        };
        let everywhere = |plane: Vec3| {
            SeenSurfaces::new(
                Raster::filled(width, height, 1.0),
                Raster::filled(4, 3, plane),
            )
        };
        let resting = Placement {
            rest: Some(Rest::Surface),
            ..placement()
        };
        let proxy = Proxy::Plane(GROUND);
        let pixels = at(2000.0, 1800.0);
        let place = |surfaces: Option<&SeenSurfaces>| {
            let placed = pixels.place(&resting, &camera, &proxy, surfaces, "scene.objects[0]");
            placed.map(|p| p.position).map_err(|e| e.to_string())
        };
        let top = everywhere(through(Vec3::Y * 0.7, Vec3::Y));
        let on_top = place(Some(&top)).unwrap();
        assert!((on_top.y - 0.7).abs() < 1e-5, "{on_top}");
        let seen = camera.project(on_top).unwrap();
        assert!(seen.distance(Vec2::new(2000.0, 1800.0)) < 0.01, "{seen}");
        // What is not known is the ground, and so is what rests on anything else.
        let unknown = everywhere(Vec3::NAN);
        let on_ground = place(None).unwrap();
        assert!(on_ground.y.abs() < 1e-5);
        assert_eq!(place(Some(&unknown)).unwrap(), on_ground);
        let other = pixels
            .place(&placement(), &camera, &proxy, Some(&top), "")
            .unwrap();
        assert_eq!(other.position, on_ground);
        for (lean_deg, stands) in [(25f32, true), (35.0, false), (90.0, false)] {
            let (sin, cos) = lean_deg.to_radians().sin_cos();
            let leaning = everywhere(through(Vec3::Y * 0.5, Vec3::new(0.0, cos, sin)));
            match place(Some(&leaning)) {
                Ok(_) => assert!(stands, "{lean_deg}"),
                Err(said) => {
                    assert!(
                        !stands && said.contains(&format!("leans {lean_deg} degrees")),
                        "{said}"
                    );
                    assert!(said.contains("scene.objects[0].at_pixel"), "{said}");
                }
            }
        }
    }

    proptest! {
        #[test]
        fn the_foot_is_seen_at_its_pixel(
            x in 0.0f32..4000.0, y in 1900.0f32..3000.0, tilt in -0.1f32..0.1,
        ) {
            let normal = Vec3::new(tilt, 1.0, -tilt).normalize();
            let proxy = Proxy::Plane(Plane { point: Vec3::new(0.0, 0.1, 0.0), normal });
            let camera = camera(Vec3::new(0.0, 0.9, -3.0));
            let placed = place(&camera, &proxy, at(x, y)).unwrap();
            let pixel = camera.project(placed.position).unwrap();
            // Single precision of positions a few metres away and of 4000 pixels: 4e-3 together.
            prop_assert!(pixel.distance(Vec2::new(x, y)) < 0.01, "{} for {} {}", pixel, x, y);
        }
    }

    #[test]
    fn a_pixel_at_or_above_the_horizon_is_refused_with_its_row() {
        // A level camera: the horizon is the middle row, and what is above it meets the ground
        // behind the camera.
        let camera = camera(Vec3::new(0.3, 1.6, -3.0));
        for y in [1500.0, 1400.0, 0.0] {
            let error = place(&camera, &Proxy::Plane(GROUND), at(2000.0, y)).unwrap_err();
            assert_eq!(
                error,
                format!(
                    "scene.objects[0].at_pixel is [2000.0, {y:?}], where no ground is seen; accepted: \
                     a pixel below the horizon, which is at row 1500.0 in this column"
                )
            );
        }
    }

    #[test]
    fn a_pixel_outside_of_the_photograph_is_refused() {
        let camera = camera(Vec3::new(0.3, 1.6, -3.0));
        for (x, y) in [(2000.0, 3001.0), (-1.0, 2000.0), (4000.5, 2000.0)] {
            let error = place(&camera, &Proxy::Plane(GROUND), at(x, y)).unwrap_err();
            assert_eq!(
                error,
                format!(
                    "scene.objects[0].at_pixel is [{x:?}, {y:?}]; accepted: a pixel of the photograph, \
                     [0, 0] to [4000.0, 3000.0]; `position` also places what is outside of it"
                )
            );
        }
    }

    #[test]
    fn a_camera_under_the_ground_is_told_to_rise() {
        let camera = camera(Vec3::new(0.3, 1.6, -3.0));
        let ceiling = Plane {
            point: Vec3::new(0.0, 2.0, 0.0),
            normal: Vec3::Y,
        };
        let error = place(&camera, &Proxy::Plane(ceiling), at(2000.0, 100.0)).unwrap_err();
        assert!(
            error.contains("0.400 m behind: raise scene.camera.position"),
            "{error}"
        );
    }

    #[test]
    fn a_pixel_needs_a_plane() {
        let error = place(&camera(Vec3::ZERO), &Proxy::None, at(2000.0, 2000.0)).unwrap_err();
        assert!(error.starts_with("scene.proxy.plane is missing"), "{error}");
    }

    #[test]
    fn the_front_faces_its_pixel() {
        let camera = camera(Vec3::new(0.0, 0.9, -3.0));
        let proxy = Proxy::Plane(GROUND);
        let both = Pixels {
            at: Some(Vec2::new(1200.0, 2100.0)),
            to: Some(Vec2::new(3000.0, 2600.0)),
        };
        let placed = place(&camera, &proxy, both).unwrap();
        let target = ground_at(&camera, &GROUND, DVec2::new(3000.0, 2600.0)).unwrap();
        let front = DQuat::from_rotation_y(placed.yaw_rad.into()) * DVec3::Z;
        let ahead = (target - placed.position.as_dvec3()).normalize();
        assert!(front.abs_diff_eq(ahead, 1e-5), "{front} {ahead}");
        let error = place(
            &camera,
            &proxy,
            Pixels {
                to: both.at,
                ..both
            },
        )
        .unwrap_err();
        assert!(
            error.ends_with("a pixel away from where the object stands"),
            "{error}"
        );
    }
}
