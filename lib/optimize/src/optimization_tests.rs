use super::*;
use crate::guidance::{Reference, rmse, touched};
use crate::settings::LightTable;
use crate::testing::{DenseTransport, PRESET, WEIGHTS, objective};
use crate::transport::LinearTransport;
use dipir_imaging::raster::Raster;
use dipir_light::gaussian::SphericalGaussian;
use dipir_numerics::hashing::mix64;
use glam::Vec3;
use std::sync::atomic::{AtomicUsize, Ordering};

const PICTURE: (usize, usize) = (20, 16);
const MAP: (usize, usize) = (24, 12);

fn settings(iterations: usize) -> Settings {
    let table = LightTable {
        iterations: Some(iterations),
        lobes: Some(14),
        environment: Some([MAP.0, MAP.1]),
        preview_every: Some(0),
        checkpoint_every: Some(0),
        ..Default::default()
    };
    table.settings(&PRESET, 5).unwrap()
}

fn lobe(direction: Vec3, radiance: Vec3, sigma: f32) -> SphericalGaussian {
    SphericalGaussian {
        direction: direction.normalize(),
        radiance,
        sigma,
    }
}

/// A warm sun at 40 degrees and a blue sky over dark ground.
fn sun_and_sky(sun: Vec3) -> Parameters {
    let lobes = [
        lobe(sun, Vec3::new(9.0, 8.0, 6.0), 0.25),
        lobe(Vec3::Y, Vec3::new(0.35, 0.45, 0.65), 0.8),
        lobe(Vec3::Y, Vec3::splat(0.12), 5.0),
    ];
    let set: Vec<_> = lobes.iter().map(LobeParameters::of).collect();
    Parameters {
        foreground: set.clone(),
        shadow: set,
        ..Parameters::neutral(1, 1.0)
    }
}

const SUN: Vec3 = Vec3::new(0.55, 0.64, 0.5);

/// An optimisation of the ball towards its picture under [`sun_and_sky`].
struct Case {
    settings: Settings,
    scene: DenseTransport,
    framing: Framing,
}

impl Case {
    fn new(iterations: usize) -> Self {
        Self {
            settings: settings(iterations),
            scene: DenseTransport::ball(PICTURE, MAP),
            framing: Framing::Whole,
        }
    }

    fn truth(&self) -> DisplayImage {
        objective(self.scene.clone(), WEIGHTS)
            .forward(&sun_and_sky(SUN), 1.0)
            .picture
    }

    fn reference(&self) -> Reference {
        let objective = objective(self.scene.clone(), WEIGHTS);
        Reference::new(self.truth(), &objective, self.framing).unwrap()
    }

    fn run(&self) -> Result<Outcome, OptimizeError> {
        self.run_with(&mut self.reference(), None, None, &mut |_| {
            ControlFlow::Continue(())
        })
    }

    fn run_with<'a>(
        &self,
        guidance: &'a mut dyn Guidance,
        recorder: Option<&'a mut (dyn Recorder + 'a)>,
        checkpoint: Option<&'a Path>,
        watch: &mut dyn FnMut(Event) -> ControlFlow<()>,
    ) -> Result<Outcome, OptimizeError> {
        let optimization = Optimization {
            objective: objective(self.scene.clone(), self.settings.weights()),
            guidance,
            recorder,
            settings: self.settings.clone(),
            start: Parameters::neutral(self.settings.lobes, 0.5),
            checkpoint,
        };
        optimization.run(watch)
    }
}

fn degrees_between(a: Vec3, b: Vec3) -> f32 {
    (2.0 * (0.5 * (a.normalize() - b.normalize()).length()).asin()).to_degrees()
}

#[test]
fn a_sun_and_a_sky_are_recovered_from_a_picture_and_a_neutral_start() {
    let case = Case::new(300);
    let outcome = case.run().unwrap();
    let peak = outcome.lighting.peak_direction().unwrap();
    let mask = touched(&objective(case.scene.clone(), WEIGHTS));
    let error = rmse(&outcome.picture, &case.truth(), &mask);
    let angle = degrees_between(peak, SUN);
    println!(
        "peak {angle:.2} degrees, rmse {error:.4}, residual {:.4}",
        outcome.lighting.fusion_residual
    );
    assert!(angle < 3.0, "{angle} degrees off");
    assert!(error < 0.01, "rmse {error}");
    assert_eq!(outcome.skipped(), 0);
}

