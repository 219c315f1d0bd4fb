use dipir_imaging::raster::{LinearImage, Raster};

use super::*;
use crate::adaptive::Stop;
use crate::shapes::{icosphere, quad, torus_knot};
use crate::testing::{camera, ground, matte, render, scene, settings, sky};

fn view() -> dipir_scene::camera::Camera {
    camera(Vec3::new(0.0, 2.0, 4.0), Vec3::Y * 0.5, 40.0, 24)
}

/// What the scene can show.
fn possible(scene: &Scene, config: &EffectsConfig, settings: &Settings) -> EffectsPlan {
    EffectsPlan::new(&Renderer::new(scene), config, settings)
}

/// What it shows, as the first round of a render finds it, and the render.
fn rendered(scene: &Scene, config: &EffectsConfig, settings: &Settings) -> (EffectsPlan, Rendered) {
    let p = possible(scene, config, settings);
    let settings = Settings {
        leave_out: p.leave_out(config),
        ..*settings
    };
    let rendered = render(scene, &sky(1.0), &p.simulation(), &settings);
    (p.rendered(&rendered), rendered)
}

fn planned(scene: &Scene, config: &EffectsConfig, settings: &Settings) -> EffectsPlan {
    rendered(scene, config, settings).0
}

fn find(plan: &EffectsPlan, effect: Effect) -> &PlannedEffect {
    let found = plan.effects.iter().find(|e| e.name == effect);
    found.expect("every effect is listed")
}

#[test]
fn every_effect_has_a_switch_and_the_same_name_everywhere() {
    let names: Vec<_> = EffectsConfig::default()
        .switches()
        .into_iter()
        .map(|(name, _)| name)
        .collect();
    assert_eq!(names, Effect::ALL.map(Effect::name));
    for effect in Effect::ALL {
        let json = serde_json::to_string(&effect).expect("serialises");
        assert_eq!(json, format!("\"{}\"", effect.name()));
    }
}

#[test]
fn a_matte_convex_object_needs_no_interreflection_and_only_what_it_has() {
    let ball = icosphere(Vec3::Y * 0.5, 0.5, 3);
    let s = scene(ball, matte(Vec3::splat(0.5)), view(), ground());
    let p = planned(&s, &EffectsConfig::default(), &settings(64, 1));
    let e = find(&p, Effect::Interreflection);
    assert_eq!((e.enabled, e.contribution), (false, None), "{e:?}");
    assert!(e.reason.contains("convex"), "{e:?}");
    assert_eq!(p.max_depth, 1);
    assert!(p.is_enabled(Effect::Shadow));
    for (effect, reason) in [
        (
            Effect::Textures,
            "no material has textures and no vertex a colour",
        ),
        (Effect::NormalMapping, "no material has a normal map"),
        (Effect::AlphaMask, "every material is opaque"),
        (Effect::Emission, "no material emits light or is unlit"),
        (Effect::Clearcoat, "no material has a coat"),
        (Effect::Transmission, "no material lets light pass"),
        (Effect::ProxyOcclusion, "a plane does not shadow itself"),
        (
            Effect::BounceFromProxy,
            "there is no photograph to take the proxy's colour from",
        ),
        (
            Effect::Occluders,
            "no mask of the photo's foreground is given",
        ),
    ] {
        let e = find(&p, effect);
        assert_eq!((e.enabled, e.reason.as_str()), (false, reason));
        assert_eq!(e.contribution, None);
    }
    assert_eq!(p.rays["proxy_occlusion"], 0);
    assert_eq!(p.rays["bounce"], 0);
    assert!(p.rays["shadow"] > 0);
    assert!(p.left_out.is_some_and(|e| e <= p.tolerance), "{p:?}");
}

#[test]
fn without_a_proxy_nothing_is_planned_for_it() {
    let ball = icosphere(Vec3::ZERO, 0.5, 3);
    let s = scene(ball, matte(Vec3::splat(0.5)), view(), Proxy::None);
    let p = planned(&s, &EffectsConfig::default(), &settings(64, 1));
    for effect in [
        Effect::Shadow,
        Effect::ProxyOcclusion,
        Effect::EmissionOnProxy,
        Effect::BounceToProxy,
        Effect::BounceFromProxy,
    ] {
        assert_eq!(find(&p, effect).reason, "the scene has no proxy");
    }
    assert_eq!(p.simulation().light_on_proxy, None);
    assert_eq!(p.rays["shadow"], 0);
}

