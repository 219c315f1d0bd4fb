//! `dipir-tradeoff`: what accuracy costs, knob by knob and together.
use std::process::ExitCode;

use dipir_cli::exit;
use dipir_cli::output::json_paths;
use dipir_cli::progress::Progress;
use dipir_tradeoff::command_line::Cli;
use dipir_tradeoff::sweep::{Step, sweep};
use serde_json::json;

fn main() -> ExitCode {
    exit::run(|| run(&exit::parse::<Cli>()?))
}

fn run(cli: &Cli) -> anyhow::Result<()> {
    let progress = Progress::new("tradeoff", cli.output.quiet);
    let outcome = sweep(cli, &mut |step: Step| {
        progress.set(step.share);
        let point = format!("{}: {} {}", step.scene, step.series, step.label);
        if cli.output.verbose && !cli.report_only {
            progress.note(&format!("{} of {}: {point}", step.done + 1, step.total));
        }
        progress.say(point);
    })?;
    progress.done();
    cli.output.result(
        || {
            let names = outcome.files.iter();
            let names: Vec<String> = names.map(|f| format!("  {}", f.display())).collect();
            format!("{} points; wrote\n{}", outcome.points, names.join("\n"))
        },
        || json!({"points": outcome.points, "files": json_paths(&outcome.files)}),
    );
    Ok(())
}
