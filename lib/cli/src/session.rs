//! One run of a stage: its configuration read, its threads started, its output decided.
use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_pipeline::config::{Config, MAX_THREADS, PipelineTable};
use dipir_pipeline::error::StageError;
use dipir_pipeline::hashing::Hashes;
use dipir_pipeline::lock::WhenLocked;
use dipir_pipeline::stage::{StagePlan, StageWriter};
use serde_json::Value;

use crate::args::{CommonArgs, OutputArgs};
use crate::exit::{Usage, printable};
use crate::interrupt;
use crate::output::{print_line, say};
use crate::progress::Progress;
use crate::style::{bold_yellow, color_on_stderr};

/// What a stage needs of its command line and configuration.
#[derive(Debug)]
pub struct Session {
    /// The configuration with its overrides.
    pub config: Config,
    /// The `[pipeline]` table with the command line's `--seed` and `--threads`.
    pub pipeline: PipelineTable,
    /// Folder of all artifacts, relative to the current folder.
    pub out: PathBuf,
    /// Folder of another run's light stage, which is read in place of this run's own.
    pub light: Option<PathBuf>,
    /// Folder of the scene stage of a shot's photograph, if this run is of a frame: objects and ground are as there.
    pub placed: Option<PathBuf>,
    when_locked: WhenLocked,
    output: OutputArgs,
    _hashes: HandBack,
}

/// On drop, writes the hashes that this process computed into the file of hashes that the process which started it
/// reads.
#[derive(Debug)]
struct HandBack(Option<PathBuf>);

impl Drop for HandBack {
    fn drop(&mut self) {
        if let Some(path) = self.0.as_ref().filter(|path| Hashes::are_in(path)) {
            // Without it the files are hashed once more.
            let _ = Hashes::of_this_process().write(path);
        }
    }
}

impl Session {
    /// Reads the configuration, starts the worker threads and listens for Ctrl-C.
    pub fn start(args: &CommonArgs) -> anyhow::Result<Self> {
        let session = Self::open(args)?;
        session.start_threads()?;
        interrupt::listen()?;
        if args.supervised {
            interrupt::follow_standard_input();
        }
        Ok(session)
    }

    /// Reads the configuration alone.
    pub fn open(args: &CommonArgs) -> anyhow::Result<Self> {
        let config = Config::read(&args.pipeline, &args.set)?;
        let mut pipeline = config.pipeline()?;
        pipeline.seed = args.seed.unwrap_or(pipeline.seed);
        pipeline.threads = args.threads.unwrap_or(pipeline.threads);
        if let Err(message) = check_threads(pipeline.threads) {
            return Err(match args.threads {
                Some(_) => Usage(format!("--threads {}: {message}", pipeline.threads)).into(),
                None => config.invalid("pipeline.threads", message).into(),
            });
        }
        let out = match &args.out {
            Some(out) => out.clone(),
            None => config.resolve(&pipeline.out),
        };
        if out.as_os_str().is_empty() {
            return Err(
                Usage("the folder of artifacts is empty: name one with --out".into()).into(),
            );
        }
        if out.exists() && !out.is_dir() {
            let out = out.display();
            anyhow::bail!(
                "cannot create {out}: file exists; move it away or choose another folder with --out"
            );
        }
        if let Some(path) = &args.hashes {
            Hashes::read(path).adopt();
        }
        Ok(Self {
            config,
            pipeline,
            out,
            light: args.light.clone(),
            placed: args.placed.clone(),
            _hashes: HandBack(args.hashes.clone()),
            when_locked: match args.wait {
                true => WhenLocked::Wait,
                false => WhenLocked::Refuse,
            },
            output: args.output,
        })
    }

    /// Starts the worker threads; once a process.
    pub fn start_threads(&self) -> anyhow::Result<()> {
        start_threads(self.pipeline.threads)
    }

