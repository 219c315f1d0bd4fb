use super::*;
use dipir_numerics::gradcheck::{central_difference, relative_error};

fn bent() -> ToneParameters {
    let mut all = [0.0; TONE_PARAMETERS];
    for (i, p) in all.iter_mut().enumerate() {
        *p = (i as f64 * 2.3).sin();
    }
    ToneParameters::from_array(&all)
}

/// A small picture of the object with dark, bright, half-covered and empty pixels.
fn picture() -> (LinearImage, Raster<f32>, Raster<Vec3>) {
    let alpha = Raster::from_pixels(3, 2, vec![1.0, 0.5, 0.0, 1e-3, 1.0, 0.9]);
    let colours = vec![
        Vec3::new(0.0, 0.2, 0.7),
        Vec3::new(0.1, 3.0, 0.02),
        Vec3::ZERO,
        Vec3::new(1e-4, 1e-3, 2e-3),
        Vec3::new(1e4, 50.0, 0.9),
        Vec3::new(0.3, 0.4, 0.5),
    ];
    let gradient = (0..6).map(|i| Vec3::new(1.0, -0.5, 0.25) * (1.0 + i as f32));
    (
        LinearImage(Raster::from_pixels(3, 2, colours)),
        alpha,
        Raster::from_pixels(3, 2, gradient.collect()),
    )
}

#[test]
fn reinhards_gradient_follows_central_differences() {
    for x in [0.0, 1e-6, 0.1, 1.0, 30.0, 1e4, -0.5] {
        // Error: h^2 f'''/6 = 1e-10 of the slope, and eps / (h slope), the slope being 1/x^2.
        let h = 1e-5 * (1.0 + f64::abs(x));
        let want = central_difference(reinhard, x, h);
        assert!(
            relative_error(reinhard_vjp(x, 1.0), want, 1e-9) < 1e-5,
            "{x}"
        );
    }
    assert_eq!(reinhard(1e6), 1e6 / (1e6 + 1.0));
}

#[test]
fn at_start_the_object_sees_reinhard_alone_and_the_shadow_nothing() {
    let curves = ToneCurves::identity();
    let (object, alpha, _) = picture();
    let toned = curves.apply_object(&object, &alpha);
    for ((got, &rgb), &a) in toned
        .0
        .pixels()
        .iter()
        .zip(object.0.pixels())
        .zip(alpha.pixels())
    {
        let want = if a > 0.0 {
            rgb / (Vec3::ONE + rgb / a)
        } else {
            Vec3::ZERO
        };
        // The reference rounds four times in f32, the result is below 1.
        assert!(got.abs_diff_eq(want, 4.0 * f32::EPSILON), "{got} {want}");
    }
    let shadow = LinearImage(object.0.map(|&c| c.min(Vec3::ONE)));
    let toned = curves.apply_shadow(&shadow);
    for (got, want) in toned.0.pixels().iter().zip(shadow.0.pixels()) {
        assert!(got.abs_diff_eq(*want, f32::EPSILON), "{got} {want}");
    }
}

#[test]
fn an_unshadowed_pixel_stays_unshadowed_under_every_curve() {
    assert_eq!(bent().curves().mapper().shadow_pixel(Vec3::ONE), Vec3::ONE);
    assert_eq!(
        bent().curves().mapper().shadow_pixel(Vec3::ZERO),
        Vec3::ZERO
    );
}

#[test]
fn the_curve_acts_on_the_covered_part_whatever_the_coverage() {
    let curves = bent().curves().mapper();
    let colour = Vec3::new(0.2, 1.0, 4.0);
    let full = curves.object_pixel(colour, 1.0);
    for alpha in [1e-6, 0.1, 0.75] {
        let part = curves.object_pixel(colour * alpha, alpha) / alpha;
        // The product and the quotient round in f32, and the curve's slope is under 4.
        assert!(part.abs_diff_eq(full, 8.0 * f32::EPSILON), "{alpha}");
    }
    assert_eq!(curves.object_pixel(Vec3::ZERO, 0.0), Vec3::ZERO);
}

