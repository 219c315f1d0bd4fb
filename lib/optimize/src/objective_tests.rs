use super::*;
use crate::crop::CropView;
use crate::guidance::{PHOTOMETRIC_SCALE, charbonnier};
use crate::tensors::Group;
use crate::testing::{DenseTransport, WEIGHTS, objective, recorded};
use dipir_imaging::resize::PixelBox;
use dipir_imaging::spline::Curve;
use dipir_imaging::tone::{TONE_PARAMETERS, ToneParameters, reinhard};
use dipir_light::environment::solid_angle;
use dipir_light::luminance::luminance_f64;
use dipir_light::rasterize::rasterize;
use dipir_light::regularizer::UNIFORM_SHARE;
use dipir_numerics::gradcheck::relative_error;
use dipir_numerics::hashing::mix64;
use glam::DVec3;
use std::f64::consts::PI;

const PICTURE: (usize, usize) = (14, 12);
const MAP: (usize, usize) = (16, 8);

/// The whole chain again, as its equations are written and in f64, from the rasterised maps to the
/// loss: Charbonnier's against a grey picture, plus both regularisers.
fn reference_loss(
    scene: &DenseTransport,
    [f, h]: [&[DVec3]; 2],
    tone: &ToneParameters,
    s: f64,
    view: Option<PixelBox>,
) -> f64 {
    let (fl, hl): (Vec<_>, Vec<_>) = (0..f.len())
        .map(|k| (luminance_f64(f[k]), luminance_f64(h[k])))
        .unzip();
    let largest = fl.iter().fold(0.0, |m: f64, l| m.max(*l));
    let fused: Vec<DVec3> = (0..f.len())
        .map(|k| {
            let r = fl[k] / largest * hl[k] / (fl[k] + hl[k]);
            f[k] * ((1.0 - r) * fl[k] + r * hl[k]) / fl[k]
        })
        .collect();
    let mixed = |a: &[DVec3]| -> Vec<DVec3> {
        a.iter()
            .zip(&fused)
            .map(|(a, b)| *b * s + *a * (1.0 - s))
            .collect()
    };
    let (light, caster) = (mixed(f), mixed(h));

    let curves = tone.curves();
    let arriving: DVec3 = caster
        .iter()
        .zip(&scene.arriving)
        .map(|(l, e)| *l * f64::from(*e))
        .sum();
    let toned = |curve: &Curve, x: f64| curve.eval(x);
    let foreground = curves.foreground.curve();
    let shadow = curves.shadow.map(|k| k.curve());
    let background = crate::testing::background(PICTURE);
    let pixel = |k: usize| {
        let alpha = f64::from(scene.coverage.pixels()[k]);
        let object: DVec3 = scene.object[k]
            .iter()
            .zip(&light)
            .map(|(w, l)| w.as_dvec3() * *l)
            .sum();
        let blocked: DVec3 = scene.blocked[k]
            .iter()
            .zip(&caster)
            .map(|(w, l)| *l * f64::from(*w))
            .sum();
        let ratio = DVec3::ONE - blocked / arriving;
        let mut shown = DVec3::ZERO;
        for c in 0..3 {
            let own = match alpha > 0.0 {
                true => alpha * toned(&foreground, reinhard(object[c] / alpha)),
                false => 0.0,
            };
            let beta = toned(&shadow[c], ratio[c]);
            let v = f64::from(background.0.pixels()[k][c]) * beta * (1.0 - alpha) + own;
            assert!(v > 0.0031308 && v < 1.0, "nothing clips: {v}");
            shown[c] = 1.055 * v.powf(1.0 / 2.4) - 0.055;
        }
        shown
    };
    let shown: Vec<DVec3> = (0..PICTURE.0 * PICTURE.1).map(pixel).collect();
    let inside = |k: &usize| match view {
        Some(b) => {
            let (x, y) = (k % PICTURE.0, k / PICTURE.0);
            (b.x..b.x + b.width).contains(&x) && (b.y..b.y + b.height).contains(&y)
        }
        None => true,
    };
    let charbonnier = |v: f64| charbonnier(v - TARGET, PHOTOMETRIC_SCALE).0;
    let loss: f64 = (0..shown.len())
        .filter(inside)
        .map(|k| charbonnier(shown[k].x) + charbonnier(shown[k].y) + charbonnier(shown[k].z))
        .sum();

    let area = |k: usize| solid_angle(MAP.0, MAP.1, k / MAP.0);
    let total = |l: &[f64]| -> f64 { l.iter().enumerate().map(|(k, l)| l * area(k)).sum() };
    // The shadow's side of the consistency is detached: its value is that of the start.
    let detached: Vec<f64> = maps(&start())[1]
        .iter()
        .map(|t| luminance_f64(*t))
        .collect();
    let (ft, dt) = (total(&fl), total(&detached));
    let consistency: f64 = (0..fl.len())
        .map(|k| {
            let density = (1.0 - UNIFORM_SHARE) * fl[k] / ft + UNIFORM_SHARE / (4.0 * PI);
            -detached[k] / dt * density.ln() * area(k)
        })
        .sum();
    let cauchy: f64 = (0..h.len())
        .map(|k| {
            let terms = 1.0 + 2.0 * h[k] * h[k];
            area(k) * (terms.x.ln() + terms.y.ln() + terms.z.ln())
        })
        .sum();
    loss + WEIGHTS.consistency * consistency + WEIGHTS.regularizer * cauchy
}