#[test]
fn a_folded_bright_object_gets_the_depth_that_it_needs() {
    let knot = torus_knot(Vec3::Y * 0.7, 0.4, 0.17, 96, 12);
    let s = scene(knot, matte(Vec3::splat(0.9)), view(), ground());
    let p = planned(&s, &EffectsConfig::default(), &settings(64, 1));
    assert!(p.is_enabled(Effect::Interreflection));
    assert!((2..=MAX_DEPTH).contains(&p.max_depth), "{}", p.max_depth);
    let coarse = EffectsConfig {
        tolerance: Some(0.02),
        ..EffectsConfig::default()
    };
    let coarse = planned(&s, &coarse, &settings(64, 1));
    assert!(coarse.max_depth < p.max_depth, "{coarse:?} {p:?}");
    // A depth that the user gives stands.
    let shallow = EffectsConfig {
        max_depth: Some(1),
        ..EffectsConfig::default()
    };
    let shallow = planned(&s, &shallow, &settings(64, 1));
    assert_eq!((shallow.max_depth, shallow.simulation().max_depth), (1, 1));
}

#[test]
fn what_the_user_switches_wins() {
    let mut glowing = matte(Vec3::splat(0.5));
    glowing.emissive = Vec3::splat(2.0);
    let s = scene(icosphere(Vec3::Y, 0.5, 2), glowing, view(), ground());
    let config = EffectsConfig {
        emission: Some(EffectSwitch::Off),
        interreflection: Some(EffectSwitch::On),
        clearcoat: Some(EffectSwitch::On),
        ..EffectsConfig::default()
    };
    let p = planned(&s, &config, &settings(64, 1));
    let emission = find(&p, Effect::Emission);
    assert_eq!(
        (emission.enabled, emission.reason.as_str()),
        (false, "switched off by the user")
    );
    let bounces = find(&p, Effect::Interreflection);
    assert_eq!(
        (bounces.enabled, bounces.reason.as_str()),
        (true, "switched on by the user")
    );
    assert_eq!(p.max_depth, MAX_DEPTH);
    // What the scene lacks cannot be switched on.
    assert!(!p.is_enabled(Effect::Clearcoat));
    let no_shadow = EffectsConfig {
        shadow: Some(EffectSwitch::Off),
        ..EffectsConfig::default()
    };
    let p = planned(&s, &no_shadow, &settings(64, 1));
    assert_eq!(
        find(&p, Effect::BounceToProxy).reason,
        "nothing without shadow"
    );
    assert_eq!(p.rays["shadow"] + p.rays["light_on_proxy"], 0);
}

#[test]
fn what_means_nothing_alone_is_left_out_though_the_user_switches_it_on() {
    let mut glowing = matte(Vec3::splat(0.5));
    glowing.emissive = Vec3::splat(2.0);
    let s = scene(icosphere(Vec3::Y, 0.5, 2), glowing, view(), ground());
    let no_shadow = EffectsConfig {
        shadow: Some(EffectSwitch::Off),
        emission_on_proxy: Some(EffectSwitch::On),
        ..EffectsConfig::default()
    };
    let no_emission = EffectsConfig {
        emission: Some(EffectSwitch::Off),
        bounce_to_proxy: Some(EffectSwitch::Off),
        ..EffectsConfig::default()
    };
    for (config, reason) in [
        (no_shadow, "nothing without shadow"),
        (no_emission, "nothing without emission"),
    ] {
        let p = possible(&s, &config, &settings(64, 1));
        let e = find(&p, Effect::EmissionOnProxy);
        assert_eq!((e.enabled, e.reason.as_str()), (false, reason));
        assert_eq!(p.simulation().light_on_proxy, None);
    }
}

#[test]
fn a_depth_of_one_leaves_interreflection_out_from_the_beginning() {
    let knot = torus_knot(Vec3::Y * 0.7, 0.4, 0.17, 96, 12);
    let s = scene(knot, matte(Vec3::splat(0.9)), view(), ground());
    let shallow = EffectsConfig {
        max_depth: Some(1),
        ..EffectsConfig::default()
    };
    let p = planned(&s, &shallow, &settings(16, 1));
    let e = find(&p, Effect::Interreflection);
    let reason = "max_depth allows one interaction";
    assert_eq!((e.enabled, e.reason.as_str()), (false, reason));
    assert_eq!(e.contribution, None);
}

#[test]
fn light_that_reaches_the_proxy_is_found_and_simulated() {
    let mut glowing = matte(Vec3::splat(0.5));
    glowing.emissive = Vec3::splat(4.0);
    let s = scene(icosphere(Vec3::Y * 0.6, 0.5, 2), glowing, view(), ground());
    let p = planned(&s, &EffectsConfig::default(), &settings(64, 1));
    assert!(p.is_enabled(Effect::Emission) && p.is_enabled(Effect::EmissionOnProxy));
    assert!(p.rays["light_on_proxy"] > 0);
}

