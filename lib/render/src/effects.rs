//! Which effects a scene calls for.
//!
//! An effect is absent by structure (no coat on any material, a plane that cannot shadow itself),
//! or a pilot render at low resolution measures what leaving it out would change: the
//! display-referred RMSE between the composite with everything and the composite without it, over
//! the pixels that the object or its shadow touches. Effects are left out, the least important
//! first, while what is lost together stays below the tolerance: RMSE is a norm, so the sum of the
//! parts bounds the whole.
//!
//! Both pictures share their random numbers, so an effect that changes nothing measures exactly
//! zero; and the squared difference is the product of two independently seeded differences, so that
//! noise does not count as contribution.
use std::collections::BTreeMap;
use std::ops::ControlFlow;

use dipir_scene::config::{EffectSwitch, EffectsConfig, EffectsMode};
use dipir_scene::material::{AlphaMode, Material};
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;
use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::error::RenderError;
use crate::features::{self, PROXY_RADIANCE};
use crate::light::SceneLight;
use crate::pilot::{Difference, Pilot};
use crate::render::{Renderer, Settings, Simulation};
use crate::shadow::LightOnProxy;

/// A phenomenon that can be simulated, by its name in files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Effect {
    /// Light that the object takes from the proxy.
    Shadow,
    /// Light that the proxy takes from itself.
    ProxyOcclusion,
    /// Light that bounces between parts of the object.
    Interreflection,
    /// Mirror-like reflection.
    Specular,
    /// Colour, metalness and roughness that vary over the surface.
    Textures,
    /// Shading normals from textures.
    NormalMapping,
    /// Coverage from base-colour alpha.
    AlphaMask,
    /// Light that the object emits.
    Emission,
    /// The same, as the proxy receives it.
    EmissionOnProxy,
    /// A coat over the base.
    Clearcoat,
    /// Light that passes through the surface.
    Transmission,
    /// Light that the object reflects onto the proxy.
    BounceToProxy,
    /// Light that the proxy reflects onto the object.
    BounceFromProxy,
    /// The photo's own foreground in front of the object.
    Occluders,
}

impl Effect {
    /// Every effect, in the order of the files.
    pub const ALL: [Effect; 14] = [
        Effect::Shadow,
        Effect::ProxyOcclusion,
        Effect::Interreflection,
        Effect::Specular,
        Effect::Textures,
        Effect::NormalMapping,
        Effect::AlphaMask,
        Effect::Emission,
        Effect::EmissionOnProxy,
        Effect::Clearcoat,
        Effect::Transmission,
        Effect::BounceToProxy,
        Effect::BounceFromProxy,
        Effect::Occluders,
    ];

    /// The name in configuration and files.
    pub fn name(self) -> &'static str {
        match self {
            Effect::Shadow => "shadow",
            Effect::ProxyOcclusion => "proxy_occlusion",
            Effect::Interreflection => "interreflection",
            Effect::Specular => "specular",
            Effect::Textures => "textures",
            Effect::NormalMapping => "normal_mapping",
            Effect::AlphaMask => "alpha_mask",
            Effect::Emission => "emission",
            Effect::EmissionOnProxy => "emission_on_proxy",
            Effect::Clearcoat => "clearcoat",
            Effect::Transmission => "transmission",
            Effect::BounceToProxy => "bounce_to_proxy",
            Effect::BounceFromProxy => "bounce_from_proxy",
            Effect::Occluders => "occluders",
        }
    }

    /// The kernel feature that simulates it, if it has one of its own.
    fn feature(self) -> u32 {
        match self {
            Effect::Specular => features::SPECULAR,
            Effect::Textures => features::TEXTURES,
            Effect::NormalMapping => features::NORMAL_MAPPING,
            Effect::AlphaMask => features::ALPHA,
            Effect::Emission => features::EMISSION,
            Effect::Clearcoat => features::CLEARCOAT,
            Effect::Transmission => features::TRANSMISSION,
            Effect::BounceFromProxy => PROXY_RADIANCE,
            _ => 0,
        }
    }

    /// What must be simulated too for this effect to mean anything.
    fn needs(self) -> Option<Effect> {
        match self {
            Effect::ProxyOcclusion | Effect::EmissionOnProxy | Effect::BounceToProxy => {
                Some(Effect::Shadow)
            }
            _ => None,
        }
    }
}

