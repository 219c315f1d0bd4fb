//! Adjoints against the forward products and finite differences.
use super::*;

#[test]
fn the_transposed_product_is_the_transpose() {
    for transport in transports() {
        let light = random_vectors(512, 1);
        let y = random_vectors(144, 2);
        let image = transport.foreground(&light);
        let forward = dot(image.pixels(), &y) - dot(transport.base().pixels(), &y);
        let backward = dot(&light, &transport.foreground_vjp(&y));
        // All terms are positive: rows of up to 500 f32 sums keep more than 6 digits.
        assert!(
            (forward / backward - 1.0).abs() < 1e-6,
            "{forward} {backward}"
        );
        assert!(forward > 1.0);
    }
}

#[test]
fn gradients_of_the_shadow_ratio_equal_central_differences() {
    let mut compared = 0;
    for transport in transports() {
        let light = random_vectors(512, 3);
        let y = random_vectors(144, 4);
        let ratio = transport.shadow(&light);
        let gradient = transport.shadow_vjp(&light, &ratio, &y);
        for seed in 5..9 {
            // Along a random direction; the loss is smooth as no ratio is clamped.
            let direction: Vec<Vec3> = random_vectors(512, seed).iter().map(|v| *v - 0.5).collect();
            let loss = |h: f64| {
                let moved = reference_shadow(&transport, &light, &direction, h);
                moved
                    .iter()
                    .zip(&y)
                    .map(|(r, y)| r.dot(y.as_dvec3()))
                    .sum::<f64>()
            };
            // f64 and a step of 1e-4 of the light: truncation and rounding are both below 1e-7.
            let expected = (loss(1e-4) - loss(-1e-4)) / 2e-4;
            let found = dot(&gradient, &direction);
            if transport.header().shadow == ShadowKind::None {
                assert_eq!(found, 0.0);
                continue;
            }
            let scale: f64 = gradient
                .iter()
                .map(|g| g.as_dvec3().length_squared())
                .sum::<f64>()
                .sqrt();
            assert!(
                (found - expected).abs() < 1e-4 * expected.abs() + 1e-6 * scale,
                "{found} instead of {expected}, {:?}",
                transport.header()
            );
            compared += 1;
        }
    }
    assert_eq!(compared, 32);
}

/// The ratios under `light + h direction`, in f64 from the stored weights.
fn reference_shadow(
    transport: &Transport,
    light: &[Vec3],
    direction: &[Vec3],
    h: f64,
) -> Vec<DVec3> {
    let light: Vec<DVec3> = light
        .iter()
        .zip(direction)
        .map(|(l, d)| l.as_dvec3() + d.as_dvec3() * h)
        .collect();
    fn product<E: Entry>(rows: &Rows<E>, light: &[DVec3]) -> Vec<DVec3> {
        let mut sums = vec![DVec3::ZERO; rows.pixels()];
        for row in 0..rows.pixels() {
            let entries = rows.offsets[row] as usize..rows.offsets[row + 1] as usize;
            let scale = 2f64.powi(-i32::from(rows.exponents[row]));
            let terms = rows.entries[entries].iter();
            sums[rows.pixel(row)] = terms
                .map(|e| e.weight().truncate().as_dvec3() * light[e.texel()] * scale)
                .sum();
        }
        sums
    }
    let ratio = |b: DVec3, a: DVec3, s: f32| {
        let ratio = DVec3::ONE - f64::from(s) * b / a;
        DVec3::select(a.cmpgt(DVec3::ZERO), ratio, DVec3::ONE).max(DVec3::ZERO)
    };
    with_rows!(&transport.weights, set => {
        let sent = match &set.sent {
            Some(sent) => {
                let base = sent.base.iter().map(|b| b.as_dvec3());
                base.zip(product(&sent.rows, &light)).map(|(b, s)| b + s).collect()
            }
            None => vec![DVec3::ZERO; set.object.pixels()],
        };
        let missing = |blocked| product(blocked, &light).into_iter().zip(sent).map(|(b, s)| b - s);
        match &set.shadow {
            Shadow::None => vec![DVec3::ONE; set.object.pixels()],
            Shadow::Plane { blocked, cosine } => {
                let e: DVec3 = cosine.iter().zip(&light).map(|(&e, l)| *l * f64::from(e)).sum();
                missing(blocked).map(|b| ratio(b, e, 1.0)).collect()
            }
            Shadow::Mesh { blocked, arriving, share } => missing(blocked)
                .zip(product(arriving, &light))
                .zip(share)
                .map(|((b, a), &s)| ratio(b, a, s))
                .collect(),
        }
    })
}

#[test]
fn a_clamped_ratio_has_no_gradient() {
    // Clamped, dark, and in between; the fourth is none.
    let missing = Vec4::new(2.0, 0.0, 1.0, 0.0);
    let arriving = Vec4::new(1.0, 0.0, 4.0, 0.0);
    let found = ratio(missing, arriving, 2.0);
    assert_eq!(found.truncate(), Vec3::new(0.0, 1.0, 0.5));
    let (on_missing, on_arriving) = ratio_vjp(found, arriving, 2.0, Vec4::splat(8.0));
    assert_eq!(on_missing.truncate(), Vec3::new(0.0, 0.0, -4.0));
    assert_eq!(on_arriving.truncate(), Vec3::new(0.0, 0.0, 1.0));
}
