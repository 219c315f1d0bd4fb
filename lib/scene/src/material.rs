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

/// Strength and colour of the dielectric's reflection (`KHR_materials_specular`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Specular {
    /// Reflectance at grazing incidence, which scales all of the reflection, `[0, 1]`.
    pub factor: f32,
    /// Multiplies `factor`, alpha channel.
    pub factor_texture: Option<TextureRef>,
    /// Multiplies the reflectance at normal incidence, linear, 0 or more; the product is at most 1.
    pub color: Vec3,
    /// sRGB-encoded texture that multiplies `color`.
    pub color_texture: Option<TextureRef>,
}

/// Fibres that scatter light at grazing angles (`KHR_materials_sheen`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sheen {
    /// Linear, in `[0, 1]`.
    pub color: Vec3,
    /// sRGB-encoded texture that multiplies `color`.
    pub color_texture: Option<TextureRef>,
    /// Perceptual roughness in `[0, 1]`.
    pub roughness: f32,
    /// Multiplies `roughness`, alpha channel.
    pub roughness_texture: Option<TextureRef>,
}

/// Highlights that are longer in one direction (`KHR_materials_anisotropy`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Anisotropy {
    /// How much rougher the surface is along the direction, `[0, 1]`.
    pub strength: f32,
    /// The direction, from the tangent towards the bitangent, radians.
    pub rotation_rad: f32,
    /// Red and green turn the direction, as a vector in `[-1, 1]`; blue multiplies `strength`.
    pub texture: Option<TextureRef>,
}

/// A thin film over the base (`KHR_materials_iridescence`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Iridescence {
    /// Share of the surface that has the film, `[0, 1]`.
    pub factor: f32,
    /// Multiplies `factor`, red channel.
    pub factor_texture: Option<TextureRef>,
    /// Index of refraction of the film.
    pub ior: f32,
    /// Thickness where the texture is 0 and where it is 1, or is missing, nanometres.
    pub thickness_nm: [f32; 2],
    /// Thickness between the two, green channel.
    pub thickness_texture: Option<TextureRef>,
}

/// What fills a transmissive object (`KHR_materials_volume`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Volume {
    /// Length of the way through a sheet that has no inner side, metres; above 0.
    pub thickness: f32,
    /// Multiplies `thickness`, green channel.
    pub thickness_texture: Option<TextureRef>,
    /// What white light turns into on a way of `attenuation_distance`, linear, in `(0, 1]`.
    pub attenuation_color: Vec3,
    /// Metres; infinite for a clear volume.
    pub attenuation_distance: f32,
}

/// Extensions of the metallic-roughness model beside coat and transmission.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MaterialExtensions {
    /// Strength and colour of the dielectric's reflection.
    pub specular: Option<Specular>,
    /// Fibres.
    pub sheen: Option<Sheen>,
    /// Longer highlights.
    pub anisotropy: Option<Anisotropy>,
    /// A thin film.
    pub iridescence: Option<Iridescence>,
    /// What fills the object.
    pub volume: Option<Volume>,
}

impl MaterialExtensions {
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// All uses of textures.
    pub fn textures_mut(&mut self) -> impl Iterator<Item = &mut Option<TextureRef>> {
        let specular = self.specular.iter_mut();
        let sheen = self.sheen.iter_mut();
        let film = self.iridescence.iter_mut();
        specular
            .flat_map(|s| [&mut s.factor_texture, &mut s.color_texture])
            .chain(sheen.flat_map(|s| [&mut s.color_texture, &mut s.roughness_texture]))
            .chain(self.anisotropy.iter_mut().map(|a| &mut a.texture))
            .chain(film.flat_map(|f| [&mut f.factor_texture, &mut f.thickness_texture]))
            .chain(self.volume.iter_mut().map(|v| &mut v.thickness_texture))
    }

