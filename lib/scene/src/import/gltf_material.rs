//! Materials, textures and images of a glTF document.
use std::collections::HashMap;
use std::sync::Arc;

use glam::{Mat3, Vec2, Vec3, Vec4};
use gltf::json::extensions::texture::TextureTransform;
use gltf::json::material::NormalTexture;
use gltf::json::texture::{Info, MagFilter, Sampler, WrappingMode};
use gltf::json::validation::Checked;
use gltf::json::{self, Index};
use serde::Deserialize;

use super::accessor::{Buffers, get};
use super::container::{self, Resolver};
use super::document::{self, Document, raw_extension};
use crate::error::Error;
use crate::material::{AlphaMode, Clearcoat, Material, Specular, TextureRef, Transmission};

pub(super) mod extensions;
use crate::texture::{Encoding, Filter, ImageSource, Texture, Wrap};

const EXPORT: &str = "export the file again";

/// Image formats that hide behind a texture extension and are not read.
pub(super) const IMAGE_EXTENSIONS: [&str; 3] =
    ["KHR_texture_basisu", "EXT_texture_avif", "MSFT_texture_dds"];

const WEBP: &str = "EXT_texture_webp";

/// That extension of a texture.
#[derive(Deserialize)]
struct Webp {
    source: u32,
}

/// What to do about one of [`IMAGE_EXTENSIONS`].
pub(super) fn image_remedy(extension: &str) -> &'static str {
    match extension {
        "KHR_texture_basisu" => {
            "convert the textures to PNG: gltf-transform ktxdecompress IN.glb OUT.glb"
        }
        "EXT_texture_avif" => "convert the textures to PNG: gltf-transform png IN.glb OUT.glb",
        _ => "export the textures as PNG or JPEG",
    }
}

/// An index of refraction that reflects all but 4e-4 of light.
const MIRROR: f32 = 1e4;

const CLEARCOAT: &str = "KHR_materials_clearcoat";

/// Collects what materials refer to.
pub(super) struct MaterialReader<'a> {
    document: &'a Document<'a>,
    buffers: &'a Buffers<'a>,
    resolver: &'a dyn Resolver,
    /// `None` where the file is missing.
    images: HashMap<usize, Option<ImageSource>>,
    /// By glTF texture and encoding.
    known: HashMap<(usize, Encoding), u32>,
    pub textures: Vec<Texture>,
    pub warnings: Vec<String>,
}

impl<'a> MaterialReader<'a> {
    pub fn new(
        document: &'a Document<'a>,
        buffers: &'a Buffers<'a>,
        resolver: &'a dyn Resolver,
    ) -> Self {
        Self {
            document,
            buffers,
            resolver,
            images: HashMap::new(),
            known: HashMap::new(),
            textures: Vec::new(),
            warnings: Vec::new(),
        }
    }

    /// Reads `materials[index]`.
    pub fn read(&mut self, index: usize) -> Result<Material, Error> {
        let at = format!("materials[{index}]");
        let source = &self.document.materials[index];
        let extensions = source.extensions.as_ref();
        let mut unread: Vec<&str> = extensions
            .iter()
            .flat_map(|e| e.others.keys())
            .map(String::as_str)
            .filter(|name| *name != CLEARCOAT && !extensions::READ.contains(name))
            .collect();
        unread.sort_unstable();
        if !unread.is_empty() {
            self.warnings.push(format!(
                "{at}: {} not supported and left out",
                unread.join(", ")
            ));
        }
        let mut material = Material {
            name: source.name.clone().unwrap_or_default(),
            double_sided: source.double_sided,
            unlit: extensions.is_some_and(|e| e.unlit.is_some()),
            ..Material::default()
        };
        self.read_base(index, &at, &mut material)?;
        material.normal_texture = self.normal_map(&source.normal_texture, &at, "normalTexture")?;
        self.read_emission(source, &at, &mut material)?;
        material.alpha_mode = match source.alpha_mode {
            Checked::Valid(json::material::AlphaMode::Opaque) => AlphaMode::Opaque,
            Checked::Valid(json::material::AlphaMode::Mask) => {
                let cutoff = source.alpha_cutoff.unwrap_or_default().0;
                AlphaMode::Mask {
                    cutoff: self.factor(cutoff, f32::MAX, 0.5, &at, "alphaCutoff"),
                }
            }
            Checked::Valid(json::material::AlphaMode::Blend) => AlphaMode::Blend,
            Checked::Invalid => {
                let pointer = format!("/materials/{index}/alphaMode");
                return Err(Error::malformed(
                    format!(
                        "{at}.alphaMode is {}; accepted: OPAQUE, MASK, BLEND",
                        self.document.quoted(&pointer)
                    ),
                    EXPORT,
                ));
            }
        };
        let Some(extensions) = extensions else {
            return Ok(material);
        };
        if let Some(coat) = raw_extension(&extensions.others, CLEARCOAT, &at)? {
            material.clearcoat = self.clearcoat(&coat, &at)?;
        }
        let of_old_model = material.extensions.specular;
        material.extensions = self.extensions(&extensions.others, &at)?;
        material.extensions.specular = of_old_model.or(material.extensions.specular);
        if let Some(transmission) = &extensions.transmission {
            let factor = transmission.transmission_factor.0;
            let factor = self.factor(factor, 1.0, 0.0, &at, "transmissionFactor");
            if factor > 0.0 {
                material.transmission = Some(Transmission {
                    factor,
                    texture: self.texture(
                        &transmission.transmission_texture,
                        &at,
                        "transmissionTexture",
                        Encoding::Linear,
                    )?,
                });
            }
        }
        if let Some(ior) = extensions.ior.as_ref().map(|e| e.ior.0) {
            // 0 is the extension's name for "reflects like a mirror everywhere": large enough.
            let ior = if ior == 0.0 { MIRROR } else { ior };
            material.ior = self.factor(ior, MIRROR, 1.5, &at, "ior").max(1.0);
        }
        Ok(material)
    }

