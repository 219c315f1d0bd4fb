//! `dipir run --plan`: what a run would do and take, before anything starts.
use dipir_cli::interrupt;
use dipir_cli::session::{Session, duration, size};
use dipir_pipeline::graph::{Graph, Node};
use dipir_pipeline::manifest::{Manifest, peak_rss_bytes};
use dipir_pipeline::status::State;
use dipir_stages::graph;
use dipir_stages::model::{self, ModelTable, forecast};
use dipir_stages::names::{CONCEPTS, LIGHT, LORA};
use serde::Serialize;
use serde_json::{Value, json};

/// What is expected of a stage.
#[derive(Serialize)]
struct Expected {
    stage: &'static str,
    runs: bool,
    /// Seconds and bytes, and what they come from; nothing where nothing is known.
    seconds: Option<f64>,
    peak_rss_bytes: Option<u64>,
    from: &'static str,
}

/// The stages of a run with their expected time and memory, for people and for programs.
pub fn plan(
    session: &Session,
    graph: &Graph,
    nodes: &[&Node],
    force: bool,
) -> anyhow::Result<(String, Value)> {
    let states = graph::assess(session, graph, nodes)?;
    let mut all = vec![];
    for node in nodes {
        let state = states.iter().find(|s| s.stage == node.stage);
        let idle = state.is_none_or(|s| matches!(s.state, State::Unneeded { .. }))
            || (!force && state.is_some_and(|s| matches!(s.state, State::Fresh)));
        let earlier = Manifest::read(&session.stage_folder(node.stage), "").ok();
        let mut expected = Expected {
            stage: node.stage,
            runs: !idle,
            seconds: None,
            peak_rss_bytes: None,
            from: "nothing is known: it has not run here",
        };
        if let (true, Some(earlier)) = (expected.runs, earlier) {
            expected.seconds = Some(earlier.elapsed_s);
            expected.peak_rss_bytes = earlier.peak_rss_bytes;
            expected.from = "as it took the last time";
        }
        all.push(expected);
    }
    measure(session, &mut all)?;
    Ok((in_words(&all), json!({"plan": all})))
}

/// Fills in what asks the model and has not run, from a few steps of it.
fn measure(session: &Session, all: &mut [Expected]) -> anyhow::Result<()> {
    let asks = [CONCEPTS.name, LORA.name, LIGHT.name];
    let unknown = |e: &Expected| e.runs && e.seconds.is_none() && asks.contains(&e.stage);
    if !all.iter().any(unknown) || !forecast::asks_model(session)? {
        return Ok(());
    }
    let table: ModelTable = session.config.table("model")?;
    let model = model::load(session, &table)?;
    let progress = session.progress("measuring");
    let times = forecast::measure(session, &model, |share| {
        progress.set(share);
        !interrupt::asked()
    });
    progress.done();
    let works = forecast::works(session, &times?)?;
    for expected in all.iter_mut().filter(|e| unknown(e)) {
        if let Some(work) = works.iter().find(|w| w.stage == expected.stage) {
            expected.seconds = Some(work.seconds);
            expected.peak_rss_bytes = peak_rss_bytes();
            expected.from = "by measured steps of the model; other work comes on top";
        }
    }
    Ok(())
}

fn in_words(all: &[Expected]) -> String {
    let mut lines = vec![];
    for e in all {
        lines.push(match (e.runs, e.seconds) {
            (false, _) => format!("{:10} does not run", e.stage),
            (true, None) => format!("{:10} runs; {}", e.stage, e.from),
            (true, Some(seconds)) => {
                let memory = e.peak_rss_bytes.map(|b| format!(", {}", size(b)));
                let memory = memory.unwrap_or_default();
                format!(
                    "{:10} about {}{memory} ({})",
                    e.stage,
                    duration(seconds),
                    e.from
                )
            }
        });
    }
    let known: f64 = all.iter().filter_map(|e| e.seconds).sum();
    let open = all.iter().filter(|e| e.runs && e.seconds.is_none()).count();
    lines.push(match open {
        0 => format!("{:10} about {}", "together", duration(known)),
        n => format!(
            "{:10} about {} and {n} of which nothing is known",
            "together",
            duration(known)
        ),
    });
    lines.join("\n")
}