#[test]
fn what_is_optimised_last_is_what_is_delivered() {
    let case = Case::new(120);
    let outcome = case.run().unwrap();
    // Both sets are one, and making lobes of them changes nothing.
    assert_eq!(outcome.parameters.foreground, outcome.parameters.shadow);
    let residual = outcome.lighting.fusion_residual;
    assert!(residual < 1e-6, "{residual}");
    // The regularisers end where the sets are joined; before that they weigh in.
    let joined = case.settings.fused_at();
    for row in &outcome.history {
        let sum = row.consistency.unwrap().abs() + row.regularizer.unwrap();
        assert_eq!(sum == 0.0, row.iteration >= joined, "{}", row.iteration);
    }
    let loss = |k: usize| outcome.history[k].guidance.unwrap();
    assert!(loss(119) < loss(joined), "{} {}", loss(119), loss(joined));
}

#[test]
fn random_crops_lead_to_the_same_sun() {
    let mut case = Case::new(300);
    case.framing = Framing::Crops {
        side: 12,
        scale: crate::crop::USUAL_SCALE,
    };
    let outcome = case.run().unwrap();
    let angle = degrees_between(outcome.lighting.peak_direction().unwrap(), SUN);
    assert!(angle < 5.0, "{angle} degrees off");
}

#[test]
fn with_the_light_frozen_only_the_tone_curves_move() {
    let mut case = Case::new(20);
    case.settings.light = false;
    let outcome = case.run().unwrap();
    let start = Parameters::neutral(case.settings.lobes, 0.5);
    let (a, b) = (outcome.parameters.to_tensors(), start.to_tensors());
    for (a, b) in a.0.iter().zip(&b.0) {
        let apart = a.values.iter().zip(&b.values).map(|(a, b)| (a - b).abs());
        let apart = apart.fold(0.0, f64::max);
        if a.name.starts_with("tone") {
            assert!(apart > 1e-4, "{}", a.name);
        } else {
            // Directions are normalised once more.
            assert!(apart < 1e-15, "{}", a.name);
        }
    }
}

#[test]
fn the_loss_standing_still_ends_the_run_once_the_lights_are_fused() {
    let mut case = Case::new(4000);
    case.settings.fused_after = 0.005;
    case.settings.patience = 30;
    let outcome = case.run().unwrap();
    assert!(
        outcome.stopped_early && outcome.history.len() >= 80,
        "{}",
        outcome.history.len()
    );
    assert!(outcome.history.len() < 4000);
}

// ---- hard cases ------------------------------------------------------------------------------

#[test]
fn six_thousand_iterations_stay_finite() {
    // Ten times too long, on the smallest scene that has an object and a shadow.
    let mut case = Case::new(6000);
    case.scene = DenseTransport::ball((6, 5), (8, 4));
    case.settings.lobes = 6;
    let outcome = case.run().unwrap();
    assert_eq!(outcome.history.len(), 6000);
    assert_eq!(outcome.skipped(), 0);
    assert!(outcome.parameters.to_tensors().first_not_finite().is_none());
    let last = outcome.history.last().unwrap();
    let first = &outcome.history[0];
    assert!(last.guidance.unwrap() < 0.2 * first.guidance.unwrap());
}

/// Asks another guidance, then spoils or delays its answer.
struct Spoiled<'a> {
    inner: Reference,
    spoil: &'a dyn Fn(usize, &mut Guided),
}

impl Guidance for Spoiled<'_> {
    fn framing(&self) -> Framing {
        self.inner.framing()
    }

    fn gradient(
        &mut self,
        picture: &Raster<Vec3>,
        view: &CropView,
        step: Step,
    ) -> Result<Guided, OptimizeError> {
        let mut guided = self.inner.gradient(picture, view, step)?;
        (self.spoil)(step.iteration, &mut guided);
        Ok(guided)
    }
}

fn run_spoiled(case: &Case, spoil: &dyn Fn(usize, &mut Guided)) -> Result<Outcome, OptimizeError> {
    let inner = case.reference();
    case.run_with(&mut Spoiled { inner, spoil }, None, None, &mut |_| {
        ControlFlow::Continue(())
    })
}

