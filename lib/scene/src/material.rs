//! The glTF metallic-roughness material with the extensions that the renderer knows.
use glam::{Mat3, Vec3, Vec4};
use serde::{Deserialize, Serialize};

/// A use of a texture by a material.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TextureRef {
    /// Index into [`Scene::textures`](crate::scene::Scene::textures).
    pub texture: u32,
    /// Which of the mesh's two texture coordinate sets is read, after any override of
    /// `KHR_texture_transform`.
    pub uv_set: u8,
    /// Applied to `(u, v, 1)` before the lookup (`KHR_texture_transform`).
    pub transform: Mat3,
}

/// How coverage follows from base-colour alpha.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlphaMode {
    /// Alpha is ignored.
    Opaque,
    /// Present where alpha is at least the cutoff.
    Mask {
        /// Threshold on alpha.
        cutoff: f32,
    },
    /// Alpha is the probability that light meets the surface.
    Blend,
}

/// A dielectric coat over the base (`KHR_materials_clearcoat`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Clearcoat {
    /// Layer weight in `[0, 1]`.
    pub factor: f32,
    /// Multiplies `factor`, red channel.
    pub factor_texture: Option<TextureRef>,
    /// Perceptual roughness in `[0, 1]`.
    pub roughness: f32,
    /// Multiplies `roughness`, green channel.
    pub roughness_texture: Option<TextureRef>,
    /// The coat's own normal map and its scale.
    pub normal_texture: Option<(TextureRef, f32)>,
}

/// Light that passes through the surface (`KHR_materials_transmission`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transmission {
    /// Share of light that is transmitted instead of diffusely reflected, `[0, 1]`.
    pub factor: f32,
    /// Multiplies `factor`, red channel.
    pub texture: Option<TextureRef>,
}

/// One surface. Colours are linear Rec.709.
#[derive(Clone, Debug, PartialEq)]
pub struct Material {
    /// Name in the source file; may be empty.
    pub name: String,
    /// Linear RGBA factor.
    pub base_color: Vec4,
    /// sRGB-encoded RGBA texture that multiplies `base_color`.
    pub base_color_texture: Option<TextureRef>,
    /// Metalness in `[0, 1]`.
    pub metallic: f32,
    /// Perceptual roughness in `[0, 1]`; GGX alpha is its square.
    pub roughness: f32,
    /// Linear texture: green multiplies roughness, blue multiplies metallic.
    pub metallic_roughness_texture: Option<TextureRef>,
    /// Tangent-space normal map and its scale.
    pub normal_texture: Option<(TextureRef, f32)>,
    /// Emitted radiance, linear, strength (`KHR_materials_emissive_strength`) multiplied in.
    pub emissive: Vec3,
    /// sRGB-encoded texture that multiplies `emissive`.
    pub emissive_texture: Option<TextureRef>,
    /// Coverage.
    pub alpha_mode: AlphaMode,
    /// Whether the back face reflects too; otherwise it is not there for camera and light rays alike.
    pub double_sided: bool,
    /// Index of refraction of the dielectric interface (`KHR_materials_ior`), 1.5 by default.
    pub ior: f32,
    /// Coat, if any.
    pub clearcoat: Option<Clearcoat>,
    /// Transmission, if any.
    pub transmission: Option<Transmission>,
    /// `KHR_materials_unlit`: radiance is the base colour, whatever the light.
    pub unlit: bool,
}
