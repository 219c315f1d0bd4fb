//! The `[scene.effects]` table.
use super::*;

/// Whether planning decides what is simulated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum EffectsMode {
    /// Only what the scene calls for.
    #[default]
    Planned,
    /// Everything.
    All,
}

/// What the user says about one effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum EffectSwitch {
    /// Simulated, whatever it contributes.
    On,
    /// Left out, whatever it contributes.
    Off,
    /// Planning decides.
    Auto,
}

macro_rules! effects_config {
    ($($name:ident: $what:literal),* $(,)?) => {
        /// The `[scene.effects]` table.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
        #[serde(deny_unknown_fields)]
        pub struct EffectsConfig {
            /// Whether planning decides what is simulated: `planned` simulates what the picture
            /// shows, `all` everything.
            #[schemars(extend("default" = "planned"), example = &"all")]
            #[serde(skip_serializing_if = "Option::is_none")]
            pub mode: Option<EffectsMode>,
            /// Error that planning may leave, display-referred RMSE with white at 1; never more than a quarter of `composite.target_error`.
            #[schemars(range(min = 0.0, max = 1.0), extend("default" = EffectsConfig::DEFAULT_TOLERANCE), example = 0.002)]
            #[serde(skip_serializing_if = "Option::is_none")]
            pub tolerance: Option<f64>,
            /// Most interactions of a path with the object.
            #[schemars(range(min = 1, max = EffectsConfig::MOST_DEPTH), extend("x-default" = "as few as `tolerance` allows"), example = 3)]
            #[serde(skip_serializing_if = "Option::is_none")]
            pub max_depth: Option<u32>,
            $(
                #[doc = $what]
                #[schemars(extend("default" = "auto"), example = &"off")]
                #[serde(skip_serializing_if = "Option::is_none")]
                pub $name: Option<EffectSwitch>,
            )*
        }

        impl EffectsConfig {
            /// Every effect by the name that the table and `effects.json` use, with what the user
            /// says about it.
            pub fn switches(&self) -> Vec<(&'static str, EffectSwitch)> {
                vec![$((stringify!($name), self.$name.unwrap_or(EffectSwitch::Auto))),*]
            }
        }
    };
}

effects_config! {
    shadow: "The object's shadow: light that it keeps from the proxy.",
    proxy_occlusion: "The proxy's own shadow: light, the object's too, that its parts keep from each other.",
    interreflection: "Light that bounces between parts of the object.",
    specular: "Mirror-like reflection at the surface.",
    textures: "Base colour, metalness and roughness that vary over the surface.",
    normal_mapping: "Shading normals from textures.",
    alpha_mask: "Coverage from base-colour alpha, masked or blended.",
    emission: "Light that the object emits.",
    emission_on_proxy: "Light that the object emits onto the proxy.",
    clearcoat: "A coat over the base.",
    transmission: "Light that passes through the surface.",
    bounce_to_proxy: "Light that the object reflects onto the proxy.",
    bounce_from_proxy: "Light that the proxy reflects onto the object.",
    occluders: "The photo's own foreground in front of the object, by mask or depths, and what depths show that catches shadows.",
}

impl EffectsConfig {
    /// Default of [`tolerance`](Self::tolerance): half an 8-bit step.
    pub const DEFAULT_TOLERANCE: f64 = 0.002;
    /// Most interactions of a path that are ever simulated; an albedo of 0.8 leaves 17% of the
    /// light after eight.
    pub const MOST_DEPTH: u32 = 8;

    /// Whether planning decides what is simulated.
    pub fn mode(&self) -> EffectsMode {
        self.mode.unwrap_or_default()
    }

    /// Display-referred RMSE that may be left out.
    pub fn tolerance(&self) -> f64 {
        self.tolerance.unwrap_or(Self::DEFAULT_TOLERANCE)
    }
}
