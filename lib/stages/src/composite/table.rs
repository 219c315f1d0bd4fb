//! The `[composite]` table.
use std::path::PathBuf;
use std::time::Duration;

use dipir_cli::session::Session;
use dipir_imaging::tone::ToneCurves;
use dipir_pipeline::config::{Config, Quality};
use dipir_pipeline::error::ConfigError;
use dipir_render::adaptive::Stop;
use dipir_render::gloss::Gloss;
use dipir_scene::scene::Scene;
use glam::Vec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::known_light::Placement;
use crate::presets::{self, CompositePreset};

/// The `[composite]` table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CompositeTable {
    /// Environment map that lights the object, equirectangular, HDR or EXR.
    #[schemars(extend("format" = "path"), extend("x-default" = "none: the recovered light"), example = &"sky.exr")]
    pub environment: Option<PathBuf>,
    /// Exposure of the light, stops. It brings a map to the photograph's scale, and makes a light that was found brighter
    /// or dimmer.
    #[schemars(range(min = -64.0, max = 64.0), example = -1.5)]
    pub exposure_ev: f32,
    /// Stops of red, green and blue of the light beside that, for another white balance.
    #[schemars(extend("x-default" = "none"), example = [0.1, 0.0, -0.15])]
    pub tint: Option<[f32; 3]>,
    /// How much brighter objects glow than their files say, stops. Guidance sees them as the files say.
    #[schemars(range(min = -64.0, max = 64.0), extend("x-default" = "0.0"), example = 1.0)]
    pub emission_ev: Option<f32>,
    /// Stops of red, green and blue of their glow beside that.
    #[schemars(extend("x-default" = "none"), example = [0.1, 0.0, -0.15])]
    pub emission_tint: Option<[f32; 3]>,
    /// Turn of the light about the vertical, degrees, counter-clockwise from above.
    #[schemars(example = 90.0)]
    pub rotation_deg: f32,
    /// Rendering stops at this error, display-referred RMSE with white at 1.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1.0), example = 0.002)]
    pub target_error: Option<f32>,
    /// Rendering stops after about this time, seconds. It replaces `target_error`.
    #[schemars(range(min = LEAST_BUDGET_S, max = MOST_BUDGET_S), example = 60.0)]
    pub time_budget_s: Option<f64>,
    /// Most samples in any pixel.
    #[schemars(range(min = 1), extend("default" = MAX_SAMPLES), example = 1024)]
    pub max_samples: Option<u32>,
    /// Most pixels at which object and shadow are rendered: in a larger photograph they are rendered at a half, a quarter
    /// and so on of its resolution, and enlarged. A time budget chooses the resolution itself.
    #[schemars(range(min = 1), extend("x-default" = "as many as the photograph is sharp for; 1048576 for the preset `draft`; none for `high`"), example = 4000000)]
    pub most_pixels: Option<u64>,
    /// Whether noise is removed from object and shadow. What that does to the error is measured and stated.
    #[schemars(extend("x-default" = "true; false for the preset `high`"), example = false)]
    pub denoise: Option<bool>,
    /// Whether caustics on the object are blurred, such as the sun's reflection by polished paint onto a matt part beside
    /// it: fewer specks, in less time.
    #[schemars(extend("x-default" = "true; false for the preset `high`"), example = false)]
    pub blur_caustics: Option<bool>,
    /// Whether object and shadow are blurred as the photograph's sharpest edges are, where these are softer than rendered ones.
    #[schemars(extend("x-default" = "true"), example = false)]
    pub match_blur: Option<bool>,
    /// Whether the object gets the photograph's grain, where its flat areas show some.
    #[schemars(extend("x-default" = "true"), example = false)]
    pub match_grain: Option<bool>,
    /// How rough polished ground is, from 0, a mirror, to 1: it then shows the object's mirror image. The ground has to be a plane.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-default" = "none: matt ground"), example = 0.15)]
    pub ground_roughness: Option<f32>,
    /// Share of the light that polished ground reflects where it is looked at from above: 0.02 for water, 0.04 for stone,
    /// tiles and varnish, up to 1 for metal.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1.0), extend("x-default" = "0.04"), example = 0.02)]
    pub ground_reflectance: Option<f32>,
    /// Distance of what is in focus in the photograph, along the optical axis, metres. What is nearer or farther is then blurred as
    /// by the photograph's lens. Excludes `focus_at_pixel`.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1e5), extend("x-default" = "none: everything is sharp"), example = 2.5)]
    pub focus_m: Option<f32>,
    /// Pixel of the photograph where the ground, or what `scene.depth` shows, is in focus: column and row. Excludes `focus_m`.
    #[schemars(extend("x-default" = "none"), example = [1200.0, 1810.0])]
    pub focus_at_pixel: Option<[f32; 2]>,
    /// f-number of the photograph's lens.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1e3), extend("x-default" = "the photograph's"), example = 1.8)]
    pub f_number: Option<f32>,
    /// Diameter of the opening of the photograph's lens, millimetres: its true focal length over its f-number. Excludes `f_number`.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1e3), extend("x-default" = "focal length over `f_number`"), example = 28.0)]
    pub aperture_mm: Option<f32>,
    /// How long the shutter was open, degrees: 360 is from frame to frame, 180 half of that. The objects are then blurred by the
    /// motion of a shot's camera around each frame.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 360.0), extend("x-default" = "none: no motion blur"), example = 180.0)]
    pub shutter_deg: Option<f32>,
    /// Curve on the object's light before it is laid over the photograph: `none`, or `reinhard`, `x
    /// / (1 + x)` on every channel, for photographs whose highlights are compressed.
    #[schemars(extend("x-default" = "the recovered curves with the recovered light, `none` with a map"), example = &"reinhard")]
    pub tone: Option<Tone>,
}

