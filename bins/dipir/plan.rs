//! `--plan`: what a run would do and take, before anything starts.
use std::path::PathBuf;

use dipir_cli::interrupt;
use dipir_cli::session::{Session, duration, size};
use dipir_pipeline::fingerprint::StaleReason;
use dipir_pipeline::graph::{Graph, Node};
use dipir_pipeline::manifest::{Manifest, peak_rss_bytes};
use dipir_pipeline::status::State;
use dipir_stages::composite::table::CompositeTable;
use dipir_stages::graph;
use dipir_stages::light;
use dipir_stages::lora::table::LoraTable;
use dipir_stages::model::{self, ModelTable, forecast};
use dipir_stages::names::{COMPOSITE, CONCEPTS, LIGHT, LORA, SCENE};
use serde::Serialize;
use serde_json::{Value, json};

use crate::project::ProjectArgs;
use crate::run;

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

impl Expected {
    fn idle(stage: &'static str) -> Self {
        Self {
            stage,
            runs: false,
            seconds: None,
            peak_rss_bytes: None,
            from: "it does not run",
        }
    }

    /// By the run before, if any; `changed` says that it had other settings. Their time tells less than what is
    /// `foretold` from it, and than a budget.
    fn running(
        stage: &'static str,
        earlier: Option<Manifest>,
        changed: bool,
        budget_s: Option<f64>,
        foretold_s: Option<f64>,
    ) -> Self {
        let (seconds, from) = match (&earlier, changed) {
            (Some(earlier), false) => (Some(earlier.elapsed_s), "as it took the last time"),
            (_, _) if budget_s.is_some() => (budget_s, "its time budget"),
            (_, true) if foretold_s.is_some() => (
                foretold_s,
                "from the times of the last run, which had other settings",
            ),
            (Some(earlier), true) => (
                Some(earlier.elapsed_s),
                "as it took the last time, with other settings",
            ),
            (None, _) => (None, "nothing is known: it has not run here"),
        };
        Self {
            stage,
            runs: true,
            seconds,
            peak_rss_bytes: earlier.and_then(|e| e.peak_rss_bytes),
            from,
        }
    }
}

/// Whether the outputs that are there were made with other parameters.
fn has_other_settings(state: &State) -> bool {
    let reasons = match state {
        State::Stale { reasons } | State::Waits { reasons, .. } => reasons,
        State::Fresh | State::Blocked { .. } | State::Unneeded { .. } => return false,
    };
    let is_parameter = |r: &StaleReason| matches!(r, StaleReason::Parameter { .. });
    reasons.iter().any(is_parameter)
}

/// Whether a run of the LoRA stage with these parameters trained one. How long that took says nothing of one that is read.
fn trains(params: &Value) -> bool {
    params["lora"]["path"].is_null()
}

