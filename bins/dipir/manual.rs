//! `dipir completions` and `dipir man`, for all executables.
use std::fs;
use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, Command, CommandFactory, ValueEnum};
use clap_complete::Shell;
use clap_mangen::Man;
use dipir_benchmark::command_line as evaluate;
use dipir_cli::exit::printable;
use dipir_cli::output::{print_bytes, print_line};
use dipir_inspection::command_line as inspect;
use dipir_stages::command_line::{composite, concepts, light, lora, model, scene};
use dipir_tradeoff::command_line as tradeoff;

/// Name of this executable.
pub const DIPIR: &str = "dipir";

#[derive(Args)]
pub struct CompletionsArgs {
    /// The shell
    #[arg(value_name = "SHELL")]
    shell: Shell,

    /// The executable whose options are completed
    #[arg(long = "of", value_name = "EXECUTABLE", default_value = DIPIR)]
    executable: Executable,
}

#[derive(Args)]
pub struct ManArgs {
    /// The executable whose page is printed
    #[arg(long = "of", value_name = "EXECUTABLE", default_value = DIPIR)]
    executable: Executable,

    /// Write the pages of all executables into this folder instead
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Executable {
    Dipir,
    DipirScene,
    DipirConcepts,
    DipirLora,
    DipirLight,
    DipirComposite,
    DipirInspect,
    DipirModel,
    DipirEvaluate,
    DipirTradeoff,
    DipirPretrain,
}

impl Executable {
    fn command(self) -> Command {
        match self {
            Self::Dipir => crate::Cli::command(),
            Self::DipirScene => scene::Cli::command(),
            Self::DipirConcepts => concepts::Cli::command(),
            Self::DipirLora => lora::Cli::command(),
            Self::DipirLight => light::Cli::command(),
            Self::DipirComposite => composite::Cli::command(),
            Self::DipirInspect => inspect::Cli::command(),
            Self::DipirModel => model::Cli::command(),
            Self::DipirEvaluate => evaluate::Cli::command(),
            Self::DipirTradeoff => tradeoff::Cli::command(),
            Self::DipirPretrain => dipir_pretraining::command_line::Cli::command(),
        }
    }
}

/// Names of all executables.
pub fn executables() -> impl Iterator<Item = String> {
    let values = Executable::value_variants().iter();
    values
        .filter_map(|e| e.to_possible_value())
        .map(|v| v.get_name().into())
}

pub fn completions(args: &CompletionsArgs) -> anyhow::Result<()> {
    let mut command = args.executable.command();
    let name = command.get_name().to_string();
    let mut text = Vec::new();
    clap_complete::generate(args.shell, &mut command, name, &mut text);
    print_bytes(&text);
    Ok(())
}

pub fn man(args: &ManArgs) -> anyhow::Result<()> {
    let Some(folder) = &args.dir else {
        let mut text = Vec::new();
        Man::new(args.executable.command()).render(&mut text)?;
        print_bytes(&text);
        return Ok(());
    };
    fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
    for executable in Executable::value_variants() {
        clap_mangen::generate_to(executable.command(), folder)
            .with_context(|| format!("cannot write to {}", folder.display()))?;
    }
    print_line(&printable(&format!(
        "wrote the pages to {}",
        folder.display()
    )));
    Ok(())
}