    fn read_base(&mut self, index: usize, at: &str, material: &mut Material) -> Result<(), Error> {
        let source = &self.document.materials[index];
        let old = source.extensions.as_ref();
        let old = old.and_then(|e| e.pbr_specular_glossiness.as_ref());
        let unit = |s: &mut Self, v, name| s.factor(v, 1.0, 1.0, at, name);
        let color = |s: &mut Self, c: [f32; 4]| {
            Vec4::from_array(c.map(|v| s.factor(v, 1.0, 1.0, at, "baseColorFactor")))
        };
        if let Some(old) = old.filter(|_| !self.document.has_metallic_roughness(index)) {
            material.base_color = color(self, old.diffuse_factor.0);
            material.metallic = 0.0;
            material.roughness = 1.0 - unit(self, old.glossiness_factor.0, "glossinessFactor");
            material.base_color_texture =
                self.texture(&old.diffuse_texture, at, "diffuseTexture", Encoding::Srgb)?;
            let name = "specularGlossinessTexture";
            let reflectance = Vec3::from_array(old.specular_factor.0);
            let reflectance = reflectance.clamp(Vec3::ZERO, Vec3::ONE);
            let most = reflectance.max_element();
            material.ior = ior_of(most);
            let color = match most > 0.0 {
                true => reflectance / most,
                false => Vec3::ONE,
            };
            let color_texture =
                self.texture(&old.specular_glossiness_texture, at, name, Encoding::Srgb)?;
            if color != Vec3::ONE || color_texture.is_some() {
                material.extensions.specular = Some(Specular {
                    factor: 1.0,
                    factor_texture: None,
                    color,
                    color_texture,
                });
            }
            if old.specular_glossiness_texture.is_some() {
                self.warnings.push(format!(
                    "{at}: the glossiness in {name} is not read; glossinessFactor alone is used"
                ));
            }
            return Ok(());
        }
        let pbr = &source.pbr_metallic_roughness;
        material.base_color = color(self, pbr.base_color_factor.0);
        material.metallic = unit(self, pbr.metallic_factor.0, "metallicFactor");
        material.roughness = unit(self, pbr.roughness_factor.0, "roughnessFactor");
        material.base_color_texture = self.texture(
            &pbr.base_color_texture,
            at,
            "baseColorTexture",
            Encoding::Srgb,
        )?;
        material.metallic_roughness_texture = self.texture(
            &pbr.metallic_roughness_texture,
            at,
            "metallicRoughnessTexture",
            Encoding::Linear,
        )?;
        Ok(())
    }

