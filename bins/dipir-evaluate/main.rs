//! `dipir-evaluate`: how good the light of a method is, where the truth is known.
mod bench;
mod cli;
mod generated;
mod lights;
mod make;
mod methods;
mod page;
mod report;
mod run;
mod study;

use std::process::ExitCode;

use clap::Parser;
use cli::{Cli, Command, MethodsArgs, StudyCommand};
use dipir_cli::exit;
use serde_json::json;

fn main() -> ExitCode {
    exit::run(|| match Cli::parse().command {
        Command::Make(args) => make::run(&args),
        Command::Run(args) => run::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Study(StudyCommand::Page(args)) => study::page(&args),
        Command::Study(StudyCommand::Count(args)) => study::count(&args),
        Command::Methods(args) => list(&args),
    })
}

fn list(args: &MethodsArgs) -> anyhow::Result<()> {
    let methods = methods::read(None)?;
    let line = |m: &methods::Method| {
        let needs = if m.model { ", asks a model" } else { "" };
        format!("{:12} {}{needs}", m.name, m.title)
    };
    args.output.result(
        || match args.toml {
            true => methods::TABLE.trim_end().into(),
            false => methods.iter().map(line).collect::<Vec<_>>().join("\n"),
        },
        || json!({"methods": methods}),
    );
    Ok(())
}