#[test]
fn a_nan_from_one_step_on_ends_the_run_with_the_name_of_what_went_bad() {
    let case = Case::new(40);
    let error = run_spoiled(&case, &|k, g| {
        if k >= 7 {
            g.gradient.pixels_mut()[5].y = f32::NAN;
        }
    });
    assert_eq!(
        error.unwrap_err().to_string(),
        "`gradient of the guidance` is not finite in iteration 11, and 5 steps in a row could not be \
         taken; nothing was changed by them: lower light.learning_rates, or look at the inputs of \
         `gradient of the guidance`"
    );
    let error = run_spoiled(&case, &|k, g| {
        if k >= 7 {
            g.loss = f64::INFINITY;
        }
    });
    assert!(
        error
            .unwrap_err()
            .to_string()
            .starts_with("`loss of the guidance` is not finite")
    );
}

/// A transport one of whose results turns to NaN.
struct Failing {
    inner: DenseTransport,
    what: &'static str,
    calls: AtomicUsize,
}

impl Failing {
    fn spoil(&self, what: &str, values: &mut [Vec3]) {
        if what == self.what && self.calls.fetch_add(1, Ordering::Relaxed) >= 3 {
            values[0].x = f32::NAN;
        }
    }
}

impl LinearTransport for Failing {
    fn size(&self) -> (usize, usize) {
        self.inner.size()
    }
    fn environment_size(&self) -> (usize, usize) {
        self.inner.environment_size()
    }
    fn coverage(&self) -> &Raster<f32> {
        self.inner.coverage()
    }
    fn foreground(&self, light: &[Vec3]) -> Raster<Vec3> {
        let mut image = self.inner.foreground(light);
        self.spoil("object", image.pixels_mut());
        image
    }
    fn foreground_vjp(&self, gradient: &[Vec3]) -> Vec<Vec3> {
        let mut texels = self.inner.foreground_vjp(gradient);
        self.spoil("gradient of foreground.log_radiance", &mut texels);
        texels
    }
    fn shadow(&self, light: &[Vec3]) -> Raster<Vec3> {
        let mut image = self.inner.shadow(light);
        self.spoil("shadow ratio", image.pixels_mut());
        image
    }
    fn shadow_vjp(&self, light: &[Vec3], ratio: &Raster<Vec3>, gradient: &[Vec3]) -> Vec<Vec3> {
        let mut texels = self.inner.shadow_vjp(light, ratio, gradient);
        self.spoil("gradient of shadow.log_radiance", &mut texels);
        texels
    }
}

#[test]
fn a_nan_anywhere_in_the_chain_is_named_by_the_first_tensor_that_holds_it() {
    let case = Case::new(40);
    for what in [
        "object",
        "shadow ratio",
        "gradient of foreground.log_radiance",
        "gradient of shadow.log_radiance",
    ] {
        let failing = Failing {
            inner: case.scene.clone(),
            what,
            calls: AtomicUsize::new(0),
        };
        let background = crate::testing::background(PICTURE);
        let transfer = dipir_imaging::transfer::Transfer::Srgb;
        let objective = Objective::new(Box::new(failing), background, transfer, WEIGHTS).unwrap();
        let optimization = Optimization {
            objective,
            guidance: &mut case.reference(),
            recorder: None,
            settings: Settings {
                // Maps unfused, so that a gradient reaches its own light set alone.
                fused_after: 1.0,
                ..case.settings.clone()
            },
            start: Parameters::neutral(6, 0.5),
            checkpoint: None,
        };
        match optimization.run(&mut |_| ControlFlow::Continue(())) {
            Err(OptimizeError::NotFinite {
                tensor,
                in_a_row: 5,
                ..
            }) => {
                // A NaN in the shadow's adjoint passes through the fused map to the foreground.
                let fused = what == "gradient of shadow.log_radiance"
                    && tensor == "gradient of foreground.log_radiance";
                assert!(tensor == what || fused, "{what}: {tensor}");
            }
            other => panic!("{what}: {:?}", other.map(|o| o.skipped())),
        }
    }
}

