//! Shell completions and manual pages.
use std::io::Write;
use std::process::Stdio;

use crate::project::*;

const EXECUTABLES: [&str; 11] = [
    "dipir",
    "dipir-scene",
    "dipir-concepts",
    "dipir-lora",
    "dipir-light",
    "dipir-composite",
    "dipir-inspect",
    "dipir-model",
    "dipir-evaluate",
    "dipir-tradeoff",
    "dipir-pretrain",
];

#[test]
fn every_executable_has_completions_that_a_shell_accepts() {
    let project = Project::new();
    for name in EXECUTABLES {
        let run = project.run(DIPIR, &["completions", "bash", "--of", name]);
        run.expect_success();
        let registers =
            |line: &str| line.contains("complete -F") && line.ends_with(&format!(" {name}"));
        assert!(run.stdout.lines().any(registers), "{name}: {}", run.stdout);
        let mut bash = project.command("bash", &["-n"]);
        let Ok(mut shell) = bash.stdin(Stdio::piped()).spawn() else {
            eprintln!("bash is not installed: it is not asked");
            continue;
        };
        let mut input = shell.stdin.take().unwrap();
        input.write_all(run.stdout.as_bytes()).unwrap();
        drop(input);
        Run::from(shell.wait_with_output().unwrap()).expect_success();
    }
    let zsh = project.run(DIPIR, &["completions", "zsh"]).stdout;
    for option in ["#compdef dipir", "--until=", "scene", "composite"] {
        assert!(zsh.contains(option), "{option}");
    }
}

#[test]
fn every_executable_and_subcommand_has_a_manual_page() {
    let project = Project::new();
    project
        .run(DIPIR, &["man", "--dir", "man"])
        .expect_success();
    let page = |name: &str| String::from_utf8(project.read(&format!("man/{name}.1"))).unwrap();
    for name in EXECUTABLES.into_iter().chain([
        "dipir-init",
        "dipir-run",
        "dipir-report",
        "dipir-model-fetch",
    ]) {
        let text = page(name);
        assert!(text.contains(&format!(".TH {name} 1")), "{name}: {text}");
    }
    let text = page("dipir-light");
    assert!(
        text.contains("\\-\\-set") && text.contains("Exit codes: 0 done"),
        "{text}"
    );
    // The page of one executable goes to standard output.
    let one = project.run(DIPIR, &["man", "--of", "dipir-light"]);
    assert_eq!(one.stdout, text);
}