/// Both maps of `p`, as they are rasterised.
fn maps(p: &Parameters) -> [Vec<DVec3>; 2] {
    [p.foreground_lobes(), p.shadow_lobes()].map(|lobes: Vec<SphericalGaussian>| {
        let map = rasterize(&lobes, MAP.0, MAP.1);
        map.texels().iter().map(|t| t.as_dvec3()).collect()
    })
}

/// Display value that the test's loss pulls towards.
const TARGET: f64 = 0.4;

/// Lobes of all widths, a bent tone, and an exposure of 0, where the detached side stands.
fn start() -> Parameters {
    let mut p = Parameters::neutral(5, 0.7);
    let sets = p.foreground.iter_mut().chain(&mut p.shadow);
    for (k, lobe) in sets.enumerate() {
        let wave = |phase: f64| (1.7 * k as f64 + phase).sin();
        lobe.log_radiance += DVec3::new(wave(0.0), wave(1.0), wave(2.0)) * 0.5;
        lobe.direction = (lobe.direction + DVec3::new(wave(3.0), wave(4.0), wave(5.0)) * 0.3) * 1.3;
        lobe.log_sigma += 0.2 * wave(6.0);
    }
    // One texel is clearly the brightest, as fusion divides by that and has a kink where it changes.
    p.foreground[3].log_radiance += 1.0;
    let mut tone = [0.0; TONE_PARAMETERS];
    for (k, t) in tone.iter_mut().enumerate() {
        *t = 0.1 * (2.3 * k as f64).sin();
    }
    p.tone = ToneParameters::from_array(&tone);
    p
}

/// The chain's loss and what its adjoint starts from.
fn judged(
    objective: &Objective,
    p: &Parameters,
    s: f32,
    crop: Option<PixelBox>,
) -> (f64, Forward, Raster<Vec3>) {
    let forward = objective.forward(p, s);
    let view = match crop {
        Some(b) => CropView::of(PICTURE, b, b.width),
        None => CropView::whole(),
    };
    let shown = view.apply(&forward.picture.0);
    let mut loss = forward.consistency + forward.regularizer;
    let gradient = shown.map(|v| {
        let channel = |c: usize| charbonnier(f64::from(v[c]) - TARGET, PHOTOMETRIC_SCALE);
        let (x, y, z) = (channel(0), channel(1), channel(2));
        loss += x.0 + y.0 + z.0;
        Vec3::new(x.1 as f32, y.1 as f32, z.1 as f32)
    });
    (loss, forward, view.apply_vjp(gradient))
}

/// How far fused, and which part is seen.
const CASES: [(f32, Option<PixelBox>); 4] = [
    (0.0, None),
    (0.6, None),
    (1.0, None),
    (
        0.6,
        Some(PixelBox {
            x: 3,
            y: 2,
            width: 8,
            height: 8,
        }),
    ),
];

/// Central differences of fourth order: `h^4 f^(5) / 30` from the derivative.
fn derivative(f: impl Fn(f64) -> f64, h: f64) -> f64 {
    (8.0 * (f(h) - f(-h)) - (f(2.0 * h) - f(-2.0 * h))) / (12.0 * h)
}

#[test]
fn the_gradients_of_both_maps_agree_with_differences_in_f64_texel_by_texel() {
    let scene = DenseTransport::ball(PICTURE, MAP);
    let objective = objective(scene.clone(), WEIGHTS);
    let p = start();
    for (s, crop) in CASES {
        let (loss, forward, gradient) = judged(&objective, &p, s, crop);
        let [f, h] = maps(&p);
        let exact = reference_loss(&scene, [&f, &h], &p.tone, s.into(), crop);
        // Thousands of f32 roundings, averaged.
        assert!(
            relative_error(loss, exact, 0.0) < 1e-6,
            "{s}: {loss} {exact}"
        );
        let (ours, _) = objective.maps_vjp(&forward, &gradient);
        for (set, ours) in [ours.foreground, ours.shadow].iter().enumerate() {
            let largest = ours.iter().fold(0f32, |m, g| m.max(g.abs().max_element()));
            for k in (set..ours.len()).step_by(5) {
                let c = k % 3;
                let moved = |step: f64| {
                    let mut both = [f.clone(), h.clone()];
                    both[set][k][c] += step;
                    reference_loss(&scene, [&both[0], &both[1]], &p.tone, s.into(), crop)
                };
                // Texels are around 1 and all is f64: 1e-16 / h, and nothing is near a kink.
                let numeric = derivative(moved, 1e-5);
                let error = relative_error(ours[k][c].into(), numeric, 1e-2 * f64::from(largest));
                // f32 sums over hundreds of pixels, of terms of both signs.
                assert!(
                    error < 2e-5,
                    "texel {k}, channel {c}, of map {set} at s = {s}, {crop:?}: ours {}, numeric \
                     {numeric}, error {error:e}",
                    ours[k][c]
                );
            }
        }
    }
}

