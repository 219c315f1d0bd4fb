//! `dipir-tradeoff`: what accuracy costs, knob by knob and together.
use std::process::ExitCode;

use dipir_cli::exit::{self, printable};
use dipir_cli::output::{json_paths, say};
use dipir_cli::progress::Progress;
use dipir_cli::session::duration;
use dipir_tradeoff::command_line::Cli;
use dipir_tradeoff::sweep::{Step, sweep};
use serde_json::json;

fn main() -> ExitCode {
    exit::run(|| run(&exit::parse::<Cli>()?))
}

fn run(cli: &Cli) -> anyhow::Result<()> {
    let progress = Progress::new("tradeoff", cli.output.quiet);
    let outcome = sweep(cli, &mut |step: Step| {
        if step.done == 0 && !cli.report_only && step.expected_s != Some(0.0) {
            say_what_comes(cli, &step);
        }
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

/// Says how much is about to be measured.
fn say_what_comes(cli: &Cli, step: &Step) {
    if cli.output.quiet {
        return;
    }
    let takes = step.expected_s.map_or_else(String::new, |seconds| {
        format!("about {} of processor time; ", duration(seconds))
    });
    say(format!(
        "{} points, each {} times, into {}: {takes}Ctrl-C ends it, and the same command goes on",
        step.total,
        cli.repeats,
        printable(&cli.out.display().to_string())
    ));
}
