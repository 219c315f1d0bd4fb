//! Material libraries of OBJ files, with the usual extension for physically based materials.
//!
//! `Kd`/`map_Kd` become the base colour, `Pm` metalness, `Pr` roughness; without `Pr` roughness
//! follows from the Blinn-Phong exponent `Ns` by `alpha^2 = 2 / (Ns + 2)` [Walter et al. 2007,
//! section 5.2]. A black `Ks` switches the dielectric reflection off. Surfaces are double-sided, for
//! the format does not say which side is the front.
//!
//! Glass is what refracts (`illum` 6 and 7) by an index (`Ni` above 1), is opaque by `d` and has no `map_Kd`, in the colour of
//! `Tf`. With `d` below 1 the same numbers come from exporters that mean no more than `d`; some write 7 of every surface, but
//! no index; and 4 and 9, glass by the format's name, are written of opaque surfaces.
use std::borrow::Cow;
use std::collections::{HashMap, HashSet};

use glam::{Mat3, Vec2, Vec3, Vec4};

use super::container::{self, Resolver};
use super::opacity;
use crate::error::Error;
use crate::limits::Limits;
use crate::material::{AlphaMode, Clearcoat, Material, TextureRef, Transmission};
use crate::texture::{Encoding, Filter, Texture, Wrap};

/// Statements that change what a surface looks like and are not read.
const LEFT_OUT: [&str; 13] = [
    "Ps", "aniso", "map_Ks", "map_Ns", "map_Ps", "map_Pc", "map_Pcr", "map_Tr", "map_refl",
    "map_disp", "disp", "decal", "refl",
];

/// Statements that are read, as the format spells them: some exporters write them small.
const READ: [&str; 22] = [
    "newmtl", "Kd", "Ks", "Ke", "Ns", "Ni", "Tf", "Tr", "d", "illum", "Pr", "Pm", "Pc", "Pcr",
    "map_Kd", "map_Ke", "map_Pr", "map_Pm", "map_d", "map_Bump", "norm", "bump",
];

/// Linear Rec.709 of CIE XYZ, by columns [IEC 61966-2-1].
const REC709_OF_XYZ: Mat3 = Mat3::from_cols(
    Vec3::new(3.2404542, -0.969266, 0.0556434),
    Vec3::new(-1.5371385, 1.8760108, -0.2040259),
    Vec3::new(-0.4985314, 0.041556, 1.0572252),
);

/// What a triangle without a material gets.
pub(super) fn grey() -> Material {
    Material {
        base_color: Vec4::new(0.8, 0.8, 0.8, 1.0),
        metallic: 0.0,
        roughness: 1.0,
        double_sided: true,
        ..Material::default()
    }
}

/// The first word of a line and what follows it, without a comment. A name of a material may hold a `#`, as `Material #25`
/// does: a comment behind it is cut off where no material has the whole name. Names of files hold it within a word.
pub(super) fn statement(line: &str) -> (&str, &str) {
    let line = line.trim();
    let (word, rest) = line
        .split_once(char::is_whitespace)
        .map_or((line, ""), |(w, r)| (w, r.trim()));
    let is = |name: &&str| word.eq_ignore_ascii_case(name);
    let is_map = (word.get(..4)).is_some_and(|start| start.eq_ignore_ascii_case("map_"));
    let blank = |at: usize| {
        rest[..at]
            .chars()
            .next_back()
            .is_none_or(char::is_whitespace)
    };
    if word.starts_with('#') {
        ("", "")
    } else if ["usemtl", "newmtl"].iter().any(is) {
        (word, rest)
    } else if is_map || ["mtllib", "norm", "bump"].iter().any(is) {
        let mut marks = rest.match_indices('#').map(|(at, _)| at);
        let end = marks.find(|at| blank(*at)).unwrap_or(rest.len());
        (word, rest[..end].trim())
    } else {
        (word, without_comment(rest))
    }
}

fn without_comment(text: &str) -> &str {
    text.split('#').next().unwrap_or_default().trim()
}

/// The materials of all libraries of a file.
#[derive(Default)]
pub(super) struct Library {
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
    pub warnings: Vec<String>,
    /// Materials with a `map_Bump`, which may be one of heights, and how that is written.
    bumps: Vec<(usize, String)>,
    /// Materials with a `map_d` in a file of its own.
    opacities: Vec<(usize, TextureRef)>,
    by_name: HashMap<String, u32>,
    by_file: HashMap<(String, Encoding, bool), u32>,
}

