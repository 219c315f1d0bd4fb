use super::super::features::{ALL, CLEARCOAT, SPECULAR};
use super::super::ggx::reflect;
use super::super::reference::Reference;
use super::*;
use dipir_numerics::gradcheck::{central_difference, relative_error};
use glam::{DVec3, Vec2};

fn surface(r: &Reference) -> SurfacePoint {
    let mut s = SurfacePoint::facing(Vec3::Z);
    s.base_color = Vec3::splat(r.color as f32);
    s.metallic = r.metallic as f32;
    s.roughness = r.roughness as f32;
    s.transmission = r.passing as f32;
    if let Some((factor, roughness)) = r.coat {
        s.coat.factor = factor as f32;
        s.coat.roughness = roughness as f32;
    }
    s
}

/// Derivatives of the f64 reference. Steps of 1e-5 of the scale on which the value changes: the
/// truncation is some 1e-9 of the derivative, rounding 1e-10.
fn numeric(r: &Reference, wo: DVec3, wi: DVec3) -> [f64; 3] {
    let by = |set: &dyn Fn(&mut Reference, f64), at: f64, h: f64| {
        let f = |x: f64| {
            let mut moved = *r;
            set(&mut moved, x);
            moved.eval(wo, wi)
        };
        central_difference(f, at, h)
    };
    [
        by(&|r, x| r.color = x, r.color, 1e-5),
        by(&|r, x| r.metallic = x, r.metallic, 1e-5),
        by(&|r, x| r.roughness = x, r.roughness, 1e-5 * r.roughness),
    ]
}

/// Directions of `wi` for one `wo`: mirrored about facets in and around the lobe, and one far
/// away from it.
fn directions(wo: Vec3, alpha: f32) -> Vec<Vec3> {
    let mut all = vec![Vec3::new(-0.3, 0.7, 0.5).normalize()];
    for offset in [0.0f32, 0.3, 1.0, 4.0] {
        let h = Vec3::new(offset * alpha, 0.2 * offset * alpha, 1.0).normalize();
        let wi = reflect(wo, h).0;
        if wi.z > 0.0 {
            all.push(wi.normalize());
        }
    }
    all
}

fn check<const F: u32>(r: Reference, below: bool) -> usize {
    let surface = surface(&r);
    // What f32 made of the parameters.
    let r = Reference {
        color: f64::from(surface.base_color.x),
        metallic: f64::from(surface.metallic),
        roughness: f64::from(surface.roughness),
        passing: f64::from(surface.transmission),
        coat: r.coat.map(|_| {
            (
                f64::from(surface.coat.factor),
                f64::from(surface.coat.roughness),
            )
        }),
        ..r
    };
    let alpha = (r.roughness * r.roughness) as f32;
    let mut checked = 0;
    // None of them, over the widths below, is an edge of a cell of the table, where differences
    // straddle two slopes.
    for z in [0.997f32, 0.71, 0.23, 0.023] {
        let wo = Vec3::new((1.0 - z * z).sqrt(), 0.0, z);
        let bsdf = Bsdf::<F>::new(&surface, wo);
        let slopes = BsdfSlopes::new(&bsdf, &surface);
        for above in directions(wo, alpha) {
            let wi = match below {
                true => Vec3::new(above.x, above.y, -above.z),
                false => above,
            };
            // Directions in f32 do not say more precisely where on its slope the lobe is met,
            // in units of its width.
            let slope_error = 2.0 * f32::EPSILON / (wo.z + above.z) / alpha;
            if slope_error > 1e-3 {
                continue;
            }
            let tolerance = 1e-4 + 8.0 * f64::from(slope_error);
            let (o, i) = (wo.as_dvec3(), wi.as_dvec3());
            let found = slopes.eval(wi);
            let value = r.eval(o, i);
            let expected = numeric(&r, o, i);
            let found = [found.base_color.x, found.metallic.x, found.roughness.x];
            // Where terms cancel, the error is relative to these: the value over the scale on
            // which it changes.
            let floors = [value, value, value / r.roughness];
            for k in 0..3 {
                let error = relative_error(f64::from(found[k]), expected[k], floors[k].max(1e-12));
                assert!(
                    error < tolerance,
                    "{r:?}, wo {wo}, wi {wi}, parameter {k}: {} for {}, error {error:.1e} of at \
                     most {tolerance:.1e}",
                    found[k],
                    expected[k],
                );
                checked += 1;
            }
            if r.coat.is_none() {
                let error = relative_error(f64::from(bsdf.eval(wi).x), value, 1e-12);
                assert!(
                    error < tolerance,
                    "{r:?}, wo {wo}, wi {wi}: value, {error:.1e}"
                );
            }
        }
    }
    checked
}