/// What was decided about one effect, and why.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedEffect {
    /// Which.
    pub name: Effect,
    /// Whether it is simulated.
    pub enabled: bool,
    /// Why, in words.
    pub reason: String,
    /// Display-referred RMSE that leaving it out costs; absent if it was not measured.
    pub contribution: Option<f64>,
    /// Standard error of `contribution`.
    pub contribution_se: Option<f64>,
    /// Share of the pilot's effort with everything on that leaving it out saves, counted in rays
    /// and weighted shading, so that it is the same on every machine.
    pub time_share: Option<f64>,
}

/// What to simulate of a scene: the content of `effects.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EffectsPlan {
    /// Most interactions of a path with the object, D.
    pub max_depth: u32,
    /// Display-referred RMSE that was allowed to be left out.
    pub tolerance: f64,
    /// Measured display-referred RMSE of everything that was left out; absent if nothing was
    /// measured.
    pub left_out: Option<f64>,
    /// All effects.
    pub effects: Vec<PlannedEffect>,
    /// Rays of the pilot render as planned, by kind.
    pub rays: BTreeMap<String, u64>,
}

/// Most interactions that are ever simulated.
pub const MAX_DEPTH: u32 = EffectsConfig::MOST_DEPTH;

impl EffectsPlan {
    /// Whether `effect` is simulated.
    pub fn is_enabled(&self, effect: Effect) -> bool {
        self.effects.iter().any(|e| e.name == effect && e.enabled)
    }

    /// Everything that `scene` has the means for, at the greatest depth.
    pub fn everything(scene: &Scene, settings: &Settings) -> Self {
        let effects = Effect::ALL
            .into_iter()
            .map(|name| {
                let absent = absence(scene, settings, name);
                PlannedEffect {
                    name,
                    enabled: absent.is_none(),
                    reason: absent
                        .unwrap_or("everything is simulated, nothing was planned")
                        .to_owned(),
                    contribution: None,
                    contribution_se: None,
                    time_share: None,
                }
            })
            .collect();
        Self {
            max_depth: MAX_DEPTH,
            tolerance: 0.0,
            left_out: None,
            effects,
            rays: BTreeMap::new(),
        }
    }

    /// The plan as the kernels take it.
    pub fn simulation(&self) -> Simulation {
        let on = |e| self.is_enabled(e);
        let sent = LightOnProxy {
            emission: on(Effect::EmissionOnProxy),
            bounce: on(Effect::BounceToProxy),
        };
        Simulation {
            features: Effect::ALL
                .into_iter()
                .filter(|&e| on(e))
                .fold(0, |mask, e| mask | e.feature()),
            max_depth: if on(Effect::Interreflection) {
                self.max_depth
            } else {
                self.max_depth.min(1)
            },
            shadow: on(Effect::Shadow),
            proxy_occlusion: on(Effect::ProxyOcclusion),
            light_on_proxy: (sent.emission || sent.bounce).then_some(sent),
        }
    }

    fn set(&mut self, effect: Effect, enabled: bool, reason: String) {
        if let Some(e) = self.effects.iter_mut().find(|e| e.name == effect) {
            e.enabled = enabled;
            e.reason = reason;
        }
    }

    /// The same plan without `effect`.
    fn without(&self, effect: Effect) -> Self {
        let mut plan = self.clone();
        plan.set(effect, false, String::new());
        for dependent in Effect::ALL {
            if dependent.needs() == Some(effect) {
                plan.set(dependent, false, String::new());
            }
        }
        plan
    }
}

