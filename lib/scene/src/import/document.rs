//! A glTF document: the `gltf` crate's model of the JSON, and beside it the little that the model
//! cannot say.
//!
//! Nothing is validated as a whole, for a file may use extensions that the crate does not know.
//! Whoever follows an index checks it.
use std::collections::BTreeMap;
use std::fmt;
use std::ops::Deref;

use gltf::json as model;
use serde::Deserialize;
use serde::de::{DeserializeSeed, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value, json};

use crate::error::Error;

const EXPORT: &str = "export the file again";

/// Dereferences to the model.
#[derive(Debug)]
pub(super) struct Document<'a> {
    text: &'a [u8],
    root: model::Root,
    beside: Beside,
}

/// What the model leaves out.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Beside {
    nodes: Vec<Placement>,
    materials: Vec<Presence>,
}

/// A node's transform as written: the model rounds it to single precision, a millimetre every ten
/// kilometres.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Placement {
    pub matrix: Option<[f64; 16]>,
    pub translation: Option<[f64; 3]>,
    pub rotation: Option<[f64; 4]>,
    pub scale: Option<[f64; 3]>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
struct Presence {
    pbr_metallic_roughness: Option<IgnoredAny>,
}

/// `EXT_mesh_gpu_instancing` of a node.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Instancing {
    pub attributes: BTreeMap<String, model::Index<model::Accessor>>,
}

/// `KHR_materials_clearcoat` of a material.
#[derive(Debug, Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct Clearcoat {
    pub clearcoat_factor: f32,
    pub clearcoat_texture: Option<model::texture::Info>,
    pub clearcoat_roughness_factor: f32,
    pub clearcoat_roughness_texture: Option<model::texture::Info>,
    pub clearcoat_normal_texture: Option<model::material::NormalTexture>,
}

/// `KHR_materials_specular` of a material.
#[derive(Debug, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct Specular {
    pub specular_factor: f32,
    pub specular_texture: Option<model::texture::Info>,
    pub specular_color_factor: [f32; 3],
    pub specular_color_texture: Option<model::texture::Info>,
}

impl Default for Specular {
    fn default() -> Self {
        Self {
            specular_factor: 1.0,
            specular_texture: None,
            specular_color_factor: [1.0; 3],
            specular_color_texture: None,
        }
    }
}

/// `KHR_materials_sheen` of a material.
#[derive(Debug, Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct Sheen {
    pub sheen_color_factor: [f32; 3],
    pub sheen_color_texture: Option<model::texture::Info>,
    pub sheen_roughness_factor: f32,
    pub sheen_roughness_texture: Option<model::texture::Info>,
}

/// `KHR_materials_anisotropy` of a material.
#[derive(Debug, Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct Anisotropy {
    pub anisotropy_strength: f32,
    pub anisotropy_rotation: f32,
    pub anisotropy_texture: Option<model::texture::Info>,
}

/// `KHR_materials_iridescence` of a material.
#[derive(Debug, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct Iridescence {
    pub iridescence_factor: f32,
    pub iridescence_texture: Option<model::texture::Info>,
    pub iridescence_ior: f32,
    pub iridescence_thickness_minimum: f32,
    pub iridescence_thickness_maximum: f32,
    pub iridescence_thickness_texture: Option<model::texture::Info>,
}

impl Default for Iridescence {
    fn default() -> Self {
        Self {
            iridescence_factor: 0.0,
            iridescence_texture: None,
            iridescence_ior: 1.3,
            iridescence_thickness_minimum: 100.0,
            iridescence_thickness_maximum: 400.0,
            iridescence_thickness_texture: None,
        }
    }
}

/// `KHR_materials_volume` of a material.
#[derive(Debug, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct Volume {
    pub thickness_factor: f32,
    pub thickness_texture: Option<model::texture::Info>,
    /// Infinite where it is missing.
    pub attenuation_distance: Option<f32>,
    pub attenuation_color: [f32; 3],
}

impl Default for Volume {
    fn default() -> Self {
        Self {
            thickness_factor: 0.0,
            thickness_texture: None,
            attenuation_distance: None,
            attenuation_color: [1.0; 3],
        }
    }
}

impl Deref for Document<'_> {
    type Target = model::Root;

    fn deref(&self) -> &model::Root {
        &self.root
    }
}

impl<'a> Document<'a> {
    /// Reads the JSON text of a file.
    pub fn read(text: &'a [u8]) -> Result<Self, Error> {
        let unreadable = |e| Error::malformed(format!("the glTF JSON cannot be read: {e}"), EXPORT);
        let root = match serde_json::from_slice(text) {
            Ok(root) => root,
            Err(strict) => read_leniently(text, strict).map_err(unreadable)?,
        };
        let mut indices = serde_json::Deserializer::from_slice(text);
        IndexGuard::Elsewhere
            .deserialize(&mut indices)
            .map_err(unreadable)?;
        Ok(Self {
            text,
            root,
            beside: serde_json::from_slice(text).map_err(unreadable)?,
        })
    }

    /// The transform of `nodes[index]`.
    pub fn placement(&self, index: usize) -> Placement {
        self.beside.nodes.get(index).cloned().unwrap_or_default()
    }

    /// Whether `materials[index]` has `pbrMetallicRoughness`, which the model fills in otherwise.
    pub fn has_metallic_roughness(&self, index: usize) -> bool {
        let presence = self.beside.materials.get(index);
        presence.is_some_and(|m| m.pbr_metallic_roughness.is_some())
    }

