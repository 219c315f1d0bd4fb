//! From a hit to a shading frame and an evaluated material.
//!
//! The rules of glTF 2.0 apply: vertex colours and textures multiply the factors, back faces
//! of double-sided surfaces turn all their normals round, a normal map's +Y points up in the
//! image (against v).
mod extensions;

use dipir_numerics::guarded::normalize_or;
use dipir_scene::error::Error;
use dipir_scene::material::{
    AlphaMode, Clearcoat, Material, MaterialExtensions, TextureRef, Transmission,
};
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::ray_offset::{geometric_normal, interpolate};
use dipir_scene::scene::Scene;
use dipir_scene::texture::{DecodedTexture, decode_textures};
use glam::{Vec2, Vec3, Vec4};

use crate::bsdf::features::{
    ALPHA, CLEARCOAT, EMISSION, EXTENSIONS, NORMAL_MAPPING, PLAIN_GGX, SPECULAR, TEXTURES,
    TRANSMISSION, has,
};
use crate::bsdf::passing_coat;

pub use extensions::{ExtensionPoint, FilmPoint};

/// The coat at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CoatPoint {
    /// Layer weight in `[0, 1]`; 0 means no coat.
    pub factor: f32,
    /// Perceptual roughness in `[0, 1]`.
    pub roughness: f32,
    /// Unit normal of the coat, on the side of `wo`.
    pub normal: Vec3,
    /// Whether the coat may have another normal than the base: a property of the material,
    /// not of the point, so that no seam appears where both happen to agree.
    pub own_normal: bool,
}

impl CoatPoint {
    /// No coat.
    pub const NONE: Self = Self {
        factor: 0.0,
        roughness: 0.0,
        normal: Vec3::ZERO,
        own_normal: false,
    };
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
    /// Extensions beside coat and transmission.
    pub extension: ExtensionPoint,
    /// Emitted radiance towards the viewer, linear: what passes the coat.
    pub emission: Vec3,
    /// Shows `base_color` as radiance, whatever the light.
    pub unlit: bool,
}

/// Derivatives of a [`SurfacePoint`] with respect to the factors of its material.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FactorSlopes {
    /// Of the base colour, a channel at a time.
    pub base_color: Vec3,
    /// Of the metalness.
    pub metallic: f32,
    /// Of the roughness.
    pub roughness: f32,
    /// Of the emission below the coat with respect to the emissive factor, a channel at a time.
    pub emission: Vec3,
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
                normal,
                ..CoatPoint::NONE
            },
            extension: ExtensionPoint::NONE,
            emission: Vec3::ZERO,
            unlit: false,
        }
    }
}

/// A material reduced to the planned effects.
#[derive(Clone, Debug)]
struct Prepared {
    material: Material,
    /// The base-colour texture's alpha, if coverage depends on it.
    alpha_texture: Option<TextureRef>,
}

impl Prepared {
    fn new(material: &Material, mask: u32) -> Self {
        let mut m = material.clone();
        let alpha_texture = match m.alpha_mode {
            AlphaMode::Opaque => None,
            _ => m.base_color_texture.filter(|_| has(mask, ALPHA)),
        };
        if !has(mask, ALPHA) {
            m.alpha_mode = AlphaMode::Opaque;
        }
        if !has(mask, EMISSION) {
            m.emissive = Vec3::ZERO;
            m.unlit = false;
        }
        if m.emissive == Vec3::ZERO {
            m.emissive_texture = None;
        }
        if !has(mask, CLEARCOAT) {
            m.clearcoat = None;
        }
        if !has(mask, TRANSMISSION) {
            m.transmission = None;
        }
        if !has(mask, EXTENSIONS) {
            m.extensions = MaterialExtensions::default();
        }
        if m.transmission.is_none() {
            m.extensions.volume = None;
        }
        if !has(mask, TEXTURES) {
            m.extensions.textures_mut().for_each(|t| *t = None);
            m.base_color_texture = None;
            m.metallic_roughness_texture = None;
            m.emissive_texture = None;
            if let Some(coat) = &mut m.clearcoat {
                coat.factor_texture = None;
                coat.roughness_texture = None;
            }
            if let Some(transmission) = &mut m.transmission {
                transmission.texture = None;
            }
        }
        if !has(mask, NORMAL_MAPPING) {
            m.normal_texture = None;
            if let Some(coat) = &mut m.clearcoat {
                coat.normal_texture = None;
            }
        }
        Self {
            material: m,
            alpha_texture,
        }
    }