/// A curve on the object's light.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Tone {
    /// None: the photograph is linear light, exposed.
    None,
    /// `x / (1 + x)` on every channel, for photographs whose highlights are compressed.
    Reinhard,
}

impl Tone {
    /// As the configuration has it.
    pub fn key(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Reinhard => "reinhard",
        }
    }

    /// What it does to the object's own colour; `None` for nothing.
    pub fn curves(self) -> Option<ToneCurves> {
        match self {
            Self::None => None,
            Self::Reinhard => Some(ToneCurves::identity()),
        }
    }
}

/// Most samples in any pixel, unless the table says otherwise.
pub(super) const MAX_SAMPLES: u32 = 1 << 14;

/// Least and most seconds of a budget: no first round is faster, and no one waits for longer than months.
const LEAST_BUDGET_S: f64 = 0.01;
const MOST_BUDGET_S: f64 = 1e7;

/// That of a surface whose index of refraction is 1.5.
const GROUND_REFLECTANCE: f32 = 0.04;

/// Most stops of a channel that a tint has: beyond, a light has one colour.
const MOST_TINT: f32 = 8.0;
/// Most stops that objects glow brighter or dimmer by, as of light.
const MOST_EMISSION_EV: f32 = 64.0;

impl CompositeTable {
    /// Refuses what no run can work with.
    ///
    /// # Errors
    /// The first such value, by key.
    pub fn check(&self, config: &Config) -> Result<(), ConfigError> {
        let environment = self.environment.as_ref();
        if environment.is_some_and(|path| path.as_os_str().is_empty()) {
            let message = "is empty; name a file, or remove the key";
            return Err(config.invalid("composite.environment", message));
        }
        if let Some(e) = self.target_error
            && !(e > 0.0 && e <= 1.0)
        {
            let accepted = "a display-referred RMSE above 0, at most 1, as in 0.004";
            return Err(config.out_of_range("composite.target_error", e, accepted));
        }
        if let Some(t) = self.time_budget_s
            && !(LEAST_BUDGET_S..=MOST_BUDGET_S).contains(&t)
        {
            // The digits that were written, not 301 of them.
            let t = format!("{t:?}");
            let accepted = "seconds from 0.01 to 1e7, as in 60";
            return Err(config.out_of_range("composite.time_budget_s", t, accepted));
        }
        if self.target_error.is_some() && self.time_budget_s.is_some() {
            let message = "excludes target_error; keep one of the two";
            return Err(config.invalid("composite.time_budget_s", message));
        }
        self.check_ground(config)?;
        self.check_focus(config)?;
        self.check_shutter(config)?;
        if self.max_samples == Some(0) {
            return Err(config.out_of_range("composite.max_samples", 0, "1 or more"));
        }
        if self.most_pixels == Some(0) {
            return Err(config.out_of_range("composite.most_pixels", 0, "1 or more"));
        }
        for (key, tint) in [
            ("composite.tint", self.tint),
            ("composite.emission_tint", self.emission_tint),
        ] {
            if let Some(tint) = tint
                && !tint.iter().all(|stops| stops.abs() <= MOST_TINT)
            {
                let found = format!("{tint:?}");
                let accepted = "three numbers of stops from -8 to 8, as in [0.1, 0.0, -0.15]";
                return Err(config.out_of_range(key, found, accepted));
            }
        }
        if let Some(ev) = self.emission_ev
            && !(ev.abs() <= MOST_EMISSION_EV)
        {
            let found = format!("{ev:?}");
            let accepted = "stops from -64 to 64, as in 1.0";
            return Err(config.out_of_range("composite.emission_ev", found, accepted));
        }
        self.placement().check(config)
    }