    /// Does `work` on one of the worker threads. From any other thread each loop in parallel hands its work to a worker,
    /// and sleeps until it is done: two switches of threads, longer than a small network's layers take. A renderer says
    /// how far a round is from the thread that sleeps: one that shows progress is called from there.
    pub fn on_worker<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        rayon::scope(|_| work())
    }

    /// The folder of a stage.
    pub fn stage_folder(&self, stage: &str) -> PathBuf {
        self.out.join(stage)
    }

    /// Opens the folder of the planned stage for writing.
    pub fn begin(&self, plan: StagePlan) -> Result<StageWriter, StageError> {
        let folder = self.stage_folder(&plan.stage);
        let writer = match StageWriter::begin(&folder, plan.clone(), WhenLocked::Refuse) {
            Err(StageError::Locked { holder, .. }) if self.when_locked == WhenLocked::Wait => {
                if !self.output.quiet {
                    let folder = printable(&folder.display().to_string());
                    say(format!("waiting for {holder}, which writes {folder}"));
                }
                StageWriter::begin(&folder, plan, WhenLocked::Wait)?
            }
            other => other?,
        };
        interrupt::unfinished(writer.partial());
        Ok(writer)
    }

    /// A path of the configuration, relative to the current folder.
    pub fn resolve(&self, path: &Path) -> PathBuf {
        self.config.resolve(path)
    }

    /// A progress bar.
    pub fn progress(&self, title: &str) -> Progress {
        Progress::new(title, self.output.quiet)
    }

    /// Prints a warning.
    pub fn warn(&self, message: &str) {
        self.output.warn(message);
    }

    /// Prints a remark that only `--verbose` shows.
    pub fn remark(&self, message: impl FnOnce() -> String) {
        if self.output.verbose {
            say(printable(&message()));
        }
    }

    /// Prints the result: `human`, or `json` with `--json`.
    pub fn result(&self, human: impl FnOnce() -> String, json: impl FnOnce() -> Value) {
        self.output.result(human, json);
    }
}

impl OutputArgs {
    /// Prints a warning.
    pub fn warn(&self, message: &str) {
        if !self.quiet {
            let label = bold_yellow("warning:", color_on_stderr());
            say(format!("{label} {}", printable(message)));
        }
    }

    /// Prints the result: `human`, or `json` with `--json`.
    pub fn result(&self, human: impl FnOnce() -> String, json: impl FnOnce() -> Value) {
        if self.json {
            print_line(&format!("{:#}", json()));
        } else if !self.quiet {
            print_line(&human());
        }
    }
}

/// Refuses more worker threads than any machine has use for.
pub fn check_threads(threads: usize) -> Result<(), String> {
    match threads <= MAX_THREADS {
        true => Ok(()),
        false => Err(format!("accepted: 0, for one a core, to {MAX_THREADS}")),
    }
}

/// Bytes of a worker's stack, as many as the main thread has on Linux: gradients of deep networks are found by recursion.
const STACK: usize = 8 << 20;

fn start_threads(threads: usize) -> anyhow::Result<()> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .stack_size(STACK)
        .build_global()
        .context("cannot start the worker threads; ask for fewer with --threads, or give the process more memory (ulimit -v)")
}

/// `1.2 s`, `3 min 20 s`, `4 h 18 min`.
pub fn duration(seconds: f64) -> String {
    match seconds {
        s if s < 9.995 => format!("{s:.2} s"),
        s if s < 59.95 => format!("{s:.1} s"),
        s if s < 60.0 => duration(60.0),
        s if s < 3600.0 => format!("{} min {:02} s", (s / 60.0) as u64, (s % 60.0) as u64),
        s => format!(
            "{} h {:02} min",
            (s / 3600.0) as u64,
            (s % 3600.0 / 60.0) as u64
        ),
    }
}

/// `1.5 MiB`.
pub fn size(bytes: u64) -> String {
    const UNITS: [&str; 4] = ["KiB", "MiB", "GiB", "TiB"];
    if bytes < 1024 {
        return format!("{bytes} B");
    }
    let mut value = bytes as f64 / 1024.0;
    let mut unit = 0;
    // As rounded below.
    while value >= 1023.95 && unit + 1 < UNITS.len() {
        value /= 1024.0;
        unit += 1;
    }
    format!("{value:.1} {}", UNITS[unit])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_and_sizes_read_well() {
        assert_eq!(duration(1.234), "1.23 s");
        assert_eq!(duration(59.0), "59.0 s");
        assert_eq!(duration(9.996), "10.0 s");
        assert_eq!(duration(59.96), "1 min 00 s");
        assert_eq!(duration(15491.0), "4 h 18 min");
        assert_eq!(duration(200.4), "3 min 20 s");
        assert_eq!(size(512), "512 B");
        assert_eq!(size(1536), "1.5 KiB");
        assert_eq!(size((1 << 20) - 1), "1.0 MiB");
        assert_eq!(size(3 << 30), "3.0 GiB");
    }
}
