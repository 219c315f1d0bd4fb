//! The stages' executables as child processes: every one after those that it reads, independent
//! ones side by side.
//!
//! A child's standard input is a pipe whose other end this process holds. Closing it asks the
//! child to stop, and so does the end of this process, however it comes: no child outlives it for
//! longer than it takes to stop.
use std::io;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::Duration;

use crate::graph::Node;

/// How often children are looked after; a small part of the shortest stage.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// What a caller knows that the runner does not.
pub trait Work {
    /// The caller's own errors.
    type Error;

    /// The command of a stage, or `None` where nothing is to be done: asked when everything that
    /// the stage reads is there. Standard input is the runner's.
    fn command(&mut self, node: &Node) -> Result<Option<Command>, Self::Error>;

    /// The child of a stage runs: the time to take its pipes.
    fn started(&mut self, node: &Node, child: &mut Child);

    /// The child of a stage ended well.
    fn done(&mut self, node: &Node) -> Result<(), Self::Error>;

    /// Whether the user asked to stop.
    fn interrupted(&self) -> bool;
}

/// How a run ended before its end.
#[derive(Debug)]
pub enum Stopped<E> {
    /// The caller's own error.
    Work(E),
    /// An executable could not be started.
    Start {
        /// The stage.
        stage: &'static str,
        /// Its executable, as it was looked for.
        program: String,
        /// Why not.
        source: io::Error,
    },
    /// A child failed.
    Failed {
        /// The stage.
        stage: &'static str,
        /// How it ended.
        status: ExitStatus,
    },
    /// The user asked to stop.
    Interrupted,
}

struct Running<'a> {
    node: &'a Node,
    child: Child,
}

/// Runs `nodes`, which are in order, at most `jobs` at a time. Stages outside `nodes` are taken as
/// they are. After a failure nothing is started; what runs already is asked to stop.
pub fn run<W: Work>(nodes: &[&Node], jobs: usize, work: &mut W) -> Result<(), Stopped<W::Error>> {
    let mut running: Vec<Running> = Vec::new();
    let result = follow(nodes, jobs.max(1), work, &mut running);
    if result.is_err() {
        stop(&mut running);
    }
    result
}

fn follow<'a, W: Work>(
    nodes: &[&'a Node],
    jobs: usize,
    work: &mut W,
    running: &mut Vec<Running<'a>>,
) -> Result<(), Stopped<W::Error>> {
    let mut waiting: Vec<&Node> = nodes.to_vec();
    while !(waiting.is_empty() && running.is_empty()) {
        if work.interrupted() {
            return Err(Stopped::Interrupted);
        }
        let mut k = 0;
        while k < waiting.len() && running.len() < jobs {
            let node = waiting[k];
            let open = |n: &&Node| node.reads.contains(&n.stage);
            if waiting.iter().any(open) || running.iter().any(|r| open(&r.node)) {
                k += 1;
                continue;
            }
            waiting.remove(k);
            if let Some(command) = work.command(node).map_err(Stopped::Work)? {
                let mut started = start(node, command)?;
                work.started(node, &mut started.child);
                running.push(started);
            }
        }
        let Some(k) = first_ended(running).map_err(|(node, source)| Stopped::Start {
            stage: node.stage,
            program: node.executable.into(),
            source,
        })?
        else {
            if !running.is_empty() {
                thread::sleep(LOOK_EVERY);
            }
            continue;
        };
        let (ended, status) = (running.swap_remove(k.0), k.1);
        if work.interrupted() {
            return Err(Stopped::Interrupted);
        }
        if !status.success() {
            let stage = ended.node.stage;
            return Err(Stopped::Failed { stage, status });
        }
        work.done(ended.node).map_err(Stopped::Work)?;
    }
    Ok(())
}

fn start<E>(node: &Node, mut command: Command) -> Result<Running<'_>, Stopped<E>> {
    let program = command.get_program().to_string_lossy().into_owned();
    match command.stdin(Stdio::piped()).spawn() {
        Ok(child) => Ok(Running { node, child }),
        Err(source) => Err(Stopped::Start {
            stage: node.stage,
            program,
            source,
        }),
    }
}

#[allow(clippy::type_complexity)]
fn first_ended<'a>(
    running: &mut [Running<'a>],
) -> Result<Option<(usize, ExitStatus)>, (&'a Node, io::Error)> {
    for (k, r) in running.iter_mut().enumerate() {
        match r.child.try_wait() {
            Ok(Some(status)) => return Ok(Some((k, status))),
            Ok(None) => {}
            Err(e) => return Err((r.node, e)),
        }
    }
    Ok(None)
}

