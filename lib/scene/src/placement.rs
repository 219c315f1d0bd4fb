//! Where an object stands: its lowest point rests on the proxy.
//!
//! Up is the normal of a proxy plane, else +y. The object is turned by roll (about z), pitch (x) and
//! yaw (y), in this order; scaled; tilted so that its y points up; and moved so that its anchor lies
//! above the contact point and its lowest point at the same height. This is computed in double precision.
use dipir_points::place::Body;
use glam::{DMat3, DMat4, DQuat, DVec3, Vec3, swizzles::Vec3Swizzles};
use serde::{Deserialize, Serialize};

use crate::error::Error;
use crate::mesh::TriangleMesh;
use crate::proxy::Proxy;

/// How large the object is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Size {
    /// Factor on the file's metres.
    Scale(f32),
    /// Extent along the up direction once turned, metres.
    Height(f32),
}

/// What the height of the object's lowest point follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rest {
    /// The proxy below or above the placement's x and z.
    Proxy,
    /// The placement's position.
    Position,
}

/// Which point of the object comes to lie at the placement's position, seen from above.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Anchor {
    /// The origin of the object's file.
    #[default]
    Origin,
    /// The centre of the object's bounding box once turned.
    Center,
}

/// A checked placement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Where the object rests, metres.
    pub position: Vec3,
    /// Turn about the up direction, applied last.
    pub yaw_rad: f32,
    /// Turn about x, applied second.
    pub pitch_rad: f32,
    /// Turn about z, applied first.
    pub roll_rad: f32,
    /// How large the object is.
    pub size: Size,
    /// What its height follows; `None` decides by the proxy.
    pub rest: Option<Rest>,
    /// Which point lies at the position.
    pub anchor: Anchor,
}

impl Placement {
    /// The map from the coordinates of `mesh` to the world. The mesh's (0, 0, 0) lies at `origin` in
    /// the file; `key` names the object's table in messages. Returns a warning if the object hovers
    /// over a plane or reaches below it.
    pub fn resolve(
        &self,
        mesh: &TriangleMesh,
        origin: DVec3,
        proxy: &Proxy,
        key: &str,
    ) -> Result<(DMat4, Option<String>), Error> {
        let up = match proxy {
            Proxy::Plane(plane) => plane.normal.as_dvec3().normalize(),
            _ => DVec3::Y,
        };
        let (turn, low, high) = self.turned(mesh);
        let scale = self.scale(low, high, key)?;
        let anchor = match self.anchor {
            Anchor::Origin => turn * -origin,
            Anchor::Center => (low + high) * 0.5,
        };
        let foot = DVec3::new(anchor.x, low.y, anchor.z);
        let (contact, warning) = self.contact(proxy, key)?;
        let upright = DMat4::from_quat(DQuat::from_rotation_arc(DVec3::Y, up));
        let map = DMat4::from_translation(contact)
            * upright
            * DMat4::from_scale(DVec3::splat(scale))
            * DMat4::from_translation(-foot)
            * DMat4::from_mat3(turn);
        Ok((map, warning))
    }

    /// The turn, and the bounds of the turned mesh.
    fn turned(&self, mesh: &TriangleMesh) -> (DMat3, DVec3, DVec3) {
        let turn = DMat3::from_rotation_y(self.yaw_rad.into())
            * DMat3::from_rotation_x(self.pitch_rad.into())
            * DMat3::from_rotation_z(self.roll_rad.into());
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for corner in mesh.corners() {
            let p = turn * corner.as_dvec3();
            low = low.min(p);
            high = high.max(p);
        }
        (turn, low, high)
    }

    /// The factor on the lengths of a turned mesh with these bounds.
    fn scale(&self, low: DVec3, high: DVec3, key: &str) -> Result<f64, Error> {
        match self.size {
            Size::Scale(s) => Ok(f64::from(s)),
            Size::Height(h) if high.y - low.y > 0.0 => Ok(f64::from(h) / (high.y - low.y)),
            Size::Height(h) => Err(Error::Config {
                key: format!("{key}.height_m"),
                value: h.to_string(),
                accepted: "left out, for the object is flat and has no height; write scale".into(),
            }),
        }
    }

    /// The upright cylinder around the mesh as it will stand, about the centre of its bounding box.
    pub(crate) fn body(&self, mesh: &TriangleMesh, key: &str) -> Result<Body, Error> {
        let (_, low, high) = self.turned(mesh);
        let extent = (high - low) * self.scale(low, high, key)?;
        Ok(Body {
            radius_m: 0.5 * extent.x.hypot(extent.z),
            height_m: extent.y,
        })
    }

    /// The point that the object's foot gets.
    fn contact(&self, proxy: &Proxy, key: &str) -> Result<(DVec3, Option<String>), Error> {
        let position = self.position.as_dvec3();
        let rest = self.rest.unwrap_or(match proxy {
            Proxy::None => Rest::Position,
            Proxy::Plane(plane) if plane.normal.y > 1.0 - 1e-6 => Rest::Position,
            _ => Rest::Proxy,
        });
        match (proxy, rest) {
            (Proxy::Plane(plane), _) => {
                let n = plane.normal.as_dvec3();
                let height = n.dot(position - plane.point.as_dvec3());
                if rest == Rest::Proxy {
                    // Straight down; along the normal where the plane is a wall.
                    let down = if n.y.abs() > 1e-3 {
                        DVec3::Y * (height / n.y)
                    } else {
                        n * height
                    };
                    return Ok((position - down, None));
                }
                let warning = (height.abs() > 1e-3).then(|| {
                    let how = if height > 0.0 { "hovers" } else { "sinks" };
                    let side = if height > 0.0 { "above" } else { "below" };
                    format!(
                        "{key} {how} {:.3} m {side} the proxy plane, as its position says; rest = \"proxy\" puts it there",
                        height.abs()
                    )
                });
                Ok((position, warning))
            }
            (Proxy::Mesh(mesh), Rest::Proxy) => match highest(mesh, position) {
                Some(y) => Ok((position.with_y(y), None)),
                None => Err(Error::Config {
                    key: format!("{key}.position"),
                    value: format!(
                        "[{:?}, {:?}, {:?}]",
                        self.position.x, self.position.y, self.position.z
                    ),
                    accepted: match mesh.bounds() {
                        Some((low, high)) => format!(
                            "a position with the proxy mesh below or above it, which spans x from {} to {} and z from {} to {}; or rest = \"position\"",
                            low.x, high.x, low.z, high.z
                        ),
                        None => "rest = \"position\", for the proxy mesh has no triangles".into(),
                    },
                }),
            },
            _ => Ok((position, None)),
        }
    }
}

/// The height of the mesh's highest point on the vertical line through `position`.
fn highest(mesh: &TriangleMesh, position: DVec3) -> Option<f64> {
    let target = position.xz();
    let mut best: Option<f64> = None;
    for triangle in &mesh.indices {
        let p = triangle.map(|i| mesh.positions[i as usize].as_dvec3());
        let [a, b, c] = p.map(|p| p.xz() - target);
        // Weights by areas; edges count as inside.
        let w = [b.perp_dot(c), c.perp_dot(a), a.perp_dot(b)];
        let area = w[0] + w[1] + w[2];
        if area == 0.0 || w.iter().any(|w| w * area < 0.0) {
            continue;
        }
        let y = (w[0] * p[0].y + w[1] * p[1].y + w[2] * p[2].y) / area;
        best = Some(best.map_or(y, |b| b.max(y)));
    }
    best
}