    fn check_ground(&self, config: &Config) -> Result<(), ConfigError> {
        if let Some(r) = self.ground_roughness
            && !(0.0..=1.0).contains(&r)
        {
            let accepted = "0, a mirror, to 1, as in 0.15";
            return Err(config.out_of_range("composite.ground_roughness", r, accepted));
        }
        if let Some(r) = self.ground_reflectance
            && !(r > 0.0 && r <= 1.0)
        {
            let accepted = "a share above 0, at most 1, as in 0.04";
            return Err(config.out_of_range("composite.ground_reflectance", r, accepted));
        }
        if self.ground_reflectance.is_some() && self.ground_roughness.is_none() {
            let message =
                "is about polished ground; say how rough it is, too: ground_roughness = 0.15";
            return Err(config.invalid("composite.ground_reflectance", message));
        }
        Ok(())
    }

    /// The ground, if it is polished.
    pub fn gloss(&self) -> Option<Gloss> {
        Some(Gloss {
            roughness: self.ground_roughness?,
            reflectance: self.ground_reflectance.unwrap_or(GROUND_REFLECTANCE),
        })
    }

    /// The factor of each channel that `tint` is.
    pub fn tint_gain(&self) -> Vec3 {
        Vec3::from(self.tint.unwrap_or_default()).exp2()
    }

    /// The factor of each channel of what objects emit; `None` for 1.
    pub(crate) fn emission_gain(&self) -> Option<Vec3> {
        let stops = Vec3::from(self.emission_tint.unwrap_or_default());
        let stops = stops + self.emission_ev.unwrap_or_default();
        (stops != Vec3::ZERO).then(|| stops.exp2())
    }

    /// What the table says of that, if anything.
    pub(super) fn emission_params(&self) -> Option<Value> {
        let params = json!({"ev": self.emission_ev, "tint": self.emission_tint});
        self.emission_gain().map(|_| params)
    }

    /// Makes the objects of `scene` glow as much as the table says; whether any does.
    pub fn scale_emission(&self, scene: &mut Scene) -> bool {
        let gain = self.emission_gain().unwrap_or(Vec3::ONE);
        let mut glows = false;
        for material in &mut scene.materials {
            glows |= material.unlit || material.emissive != Vec3::ZERO;
            material.emissive *= gain;
            if material.unlit {
                material.base_color *= gain.extend(1.0);
            }
        }
        glows
    }

    /// Warns of keys about what objects emit if none `glows`. Of the frames of a shot they are set in any case.
    pub(super) fn warn_of_unused(&self, session: &Session, glows: bool) {
        if !glows && self.emission_gain().is_some() && session.placed.is_none() {
            session.warn("composite.emission_ev, emission_tint: no object emits light");
        }
    }

    /// How the map of `environment` is used.
    pub fn placement(&self) -> Placement {
        Placement {
            exposure_ev: ("composite.exposure_ev", self.exposure_ev),
            rotation_deg: ("composite.rotation_deg", self.rotation_deg),
        }
    }

    pub(super) fn denoise(&self, quality: Quality) -> bool {
        let by_preset = presets::of(quality).composite.denoise;
        self.denoise.unwrap_or(by_preset)
    }

    pub(super) fn matches_blur(&self) -> bool {
        self.match_blur.unwrap_or(true)
    }

    pub(super) fn matches_grain(&self) -> bool {
        self.match_grain.unwrap_or(true)
    }

    pub(super) fn blur_caustics(&self, quality: Quality) -> bool {
        let by_preset = presets::of(quality).composite.blur_caustics;
        self.blur_caustics.unwrap_or(by_preset)
    }

    /// Most pixels at which object and shadow are rendered with `preset`, where the photograph is as sharp as `enough`
    /// pixels would be. A time budget chooses the resolution itself.
    pub(super) fn most_pixels(&self, preset: &CompositePreset, enough: Option<u64>) -> Option<u64> {
        let enough = enough.filter(|_| preset.follow_sharpness);
        let by_preset = [preset.most_pixels, enough].into_iter().flatten().min();
        self.most_pixels.or(by_preset)
    }

    pub(super) fn stop(&self, quality: Quality) -> Stop {
        match (self.target_error, self.time_budget_s) {
            (Some(error), _) => Stop::TargetError(error),
            (None, Some(seconds)) => Stop::TimeBudget(Duration::from_secs_f64(seconds)),
            (None, None) => Stop::TargetError(presets::of(quality).composite.target_error),
        }
    }
}
