//! Which stages are up to date, and why the others are not.
//!
//! Nothing is remembered between two calls: every answer comes from the bytes that are there, the
//! outputs' included, compared with what each `stage.json` says. What the stages read of each
//! other is compared by the hashes in the manifests, whose own files are checked in turn, so that
//! every byte is hashed once ([`hash_file`](crate::hashing::hash_file)).
use std::fmt;
use std::path::{Path, PathBuf};
use std::thread;

use serde::Serialize;

use crate::error::StageError;
use crate::fingerprint::{StaleReason, in_words, stale_reasons};
use crate::graph::{Graph, Node};
use crate::manifest::Manifest;
use crate::stage::StagePlan;

/// Whether a stage has to run.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum State {
    /// Its outputs are what a run would write.
    Fresh,
    /// It has to run.
    Stale {
        /// Why; at least one.
        reasons: Vec<StaleReason>,
    },
    /// It reads stages that have to run first. With reasons of its own it will run for certain;
    /// without, only if what those write differs from what is there now.
    Waits {
        /// The stages that it reads and that are not up to date.
        on: Vec<&'static str>,
        /// Its own reasons, as far as they are known yet.
        reasons: Vec<StaleReason>,
    },
    /// It cannot run as things are.
    Blocked {
        /// What is wrong.
        message: String,
    },
    /// The configuration gets by without it.
    Unneeded {
        /// Why.
        why: &'static str,
    },
}

impl State {
    /// Lets `edit` change the reasons why it has to run, if there are any.
    pub fn with_reasons(&mut self, edit: impl FnOnce(&mut Vec<StaleReason>)) {
        if let Self::Stale { reasons } | Self::Waits { reasons, .. } = self {
            edit(reasons);
        }
    }
}

/// A stage and its state.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StageStatus {
    /// Name of the stage.
    pub stage: &'static str,
    /// The executable that runs it.
    pub executable: &'static str,
    /// Whether it has to run.
    #[serde(flatten)]
    pub state: State,
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Fresh => write!(f, "up to date"),
            Self::Stale { reasons } => write!(f, "stale: {}", in_words(reasons)),
            Self::Waits { on, reasons } if reasons.is_empty() => {
                write!(f, "waits for {}, and runs if that changes", on.join(", "))
            }
            Self::Waits { on, reasons } => {
                write!(
                    f,
                    "stale: {}; runs after {}",
                    in_words(reasons),
                    on.join(", ")
                )
            }
            Self::Blocked { message } => write!(f, "cannot run: {message}"),
            Self::Unneeded { why } => write!(f, "not needed: {why}"),
        }
    }
}

/// Why the outputs in `folder` are not those of the plan; the plan's own failure is the reason
/// that blocks it.
pub fn state_of(plan: Result<StagePlan, String>, folder: &Path) -> Result<State, StageError> {
    Ok(match plan {
        Err(message) => State::Blocked { message },
        Ok(plan) => match stale_reasons(&plan, folder)? {
            reasons if reasons.is_empty() => State::Fresh,
            reasons => State::Stale { reasons },
        },
    })
}

/// Refuses the outputs of an earlier stage in `folder` that `plan` reads if they are damaged, as their reader
/// would.
pub fn check_taken(plan: &StagePlan, folder: &Path) -> Result<(), StageError> {
    let earlier = Manifest::read(folder, "")?;
    for output in &earlier.outputs {
        let path = Path::new(&earlier.stage).join(&output.path);
        if plan.inputs.iter().any(|i| i.path == path) {
            earlier.output(folder, &output.role)?;
        }
    }
    Ok(())
}

/// The state of every stage of `graph`. `plan` says what a run would be, or why there can be none;
/// `folder` where its outputs are. Stages that are not among `needed` are passed over.
pub fn assess(
    graph: &Graph,
    needed: &[&Node],
    plan: impl Fn(&str) -> Result<StagePlan, String>,
    folder: impl Fn(&str) -> PathBuf,
) -> Result<Vec<StageStatus>, StageError> {
    let is_needed = |node: &Node| needed.iter().any(|n| n.stage == node.stage);
    // Plans are made one after the other, outputs are hashed side by side.
    let states: Vec<Option<Result<State, StageError>>> = thread::scope(|scope| {
        let jobs: Vec<_> = graph
            .nodes()
            .iter()
            .map(|node| {
                is_needed(node).then(|| {
                    let (plan, folder) = (plan(node.stage), folder(node.stage));
                    scope.spawn(move || state_of(plan, &folder))
                })
            })
            .collect();
        let join = |job: thread::ScopedJoinHandle<_>| match job.join() {
            Ok(state) => state,
            Err(panic) => std::panic::resume_unwind(panic),
        };
        jobs.into_iter().map(|job| job.map(join)).collect()
    });
    let mut all: Vec<StageStatus> = Vec::new();
    for (node, state) in graph.nodes().iter().zip(states) {
        let state = match state {
            None => State::Unneeded {
                why: node
                    .unneeded
                    .unwrap_or("nothing that is asked for reads it"),
            },
            Some(state) => after(node, state?, &all),
        };
        all.push(StageStatus {
            stage: node.stage,
            executable: node.executable,
            state,
        });
    }
    Ok(all)
}

