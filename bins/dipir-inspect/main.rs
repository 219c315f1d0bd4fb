//! `dipir-inspect`: shows any artifact, and whether it is whole.
use std::process::ExitCode;

use anyhow::bail;
use dipir_cli::exit::{self, Usage, printable};
use dipir_cli::style::{bold, color_on_stdout};
use dipir_inspection::command_line::Cli;
use dipir_inspection::inspect;
use dipir_inspection::report::Report;

fn main() -> ExitCode {
    exit::run(|| run(&exit::parse::<Cli>()?))
}

fn run(args: &Cli) -> anyhow::Result<()> {
    if args.view.png.is_some() && args.paths.len() != 1 {
        return Err(Usage("--png shows one image: give one PATH".into()).into());
    }
    let mut reports = Vec::new();
    for path in &args.paths {
        reports.push(inspect(path, &args.view)?);
    }
    print(args, &reports);
    let problems: Vec<_> = reports.iter().flat_map(|r| &r.problems).collect();
    match problems.as_slice() {
        [] => Ok(()),
        [one] => bail!("{one}"),
        [first, rest @ ..] => bail!("{first} (and {} more)", rest.len()),
    }
}

fn print(args: &Cli, reports: &[Report]) {
    let text = || {
        let color = color_on_stdout();
        let shown: Vec<String> = reports
            .iter()
            .map(|r| {
                let title = bold(&printable(&r.title), color);
                format!("{title}\n{}", printable(r.text.trim_end()))
            })
            .collect();
        shown.join("\n\n")
    };
    let json = || match reports {
        [one] => one.json.clone(),
        many => many.iter().map(|r| r.json.clone()).collect(),
    };
    args.output.result(text, json);
}
