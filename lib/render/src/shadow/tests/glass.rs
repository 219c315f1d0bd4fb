//! What light does that passes the object.
use super::*;

/// A horizontal sheet of glass that hides the sky from the ground that is looked at.
fn under_glass(roughness: f32, color: Vec3) -> dipir_scene::scene::Scene {
    let material = dipir_scene::material::Material {
        transmission: Some(dipir_scene::material::Transmission {
            factor: 1.0,
            texture: None,
        }),
        roughness,
        ..matte(color)
    };
    let sheet = quad(
        Vec3::new(-400.0, 2.0, 400.0),
        Vec3::X * 800.0,
        Vec3::NEG_Z * 800.0,
    );
    let view = camera(Vec3::new(0.0, 1.0, 2.0), Vec3::ZERO, 20.0, 4);
    scene(sheet, material, view, ground())
}

fn through_glass(roughness: f32, color: Vec3, light: &EnvironmentSampler, sent: bool) -> Rendered {
    let simulation = Simulation {
        light_on_proxy: sent.then_some(LightOnProxy {
            bounce: true,
            emission: false,
        }),
        ..everything(4)
    };
    let s = under_glass(roughness, color);
    render(&s, light, &simulation, &settings(256, 5))
}

fn mean_shadow(r: &Rendered) -> Vec3 {
    let pixels = r.film.shadow.pixels();
    pixels.iter().sum::<Vec3>() / pixels.len() as f32
}

#[test]
fn the_sun_passes_a_sheet_of_glass_straight_and_takes_its_colour() {
    // 25 degrees from the zenith: Schlick's reflectance there is .04 to six digits.
    let towards = Vec3::new(0.0, 0.906, 0.423).normalize();
    let light = EnvironmentSampler::new(sun(towards, 1e4, 0.0, 128));
    for roughness in [0.0, 0.1, 0.3] {
        for color in [Vec3::ONE, Vec3::new(0.9, 0.5, 0.2)] {
            let found = mean_shadow(&through_glass(roughness, color, &light, true));
            // What masking takes at a roughness of .3 comes back as a wide lobe, of .2%.
            let off = (found - 0.96 * color).abs().max_element();
            assert!(off < 4e-3, "{roughness}: {found} of {color}");
        }
    }
}

#[test]
fn of_an_even_sky_glass_takes_what_it_reflects() {
    // Schlick's reflectance, averaged over the cosine: f0 + (1 - f0) / 21.
    let passing = 1.0 - (0.04 + 0.96 / 21.0);
    for (roughness, sent, [least, most]) in [
        (0.0, false, [passing, passing]),
        (0.5, false, [0.0, 0.0]),
        // It reflects the equally bright light below, blurred, by which less of it is seen at grazing angles.
        (0.0, true, [0.95, 1.0]),
        (0.2, true, [0.95, 1.0]),
        // What scatters widely sends as much as it takes.
        (0.5, true, [1.0, 1.0]),
    ] {
        let r = through_glass(roughness, Vec3::ONE, &sky(1.0), sent);
        let found = mean_shadow(&r).x;
        let pixels = (0..16).map(|k| r.film.shadow_variance(k % 4, k / 4).x);
        let noise = pixels.sum::<f32>().sqrt() / 16.0;
        // The sheet ends 89.7 degrees from the zenith.
        let slack = 4.0 * noise + 2e-3;
        assert!(
            found > least - slack && found < most + slack,
            "{roughness}: {found} {noise}"
        );
    }
}
