//! The extensions of the metallic-roughness model at a point.
use dipir_numerics::warp::Frame;
use dipir_scene::material::{Anisotropy, MaterialExtensions, TextureRef};
use glam::{Mat3, Vec2, Vec3, Vec4};

use super::{Barycentric, Surfaces};
use crate::bsdf::features::{TEXTURES, has};

/// A thin film at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilmPoint {
    /// Share of the surface that has it; 0 means no film.
    pub factor: f32,
    /// Its index of refraction.
    pub ior: f32,
    /// Its thickness, nanometres.
    pub thickness_nm: f32,
}

/// What extensions say of a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExtensionPoint {
    /// The dielectric's reflectance at grazing incidence, `[0, 1]`; scales all of its reflection.
    pub specular: f32,
    /// Multiplies the dielectric's reflectance at normal incidence, linear.
    pub specular_color: Vec3,
    /// Colour of the sheen, linear, in `[0, 1]`; black means none.
    pub sheen_color: Vec3,
    /// Perceptual roughness of the sheen, `[0, 1]`.
    pub sheen_roughness: f32,
    /// How much rougher the surface is along `tangent`, `[0, 1]`.
    pub anisotropy: f32,
    /// World space, at right angles to the shading normal, or nearly.
    pub tangent: Vec3,
    /// A thin film.
    pub film: FilmPoint,
    /// Coefficient of attenuation inside the object, per metre.
    pub attenuation: Vec3,
    /// Length of the way through a sheet that has no inner side, metres.
    pub thickness: f32,
}

impl ExtensionPoint {
    /// No extensions.
    pub const NONE: Self = Self {
        specular: 1.0,
        specular_color: Vec3::ONE,
        sheen_color: Vec3::ZERO,
        sheen_roughness: 0.0,
        anisotropy: 0.0,
        tangent: Vec3::ZERO,
        film: FilmPoint {
            factor: 0.0,
            ior: 1.3,
            thickness_nm: 0.0,
        },
        attenuation: Vec3::ZERO,
        thickness: 0.0,
    };

    /// The frame of a surface with the shading normal `normal`: its first axis along the
    /// tangent where the surface is anisotropic.
    #[inline]
    pub fn frame(&self, normal: Vec3) -> Frame {
        let across = self.tangent - normal * normal.dot(self.tangent);
        match across.try_normalize() {
            Some(tangent) if self.anisotropy > 0.0 => Frame {
                tangent,
                bitangent: normal.cross(tangent),
                normal,
            },
            _ => Frame::from_normal(normal),
        }
    }

    /// Share of light that is left after `distance` metres inside the object.
    #[inline]
    pub fn left_after(attenuation: Vec3, distance: f32) -> Vec3 {
        Vec3::from((attenuation * -distance).to_array().map(f32::exp))
    }
}

impl Surfaces<'_> {
    /// The `extensions` of a material at a point of a triangle with `vertices`, whose smooth normal on the
    /// front side is `normal`.
    pub(super) fn extensions_at<const F: u32>(
        &self,
        extensions: &MaterialExtensions,
        point: &Barycentric,
        vertices: [Vec3; 3],
        normal: Vec3,
    ) -> ExtensionPoint {
        let read = |texture: &Option<TextureRef>| match texture {
            Some(t) if has(F, TEXTURES) => self.lookup(t, point),
            _ => Vec4::ONE,
        };
        let mut all = ExtensionPoint::NONE;
        if let Some(s) = &extensions.specular {
            all.specular = (s.factor * read(&s.factor_texture).w).clamp(0.0, 1.0);
            all.specular_color = s.color * read(&s.color_texture).truncate();
        }
        if let Some(s) = &extensions.sheen {
            let color = s.color * read(&s.color_texture).truncate();
            all.sheen_color = color.clamp(Vec3::ZERO, Vec3::ONE);
            all.sheen_roughness = (s.roughness * read(&s.roughness_texture).w).clamp(0.0, 1.0);
        }
        if let Some(a) = &extensions.anisotropy {
            (all.anisotropy, all.tangent) = self.anisotropy_at::<F>(a, point, vertices, normal);
        }
        if let Some(f) = &extensions.iridescence {
            let share = match f.thickness_texture {
                Some(_) => read(&f.thickness_texture).y,
                None => 1.0,
            };
            let [least, most] = f.thickness_nm;
            all.film = FilmPoint {
                factor: (f.factor * read(&f.factor_texture).x).clamp(0.0, 1.0),
                ior: f.ior,
                thickness_nm: least + (most - least) * share,
            };
        }
        if let Some(v) = &extensions.volume {
            let color = v.attenuation_color.to_array();
            let attenuation = -Vec3::from(color.map(f32::ln)) / v.attenuation_distance;
            // Within a tiny distance it exceeds all numbers, and 0 m of that would be no number.
            all.attenuation = attenuation.min(Vec3::splat(f32::MAX));
            all.thickness = v.thickness * read(&v.thickness_texture).y;
        }
        all
    }

    fn anisotropy_at<const F: u32>(
        &self,
        anisotropy: &Anisotropy,
        point: &Barycentric,
        vertices: [Vec3; 3],
        normal: Vec3,
    ) -> (f32, Vec3) {
        let without_texture = TextureRef {
            texture: u32::MAX,
            uv_set: 0,
            transform: Mat3::IDENTITY,
        };
        let texture = anisotropy.texture.filter(|_| has(F, TEXTURES));
        let (mut direction, mut strength) = (Vec2::X, anisotropy.strength);
        if let Some(t) = &texture {
            let value = self.lookup(t, point);
            direction = (value.truncate().truncate() * 2.0 - 1.0).normalize_or(Vec2::X);
            strength *= value.z;
        }
        let direction = Vec2::from_angle(anisotropy.rotation_rad).rotate(direction);
        let reference = texture.unwrap_or(without_texture);
        let tangents = self.tangents(&reference, point, vertices, normal);
        let (tangent, bitangent) = tangents.unwrap_or_else(|| {
            let frame = Frame::from_normal(normal);
            (frame.tangent, frame.bitangent)
        });
        let along = tangent * direction.x + bitangent * direction.y;
        (strength.clamp(0.0, 1.0), along)
    }
}