    fn textures(&self) -> impl Iterator<Item = u32> {
        let m = &self.material;
        let coat = m.clearcoat;
        [
            self.alpha_texture,
            m.base_color_texture,
            m.metallic_roughness_texture,
            m.normal_texture.map(|n| n.0),
            m.emissive_texture,
            coat.and_then(|c| c.factor_texture),
            coat.and_then(|c| c.roughness_texture),
            coat.and_then(|c| c.normal_texture).map(|n| n.0),
            m.transmission.and_then(|t| t.texture),
        ]
        .into_iter()
        .flatten()
        .chain(m.extensions.textures().copied())
        .map(|t| t.texture)
    }
}

/// The surfaces of a scene, with the materials and textures that the planned effects need.
pub struct Surfaces<'a> {
    mesh: &'a TriangleMesh,
    materials: Vec<Prepared>,
    textures: Vec<Option<DecodedTexture>>,
    has_colors: bool,
}

impl<'a> Surfaces<'a> {
    /// Prepares the materials of `scene` for the effects in `mask`
    /// ([`features`](crate::bsdf::features)) and decodes the textures that these need, no
    /// others. Fails if one of them cannot be decoded.
    pub fn new(scene: &'a Scene, mask: u32) -> Result<Self, Error> {
        let materials: Vec<Prepared> = scene
            .materials
            .iter()
            .map(|m| Prepared::new(m, mask))
            .collect();
        let mut wanted = vec![false; scene.textures.len()];
        for texture in materials.iter().flat_map(Prepared::textures) {
            if let Some(w) = wanted.get_mut(texture as usize) {
                *w = true;
            }
        }
        Ok(Self {
            mesh: &scene.mesh,
            textures: decode_textures(&scene.textures, |i| wanted[i])?,
            materials,
            has_colors: has(mask, TEXTURES) && !scene.mesh.colors.is_empty(),
        })
    }

    /// Whether rays from behind pass through `triangle`. Transmissive surfaces are met from both
    /// sides.
    #[inline]
    pub fn single_sided(&self, triangle: u32) -> bool {
        let m = self.material(triangle);
        !m.double_sided && m.transmission.is_none()
    }

    /// Whether `triangle` may let light pass where its alpha says so.
    #[inline]
    pub fn has_alpha(&self, triangle: u32) -> bool {
        self.material(triangle).alpha_mode != AlphaMode::Opaque
    }

    /// Whether light may pass through `triangle`.
    #[inline]
    pub fn transmits(&self, triangle: u32) -> bool {
        self.material(triangle).transmission.is_some()
    }

    /// Index into [`Scene::materials`].
    #[inline]
    pub fn material_index(&self, triangle: u32) -> u32 {
        self.mesh.materials[triangle as usize]
    }

    /// Unit normal of `triangle` on the side of its front face; zero if it has no area.
    #[inline]
    pub fn geometric_normal(&self, triangle: u32) -> Vec3 {
        geometric_normal(self.vertices(triangle))
    }