/// The stages of a run with their expected time and memory, for people and for programs.
pub fn plan(
    session: &Session,
    graph: &Graph,
    nodes: &[&Node],
    force: bool,
) -> anyhow::Result<(String, Value)> {
    let states = graph::assess(session, graph, nodes)?;
    let trained = session.config.table::<LoraTable>("lora")?.path.is_none();
    let mut all = vec![];
    for node in nodes {
        let state = states.iter().find(|s| s.stage == node.stage);
        let idle = state.is_none_or(|s| matches!(s.state, State::Unneeded { .. }))
            || (!force && state.is_some_and(|s| matches!(s.state, State::Fresh)));
        let earlier = Manifest::read(&session.stage_folder(node.stage), "").ok();
        let earlier = earlier.filter(|e| node.stage != LORA.name || trains(&e.params) == trained);
        let changed = state.is_some_and(|s| has_other_settings(&s.state));
        let foretold = earlier
            .as_ref()
            .filter(|_| changed && !idle && node.stage == LIGHT.name)
            .and_then(|earlier| light::forecast::seconds(session, earlier));
        let budget = match node.stage == COMPOSITE.name && (changed || earlier.is_none()) {
            true => session.config.table("composite")?,
            false => CompositeTable::default(),
        };
        let expected = match idle {
            true => Expected::idle(node.stage),
            false => {
                Expected::running(node.stage, earlier, changed, budget.time_budget_s, foretold)
            }
        };
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

/// What the frames of a shot would take, after the plan of its photograph (`photo`). A frame takes as long as the frames that
/// have run, or as the photograph's own picture if none has. With `force` all frames run.
pub fn frames(
    base: &Session,
    photo: (String, Value),
    frames: &[(PathBuf, ProjectArgs)],
    force: bool,
) -> anyhow::Result<(String, Value)> {
    let runs = |e: &Value| e["runs"] == json!(true);
    // Objects and light are those of the photograph.
    let concerns_all = photo.1["plan"]
        .as_array()
        .is_some_and(|all| all.iter().any(runs));
    let (mut stale, mut took) = (0, vec![]);
    for (_, project) in frames {
        let (session, graph) = project.open()?;
        let nodes = graph.up_to(graph::LAST);
        stale += usize::from(force || concerns_all || !run::all_fresh(&session, &graph, &nodes)?);
        took.extend(seconds(&session));
    }
    if took.is_empty() {
        took.extend(seconds(base));
    }
    let each = (!took.is_empty()).then(|| took.iter().sum::<f64>() / took.len() as f64);
    let together = each.map(|each| each * stale as f64);
    let all = frames.len();
    let mut words = format!("frames     {stale} of {all} run");
    words += &match (stale, each.zip(together)) {
        (0, _) => String::new(),
        (_, None) => "; nothing is known: none has run here".into(),
        (_, Some((each, together))) => format!(
            ", about {} each: about {}",
            duration(each),
            duration(together)
        ),
    };
    let (of_photo, mut json) = photo;
    json["frames"] = json!({"all": all, "run": stale, "seconds_each": each, "seconds": together});
    Ok((format!("{of_photo}\n{words}"), json))
}

/// What the picture of a session took the last time.
fn seconds(session: &Session) -> Option<f64> {
    let of = |stage: &str| Manifest::read(&session.stage_folder(stage), "").ok();
    Some(of(SCENE.name)?.elapsed_s + of(COMPOSITE.name)?.elapsed_s)
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
    let known: Vec<f64> = all.iter().filter_map(|e| e.seconds).collect();
    let sum = duration(known.iter().fold(0.0, |sum, s| sum + s));
    let open = all.iter().filter(|e| e.runs && e.seconds.is_none()).count();
    let together = match (known.len(), open) {
        (0, 0) => "nothing to do".to_string(),
        (0, _) => "nothing is known".to_string(),
        (_, 0) => format!("about {sum}"),
        (_, n) => format!("about {sum} and {n} of which nothing is known"),
    };
    lines.push(format!("{:10} {together}", "together"));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest() -> Manifest {
        Manifest {
            schema: 2,
            stage: COMPOSITE.name.into(),
            version: 1,
            params: Value::Null,
            seed: 0,
            device: "cpu".into(),
            inputs: vec![],
            outputs: vec![],
            elapsed_s: 8.5,
            timings_s: Default::default(),
            peak_rss_bytes: Some(1 << 30),
            estimated_error: None,
        }
    }

    #[test]
    fn an_earlier_time_with_other_settings_is_said_to_be_one() {
        let foretold = |earlier: bool, changed, budget, foretold| {
            let earlier = earlier.then(manifest);
            let e = Expected::running(COMPOSITE.name, earlier, changed, budget, foretold);
            (e.seconds, e.from)
        };
        let of = |earlier, changed, budget| foretold(earlier, changed, budget, None);
        let last = "as it took the last time";
        assert_eq!(of(true, false, Some(60.0)), (Some(8.5), last));
        let other = "as it took the last time, with other settings";
        assert_eq!(of(true, true, None), (Some(8.5), other));
        assert_eq!(of(true, true, Some(60.0)), (Some(60.0), "its time budget"));
        assert_eq!(
            of(false, false, Some(60.0)),
            (Some(60.0), "its time budget")
        );
        assert_eq!(of(false, false, None).0, None);
        let by_it = "from the times of the last run, which had other settings";
        assert_eq!(foretold(true, true, None, Some(3.0)), (Some(3.0), by_it));
        let parameter = StaleReason::Parameter {
            key: "quality".into(),
            was: None,
            now: None,
        };
        let on = vec!["scene"];
        for (reason, is) in [(parameter, true), (StaleReason::NeverRun, false)] {
            let reasons = vec![reason];
            let stale = State::Stale {
                reasons: reasons.clone(),
            };
            assert_eq!(has_other_settings(&stale), is);
            let on = on.clone();
            assert_eq!(has_other_settings(&State::Waits { on, reasons }), is);
        }
    }

    #[test]
    fn a_lora_that_was_read_is_not_one_that_was_trained() {
        assert!(trains(&json!({"lora": {"rank": 4}})));
        assert!(!trains(&json!({"lora": {"path": "a.safetensors"}})));
    }

    #[test]
    fn the_sum_is_of_what_runs() {
        let idle = || Expected::idle("scene");
        assert!(in_words(&[idle()]).ends_with("together   nothing to do"));
        assert!(!json!([idle()]).to_string().contains("has not run here"));
        let runs = |earlier| Expected::running("light", earlier, false, None, None);
        assert!(in_words(&[idle(), runs(None)]).ends_with("together   nothing is known"));
        assert!(in_words(&[idle(), runs(Some(manifest()))]).ends_with("about 8.50 s"));
        let text = in_words(&[runs(Some(manifest())), runs(None)]);
        assert!(
            text.ends_with("about 8.50 s and 1 of which nothing is known"),
            "{text}"
        );
    }
}
