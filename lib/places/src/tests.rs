//! Properties of the photographs, and a whole training in small.
use std::path::Path;

use dipir_estimator::Estimator;
use dipir_estimator::network::{Sight, from_bytes};
use dipir_light::environment::EnvironmentMap;
use dipir_light::luminance::luminance;
use glam::{Vec2, Vec3};
use safetensors::Dtype;
use safetensors::tensor::TensorView;

use crate::examples::{Example, Seen, drawn};
use crate::place::{Place, SMOOTH, folds, read_places};
use crate::probes::{PROBES, Probes};
use crate::trainer::{Training, train};
use crate::view::View;
use crate::{LeftOut, PlacesError, Progress, Settings, run};

/// A sky over a ground, with a sun at azimuth 90 degrees, 40 high, and a wall of its own grey.
fn panorama(grey: f32) -> EnvironmentMap {
    let sun = dipir_estimator::grid::direction(std::f32::consts::FRAC_PI_2, 0.698);
    let black = EnvironmentMap::constant(128, 64, Vec3::ZERO);
    let disc = black.texel_of(sun);
    let texel = |k: usize| {
        let d = black.direction_of(k / 128, k % 128);
        let sky = if d.y > 0.0 {
            Vec3::new(0.6, 0.8, 1.0)
        } else {
            Vec3::splat(grey)
        };
        let lit = sky * (1.0 + 0.3 * d.x);
        if (k / 128, k % 128) == disc {
            lit + Vec3::splat(2000.0)
        } else {
            lit
        }
    };
    EnvironmentMap::new(128, 64, (0..128 * 64).map(texel).collect()).unwrap()
}

fn place(name: &str, grey: f32) -> Place {
    Place::new(name, "outdoor", panorama(grey))
}

fn seen(probes: &Probes) -> Seen<'_> {
    Seen { probes, tuned: &[] }
}

#[test]
fn a_place_comes_apart_into_smooth_light_and_its_sun() {
    let p = place("yard", 0.3);
    let sun = dipir_estimator::grid::direction(std::f32::consts::FRAC_PI_2, 0.698);
    assert!(p.sun && p.peak.dot(sun) > 0.999, "{} {}", p.share, p.peak);
    let whole = luminance(p.panorama.integral().as_vec3());
    let parts = luminance(p.smooth.integral().as_vec3() + p.energy);
    assert!((whole - parts).abs() < 1e-3 * whole, "{whole} {parts}");
}

#[test]
fn the_sun_is_found_relative_to_the_view() {
    let (p, probes) = (place("yard", 0.3), Probes::default());
    // Heading by a quarter turn to the right looks at the sun.
    let e = Example::new(&p, 0, &View::standard(SMOOTH[0] / 4), &seen(&probes), 0);
    assert!(
        e.truth.peak.x.abs() < 0.03 && e.truth.peak.z < -0.7,
        "{}",
        e.truth.peak
    );
    let e = Example::new(&p, 0, &View::standard(0), &seen(&probes), 0);
    assert!(e.truth.peak.x > 0.7, "{}", e.truth.peak);
}

#[test]
fn probes_hold_the_irradiance_of_the_panorama() {
    let (p, probes) = (place("yard", 0.3), Probes::default());
    let e = Example::new(&p, 0, &View::standard(0), &seen(&probes), 0);
    let (_, gain, curve) = View::standard(0).take(&p, 0);
    let scale = gain * curve / e.reference;
    for (k, normal) in probes.normals.iter().enumerate() {
        let truth: Vec3 = (0..128 * 64)
            .map(|t| {
                let (i, j) = (t / 128, t % 128);
                let cos = p.panorama.direction_of(i, j).dot(*normal).max(0.0);
                p.panorama.texel(i, j) * cos * p.panorama.solid_angle(i) as f32
            })
            .sum::<Vec3>()
            * scale
            / std::f32::consts::PI;
        // The smooth part is kept on texels of 5.6 degrees.
        let off = (e.truth.all[k] - truth).abs().max_element();
        assert!(
            off < 0.02 * truth.max_element() + 0.02,
            "{normal}: {} {truth}",
            e.truth.all[k]
        );
    }
    assert_eq!(
        e.truth.mirrored(&probes).mirrored(&probes).all.len(),
        PROBES
    );
}