    /// The chance in `[0, 1]` that light meets `triangle` at barycentric weights `u`, `v` of
    /// its vertices 1 and 2; 0 or 1 in mask mode.
    #[inline]
    pub fn coverage<const F: u32>(&self, triangle: u32, u: f32, v: f32) -> f32 {
        if !has(F, ALPHA) {
            return 1.0;
        }
        let prepared = &self.materials[self.material_index(triangle) as usize];
        let point = self.barycentric(triangle, u, v);
        let alpha = || {
            let mut a = prepared.material.base_color.w;
            if let Some(texture) = &prepared.alpha_texture {
                a *= self.lookup(texture, &point).w;
            }
            if !self.mesh.colors.is_empty() {
                a *= point.interpolate(&self.mesh.colors, Vec4::ZERO).w;
            }
            a
        };
        match prepared.material.alpha_mode {
            AlphaMode::Opaque => 1.0,
            AlphaMode::Mask { cutoff } => f32::from(alpha() >= cutoff),
            AlphaMode::Blend => alpha().clamp(0.0, 1.0),
        }
    }

    /// The surface that a ray with unit `direction` meets on `triangle` at barycentric weights
    /// `u`, `v` of its vertices 1 and 2.
    pub fn interact<const F: u32>(
        &self,
        direction: Vec3,
        triangle: u32,
        u: f32,
        v: f32,
    ) -> SurfacePoint {
        let wo = -direction;
        let vertices = self.vertices(triangle);
        let point = self.barycentric(triangle, u, v);
        let m = self.material(triangle);

        let front = normalize_or(geometric_normal(vertices), wo);
        let front_face = front.dot(wo) >= 0.0;
        let side = if front_face { 1.0 } else { -1.0 };
        let smooth = match self.mesh.normals.is_empty() {
            true => front,
            false => normalize_or(point.interpolate(&self.mesh.normals, Vec3::ZERO), front),
        };
        let mapped = |map: &Option<(TextureRef, f32)>| match map {
            Some((texture, scale)) if has(F, NORMAL_MAPPING) => {
                self.mapped_normal(texture, *scale, &point, vertices, smooth)
            }
            _ => smooth,
        };
        let facing = |normal: Vec3| match has(F, SPECULAR | CLEARCOAT) && !has(F, PLAIN_GGX) {
            true => visible_normal(normal * side, front * side, wo),
            false => normal * side,
        };

        let mut base = m.base_color.truncate();
        let (mut metallic, mut roughness) = (m.metallic, m.roughness);
        let mut emission = m.emissive;
        if has(F, TEXTURES) {
            if let Some(t) = &m.base_color_texture {
                base *= self.lookup(t, &point).truncate();
            }
            if self.has_colors {
                base *= point.interpolate(&self.mesh.colors, Vec4::ZERO).truncate();
            }
            if let Some(t) = &m.metallic_roughness_texture {
                let value = self.lookup(t, &point);
                roughness *= value.y;
                if m.metallic_is_textured {
                    metallic *= value.z;
                }
            }
            if let Some(t) = &m.emissive_texture {
                emission *= self.lookup(t, &point).truncate();
            }
        }
        let coat = match &m.clearcoat {
            Some(c) if has(F, CLEARCOAT) => CoatPoint {
                normal: facing(mapped(&c.normal_texture)),
                own_normal: c.normal_texture.is_some() || m.normal_texture.is_some(),
                ..self.coat_at::<F>(c, &point)
            },
            _ => CoatPoint::NONE,
        };
        if emission != Vec3::ZERO {
            emission *= passing_coat(&coat, wo);
        }
        SurfacePoint {
            position: interpolate(vertices, u, v).as_vec3(),
            geometric_normal: front * side,
            normal: facing(mapped(&m.normal_texture)),
            front_face,
            base_color: base.clamp(Vec3::ZERO, Vec3::ONE),
            metallic: metallic.clamp(0.0, 1.0),
            roughness: roughness.clamp(0.0, 1.0),
            ior: m.ior,
            transmission: match &m.transmission {
                Some(t) if has(F, TRANSMISSION) => self.transmission_at::<F>(t, &point),
                _ => 0.0,
            },
            coat,
            extension: match has(F, EXTENSIONS) && !m.extensions.is_empty() {
                true => self.extensions_at::<F>(&m.extensions, &point, vertices, smooth),
                false => ExtensionPoint::NONE,
            },
            emission,
            unlit: m.unlit,
        }
    }

