//! `dipir run`: the stages' executables in order, those left out that have nothing to do.
use std::ffi::{OsStr, OsString};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::{self, JoinHandle};
use std::time::Instant;

use anyhow::Context;
use clap::Args;
use dipir_cli::args::CommonArgs;
use dipir_cli::ending;
use dipir_cli::exit::{self, AlreadyReported, Usage, printable};
use dipir_cli::interrupt::{self, Interrupted};
use dipir_cli::output::{json_path, say};
use dipir_cli::session::{Session, check_threads, duration};
use dipir_cli::style::{bold, color_on_stderr};
use dipir_pipeline::graph::{Graph, Node};
use dipir_pipeline::hashing::Hashes;
use dipir_pipeline::runner::{self, Stopped, Work};
use dipir_pipeline::status::{self, State};
use dipir_stages::light::idle_guidance;
use dipir_stages::truth::Truth;
use dipir_stages::{graph, needed_files};
use serde_json::{Map, Value, json};

use crate::hashed::{Reads, hashes_file, remove_left};
use crate::lock::lock_folder;
use crate::made::MadeFolders;
use crate::plan;
use crate::project::{ProjectArgs, Stage};
use crate::report;
use crate::watch;

#[derive(Args)]
pub struct RunArgs {
    #[command(flatten)]
    project: ProjectArgs,

    /// Begin with this stage, and take what earlier ones wrote as it is
    #[arg(long, value_name = "STAGE")]
    from: Option<Stage>,

    /// End with this stage: run it and what it needs, even if the picture gets by without it
    #[arg(long, value_name = "STAGE")]
    until: Option<Stage>,

    /// Run every stage that is asked for, up to date or not
    #[arg(long)]
    force: bool,

    /// Say which stages would run and what each takes, and start nothing. What did not run here yet and asks a diffusion
    /// model is measured: a few steps of it
    #[arg(long, conflicts_with = "jobs")]
    plan: bool,

    /// Stages that may run at the same time, such as scene and concepts
    #[arg(long, value_name = "N", default_value_t = 1)]
    jobs: usize,

    /// Worker threads of each stage, 0 for one a core; the results do not depend on it
    /// [default: [pipeline] threads]
    #[arg(long, short = 'j', value_name = "N")]
    threads: Option<usize>,

    /// Wait for another run in the same folder instead of refusing
    #[arg(long)]
    wait: bool,

    /// As --set pipeline.quality=draft
    #[arg(long)]
    draft: bool,

    /// Run again whenever a file that is read changes, until Ctrl-C
    #[arg(long)]
    watch: bool,
}

/// Runs what is not up to date, in one project after the other.
pub fn run(args: &RunArgs) -> anyhow::Result<()> {
    if args.jobs == 0 {
        return Err(Usage("--jobs 0: accepted: 1 or more".into()).into());
    }
    if let Some(Err(message)) = args.threads.map(check_threads) {
        let threads = args.threads.unwrap_or_default();
        return Err(Usage(format!("--threads {threads}: {message}")).into());
    }
    if args.watch {
        return watch::watch(&args.project);
    }
    let mut projects = args.project.each();
    if args.draft {
        for project in &mut projects {
            project.set.push("pipeline.quality=draft".into());
        }
    }
    let output = args.project.output;
    if let [project] = &projects[..] {
        let done = run_one(args, project)?;
        output.result(|| done.0, || done.1);
        return Ok(());
    }
    if args.project.out.is_some() {
        let message = "--out with several files: each has a folder of its own, [pipeline] out";
        return Err(Usage(message.into()).into());
    }
    check_several(&projects)?;
    let named = |project: ProjectArgs| (project.file().to_owned(), project);
    run_each(args, projects.into_iter().map(named).collect(), |_| {
        Map::new()
    })
}