#[test]
fn a_coloured_floor_in_the_photograph_lights_the_object() {
    let photo = LinearImage(Raster::filled(24, 24, Vec3::new(0.9, 0.1, 0.1)));
    let settings = Settings {
        background: Some(&photo),
        ..settings(64, 1)
    };
    let s = scene(
        icosphere(Vec3::Y * 0.6, 0.5, 3),
        matte(Vec3::splat(0.8)),
        view(),
        ground(),
    );
    let p = planned(&s, &EffectsConfig::default(), &settings);
    assert!(p.is_enabled(Effect::BounceFromProxy));
    assert!(p.rays["proxy_radiance"] > 0);
}

/// Samples a pixel of the references.
const MANY: u32 = 4096;

/// Display-referred RMSE between two films over the pixels that the object or its shadow touches in the second, in the
/// linear values of these tests.
fn difference(a: &Rendered, b: &Rendered) -> f64 {
    let (a, b) = (&a.film, &b.film);
    let (mut sum, mut count) = (0.0, 0);
    for k in 0..b.alpha.pixels().len() {
        let shown = |film: &crate::film::Film| {
            let (object, alpha) = (film.object.pixels()[k], film.alpha.pixels()[k]);
            let under = Vec3::splat(0.18) * film.shadow.pixels()[k] * (1.0 - alpha);
            (under + object).clamp(Vec3::ZERO, Vec3::ONE)
        };
        let is_shadowed = (b.shadow.pixels()[k] - Vec3::ONE).abs().max_element() > 0.02;
        if b.alpha.pixels()[k] > 0.0 || is_shadowed {
            sum += f64::from((shown(a) - shown(b)).length_squared()) / 3.0;
            count += 1;
        }
    }
    (sum / f64::from(count.max(1))).sqrt()
}

/// Plans `scene` by a render and compares what was left out with everything, converged with the same numbers. From the
/// second round on no ray may be traced for what was left out. Returns the plan.
fn assert_plan_keeps_the_picture(scene: &Scene, settings: &Settings) -> EffectsPlan {
    let (p, first) = rendered(scene, &EffectsConfig::default(), settings);
    let left_out = first.left_out.as_ref().expect("was asked for");
    let all = EffectsPlan::everything(scene, settings).simulation();
    let converged = |simulation: &Simulation| {
        let settings = Settings {
            stop: Stop::Samples(MANY),
            ..*settings
        };
        render(scene, &sky(1.0), simulation, &settings)
    };
    let everything = converged(&all);
    let kept = converged(&left_out.simulation);
    // Different bounces draw different numbers after the first: some noise of both is left.
    let noise = everything.error.rmse + kept.error.rmse;
    let lost = difference(&kept, &everything);
    assert!(lost <= p.tolerance + noise, "{lost} {noise} {p:?}");
    assert!(
        p.left_out_upper_95.is_some_and(|l| l <= p.tolerance),
        "{p:?}"
    );
    let sent = left_out.simulation.light_on_proxy;
    let kinds = [
        (RayKind::Shadow, p.is_enabled(Effect::Shadow)),
        (
            RayKind::ProxyOcclusion,
            p.is_enabled(Effect::ProxyOcclusion),
        ),
        (RayKind::LightOnProxy, sent.is_some()),
        (
            RayKind::ProxyRadiance,
            p.is_enabled(Effect::BounceFromProxy),
        ),
    ];
    for (kind, enabled) in kinds {
        let later = first.counts.get(kind) - left_out.first_round.get(kind);
        assert!(enabled || later == 0, "{kind:?}: {later}");
    }
    p
}

fn knot() -> dipir_scene::mesh::TriangleMesh {
    torus_knot(Vec3::Y * 0.7, 0.4, 0.15, 96, 12)
}

fn ball() -> dipir_scene::mesh::TriangleMesh {
    icosphere(Vec3::Y * 0.6, 0.5, 3)
}

#[test]
fn the_plan_of_a_matte_convex_object_keeps_the_picture() {
    let s = scene(ball(), matte(Vec3::splat(0.6)), view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(64, 1));
    assert_eq!(p.max_depth, 1);
}

#[test]
fn the_plan_of_a_concave_object_keeps_the_picture() {
    let s = scene(knot(), matte(Vec3::splat(0.8)), view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(64, 1));
    assert!(p.is_enabled(Effect::Interreflection));
}