/// Why `scene` cannot show `effect` at all; `None` if it can.
fn absence(scene: &Scene, settings: &Settings, effect: Effect) -> Option<&'static str> {
    let used = |test: &dyn Fn(&Material) -> bool| {
        let mut is_used = vec![false; scene.materials.len()];
        for &m in &scene.mesh.materials {
            is_used[m as usize] = true;
        }
        scene
            .materials
            .iter()
            .zip(is_used)
            .any(|(m, used)| used && test(m))
    };
    let no_proxy = matches!(scene.proxy, Proxy::None);
    let emits = || used(&|m| m.emissive != Vec3::ZERO);
    let absent = |is_absent: bool, why| is_absent.then_some(why);
    match effect {
        Effect::Shadow | Effect::BounceToProxy => absent(no_proxy, "the scene has no proxy"),
        Effect::ProxyOcclusion => match scene.proxy {
            Proxy::None => Some("the scene has no proxy"),
            Proxy::Plane(_) => Some("a plane does not shadow itself"),
            Proxy::Mesh(_) => None,
        },
        Effect::Interreflection => absent(!used(&|m| !m.unlit), "no material reflects light"),
        Effect::Specular => absent(!used(&|m| !m.unlit), "no material reflects light"),
        Effect::Textures => absent(
            scene.mesh.colors.is_empty() && !used(&has_textures),
            "no material has textures and no vertex a colour",
        ),
        Effect::NormalMapping => absent(
            !used(&|m| {
                m.normal_texture.is_some()
                    || m.clearcoat.is_some_and(|c| c.normal_texture.is_some())
            }),
            "no material has a normal map",
        ),
        Effect::AlphaMask => absent(
            !used(&|m| m.alpha_mode != AlphaMode::Opaque),
            "every material is opaque",
        ),
        Effect::Emission => absent(
            !emits() && !used(&|m| m.unlit),
            "no material emits light or is unlit",
        ),
        Effect::EmissionOnProxy if no_proxy => Some("the scene has no proxy"),
        Effect::EmissionOnProxy => absent(!emits(), "no material emits light"),
        Effect::Clearcoat => absent(
            !used(&|m| m.clearcoat.is_some_and(|c| c.factor > 0.0)),
            "no material has a coat",
        ),
        Effect::Transmission => absent(
            !used(&|m| m.transmission.is_some_and(|t| t.factor > 0.0)),
            "no material lets light pass",
        ),
        Effect::BounceFromProxy if no_proxy => Some("the scene has no proxy"),
        Effect::BounceFromProxy => absent(
            settings.background.is_none(),
            "there is no photograph to take the proxy's colour from",
        ),
        Effect::Occluders => absent(
            settings.occluders.is_none(),
            "no mask of the photo's foreground is given",
        ),
    }
}

fn has_textures(m: &Material) -> bool {
    m.base_color_texture.is_some()
        || m.metallic_roughness_texture.is_some()
        || m.emissive_texture.is_some()
        || m.clearcoat
            .is_some_and(|c| c.factor_texture.is_some() || c.roughness_texture.is_some())
        || m.transmission.is_some_and(|t| t.texture.is_some())
        || m.extensions.textures().next().is_some()
}

/// What the user wants of `effect`.
fn switch(config: &EffectsConfig, effect: Effect) -> EffectSwitch {
    config
        .switches()
        .into_iter()
        .find(|(name, _)| *name == effect.name())
        .map_or(EffectSwitch::Auto, |(_, s)| s)
}

/// Decides what to simulate of the renderer's scene under `light`. Of `settings` the pilot takes
/// seed, photograph, transfer and mask. `progress` is told the share done and may break off.
pub fn plan<L: SceneLight>(
    renderer: &Renderer,
    light: &L,
    config: &EffectsConfig,
    settings: &Settings,
    progress: &mut dyn FnMut(f64) -> ControlFlow<()>,
) -> Result<EffectsPlan, RenderError> {
    let scene = renderer.scene();
    let mut plan = EffectsPlan::everything(scene, settings);
    plan.tolerance = config.tolerance();
    for effect in Effect::ALL {
        if absence(scene, settings, effect).is_none() {
            match switch(config, effect) {
                EffectSwitch::On => plan.set(effect, true, "switched on by the user".into()),
                EffectSwitch::Off => {
                    plan = plan.without(effect);
                    plan.set(effect, false, "switched off by the user".into());
                }
                EffectSwitch::Auto => {}
            }
        }
    }
    explain_dependents(&mut plan);
    let pilot = Pilot::new(renderer, light, settings);
    match (config.mode(), pilot.is_affordable()) {
        (EffectsMode::Planned, true) => leave_out(&mut plan, &pilot, config, progress)?,
        (EffectsMode::Planned, false) => explain_unmeasured(&mut plan, config),
        (EffectsMode::All, _) => {}
    }
    if let Some(depth) = config.max_depth {
        plan.max_depth = depth;
    }
    plan.rays = pilot
        .render(&plan.simulation())?
        .counts
        .named()
        .map(|(name, n)| (name.to_owned(), n))
        .collect();
    Ok(plan)
}