/// Refuses files that are not there, and two with one folder of artifacts: the later would replace what the earlier wrote.
fn check_several(projects: &[ProjectArgs]) -> anyhow::Result<()> {
    let mut outs: Vec<(PathBuf, &Path)> = Vec::new();
    for project in projects {
        project.check_there()?;
        // What is wrong with the configuration its own run says.
        let Ok(session) = Session::open(&project.common()) else {
            continue;
        };
        let out = in_full(&session.out);
        if let Some((_, other)) = outs.iter().find(|(known, _)| *known == out) {
            let message = format!(
                "{} and {} write one folder, {}: give each its own, [pipeline] out",
                other.display(),
                project.file().display(),
                session.out.display()
            );
            return Err(Usage(printable(&message)).into());
        }
        outs.push((out, project.file()));
    }
    Ok(())
}

/// The path without links and detours, as far as it is there.
fn in_full(path: &Path) -> PathBuf {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.into());
    match (path.canonicalize(), path.parent(), path.file_name()) {
        (Ok(found), _, _) => found,
        (_, Some(parent), Some(name)) => in_full(parent).join(name),
        _ => path,
    }
}

/// Runs projects, each with what it is called, one after the other. One that fails does not keep the others from running.
/// `at_end` learns which failed, and says what else the JSON tells.
pub fn run_each(
    args: &RunArgs,
    projects: Vec<(PathBuf, ProjectArgs)>,
    at_end: impl FnOnce(&[String]) -> Map<String, Value>,
) -> anyhow::Result<()> {
    let output = args.project.output;
    let (mut results, mut failed) = (Vec::new(), Vec::new());
    let all = projects.len();
    // Seconds of those that ran something, and their number.
    let mut took = (0.0, 0);
    for (k, (name, project)) in projects.into_iter().enumerate() {
        interrupt::check()?;
        let name = name.display().to_string();
        if !(output.quiet || output.json) {
            let left = (all - k) as f64 * took.0 / f64::from(took.1.max(1));
            let left = match took.1 {
                0 => String::new(),
                _ => format!(", about {} left", duration(left)),
            };
            say(format!("{} ({} of {all}{left})", printable(&name), k + 1));
        }
        let start = Instant::now();
        let done = run_one(args, &project);
        if matches!(&done, Ok((_, json)) if json["ran"] != json!([])) {
            took = (took.0 + start.elapsed().as_secs_f64(), took.1 + 1);
        }
        match done {
            Ok(done) => {
                if !output.json {
                    output.result(
                        || format!("{}: {}", printable(&name), done.0),
                        || Value::Null,
                    );
                }
                results.push(json!({"file": name, "done": done.1}));
            }
            Err(e) if e.is::<Interrupted>() => return Err(e),
            Err(e) => {
                let code = exit::code_of(&e);
                if !e.is::<AlreadyReported>() {
                    exit::print(&e.context(name.clone()));
                }
                failed.push((code, name.clone()));
                results.push(json!({"file": name, "exit_code": code}));
            }
        }
    }
    let (codes, failed): (Vec<_>, Vec<_>) = failed.into_iter().unzip();
    let mut json = at_end(&failed);
    if output.json {
        json.insert("runs".into(), results.into());
        output.result(String::new, || Value::Object(json));
    }
    let Some(code) = codes.first() else {
        return Ok(());
    };
    if !output.json {
        let names: Vec<_> = failed.iter().map(|name| printable(name)).collect();
        say(format!(
            "{} of {all} failed: {}",
            names.len(),
            names.join(", ")
        ));
    }
    Err(AlreadyReported(*code).into())
}

impl RunArgs {
    /// What is not up to date, to `until` or to the end.
    pub fn needed(common: &CommonArgs, until: Option<Stage>) -> Self {
        Self {
            project: ProjectArgs::of(common),
            from: None,
            until,
            force: false,
            plan: false,
            jobs: 1,
            threads: common.threads,
            wait: common.wait,
            draft: false,
            watch: false,
        }
    }

    /// The same, of which nothing is started.
    pub fn planned(mut self) -> Self {
        self.plan = true;
        self
    }

