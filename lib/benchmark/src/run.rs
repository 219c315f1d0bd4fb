//! Runs methods on scenes, several at a time. Results that are there are not made again.
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use dipir_cli::executables::Executables;
use dipir_cli::exit::Usage;
use dipir_cli::interrupt;

use crate::chosen::choose;
use crate::command_line::RunArgs;
use crate::folder::{EvaluationFolder, SceneInfo};
use crate::parts::Parts;
use crate::runner::Runner;

/// A method that has ended on a scene, whether it failed or not.
pub struct Step<'a> {
    /// Runs that have ended, this one included.
    pub done: usize,
    /// Runs in all.
    pub total: usize,
    /// The scene.
    pub scene: &'a str,
    /// The method.
    pub method: &'a str,
}

/// What was run.
pub struct Outcome {
    /// Where results are.
    pub folder: PathBuf,
    /// Scenes.
    pub scenes: usize,
    /// Methods.
    pub methods: usize,
    /// Scene and method of each run that failed, and why.
    pub failures: Vec<(String, anyhow::Error)>,
}

/// Runs what is not done yet. `note` gets a line for each method that is left out, `report` every run that ends.
///
/// # Errors
/// If there are no scenes, the arguments name what is not there or set what cannot be set, or the user interrupts. Runs
/// that fail are no error: they are in the outcome, and the others go on.
pub fn run(
    args: &RunArgs,
    note: &dyn Fn(&str),
    report: &(dyn Fn(Step) + Sync),
) -> anyhow::Result<Outcome> {
    interrupt::listen()?;
    let (runner, scenes) = prepare(args, note)?;
    let total = scenes.len() * runner.methods.len();
    let (next, done) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let failures: Mutex<Vec<(String, anyhow::Error)>> = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..args.jobs.min(scenes.len()) {
            scope.spawn(|| {
                while let Some(scene) = scenes.get(next.fetch_add(1, Ordering::Relaxed)) {
                    if interrupt::asked() {
                        break;
                    }
                    runner.scene(scene, &|method: &str, failed: Option<anyhow::Error>| {
                        report(Step {
                            done: done.fetch_add(1, Ordering::Relaxed) + 1,
                            total,
                            scene: &scene.name,
                            method,
                        });
                        if let (Some(error), Ok(mut list)) = (failed, failures.lock()) {
                            list.push((format!("{}, {method}", scene.name), error));
                        }
                    });
                }
            });
        }
    });
    interrupt::check()?;
    Ok(Outcome {
        folder: runner.evaluation.root().join("runs"),
        scenes: scenes.len(),
        methods: runner.methods.len(),
        failures: failures.into_inner().unwrap_or_default(),
    })
}

/// What runs on which scenes. Nothing that the arguments or the configuration get wrong is left to find for a run.
fn prepare<'a>(
    args: &'a RunArgs,
    note: &dyn Fn(&str),
) -> anyhow::Result<(Runner<'a>, Vec<SceneInfo>)> {
    if !(args.target_error > 0.0 && args.target_error < 1.0) || args.jobs == 0 {
        let text = "--target-error must lie above 0 and below 1, --jobs must be at least 1";
        return Err(Usage(text.into()).into());
    }
    let evaluation = EvaluationFolder::new(&args.folder.out);
    let scenes = evaluation.chosen(&args.scene)?;
    let methods = choose(args, note)?;
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
    let threads = if args.threads == 0 {
        cores
    } else {
        args.threads
    };
    let runner = Runner {
        evaluation,
        executables: Executables::beside_this()?,
        args,
        methods,
        threads: (threads / args.jobs).max(1),
        parts: Parts::default(),
    };
    if let Some(first) = scenes.first() {
        runner.check(first)?;
    }
    Ok((runner, scenes))
}

#[cfg(test)]
mod tests {
    use dipir_evaluation::results::write;

    use super::*;
    use crate::chosen::tests::arguments;

    #[test]
    fn a_wrong_setting_is_found_before_anything_runs() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("scenes/a");
        let info = "{\"name\": \"a\", \"made_from\": \"\", \"map\": \"map.exr\", \"exposure_ev\": 0, \"tone\": \"none\"}";
        write(&scene.join("scene.json"), info).unwrap();
        let pipeline = "[scene]\nbackground = \"photo.png\"\n[[scene.objects]]\npath = \"a.obj\"\n";
        write(&scene.join("pipeline.toml"), pipeline).unwrap();
        let out = folder.path().to_str().unwrap();
        for set in ["lora.stepps=3", "light.guidance=lds"] {
            let args = arguments(&["--out", out, "-s", set]);
            let error = prepare(&args, &|_| {}).map(|_| ()).unwrap_err();
            assert!(error.is::<Usage>(), "{error:#}");
            assert!(
                error.to_string().starts_with(&format!("--set {set}: ")),
                "{error:#}"
            );
        }
    }
}