#[test]
fn views_are_drawn_within_their_ranges_and_the_same_again() {
    for n in 0..200 {
        let view = View::drawn(3, 5, n);
        assert_eq!(view, View::drawn(3, 5, n));
        let pitch = view.pitch.to_degrees();
        assert!((-40.0..=20.0).contains(&pitch) && view.heading < SMOOTH[0]);
        assert!(view.half.cmpgt(Vec2::splat(0.05)).all() && view.half.max_element() <= 1.0001);
        assert!((view.curve.iter().sum::<f32>() - 1.0).abs() < 1e-5);
    }
}

#[test]
fn places_seen_again_are_in_one_fold() {
    let names = [
        "quarry_02",
        "quarry_04",
        "kloppenheim_01_puresky",
        "kloppenheim_05",
        "yard",
        "hall",
    ];
    let places: Vec<Place> = names.iter().map(|n| place(n, 0.2)).collect();
    let fold = folds(&places, 3);
    assert!(fold[0] == fold[1] && fold[2] == fold[3]);
    assert_eq!(fold.iter().max(), Some(&2));
}

fn write_panoramas(folder: &Path) {
    for (n, grey) in [0.1, 0.2, 0.4, 0.6].into_iter().enumerate() {
        let name = ["yard", "hall", "field", "street"][n];
        panorama(grey)
            .write(folder.join(format!("{name}.exr")))
            .unwrap();
    }
}

fn settings(folder: &Path, out: &str) -> Settings {
    let training = Training {
        hidden: 8,
        epochs: 1,
        batch: 8,
        ..Training::default()
    };
    Settings {
        folds: 2,
        views: 6,
        judged: 2,
        training,
        ..Settings::new(folder.to_owned(), folder.join(out))
    }
}

#[test]
fn training_gives_the_same_bytes_for_any_number_of_threads_and_leaves_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    let whole = settings(folder.path(), "whole.safetensors");
    let outcome = run(&whole, &|_| true).unwrap();
    assert_eq!(outcome.places.len(), 4);
    let first = std::fs::read(&whole.out).unwrap();
    let one_thread = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    one_thread.install(|| run(&whole, &|_| true)).unwrap();
    assert_eq!(
        std::fs::read(&whole.out).unwrap(),
        first,
        "any number of threads"
    );
    let left: Vec<String> = std::fs::read_dir(folder.path())
        .unwrap()
        .filter_map(|e| Some(e.ok()?.file_name().to_string_lossy().into_owned()))
        .filter(|n| n.contains("fold"))
        .collect();
    assert!(left.is_empty(), "{left:?}");
    let few = Settings { folds: 9, ..whole };
    assert!(matches!(
        run(&few, &|_| true),
        Err(PlacesError::TooFew { found: 4, .. })
    ));
}

#[test]
fn training_goes_on_from_finished_folds_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    let long = |out: &str| {
        let mut s = settings(folder.path(), out);
        // 3 steps a pass: progress is told at step 20.
        s.training.epochs = 8;
        s
    };
    let (whole, stopped) = (long("whole.safetensors"), long("stopped.safetensors"));
    run(&whole, &|_| true).unwrap();
    let one_thread = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    // One thread trains fold 0 before fold 1.
    let end = one_thread.install(|| run(&stopped, &|p| !matches!(p, Progress::Training(1, ..))));
    assert!(matches!(end, Err(PlacesError::Stopped)));
    assert!(!stopped.out.exists() && stopped.out.with_extension("fold0").exists());
    let kept = std::sync::Mutex::new(Vec::new());
    let note = |p: Progress| {
        if let Progress::Kept(f) = p {
            kept.lock().unwrap().push(f);
        }
        true
    };
    run(&stopped, &note).unwrap();
    assert_eq!(kept.into_inner().unwrap(), [0]);
    let bytes = |s: &Settings| std::fs::read(&s.out).unwrap();
    assert_eq!(bytes(&whole), bytes(&stopped));
}

#[test]
fn fewer_photographs_than_a_batch_are_one_batch() {
    let (p, probes) = (place("yard", 0.3), Probes::default());
    let examples: Vec<Example> = (0..3)
        .map(|n| Example::new(&p, n, &View::drawn(3, 0, n), &seen(&probes), 3))
        .collect();
    let examples: Vec<&Example> = examples.iter().collect();
    let network = |batch: usize, rate: f32| {
        let settings = Training {
            hidden: 8,
            epochs: 2,
            batch,
            learning_rate: rate,
            ..Training::default()
        };
        train(
            &examples,
            0,
            &settings,
            &probes,
            Sight::Parts,
            1,
            &mut |_, _| true,
        )
    };
    // Three photographs and their mirror images.
    let whole = network(6, 2e-3).unwrap();
    assert!(
        whole.output[0].iter().any(|w| *w != 0.0),
        "nothing was learned"
    );
    assert_eq!(network(128, 2e-3).unwrap(), whole);
    assert!(matches!(
        network(6, 1e38),
        Err(PlacesError::Diverged { .. })
    ));
}

