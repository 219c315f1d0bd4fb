//! What a command line that cannot be understood was probably meant to be.
use std::ffi::OsStr;
use std::path::Path;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory, Parser};
use dipir_cli::exit::{self, Usage};
use dipir_pipeline::config::{nearest, renamed};

use crate::{Cli, manual};

/// Reads the command line. What clap has no better word for than that it is wrong is answered with
/// what was meant.
pub fn parse() -> anyhow::Result<Cli> {
    let error = match Cli::try_parse() {
        Ok(cli) => return Ok(cli),
        Err(error) => error,
    };
    match meant(&error) {
        Some(message) => Err(Usage(message).into()),
        None => Err(exit::answered(&error)),
    }
}

fn meant(error: &clap::Error) -> Option<String> {
    let said = |kind| match error.get(kind) {
        Some(ContextValue::String(text)) => Some(text.as_str()),
        _ => None,
    };
    match error.kind() {
        ErrorKind::InvalidSubcommand => {
            let name = said(ContextKind::InvalidSubcommand)?;
            file(name)
                .or_else(|| executable(name))
                .or_else(|| command(name))
        }
        ErrorKind::TooManyValues if said(ContextKind::InvalidArg)? == "[FILE]" => {
            let name = said(ContextKind::InvalidValue)?;
            Some(format!(
                "{name}: this takes one file; dipir run takes several"
            ))
        }
        ErrorKind::InvalidValue => {
            let value = said(ContextKind::InvalidValue)?;
            let option = said(ContextKind::InvalidArg)?;
            let option = option.split(' ').next()?;
            renamed(value).map(|now| format!("{option} {value}: that stage is called {now} now"))
        }
        _ => None,
    }
}

/// For what is an executable of its own: a stage, or one of those that stand beside them.
fn executable(name: &str) -> Option<String> {
    let own = format!("dipir-{name}");
    if manual::executables().any(|known| known == own) {
        return Some(format!(
            "{name} is no command of dipir but an executable of its own: {own} --help"
        ));
    }
    None
}

/// For a slip of the pen.
fn command(name: &str) -> Option<String> {
    let all = Cli::command();
    let names = all.get_subcommands().map(clap::Command::get_name);
    let meant = nearest(name, names)?;
    Some(format!(
        "{name} is no command of dipir; did you mean dipir {meant}?"
    ))
}

/// How to begin with a photograph and an object.
pub fn beginning() -> &'static str {
    match Cli::command().find_subcommand("init").is_some() {
        true => "to begin with a photograph and an object: dipir init PHOTO MODEL",
        false => {
            "name the photograph in a pipeline.toml, as [scene] background, and its object, as in \
             the README, and run it: dipir run pipeline.toml"
        }
    }
}

/// For a file where a command should stand.
fn file(name: &str) -> Option<String> {
    let extension = Path::new(name).extension().and_then(OsStr::to_str)?;
    if extension == "toml" {
        return Some(format!(
            "{name} is no command of dipir; to run it: dipir run {name}"
        ));
    }
    Some(format!("{name} is no command of dipir; {}", beginning()))
}
