//! Executables as child processes: for programs that measure them as users run them.
use std::fs;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::Instant;

use anyhow::{Context, bail};
use serde_json::Value;

use crate::exit::INTERRUPTED;
use crate::interrupt::{self, Interrupted};

/// The folder of the executables, which is that of this one.
#[derive(Clone, Debug)]
pub struct Executables {
    folder: PathBuf,
}

/// What a child left behind.
#[derive(Clone, Debug)]
pub struct Ran {
    /// What it printed.
    pub json: Value,
    /// Seconds from its start to its end.
    pub wall_s: f64,
    /// Seconds that processors worked for it, all threads together; absent where the system does
    /// not say. Right only while no other child of this process ends.
    pub cpu_s: Option<f64>,
}

impl Executables {
    /// Those beside this executable.
    pub fn beside_this() -> anyhow::Result<Self> {
        let this = std::env::current_exe().context("cannot find the folder of this executable")?;
        let folder = this.parent().context("this executable has no folder")?;
        Ok(Self {
            folder: folder.into(),
        })
    }

    /// Runs the stage `name` with `arguments` and `--json`, and waits for its end.
    pub fn run<S: AsRef<str>>(&self, name: &str, arguments: &[S]) -> anyhow::Result<Ran> {
        interrupt::check()?;
        let program = self
            .folder
            .join(format!("{name}{}", std::env::consts::EXE_SUFFIX));
        let before = children_cpu_s();
        let clock = Instant::now();
        let mut child = Command::new(&program)
            .args(arguments.iter().map(AsRef::as_ref))
            .args(["--json", "--supervised"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", program.display()))?;
        // The child stops when this end closes: it does not outlive this process.
        let held = child.stdin.take();
        let output = child
            .wait_with_output()
            .with_context(|| format!("cannot follow {}", program.display()))?;
        drop(held);
        let wall_s = clock.elapsed().as_secs_f64();
        let cpu_s = children_cpu_s()
            .zip(before)
            .map(|(after, before)| after - before);
        if output.status.code() == Some(INTERRUPTED.into()) {
            return Err(Interrupted.into());
        }
        if !output.status.success() {
            let message = String::from_utf8_lossy(&output.stderr);
            let typed: Vec<&str> = arguments.iter().map(AsRef::as_ref).collect();
            bail!(
                "{name} {} failed: {}",
                typed.join(" "),
                message.trim().trim_start_matches("error: ")
            );
        }
        let json = serde_json::from_slice(&output.stdout)
            .with_context(|| format!("{name} printed no JSON"))?;
        Ok(Ran {
            json,
            wall_s,
            cpu_s,
        })
    }
}

/// Processor seconds of all children of this process that have ended.
fn children_cpu_s() -> Option<f64> {
    // Ticks of the kernel's interface to programs, whatever its own: 100 a second on Linux.
    const TICKS_PER_S: f64 = 100.0;
    let text = fs::read_to_string("/proc/self/stat").ok()?;
    // The name, in parentheses, may hold anything; children's user and system time are the 14th
    // and 15th numbers behind it.
    let (_, behind) = text.rsplit_once(')')?;
    let ticks = |k: usize| behind.split_whitespace().nth(k)?.parse::<f64>().ok();
    Some((ticks(13)? + ticks(14)?) / TICKS_PER_S)
}
