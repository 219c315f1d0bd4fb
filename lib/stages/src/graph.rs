//! All stages together: which ones a configuration needs, what each reads, and what a run of each
//! would be.
use std::cell::RefCell;

use dipir_cli::exit::{self, describe};
use dipir_cli::session::Session;
use dipir_pipeline::error::StageError;
use dipir_pipeline::graph::{Graph, Node};
use dipir_pipeline::stage::StagePlan;
use dipir_pipeline::status::{self, StageStatus, State};
use dipir_scene::config::SceneConfig;

use crate::light::materials;
use crate::light::method::Method;
use crate::model::ModelTable;
use crate::names::{COMPOSITE, CONCEPTS, LIGHT, LORA, SCENE, StageName, refuse_replaced};
use crate::truth::ReportTable;
use crate::{composite, concepts, light, lora, reasons, scene};

/// The stage that everything leads to.
pub const LAST: &str = COMPOSITE.name;

/// The graph of the session's configuration.
pub fn graph(session: &Session) -> anyhow::Result<Graph> {
    // Read here so that an error in them is reported before anything runs.
    let _: (SceneConfig, ModelTable) = (
        session.config.table("scene")?,
        session.config.table("model")?,
    );
    let report: ReportTable = session.config.table("report")?;
    report.placement().check(&session.config)?;
    let method = Method::of(session)?;
    let no_model = method.without_model();
    let no_light = match method {
        Method::Given | Method::Taken => no_model,
        _ => None,
    };
    let no_concepts = no_model.or(lora::without_concepts(session)?);
    let chosen = |stages: &[(&'static str, bool)]| -> Vec<&'static str> {
        let chosen = stages.iter().filter(|(_, on)| *on);
        chosen.map(|(stage, _)| *stage).collect()
    };
    let node = |stage: &StageName, reads, unneeded| Node {
        stage: stage.name,
        executable: stage.executable,
        reads,
        unneeded,
    };
    Ok(Graph::new(vec![
        node(&SCENE, vec![], None),
        node(&CONCEPTS, vec![], no_concepts),
        node(
            &LORA,
            chosen(&[(CONCEPTS.name, lora::preserves_concepts(session)?)]),
            no_model,
        ),
        node(
            &LIGHT,
            chosen(&[(SCENE.name, true), (LORA.name, no_model.is_none())]),
            no_light,
        ),
        node(
            &COMPOSITE,
            chosen(&[(SCENE.name, true), (LIGHT.name, no_light.is_none())]),
            None,
        ),
    ]))
}

/// What a run of the stage would be, from the configuration, the files that it names, and the
/// manifests of the stages that it reads.
pub fn plan(session: &Session, stage: &str) -> anyhow::Result<StagePlan> {
    let plan: fn(&Session) -> anyhow::Result<StagePlan> = match stage {
        s if s == SCENE.name => scene::plan,
        s if s == CONCEPTS.name => concepts::plan,
        s if s == LORA.name => lora::plan,
        s if s == LIGHT.name && materials::are_asked_for(session)? => materials::plan,
        s if s == LIGHT.name => light::plan,
        s if s == COMPOSITE.name => composite::plan_of,
        other => anyhow::bail!("there is no stage \"{other}\""),
    };
    let plan = plan(session)?;
    refuse_replaced(session, &plan)?;
    Ok(plan)
}

/// The states of all stages that `needed` selects; an error if the configuration is wrong for one
/// of them.
pub fn assess(
    session: &Session,
    graph: &Graph,
    needed: &[&Node],
) -> anyhow::Result<Vec<StageStatus>> {
    let wrong = RefCell::new(None);
    let plan = |stage: &str| {
        plan(session, stage).map_err(|e| {
            let message = describe(&e);
            if exit::code_of(&e) == exit::USAGE {
                wrong.borrow_mut().get_or_insert(e);
            }
            message
        })
    };
    let mut states = status::assess(graph, needed, plan, |stage| session.stage_folder(stage))?;
    for status in &mut states {
        status
            .state
            .with_reasons(|r| reasons::by_keys(status.stage, r));
    }
    match wrong.take() {
        Some(e) => Err(e),
        None => Ok(states),
    }
}

/// The state of one stage, when everything that it reads is there.
pub fn state_of(session: &Session, stage: &str) -> Result<State, StageError> {
    let plan = plan(session, stage).map_err(|e| describe(&e));
    let mut state = status::state_of(plan, &session.stage_folder(stage))?;
    state.with_reasons(|r| reasons::by_keys(stage, r));
    Ok(state)
}