#[test]
fn the_plan_of_a_metal_keeps_the_picture() {
    let mut metal = matte(Vec3::new(0.9, 0.6, 0.2));
    (metal.metallic, metal.roughness) = (1.0, 0.3);
    let s = scene(knot(), metal, view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(64, 1));
    assert!(p.is_enabled(Effect::Specular));
}

#[test]
fn the_plan_of_a_coloured_surface_keeps_the_picture() {
    let mut mesh = ball();
    mesh.colors = mesh.normals.iter().map(|n| n.abs().extend(1.0)).collect();
    let s = scene(mesh, matte(Vec3::splat(0.9)), view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(64, 1));
    assert!(p.is_enabled(Effect::Textures));
}

#[test]
fn the_plan_of_an_emitter_keeps_the_picture() {
    let mut glowing = matte(Vec3::splat(0.5));
    glowing.emissive = Vec3::new(0.5, 0.3, 0.1);
    let s = scene(ball(), glowing, view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(64, 1));
    assert!(p.is_enabled(Effect::Emission));
}

#[test]
fn the_plan_of_a_half_transparent_sheet_keeps_the_picture() {
    let mut holes = matte(Vec3::splat(0.7));
    holes.base_color.w = 0.5;
    holes.alpha_mode = AlphaMode::Blend;
    holes.double_sided = true;
    let sheet = quad(Vec3::new(-0.5, 0.2, 0.0), Vec3::X, Vec3::Y);
    let s = scene(sheet, holes, view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(64, 1));
    assert!(p.is_enabled(Effect::AlphaMask));
}

#[test]
fn the_plan_of_glass_keeps_the_picture() {
    let mut glass = matte(Vec3::splat(0.9));
    glass.roughness = 0.05;
    glass.transmission = Some(dipir_scene::material::Transmission {
        factor: 1.0,
        texture: None,
    });
    let s = scene(ball(), glass, view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(64, 1));
    assert!(p.is_enabled(Effect::Transmission));
}

#[test]
fn the_plan_without_a_proxy_keeps_the_picture() {
    let s = scene(knot(), matte(Vec3::splat(0.5)), view(), Proxy::None);
    assert_plan_keeps_the_picture(&s, &settings(64, 1));
}

#[test]
fn the_plan_of_a_folded_proxy_mesh_keeps_the_picture() {
    let mut floor = quad(
        Vec3::new(-9.0, 0.0, 9.0),
        Vec3::X * 18.0,
        Vec3::NEG_Z * 18.0,
    );
    let wall = quad(Vec3::new(-9.0, 0.0, -1.5), Vec3::X * 18.0, Vec3::Y * 4.0);
    crate::shapes::append(&mut floor, wall, 0);
    let s = scene(ball(), matte(Vec3::splat(0.5)), view(), Proxy::Mesh(floor));
    let p = assert_plan_keeps_the_picture(&s, &settings(64, 1));
    assert!(p.simulation().shadow);
}

#[test]
fn the_file_round_trips_and_refuses_unknown_keys() {
    let s = scene(
        icosphere(Vec3::Y, 0.5, 2),
        matte(Vec3::splat(0.5)),
        view(),
        ground(),
    );
    let p = planned(&s, &EffectsConfig::default(), &settings(64, 1));
    let json = serde_json::to_string_pretty(&p).expect("serialises");
    let back: EffectsPlan = serde_json::from_str(&json).expect("parses");
    assert_eq!(back, p);
    let broken = json.replace("max_depth", "depth");
    assert!(serde_json::from_str::<EffectsPlan>(&broken).is_err());
}

#[test]
fn the_same_seed_gives_the_same_plan() {
    let ball = icosphere(Vec3::Y * 0.7, 0.4, 2);
    let s = scene(ball, matte(Vec3::splat(0.9)), view(), ground());
    let [a, b] = [1, 2].map(|threads| {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("a pool")
            .install(|| planned(&s, &EffectsConfig::default(), &settings(64, 1)))
    });
    assert_eq!(a, b);
}

