use dipir_imaging::raster::{LinearImage, Raster};
use dipir_scene::mesh::TriangleMesh;

use super::*;
use crate::counters::RayKind;
use crate::shapes::{icosphere, quad, torus_knot};
use crate::testing::{camera, ground, matte, scene, settings, sky};

fn view() -> dipir_scene::camera::Camera {
    camera(Vec3::new(0.0, 2.0, 4.0), Vec3::Y * 0.5, 40.0, 24)
}

fn planned(scene: &Scene, config: &EffectsConfig, settings: &Settings) -> EffectsPlan {
    plan(
        &Renderer::new(scene),
        &sky(1.0),
        config,
        settings,
        &mut |_| ControlFlow::Continue(()),
    )
    .expect("plans")
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

/// Octahedra about one centre: a ray meets thousands of boxes, however the hierarchy is built.
fn shells(count: u32) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for k in 0..count {
        let r = 0.2 + 0.3 * k as f32 / count as f32;
        let corners = [Vec3::X, -Vec3::X, Vec3::Y, -Vec3::Y, Vec3::Z, -Vec3::Z];
        mesh.positions
            .extend(corners.map(|c| Vec3::Y * 0.5 + c * r));
        for octant in 0..8 {
            let pick = |axis: u32| 6 * k + 2 * axis + (octant >> axis & 1);
            mesh.indices.push([pick(0), pick(1), pick(2)]);
        }
    }
    mesh.materials = vec![0; mesh.indices.len()];
    mesh
}

#[test]
fn where_rays_take_too_long_nothing_is_measured_and_everything_simulated() {
    let plan_of = |count: u32| {
        let s = scene(shells(count), matte(Vec3::splat(0.5)), view(), ground());
        planned(&s, &EffectsConfig::default(), &settings(0, 1))
    };
    let p = plan_of(16_000);
    for effect in [Effect::Shadow, Effect::Specular, Effect::Interreflection] {
        let e = find(&p, effect);
        assert_eq!(
            (e.enabled, e.reason.as_str()),
            (true, "not measured, for rays take too long")
        );
    }
    assert!(p.effects.iter().all(|e| e.contribution.is_none()));
    assert_eq!((p.left_out, p.max_depth), (None, MAX_DEPTH));
    // Fewer shells are worth measuring.
    let p = plan_of(100);
    assert!(find(&p, Effect::Specular).contribution.is_some());
}

#[test]
fn a_matte_convex_object_needs_no_interreflection_and_only_what_it_has() {
    let ball = icosphere(Vec3::Y * 0.5, 0.5, 3);
    let s = scene(ball, matte(Vec3::splat(0.5)), view(), ground());
    let p = planned(&s, &EffectsConfig::default(), &settings(0, 1));
    let e = find(&p, Effect::Interreflection);
    assert_eq!((e.enabled, e.contribution), (false, Some(0.0)), "{e:?}");
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
    let p = planned(&s, &EffectsConfig::default(), &settings(0, 1));
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
    let p = planned(&s, &EffectsConfig::default(), &settings(0, 1));
    assert!(p.is_enabled(Effect::Interreflection));
    assert!((2..=MAX_DEPTH).contains(&p.max_depth), "{}", p.max_depth);
    let coarse = EffectsConfig {
        tolerance: Some(0.02),
        ..EffectsConfig::default()
    };
    let coarse = planned(&s, &coarse, &settings(0, 1));
    assert!(coarse.max_depth < p.max_depth, "{coarse:?} {p:?}");
    // A depth that the user gives stands, and what it costs is said.
    let shallow = EffectsConfig {
        max_depth: Some(1),
        ..EffectsConfig::default()
    };
    let shallow = planned(&s, &shallow, &settings(0, 1));
    assert_eq!((shallow.max_depth, shallow.simulation().max_depth), (1, 1));
    assert!(shallow.left_out > p.left_out);
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
    let p = planned(&s, &config, &settings(0, 1));
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
    let p = planned(&s, &no_shadow, &settings(0, 1));
    assert_eq!(
        find(&p, Effect::BounceToProxy).reason,
        "nothing without shadow"
    );
    assert_eq!(p.rays["shadow"] + p.rays["light_on_proxy"], 0);
}

#[test]
fn light_that_reaches_the_proxy_is_found_and_simulated() {
    let mut glowing = matte(Vec3::splat(0.5));
    glowing.emissive = Vec3::splat(4.0);
    let s = scene(icosphere(Vec3::Y * 0.6, 0.5, 2), glowing, view(), ground());
    let p = planned(&s, &EffectsConfig::default(), &settings(0, 1));
    assert!(p.is_enabled(Effect::Emission) && p.is_enabled(Effect::EmissionOnProxy));
    assert!(p.rays["light_on_proxy"] > 0);
}