    /// What the file says at a JSON `pointer`, for messages about values that the model only calls
    /// invalid.
    pub fn quoted(&self, pointer: &str) -> String {
        let whole: Option<Value> = serde_json::from_slice(self.text).ok();
        let value = whole.as_ref().and_then(|v| v.pointer(pointer));
        value.map_or_else(|| "missing".into(), Value::to_string)
    }
}

/// The contents of an extension that the model keeps as plain JSON; `at` is where it stands.
pub(super) fn raw_extension<T: serde::de::DeserializeOwned>(
    others: &Map<String, Value>,
    name: &str,
    at: &str,
) -> Result<Option<T>, Error> {
    others
        .get(name)
        .filter(|v| !v.is_null())
        .map(|v| T::deserialize(v))
        .transpose()
        .map_err(|e| {
            Error::malformed(
                format!("{at}.extensions.{name} cannot be read: {e}"),
                EXPORT,
            )
        })
}

/// Reads documents that are legal, or nearly so, but that the `gltf` crate refuses because roots of
/// a scene, targets of animations or fields of cameras are missing.
fn read_leniently(
    text: &[u8],
    strict: serde_json::Error,
) -> Result<model::Root, serde_json::Error> {
    let Ok(Value::Object(mut members)) = serde_json::from_slice(text) else {
        return Err(strict);
    };
    if let Value::Object(asset) = members.entry("asset").or_insert_with(|| json!({})) {
        asset.entry("version").or_insert_with(|| json!("2.0"));
    }
    members.remove("cameras");
    let mut each = |list: &str, change: &dyn Fn(&mut Map<String, Value>)| {
        let list = members.get_mut(list).and_then(Value::as_array_mut);
        let maps = list.into_iter().flatten().filter_map(Value::as_object_mut);
        maps.for_each(change);
    };
    for (list, required) in [
        ("scenes", "nodes"),
        ("skins", "joints"),
        ("meshes", "primitives"),
    ] {
        each(list, &|map| {
            map.entry(required).or_insert_with(|| json!([]));
        });
    }
    // Only their number matters.
    each("animations", &|map| {
        map.insert("channels".into(), json!([]));
        map.insert("samplers".into(), json!([]));
    });
    serde_json::from_value(Value::Object(members)).map_err(|lenient| {
        // The same complaint, but with line and column.
        if strict.to_string().starts_with(&lenient.to_string()) {
            strict
        } else {
            lenient
        }
    })
}

/// Walks a document and refuses indices and codes beyond 32 bits, whose upper half the model would
/// drop: 2^32 would pass for index 0.
#[derive(Clone, Copy)]
enum IndexGuard {
    /// Numbers are indices or codes.
    Index,
    /// Members of maps are indices.
    Attributes,
    /// Members of maps are extensions.
    Extensions,
    Elsewhere,
}

impl IndexGuard {
    /// What the member `key` of a map is, `None` for what is not read.
    fn member(self, key: &str) -> Option<Self> {
        match (self, key) {
            (Self::Attributes, _) => Some(Self::Index),
            (
                Self::Extensions,
                "EXT_mesh_gpu_instancing"
                | "KHR_materials_anisotropy"
                | "KHR_materials_clearcoat"
                | "KHR_materials_iridescence"
                | "KHR_materials_pbrSpecularGlossiness"
                | "KHR_materials_sheen"
                | "KHR_materials_specular"
                | "KHR_materials_transmission"
                | "KHR_materials_volume",
            ) => Some(Self::Elsewhere),
            (Self::Extensions, _) | (_, "extras") => None,
            (_, "extensions") => Some(Self::Extensions),
            (_, "attributes" | "targets") => Some(Self::Attributes),
            (
                _,
                "buffer"
                | "bufferView"
                | "children"
                | "componentType"
                | "index"
                | "indices"
                | "inverseBindMatrices"
                | "joints"
                | "magFilter"
                | "material"
                | "mesh"
                | "mode"
                | "nodes"
                | "sampler"
                | "scene"
                | "skin"
                | "source"
                | "wrapS"
                | "wrapT",
            ) => Some(Self::Index),
            _ => Some(Self::Elsewhere),
        }
    }
}

impl<'de> DeserializeSeed<'de> for IndexGuard {
    type Value = ();

    fn deserialize<D: serde::Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for IndexGuard {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a glTF document")
    }

    fn visit_u64<E: serde::de::Error>(self, value: u64) -> Result<(), E> {
        // The model marks an absent texture source by the largest index.
        if matches!(self, Self::Index) && value >= u64::from(u32::MAX) {
            return Err(E::custom(format!("{value} is no index or code of 32 bits")));
        }
        Ok(())
    }

    fn visit_bool<E>(self, _: bool) -> Result<(), E> {
        Ok(())
    }

    fn visit_i64<E>(self, _: i64) -> Result<(), E> {
        Ok(())
    }

    fn visit_f64<E>(self, _: f64) -> Result<(), E> {
        Ok(())
    }

    fn visit_str<E>(self, _: &str) -> Result<(), E> {
        Ok(())
    }

    fn visit_unit<E>(self) -> Result<(), E> {
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<(), A::Error> {
        while list.next_element_seed(self)?.is_some() {}
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        while let Some(key) = map.next_key::<String>()? {
            match self.member(&key) {
                Some(member) => map.next_value_seed(member)?,
                None => {
                    map.next_value::<IgnoredAny>()?;
                }
            }
        }
        Ok(())
    }
}