#[test]
fn a_few_bad_steps_are_skipped_and_counted_and_change_nothing() {
    let mut case = Case::new(60);
    case.settings.learning_rates.tone = 0.0;
    let mut spoiled_at = vec![];
    let outcome = run_spoiled(&case, &|k, g| {
        if [3, 4, 20, 21, 22, 23].contains(&k) {
            g.gradient.pixels_mut()[0] = Vec3::splat(f32::NAN);
        }
    })
    .unwrap();
    for row in &outcome.history {
        if row.skipped.is_some() {
            spoiled_at.push(row.iteration);
            assert_eq!(row.loss, None);
        }
    }
    assert_eq!(spoiled_at, [3, 4, 20, 21, 22, 23]);
    assert_eq!(outcome.skipped(), 6);
    assert!(outcome.parameters.to_tensors().first_not_finite().is_none());
}

#[test]
fn gradients_of_zero_leave_the_light_to_the_regularisers_and_of_1e6_stay_finite() {
    let case = Case::new(120);
    let zero = run_spoiled(&case, &|_, g| g.gradient.pixels_mut().fill(Vec3::ZERO)).unwrap();
    assert!(zero.parameters.to_tensors().first_not_finite().is_none());
    let huge = run_spoiled(&case, &|k, g| {
        let sign = if k % 2 == 0 { 1e6 } else { -1e6 };
        g.gradient.pixels_mut().iter_mut().for_each(|p| *p *= sign);
    })
    .unwrap();
    assert_eq!(huge.skipped(), 0);
    assert!(huge.parameters.to_tensors().first_not_finite().is_none());
    assert!(huge.picture.0.pixels().iter().all(|p| p.is_finite()));
}

#[test]
fn nothing_to_light_and_no_light_at_all_stay_finite() {
    for scene in [DenseTransport::ball((1, 1), (2, 1)), {
        // The camera's corner: neither object nor shadow.
        let mut scene = DenseTransport::ball((4, 4), (4, 2));
        scene.coverage.pixels_mut().fill(0.0);
        scene.object.iter_mut().for_each(Vec::clear);
        scene.blocked.iter_mut().for_each(Vec::clear);
        scene
    }] {
        let mut case = Case::new(30);
        case.scene = scene;
        case.settings.lobes = 3;
        let outcome = case.run().unwrap();
        assert_eq!(outcome.skipped(), 0);
    }
}

#[test]
fn no_iteration_gives_the_light_of_the_start_and_a_single_one_moves_it() {
    let none = Case::new(0).run().unwrap();
    let start = Parameters::neutral(Case::new(0).settings.lobes, 0.5);
    assert_eq!(none.parameters, start);
    assert!(none.history.is_empty() && !none.stopped_early);
    let one = Case::new(1).run().unwrap();
    assert_eq!(one.history.len(), 1);
    assert_ne!(one.parameters, start);
    for outcome in [none, one] {
        assert!(outcome.picture.0.pixels().iter().all(|p| p.is_finite()));
        assert!(outcome.parameters.to_tensors().first_not_finite().is_none());
    }
}

/// A step of 1e6 times the usual gradient early in the run is not a NaN that would be skipped.
#[test]
fn a_huge_gradient_in_an_early_step_does_not_stop_the_light() {
    let case = Case::new(300);
    let struck = run_spoiled(&case, &|k, g| {
        if k == 4 {
            g.gradient.pixels_mut().iter_mut().for_each(|p| *p *= -1e6);
        }
    })
    .unwrap();
    let off = degrees_between(struck.lighting.peak_direction().unwrap(), SUN);
    let mask = touched(&objective(case.scene.clone(), WEIGHTS));
    let error = rmse(&struck.picture, &case.truth(), &mask);
    // As without the stroke.
    assert!(off < 3.0 && error < 0.01, "{off} degrees, rmse {error}");
}

// ---- resuming --------------------------------------------------------------------------------

/// The outcome without what differs from run to run.
fn bytes(outcome: &Outcome) -> String {
    let rows: Vec<Row> = outcome
        .history
        .iter()
        .map(|r| Row {
            seconds: 0.0,
            ..r.clone()
        })
        .collect();
    format!(
        "{:?} {:?} {:?} {:?}",
        outcome.lighting, outcome.tone, outcome.picture, rows
    )
}

