//! `dipir preview`.
use std::fs;
use std::path::{Path, PathBuf};

use clap::Args;
use dipir_cli::exit::{Usage, check_png, printable};
use dipir_cli::output::json_path;
use dipir_cli::session::{Session, duration};
use dipir_preview::picture::Preview;
use serde_json::json;

use crate::project::FileArgs;

#[derive(Args)]
pub struct PreviewArgs {
    #[command(flatten)]
    project: FileArgs,

    /// The picture to write; a file that dipir did not make is not replaced
    /// [default: preview.png beside the project's file]
    #[arg(long, short = 'o', value_name = "PNG")]
    out: Option<PathBuf>,

    /// Boxes and lines alone, without a draft of the objects
    #[arg(long)]
    wire: bool,
}

/// Draws what is configured, without running a stage.
pub fn run(args: &PreviewArgs) -> anyhow::Result<()> {
    if let Some(path) = &args.out {
        check_png(path, "the preview", "preview.png")?;
    }
    let session = args.project.start()?;
    let path = args.out.clone();
    let path = path.unwrap_or_else(|| session.config.base_dir().join("preview.png"));
    refuse_input(&session, &path)?;
    let preview = Preview::new(&session, !args.wire)?;
    for warning in &preview.arrangement.warnings {
        session.warn(warning);
    }
    preview.write(&path)?;
    let light = preview.light.map(|l| l.words_of(&session)).transpose()?;
    let took = duration(preview.seconds);
    session.result(
        || {
            let light = light.map_or_else(String::new, |l| format!("; light: {l}"));
            printable(&format!("wrote {} in {took}{light}", path.display()))
        },
        || json!({"preview": json_path(&path), "light": light, "seconds": preview.seconds}),
    );
    Ok(())
}

/// Refuses to draw over a file that the project reads.
fn refuse_input(session: &Session, path: &Path) -> Result<(), Usage> {
    let Ok(found) = fs::canonicalize(path) else {
        return Ok(());
    };
    let is_it =
        |text: &str| fs::canonicalize(session.resolve(Path::new(text))).ok() == Some(found.clone());
    match session.config.texts().iter().find(|(_, text)| is_it(text)) {
        None => Ok(()),
        Some((key, _)) => Err(Usage(printable(&format!(
            "{} is what {key} names, and the preview would replace it: name another file with --out",
            path.display()
        )))),
    }
}