/// A material while its statements are read.
#[derive(Default)]
struct Draft {
    diffuse: Option<Vec3>,
    base_file: String,
    shininess: Option<f32>,
    roughness: Option<f32>,
    roughness_file: Option<String>,
    metallic_file: Option<String>,
    opacity: Option<Map>,
    /// Weight and roughness of the coat.
    coat: [f32; 2],
    /// Statements that change the surface and are not read.
    left_out: Vec<String>,
    /// Whether there is a `map_Ke`.
    has_emission_map: bool,
    /// Whether `d` was written.
    has_opacity: bool,
    /// The `illum` of a surface that refracts.
    refraction: Option<String>,
    /// Whether `Ni` is above 1.
    has_index: bool,
    /// `Tf`, but for black and white.
    filter: Option<Vec3>,
}

/// An image statement: the file and its options.
struct Map {
    file: String,
    transform: Mat3,
    clamp: bool,
    bump: f32,
}

impl Library {
    pub fn index_of(&self, name: &str) -> Option<u32> {
        let found = self.by_name.get(name);
        found
            .or_else(|| self.by_name.get(without_comment(name)))
            .copied()
    }

    /// Reads a library; `name` is its path relative to the object, which textures are relative to.
    pub fn read(&mut self, bytes: &[u8], name: &str, resolver: &dyn Resolver) -> Result<(), Error> {
        let name = name.replace('\\', "/");
        let folder = name.rfind('/').map_or("", |i| &name[..=i]);
        let text = dipir_files::without_byte_order_mark(bytes);
        let mut current: Option<(Material, Draft)> = None;
        let end = line_end(bytes);
        for (i, line) in text.split(|b| *b == end).enumerate() {
            let line = decoded(line);
            let (word, rest) = statement(&line);
            let mut known = READ.iter().chain(&LEFT_OUT);
            let word = known
                .find(|k| k.eq_ignore_ascii_case(word))
                .copied()
                .unwrap_or(word);
            if word == "newmtl" {
                if let Some(done) = current.take() {
                    self.finish(done, folder, resolver)?;
                }
                let material = Material {
                    name: rest.to_owned(),
                    ..grey()
                };
                current = Some((material, Draft::default()));
            } else if let Some((material, draft)) = &mut current {
                self.statement(word, rest, folder, resolver, material, draft)
                    .map_err(|e| match e {
                        Error::Malformed { detail, remedy } => {
                            Error::malformed(format!("line {}: {detail}", i + 1), remedy)
                        }
                        other => other,
                    })?;
            }
        }
        if let Some(done) = current {
            self.finish(done, folder, resolver)?;
        }
        Ok(())
    }

    fn statement(
        &mut self,
        word: &str,
        rest: &str,
        folder: &str,
        resolver: &dyn Resolver,
        material: &mut Material,
        draft: &mut Draft,
    ) -> Result<(), Error> {
        let unit = |rest| number(rest).map(|v| v.clamp(0.0, 1.0));
        let is_map = word.starts_with("map_") || ["norm", "bump"].contains(&word);
        if is_map && Map::parse(rest).file.is_empty() {
            let name = &material.name;
            self.warnings
                .push(format!("material \"{name}\": {word} names no file"));
            return Ok(());
        }
        match word {
            "Kd" | "Ks" | "Ke" | "Tf" if is_spectrum(rest) => {
                draft.left_out.push(format!("{word} spectral"));
            }
            "Kd" => draft.diffuse = Some(color(rest)?.min(Vec3::ONE)),
            "Ks" if color(rest)? == Vec3::ZERO => material.ior = 1.0,
            "Ke" => material.emissive = color(rest)?,
            // Maya writes white for opaque, others for clear: black and white say nothing.
            "Tf" => {
                draft.filter = color(rest)
                    .ok()
                    .filter(|c| *c != Vec3::ZERO && *c != Vec3::ONE)
            }
            "illum" => {
                draft.refraction =
                    Some(rest.to_owned()).filter(|n| ["6", "7"].contains(&n.as_str()))
            }
            "Ns" => draft.shininess = Some(number(rest)?.max(0.0)),
            "Ni" => {
                let ior = number(rest)?;
                draft.has_index = ior > 1.0;
                // Many exporters write 1 for "unknown". It would mean a surface without reflection, so it is ignored.
                if ior > 1.0 && material.ior > 1.0 {
                    material.ior = ior.min(10.0);
                }
            }
            "Pr" => draft.roughness = Some(unit(rest)?),
            "Pm" => material.metallic = unit(rest)?,
            "Pc" => draft.coat[0] = unit(rest)?,
            "Pcr" => draft.coat[1] = unit(rest)?,
            "Ps" | "aniso" if number(rest)? == 0.0 => {}
            "d" => {
                material.base_color.w = unit(rest)?;
                draft.has_opacity = true;
            }
            // Some exporters write opacity here: beside d it does not count.
            "Tr" if !draft.has_opacity => material.base_color.w = 1.0 - unit(rest)?,
            "map_Kd" => {
                let map = Map::parse(rest);
                material.base_color_texture =
                    self.texture(&map, folder, resolver, Encoding::Srgb)?;
                draft.base_file = map.file;
            }
            "map_Ke" => {
                let map = Map::parse(rest);
                material.emissive_texture = self.texture(&map, folder, resolver, Encoding::Srgb)?;
                draft.has_emission_map = true;
            }
            "map_Pr" => {
                let map = Map::parse(rest);
                material.metallic_roughness_texture =
                    self.texture(&map, folder, resolver, Encoding::Linear)?;
                draft.roughness_file = material
                    .metallic_roughness_texture
                    .is_some()
                    .then_some(map.file);
            }
            "map_Pm" => draft.metallic_file = Some(Map::parse(rest).file),
            "map_d" => draft.opacity = Some(Map::parse(rest)),
            "norm" | "map_Bump" | "bump" => {
                let map = Map::parse(rest);
                let texture = self.texture(&map, folder, resolver, Encoding::Linear)?;
                material.normal_texture = texture.map(|texture| (texture, map.bump));
                if word != "norm" {
                    self.bumps.push((self.materials.len(), word.into()));
                }
            }
            word if LEFT_OUT.contains(&word) => draft.left_out.push(word.into()),
            _ => {}
        }
        Ok(())
    }