/// Stands for a recorder: the same scene, sampled well from then on, and a little different.
struct Again {
    scene: DenseTransport,
    recorded: usize,
}

impl Recorder for Again {
    fn record(
        &mut self,
        light: &EnvironmentMap,
    ) -> Result<Box<dyn LinearTransport>, OptimizeError> {
        self.recorded += 1;
        let mut scene = self.scene.clone();
        scene.efficiency = 1.0;
        // What is recorded depends on the light that it is recorded for.
        let scale = 1.0 + 0.01 * light.texels()[7].x;
        scene.object.iter_mut().flatten().for_each(|w| *w *= scale);
        Ok(Box::new(scene))
    }
}

#[test]
fn killed_at_any_iteration_and_started_again_the_result_is_the_same_bytes() {
    let mut case = Case::new(130);
    case.framing = Framing::Crops {
        side: 8,
        scale: crate::crop::USUAL_SCALE,
    };
    case.scene.efficiency = 0.05;
    case.settings.checkpoint_every = 17;
    let again = || Again {
        scene: case.scene.clone(),
        recorded: 0,
    };
    let go_on = &mut |_: Event| ControlFlow::Continue(());
    let mut recorder = again();
    let whole = case
        .run_with(&mut case.reference(), Some(&mut recorder), None, go_on)
        .unwrap();
    assert_eq!(
        recorder.recorded, 1,
        "at iteration 50, for the record serves well from then on"
    );
    assert!(whole.history[50].recorded);
    // At random, and before and after both light sets are joined.
    let joined = case.settings.fused_at();
    let random = |k: u64| 1 + (mix64(k) % 129) as usize;
    let ends = [random(0), random(1), random(2), joined - 1, joined];
    for (k, at) in ends.into_iter().enumerate() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        // Killed: what happened after the last checkpoint is lost. Interrupted: nothing is.
        let killed = k % 2 == 0;
        let mut first = case_clone(&case);
        let mut stop = |event: Event| match event {
            Event::Step(row) if row.iteration == at => ControlFlow::Break(()),
            _ => ControlFlow::Continue(()),
        };
        let result = first.run_with(
            &mut case.reference(),
            Some(&mut again()),
            Some(&path),
            &mut stop,
        );
        assert!(matches!(result, Err(OptimizeError::Interrupted)));
        if killed {
            // The file as it stood at the last regular checkpoint.
            let _ = std::fs::remove_file(&path);
            first.settings.iterations = 130;
            let regular = at / 17 * 17;
            if regular > 0 {
                let mut stop = |event: Event| match event {
                    Event::Step(row) if row.iteration + 1 == regular => ControlFlow::Break(()),
                    _ => ControlFlow::Continue(()),
                };
                let kept = first.run_with(
                    &mut case.reference(),
                    Some(&mut again()),
                    Some(&path),
                    &mut stop,
                );
                assert!(matches!(kept, Err(OptimizeError::Interrupted)));
            }
        }
        let resumed = first
            .run_with(
                &mut case.reference(),
                Some(&mut again()),
                Some(&path),
                go_on,
            )
            .unwrap();
        assert_eq!(
            bytes(&resumed),
            bytes(&whole),
            "stopped at {at}, killed: {killed}"
        );
    }
}

fn case_clone(case: &Case) -> Case {
    Case {
        settings: case.settings.clone(),
        scene: case.scene.clone(),
        framing: case.framing,
    }
}

#[test]
fn previews_come_when_they_are_due_and_last_of_all_the_final_picture() {
    let mut case = Case::new(25);
    case.settings.preview_every = 10;
    let mut seen = vec![];
    let outcome = case
        .run_with(&mut case.reference(), None, None, &mut |event| {
            if let Event::Preview { iteration, picture } = event {
                seen.push((iteration, picture.clone()));
            }
            ControlFlow::Continue(())
        })
        .unwrap();
    let at: Vec<usize> = seen.iter().map(|s| s.0).collect();
    assert_eq!(at, [0, 10, 20, 25]);
    assert_eq!(seen[3].1, outcome.picture);
}

#[path = "interruption_tests.rs"]
mod interruption;
#[path = "time_budget_tests.rs"]
mod time_budget;