#[test]
fn trainings_that_cannot_be_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |change: &dyn Fn(&mut Training)| {
        let mut s = settings(folder.path(), "out.safetensors");
        change(&mut s.training);
        matches!(run(&s, &|_| true), Err(PlacesError::Setting(_)))
    };
    assert!(refused(&|t| t.epochs = 0));
    assert!(refused(&|t| t.weight_decay = f32::NAN));
    assert!(refused(&|t| t.learning_rate = f32::INFINITY));
    assert!(!refused(&|_| ()), "an empty folder is another error");
    let figures = run(&settings(folder.path(), "out.json"), &|_| true).unwrap_err();
    assert!(
        figures.to_string().contains("out.json`: the figures"),
        "{figures}"
    );
}

#[test]
fn surfaces_count_by_how_much_of_them_a_camera_sees() {
    let probes = Probes::seen(0.8, None);
    let surfaces = &probes.strength[..crate::probes::NORMALS];
    let mean = surfaces.iter().sum::<f32>() / surfaces.len() as f32;
    assert!((mean - 1.0).abs() < 1e-5, "{mean}");
    for (strength, normal) in surfaces.iter().zip(&probes.normals) {
        // A surface that faces away from the camera keeps a fifth.
        assert!(
            *strength >= 0.2 - 1e-6 && (*strength > 0.21) == (normal.z + 0.25 * normal.y > 1e-3)
        );
    }
}

#[test]
fn with_an_albedo_the_light_to_learn_shows_a_surface_as_the_curve_does() {
    let p = place("yard", 0.3);
    let (plain, told) = (Probes::default(), Probes::seen(0.0, Some(0.3)));
    let view = View::standard(0);
    let (_, _, curve) = view.take(&p, 0);
    let a = Example::new(&p, 0, &view, &seen(&plain), 0);
    let b = Example::new(&p, 0, &view, &seen(&told), 0);
    for (light, shown) in a.truth.all.iter().zip(&b.truth.all) {
        // `x / (1 + x)` of the exposed light.
        let exposed = 0.3 * light.y * a.reference / curve;
        let display = 0.3 * shown.y * a.reference;
        assert!(
            (display - exposed / (1.0 + exposed)).abs() < 1e-4,
            "{display} {exposed}"
        );
    }
}

/// Names of the places of a fold.
fn names_of(places: &[Place], fold: &[usize], f: usize) -> Vec<String> {
    let own = places.iter().zip(fold).filter(|(_, g)| **g == f);
    own.map(|(p, _)| p.name.clone()).collect()
}

/// A file of two of the embedded tunings, from number `first` on, whose folds left out `left_out`.
fn tunings(path: &Path, first: usize, left_out: &[Vec<String>]) {
    let embedded = Estimator::embedded().unwrap();
    let tuned = embedded.tuned()[first..first + 2].iter().enumerate();
    let tensors = tuned.flat_map(|(k, t)| t.tensors(&format!("tuned.{k}")));
    let stored: Vec<(String, Vec<u8>)> = tensors
        .map(|(name, v)| (name, v.iter().flat_map(|v| v.to_le_bytes()).collect()))
        .collect();
    let views = stored.iter().map(|(name, bytes)| {
        let shape = vec![bytes.len() / 4];
        (
            name.clone(),
            TensorView::new(Dtype::F32, shape, bytes).unwrap(),
        )
    });
    let text = serde_json::to_string(left_out).unwrap();
    let metadata = [("left_out".to_string(), text)].into();
    std::fs::write(path, safetensors::serialize(views, Some(metadata)).unwrap()).unwrap();
}