#[test]
fn what_does_not_show_takes_no_ray_after_the_first_round_and_the_bound_holds() {
    let mut dark = matte(Vec3::splat(0.002));
    (dark.metallic, dark.roughness) = (1.0, 1.0);
    let s = scene(knot(), dark, view(), ground());
    let many = Settings {
        stop: Stop::TargetError(0.003),
        ..settings(64, 1)
    };
    let (p, r) = rendered(&s, &EffectsConfig::default(), &many);
    let left_out = r.left_out.as_ref().expect("measured");
    assert!(r.rounds > 1);
    // A black object sends nothing anywhere.
    for effect in [Effect::Interreflection, Effect::BounceToProxy] {
        let e = find(&p, effect);
        assert!(!e.enabled && e.contribution.is_some(), "{e:?}");
    }
    assert_eq!((p.max_depth, left_out.simulation.light_on_proxy), (1, None));
    assert!(left_out.first_round.get(RayKind::LightOnProxy) > 0);
    let later = r.counts.get(RayKind::LightOnProxy);
    assert_eq!(later, left_out.first_round.get(RayKind::LightOnProxy));
    // What is lost counts as error.
    assert!(
        r.error.rmse >= left_out.lost.rmse && r.error.upper_95 <= 0.003,
        "{r:?}"
    );
    assert!(left_out.lost.upper_95 <= 0.25 * 0.003);
    // The user's word stands.
    let config = EffectsConfig {
        bounce_to_proxy: Some(EffectSwitch::On),
        max_depth: Some(3),
        ..EffectsConfig::default()
    };
    let (p, r) = rendered(&s, &config, &many);
    assert!(
        p.is_enabled(Effect::BounceToProxy) && p.max_depth == 3,
        "{p:?}"
    );
    let first = &r.left_out.as_ref().expect("measured").first_round;
    assert!(r.counts.get(RayKind::LightOnProxy) > first.get(RayKind::LightOnProxy));
    let all = EffectsConfig {
        mode: Some(EffectsMode::All),
        ..EffectsConfig::default()
    };
    let (p, r) = rendered(&s, &all, &many);
    assert!(r.left_out.is_none() && p.max_depth == MAX_DEPTH && p.left_out.is_none());
}

#[test]
fn a_contribution_is_what_leaving_the_effect_out_changes() {
    let mut glowing = matte(Vec3::new(0.9, 0.7, 0.5));
    glowing.emissive = Vec3::splat(0.3);
    let s = scene(knot(), glowing, view(), ground());
    let (_, r) = rendered(&s, &EffectsConfig::default(), &settings(256, 1));
    let left_out = r.left_out.expect("measured");
    let everything = EffectsPlan::everything(&s, &settings(64, 1)).simulation();
    let converged = |simulation: &Simulation| render(&s, &sky(1.0), simulation, &settings(MANY, 3));
    let all = converged(&everything);
    let both = LightOnProxy {
        emission: true,
        bounce: true,
    };
    let with = |max_depth: u32, sent: LightOnProxy| Simulation {
        max_depth,
        light_on_proxy: Some(sent),
        ..everything
    };
    let emission = LightOnProxy {
        emission: false,
        ..both
    };
    let bounce = LightOnProxy {
        bounce: false,
        ..both
    };
    let cases = [
        ("interreflection", left_out.interreflection(), with(1, both)),
        ("depth 2", left_out.deeper(2), with(2, both)),
        (
            "emission",
            left_out.emission_on_proxy(),
            with(MAX_DEPTH, emission),
        ),
        (
            "bounce",
            left_out.bounce_to_proxy(),
            with(MAX_DEPTH, bounce),
        ),
    ];
    for (name, measured, without) in cases {
        let truth = difference(&converged(&without), &all);
        assert!(truth > 0.002, "{name}: {truth}");
        let error = (measured.rmse - truth).abs();
        assert!(
            error < 0.1 * truth + 3.0 * measured.std_error,
            "{name}: {measured:?}, true {truth}"
        );
    }
}

#[test]
fn the_same_bytes_come_from_any_number_of_threads_when_effects_are_left_out() {
    let s = scene(knot(), matte(Vec3::splat(0.3)), view(), ground());
    let many = Settings {
        stop: Stop::TargetError(0.01),
        ..settings(64, 1)
    };
    let [a, b] = [1, 2].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.expect("a pool");
        pool.install(|| rendered(&s, &EffectsConfig::default(), &many).1)
    });
    assert_eq!(a.film.object, b.film.object);
    assert_eq!(a.film.shadow, b.film.shadow);
    assert_eq!((a.left_out, a.counts), (b.left_out, b.counts));
}

#[test]
fn occluders_that_are_switched_off_are_said_to_be() {
    let ball = icosphere(Vec3::Y * 0.5, 0.5, 1);
    let s = scene(ball, matte(Vec3::splat(0.5)), view(), ground());
    let off = EffectsConfig {
        occluders: Some(EffectSwitch::Off),
        ..EffectsConfig::default()
    };
    let reason = |config: &EffectsConfig| {
        let plan = possible(&s, config, &settings(8, 1));
        let found = find(&plan, Effect::Occluders);
        assert!(!found.enabled);
        found.reason.clone()
    };
    assert_eq!(reason(&off), "switched off by the user");
    let without = reason(&EffectsConfig::default());
    assert_eq!(without, "no mask of the photo's foreground is given");
}