    /// The same, up to date or not.
    pub fn forced(mut self, force: bool) -> Self {
        self.force = force;
        self
    }
}

/// Runs one project; what was done, for people and for programs.
pub fn run_one(args: &RunArgs, project: &ProjectArgs) -> anyhow::Result<(String, Value)> {
    let reads = Reads::until_now();
    let (session, graph) = project.open()?;
    let nodes = selected(args, &graph)?;
    let is_frame = project.placed.is_some();
    if let Some(warning) = idle_guidance(&session)?.filter(|_| !is_frame) {
        session.warn(&warning);
    }
    needed_files::check(&session, &nodes)?;
    check_taken(&session, &nodes)?;
    if args.plan {
        return plan::plan(&session, &graph, &nodes, args.force);
    }
    // Dropped after all that is written there: a run that fails leaves no empty folder.
    let _made = MadeFolders::make(&session.out);
    let mut work = Pipeline::new(args, project, &session)?;
    let all_fresh = all_fresh(&session, &graph, &nodes)?;
    if args.force || !all_fresh {
        interrupt::listen_patiently()?;
        let _lock = lock_folder(&session, args.wait, project.output.quiet)?;
        remove_left(&session.out);
        runner::run(&nodes, args.jobs, &mut work).map_err(stopped)?;
    }
    let report = match is_frame || dipir_stages::report::is_current(&session) {
        true => None,
        false => page(project, &session, &graph, &[]),
    };
    Ok(work.conclude(&nodes, report, &reads))
}

/// The page that shows the run. What the stages wrote stands without it, so that it cannot be
/// written is no failure of the run.
pub fn page(
    project: &ProjectArgs,
    session: &Session,
    graph: &Graph,
    failed: &[String],
) -> Option<Page> {
    match report::write(project, session, graph, failed) {
        Ok(page) => Some(page),
        Err(e) => {
            session.warn(&format!("there is no report: {}", exit::describe(&e)));
            None
        }
    }
}

/// Where the page is, and the comparison with the true light.
type Page = (PathBuf, Option<Truth>);

/// The stages that are asked for, in order.
fn selected<'a>(args: &RunArgs, graph: &'a Graph) -> anyhow::Result<Vec<&'a Node>> {
    let until = args.until.map_or(graph::LAST, Stage::name);
    let mut nodes = graph.up_to(until);
    if let Some(from) = args.from {
        let from = from.name();
        if !nodes.iter().any(|n| n.stage == from) {
            let why = graph.node(from).and_then(|n| n.unneeded);
            let message = match why {
                Some(why) => format!("--from {from}: the stage is not needed: {why}"),
                None => format!("--from {from}: {until} does not need that stage"),
            };
            return Err(Usage(message).into());
        }
        let reached = graph.from(from);
        nodes.retain(|n| reached.contains(n));
    }
    Ok(nodes)
}

/// Refuses damaged files of stages that `--from` leaves out: no stage of the run would write them again.
fn check_taken(session: &Session, nodes: &[&Node]) -> anyhow::Result<()> {
    let runs = |stage: &str| nodes.iter().any(|n| n.stage == stage);
    for node in nodes {
        let taken: Vec<_> = node.reads.iter().filter(|s| !runs(s)).collect();
        if taken.is_empty() {
            continue;
        }
        // Without a plan its executable says what is wrong.
        let Ok(plan) = graph::plan(session, node.stage) else {
            continue;
        };
        for stage in taken {
            status::check_taken(&plan, &session.stage_folder(stage))?;
        }
    }
    Ok(())
}

/// Whether nothing of `nodes` would run.
pub fn all_fresh(session: &Session, graph: &Graph, nodes: &[&Node]) -> anyhow::Result<bool> {
    let states = graph::assess(session, graph, nodes)?;
    let fresh = |s: &State| matches!(s, State::Fresh | State::Unneeded { .. });
    // Stages that were not asked for count as up to date, whatever they are.
    let asked = states
        .iter()
        .filter(|s| nodes.iter().any(|n| n.stage == s.stage));
    Ok(asked.into_iter().all(|s| fresh(&s.state)))
}

