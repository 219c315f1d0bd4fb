//! Extensions of the metallic-roughness model: specular, sheen, anisotropy, iridescence, volume.
use glam::Vec3;
use gltf::json::texture::Info;
use serde_json::{Map, Value};

use super::MaterialReader;
use crate::error::Error;
use crate::import::document::{self, raw_extension};
use crate::material::{
    Anisotropy, Iridescence, Material, MaterialExtensions, Sheen, Specular, TextureRef, Volume,
};
use crate::texture::Encoding;

const SPECULAR: &str = "KHR_materials_specular";
const SHEEN: &str = "KHR_materials_sheen";
const ANISOTROPY: &str = "KHR_materials_anisotropy";
const IRIDESCENCE: &str = "KHR_materials_iridescence";
const VOLUME: &str = "KHR_materials_volume";

/// The extensions that are read here.
pub(super) const READ: [&str; 5] = [SPECULAR, SHEEN, ANISOTROPY, IRIDESCENCE, VOLUME];

/// Attenuation to black within the distance has no finite coefficient: this is black enough.
const LEAST_ATTENUATION: f32 = 1e-6;

/// Names that a warning lists.
const MOST_NAMES: usize = 5;

/// A warning that names the solids whose refraction is left out.
pub(in crate::import) fn without_refraction(materials: &[Material]) -> Option<String> {
    let bends =
        |m: &Material| m.transmission.is_some() && m.extensions.volume.is_some() && m.ior > 1.0;
    let named = |(i, m): (usize, &Material)| match m.name.is_empty() {
        true => format!("materials[{i}]"),
        false => format!("\"{}\"", m.name),
    };
    let all = materials.iter().enumerate().filter(|(_, m)| bends(m));
    let names: Vec<String> = all.map(named).collect();
    let more = match names.len() {
        0 => return None,
        n if n > MOST_NAMES => format!(" and {} more", n - MOST_NAMES),
        _ => String::new(),
    };
    Some(format!(
        "the refraction of the solid {}{more} (KHR_materials_volume) is left out: light is attenuated there, but goes straight on",
        names[..names.len().min(MOST_NAMES)].join(", ")
    ))
}