#[test]
fn a_coloured_floor_in_the_photograph_lights_the_object() {
    let photo = LinearImage(Raster::filled(24, 24, Vec3::new(0.9, 0.1, 0.1)));
    let settings = Settings {
        background: Some(&photo),
        ..settings(0, 1)
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

/// Plans `scene` and compares what was planned with everything, under fresh seeds; then the rays
/// of every kind that belongs to what was left out must not exist. Returns the plan.
fn assert_plan_keeps_the_picture(scene: &Scene, settings: &Settings) -> EffectsPlan {
    let light = sky(1.0);
    let p = planned(scene, &EffectsConfig::default(), settings);
    let renderer = Renderer::new(scene);
    let fresh = Settings {
        seed: 77,
        ..*settings
    };
    let pilot = Pilot::new(&renderer, &light, &fresh);
    let all = EffectsPlan::everything(scene, settings).simulation();
    let reference = pilot.reference(&all).expect("renders");
    let planned = p.simulation();
    let difference = pilot.difference(&reference, &planned).expect("renders");
    // The measurement itself is uncertain by its standard error.
    let allowed = p.tolerance + 2.0 * difference.std_error;
    assert!(difference.rmse <= allowed, "{difference:?} {p:?}");
    let counts = pilot.render(&planned).expect("renders").counts;
    let kinds = [
        (RayKind::Shadow, p.is_enabled(Effect::Shadow)),
        (RayKind::Bounce, planned.max_depth > 0),
        (
            RayKind::ProxyOcclusion,
            p.is_enabled(Effect::ProxyOcclusion),
        ),
        (RayKind::LightOnProxy, planned.light_on_proxy.is_some()),
        (
            RayKind::ProxyRadiance,
            p.is_enabled(Effect::BounceFromProxy),
        ),
    ];
    for (kind, enabled) in kinds {
        assert!(enabled || counts.get(kind) == 0, "{kind:?}: {counts:?}");
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
    let p = assert_plan_keeps_the_picture(&s, &settings(0, 1));
    assert_eq!(p.max_depth, 1);
}

#[test]
fn the_plan_of_a_concave_object_keeps_the_picture() {
    let s = scene(knot(), matte(Vec3::splat(0.8)), view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(0, 1));
    assert!(p.is_enabled(Effect::Interreflection));
}

#[test]
fn the_plan_of_a_metal_keeps_the_picture() {
    let mut metal = matte(Vec3::new(0.9, 0.6, 0.2));
    (metal.metallic, metal.roughness) = (1.0, 0.3);
    let s = scene(knot(), metal, view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(0, 1));
    assert!(p.is_enabled(Effect::Specular));
}

#[test]
fn the_plan_of_a_coloured_surface_keeps_the_picture() {
    let mut mesh = ball();
    mesh.colors = mesh.normals.iter().map(|n| n.abs().extend(1.0)).collect();
    let s = scene(mesh, matte(Vec3::splat(0.9)), view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(0, 1));
    assert!(p.is_enabled(Effect::Textures));
}

#[test]
fn the_plan_of_an_emitter_keeps_the_picture() {
    let mut glowing = matte(Vec3::splat(0.5));
    glowing.emissive = Vec3::new(0.5, 0.3, 0.1);
    let s = scene(ball(), glowing, view(), ground());
    let p = assert_plan_keeps_the_picture(&s, &settings(0, 1));
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
    let p = assert_plan_keeps_the_picture(&s, &settings(0, 1));
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
    let p = assert_plan_keeps_the_picture(&s, &settings(0, 1));
    assert!(p.is_enabled(Effect::Transmission));
}

#[test]
fn the_plan_without_a_proxy_keeps_the_picture() {
    let s = scene(knot(), matte(Vec3::splat(0.5)), view(), Proxy::None);
    assert_plan_keeps_the_picture(&s, &settings(0, 1));
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
    let p = assert_plan_keeps_the_picture(&s, &settings(0, 1));
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
    let p = planned(&s, &EffectsConfig::default(), &settings(0, 1));
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
            .install(|| planned(&s, &EffectsConfig::default(), &settings(0, 1)))
    });
    assert_eq!(a, b);
}

#[test]
fn planning_can_be_interrupted() {
    let s = scene(
        icosphere(Vec3::Y, 0.5, 2),
        matte(Vec3::splat(0.5)),
        view(),
        ground(),
    );
    let result = plan(
        &Renderer::new(&s),
        &sky(1.0),
        &EffectsConfig::default(),
        &settings(0, 1),
        &mut |_| ControlFlow::Break(()),
    );
    assert!(matches!(result, Err(RenderError::Interrupted)));
}