/// What the runner asks.
struct Pipeline<'a> {
    args: &'a RunArgs,
    project: &'a ProjectArgs,
    session: &'a Session,
    /// Folder of the stages' executables.
    programs: PathBuf,
    /// What the stages printed, with `--json`.
    results: Vec<Value>,
    /// What they are about to print, by stage.
    printed: Vec<(&'static str, JoinHandle<io::Result<String>>)>,
    ran: Vec<&'static str>,
    started: Vec<&'static str>,
}

impl<'a> Pipeline<'a> {
    fn new(
        args: &'a RunArgs,
        project: &'a ProjectArgs,
        session: &'a Session,
    ) -> anyhow::Result<Self> {
        let own =
            std::env::current_exe().context("cannot tell where the stages' executables are")?;
        Ok(Self {
            args,
            project,
            session,
            programs: own.parent().map(PathBuf::from).unwrap_or_default(),
            results: Vec::new(),
            printed: Vec::new(),
            ran: Vec::new(),
            started: Vec::new(),
        })
    }

    fn say(&self, node: &Node, text: &str) {
        if !self.args.project.output.quiet {
            let name = bold(node.stage, color_on_stderr());
            say(format!("{name}: {}", printable(text)));
        }
    }

    /// How it went.
    fn conclude(self, nodes: &[&Node], page: Option<Page>, reads: &Reads) -> (String, Value) {
        let names: Vec<&str> = nodes.iter().map(|n| n.stage).collect();
        let done = match self.ran.is_empty() {
            true => format!("nothing to do: {} up to date", listed(&names)),
            false => format!("ran {}", self.ran.join(", ")),
        };
        let done = match &page {
            None => done,
            Some((path, truth)) => format!("{done}\n{}", report::in_words(path, truth.as_ref())),
        };
        let (path, truth) = page.unzip();
        let json = json!({
            "stages": names, "ran": self.ran, "results": self.results, "report": path.map(json_path),
            "truth": truth.flatten(), "hashed": reads.since(),
        });
        (printable(&done), json)
    }

    /// Takes back the hashes of the stage.
    fn take_hashes(&self, stage: &str) {
        let path = hashes_file(&self.session.out, stage);
        let hashes = Hashes::read(&path);
        // A file of that name that is not ours stays, and nothing is taken from it.
        if Hashes::remove(&path).unwrap_or(false) {
            hashes.adopt();
        }
    }
}

impl Drop for Pipeline<'_> {
    fn drop(&mut self) {
        for stage in &self.started {
            let _ = Hashes::remove(&hashes_file(&self.session.out, stage));
        }
    }
}

/// `--name=value` as one word: a value that begins with a dash would be another option.
fn option(name: &str, value: impl AsRef<OsStr>) -> OsString {
    let mut word = OsString::from(format!("--{name}="));
    word.push(value);
    word
}

fn listed(names: &[&str]) -> String {
    match names {
        [one] => format!("{one} is"),
        _ => format!("{} are", names.join(", ")),
    }
}