    fn read_emission(
        &mut self,
        source: &json::Material,
        at: &str,
        material: &mut Material,
    ) -> Result<(), Error> {
        let extensions = source.extensions.as_ref();
        let strength = extensions.and_then(|e| e.emissive_strength.as_ref());
        let strength = strength.map_or(1.0, |e| e.emissive_strength.0);
        let strength = self.factor(strength, 1e12, 1.0, at, "emissiveStrength");
        let factor = source.emissive_factor.0;
        let factor = factor.map(|v| self.factor(v, 1e12, 0.0, at, "emissiveFactor"));
        material.emissive = Vec3::from_array(factor) * strength;
        // A texture times zero is no reason to decode it.
        if material.emissive != Vec3::ZERO {
            material.emissive_texture = self.texture(
                &source.emissive_texture,
                at,
                "emissiveTexture",
                Encoding::Srgb,
            )?;
            if source.emissive_texture.is_some() && material.emissive_texture.is_none() {
                // What glows only in places shall not glow all over.
                material.emissive = Vec3::ZERO;
                self.warnings.push(format!(
                    "{at}: without emissiveTexture it does not emit light"
                ));
            }
        }
        Ok(())
    }

    fn clearcoat(
        &mut self,
        coat: &document::Clearcoat,
        at: &str,
    ) -> Result<Option<Clearcoat>, Error> {
        let factor = self.factor(coat.clearcoat_factor, 1.0, 0.0, at, "clearcoatFactor");
        if factor == 0.0 {
            return Ok(None);
        }
        let roughness = coat.clearcoat_roughness_factor;
        Ok(Some(Clearcoat {
            factor,
            factor_texture: self.texture(
                &coat.clearcoat_texture,
                at,
                "clearcoatTexture",
                Encoding::Linear,
            )?,
            roughness: self.factor(roughness, 1.0, 0.0, at, "clearcoatRoughnessFactor"),
            roughness_texture: self.texture(
                &coat.clearcoat_roughness_texture,
                at,
                "clearcoatRoughnessTexture",
                Encoding::Linear,
            )?,
            normal_texture: self.normal_map(
                &coat.clearcoat_normal_texture,
                at,
                "clearcoatNormalTexture",
            )?,
        }))
    }

    /// Brings a factor into `[0, max]`, with a warning if it was outside.
    fn factor(&mut self, value: f32, max: f32, fallback: f32, at: &str, name: &str) -> f32 {
        let kept = if value.is_finite() {
            value.clamp(0.0, max)
        } else {
            fallback
        };
        if kept != value {
            self.warnings
                .push(format!("{at}: {name} is {value}; {kept} is used"));
        }
        kept
    }

    fn normal_map(
        &mut self,
        source: &Option<NormalTexture>,
        at: &str,
        name: &str,
    ) -> Result<Option<(TextureRef, f32)>, Error> {
        let Some(source) = source else {
            return Ok(None);
        };
        let transform: Option<TextureTransform> = match &source.extensions {
            Some(e) => raw_extension(&e.others, "KHR_texture_transform", &format!("{at}.{name}"))?,
            None => None,
        };
        let scale = Some(source.scale).filter(|s| s.is_finite());
        let texture = self.texture_ref(
            source.index,
            source.tex_coord,
            transform.as_ref(),
            at,
            name,
            Encoding::Linear,
        )?;
        Ok(texture.map(|t| (t, scale.unwrap_or(1.0))))
    }

    fn texture(
        &mut self,
        info: &Option<Info>,
        at: &str,
        name: &str,
        encoding: Encoding,
    ) -> Result<Option<TextureRef>, Error> {
        let Some(info) = info else {
            return Ok(None);
        };
        let transform = info.extensions.as_ref();
        let transform = transform.and_then(|e| e.texture_transform.as_ref());
        self.texture_ref(info.index, info.tex_coord, transform, at, name, encoding)
    }

    fn texture_ref(
        &mut self,
        index: Index<json::Texture>,
        tex_coord: u32,
        transform: Option<&TextureTransform>,
        at: &str,
        name: &str,
        encoding: Encoding,
    ) -> Result<Option<TextureRef>, Error> {
        let place = format!("{at}.{name}.index");
        get(&self.document.textures, index.value(), &place, "textures")?;
        let Some(texture) = self.texture_index(index.value(), encoding)? else {
            return Ok(None);
        };
        let set = transform.and_then(|t| t.tex_coord).unwrap_or(tex_coord);
        if set > 1 {
            self.warnings.push(format!(
                "{at}: {name} reads TEXCOORD_{set}; two sets are supported, TEXCOORD_0 is used"
            ));
        }
        Ok(Some(TextureRef {
            texture,
            uv_set: if set == 1 { 1 } else { 0 },
            transform: transform.map_or(Mat3::IDENTITY, uv_transform),
        }))
    }

