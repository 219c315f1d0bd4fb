//! How good a method is on a scene.
use std::path::Path;

use dipir_evaluation::results::read_json;
use dipir_evaluation::scores::{DisplayedComposite, LightScores, PictureScores, Touched};
use dipir_imaging::raster::DisplayImage;
use dipir_light::environment::EnvironmentMap;
use serde::{Deserialize, Serialize};

use crate::definition::Definition;

/// How good a method is on a scene: the content of `score.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Fingerprint of what decided it: scene, method, settings.
    pub key: String,
    /// The method's name.
    pub method: String,
    /// What it was made with, beside the scene.
    pub definition: Definition,
    /// Its title.
    pub title: String,
    /// The scene.
    pub scene: String,
    /// [`EvaluationFolder::digest`](crate::folder::EvaluationFolder::digest) of the scene; absent in scores that were
    /// written without it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene_digest: Option<String>,
    /// Errors of the picture; absent for the truth.
    pub picture: Option<PictureScores>,
    /// LPIPS of the picture, if a report was asked for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    /// Errors of the light.
    pub light: Option<LightScores>,
    /// Seconds of the stages before the composite, and of the composite.
    pub seconds: Vec<(String, f64)>,
    /// Most memory of any stage, bytes.
    pub peak_rss_bytes: u64,
}

impl Score {
    /// Whether `file` holds the score of the run with this key.
    pub fn is_done(file: &Path, key: &str) -> bool {
        file.is_file() && read_json::<Self>(file).is_ok_and(|s| s.key == key)
    }
}

/// What a method's picture and light are compared with.
pub struct Truth {
    /// The composite under the true light.
    pub picture: DisplayImage,
    /// The pixels that count.
    pub touched: Touched,
    /// The true light on the photograph's scale.
    pub map: EnvironmentMap,
}

impl Truth {
    /// Reads the true composite and the true map, which `exposure_ev` stops bring to the photograph's
    /// scale.
    ///
    /// # Errors
    /// If one of them cannot be read.
    pub fn read(exr: &Path, map: &Path, exposure_ev: f64) -> anyhow::Result<Self> {
        let composite = DisplayedComposite::read(exr)?;
        Ok(Self {
            touched: composite.touched(),
            picture: composite.picture,
            map: EnvironmentMap::read(map)?.scaled(exposure_ev.exp2() as f32),
        })
    }
}