    fn finish(
        &mut self,
        (mut material, mut draft): (Material, Draft),
        folder: &str,
        resolver: &dyn Resolver,
    ) -> Result<(), Error> {
        let name = material.name.clone();
        let has_map = !draft.base_file.is_empty();
        let diffuse = match draft.diffuse {
            // White, so that the texture is seen as it is where no Kd was meant.
            Some(Vec3::ZERO) if has_map => Some(Vec3::ONE),
            None if material.base_color_texture.is_some() => Some(Vec3::ONE),
            own => own,
        };
        if let Some(diffuse) = diffuse {
            material.base_color = diffuse.extend(material.base_color.w);
        }
        material.roughness = match (draft.roughness, draft.shininess) {
            (Some(r), _) => r,
            (None, Some(ns)) => (2.0 / (ns + 2.0)).powf(0.25),
            // A texture multiplies the factor.
            (None, None) => 1.0,
        };
        if draft.roughness_file.is_some() && draft.roughness.is_none() {
            material.roughness = 1.0;
        }
        let is_opaque = material.base_color.w == 1.0 && draft.opacity.is_none();
        let refraction = draft.refraction.filter(|_| is_opaque);
        let is_glass = draft.has_index && !has_map;
        if let Some(illum) = refraction.as_ref().filter(|_| is_glass) {
            self.warnings.push(format!(
                "material \"{name}\" is glass (illum {illum}) that light passes straight: its refraction is left out"
            ));
            material.transmission = Some(Transmission {
                factor: 1.0,
                texture: None,
            });
            let filter = draft.filter.unwrap_or(Vec3::ONE).min(Vec3::ONE);
            material.base_color = filter.extend(1.0);
            // Rays that are refracted are not blurred: Ns is the size of highlights.
            if draft.roughness.is_none() && draft.roughness_file.is_none() {
                material.roughness = 0.0;
            }
        } else {
            let tf = draft.filter.map(|_| "Tf".into());
            let refraction = refraction.map(|illum| format!("illum {illum} (refraction)"));
            draft.left_out.extend(tf.into_iter().chain(refraction));
        }
        // One texture holds both, in green and blue: a grey map of roughness alone shall not dim the metal.
        material.metallic_is_textured = draft.roughness_file == draft.metallic_file;
        match (&draft.roughness_file, &draft.metallic_file) {
            (Some(r), Some(m)) if r == m => {
                if material.metallic == 0.0 {
                    material.metallic = 1.0;
                }
            }
            (_, None) => {}
            _ => self.warnings.push(format!(
                "material \"{name}\": metalness and roughness textures are read only from one common file; metalness is constant"
            )),
        }
        if let Some(map) = &draft.opacity {
            let base = material.base_color_texture;
            if map.file == draft.base_file {
                material.alpha_mode = AlphaMode::Blend;
            } else if base.is_some_and(|base| base.transform != map.transform) {
                self.warnings.push(format!(
                    "material \"{name}\": map_d is read only with the options of map_Kd, and left out"
                ));
            } else if let Some(own) = self.texture(map, folder, resolver, Encoding::Linear)? {
                self.opacities.push((self.materials.len(), own));
            }
        }
        if draft.has_emission_map && material.emissive_texture.is_some() {
            if material.emissive == Vec3::ZERO {
                material.emissive = Vec3::ONE;
            }
        } else if draft.has_emission_map {
            // What glows only in places shall not glow all over.
            material.emissive = Vec3::ZERO;
            self.warnings.push(format!(
                "material \"{name}\": without map_Ke it does not emit light"
            ));
        }
        if draft.coat[0] > 0.0 {
            material.clearcoat = Some(Clearcoat {
                factor: draft.coat[0],
                factor_texture: None,
                roughness: draft.coat[1],
                roughness_texture: None,
                normal_texture: None,
            });
        }
        if !draft.left_out.is_empty() {
            self.warnings.push(format!(
                "material \"{name}\": {} not supported and left out",
                draft.left_out.join(", ")
            ));
        }
        if material.base_color.w < 1.0 {
            material.alpha_mode = AlphaMode::Blend;
        }
        let index = self.materials.len() as u32;
        let short = without_comment(&name).to_owned();
        self.by_name.entry(short).or_insert(index);
        self.by_name.insert(name, index);
        self.materials.push(material);
        Ok(())
    }