#[test]
fn the_object_gradients_follow_central_differences() {
    let parameters = bent();
    let (object, alpha, weights) = picture();
    // The same function in f64 throughout.
    let loss = |parameters: &ToneParameters, colours: &[[f64; 3]]| {
        let knots = parameters.foreground.knots();
        let mut sum = 0.0;
        for (i, colour) in colours.iter().enumerate() {
            let a = f64::from(alpha.pixels()[i]);
            for c in 0..3 {
                if a > 0.0 {
                    let toned = a * knots.eval(reinhard(colour[c] / a));
                    sum += toned * f64::from(weights.pixels()[i][c]);
                }
            }
        }
        sum
    };
    let colours: Vec<[f64; 3]> = object
        .0
        .pixels()
        .iter()
        .map(|c| c.as_dvec3().to_array())
        .collect();
    let curves = parameters.curves();
    let (to_pixels, to_knots) = curves.apply_object_vjp(&object, &alpha, &weights);
    for i in 0..colours.len() {
        for c in 0..3 {
            let of = |v: f64| {
                let mut colours = colours.clone();
                colours[i][c] = v;
                loss(&parameters, &colours)
            };
            // Relative to the covered colour's scale; f32 results hold 1e-6, a sum of about 10
            // in f64 loses 1e-15 / h.
            let h = 1e-5 * f64::from(alpha.pixels()[i]).max(1e-9) * (1.0 + colours[i][c].abs());
            let want = central_difference(of, colours[i][c], h);
            let got = f64::from(to_pixels.pixels()[i][c]);
            let error = relative_error(got, want, 1e-3);
            assert!(
                error < 1e-4,
                "pixel {i}, channel {c}: {got}, numerically {want}"
            );
        }
    }
    let gradient = ToneGradient {
        foreground: to_knots,
        ..ToneGradient::default()
    };
    let got = parameters.curves_vjp(&gradient).to_array();
    for i in 0..TONE_PARAMETERS {
        let of = |v: f64| {
            let mut all = parameters.to_array();
            all[i] = v;
            loss(&ToneParameters::from_array(&all), &colours)
        };
        let want = central_difference(of, parameters.to_array()[i], 1e-6);
        let error = relative_error(got[i], want, 1e-2);
        assert!(
            error < 1e-5,
            "parameter {i}: {}, numerically {want}",
            got[i]
        );
    }
}

#[test]
fn the_shadow_gradients_follow_central_differences() {
    let parameters = bent();
    let ratios = [0.0, 0.03, 0.4, 0.77, 0.999, 1.0];
    let shadow = Raster::from_pixels(6, 1, ratios.map(Vec3::splat).to_vec());
    let weights = Raster::from_pixels(6, 1, ratios.map(|r| Vec3::new(1.0, -2.0, r)).to_vec());
    let curves = parameters.curves();
    let (to_pixels, to_knots) = curves.apply_shadow_vjp(&LinearImage(shadow), &weights);
    let gradient = ToneGradient {
        shadow: to_knots,
        ..ToneGradient::default()
    };
    let got = parameters.curves_vjp(&gradient).to_array();
    let loss = |parameters: &ToneParameters| {
        let mut sum = 0.0;
        for (&ratio, weight) in ratios.iter().zip(weights.pixels()) {
            for c in 0..3 {
                sum += parameters.shadow[c].knots().eval(f64::from(ratio)) * f64::from(weight[c]);
            }
        }
        sum
    };
    for i in 0..TONE_PARAMETERS {
        let of = |v: f64| {
            let mut all = parameters.to_array();
            all[i] = v;
            loss(&ToneParameters::from_array(&all))
        };
        let want = central_difference(of, parameters.to_array()[i], 1e-6);
        let error = relative_error(got[i], want, 1e-2);
        assert!(
            error < 1e-5,
            "parameter {i}: {}, numerically {want}",
            got[i]
        );
    }
    for (i, &ratio) in ratios.iter().enumerate() {
        for c in 0..3 {
            let knots = curves.shadow[c];
            // Once differentiable at both ends, so one-sided errors are h f'' / 2.
            let slope = central_difference(|x| knots.eval(x), f64::from(ratio), 1e-7);
            let want = slope * f64::from(weights.pixels()[i][c]);
            let got = f64::from(to_pixels.pixels()[i][c]);
            assert!(
                relative_error(got, want, 1e-3) < 1e-5,
                "{ratio}: {got}, numerically {want}"
            );
        }
    }
}

#[test]
fn gradients_are_the_same_bytes_for_any_number_of_threads() {
    let n = 3 * CHUNK + 17;
    let pixel = |i: usize| Vec3::new(i as f32 * 1e-3, (i as f32).sin().abs(), 0.5);
    let object = LinearImage(Raster::from_pixels(n, 1, (0..n).map(pixel).collect()));
    let alpha = Raster::filled(n, 1, 0.8);
    let curves = bent().curves();
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap()
            .install(|| curves.apply_object_vjp(&object, &alpha, &object.0))
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn tone_json_keeps_every_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tone.json");
    let curves = bent().curves();
    curves.write_json(&path).unwrap();
    assert_eq!(ToneCurves::read_json(&path).unwrap(), curves);
}

#[test]
fn tone_json_with_a_falling_curve_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tone.json");
    let mut curves = ToneCurves::identity();
    curves.shadow[1].y[2] = 0.1;
    curves.write_json(&path).unwrap();
    let error = ToneCurves::read_json(&path).unwrap_err();
    let want = format!(
        "`{}` is not a tone file: in `shadow[1]`, `y` does not rise after knot 1; expected \
         `foreground` and three `shadow` curves of 6 knots each, rising from 0 to 1: write it \
         again with the optimisation",
        path.display()
    );
    assert_eq!(error.to_string(), want);
}