    /// Derivatives of what [`interact`](Self::interact) says of a material's factors, at
    /// barycentric weights `u`, `v` on `triangle`: the textures and colours that multiply them.
    pub fn slopes<const F: u32>(&self, triangle: u32, u: f32, v: f32) -> FactorSlopes {
        let m = self.material(triangle);
        let mut slopes = FactorSlopes {
            base_color: Vec3::ONE,
            metallic: 1.0,
            roughness: 1.0,
            emission: Vec3::ONE,
        };
        if has(F, TEXTURES) {
            let point = self.barycentric(triangle, u, v);
            if let Some(t) = &m.base_color_texture {
                slopes.base_color *= self.lookup(t, &point).truncate();
            }
            if self.has_colors {
                let colors = point.interpolate(&self.mesh.colors, Vec4::ZERO);
                slopes.base_color *= colors.truncate();
            }
            if let Some(t) = &m.metallic_roughness_texture {
                let value = self.lookup(t, &point);
                slopes.roughness *= value.y;
                if m.metallic_is_textured {
                    slopes.metallic *= value.z;
                }
            }
            if let Some(t) = &m.emissive_texture {
                slopes.emission *= self.lookup(t, &point).truncate();
            }
        }
        // Beyond 1 the products are clamped and no longer change.
        let color = m.base_color.truncate() * slopes.base_color;
        slopes.base_color = Vec3::select(color.cmple(Vec3::ONE), slopes.base_color, Vec3::ZERO);
        slopes.metallic *= f32::from(m.metallic * slopes.metallic <= 1.0);
        slopes.roughness *= f32::from(m.roughness * slopes.roughness <= 1.0);
        slopes
    }

    fn transmission_at<const F: u32>(&self, t: &Transmission, point: &Barycentric) -> f32 {
        let texture = t.texture.as_ref().filter(|_| has(F, TEXTURES));
        let value = texture.map_or(1.0, |t| self.lookup(t, point).x);
        (t.factor * value).clamp(0.0, 1.0)
    }

    fn coat_at<const F: u32>(&self, coat: &Clearcoat, point: &Barycentric) -> CoatPoint {
        let read = |texture: &Option<TextureRef>, channel: usize| match texture {
            Some(t) if has(F, TEXTURES) => self.lookup(t, point)[channel],
            _ => 1.0,
        };
        CoatPoint {
            factor: (coat.factor * read(&coat.factor_texture, 0)).clamp(0.0, 1.0),
            roughness: (coat.roughness * read(&coat.roughness_texture, 1)).clamp(0.0, 1.0),
            ..CoatPoint::NONE
        }
    }

    /// The normal that a tangent-space map holds, on the front side.
    fn mapped_normal(
        &self,
        texture: &TextureRef,
        scale: f32,
        point: &Barycentric,
        vertices: [Vec3; 3],
        normal: Vec3,
    ) -> Vec3 {
        let texel = self.lookup(texture, point).truncate() * 2.0 - Vec3::ONE;
        let Some((tangent, bitangent)) = self.tangents(texture, point, vertices, normal) else {
            return normal;
        };
        let mapped = tangent * (texel.x * scale) + bitangent * (texel.y * scale) + normal * texel.z;
        normalize_or(mapped, normal)
    }