    /// Makes textures whose alpha is each `map_d` in a file of its own. Their pixels count by themselves against the limit of
    /// all. What cannot be decoded is left out with a warning, and the material stays opaque.
    pub fn add_opacities(&mut self, limits: &Limits) -> Result<(), Error> {
        let (mut known, mut unreadable, mut all) = (HashMap::new(), HashSet::new(), 0);
        for (i, map) in &self.opacities {
            let material = &mut self.materials[*i];
            let key = (material.base_color_texture.map(|b| b.texture), map.texture);
            let of = |index: u32| &self.textures[index as usize];
            if !known.contains_key(&key) && !unreadable.contains(&map.texture) {
                match of(map.texture).decode() {
                    Ok(decoded) => {
                        let base = key.0.map(of);
                        let (texture, pixels) =
                            opacity::combined(base, of(map.texture), decoded.texels())?;
                        all += pixels;
                        limits.check_pixels(pixels, all, &texture.image.name())?;
                        self.textures.push(texture);
                        known.insert(key, self.textures.len() as u32 - 1);
                    }
                    Err(e) => {
                        unreadable.insert(map.texture);
                        self.warnings.push(format!("map_d is left out: {e}"));
                    }
                }
            }
            if let Some(&texture) = known.get(&key) {
                material.base_color_texture = Some(TextureRef { texture, ..*map });
                material.alpha_mode = AlphaMode::Blend;
            }
        }
        Ok(())
    }

    /// Leaves out each `map_Bump` that is grey: it holds heights, and as normals these would tilt the whole surface.
    pub fn drop_heights(&mut self) {
        for (i, word) in &self.bumps {
            let material = &mut self.materials[*i];
            let Some((texture, _)) = material.normal_texture else {
                continue;
            };
            let is_grey = |&[r, g, b, _]: &[u8; 4]| r == g && g == b;
            // What cannot be decoded is told where it is looked up.
            let decoded = self.textures[texture.texture as usize].decode();
            let holds_heights =
                decoded.is_ok_and(|image| image.texels().pixels().iter().all(is_grey));
            if holds_heights {
                material.normal_texture = None;
            }
            self.warnings.push(format!(
                "material \"{}\": {word} is {}",
                material.name,
                match holds_heights {
                    true => "grey, a map of heights, and left out; bake it into a normal map",
                    false => "read as a normal map",
                }
            ));
        }
    }

    /// `None`, with a warning, if the file is missing.
    fn texture(
        &mut self,
        map: &Map,
        folder: &str,
        resolver: &dyn Resolver,
        encoding: Encoding,
    ) -> Result<Option<TextureRef>, Error> {
        let is_absolute = map.file.starts_with('/') || map.file.contains(":/");
        let file = match is_absolute {
            true => map.file.clone(),
            false => format!("{folder}{}", map.file),
        };
        let key = (file.clone(), encoding, map.clamp);
        let texture = match self.by_file.get(&key) {
            Some(&known) => known,
            None => {
                let what = "the texture".into();
                let found = container::image(resolver, &file, what, &mut self.warnings)?;
                let Some(image) = found else {
                    return Ok(None);
                };
                let wrap = if map.clamp {
                    Wrap::ClampToEdge
                } else {
                    Wrap::Repeat
                };
                self.textures.push(Texture {
                    image,
                    encoding,
                    wrap: [wrap; 2],
                    filter: Filter::Linear,
                });
                let index = self.textures.len() as u32 - 1;
                self.by_file.insert(key, index);
                index
            }
        };
        Ok(Some(TextureRef {
            texture,
            uv_set: 0,
            transform: map.transform,
        }))
    }
}

