//! Where an object stands: its lowest point rests on the proxy.
//!
//! Up is the normal of a proxy plane, else +y. The object is turned by roll (about z), pitch (x) and
//! yaw (y), in this order; scaled; tilted so that its y points up; and moved so that its anchor lies
//! above the contact point and its lowest point at the same height. This is computed in double precision.
use dipir_points::place::Body;
use glam::{DMat3, DMat4, DQuat, DVec3, Vec3, swizzles::Vec3Swizzles};
use serde::{Deserialize, Serialize};

use crate::camera::FARTHEST_M;
use crate::error::Error;
use crate::mesh::TriangleMesh;
use crate::proxy::Proxy;
use crate::visibility::short;

/// Largest extent of an object, metres.
const LARGEST_M: f64 = 1e6;

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
    /// What the photograph shows at the pixel where the object is put.
    Surface,
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
        let of_turned = DMat4::from_translation(contact)
            * upright
            * DMat4::from_scale(DVec3::splat(scale))
            * DMat4::from_translation(-foot);
        if !mesh.indices.is_empty() {
            within_reach(&of_turned, scale, [low, high], key)?;
        }
        Ok((of_turned * DMat4::from_mat3(turn), warning))
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
            (_, Rest::Surface) => Ok((position, None)),
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

/// Refuses an object that is too large or too far out; `map` moves its turned box, from `low` to `high`, and makes it
/// `scale` times as large. Rays are exact to some millionths of the extent of all objects: with a wheel at the end of the
/// world each would be tested against all triangles of a car, whose shadows would start metres away.
fn within_reach(map: &DMat4, scale: f64, [low, high]: [DVec3; 2], key: &str) -> Result<(), Error> {
    let size = scale * (high - low).max_element();
    let refused = |value: String, accepted: &str| {
        Err(Error::Config {
            key: key.into(),
            value,
            accepted: accepted.into(),
        })
    };
    // Comparisons of NaN, of what overflows, fail.
    if !(size <= LARGEST_M) {
        return refused(
            format!("{} m large", short(size)),
            "at most a thousand kilometres: see its scale or height_m, and whether a part of its file lies far out",
        );
    }
    let corners = [0, 1, 2, 3, 4, 5, 6, 7].map(|k| {
        let upper = [k & 1, k >> 1 & 1, k >> 2].map(|bit| bit as f64);
        map.transform_point3(low + (high - low) * DVec3::from_array(upper))
    });
    let farthest = corners.map(|p| p.abs().max_element()).into_iter();
    let farthest = farthest.fold(0.0, f64::max);
    if !(farthest <= f64::from(FARTHEST_M)) {
        return refused(
            format!("{} m from the scene's origin", short(farthest)),
            "at most ten million metres: see its position, and where its file has it (anchor = \"center\" moves it to the position)",
        );
    }
    Ok(())
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A triangle whose third corner lies at `far`.
    fn triangle(far: Vec3) -> TriangleMesh {
        TriangleMesh {
            positions: vec![Vec3::ZERO, Vec3::X, far],
            indices: vec![[0, 1, 2]],
            ..TriangleMesh::default()
        }
    }

    fn resolved(mesh: &TriangleMesh, position: Vec3, size: Size) -> Result<DMat4, String> {
        let placement = Placement {
            position,
            yaw_rad: 0.3,
            pitch_rad: 0.0,
            roll_rad: 0.0,
            size,
            rest: None,
            anchor: Anchor::Origin,
        };
        let resolved = placement.resolve(mesh, DVec3::ZERO, &Proxy::None, "scene.objects[2]");
        resolved.map(|r| r.0).map_err(|e| e.to_string())
    }

    #[test]
    fn an_object_beyond_reach_is_refused_with_its_size() {
        let usual = triangle(Vec3::Y);
        let with_a_far_part = triangle(Vec3::new(0.0, 1.0, 9_007_199_254_740_993.0));
        let size = "; accepted: at most a thousand kilometres: see its scale or height_m, and whether a part of its file lies far out";
        let place = "; accepted: at most ten million metres: see its position, and where its file has it (anchor = \"center\" moves it to the position)";
        let zero = Vec3::ZERO;
        for (mesh, position, scale, refusal) in [
            (&usual, zero, Size::Scale(1.0), None),
            (&usual, zero, Size::Scale(5e5), None),
            (&with_a_far_part, zero, Size::Scale(1e-12), None),
            (&usual, Vec3::splat(9e6), Size::Scale(1.0), None),
            (
                &usual,
                zero,
                Size::Height(3e6),
                Some(("3.0e6 m large", size)),
            ),
            (
                &usual,
                zero,
                Size::Scale(1e38),
                Some(("1.0e38 m large", size)),
            ),
            (
                &with_a_far_part,
                zero,
                Size::Height(1.4),
                Some(("1.2e16 m large", size)),
            ),
            (
                &usual,
                Vec3::X * 3e7,
                Size::Scale(1.0),
                Some(("3.0e7 m from the scene's origin", place)),
            ),
        ] {
            let found = resolved(mesh, position, scale);
            match refusal {
                None => assert!(found.is_ok(), "{found:?}"),
                Some((value, accepted)) => assert_eq!(
                    found.unwrap_err(),
                    format!("scene.objects[2] is {value}{accepted}")
                ),
            }
        }
        let far_in_its_file = triangle(Vec3::new(-4e30, 0.0, 4e30));
        let error = resolved(&far_in_its_file, zero, Size::Scale(1e38)).unwrap_err();
        assert!(error.contains("e68 m large"), "{error}");
    }
}