impl Work for Pipeline<'_> {
    type Error = anyhow::Error;

    fn command(&mut self, node: &Node) -> anyhow::Result<Option<Command>> {
        let state = graph::state_of(self.session, node.stage)?;
        match &state {
            State::Fresh if !self.args.force => {
                self.say(node, "up to date");
                return Ok(None);
            }
            State::Fresh => self.say(node, "runs: --force"),
            // Its executable says what is wrong better than the plan can.
            State::Blocked { .. } => {}
            other => {
                let why = other.to_string();
                self.say(
                    node,
                    &format!("runs: {}", why.trim_start_matches("stale: ")),
                );
            }
        }
        let name = format!("{}{}", node.executable, std::env::consts::EXE_SUFFIX);
        let mut command = Command::new(self.programs.join(name));
        let project = self.project;
        command.arg(option("pipeline", project.file()));
        command.args(project.set.iter().map(|set| option("set", set)));
        let folders = [
            ("out", &project.out),
            ("light", &project.light),
            ("placed", &project.placed),
        ];
        for (name, folder) in folders {
            command.args(folder.iter().map(|folder| option(name, folder)));
        }
        if let Some(seed) = project.seed {
            command.args(["--seed", &seed.to_string()]);
        }
        if let Some(threads) = self.args.threads {
            command.args(["--threads", &threads.to_string()]);
        }
        // A child of a run that was killed may take a moment to notice.
        command.args(["--wait", "--supervised"]);
        let hashes = hashes_file(&self.session.out, node.stage);
        // Without the file the stage hashes for itself.
        if Hashes::to_hand_over().write(&hashes).is_ok() {
            command.arg(option("hashes", hashes));
            self.started.push(node.stage);
        }
        for (on, flag) in [
            (project.output.quiet, "--quiet"),
            (project.output.verbose, "--verbose"),
            (project.output.json, "--json"),
        ] {
            if on {
                command.arg(flag);
            }
        }
        if project.output.json {
            command.stdout(Stdio::piped());
        }
        Ok(Some(command))
    }

    fn started(&mut self, node: &Node, child: &mut Child) {
        if let Some(mut output) = child.stdout.take() {
            // Read at once, or a child with much to say would wait for ever.
            let reader = thread::spawn(move || {
                let mut text = String::new();
                output.read_to_string(&mut text).map(|_| text)
            });
            self.printed.push((node.stage, reader));
        }
    }

    fn done(&mut self, node: &Node) -> anyhow::Result<()> {
        self.ran.push(node.stage);
        self.take_hashes(node.stage);
        if let Some(k) = self.printed.iter().position(|p| p.0 == node.stage) {
            let text = match self.printed.swap_remove(k).1.join() {
                Ok(text) => text,
                Err(panic) => std::panic::resume_unwind(panic),
            };
            let text =
                text.with_context(|| format!("cannot read what {} printed", node.executable))?;
            let result: Value = serde_json::from_str(&text).unwrap_or(Value::String(text));
            self.results
                .push(json!({"stage": node.stage, "result": result}));
        }
        Ok(())
    }

    fn interrupted(&self) -> bool {
        interrupt::asked()
    }
}

fn stopped(stopped: Stopped<anyhow::Error>) -> anyhow::Error {
    match stopped {
        Stopped::Work(e) => e,
        Stopped::Interrupted => Interrupted.into(),
        Stopped::Start {
            stage,
            program,
            source,
        } => {
            let reason = dipir_pipeline::manifest::plain_reason(&source);
            anyhow::anyhow!(
                "the stage \"{stage}\" cannot be started: {program}: {reason}; install the \
                 executables of all stages in one folder"
            )
        }
        Stopped::Failed { stage, status } => match status.code() {
            Some(code) if code == i32::from(exit::INTERRUPTED) => Interrupted.into(),
            None if ending::is_told(status) => AlreadyReported(exit::FAILED).into(),
            code => match code.and_then(|code| u8::try_from(code).ok()) {
                // The stage has printed what was wrong.
                Some(code) => AlreadyReported(code).into(),
                // A signal or, on Windows, a code that says how the system ended it.
                None => anyhow::anyhow!(
                    "the stage \"{stage}\" ended without a word ({status}): {}; run again to go on \
                     where it was",
                    ending::cause(status)
                ),
            },
        },
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::process::ExitStatusExt;
    use std::process::ExitStatus;

    use super::*;

    #[test]
    fn what_a_stage_has_said_is_not_said_again() {
        let ended = |signal: i32| {
            let status = ExitStatus::from_raw(signal);
            stopped(Stopped::Failed {
                stage: "light",
                status,
            })
        };
        // As an allocation that fails ends it.
        assert!(ended(6).is::<AlreadyReported>());
        let killed = ended(9).to_string();
        assert!(killed.contains("ended without a word"), "{killed}");
    }
}
