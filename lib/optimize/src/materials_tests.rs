use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_render::features::ALL;
use dipir_render::shapes::icosphere;
use dipir_scene::camera::Camera;
use dipir_scene::proxy::Proxy;
use glam::{Mat3, Vec2};

use super::*;

const SIDE: usize = 14;

/// A ball in front of the camera, of `material`.
fn ball(material: Material) -> Scene {
    Scene {
        mesh: icosphere(Vec3::ZERO, 1.0, 2),
        materials: vec![material],
        textures: Vec::new(),
        camera: Camera {
            position: Vec3::Z * 4.0,
            rotation: Mat3::IDENTITY,
            focal_px: Vec2::splat(1.7 * SIDE as f32),
            principal_px: Vec2::splat(0.5 * SIDE as f32),
            resolution: [SIDE as u32; 2],
        },
        proxy: Proxy::None,
    }
}

/// A sky with a wide window and a small lamp: highlights of two widths.
fn light() -> EnvironmentSampler {
    let (width, height) = (32, 16);
    let texels = (0..width * height).map(|k| {
        let (row, column) = (k / width, k % width);
        match (row, column) {
            (3..=6, 10..=14) => Vec3::new(3.0, 2.8, 2.5),
            (5, 19) => Vec3::splat(25.0),
            (0..=7, _) => Vec3::new(0.3, 0.35, 0.45),
            _ => Vec3::splat(0.15),
        }
    });
    EnvironmentSampler::new(EnvironmentMap::new(width, height, texels.collect()).unwrap())
}

fn simulation() -> Simulation {
    Simulation {
        features: ALL,
        max_depth: 2,
        shadow: false,
        proxy_occlusion: false,
        light_on_proxy: None,
    }
}

fn material(color: [f32; 3], metallic: f32, roughness: f32) -> Material {
    Material {
        name: "paint".into(),
        base_color: Vec3::from(color).extend(1.0),
        metallic,
        roughness,
        ..Material::default()
    }
}

/// What a material is recovered from: the ball in a half-metallic grey, and a picture of it in
/// `truth`, traced with another seed.
struct Case {
    start: Scene,
    background: LinearImage,
    reference: DisplayImage,
    light: EnvironmentSampler,
}

impl Case {
    fn new(truth: &Material) -> Self {
        let (light, background) = (light(), Raster::filled(SIDE, SIDE, Vec3::splat(0.2)));
        let background = LinearImage(background);
        let rendering = Settings {
            seed: 77,
            stop: Stop::Samples(1024),
            background: Some(&background),
            ..Settings::default()
        };
        let film = Renderer::new(&ball(truth.clone()))
            .render(&light, &simulation(), &rendering, &mut |_| {
                ControlFlow::Continue(())
            })
            .unwrap()
            .film;
        let toned = ToneCurves::identity().apply_object(&LinearImage(film.object), &film.alpha);
        let pixels = (0..SIDE * SIDE).map(|p| {
            let (behind, front) = (background.0.pixels()[p], toned.0.pixels()[p]);
            composite_pixel(behind, front, film.alpha.pixels()[p], Vec3::ONE)
        });
        let linear = LinearImage(Raster::from_pixels(SIDE, SIDE, pixels.collect()));
        Self {
            start: ball(Material {
                base_color: Vec3::splat(0.5).extend(1.0),
                metallic: 0.5,
                roughness: 0.5,
                ..truth.clone()
            }),
            background,
            reference: Transfer::Srgb.encode(&linear),
            light,
        }
    }

    fn run(
        &self,
        settings: MaterialSettings,
        checkpoint: Option<&Path>,
        progress: &mut dyn FnMut(f64) -> ControlFlow<()>,
    ) -> Result<MaterialOutcome, OptimizeError> {
        self.optimization(&Renderer::new(&self.start), settings, checkpoint)
            .run(progress)
    }

    fn optimization<'a>(
        &'a self,
        renderer: &'a Renderer<'a>,
        settings: MaterialSettings,
        checkpoint: Option<&'a Path>,
    ) -> MaterialOptimization<'a, EnvironmentSampler> {
        MaterialOptimization {
            renderer,
            light: &self.light,
            simulation: simulation(),
            tone: Some(ToneCurves::identity()),
            background: &self.background,
            transfer: Transfer::Srgb,
            reference: &self.reference,
            materials: vec![0],
            settings,
            checkpoint,
        }
    }
}

const SETTINGS: MaterialSettings = MaterialSettings {
    iterations: 400,
    picture_samples: 64,
    gradient_samples: 16,
    rate: 0.04,
    checkpoint_every: 0,
    seed: 5,
};

fn recover(truth: &Material) -> MaterialOutcome {
    let go_on = &mut |_| ControlFlow::Continue(());
    Case::new(truth).run(SETTINGS, None, go_on).unwrap()
}

fn assert_recovered(truth: &Material) {
    let outcome = recover(truth);
    let found = &outcome.materials[0];
    let apart = (Vec3::from(found.base_color) - truth.base_color.truncate()).abs();
    let (metallic, roughness) = (
        (found.metallic - truth.metallic).abs(),
        (found.roughness - truth.roughness).abs(),
    );
    // What is asked for; the picture's noise of a few hundredths a pixel, averaged over 100 pixels
    // and 100 steps, leaves less than a thousandth.
    assert!(
        apart.max_element() < 0.02 && metallic < 0.02 && roughness < 0.02,
        "{found:?} for {:?}, metallic {}, roughness {}",
        truth.base_color,
        truth.metallic,
        truth.roughness
    );
    assert!(outcome.losses[399] < outcome.losses[0]);
}

