//! How many rays of each kind were traced.
use serde::{Deserialize, Serialize};

/// Why a ray was traced.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum RayKind {
    /// From the camera to the object.
    Camera,
    /// From a point on the object towards a sampled light direction.
    Light,
    /// From a point on the object in a direction that its BSDF chose.
    Bounce,
    /// From the proxy towards the light, to find whether the object is in the way.
    Shadow,
    /// From the camera to a proxy mesh.
    Proxy,
    /// From a proxy mesh towards the light or the object, to find whether the mesh itself is in the way.
    ProxyOcclusion,
    /// From the proxy to the object, for light that the object sends there.
    LightOnProxy,
    /// From the object to the proxy, for the photograph seen there.
    ProxyRadiance,
    /// Of particles from the light, which tell paths where it comes from by way of the object.
    Guide,
}

/// Number of [`RayKind`]s.
const KINDS: usize = 9;

/// The names under which [`RayCounts::named`] lists the kinds, in order.
const NAMES: [&str; KINDS] = [
    "camera",
    "light",
    "bounce",
    "shadow",
    "proxy",
    "proxy_occlusion",
    "light_on_proxy",
    "proxy_radiance",
    "guide",
];

/// Rays traced, by kind. Each task counts its own and the sums are exact, so the counts are the
/// same for any number of threads. One integer addition a ray is not measurable beside the ray.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RayCounts([u64; KINDS]);

impl RayCounts {
    /// Counts one ray.
    #[inline(always)]
    pub fn add(&mut self, kind: RayKind) {
        self.0[kind as usize] += 1;
    }

    /// Rays of one kind.
    pub fn get(&self, kind: RayKind) -> u64 {
        self.0[kind as usize]
    }

    /// Rays of all kinds.
    pub fn total(&self) -> u64 {
        self.0.iter().sum()
    }

    /// Adds the counts of another task.
    pub fn merge(&mut self, other: &Self) {
        for (a, b) in self.0.iter_mut().zip(other.0) {
            *a += b;
        }
    }

    /// `(name, count)` of every kind, as they are written to files.
    pub fn named(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        NAMES.into_iter().zip(self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_of_tasks_add_up_by_kind() {
        let mut a = RayCounts::default();
        a.add(RayKind::Camera);
        let mut b = RayCounts::default();
        b.add(RayKind::Guide);
        b.add(RayKind::Camera);
        a.merge(&b);
        assert_eq!(a.get(RayKind::Camera), 2);
        assert_eq!(a.get(RayKind::Guide), 1);
        assert_eq!(a.total(), 3);
        assert_eq!(a.named().last(), Some(("guide", 1)));
    }
}
