//! From a hit to a shading frame and an evaluated material.
use glam::Vec3;

/// The coat at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CoatPoint {
    /// Layer weight in `[0, 1]`; 0 means no coat.
    pub factor: f32,
    /// Perceptual roughness in `[0, 1]`.
    pub roughness: f32,
    /// The coat's own unit normal, on the side of `wo`.
    pub normal: Vec3,
}

/// Everything that scattering, emission and coverage need to know of one point of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// World space, metres.
    pub position: Vec3,
    /// Unit normal of the triangle, turned to the side that is seen.
    pub geometric_normal: Vec3,
    /// Unit shading normal on the same side, bent where needed so that the viewer and the
    /// mirror direction lie above both planes.
    pub normal: Vec3,
    /// Whether the front (counter-clockwise) side is seen.
    pub front_face: bool,
    /// Linear Rec.709 in `[0, 1]`.
    pub base_color: Vec3,
    /// Metalness in `[0, 1]`.
    pub metallic: f32,
    /// Perceptual roughness in `[0, 1]`; GGX alpha is its square.
    pub roughness: f32,
    /// Index of refraction of the dielectric interface.
    pub ior: f32,
    /// Share of light that passes instead of being diffusely reflected, `[0, 1]`.
    pub transmission: f32,
    /// Dielectric coat over the base.
    pub coat: CoatPoint,
    /// Emitted radiance towards the side that is seen, linear.
    pub emission: Vec3,
    /// Chance in `[0, 1]` that light meets the surface at all.
    pub coverage: f32,
    /// Shows `base_color` as radiance, whatever the light.
    pub unlit: bool,
}

impl SurfacePoint {
    /// A flat, white, rough, opaque dielectric at the origin that faces `normal`.
    pub fn facing(normal: Vec3) -> Self {
        Self {
            position: Vec3::ZERO,
            geometric_normal: normal,
            normal,
            front_face: true,
            base_color: Vec3::ONE,
            metallic: 0.0,
            roughness: 1.0,
            ior: 1.5,
            transmission: 0.0,
            coat: CoatPoint {
                factor: 0.0,
                roughness: 0.0,
                normal,
            },
            emission: Vec3::ZERO,
            coverage: 1.0,
            unlit: false,
        }
    }
}