    /// All uses of textures.
    pub fn textures(&self) -> impl Iterator<Item = &TextureRef> {
        let specular = self.specular.iter();
        let sheen = self.sheen.iter();
        let film = self.iridescence.iter();
        specular
            .flat_map(|s| [&s.factor_texture, &s.color_texture])
            .chain(sheen.flat_map(|s| [&s.color_texture, &s.roughness_texture]))
            .chain(self.anisotropy.iter().map(|a| &a.texture))
            .chain(film.flat_map(|f| [&f.factor_texture, &f.thickness_texture]))
            .chain(self.volume.iter().map(|v| &v.thickness_texture))
            .flatten()
    }
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
    /// Whether blue multiplies metallic: a grey map of roughness alone leaves it.
    pub metallic_is_textured: bool,
    /// Tangent-space normal map and its scale.
    pub normal_texture: Option<(TextureRef, f32)>,
    /// Emitted radiance, linear, strength (`KHR_materials_emissive_strength`) multiplied in.
    pub emissive: Vec3,
    /// sRGB-encoded texture that multiplies `emissive`.
    pub emissive_texture: Option<TextureRef>,
    /// Coverage.
    pub alpha_mode: AlphaMode,
    /// Whether the back face is seen too. The back of a single-sided surface is invisible to camera
    /// and path rays, but still blocks the light that would reach the proxy.
    pub double_sided: bool,
    /// Index of refraction of the dielectric interface (`KHR_materials_ior`), 1.5 by default.
    pub ior: f32,
    /// Coat, if any.
    pub clearcoat: Option<Clearcoat>,
    /// Transmission, if any.
    pub transmission: Option<Transmission>,
    /// Further extensions.
    pub extensions: MaterialExtensions,
    /// `KHR_materials_unlit`: radiance is the base colour, whatever the light.
    pub unlit: bool,
}

impl TextureRef {
    /// Texture coordinates after the material's transform.
    pub fn apply(&self, uv: glam::Vec2) -> glam::Vec2 {
        self.transform.transform_point2(uv)
    }
}

impl Default for Material {
    /// glTF's default material: white, fully metallic, fully rough.
    fn default() -> Self {
        Self {
            name: String::new(),
            base_color: Vec4::ONE,
            base_color_texture: None,
            metallic: 1.0,
            roughness: 1.0,
            metallic_roughness_texture: None,
            metallic_is_textured: true,
            normal_texture: None,
            emissive: Vec3::ZERO,
            emissive_texture: None,
            alpha_mode: AlphaMode::Opaque,
            double_sided: false,
            ior: 1.5,
            clearcoat: None,
            transmission: None,
            extensions: MaterialExtensions::default(),
            unlit: false,
        }
    }
}

impl Material {
    /// All uses of textures.
    pub fn texture_refs(&self) -> impl Iterator<Item = &TextureRef> {
        let own = self.textures().into_iter().flatten();
        own.chain(self.extensions.textures())
    }

    /// Adds `offset` to the index of every texture, as is needed when the textures of several
    /// files are put into one list.
    pub fn shift_textures(&mut self, offset: u32) {
        let coat = self.clearcoat.as_mut();
        let (coat_factor, coat_roughness, coat_normal) = match coat {
            Some(c) => (
                c.factor_texture.as_mut(),
                c.roughness_texture.as_mut(),
                c.normal_texture.as_mut().map(|(t, _)| t),
            ),
            None => (None, None, None),
        };
        let all = [
            self.base_color_texture.as_mut(),
            self.metallic_roughness_texture.as_mut(),
            self.normal_texture.as_mut().map(|(t, _)| t),
            self.emissive_texture.as_mut(),
            coat_factor,
            coat_roughness,
            coat_normal,
            self.transmission.as_mut().and_then(|t| t.texture.as_mut()),
        ];
        let further = self.extensions.textures_mut().flatten();
        for texture in all.into_iter().flatten().chain(further) {
            texture.texture += offset;
        }
    }

    fn textures(&self) -> [Option<&TextureRef>; 8] {
        let coat = self.clearcoat.as_ref();
        [
            self.base_color_texture.as_ref(),
            self.metallic_roughness_texture.as_ref(),
            self.normal_texture.as_ref().map(|(t, _)| t),
            self.emissive_texture.as_ref(),
            coat.and_then(|c| c.factor_texture.as_ref()),
            coat.and_then(|c| c.roughness_texture.as_ref()),
            coat.and_then(|c| c.normal_texture.as_ref().map(|(t, _)| t)),
            self.transmission.as_ref().and_then(|t| t.texture.as_ref()),
        ]
    }
}