    /// Our index of a glTF texture; `None` if it has no image that can be read.
    fn texture_index(&mut self, index: usize, encoding: Encoding) -> Result<Option<u32>, Error> {
        if let Some(&known) = self.known.get(&(index, encoding)) {
            return Ok(Some(known));
        }
        let source = &self.document.textures[index];
        let at = format!("textures[{index}]");
        let webp: Option<Webp> = match &source.extensions {
            Some(e) => raw_extension(&e.others, WEBP, &at)?,
            None => None,
        };
        let mut image = source.source.value();
        if image == u32::MAX as usize
            && let Some(webp) = webp
        {
            image = webp.source as usize;
        }
        // The model's way of saying that there is none.
        if image == u32::MAX as usize {
            let known = |e: &&&str| {
                let extensions = source.extensions.as_ref();
                extensions.is_some_and(|all| all.others.contains_key(**e))
            };
            return match IMAGE_EXTENSIONS.iter().find(known) {
                Some(extension) => Err(Error::UnsupportedExtension {
                    extension: (*extension).into(),
                    remedy: image_remedy(extension),
                }),
                None => {
                    self.warnings
                        .push(format!("{at} has no image and is left out"));
                    Ok(None)
                }
            };
        }
        let (wrap, filter) = match source.sampler {
            None => Default::default(),
            Some(sampler) => {
                let place = format!("{at}.sampler");
                let samplers = &self.document.samplers;
                lookup(get(samplers, sampler.value(), &place, "samplers")?)
            }
        };
        let Some(image) = self.image(image, &format!("{at}.source"))? else {
            return Ok(None);
        };
        self.textures.push(Texture {
            image,
            encoding,
            wrap,
            filter,
        });
        let ours = self.textures.len() as u32 - 1;
        self.known.insert((index, encoding), ours);
        Ok(Some(ours))
    }

    fn image(&mut self, index: usize, place: &str) -> Result<Option<ImageSource>, Error> {
        if let Some(known) = self.images.get(&index) {
            return Ok(known.clone());
        }
        let source = get(&self.document.images, index, place, "images")?;
        let at = format!("images[{index}]");
        let name = match &source.name {
            Some(name) => format!("{at} ({name})"),
            None => at.clone(),
        };
        let embedded = |bytes: Vec<u8>| {
            Some(ImageSource::Bytes {
                name: name.clone(),
                bytes: Arc::from(bytes),
            })
        };
        let image = match (&source.uri, source.buffer_view) {
            (None, None) => {
                return Err(Error::malformed(
                    format!("{at} has neither uri nor bufferView"),
                    EXPORT,
                ));
            }
            (None, Some(view)) => {
                let (bytes, _) = self.buffers.view(view, &format!("{at}.bufferView"))?;
                embedded(bytes.to_vec())
            }
            (Some(uri), _) => match container::data_uri(uri, &at) {
                Some(bytes) => embedded(bytes?),
                None => {
                    let what = format!("the texture {name}");
                    container::image(self.resolver, uri, what, &mut self.warnings)?
                }
            },
        };
        self.images.insert(index, image.clone());
        Ok(image)
    }
}

/// The index of refraction of a surface that reflects so much at normal incidence.
fn ior_of(reflectance: f32) -> f32 {
    let root = reflectance.sqrt();
    ((1.0 + root) / (1.0 - root)).min(MIRROR)
}

/// `KHR_texture_transform`: scale, then rotate counter-clockwise in the image, then offset.
fn uv_transform(t: &TextureTransform) -> Mat3 {
    let (scale, offset) = (Vec2::from_array(t.scale.0), Vec2::from_array(t.offset.0));
    let (sin, cos) = t.rotation.0.sin_cos();
    let all = Mat3::from_cols(
        Vec3::new(cos, -sin, 0.0) * scale.x,
        Vec3::new(sin, cos, 0.0) * scale.y,
        offset.extend(1.0),
    );
    if all.is_finite() { all } else { Mat3::IDENTITY }
}

/// There are no mipmaps here: only the magnification filter counts. Unknown codes mean the default.
fn lookup(sampler: &Sampler) -> ([Wrap; 2], Filter) {
    let wrap = |mode: Checked<WrappingMode>| match mode {
        Checked::Valid(WrappingMode::ClampToEdge) => Wrap::ClampToEdge,
        Checked::Valid(WrappingMode::MirroredRepeat) => Wrap::MirroredRepeat,
        _ => Wrap::Repeat,
    };
    let filter = match sampler.mag_filter {
        Some(Checked::Valid(MagFilter::Nearest)) => Filter::Nearest,
        _ => Filter::Linear,
    };
    ([wrap(sampler.wrap_s), wrap(sampler.wrap_t)], filter)
}
