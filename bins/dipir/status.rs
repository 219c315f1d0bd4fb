//! `dipir status` and `dipir graph`.
use clap::Args;
use dipir_cli::exit::printable;
use dipir_cli::style::{bold, color_on_stdout, faint};
use dipir_pipeline::status::{StageStatus, State};
use dipir_stages::{graph, shot};
use serde_json::json;

use crate::project::{ProjectArgs, Stage, one_file};

#[derive(Args)]
#[command(mut_arg("files", one_file))]
pub struct StatusArgs {
    #[command(flatten)]
    project: ProjectArgs,

    /// Ask for this stage and what it needs only
    #[arg(long, value_name = "STAGE")]
    until: Option<Stage>,
}

#[derive(Args)]
#[command(mut_arg("files", one_file))]
pub struct GraphArgs {
    #[command(flatten)]
    project: ProjectArgs,

    /// For Graphviz, as in dipir graph --dot | dot -Tsvg > graph.svg
    #[arg(long, conflicts_with = "json")]
    dot: bool,
}

/// Says of each stage whether it is up to date, and why not.
pub fn run(args: &StatusArgs) -> anyhow::Result<()> {
    let (session, graph) = args.project.open()?;
    let needed = graph.up_to(args.until.map_or(graph::LAST, Stage::name));
    let all = graph::assess(&session, &graph, &needed)?;
    let frames = shot::folders(&session.out);
    let made = frames.iter().filter(|frame| shot::is_made(frame)).count();
    let begun = frames.len();
    let words = || match begun {
        0 => in_words(&all),
        _ => format!(
            "{}\nframes     {made} of {begun} that were begun, in {}; dipir shot --plan FRAME… says which of them are up to date",
            in_words(&all),
            printable(&session.out.join(shot::FOLDER).display().to_string()),
        ),
    };
    session.result(words, || json!({"stages": all, "frames": made}));
    Ok(())
}

/// One line a stage, and one for every further reason.
fn in_words(all: &[StageStatus]) -> String {
    let width = all.iter().map(|s| s.stage.len()).max().unwrap_or(0);
    let color = color_on_stdout();
    let lines: Vec<String> = all
        .iter()
        .map(|s| {
            let name = bold(&format!("{:width$}", s.stage), color);
            let state = printable(&s.state.to_string());
            match s.state {
                State::Fresh | State::Unneeded { .. } => {
                    format!("{name}  {}", faint(&state, color))
                }
                _ => format!("{name}  {state}"),
            }
        })
        .collect();
    lines.join("\n")
}

/// Shows which stage reads which.
pub fn graph(args: &GraphArgs) -> anyhow::Result<()> {
    let (session, graph) = args.project.open()?;
    session.result(
        || match args.dot {
            true => graph.to_dot(),
            false => graph.to_text(),
        },
        || json!({"stages": graph.nodes()}),
    );
    Ok(())
}