    /// Directions of the normal map's +X and +Y. The mesh's own tangents where it has them;
    /// otherwise those along which the texture coordinates grow, at right angles to `normal`.
    fn tangents(
        &self,
        texture: &TextureRef,
        point: &Barycentric,
        vertices: [Vec3; 3],
        normal: Vec3,
    ) -> Option<(Vec3, Vec3)> {
        if !self.mesh.tangents.is_empty() {
            let t = point.interpolate(&self.mesh.tangents, Vec4::ZERO);
            let tangent = normalize_or(t.truncate(), Vec3::ZERO);
            if tangent != Vec3::ZERO {
                // Interpolation keeps the sign unless the mesh changes it within a triangle.
                return Some((tangent, normal.cross(tangent) * 1f32.copysign(t.w)));
            }
        }
        let set = self.mesh.uvs.get(texture.uv_set as usize)?;
        if set.is_empty() {
            return None;
        }
        let uv = point
            .vertices
            .map(|i| texture.transform.transform_point2(set[i as usize]));
        let (e1, e2) = (vertices[1] - vertices[0], vertices[2] - vertices[0]);
        let (d1, d2) = (uv[1] - uv[0], uv[2] - uv[0]);
        let orientation = 1f32.copysign(d1.perp_dot(d2));
        let along_u = (e1 * d2.y - e2 * d1.y) * orientation;
        let tangent = normalize_or(along_u - normal * normal.dot(along_u), Vec3::ZERO);
        // Counter-clockwise in (u, v) is clockwise in the image, where v points down.
        (tangent != Vec3::ZERO).then(|| (tangent, normal.cross(tangent) * -orientation))
    }

    /// The linear RGBA value of `texture`, white if the mesh lacks its coordinates.
    #[inline]
    fn lookup(&self, texture: &TextureRef, point: &Barycentric) -> Vec4 {
        let set = self.mesh.uvs.get(texture.uv_set as usize);
        let decoded = self.textures.get(texture.texture as usize);
        let (Some(set), Some(Some(decoded))) = (set, decoded) else {
            return Vec4::ONE;
        };
        let uv = point.interpolate(set, Vec2::ZERO);
        decoded.sample(texture.transform.transform_point2(uv))
    }

    #[inline]
    fn material(&self, triangle: u32) -> &Material {
        &self.materials[self.material_index(triangle) as usize].material
    }

    #[inline]
    fn vertices(&self, triangle: u32) -> [Vec3; 3] {
        self.mesh.indices[triangle as usize].map(|i| self.mesh.positions[i as usize])
    }

    #[inline]
    fn barycentric(&self, triangle: u32, u: f32, v: f32) -> Barycentric {
        Barycentric {
            vertices: self.mesh.indices[triangle as usize],
            weights: [1.0 - u - v, u, v],
        }
    }
}

/// A position on a triangle.
#[derive(Clone, Copy)]
struct Barycentric {
    vertices: [u32; 3],
    weights: [f32; 3],
}

impl Barycentric {
    /// The attribute at this position; `missing` if the mesh has none.
    #[inline]
    fn interpolate<T>(&self, attribute: &[T], missing: T) -> T
    where
        T: Copy + std::ops::Mul<f32, Output = T> + std::ops::Add<Output = T>,
    {
        if attribute.is_empty() {
            return missing;
        }
        let [a, b, c] = self.vertices.map(|i| attribute[i as usize]);
        a * self.weights[0] + b * self.weights[1] + c * self.weights[2]
    }
}

/// `normal`, bent just so far that the viewer sees its front and that its mirror direction
/// rises above the surface: else smooth shading and normal maps leave black spots where the
/// reflection would enter the object.
///
/// `geometric` and `wo` lie on one side. The mirror direction is raised to at most one
/// hundredth above the plane, less where `wo` grazes the plane too, so that a shading normal
/// equal to the geometric one is never changed; what is bent changes continuously with what
/// is not. Normals on the wrong side altogether are turned round.
pub fn visible_normal(normal: Vec3, geometric: Vec3, wo: Vec3) -> Vec3 {
    let facing = normal.dot(wo);
    let mirrored = 2.0 * facing * normal - wo;
    let height = mirrored.dot(geometric);
    let least = (0.9 * wo.dot(geometric)).clamp(0.0, 0.01);
    if height >= least {
        return if facing >= 0.0 { normal } else { -normal };
    }
    let raised = normalize_or(mirrored + geometric * (least - height), geometric);
    normalize_or(wo + raised, geometric)
}

#[cfg(test)]
mod tests;