#[test]
fn the_networks_of_a_fold_see_through_the_tuning_that_left_out_its_places() {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    let places = read_places(folder.path()).unwrap();
    let fold = folds(&places, 2);
    let file = folder.path().join("tuned.safetensors");
    let of = |f: usize| names_of(&places, &fold, f);
    tunings(&file, 0, &[of(0), of(1)]);
    let plain = settings(folder.path(), "plain.safetensors");
    let tuned = Settings {
        tuned: Some(file.clone()),
        keep: true,
        ..settings(folder.path(), "out.safetensors")
    };
    run(&plain, &|_| true).unwrap();
    run(&tuned, &|_| true).unwrap();
    let load = |path: &Path| Estimator::load(path).unwrap();
    let (whole, embedded) = (load(&tuned.out), Estimator::embedded().unwrap());
    assert_eq!(whole.tuned(), &embedded.tuned()[..2]);
    let probes = Probes::default();
    let through = Seen {
        probes: &probes,
        tuned: whole.tuned(),
    };
    let photographs = drawn(&places, tuned.views, &through, tuned.seed);
    for f in 0..2 {
        let path = tuned.out.with_extension(format!("fold{f}"));
        assert_eq!(load(&path).tuned(), &embedded.tuned()[f..=f]);
        // What the networks of the fold learned from.
        let learned = photographs.iter().filter(|e| fold[e.place] != f);
        let rows: Vec<&Vec<f32>> = learned.flat_map(|e| &e.of_fold(f)[0]).collect();
        let weights = from_bytes(&std::fs::read(&path).unwrap()).unwrap();
        let [_, kind] = &weights.members[0];
        for (n, mean) in kind.mean.iter().enumerate() {
            let seen = |r: &&Vec<f32>| f64::from(*Sight::Kind.of(r).nth(n).unwrap());
            let wanted = rows.iter().map(seen).sum::<f64>() / rows.len() as f64;
            // The same sum in the same order; rounded once to single precision, 6e-8 of it.
            assert!(
                (f64::from(*mean) - wanted).abs() <= 1e-7 * wanted.abs(),
                "{n}"
            );
        }
    }
    assert!(load(&plain.out).tuned().is_empty());
    tunings(&file, 0, &[of(1), of(0)]);
    let refused = run(&tuned, &|_| true).unwrap_err().to_string();
    assert!(
        refused.contains("other folds") && refused.contains("tuned.safetensors"),
        "{refused}"
    );
    let refused = run(&Settings { folds: 3, ..tuned }, &|_| true).unwrap_err();
    assert!(refused.to_string().contains("2 folds, not 3"), "{refused}");
}

#[test]
fn a_finished_fold_of_another_tuning_is_trained_again() {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    let places = read_places(folder.path()).unwrap();
    let fold = folds(&places, 2);
    let of = |f: usize| names_of(&places, &fold, f);
    let file = folder.path().join("tuned.safetensors");
    let mut asked = Settings {
        tuned: Some(file.clone()),
        ..settings(folder.path(), "out.safetensors")
    };
    // 3 steps a pass: progress is told at step 20.
    asked.training.epochs = 8;
    let one_thread = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    tunings(&file, 0, &[of(0), of(1)]);
    let end = one_thread.install(|| run(&asked, &|p| !matches!(p, Progress::Training(1, ..))));
    assert!(matches!(end, Err(PlacesError::Stopped)));
    assert!(asked.out.with_extension("fold0").exists());
    tunings(&file, 2, &[of(0), of(1)]);
    run(&asked, &|p| !matches!(p, Progress::Kept(_))).unwrap();
    let embedded = Estimator::embedded().unwrap();
    let found = Estimator::load(&asked.out).unwrap();
    assert_eq!(found.tuned(), &embedded.tuned()[2..4]);
}

#[test]
fn a_finished_fold_of_other_panoramas_is_trained_again() {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    let mut asked = settings(folder.path(), "out.safetensors");
    // 3 steps a pass: progress is told at step 20.
    asked.training.epochs = 8;
    let one_thread = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    let end = one_thread.install(|| run(&asked, &|p| !matches!(p, Progress::Training(1, ..))));
    assert!(matches!(end, Err(PlacesError::Stopped)));
    assert!(asked.out.with_extension("fold0").exists());
    panorama(0.9).write(folder.path().join("yard.exr")).unwrap();
    let kept = std::sync::Mutex::new(Vec::new());
    let note = |p: Progress| {
        if let Progress::Kept(f) = p {
            kept.lock().unwrap().push(f);
        }
        true
    };
    run(&asked, &note).unwrap();
    assert!(kept.into_inner().unwrap().is_empty());
}

#[test]
fn one_place_seen_four_times_is_too_few_for_two_folds() {
    let folder = tempfile::tempdir().unwrap();
    for n in 1..5 {
        let file = folder.path().join(format!("yard_0{n}.exr"));
        panorama(0.1 * n as f32).write(file).unwrap();
    }
    let end = run(&settings(folder.path(), "out.safetensors"), &|_| true);
    assert!(
        matches!(end, Err(PlacesError::TooFew { found: 1, .. })),
        "{:?}",
        end.err()
    );
}