/// The state of a stage in the light of those before it.
fn after(node: &Node, own: State, before: &[StageStatus]) -> State {
    let is_ready = |s: &StageStatus| matches!(s.state, State::Fresh | State::Unneeded { .. });
    let on: Vec<&'static str> = before
        .iter()
        .filter(|s| node.reads.contains(&s.stage) && !is_ready(s))
        .map(|s| s.stage)
        .collect();
    if on.is_empty() {
        return own;
    }
    let reasons = match own {
        State::Stale { reasons } => reasons,
        _ => Vec::new(),
    };
    State::Waits { on, reasons }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use serde_json::json;

    use super::*;
    use crate::lock::WhenLocked;
    use crate::stage::StageWriter;

    fn graph() -> Graph {
        let node = |stage, reads: &[&'static str], unneeded| Node {
            stage,
            executable: "x",
            reads: reads.into(),
            unneeded,
        };
        Graph::new(vec![
            node("a", &[], None),
            node("b", &["a"], None),
            node("c", &["b"], None),
            node("d", &[], Some("nobody asks")),
        ])
    }

    /// `settings` by stage.
    fn states(out: &Path, settings: &dyn Fn(&str) -> u32) -> Vec<String> {
        let graph = graph();
        let plan = |stage: &str| match settings(stage) {
            0 => Err("no file".to_string()),
            n => Ok(StagePlan::new(stage, 1, json!({"key": n}), 0)),
        };
        let needed = graph.up_to("c");
        let all = assess(&graph, &needed, plan, |s| out.join(s)).unwrap();
        all.iter().map(|s| s.state.to_string()).collect()
    }

    #[test]
    fn a_change_is_told_where_it_is_and_felt_downstream() {
        let out = tempfile::tempdir().unwrap();
        for stage in ["a", "b", "c"] {
            let plan = StagePlan::new(stage, 1, json!({"key": 1}), 0);
            let folder = out.path().join(stage);
            let mut writer = StageWriter::begin(&folder, plan, WhenLocked::Refuse).unwrap();
            fs::write(writer.output("x", "x").unwrap(), "x").unwrap();
            writer.finish().unwrap();
        }
        let unneeded = "not needed: nobody asks";
        let fresh = "up to date";
        assert_eq!(states(out.path(), &|_| 1), [fresh, fresh, fresh, unneeded]);
        let changed = |stage: &str| if stage == "c" { 1 } else { 2 };
        assert_eq!(
            states(out.path(), &changed),
            [
                "stale: key changed from 1 to 2",
                "stale: key changed from 1 to 2; runs after a",
                "waits for b, and runs if that changes",
                unneeded
            ]
        );
        let blocked = |stage: &str| u32::from(stage != "b");
        assert_eq!(
            states(out.path(), &blocked),
            [
                fresh,
                "cannot run: no file",
                "waits for b, and runs if that changes",
                unneeded
            ]
        );
        fs::write(out.path().join("c/x"), "y").unwrap();
        let damaged = &states(out.path(), &|_| 1)[2];
        let file = out.path().join("c/x");
        let start = format!("stale: {}: damaged: its BLAKE3 hash is", file.display());
        assert!(damaged.starts_with(&start), "{damaged}");
    }

    #[test]
    fn damage_of_what_is_read_is_told_and_other_damage_is_not() {
        let out = tempfile::tempdir().unwrap();
        let folder = out.path().join("a");
        let plan = StagePlan::new("a", 1, json!({}), 0);
        let mut writer = StageWriter::begin(&folder, plan, WhenLocked::Refuse).unwrap();
        for name in ["x", "y"] {
            fs::write(writer.output(name, name).unwrap(), name).unwrap();
        }
        writer.finish().unwrap();
        let mut plan = StagePlan::new("b", 1, json!({}), 0);
        let earlier = Manifest::read(&folder, "").unwrap();
        plan.outputs_of(&earlier, &["x"]).unwrap();
        fs::write(folder.join("y"), "damaged").unwrap();
        assert!(check_taken(&plan, &folder).is_ok());
        fs::write(folder.join("x"), "damaged").unwrap();
        let message = check_taken(&plan, &folder).unwrap_err().to_string();
        assert!(message.ends_with("run the stage \"a\" again"), "{message}");
    }
}
