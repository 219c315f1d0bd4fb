//! Every lobe through the harness, and the hard cases by name.
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::stats::sidak;
use glam::{Vec2, Vec3};

mod extensions;
mod pictures;

use super::features::{ALL, CLEARCOAT, PLAIN_GGX, SPECULAR, TRANSMISSION};
use super::harness::{Case, Measured, Scatter};
use super::{Bsdf, ggx::Ggx};
use crate::surface::{CoatPoint, ExtensionPoint, SurfacePoint};

const ROUGHNESSES: [f32; 9] = [0.0, 1e-4, 0.01, 0.02, 0.05, 0.1, 0.3, 0.8, 1.0];
const COSINES: [f32; 4] = [1.0, 0.6, 0.1, 1e-7];

/// The largest weight that a sample may have: how far a single path can stand out. It is
/// reached where a facet reflects more than the lobe does on average, which is what the lobe
/// is chosen by: coats and sheets of index 1.5 at cosines of 0.1.
const MAX_WEIGHT: f32 = 7.0;
/// The same where `wo` grazes the surface and facets turned away from it reflect all.
const MAX_GRAZING_WEIGHT: f32 = 32.0;

fn normal() -> Vec3 {
    Vec3::new(0.3, -0.5, 0.8).normalize()
}

fn white(roughness: f32, metallic: f32) -> SurfacePoint {
    SurfacePoint {
        roughness,
        metallic,
        ..SurfacePoint::facing(normal())
    }
}

fn case<const F: u32>(name: &str, surface: SurfacePoint, cosine: f32) -> Case<'static> {
    let narrowest = [surface.roughness, surface.coat.roughness]
        .into_iter()
        .filter_map(Ggx::new)
        .map(|g| g.alpha)
        .fold(1.0, f32::min);
    Case {
        name: format!(
            "{name}, roughness {}, metallic {}, cos {cosine}",
            surface.roughness, surface.metallic
        ),
        surface,
        prepare: &|s, wo| Box::new(Bsdf::<F>::new(s, wo)) as Box<dyn Scatter>,
        cosine,
        alpha: narrowest as f64,
        transmits: F & TRANSMISSION != 0 && surface.transmission > 0.0,
    }
}