#[test]
fn a_training_that_is_stopped_early_draws_no_photograph() {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    let asked = settings(folder.path(), "out.safetensors");
    let end = run(&asked, &|p| match p {
        Progress::Places(_) => false,
        other => panic!("{other:?}"),
    });
    assert!(matches!(end, Err(PlacesError::Stopped)));
}

#[test]
fn no_fold_is_left_of_an_earlier_training_with_more_of_them() {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    let trained = |folds: usize| {
        let asked = Settings {
            folds,
            keep: true,
            ..settings(folder.path(), "out.safetensors")
        };
        run(&asked, &|_| true).unwrap();
        [0, 1, 2].map(|f| asked.out.with_extension(format!("fold{f}")).exists())
    };
    assert_eq!(trained(3), [true, true, true]);
    assert_eq!(trained(2), [true, true, false]);
}

/// A folder of four panoramas, and the weights of a training that kept its folds.
fn kept() -> (tempfile::TempDir, Settings) {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    let asked = Settings {
        keep: true,
        ..settings(folder.path(), "out.safetensors")
    };
    run(&asked, &|_| true).unwrap();
    (folder, asked)
}

#[test]
fn places_stay_in_the_folds_of_their_training_when_panoramas_come_and_go() {
    let (folder, asked) = kept();
    let read = || LeftOut::read(folder.path(), &asked.out).unwrap();
    let fold_of = |found: &LeftOut, name: &str| {
        let at = found.places.iter().position(|p| p.name == name);
        found.fold[at.unwrap()]
    };
    let before = read();
    let names = ["field", "hall", "street", "yard"];
    let trained = names.map(|n| fold_of(&before, n));
    assert_eq!((before.note(), trained.iter().sum::<usize>()), (None, 2));
    // Its sun has the least share of all light: dealt anew, it comes first and moves the others by one.
    for name in ["alley", "yard_02"] {
        panorama(0.9)
            .write(folder.path().join(format!("{name}.exr")))
            .unwrap();
    }
    let after = read();
    assert_ne!(
        folds(&after.places, 2)[1..5],
        trained,
        "or this shows nothing"
    );
    assert_eq!(names.map(|n| fold_of(&after, n)), trained);
    assert_eq!(
        fold_of(&after, "yard_02"),
        trained[3],
        "the yard seen again"
    );
    assert_eq!(after.added, ["alley"]);
    assert!(after.note().unwrap().starts_with("1 of 6 panoramas"));
    std::fs::remove_file(folder.path().join("field.exr")).unwrap();
    assert_eq!(fold_of(&read(), "hall"), trained[1]);
}

#[test]
fn networks_and_figures_of_other_trainings_are_refused() {
    let (folder, asked) = kept();
    let file = |extension: &str| asked.out.with_extension(extension);
    let refused = || match LeftOut::read(folder.path(), &asked.out) {
        Err(e) => e.to_string(),
        Ok(_) => "accepted".into(),
    };
    assert_eq!(refused(), "accepted");
    let figures = std::fs::read_to_string(file("json")).unwrap();
    std::fs::remove_file(file("json")).unwrap();
    assert!(refused().contains("out.json`, in which"), "{}", refused());
    std::fs::write(file("json"), "{}").unwrap();
    assert!(refused().contains("missing field"), "{}", refused());
    std::fs::write(file("json"), figures).unwrap();
    let one = std::fs::read(file("fold1")).unwrap();
    std::fs::write(file("fold1"), std::fs::read(file("fold0")).unwrap()).unwrap();
    assert!(refused().contains("not of one training"), "{}", refused());
    std::fs::remove_file(file("fold1")).unwrap();
    assert!(refused().contains("the 1 networks"), "{}", refused());
    std::fs::write(file("fold1"), one).unwrap();
    std::fs::remove_file(file("fold0")).unwrap();
    assert!(refused().contains("--keep-folds"), "{}", refused());
}

#[test]
fn a_kind_is_that_of_the_whole_name_whatever_the_resolution() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["street_1k", "street_8k", "street_lamp_1k", "streets"] {
        panorama(0.2)
            .write(folder.path().join(format!("{name}.exr")))
            .unwrap();
    }
    std::fs::write(
        folder.path().join("panoramas.tsv"),
        "name\tkind\nstreet\toutdoor urban\n",
    )
    .unwrap();
    let places = read_places(folder.path()).unwrap();
    let kinds: Vec<&str> = places.iter().map(|p| p.kind.as_str()).collect();
    assert_eq!(kinds, ["outdoor", "outdoor", "place", "place"]);
}
