//! `dipir report`, and the page that `dipir run` leaves.
use std::path::PathBuf;

use clap::Args;
use dipir_cli::exit::{Usage, describe, printable};
use dipir_cli::output::json_path;
use dipir_cli::session::Session;
use dipir_pipeline::graph::Graph;
use dipir_stages::graph;
use dipir_stages::report::{self, Report};
use dipir_stages::truth::{self, Truth};
use serde_json::json;

use crate::project::{ProjectArgs, one_file};

#[derive(Args)]
#[command(mut_arg("files", one_file))]
pub struct ReportArgs {
    #[command(flatten)]
    project: ProjectArgs,
}

pub fn run(args: &ReportArgs) -> anyhow::Result<()> {
    let (session, graph) = args.project.open()?;
    if !report::has_anything(&session) {
        let message = "no stage has run yet, so there is nothing to show; run dipir run first";
        return Err(Usage(message.into()).into());
    }
    let (path, truth) = write(&args.project, &session, &graph, &[])?;
    session.result(
        || printable(&in_words(&path, truth.as_ref())),
        || json!({"report": json_path(&path), "truth": truth}),
    );
    Ok(())
}

/// Writes the page, with the state of all stages, whichever ran, and the frames that `failed`; where it is, and the
/// comparison with the true light, if that is known.
pub fn write(
    args: &ProjectArgs,
    session: &Session,
    graph: &Graph,
    failed: &[String],
) -> anyhow::Result<(PathBuf, Option<Truth>)> {
    let status = graph::assess(session, graph, &graph.up_to(graph::LAST))?;
    let truth = truth::compare(session).unwrap_or_else(|e| {
        session.warn(&format!(
            "not compared with the true light: {}",
            describe(&e)
        ));
        None
    });
    let report = Report {
        session,
        status: &status,
        options: &args.options(),
        truth: truth.as_ref(),
        failed,
    };
    Ok((report.write()?, truth))
}

/// The lines that end a run.
pub fn in_words(path: &std::path::Path, truth: Option<&Truth>) -> String {
    let truth = truth.map_or_else(String::new, |t| format!("{}\n", t.in_words()));
    format!("{truth}wrote {}", path.display())
}
