//! Runs methods on scenes, several at a time. Results that are there are not made again.
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use dipir_cli::executables::Executables;
use dipir_cli::exit::Usage;
use dipir_cli::interrupt;

use crate::command_line::RunArgs;
use crate::folder::{EvaluationFolder, TRUTH};
use crate::methods::{self, Method};
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

/// Runs what is not done yet. `report` gets every run that ends.
///
/// # Errors
/// If there are no scenes, the arguments name what is not there, or the user interrupts. Runs that fail
/// are no error: they are in the outcome, and the others go on.
pub fn run(args: &RunArgs, report: &(dyn Fn(Step) + Sync)) -> anyhow::Result<Outcome> {
    if !(args.target_error > 0.0 && args.target_error < 1.0) || args.jobs == 0 {
        let text = "--target-error must lie above 0 and below 1, --jobs must be at least 1";
        return Err(Usage(text.into()).into());
    }
    interrupt::listen()?;
    let evaluation = EvaluationFolder::new(&args.folder.out);
    let scenes = evaluation.chosen(&args.scene)?;
    let methods = chosen_methods(args)?;
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
        model: dipir_stages::model::digest(args.model.as_deref())?,
        threads: (threads / args.jobs).max(1),
    };
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

/// Methods with the folder of their maps, if they are imported ones.
fn chosen_methods(args: &RunArgs) -> anyhow::Result<Vec<(Method, Option<PathBuf>)>> {
    let all = methods::read(args.methods.as_deref())?;
    for name in &args.method {
        if !all.iter().any(|m| m.name == *name) {
            let names: Vec<&str> = all.iter().map(|m| m.name.as_str()).collect();
            return Err(Usage(format!("--method {name}: accepted: {}", names.join(", "))).into());
        };
    }
    let mut chosen: Vec<_> = all
        .into_iter()
        .filter(|m| args.method.is_empty() || args.method.contains(&m.name))
        .map(|m| (m, None))
        .collect();
    if !args.environment_from.is_empty() && args.method.is_empty() {
        chosen.clear();
    }
    for folder in &args.environment_from {
        chosen.push((methods::imported(folder)?, Some(folder.clone())));
    }
    if chosen.iter().any(|(m, _)| m.name == TRUTH) {
        return Err(Usage(format!("no method may be called \"{TRUTH}\"")).into());
    }
    Ok(chosen)
}