impl MaterialReader<'_> {
    /// Reads those of [`READ`] that have an effect.
    pub(super) fn extensions(
        &mut self,
        others: &Map<String, Value>,
        at: &str,
    ) -> Result<MaterialExtensions, Error> {
        let mut all = MaterialExtensions::default();
        if let Some(e) = raw_extension(others, SPECULAR, at)? {
            all.specular = self.specular(&e, at)?;
        }
        if let Some(e) = raw_extension(others, SHEEN, at)? {
            all.sheen = self.sheen(&e, at)?;
        }
        if let Some(e) = raw_extension(others, ANISOTROPY, at)? {
            all.anisotropy = self.anisotropy(&e, at)?;
        }
        if let Some(e) = raw_extension(others, IRIDESCENCE, at)? {
            all.iridescence = self.iridescence(&e, at)?;
        }
        if let Some(e) = raw_extension(others, VOLUME, at)? {
            all.volume = self.volume(&e, at)?;
        }
        Ok(all)
    }

    fn linear(
        &mut self,
        info: &Option<Info>,
        at: &str,
        name: &str,
    ) -> Result<Option<TextureRef>, Error> {
        self.texture(info, at, name, Encoding::Linear)
    }

    fn srgb(
        &mut self,
        info: &Option<Info>,
        at: &str,
        name: &str,
    ) -> Result<Option<TextureRef>, Error> {
        self.texture(info, at, name, Encoding::Srgb)
    }

    fn specular(&mut self, e: &document::Specular, at: &str) -> Result<Option<Specular>, Error> {
        let color = e.specular_color_factor;
        let color = color.map(|v| self.factor(v, 1e4, 1.0, at, "specularColorFactor"));
        Ok(Some(Specular {
            factor: self.factor(e.specular_factor, 1.0, 1.0, at, "specularFactor"),
            factor_texture: self.linear(&e.specular_texture, at, "specularTexture")?,
            color: Vec3::from_array(color),
            color_texture: self.srgb(&e.specular_color_texture, at, "specularColorTexture")?,
        })
        .filter(|s| {
            let textures = (s.factor_texture, s.color_texture);
            (s.factor, s.color, textures) != (1.0, Vec3::ONE, (None, None))
        }))
    }

    fn sheen(&mut self, e: &document::Sheen, at: &str) -> Result<Option<Sheen>, Error> {
        let color = e.sheen_color_factor;
        let color = color.map(|v| self.factor(v, 1.0, 0.0, at, "sheenColorFactor"));
        if color == [0.0; 3] {
            return Ok(None);
        }
        let roughness = e.sheen_roughness_factor;
        Ok(Some(Sheen {
            color: Vec3::from_array(color),
            color_texture: self.srgb(&e.sheen_color_texture, at, "sheenColorTexture")?,
            roughness: self.factor(roughness, 1.0, 0.0, at, "sheenRoughnessFactor"),
            roughness_texture: self.linear(
                &e.sheen_roughness_texture,
                at,
                "sheenRoughnessTexture",
            )?,
        }))
    }

    fn anisotropy(
        &mut self,
        e: &document::Anisotropy,
        at: &str,
    ) -> Result<Option<Anisotropy>, Error> {
        let strength = self.factor(e.anisotropy_strength, 1.0, 0.0, at, "anisotropyStrength");
        if strength == 0.0 {
            return Ok(None);
        }
        let rotation = Some(e.anisotropy_rotation).filter(|r| r.is_finite());
        Ok(Some(Anisotropy {
            strength,
            rotation_rad: rotation.unwrap_or(0.0),
            texture: self.linear(&e.anisotropy_texture, at, "anisotropyTexture")?,
        }))
    }

    fn iridescence(
        &mut self,
        e: &document::Iridescence,
        at: &str,
    ) -> Result<Option<Iridescence>, Error> {
        let factor = self.factor(e.iridescence_factor, 1.0, 0.0, at, "iridescenceFactor");
        if factor == 0.0 {
            return Ok(None);
        }
        let minimum = e.iridescence_thickness_minimum;
        let maximum = e.iridescence_thickness_maximum;
        Ok(Some(Iridescence {
            factor,
            factor_texture: self.linear(&e.iridescence_texture, at, "iridescenceTexture")?,
            ior: self
                .factor(e.iridescence_ior, 10.0, 1.3, at, "iridescenceIor")
                .max(1.0),
            thickness_nm: [
                self.factor(minimum, 1e5, 100.0, at, "iridescenceThicknessMinimum"),
                self.factor(maximum, 1e5, 400.0, at, "iridescenceThicknessMaximum"),
            ],
            thickness_texture: self.linear(
                &e.iridescence_thickness_texture,
                at,
                "iridescenceThicknessTexture",
            )?,
        }))
    }

    fn volume(&mut self, e: &document::Volume, at: &str) -> Result<Option<Volume>, Error> {
        let thickness = self.factor(e.thickness_factor, 1e6, 0.0, at, "thicknessFactor");
        if thickness == 0.0 {
            return Ok(None);
        }
        let color = e.attenuation_color;
        let color = color.map(|v| self.factor(v, 1.0, 1.0, at, "attenuationColor"));
        let distance = match e.attenuation_distance {
            Some(d) if d > 0.0 => d,
            Some(d) => {
                self.warnings.push(format!(
                    "{at}: attenuationDistance is {d}; it must be above 0: the volume is clear"
                ));
                f32::INFINITY
            }
            None => f32::INFINITY,
        };
        Ok(Some(Volume {
            thickness,
            thickness_texture: self.linear(&e.thickness_texture, at, "thicknessTexture")?,
            attenuation_color: Vec3::from_array(color).max(Vec3::splat(LEAST_ATTENUATION)),
            attenuation_distance: distance,
        }))
    }
}
