//! `dipir-evaluate`: how good the light of a method is, where the truth is known.
use std::process::ExitCode;

use dipir_benchmark::command_line::{
    Cli, Command, LeftOutArgs, MakeArgs, MethodsArgs, ReportArgs, RunArgs, SpheresArgs,
    StudyCommand, StudyCountArgs, StudyPageArgs,
};
use dipir_benchmark::folder::EvaluationFolder;
use dipir_benchmark::methods::{self, Method};
use dipir_benchmark::run::Step;
use dipir_benchmark::{left_out, make, report, run, spheres, study};
use dipir_cli::exit::{self, check_png, describe};
use dipir_cli::output::{json_path, json_paths};
use dipir_cli::progress::Progress;
use serde_json::json;

fn main() -> ExitCode {
    exit::run(|| match exit::parse::<Cli>()?.command {
        Command::Make(args) => make_scenes(&args),
        Command::Run(args) => run_methods(&args),
        Command::Report(args) => write_report(&args),
        Command::Study(StudyCommand::Page(args)) => write_study(&args),
        Command::Study(StudyCommand::Count(args)) => count_answers(&args),
        Command::Methods(args) => list_methods(&args),
        Command::LeftOut(args) => compare_left_out(&args),
        Command::Spheres(args) => compare_spheres(&args),
    })
}

fn make_scenes(args: &MakeArgs) -> anyhow::Result<()> {
    let progress = Progress::new("make", args.folder.output.quiet);
    let made = make::make(args, &|share| progress.set(share))?;
    progress.done();
    let evaluation = EvaluationFolder::new(&args.folder.out);
    let scenes = evaluation.root().join("scenes");
    args.folder.output.result(
        || format!("{} scenes in {}", made.len(), scenes.display()),
        || json!({"scenes": made, "folder": json_path(evaluation.root())}),
    );
    Ok(())
}

fn compare_left_out(args: &LeftOutArgs) -> anyhow::Result<()> {
    let progress = Progress::new("left-out", args.folder.output.quiet);
    let out = &args.folder.out;
    let settings = left_out::Settings {
        panoramas: args.panoramas.clone(),
        weights: args.weights.clone(),
        models: args.models.clone(),
        views: args.views,
        seed: args.seed,
        target_error: args.target_error,
        parts: args.parts,
        cache: out.join("left-out"),
        sheet: args.sheet,
    };
    let outcome = left_out::run(&settings, &|share| progress.set(share))?;
    progress.done();
    outcome.write(out)?;
    args.folder.output.result(
        || outcome.tables.trim_end().to_string(),
        || json!({"scenes": outcome.scenes}),
    );
    Ok(())
}

fn run_methods(args: &RunArgs) -> anyhow::Result<()> {
    let output = &args.folder.output;
    let progress = Progress::new("evaluate", output.quiet);
    let ended = |step: Step| {
        let Step {
            done,
            total,
            scene,
            method,
        } = step;
        progress.set(done as f64 / total as f64);
        if output.verbose {
            progress.note(&format!("{done} of {total}: {scene}, {method}"));
        }
    };
    let outcome = run::run(args, &|line| output.warn(line), &ended)?;
    progress.done();
    for (which, error) in &outcome.failures {
        output.warn(&format!("{which}: {}", describe(error)));
    }
    if let Some((which, error)) = outcome.failures.into_iter().next() {
        return Err(error.context(format!(
            "not every run succeeded; the first that failed is {which}"
        )));
    }
    output.result(
        || {
            format!(
                "{} methods on {} scenes in {}; show them with dipir-evaluate report",
                outcome.methods,
                outcome.scenes,
                outcome.folder.display()
            )
        },
        || json!({"scenes": outcome.scenes, "methods": outcome.methods, "folder": json_path(&args.folder.out)}),
    );
    Ok(())
}

fn write_report(args: &ReportArgs) -> anyhow::Result<()> {
    let written = report::report(args)?;
    args.folder.output.result(
        || {
            let names = written.files.iter().map(|f| f.display().to_string());
            let names: Vec<String> = names.collect();
            format!("{}\nwrote {}", written.tables.trim_end(), names.join(", "))
        },
        || json!({"files": json_paths(&written.files)}),
    );
    Ok(())
}

fn write_study(args: &StudyPageArgs) -> anyhow::Result<()> {
    let page = study::page(args)?;
    if !page.changed.is_empty() {
        args.folder.output.warn(&format!(
            "left out, for they have changed since a method ran on them; run dipir-evaluate run again: {}",
            page.changed.join(", ")
        ));
    }
    args.folder.output.result(
        || {
            format!(
                "wrote {}: {} pairs; open it in a browser, and count the files that it saves with \
                 dipir-evaluate study count",
                page.file.display(),
                page.pairs
            )
        },
        || json!({"page": json_path(&page.file), "pairs": page.pairs, "changed": page.changed}),
    );
    Ok(())
}

fn count_answers(args: &StudyCountArgs) -> anyhow::Result<()> {
    let counted = study::count(args)?;
    args.output.result(
        || study::table(&counted.verdicts),
        || json!({"participants": counted.participants, "verdicts": counted.verdicts}),
    );
    Ok(())
}

fn list_methods(args: &MethodsArgs) -> anyhow::Result<()> {
    let methods = methods::read(None)?;
    let line = |m: &Method| {
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

fn compare_spheres(args: &SpheresArgs) -> anyhow::Result<()> {
    if let Some(png) = &args.png {
        check_png(png, "the comparison", "spheres.png")?;
    }
    let scores = spheres::compare_files(&args.truth, &args.estimate, args.png.as_deref())?;
    args.output
        .result(|| spheres::table(&scores), || json!({"spheres": scores}));
    Ok(())
}