#[test]
fn a_matte_balls_material_is_recovered_from_its_picture() {
    assert_recovered(&material([0.7, 0.4, 0.2], 0.0, 0.8));
}

#[test]
fn a_glossy_balls_material_is_recovered_from_its_picture() {
    assert_recovered(&material([0.2, 0.5, 0.7], 0.0, 0.3));
}

#[test]
fn a_metal_balls_material_is_recovered_from_its_picture() {
    assert_recovered(&material([0.9, 0.7, 0.4], 1.0, 0.35));
}

#[test]
fn the_strength_of_emission_alone_is_recovered() {
    let mut truth = material([0.5, 0.5, 0.5], 0.5, 0.5);
    truth.emissive = Vec3::new(0.4, 0.3, 0.2);
    let mut case = Case::new(&truth);
    case.start.materials[0].emissive *= 0.5;
    let settings = MaterialSettings {
        iterations: 120,
        ..SETTINGS
    };
    let go_on = &mut |_| ControlFlow::Continue(());
    let outcome = case.run(settings, None, go_on).unwrap();
    let strength = outcome.materials[0].emissive_strength;
    assert!((strength - 2.0).abs() < 0.1, "{strength}");
}

#[test]
fn without_a_step_the_material_is_that_of_the_start() {
    let case = Case::new(&material([0.9, 0.7, 0.4], 1.0, 0.35));
    let settings = MaterialSettings {
        iterations: 0,
        ..SETTINGS
    };
    let go_on = &mut |_| ControlFlow::Continue(());
    let outcome = case.run(settings, None, go_on).unwrap();
    let (found, start) = (&outcome.materials[0], &case.start.materials[0]);
    assert_eq!(Vec3::from(found.base_color), start.base_color.truncate());
    assert_eq!(
        (found.metallic, found.roughness),
        (start.metallic, start.roughness)
    );
    assert_eq!(found.emissive_strength, 1.0);
}

#[test]
fn a_few_steps_that_are_not_finite_change_no_material_and_five_in_a_row_end_the_run() {
    let case = Case::new(&material([0.9, 0.7, 0.4], 1.0, 0.35));
    let renderer = Renderer::new(&case.start);
    let run = case.optimization(&renderer, SETTINGS, None);
    let start = run.parameters(&case.start);
    let mut bad = start.zeros_like();
    bad.0[1].values[0] = f64::NAN;
    let mut state = MaterialState::new(start.clone());
    for _ in 0..4 {
        run.take(&mut state, 0.5, &bad).unwrap();
    }
    assert_eq!((&state.parameters, state.adam.steps), (&start, 0));
    assert_eq!((state.iteration, state.losses.len()), (4, 4));
    // The next one counts again, and so do later ones from there.
    let good = Tensors(
        start
            .0
            .iter()
            .map(|t| Tensor {
                values: vec![1.0; t.values.len()],
                ..*t
            })
            .collect(),
    );
    run.take(&mut state, 0.5, &good).unwrap();
    assert_ne!(state.parameters, start);
    let moved = state.clone();
    for _ in 0..4 {
        run.take(&mut state, f64::INFINITY, &good).unwrap();
    }
    assert_eq!(state.parameters, moved.parameters);
    assert_eq!(state.losses, moved.losses);
    let error = run.take(&mut state, 0.5, &bad).unwrap_err().to_string();
    assert!(
        error
            .starts_with("`materials.metallic` is not finite in iteration 9, and 5 steps in a row"),
        "{error}"
    );
}

#[test]
fn killed_at_any_step_and_started_again_the_material_is_the_same_bytes() {
    let case = Case::new(&material([0.9, 0.7, 0.4], 1.0, 0.35));
    let settings = MaterialSettings {
        iterations: 20,
        picture_samples: 8,
        gradient_samples: 4,
        checkpoint_every: 6,
        ..SETTINGS
    };
    let go_on = &mut |_: f64| ControlFlow::Continue(());
    let whole = case.run(settings, None, go_on).unwrap();
    // Before the mean begins at step 15, and after.
    for at in [1, 7, 13, 17] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        let mut until = |share: f64| match share * 20.0 > f64::from(at) - 0.5 {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        };
        // Interrupted: nothing is lost.
        let stopped = case.run(settings, Some(&path), &mut until);
        assert!(matches!(stopped, Err(OptimizeError::Interrupted)));
        let resumed = case.run(settings, Some(&path), go_on).unwrap();
        assert_eq!(resumed, whole, "interrupted at {at}");
        // Killed: the file is that of the last regular checkpoint.
        std::fs::remove_file(&path).unwrap();
        let regular = at / 6 * 6;
        if regular > 0 {
            let mut until = |share: f64| match share * 20.0 > f64::from(regular) - 0.5 {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            };
            assert!(case.run(settings, Some(&path), &mut until).is_err());
        }
        let resumed = case.run(settings, Some(&path), go_on).unwrap();
        assert_eq!(resumed, whole, "killed at {at}");
        // Another run's file is refused.
        let other = MaterialSettings {
            seed: 6,
            ..settings
        };
        let refused = case.run(other, Some(&path), go_on).unwrap_err().to_string();
        assert!(
            refused.ends_with(
                "belongs to a run with other settings; delete it to start from the beginning"
            ),
            "{refused}"
        );
    }
}