impl Map {
    /// Splits options from the file name, which may contain blanks.
    fn parse(rest: &str) -> Self {
        let mut map = Self {
            file: String::new(),
            transform: Mat3::IDENTITY,
            clamp: false,
            bump: 1.0,
        };
        let (mut scale, mut offset) = (Vec2::ONE, Vec2::ZERO);
        let mut rest = rest;
        while rest.starts_with('-') {
            let (option, after) = word(rest);
            rest = after;
            // Vectors have one to three numbers: as many as look like numbers are taken.
            let most = match option {
                "-o" | "-s" | "-t" => 3,
                "-mm" => 2,
                _ => 1,
            };
            let mut values = [None; 3];
            for value in values.iter_mut().take(most) {
                let (text, after) = word(rest);
                let parsed = text.parse::<f32>().ok().filter(|v| v.is_finite());
                if parsed.is_none() && most > 1 {
                    break;
                }
                if option == "-clamp" {
                    map.clamp = text == "on";
                }
                *value = parsed;
                rest = after;
            }
            match option {
                "-bm" => map.bump = values[0].unwrap_or(1.0),
                "-s" => scale = Vec2::new(values[0].unwrap_or(1.0), values[1].unwrap_or(1.0)),
                "-o" => offset = Vec2::new(values[0].unwrap_or(0.0), values[1].unwrap_or(0.0)),
                _ => {}
            }
        }
        // The format's v points up: v' = 1 - (s (1 - v) + o).
        map.transform = Mat3::from_cols(
            Vec3::new(scale.x, 0.0, 0.0),
            Vec3::new(0.0, scale.y, 0.0),
            Vec3::new(offset.x, 1.0 - scale.y - offset.y, 1.0),
        );
        map.file = unquoted(rest.trim()).replace('\\', "/");
        map
    }
}

/// A line of text. What is not UTF-8 is Latin-1, of which each byte is a character: names that differ stay different.
pub(super) fn decoded(line: &[u8]) -> Cow<'_, str> {
    match std::str::from_utf8(line) {
        Ok(text) => text.into(),
        Err(_) => line.iter().map(|b| char::from(*b)).collect(),
    }
}

/// What ends a line of a text: old tools write a carriage return alone.
pub(super) fn line_end(text: &[u8]) -> u8 {
    match text.contains(&b'\n') {
        true => b'\n',
        false => b'\r',
    }
}

/// A name without the quotation marks that some exporters put around one with blanks.
pub(super) fn unquoted(name: &str) -> &str {
    let inner = name.strip_prefix('"').and_then(|n| n.strip_suffix('"'));
    inner.unwrap_or(name)
}

/// The first word and what follows it.
fn word(text: &str) -> (&str, &str) {
    text.split_once(char::is_whitespace)
        .map_or((text, ""), |(w, r)| (w, r.trim_start()))
}

fn number(rest: &str) -> Result<f32, Error> {
    // "d -halo 0.5" is the one statement with a word in front.
    let text = rest
        .split_ascii_whitespace()
        .find(|t| *t != "-halo")
        .unwrap_or("");
    match text.parse::<f32>() {
        Ok(v) if v.is_finite() => Ok(v),
        _ => Err(Error::malformed(
            format!("\"{text}\" is not a finite number"),
            "export the material library again",
        )),
    }
}

/// Whether a colour is a file of measurements.
fn is_spectrum(rest: &str) -> bool {
    word(rest).0 == "spectral"
}

/// Three numbers, or one that stands for all three, in linear Rec.709 or, behind the word `xyz`, in CIE XYZ; at least 0.
fn color(rest: &str) -> Result<Vec3, Error> {
    let (space, numbers) = match word(rest) {
        ("xyz", numbers) => (REC709_OF_XYZ, numbers),
        _ => (Mat3::IDENTITY, rest),
    };
    let mut words = numbers.split_ascii_whitespace();
    let first = number(words.next().unwrap_or(""))?;
    let mut next = || words.next().map_or(Ok(first), number);
    let own = Vec3::new(first, next()?, next()?).max(Vec3::ZERO);
    Ok((space * own).max(Vec3::ZERO))
}