/// Switched-off effects take those along that mean nothing without them.
fn explain_dependents(plan: &mut EffectsPlan) {
    for effect in Effect::ALL {
        if let Some(needed) = effect.needs() {
            let was = plan.effects.iter().find(|e| e.name == effect);
            if was.is_some_and(|e| e.reason.is_empty()) {
                plan.set(effect, false, format!("nothing without {}", needed.name()));
            }
        }
    }
}

/// Where a ray takes too long for anything to be measured, everything is simulated.
fn explain_unmeasured(plan: &mut EffectsPlan, config: &EffectsConfig) {
    for effect in Effect::ALL {
        if plan.is_enabled(effect) && switch(config, effect) == EffectSwitch::Auto {
            plan.set(effect, true, "not measured, for rays take too long".into());
        }
    }
}

/// Measures every effect that the user leaves open and drops what the tolerance allows.
fn leave_out<L: SceneLight>(
    plan: &mut EffectsPlan,
    pilot: &Pilot<L>,
    config: &EffectsConfig,
    progress: &mut dyn FnMut(f64) -> ControlFlow<()>,
) -> Result<(), RenderError> {
    let open: Vec<Effect> = Effect::ALL
        .into_iter()
        // A mask is data, not an effect that costs time.
        .filter(|&e| e != Effect::Occluders && plan.is_enabled(e))
        .filter(|&e| switch(config, e) == EffectSwitch::Auto)
        .collect();
    let everything = plan.clone();
    let reference = pilot.reference(&everything.simulation())?;
    let steps = open.len() as f64 + f64::from(MAX_DEPTH.ilog2());
    let mut done = 0.0;
    let mut step = || {
        done += 1.0;
        match progress((done / steps).min(1.0)) {
            ControlFlow::Break(()) => Err(RenderError::Interrupted),
            ControlFlow::Continue(()) => Ok(()),
        }
    };

    // ---- What each effect contributes, alone ------------------------------------------------
    let mut measured: Vec<(Effect, Difference)> = Vec::new();
    for &effect in &open {
        let difference = pilot.difference(&reference, &everything.without(effect).simulation())?;
        if let Some(e) = plan.effects.iter_mut().find(|e| e.name == effect) {
            e.contribution = Some(difference.rmse);
            e.contribution_se = Some(difference.std_error);
            e.time_share = Some(difference.cost_share);
        }
        measured.push((effect, difference));
        step()?;
    }

    // ---- Whole effects, the least important first; half of the tolerance is kept for D ------
    measured.sort_by(|a, b| a.1.upper_95().total_cmp(&b.1.upper_95()));
    let tolerance = plan.tolerance;
    let mut spent = 0.0;
    for (effect, difference) in &measured {
        let budget = match effect {
            Effect::Interreflection => tolerance,
            _ => 0.5 * tolerance,
        };
        let text = format!("{:.5} +- {:.5}", difference.rmse, difference.std_error);
        if !plan.is_enabled(*effect) {
            continue; // Gone with what it needs.
        }
        if spent + difference.upper_95() <= budget {
            spent += difference.upper_95();
            *plan = plan.without(*effect);
            let reason =
                format!("contributes {text}, left out within the tolerance of {tolerance}");
            plan.set(*effect, false, reason);
            explain_dependents(plan);
        } else {
            plan.set(*effect, true, format!("contributes {text}"));
        }
    }

    // ---- The smallest depth that suffices ---------------------------------------------------
    if !plan.is_enabled(Effect::Interreflection) {
        plan.max_depth = 1;
    } else if config.max_depth.is_none()
        && switch(config, Effect::Interreflection) == EffectSwitch::Auto
    {
        // What is lost falls with depth, so the least sufficient one is found by halving.
        let (mut least, mut most) = (2, MAX_DEPTH);
        while least < most {
            let depth = (least + most) / 2;
            let mut shallow = everything.clone();
            shallow.max_depth = depth;
            let difference = pilot.difference(&reference, &shallow.simulation())?;
            step()?;
            if spent + difference.upper_95() <= tolerance {
                most = depth;
            } else {
                least = depth + 1;
            }
        }
        plan.max_depth = most;
    }
    if let Some(depth) = config.max_depth {
        plan.max_depth = depth;
    }
    plan.left_out = Some(pilot.difference(&reference, &plan.simulation())?.rmse);
    Ok(())
}

#[cfg(test)]
mod tests;
