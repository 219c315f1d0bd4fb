//! How much a file may ask for before it is refused.
use dipir_imaging::error::MAX_PIXELS;
use dipir_imaging::file::PhotoLimits;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::error::Error;

/// The `[scene.limits]` table. Every limit is checked before memory is taken. A file that exceeds one
/// is refused, and the error names the key.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Triangles of all objects together, copies counted. Vertices may be three times as many.
    #[schemars(example = 50_000_000)]
    pub triangles: u64,
    /// Copies of meshes (`EXT_mesh_gpu_instancing`) in a file.
    #[schemars(example = 2_000_000)]
    pub instances: u64,
    /// Pixels of a texture; decoded, one takes four bytes.
    #[schemars(example = 16384 * 16384)]
    pub texture_pixels: u64,
    /// Pixels of all textures of a file together.
    #[schemars(example = 16384 * 16384)]
    pub all_texture_pixels: u64,
    /// Bytes of an object's file, or of another that it names.
    #[schemars(example = 8_u64 << 30)]
    pub file_bytes: u64,
    /// Pixels of the photograph, millions. A pixel takes 18 bytes while it is read.
    #[schemars(range(min = 0, max = Limits::MOST_PHOTO_MEGAPIXELS), example = 250)]
    pub photo_megapixels: u64,
    /// Whether a file may name any others outside of its folder, as `/models/wood.png`; an image or a buffer at a relative
    /// path, as `../wood.png`, is read anyway.
    #[schemars(example = true)]
    pub allow_outside: bool,
}

impl Default for Limits {
    /// Beyond what usual models need.
    fn default() -> Self {
        Self {
            triangles: 20_000_000,
            instances: 1_000_000,
            texture_pixels: 8192 * 8192,
            all_texture_pixels: 4 * 8192 * 8192,
            file_bytes: 4 << 30,
            photo_megapixels: 200,
            allow_outside: false,
        }
    }
}

impl Limits {
    /// Most millions of pixels of a photograph: those of a picture's file.
    pub const MOST_PHOTO_MEGAPIXELS: u64 = MAX_PIXELS as u64 / 1_000_000;

    /// Most vertices: as many as triangles without a common one have.
    pub fn vertices(&self) -> u64 {
        self.triangles.saturating_mul(3)
    }

    /// What the photograph may ask for.
    pub fn photo(&self) -> PhotoLimits {
        PhotoLimits {
            megapixels: self.photo_megapixels as f64,
        }
    }

    /// Whether nothing was changed.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    pub(crate) fn check_mesh(&self, vertices: u64, triangles: u64) -> Result<(), Error> {
        let key = "scene.limits.triangles";
        at_most(self.triangles, key, triangles, |n| {
            format!("there are {n} triangles")
        })?;
        at_most(self.vertices(), key, vertices, |n| {
            format!("there are {n} vertices, of which a triangle has three")
        })
    }

    pub(crate) fn check_instances(&self, count: u64, place: &str) -> Result<(), Error> {
        at_most(self.instances, "scene.limits.instances", count, |n| {
            format!("{place} asks for {n} copies, those before counted")
        })
    }

    /// The pixels of one texture and of all up to it.
    pub(crate) fn check_pixels(&self, one: u64, all: u64, name: &str) -> Result<(), Error> {
        at_most(
            self.texture_pixels,
            "scene.limits.texture_pixels",
            one,
            |n| format!("the texture {name} has {n} pixels"),
        )?;
        at_most(
            self.all_texture_pixels,
            "scene.limits.all_texture_pixels",
            all,
            |n| format!("the textures up to {name} have {n} pixels together"),
        )
    }

    pub(crate) fn check_bytes(&self, bytes: u64) -> Result<(), Error> {
        at_most(self.file_bytes, "scene.limits.file_bytes", bytes, |n| {
            format!("the file has {n} bytes")
        })
    }
}

fn at_most(
    limit: u64,
    key: &'static str,
    count: u64,
    what: impl FnOnce(u64) -> String,
) -> Result<(), Error> {
    if count <= limit {
        return Ok(());
    }
    Err(Error::TooLarge {
        what: what(count),
        key,
        limit,
    })
}
