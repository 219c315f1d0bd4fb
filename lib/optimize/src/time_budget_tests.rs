use std::time::Duration;

use super::*;

#[test]
fn a_time_budget_decides_the_iterations_once_and_the_run_is_that_of_their_number() {
    let mut case = Case::new(500);
    case.settings.checkpoint_every = 25;
    case.settings.time_budget_s = Some(0.3);
    let folder = tempfile::tempdir().unwrap();
    let checkpoint = folder.path().join("checkpoint");
    // A reference that takes a time of its own.
    let sleep = |_: usize, _: &mut Guided| std::thread::sleep(Duration::from_millis(20));
    let at_once = |_: usize, _: &mut Guided| ();
    let inner = || case.reference();
    let mut planned = vec![];
    let broken_off = case.run_with(
        &mut Spoiled {
            inner: inner(),
            spoil: &sleep,
        },
        None,
        Some(&checkpoint),
        &mut |event| {
            match event {
                Event::Planned(n) => planned.push(n),
                other => panic!("{other:?} after the plan was broken off"),
            }
            ControlFlow::Break(())
        },
    );
    assert!(matches!(broken_off, Err(OptimizeError::Interrupted)));
    assert!((1..=15).contains(&planned[0]), "{planned:?}");
    // A faster machine goes on with the schedule that was begun.
    let resumed = case.run_with(
        &mut Spoiled {
            inner: inner(),
            spoil: &at_once,
        },
        None,
        Some(&checkpoint),
        &mut |event| {
            if let Event::Planned(n) = event {
                planned.push(n);
            }
            ControlFlow::Continue(())
        },
    );
    let resumed = resumed.unwrap();
    assert_eq!(planned, [planned[0]; 2]);
    assert_eq!(resumed.history.len(), planned[0]);
    let plain = Case::new(planned[0]).run().unwrap();
    assert_eq!(resumed.parameters, plain.parameters);
    assert_eq!(resumed.picture, plain.picture);
}

#[test]
fn a_time_budget_leaves_one_iteration_at_least_and_no_more_than_wanted() {
    for (budget, expected) in [(1e-9, 1), (1e9, 7), (1e300, 7)] {
        let mut case = Case::new(7);
        case.settings.time_budget_s = Some(budget);
        assert_eq!(case.run().unwrap().history.len(), expected, "{budget}");
    }
    for (bad, text) in [
        (0.0, "0"),
        (-1.0, "-1"),
        (f64::NAN, "NaN"),
        (f64::INFINITY, "inf"),
    ] {
        let mut settings = settings(7);
        settings.time_budget_s = Some(bad);
        let refusal = settings.check().unwrap_err();
        assert_eq!(refusal.key, "time_budget_s");
        let message = format!("{text} is out of range; accepted: above 0");
        assert_eq!(refusal.message, message);
    }
}