/// Measures `surfaces` from all of [`COSINES`], asserts what holds for all of them, and hands
/// each to `also`.
fn check<const F: u32>(name: &str, surfaces: &[SurfacePoint], also: impl Fn(&Case<'_>, &Measured)) {
    let tests = surfaces.len() * COSINES.len();
    for surface in surfaces {
        for cosine in COSINES {
            let case = case::<F>(name, *surface, cosine);
            let m = case.measure();
            assert!(
                m.p_value > sidak(1e-3, tests),
                "{}: chi-squared p = {:e}",
                case.name,
                m.p_value
            );
            // Interpolation of the energy table, and the quadrature's error.
            assert!(
                m.albedo.max_element() < 1.005,
                "{}: returns {}",
                case.name,
                m.albedo
            );
            // Exact but for coats, which the claim takes for uncoupled, and extensions: a film is known by
            // its bound, sheen without the minimum, an anisotropic lobe by a narrower one.
            let claimed = (m.claimed_albedo - m.albedo).abs().max_element();
            let slack = if surface.extension != ExtensionPoint::NONE {
                0.6
            } else if surface.coat.factor > 0.0 {
                0.06
            } else {
                5e-3
            };
            assert!(
                F & PLAIN_GGX != 0 || claimed < slack || surface.coat.own_normal,
                "{}: claims {}",
                case.name,
                m.claimed_albedo
            );
            // Sheen is drawn uniformly.
            let has_sheen = surface.extension.sheen_color != Vec3::ZERO;
            let limit = if cosine < 0.1 || has_sheen {
                MAX_GRAZING_WEIGHT
            } else {
                MAX_WEIGHT
            };
            assert!(
                m.max_weight < limit,
                "{}: weight {}",
                case.name,
                m.max_weight
            );
            also(&case, &m);
        }
        if surface.coat.factor > 0.0 && surface.coat.own_normal {
            // The cosine to a tilted coat is another one than that to the base.
            continue;
        }
        let asymmetry = case::<F>(name, *surface, 1.0).asymmetry();
        // Sums and products of the same numbers in another order: a few roundings.
        assert!(asymmetry < 1e-5, "{name}: {surface:?}: {asymmetry}");
    }
}

/// White furnace: 0.5% holds the interpolation of the energy table and the quadrature here.
fn stays_white(case: &Case<'_>, m: &Measured) {
    assert!(
        (m.albedo - 1.0).abs().max_element() < 5e-3,
        "{}: returns {}",
        case.name,
        m.albedo
    );
}

fn all_roughnesses(change: impl Fn(f32) -> SurfacePoint) -> Vec<SurfacePoint> {
    ROUGHNESSES.into_iter().map(change).collect()
}

#[test]
fn white_metal_of_any_roughness_stays_white_and_samples_its_density() {
    check::<SPECULAR>("metal", &all_roughnesses(|r| white(r, 1.0)), stays_white);
}

#[test]
fn white_dielectric_of_any_roughness_stays_white_and_samples_its_density() {
    check::<SPECULAR>(
        "dielectric",
        &all_roughnesses(|r| white(r, 0.0)),
        stays_white,
    );
}

#[test]
fn half_metal_of_any_roughness_stays_white_and_samples_its_density() {
    check::<SPECULAR>(
        "half metal",
        &all_roughnesses(|r| white(r, 0.5)),
        stays_white,
    );
}

#[test]
fn white_dielectrics_of_any_index_stay_white() {
    for ior in [1.0, 1.1, 1.33, 2.4, 4.0] {
        let surfaces = [0.01, 0.1, 0.5, 1.0].map(|r| SurfacePoint {
            ior,
            ..white(r, 0.0)
        });
        check::<SPECULAR>(&format!("index {ior}"), &surfaces, stays_white);
    }
}

#[test]
fn black_metal_and_black_dielectric_return_what_their_interface_does_and_no_more() {
    let surfaces: Vec<SurfacePoint> = [0.0, 1.0]
        .into_iter()
        .flat_map(|m| {
            all_roughnesses(move |r| SurfacePoint {
                base_color: Vec3::ZERO,
                ..white(r, m)
            })
        })
        .collect();
    check::<SPECULAR>("black", &surfaces, |case, m| {
        // Schlick's factor rises from F0 to 1; rough surfaces return less than smooth ones.
        let cosine = case.cosine as f64;
        let f0 = 0.04 * (1.0 - case.surface.metallic as f64);
        let smooth = f0 + (1.0 - f0) * (1.0 - cosine).powi(5);
        if case.surface.roughness < 0.02 {
            assert!(
                (m.albedo.x - smooth).abs() < 6e-3,
                "{}: {}",
                case.name,
                m.albedo
            );
        }
        if case.cosine == 1.0 {
            assert!(m.albedo.x < f0 + 0.03, "{}: {}", case.name, m.albedo);
        }
    });
}

#[test]
fn coloured_metal_and_dielectric_keep_their_channels_apart() {
    let surfaces: Vec<SurfacePoint> = [0.0, 0.3, 1.0]
        .into_iter()
        .flat_map(|m| {
            [0.02, 0.3, 1.0].map(move |r| SurfacePoint {
                base_color: Vec3::new(1.0, 0.5, 0.0),
                ..white(r, m)
            })
        })
        .collect();
    check::<ALL>("orange", &surfaces, |case, m| {
        assert!(
            (m.albedo.x - 1.0).abs() < 5e-3,
            "{}: {}",
            case.name,
            m.albedo
        );
        assert!(
            m.albedo.x > m.albedo.y && m.albedo.y > m.albedo.z,
            "{}",
            case.name
        );
    });
}

#[test]
fn without_the_specular_lobe_a_surface_is_lambertian() {
    check::<0>(
        "lambert",
        &[white(0.0, 0.0), white(0.3, 0.25)],
        |case, m| {
            let expected = 1.0 - case.surface.metallic as f64;
            assert!(
                (m.albedo.x - expected).abs() < 1e-3,
                "{}: {}",
                case.name,
                m.albedo
            );
        },
    );
}

#[test]
fn a_white_sheet_of_any_roughness_passes_what_it_does_not_reflect() {
    for share in [1.0, 0.4] {
        let surfaces = all_roughnesses(|r| SurfacePoint {
            transmission: share,
            ..white(r, 0.0)
        });
        check::<{ SPECULAR | TRANSMISSION }>(&format!("sheet {share}"), &surfaces, stays_white);
    }
    let surfaces = [0.0, 0.3, 1.0].map(|r| SurfacePoint {
        transmission: 1.0,
        ..white(r, 0.0)
    });
    check::<TRANSMISSION>("sheet without interface", &surfaces, stays_white);
}

#[test]
fn coats_of_any_roughness_never_add_energy_and_hardly_take_any_from_a_diffuse_base() {
    for roughness in [0.0, 0.1, 0.5, 1.0] {
        let coat = CoatPoint {
            factor: 1.0,
            roughness,
            normal: normal(),
            own_normal: false,
        };
        let surfaces = [0.3, 1.0].map(|r| SurfacePoint {
            coat,
            ..white(r, 0.0)
        });
        check::<{ SPECULAR | CLEARCOAT }>(&format!("coat {roughness}"), &surfaces, |case, m| {
            // The base's own specular lobe, at most a tenth of the light but at grazing
            // angles, loses some where the coat lets less pass on the other side.
            assert!(m.albedo.x > 0.97, "{}: {}", case.name, m.albedo);
        });
        check::<CLEARCOAT>(
            &format!("coat {roughness} on Lambert"),
            &surfaces[..1],
            stays_white,
        );
        let metals = [0.0, 0.3, 1.0].map(|r| SurfacePoint {
            coat,
            ..white(r, 1.0)
        });
        check::<{ SPECULAR | CLEARCOAT }>(
            &format!("coated metal {roughness}"),
            &metals,
            |case, m| {
                assert!(m.albedo.x > 0.9, "{}: {}", case.name, m.albedo);
            },
        );
    }
}

#[test]
fn a_half_coat_with_its_own_normal_over_glass_samples_its_density() {
    let tilted = (normal() + Vec3::new(0.2, 0.1, 0.0)).normalize();
    let surfaces = [0.2, 0.7].map(|r| SurfacePoint {
        coat: CoatPoint {
            factor: 0.5,
            roughness: 0.3,
            normal: tilted,
            own_normal: true,
        },
        transmission: 0.5,
        ..white(r, 0.2)
    });
    check::<ALL>("tilted coat", &surfaces, |_, _| {});
}

#[test]
fn the_plain_lobe_for_validation_samples_its_density() {
    let surfaces = all_roughnesses(|r| white(r, 1.0));
    check::<{ SPECULAR | PLAIN_GGX }>("plain", &surfaces, |_, _| {});
}

#[test]
fn the_energy_table_is_what_quadrature_gives() {
    use super::energy::LobeEnergy;
    use super::energy_quadrature::{directional_albedo, mean_albedo};
    for r in [0.02, 0.05, 0.11, 0.2, 0.35, 0.6, 0.93, 1.0] {
        let (energy, alpha) = (LobeEnergy::new(r as f32), r * r);
        for x in [1e-3, 0.03, 0.3, 1.0, 1.7, 5.0, 30.0, 300.0] {
            let mu = x * alpha;
            if mu > 1.0 {
                continue;
            }
            let (loss, e5) = directional_albedo(mu, alpha, 128);
            let got = (
                energy.loss(mu as f32) as f64,
                energy.share(mu as f32) as f64,
            );
            // 128 steps are good to a few 1e-4; of rough surfaces below mu = 2^-8, where the
            // table ends, a thousandth is missing; bilinear interpolation of the share, which
            // changes fastest for smooth surfaces, to 3e-3.
            assert!(
                (got.0 - loss).abs() < 2e-3 + 5e-3 * loss,
                "{r} {mu}: {} {loss}",
                got.0
            );
            assert!(
                (got.1 - e5 / (1.0 - loss)).abs() < 4e-3,
                "{r} {mu}: {} {e5}",
                got.1
            );
        }
        let (loss, e5) = mean_albedo(alpha, 192, 40);
        // Relative: a smooth surface's mean divides a loss that is as small.
        assert!(
            (energy.mean_loss as f64 / loss - 1.0).abs() < 0.03,
            "{r}: {loss}"
        );
        assert!((energy.mean_e5 as f64 - e5).abs() < 4e-4, "{r}: {e5}");
    }
}

/// What a white surface with a roughness of `energy` returns towards the cosine `mu`, its single scattering by quadrature and
/// the rest by the table; of index 1.5, and of metal.
fn returned(energy: &super::energy::LobeEnergy, alpha: f64, mu: f64) -> [f64; 2] {
    let (loss, e5) = super::energy_quadrature::directional_albedo(mu, alpha, 160);
    // Cosine-weighted mean over the hemisphere, graded towards grazing angles.
    let mean = |f: &dyn Fn(f32) -> f64| -> f64 {
        let at = |k: u32| {
            let t = (f64::from(k) + 0.5) / 512.0;
            f(t.powi(4) as f32) * 2.0 * t.powi(4) * 4.0 * t.powi(3) / 512.0
        };
        (0..512).map(at).sum()
    };
    let returned = mean(&|mu| energy.loss(mu).into()) / f64::from(energy.mean_loss);
    [0.04, 1.0].map(|f0| {
        let further = f64::from(energy.further_fresnel(f0));
        let interface =
            f64::from(energy.mean_albedo(f0, 1.0)) + further * f64::from(energy.mean_loss);
        let f0 = f64::from(f0);
        let left = |mu: f32| {
            let (loss, share) = (f64::from(energy.loss(mu)), f64::from(energy.share(mu)));
            1.0 - (f0 + (1.0 - f0) * share) * (1.0 - loss) - further * loss
        };
        let lost = f64::from(energy.loss(mu as f32));
        let specular = f0 * (1.0 - loss) + (1.0 - f0) * e5 + further * lost * returned;
        match f0 < 1.0 {
            true => specular + left(mu as f32) * mean(&left) / (1.0 - interface),
            false => specular,
        }
    })
}

#[test]
fn interpolation_of_the_energy_table_adds_less_than_four_thousandths_of_light() {
    use super::energy::LobeEnergy;
    // At the middle between rows, and many cosines; 160 steps are good to 2e-4. The largest found is 3.2e-3.
    for row in 1..32 {
        let r = (f64::from(row) + 0.5) / 32.0;
        let energy = LobeEnergy::new(r as f32);
        for k in 0..24 {
            let mu = 0.05 + 0.95 * (f64::from(k) / 23.0).powi(2);
            for all in returned(&energy, r * r, mu) {
                assert!((0.996..1.004).contains(&all), "{r} {mu}: {all}");
            }
        }
    }
}

#[test]
fn a_surface_at_the_edge_of_smoothness_joins_the_mirror() {
    let wo = Vec3::new(0.8, 0.0, 0.6);
    let albedo = |r: f32| {
        let s = SurfacePoint {
            base_color: Vec3::new(0.9, 0.5, 0.1),
            ..SurfacePoint {
                roughness: r,
                metallic: 0.7,
                ..SurfacePoint::facing(Vec3::Z)
            }
        };
        Bsdf::<SPECULAR>::new(&s, wo).albedo()
    };
    let difference = (albedo(0.02) - albedo(0.0199)).abs().max_element();
    assert!(difference < 1e-3, "{difference}");
}

#[test]
fn a_mirror_is_seen_by_sampling_alone() {
    let s = SurfacePoint {
        roughness: 0.0,
        metallic: 1.0,
        ..SurfacePoint::facing(Vec3::Z)
    };
    let wo = Vec3::new(0.6, 0.0, 0.8);
    let bsdf = Bsdf::<ALL>::new(&s, wo);
    assert!(bsdf.is_delta());
    let mirrored = Vec3::new(-0.6, 0.0, 0.8);
    assert_eq!(bsdf.eval_pdf(mirrored), (Vec3::ZERO, 0.0));
    let sample = bsdf.sample(0.3, Vec2::splat(0.4)).unwrap();
    assert!(sample.delta && sample.pdf == f32::INFINITY && !sample.transmitted);
    assert!(sample.wi.abs_diff_eq(mirrored, 1e-6) && sample.weight == Vec3::ONE);
    let diffuse = SurfacePoint { metallic: 0.0, ..s };
    assert!(!Bsdf::<ALL>::new(&diffuse, wo).is_delta());
}

#[test]
fn no_light_leaks_through_a_shading_normal_that_leans_over() {
    let s = SurfacePoint {
        normal: Vec3::new(0.8, 0.0, 0.6),
        ..SurfacePoint::facing(Vec3::Z)
    };
    let bsdf = Bsdf::<ALL>::new(&s, Vec3::Z);
    // Above the shading plane, below the triangle: that light is inside the object.
    let below = Vec3::new(0.99, 0.0, -0.141).normalize();
    assert!(below.dot(s.normal) > 0.0);
    assert_eq!(bsdf.eval_pdf(below), (Vec3::ZERO, 0.0));
}

#[test]
fn nothing_is_ever_nan_whatever_the_parameters() {
    for i in 0..20_000u64 {
        let u = |d: u64| (hash_u64s(&[3, i, d]) >> 40) as f32 / 16_777_216.0;
        // Corners of the domain are as likely as its inside.
        let edge = |d: u64| ((u(d) * 3.0 - 1.0).clamp(0.0, 1.0), u(d + 50) * 1e-3);
        let pick = |d: u64| match i % 3 {
            0 => edge(d).1,
            _ => edge(d).0,
        };
        let direction = |d: u64| {
            let z = pick(d).max(1e-7) * (1.0 - 2.0 * f32::from(u(d) > 0.7 && d > 20));
            let (s, c) = (std::f32::consts::TAU * u(d + 1)).sin_cos();
            let r = (1.0 - z * z).max(0.0).sqrt();
            Vec3::new(r * c, r * s, z)
        };
        let s = SurfacePoint {
            base_color: Vec3::new(pick(1), pick(2), pick(3)),
            metallic: pick(4),
            roughness: pick(5),
            ior: 1.0 + 3.0 * pick(6),
            transmission: pick(7),
            coat: CoatPoint {
                factor: pick(8),
                roughness: pick(9),
                normal: Vec3::new(0.3 * pick(10), 0.0, 1.0).normalize(),
                own_normal: true,
            },
            ..SurfacePoint::facing(Vec3::Z)
        };
        let bsdf = Bsdf::<ALL>::new(&s, direction(14));
        let (value, pdf) = bsdf.eval_pdf(direction(30));
        assert!(
            value.is_finite() && value.min_element() >= 0.0,
            "{s:?}: {value}"
        );
        assert!(pdf.is_finite() && pdf >= 0.0, "{s:?}: {pdf}");
        if let Some(sample) = bsdf.sample(u(40), Vec2::new(u(41), u(42))) {
            assert!(
                sample.wi.is_normalized() && sample.weight.is_finite(),
                "{s:?}: {sample:?}"
            );
            assert!(
                sample.pdf > 0.0 && sample.weight.min_element() >= 0.0,
                "{s:?}: {sample:?}"
            );
        }
    }
}
