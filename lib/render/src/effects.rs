//! Which effects a scene calls for.
//!
//! What a scene cannot show is known from its description: no coat on any material, a plane that cannot shadow itself,
//! a convex object whose parts light cannot bounce between. Of what it can show, the first round of a render measures
//! what it contributes ([`crate::contribution`]): the display-referred RMSE that leaving it out would cost, over the
//! pixels that the object or its shadow touches. From then on effects are left out, the least important first, while
//! what is lost together stays below the tolerance: RMSE is a norm, so the sum of the parts bounds the whole. Effects
//! that change a surface, but neither the number of rays nor their ways, are simulated wherever the scene has them.
use std::collections::BTreeMap;

use dipir_scene::config::{EffectSwitch, EffectsConfig, EffectsMode};
use dipir_scene::material::{AlphaMode, Material};
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;
use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::contribution::LeaveOut;
use crate::counters::{RayCounts, RayKind};
use crate::features::{self, PROXY_RADIANCE, has};
use crate::render::{Rendered, Renderer, Settings, Simulation};
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

    /// Whether the first round of a render measures what it contributes.
    fn is_measured(self) -> bool {
        matches!(
            self,
            Effect::Shadow
                | Effect::Interreflection
                | Effect::EmissionOnProxy
                | Effect::BounceToProxy
                | Effect::BounceFromProxy
        )
    }

    /// What must be simulated too for this effect to mean anything; these need nothing themselves.
    fn needs(self) -> &'static [Effect] {
        match self {
            Effect::ProxyOcclusion | Effect::BounceToProxy => &[Effect::Shadow],
            Effect::EmissionOnProxy => &[Effect::Shadow, Effect::Emission],
            _ => &[],
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
    /// Share of the first round's rays that are traced for it alone.
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
    /// Display-referred RMSE of everything that was left out, as measured, if the parts add up; absent if nothing was
    /// measured.
    pub left_out: Option<f64>,
    /// One-sided 95% bound of it.
    pub left_out_upper_95: Option<f64>,
    /// All effects.
    pub effects: Vec<PlannedEffect>,
    /// Rays traced so far, by kind: those of the composite, once it is rendered.
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
            left_out_upper_95: None,
            effects,
            rays: named(&RayCounts::default()),
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

impl EffectsPlan {
    /// What the renderer's scene can show and the user does not switch off.
    pub fn new(renderer: &Renderer, config: &EffectsConfig, settings: &Settings) -> Self {
        let scene = renderer.scene();
        let mut plan = Self::everything(scene, settings);
        plan.tolerance = match config.mode() {
            EffectsMode::Planned => config.tolerance(),
            EffectsMode::All => 0.0,
        };
        let is_planned = config.mode() == EffectsMode::Planned;
        for effect in Effect::ALL {
            let switch = switch(config, effect);
            // A mask that is switched off is not even loaded.
            let is_unused = effect == Effect::Occluders && switch == EffectSwitch::Off;
            if absence(scene, settings, effect).is_some() && !is_unused {
                continue;
            }
            match switch {
                EffectSwitch::On => plan.set(effect, true, "switched on by the user".into()),
                EffectSwitch::Off => plan.set(effect, false, "switched off by the user".into()),
                EffectSwitch::Auto if is_planned && plan.is_enabled(effect) => {
                    let reason = match effect.is_measured() {
                        true => "the scene can show it",
                        false => "the scene has it",
                    };
                    plan.set(effect, true, reason.into());
                }
                EffectSwitch::Auto => {}
            }
        }
        leave_out_dependents(&mut plan);
        if is_planned
            && plan.is_enabled(Effect::Interreflection)
            && switch(config, Effect::Interreflection) == EffectSwitch::Auto
            && renderer.geometry().convex
            && !lets_light_pass(scene)
        {
            let why = "the object is convex, so that no part of it lights another";
            plan.set(Effect::Interreflection, false, why.into());
        }
        plan.max_depth = config.max_depth.unwrap_or(MAX_DEPTH);
        if plan.max_depth <= 1 && plan.is_enabled(Effect::Interreflection) {
            let why = "max_depth allows one interaction";
            plan.set(Effect::Interreflection, false, why.into());
        }
        if !plan.is_enabled(Effect::Interreflection) {
            plan.max_depth = plan.max_depth.min(1);
        }
        plan.rays = named(&RayCounts::default());
        plan
    }

    /// What a render may leave out after its first round; `None` where everything is to be simulated.
    pub fn leave_out(&self, config: &EffectsConfig) -> Option<LeaveOut> {
        let is_open = |e| self.is_enabled(e) && switch(config, e) == EffectSwitch::Auto;
        (self.tolerance > 0.0).then(|| LeaveOut {
            tolerance: self.tolerance,
            depth: is_open(Effect::Interreflection) && config.max_depth.is_none(),
            emission_on_proxy: is_open(Effect::EmissionOnProxy),
            bounce_to_proxy: is_open(Effect::BounceToProxy),
            bounce_from_proxy: is_open(Effect::BounceFromProxy),
        })
    }

    /// The plan with what a render of it did: rays, and what effects contribute where it was measured.
    pub fn rendered(&self, rendered: &Rendered) -> Self {
        let mut plan = self.clone();
        plan.rays = named(&rendered.counts);
        let Some(left_out) = &rendered.left_out else {
            return plan;
        };
        let simulation = &left_out.simulation;
        let sent = simulation.light_on_proxy;
        let first = &left_out.first_round;
        let share = |kind| first.get(kind) as f64 / first.total().max(1) as f64;
        use RayKind::{LightOnProxy, ProxyOcclusion, ProxyRadiance, Shadow};
        // What was measured, its rays, and whether it was kept.
        let measured = [
            (
                Effect::Shadow,
                left_out.shadow(),
                Some(Shadow),
                simulation.shadow,
            ),
            (
                Effect::Interreflection,
                left_out.interreflection(),
                None,
                simulation.max_depth > 1,
            ),
            (
                Effect::EmissionOnProxy,
                left_out.emission_on_proxy(),
                None,
                sent.is_some_and(|s| s.emission),
            ),
            (
                Effect::BounceToProxy,
                left_out.bounce_to_proxy(),
                Some(LightOnProxy),
                sent.is_some_and(|s| s.bounce),
            ),
            (
                Effect::BounceFromProxy,
                left_out.bounce_from_proxy(),
                Some(ProxyRadiance),
                has(simulation.features, PROXY_RADIANCE),
            ),
        ];
        for effect in &mut plan.effects {
            if effect.enabled && effect.name == Effect::ProxyOcclusion {
                effect.time_share = Some(share(ProxyOcclusion));
            }
            let found = measured.iter().find(|m| m.0 == effect.name);
            let Some((_, contribution, rays, is_kept)) = found.filter(|_| effect.enabled) else {
                continue;
            };
            effect.contribution = Some(contribution.rmse);
            effect.contribution_se = Some(contribution.std_error);
            effect.time_share = rays.map(share);
            let text = format!(
                "contributes {:.5} +- {:.5}",
                contribution.rmse, contribution.std_error
            );
            effect.enabled = *is_kept;
            if !is_kept {
                let tolerance = left_out.tolerance;
                effect.reason = format!(
                    "{text}, left out after the first round within the tolerance of {tolerance:.5}"
                );
            } else if effect.reason != "switched on by the user" {
                effect.reason = text;
            }
        }
        plan.max_depth = simulation.max_depth;
        plan.left_out = Some(left_out.lost.rmse);
        plan.left_out_upper_95 = Some(left_out.lost.upper_95);
        plan
    }
}

fn named(counts: &RayCounts) -> BTreeMap<String, u64> {
    let named = counts.named().map(|(name, n)| (name.to_owned(), n));
    named.collect()
}

/// Whether a ray that leaves a convex object may meet it again, from within.
fn lets_light_pass(scene: &Scene) -> bool {
    let opens = |m: &Material| m.alpha_mode != AlphaMode::Opaque || m.transmission.is_some();
    scene.materials.iter().any(opens)
}

/// Effects that are left out take those along that mean nothing without them, even if the user switched these on.
fn leave_out_dependents(plan: &mut EffectsPlan) {
    for effect in Effect::ALL {
        let missing = effect.needs().iter().find(|&&n| !plan.is_enabled(n));
        if let (true, Some(needed)) = (plan.is_enabled(effect), missing) {
            plan.set(effect, false, format!("nothing without {}", needed.name()));
        }
    }
}

#[cfg(test)]
mod tests;