const ROUGHNESSES: [f64; 8] = [0.02, 0.035, 0.1, 0.21, 0.45, 0.7, 0.95, 1.0];

fn table(change: impl Fn(&mut Reference)) -> impl Iterator<Item = Reference> {
    let mut all = Vec::new();
    for roughness in ROUGHNESSES {
        for metallic in [0.0, 0.4, 1.0] {
            for color in [0.0, 0.05, 0.8, 1.0] {
                let mut r = Reference {
                    color,
                    metallic,
                    roughness,
                    passing: 0.0,
                    coat: None,
                    glossy: true,
                };
                change(&mut r);
                all.push(r);
            }
        }
    }
    all.into_iter()
}

#[test]
fn slopes_of_dielectrics_and_metals_equal_differences_in_f64_up_to_grazing() {
    let checked: usize = table(|_| ()).map(|r| check::<SPECULAR>(r, false)).sum();
    assert!(checked > 3000, "{checked}");
}

#[test]
fn slopes_of_lambertian_surfaces_equal_differences_in_f64() {
    let checked: usize = table(|r| r.glossy = false)
        .filter(|r| r.color > 0.0 && r.metallic < 1.0)
        .map(|r| check::<0>(r, false))
        .sum();
    assert!(checked > 1000, "{checked}");
}

#[test]
fn slopes_below_a_coat_equal_differences_in_f64() {
    let checked: usize = table(|r| r.coat = Some((0.8, 0.3)))
        .map(|r| check::<{ SPECULAR | CLEARCOAT }>(r, false))
        .sum();
    assert!(checked > 3000, "{checked}");
}

#[test]
fn slopes_of_transmissive_sheets_equal_differences_in_f64_on_both_sides() {
    for below in [false, true] {
        let checked: usize = table(|r| r.passing = 0.6)
            // What no technique draws is not evaluated either.
            .filter(|r| !below || r.color > 0.0 && r.metallic < 1.0)
            .map(|r| check::<ALL>(r, below))
            .sum();
        assert!(checked > 1500, "{below}: {checked}");
    }
}

#[test]
fn a_mirrors_weight_changes_with_its_colour_and_not_with_its_roughness() {
    let surface = |color: f32, metallic: f32| SurfacePoint {
        base_color: Vec3::splat(color),
        metallic,
        roughness: 0.0,
        ..SurfacePoint::facing(Vec3::Z)
    };
    let wo = Vec3::new(0.6, 0.0, 0.8);
    for (color, metallic) in [(0.5f32, 1.0f32), (0.7, 0.4)] {
        let bsdf = Bsdf::<SPECULAR>::new(&surface(color, metallic), wo);
        // 1 - epsilon falls on the last technique, 0 on the first that has a chance.
        let specular = if bsdf.chances[0] > 0.0 {
            0.999_999
        } else {
            0.0
        };
        let sample = bsdf.sample(specular, Vec2::splat(0.5)).unwrap();
        assert!(sample.delta);
        let slopes = BsdfSlopes::new(&bsdf, &surface(color, metallic)).weight(specular, &sample);
        let chance = f64::from(bsdf.chances[1]);
        let weight = |c: f64, m: f64| {
            let f0 = 0.04 + (c - 0.04) * m;
            (f0 + (1.0 - f0) * 0.2f64.powi(5)) / chance
        };
        let (c, m) = (f64::from(color), f64::from(metallic));
        let by_color = central_difference(|c| weight(c, m), c, 1e-4);
        let by_metallic = central_difference(|m| weight(c, m), m, 1e-4);
        assert!(relative_error(f64::from(sample.weight.x), weight(c, m), 0.0) < 1e-5);
        assert!(relative_error(f64::from(slopes.base_color.x), by_color, 0.0) < 1e-5);
        assert!(relative_error(f64::from(slopes.metallic.x), by_metallic, 0.0) < 1e-5);
        assert_eq!(slopes.roughness, Vec3::ZERO);
    }
}