/// Closes the children's standard input, upon which they stop, and waits until they have.
fn stop(running: &mut [Running]) {
    for r in running.iter_mut() {
        drop(r.child.stdin.take());
    }
    for r in running {
        let _ = r.child.wait();
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    struct Scripts {
        log: Vec<String>,
        interrupt_after: usize,
        script: fn(&str) -> Option<&'static str>,
    }

    impl Work for Scripts {
        type Error = String;

        fn command(&mut self, node: &Node) -> Result<Option<Command>, String> {
            self.log.push(format!("+{}", node.stage));
            Ok((self.script)(node.stage).map(|script| {
                let mut command = Command::new("sh");
                command.args(["-c", script]);
                command
            }))
        }

        fn started(&mut self, _: &Node, _: &mut Child) {}

        fn done(&mut self, node: &Node) -> Result<(), String> {
            self.log.push(format!("-{}", node.stage));
            Ok(())
        }

        fn interrupted(&self) -> bool {
            self.log.len() >= self.interrupt_after
        }
    }

    fn nodes() -> Vec<Node> {
        let node = |stage, reads: &[&'static str]| Node {
            stage,
            executable: "sh",
            reads: reads.into(),
            unneeded: None,
        };
        vec![node("a", &[]), node("b", &[]), node("c", &["a", "b"])]
    }

    fn run_all(
        jobs: usize,
        interrupt_after: usize,
        script: fn(&str) -> Option<&'static str>,
    ) -> (Result<(), Stopped<String>>, String) {
        let nodes = nodes();
        let mut work = Scripts {
            log: Vec::new(),
            interrupt_after,
            script,
        };
        let all: Vec<&Node> = nodes.iter().collect();
        let result = run(&all, jobs, &mut work);
        (result, work.log.join(""))
    }

    #[test]
    fn one_job_runs_one_stage_after_the_other() {
        let (result, log) = run_all(1, usize::MAX, |_| Some("true"));
        assert!(result.is_ok());
        assert_eq!(log, "+a-a+b-b+c-c");
    }

    #[test]
    fn independent_stages_run_side_by_side_and_what_reads_them_waits() {
        let (result, log) = run_all(2, usize::MAX, |_| Some("true"));
        assert!(result.is_ok());
        assert!(
            ["+a+b-a-b+c-c", "+a+b-b-a+c-c"].contains(&log.as_str()),
            "{log}"
        );
    }

    #[test]
    fn stages_without_a_command_count_as_done() {
        let (result, log) = run_all(1, usize::MAX, |stage| (stage == "c").then_some("true"));
        assert!(result.is_ok());
        assert_eq!(log, "+a+b+c-c");
    }

    #[test]
    fn after_a_failure_nothing_starts_and_the_others_are_asked_to_stop() {
        // b ends when its standard input does.
        let (result, log) = run_all(2, usize::MAX, |stage| match stage {
            "a" => Some("exit 3"),
            _ => Some("cat"),
        });
        match result {
            Err(Stopped::Failed { stage, status }) => {
                assert_eq!((stage, status.code()), ("a", Some(3)));
            }
            other => panic!("{other:?}"),
        }
        assert_eq!(log, "+a+b");
    }

    #[test]
    fn an_interruption_stops_what_runs() {
        let (result, log) = run_all(1, 1, |_| Some("cat"));
        assert!(matches!(result, Err(Stopped::Interrupted)));
        assert_eq!(log, "+a");
    }

    #[test]
    fn an_executable_that_is_not_there_is_named() {
        struct Missing;
        impl Work for Missing {
            type Error = String;
            fn command(&mut self, _: &Node) -> Result<Option<Command>, String> {
                Ok(Some(Command::new("/no/such/executable")))
            }
            fn started(&mut self, _: &Node, _: &mut Child) {}
            fn done(&mut self, _: &Node) -> Result<(), String> {
                Ok(())
            }
            fn interrupted(&self) -> bool {
                false
            }
        }
        let nodes = nodes();
        let result = run(&[&nodes[0]], 1, &mut Missing);
        assert!(
            matches!(&result, Err(Stopped::Start { program, .. }) if program == "/no/such/executable"),
            "{result:?}"
        );
    }
}
