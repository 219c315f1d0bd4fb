//! What light does that passes the object.
use super::*;
use crate::bsdf::Bsdf;
use crate::bsdf::features::{SPECULAR, TRANSMISSION};
use crate::surface::SurfacePoint;

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

/// What a white sheet lets pass of light at an angle with this cosine to its normal.
fn passing_at(roughness: f32, cosine: f32) -> f32 {
    let surface = SurfacePoint {
        roughness,
        metallic: 0.0,
        transmission: 1.0,
        ..SurfacePoint::facing(Vec3::Y)
    };
    let towards = Vec3::new((1.0 - cosine * cosine).sqrt(), cosine, 0.0);
    Bsdf::<{ SPECULAR | TRANSMISSION }>::new(&surface, towards)
        .passing()
        .x
}

/// And of an even sky.
fn passing(roughness: f32) -> f32 {
    let cosines = (0..256).map(|k| (k as f32 + 0.5) / 256.0);
    cosines
        .map(|c| 2.0 * c * passing_at(roughness, c) / 256.0)
        .sum()
}

#[test]
fn the_sun_passes_a_sheet_of_glass_straight_and_takes_its_colour() {
    let towards = Vec3::new(0.0, 0.906, 0.423).normalize();
    // 25 degrees from the zenith Schlick's reflectance is .04 to four digits.
    assert!((passing_at(0.0, towards.y) - 0.96).abs() < 1e-4);
    let light = EnvironmentSampler::new(sun(towards, 1e4, 0.0, 128));
    for roughness in [0.0, 0.1, 0.3] {
        let passing = passing_at(roughness, towards.y);
        for color in [Vec3::ONE, Vec3::new(0.9, 0.5, 0.2)] {
            let found = mean_shadow(&through_glass(roughness, color, &light, true));
            // No noise: all rays pass alike, up to the sun's width of 1.4 degrees.
            let off = (found - passing * color).abs().max_element();
            assert!(off < 1e-3, "{roughness}: {found} of {color}");
        }
    }
}

#[test]
fn of_an_even_sky_glass_takes_what_it_reflects() {
    // Schlick's reflectance, averaged over the cosine: f0 + (1 - f0) / 21.
    let closed = 1.0 - (0.04 + 0.96 / 21.0);
    assert!((passing(0.0) - closed).abs() < 1e-3, "{}", passing(0.0));
    // It reflects the equally bright light below, blurred.
    let reflected = 1.0 - passing(MIN_CAUSTIC_ROUGHNESS);
    for (roughness, sent, wanted) in [
        (0.0, false, closed),
        (0.5, false, 0.0),
        (0.0, true, closed + reflected),
        (0.2, true, passing(0.2) + reflected),
        // What scatters widely sends as much as it takes.
        (0.5, true, 1.0),
    ] {
        let r = through_glass(roughness, Vec3::ONE, &sky(1.0), sent);
        let found = mean_shadow(&r).x;
        let pixels = (0..16).map(|k| r.film.shadow_variance(k % 4, k / 4).x);
        let noise = pixels.sum::<f32>().sqrt() / 16.0;
        // The sheet ends 89.7 degrees from the zenith; four standard errors.
        let off = (found - wanted).abs();
        assert!(
            off < 4.0 * noise + 2e-3,
            "{roughness}: {found}, not {wanted}, {noise}"
        );
    }
}

#[test]
fn the_sun_is_attenuated_over_the_thickness_of_a_sheet_without_an_inner_side() {
    let towards = Vec3::new(0.0, 0.906, 0.423).normalize();
    let light = EnvironmentSampler::new(sun(towards, 1e4, 0.0, 128));
    let mut s = under_glass(0.0, Vec3::ONE);
    let glass = &mut s.materials[0];
    // Schlick's factor of an index of 1 is below 1e-5 at 25 degrees.
    glass.ior = 1.0;
    let color = Vec3::new(0.25, 0.5, 0.9);
    glass.extensions.volume = Some(dipir_scene::material::Volume {
        thickness: 3.0,
        thickness_texture: None,
        attenuation_color: color,
        attenuation_distance: 2.0,
    });
    let exact = color.powf(1.5);
    // Its front faces the sky, then the ground; then a second sheet lies 2 m above it.
    for turn in 0..3 {
        if turn < 2 {
            s.mesh.indices.iter_mut().for_each(|t| t.swap(1, 2));
        } else {
            let mut second = s.mesh.clone();
            second.positions.iter_mut().for_each(|p| p.y += 2.0);
            crate::shapes::append(&mut s.mesh, second, 0);
        }
        let exact = if turn < 2 { exact } else { exact * exact };
        let found = mean_shadow(&render(&s, &light, &everything(4), &settings(64, 5)));
        // No noise: all rays pass alike.
        assert!(found.abs_diff_eq(exact, 1e-3), "{turn}: {found} {exact}");
    }
}
