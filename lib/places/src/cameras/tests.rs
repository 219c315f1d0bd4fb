//! A whole training in small, and what is refused before one.
use std::path::Path;

use dipir_calibration::CameraEstimator;
use dipir_light::environment::EnvironmentMap;
use glam::Vec3;

use crate::PlacesError;
use crate::cameras::run::Training;
use crate::cameras::{Progress, Settings, run};

/// Two skies over two grounds.
fn write_panoramas(folder: &Path) {
    for (name, grey) in [("yard", 0.1), ("hall", 0.5)] {
        let grid = EnvironmentMap::constant(64, 32, Vec3::ZERO);
        let texel = |k: usize| {
            let d = grid.direction_of(k / 64, k % 64);
            let light = if d.y > 0.0 { 1.0 } else { grey };
            Vec3::splat(light * (1.0 + 0.3 * (5.0 * d.x).sin()))
        };
        let map = EnvironmentMap::new(64, 32, (0..64 * 32).map(texel).collect());
        let file = folder.join(format!("{name}.exr"));
        map.unwrap().write(file).unwrap();
    }
}

fn settings(folder: &Path) -> Settings {
    let small = |training: Training| Training {
        hidden: 4,
        epochs: 1,
        ..training
    };
    Settings {
        folds: 2,
        views: 2,
        learned: 2,
        judged: 1,
        built: 0,
        scorers: small(Training::of_scorers()),
        wholes: small(Training::of_wholes()),
        ..Settings::new(folder.to_owned(), folder.join("new/out.safetensors"))
    }
}

#[test]
fn weights_are_written_into_a_folder_that_is_made() {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    let asked = settings(folder.path());
    let outcome = run(&asked, &|_| ()).unwrap();
    assert_eq!((outcome.rows[0].count, outcome.rows.len()), (2, 4));
    let bytes = std::fs::read(&asked.out).unwrap();
    let found = CameraEstimator::from_bytes(&bytes).unwrap();
    assert_eq!((found.members.len(), found.trust), (2, outcome.trust));
    let left: Vec<_> = std::fs::read_dir(folder.path().join("new"))
        .unwrap()
        .map(|e| e.unwrap().file_name())
        .collect();
    assert_eq!(left, ["out.safetensors"]);
}

#[test]
fn trainings_that_cannot_be_are_refused_before_photographs_are_drawn() {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    let end = |change: &dyn Fn(&mut Settings)| {
        let mut asked = settings(folder.path());
        change(&mut asked);
        let drawn = |p: Progress| assert!(matches!(p, Progress::Places(_)), "{p:?}");
        run(&asked, &drawn).unwrap_err()
    };
    let refused = |change: &dyn Fn(&mut Settings)| matches!(end(change), PlacesError::Setting(_));
    assert!(refused(&|s| s.folds = 1));
    assert!(refused(&|s| s.views = 0));
    assert!(refused(&|s| s.judged = 0));
    assert!(refused(&|s| s.scorers.hidden = 0));
    assert!(refused(&|s| s.wholes.epochs = 0));
    assert!(refused(&|s| s.wholes.dropout = 1.0));
    assert!(refused(&|s| s.scorers.learning_rate = f32::NAN));
    let few = end(&|s| s.folds = 3);
    assert!(matches!(few, PlacesError::TooFew { found: 2, .. }), "{few}");
}

#[test]
fn a_training_that_diverges_writes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    write_panoramas(folder.path());
    for scorers in [false, true] {
        let mut asked = settings(folder.path());
        let training = match scorers {
            true => &mut asked.scorers,
            false => &mut asked.wholes,
        };
        training.learning_rate = 1e38;
        training.epochs = 3;
        let end = run(&asked, &|_| ());
        assert!(
            matches!(end, Err(PlacesError::Diverged { .. })),
            "{scorers}"
        );
        assert!(!asked.out.exists());
    }
}
