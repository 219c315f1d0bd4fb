use super::*;

/// Interrupted at the first event that `at` names and started again, the run ends as if nothing had happened.
fn assert_interruption_leaves_no_trace(case: &Case, at: impl Fn(&Event) -> bool) {
    let again = || Again {
        scene: case.scene.clone(),
        recorded: 0,
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    let run = |path: Option<&Path>, watch: &mut dyn FnMut(Event) -> ControlFlow<()>| {
        case.run_with(&mut case.reference(), Some(&mut again()), path, watch)
    };
    let go_on = &mut |_: Event| ControlFlow::Continue(());
    let whole = run(None, go_on).unwrap();
    let stopped = run(Some(&path), &mut |event| match at(&event) {
        true => ControlFlow::Break(()),
        false => ControlFlow::Continue(()),
    });
    assert!(matches!(stopped, Err(OptimizeError::Interrupted)));
    let resumed = run(Some(&path), go_on).unwrap();
    assert_eq!(bytes(&resumed), bytes(&whole));
    assert_eq!(resumed.stopped_early, whole.stopped_early);
}

#[test]
fn an_interruption_at_the_preview_of_a_new_record_leaves_no_trace() {
    let mut case = Case::new(60);
    case.scene.efficiency = 0.05;
    case.settings.preview_every = 50;
    assert_interruption_leaves_no_trace(&case, |event| {
        matches!(event, Event::Preview { iteration: 50, .. })
    });
}

#[test]
fn an_interruption_at_the_end_of_a_run_that_stood_still_leaves_no_trace() {
    let mut case = Case::new(4000);
    case.settings.fused_after = 1e-3;
    case.settings.patience = 20;
    case.settings.learning_rates = case.settings.learning_rates.scaled(0.0);
    let last = case.run().unwrap().history.len() - 1;
    assert!(last < 100, "{last}");
    assert_interruption_leaves_no_trace(
        &case,
        |event| matches!(event, Event::Step(row) if row.iteration == last),
    );
}