#[test]
fn the_gradient_of_every_tensor_agrees_with_differences_of_the_chain_in_f64() {
    // Scene by scene and tensor by tensor.
    let ball = DenseTransport::ball(PICTURE, MAP);
    assert_gradients(
        "closed form",
        &objective(ball.clone(), WEIGHTS),
        &ball,
        &CASES,
    );
    for (name, roughness, metallic) in [
        ("matte", 1.0, 0.0),
        ("glossy", 0.3, 0.5),
        ("mirror", 0.0, 1.0),
    ] {
        let record = recorded(PICTURE, MAP, roughness, metallic);
        let scene = DenseTransport::of(&record);
        assert_gradients(name, &objective(record, WEIGHTS), &scene, &CASES[2..]);
    }
}

/// Compares the gradient of every tensor with differences in f64 of the chain through `scene`.
fn assert_gradients(
    name: &str,
    objective: &Objective,
    scene: &DenseTransport,
    cases: &[(f32, Option<PixelBox>)],
) {
    let p = start();
    for &(s, crop) in cases {
        let (_, forward, gradient) = judged(objective, &p, s, crop);
        let gradient = objective.vjp(&p, &forward, &gradient).to_tensors();
        let at = p.to_tensors();
        for (t, tensor) in at.0.iter().enumerate() {
            // Lobes and texels are rounded to f32. One entry alone would hardly show above that
            // (a lobe of sigma 10 does not care where it points), so differences are taken along
            // random directions in which all entries move at once: 6e-8 of a loss of 1e2 to 1e3
            // against 4e-2 of a gradient of 1e1 to 1e3, 6e-5 at worst; the fourth order leaves 1e-5.
            // The exposure moves every texel by its step: half of it, for a gradient above 1e3.
            // Tone parameters stay f64, but the second derivative of their curve jumps at knots,
            // where only the step's size helps.
            let h = match tensor.group {
                Group::Tone => 1e-4,
                Group::Exposure => 2e-2,
                _ => 4e-2,
            };
            let ours = &gradient.0[t].values;
            let norm = crate::tensors::norm(|| ours.iter());
            for draw in 0..4u64 {
                let direction = direction(ours.len(), draw);
                let moved = |step: f64| {
                    let mut q = at.clone();
                    let values = q.0[t].values.iter_mut().zip(&direction);
                    values.for_each(|(v, d)| *v += step * d);
                    let q = Parameters::from_tensors(&q);
                    let [f, h] = maps(&q);
                    reference_loss(scene, [&f, &h], &q.tone, s.into(), crop)
                };
                let numeric = derivative(moved, h);
                let along: f64 = ours.iter().zip(&direction).map(|(g, d)| g * d).sum();
                // A random direction sees 1 / sqrt(15) of the norm of 5 lobes' directions.
                let error = relative_error(along, numeric, 0.25 * norm);
                assert!(
                    error < 1e-4,
                    "{name}, {} along {draw} at s = {s}, {crop:?}: ours {along}, numeric {numeric}, \
                     error {error:e}",
                    tensor.name
                );
            }
        }
    }
}

/// A random unit vector.
fn direction(n: usize, draw: u64) -> Vec<f64> {
    let number = |k: usize| mix64(draw << 32 | k as u64) as f64 / u64::MAX as f64 - 0.5;
    let raw: Vec<f64> = (0..n).map(number).collect();
    let length = crate::tensors::norm(|| raw.iter());
    raw.iter().map(|v| v / length).collect()
}

#[test]
fn any_number_of_threads_gives_the_same_picture_and_gradient() {
    let scene = DenseTransport::ball(PICTURE, MAP);
    let objective = objective(scene, WEIGHTS);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| {
            let (loss, forward, gradient) = judged(&objective, &start(), 0.5, None);
            (loss, objective.vjp(&start(), &forward, &gradient))
        })
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn a_background_of_another_size_is_refused() {
    let scene = DenseTransport::ball((3, 2), (4, 2));
    let background = crate::testing::background((2, 3));
    let error = Objective::new(Box::new(scene), background, Transfer::Srgb, WEIGHTS)
        .err()
        .unwrap();
    assert_eq!(
        error.to_string(),
        "the background has 2 x 3 pixels; expected 3 x 2, the size of the recorded transport"
    );
}
